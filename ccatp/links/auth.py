"""Keys of the observatory channel and of the robot link, and the clients that may use the channel over TCP.

A CURVE pair is two files in the format of ``zmq.auth``: ``NAME.key`` for others, ``NAME.key_secret`` with both halves.
A secret file that others may read is refused. The list of clients is TOML, a table for each client::

    [clients.observatory]
    public_key = "<40 characters, Z85>"
    role = "clear"

``raise`` may report emergencies and ask for the event code; ``clear`` may also end emergencies.
"""

import os
import secrets
import stat
import struct
import tomllib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import zmq
from zmq.auth import load_certificate
from zmq.utils import z85

from ccatp.errors import ConfigError

KEY_CHARACTERS = 40
PUBLIC_SUFFIX, SECRET_SUFFIX, LINK_SUFFIX, CLIENTS_SUFFIX = ".key", ".key_secret", "-robot.key_secret", "-clients.toml"
LINK_KEY_BYTES = 32
# More than a thousand clients; a list is read whole while the danger loop waits.
MAX_FILE_BYTES = 1 << 18
CLIENTS_TEXT = """\
# Who may use the observatory channel over TCP; all others are refused. Read again when it changes.
# role: raise = may report emergencies; clear = may also end them. Public keys: ccatp keys show-public.
#
# [clients.observatory]
# public_key = "..."
# role = "clear"
"""
_T = TypeVar("_T")


class BadAccess(ValueError):
    """A key or a list of clients that is malformed."""


class Role(StrEnum):
    """What a client may do."""

    RAISE = "raise"
    CLEAR = "clear"


class AuthorizedClient(NamedTuple):
    """An entry of the list of clients."""

    name: str
    role: Role


Clients = Mapping[bytes, AuthorizedClient]
"""Clients by their public key, 32 bytes."""


class KeyPair(NamedTuple):
    """A CURVE pair, each half as 40 characters of Z85. Never print or log one."""

    public: bytes
    secret: bytes

    def __repr__(self) -> str:
        """Without the secret."""
        return f"KeyPair(public={self.public!r})"


def decode_key(text: str | bytes) -> bytes:
    """The 32 bytes of a CURVE key of 40 characters (Z85, ZeroMQ RFC 32); ``BadAccess``: the text is not a key."""
    try:
        if len(text) == KEY_CHARACTERS:
            return z85.decode(text)
    except struct.error as error:
        raise BadAccess("a key whose characters stand for more than 32 bytes; copy it once more") from error
    except (KeyError, ValueError):  # a character that is not in the alphabet
        pass
    raise BadAccess(f"a key has {KEY_CHARACTERS} characters of Z85, this one {len(text)}")


def parse_clients(text: str) -> Clients:
    """The clients in the text of a list, which may be empty; ``BadAccess`` where any entry is not of the form above."""
    try:
        tree = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, deep nesting
        raise BadAccess(f"is not TOML: {error}") from error
    if unknown := tree.keys() - {"clients"}:
        raise BadAccess(f"has {min(unknown)}, but only tables [clients.NAME] may stand there")
    tables = tree.get("clients", {})
    if not isinstance(tables, dict):
        raise BadAccess("clients must be tables [clients.NAME]")
    clients: dict[bytes, AuthorizedClient] = {}
    for name, table in tables.items():
        key, client = _parse_client(name, table)
        if key in clients:
            raise BadAccess(f"{clients[key].name} and {name} have the same key")
        clients[key] = client
    return clients


def _parse_client(name: str, table: Any) -> tuple[bytes, AuthorizedClient]:
    if not isinstance(table, dict) or table.keys() != {"public_key", "role"}:
        raise BadAccess(f"clients.{name} must have public_key and role, nothing else")
    if table["role"] not in Role.__members__.values():
        raise BadAccess(f"clients.{name}.role = {table['role']!r} must be raise or clear")
    try:
        key = decode_key(str(table["public_key"]))
    except BadAccess as error:
        raise BadAccess(f"clients.{name}.public_key: {error}") from error
    return key, AuthorizedClient(name, Role(table["role"]))


def read_pair(path: Path, what: str) -> KeyPair:
    """The pair in a secret file; ``what`` is the option or the key that names it, for the error.

    ``ConfigError``: the file cannot be read, is open to others, or holds no pair.
    """
    public, secret = _load(path, what, stat.S_IRWXG | stat.S_IRWXO, SECRET_SUFFIX)
    if secret is None:
        raise ConfigError(f"{what}: {path} holds no secret key; name the file that ends in {SECRET_SUFFIX}")
    if zmq.curve_public(secret) != public:
        raise ConfigError(f"{what}: {path}: public and secret key are no pair; make a new one with ccatp keys generate")
    return KeyPair(public, secret)


def read_public(path: Path, what: str) -> bytes:
    """The public key in a file, secret or not; errors as of ``read_pair``."""
    return _load(path, what, 0, PUBLIC_SUFFIX)[0]


def read_clients(path: Path, what: str) -> Clients:
    """The clients in a file.

    ``ConfigError``: the file cannot be read, others may write it, it is malformed, or it lists no client.
    """
    text = _read(path, what, stat.S_IWGRP | stat.S_IWOTH, partial(Path.read_text, encoding="utf-8", errors="replace"))
    try:
        clients = parse_clients(text)
    except BadAccess as error:
        raise ConfigError(f"{what}: {path}: {error}") from error
    if not clients:
        raise ConfigError(f"{what}: {path} lists no client; add a table [clients.NAME] with public_key and role")
    return clients


class ClientsFile:
    """A list of clients that is read again whenever its file has changed."""

    def __init__(self, path: Path, what: str) -> None:
        self._path, self._what = path, what
        self._stamp: tuple[int, ...] | None = None
        self._clients: Clients = {}
        self.trouble = ""

    @property
    def clients(self) -> Clients:
        """The clients listed now; none where the list cannot be read or is malformed, see ``trouble``."""
        stamp: tuple[int, ...] | None = None
        with suppress(OSError):
            info = self._path.stat()
            stamp = info.st_ino, info.st_size, info.st_mtime_ns, info.st_ctime_ns
        try:
            if stamp is None or stamp != self._stamp:
                self._clients, self._stamp, self.trouble = read_clients(self._path, self._what), stamp, ""
        except ConfigError as error:
            self._clients, self._stamp, self.trouble = {}, None, str(error)
        return self._clients


def _load(path: Path, what: str, forbidden: int, suffix: str) -> tuple[bytes, bytes | None]:
    try:
        public, secret = _read(path, what, forbidden, load_certificate)
        for key in (public, secret or public):
            decode_key(key)
    except BadAccess as error:
        # The text of a malformed key may still be most of a secret: it is not shown.
        raise ConfigError(f"{what}: {path}: {error}") from error
    except ValueError as error:
        raise ConfigError(f"{what}: {path} holds no public key; name the file that ends in {suffix}") from error
    return public, secret


def _read(path: Path, what: str, forbidden: int, read: Callable[[Path], _T]) -> _T:
    try:
        info = path.stat()
        if info.st_mode & forbidden:
            mode = stat.S_IMODE(info.st_mode)
            raise ConfigError(f"{what}: {path} is open to others (mode {mode:04o}); chmod go= {path}")
        if info.st_size > MAX_FILE_BYTES:
            raise ConfigError(f"{what}: {path} is longer than {MAX_FILE_BYTES} bytes; name the right file")
        return read(path)
    except OSError as error:
        raise ConfigError(
            f"{what}: cannot read {path}: {error.strerror}; make keys with ccatp keys generate"
        ) from error


def read_key(key_file: str, *, must_be_private: bool = False) -> bytes | None:
    """Key of the robot link: the file's bytes without white space around them; ``None`` when no file is named.

    ``must_be_private``: refuse a file that others may read; the key of a simulated robot is no secret. ``ConfigError``:
    the file cannot be read, is empty, or is not private.
    """
    if not key_file:
        return None
    forbidden = stat.S_IRWXG | stat.S_IRWXO if must_be_private else 0
    key = _read(Path(key_file), "robot.key_file", forbidden, Path.read_bytes).strip()
    if not key:
        raise ConfigError(f"robot.key_file: {key_file} is empty")
    return key


def make_key_dir(path: Path) -> None:
    """Make a folder for keys with mode 0700, or check that it belongs to the caller and is closed to others.

    ``ConfigError``: it cannot be made or is open to others.
    """
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        info = path.stat()
    except OSError as error:
        raise ConfigError(f"--dir: cannot make {path}: {error.strerror}") from error
    if info.st_uid != os.getuid():
        raise ConfigError(f"--dir: {path} belongs to user {info.st_uid}, not to {os.getuid()}; choose another folder")
    if info.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError(f"--dir: {path} is open to others (mode {stat.S_IMODE(info.st_mode):04o}); chmod 700 {path}")


def write_pair(folder: Path, name: str, *, is_replacing: bool) -> list[Path]:
    """Write a new CURVE pair; returns its two files, the public one first."""
    public, secret = (key.decode() for key in zmq.curve_keypair())
    head = f'# CURVE key {name}, for the observatory channel of ccatp.\nmetadata\n    name = "{name}"\ncurve\n'
    line = f'    public-key = "{public}"\n'
    files = [folder / f"{name}{PUBLIC_SUFFIX}", folder / f"{name}{SECRET_SUFFIX}"]
    _write(files[0], head + line, 0o644, is_replacing)
    _write(files[1], head + line + f'    secret-key = "{secret}"\n', 0o600, is_replacing)
    return files


def write_link_key(folder: Path, name: str, *, is_replacing: bool) -> Path:
    """Write a new key of the robot link (``robot.key_file``); returns its file."""
    path = folder / f"{name}{LINK_SUFFIX}"
    _write(path, secrets.token_hex(LINK_KEY_BYTES) + "\n", 0o600, is_replacing)
    return path


def write_clients(folder: Path, name: str) -> Path:
    """Write a list without clients, unless the file exists; returns its file."""
    path = folder / f"{name}{CLIENTS_SUFFIX}"
    if not path.exists():
        _write(path, CLIENTS_TEXT, 0o600, is_replacing=False)
    return path


def files_in_the_way(folder: Path, name: str, suffixes: Sequence[str]) -> list[Path]:
    """Files that would be replaced."""
    return [path for suffix in suffixes if (path := folder / f"{name}{suffix}").exists()]


def _write(path: Path, text: str, mode: int, is_replacing: bool) -> None:
    # The file has its mode from the beginning, and an existing one is replaced as a whole or not at all.
    new = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        try:
            with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            if is_replacing:
                new.replace(path)
            else:
                os.link(new, path)  # unlike a rename, this fails where the file exists by now
        finally:
            new.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"--dir: cannot write {path}: {error.strerror}") from error
