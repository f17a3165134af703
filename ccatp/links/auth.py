"""Who may use the observatory channel over TCP: the list of clients, and the answers of ZAP (ZeroMQ RFC 27).

The list is TOML, a table for each client::

    [clients.observatory]
    public_key = "<40 characters, Z85>"
    role = "clear"

``raise`` may report emergencies and ask how things are; ``clear`` may end emergencies, too.

Key files: CURVE pairs of the observatory channel, the key of the robot link, the list of clients.

A CURVE pair is two files in the format of ``zmq.auth``: ``NAME.key`` for others, ``NAME.key_secret`` with both halves.
What is secret is readable by its owner alone, and a secret that others may read is refused.
"""

import os
import re
import secrets
import stat
import string
import tomllib
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import zmq

from ccatp.errors import ConfigError

ZAP_VERSION = b"1.0"
ZAP_REQUEST_FRAMES = 7  # version, request, domain, address, routing id, mechanism, and one credential for CURVE
CURVE = b"CURVE"
KEY_BYTES = 32
KEY_CHARACTERS = 40
ALPHABET = string.digits + string.ascii_lowercase + string.ascii_uppercase + ".-:+=^!/*?&<>()[]{}@%$#"
_WEIGHT = {character: value for value, character in enumerate(ALPHABET)}
_GROUP = 5  # characters that hold four bytes


class BadAccess(ValueError):
    """A key or a list of clients that is not of the form; the text says what is wrong."""


class Role(StrEnum):
    """What a client may do."""

    RAISE = "raise"
    CLEAR = "clear"


class AuthorizedClient(NamedTuple):
    """One line of the list."""

    name: str
    role: Role


Clients = Mapping[bytes, AuthorizedClient]
"""Clients by their public key, 32 bytes."""
NOBODY: Clients = {}


def decode_key(text: str) -> bytes:
    """The 32 bytes of a CURVE key.

    Args:
        text: its 40 characters (Z85, ZeroMQ RFC 32).

    Raises:
        BadAccess: it is not that.
    """
    if len(text) != KEY_CHARACTERS or not set(text) <= _WEIGHT.keys():
        raise BadAccess(f"a key has {KEY_CHARACTERS} characters of Z85, this one {len(text)}")
    key = bytearray()
    for start in range(0, KEY_CHARACTERS, _GROUP):
        value = 0
        for character in text[start : start + _GROUP]:
            value = value * len(ALPHABET) + _WEIGHT[character]
        if value >> 32:
            raise BadAccess("a key whose characters stand for more than 32 bytes; copy it once more")
        key += value.to_bytes(4, "big")
    return bytes(key)


def parse_clients(text: str) -> Clients:
    """The clients in a list; an empty list names nobody.

    Raises:
        BadAccess: not TOML, or not of the form above; nothing of such a list counts.
    """
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


class Admission(NamedTuple):
    """The answer to one ZAP request, and what the log should say where it is a refusal (empty where it is none)."""

    reply: list[bytes]
    refusal: str


def answer_zap(frames: Sequence[bytes], domain: str, clients: Clients) -> Admission:
    """Admit the listed clients of one domain, and nobody else.

    Returns:
        The reply, with the client's key in hexadecimal as its user id.
    """
    request = frames[1] if len(frames) > 1 else b""
    if len(frames) != ZAP_REQUEST_FRAMES or frames[0] != ZAP_VERSION:
        return Admission(
            [ZAP_VERSION, request, b"500", b"not a request of ZAP 1.0", b"", b""], "not a request of ZAP 1.0"
        )
    _, _, asked, address, _, mechanism, key = frames
    why = ""
    if asked != domain.encode():
        why = "another domain"
    elif mechanism != CURVE or len(key) != KEY_BYTES:
        why = "no CURVE key"
    elif key not in clients:
        why = f"key {key.hex()} is not on the list"
    if why:
        return Admission(
            [ZAP_VERSION, request, b"400", b"refused", b"", b""], f"{address.decode('ascii', 'replace')}: {why}"
        )
    return Admission([ZAP_VERSION, request, b"200", b"OK", key.hex().encode(), b""], "")


PUBLIC_SUFFIX, SECRET_SUFFIX, LINK_SUFFIX, CLIENTS_SUFFIX = ".key", ".key_secret", "-robot.key_secret", "-clients.toml"
LINK_KEY_BYTES = 32
# More than a thousand clients; a list is read whole while the danger loop waits.
MAX_FILE_BYTES = 1 << 18
_KEY_LINE = re.compile(r'^\s*(public|secret)-key\s*=\s*"(.*)"\s*$', re.MULTILINE)

CLIENTS_TEXT = """\
# Who may use the observatory channel over TCP; nobody else gets in. Read anew when it changes.
# role: raise = may report emergencies; clear = may end them, too. Public keys: ccatp keys show-public.
#
# [clients.observatory]
# public_key = "..."
# role = "clear"
"""


class KeyPair(NamedTuple):
    """A CURVE pair, each half as 40 characters of Z85. Never print or log one."""

    public: bytes
    secret: bytes

    def __repr__(self) -> str:
        """Without the secret."""
        return f"KeyPair(public={self.public!r})"


def read_pair(path: Path, what: str) -> KeyPair:
    """A pair from its secret file.

    Args:
        path: ``NAME.key_secret``.
        what: the option or key of the configuration that names it, for the error.

    Raises:
        ConfigError: it cannot be read, others may read it, or it holds no pair.
    """
    keys = _keys_in(_read(path, what, forbidden=stat.S_IRWXG | stat.S_IRWXO), path, what)
    if keys.keys() != {"public", "secret"}:
        raise ConfigError(f"{what}: {path} holds no secret key; name the file that ends in {SECRET_SUFFIX}")
    public, secret = keys["public"].encode(), keys["secret"].encode()
    if zmq.curve_public(secret) != public:
        raise ConfigError(f"{what}: {path}: public and secret key are no pair; make a new one with ccatp keys generate")
    return KeyPair(public, secret)


def read_public(path: Path, what: str) -> bytes:
    """The public key in a file, secret or not.

    Raises:
        ConfigError: it cannot be read or holds none.
    """
    keys = _keys_in(_read(path, what, forbidden=0), path, what)
    if "public" not in keys:
        raise ConfigError(f"{what}: {path} holds no public key; name the file that ends in {PUBLIC_SUFFIX}")
    return keys["public"].encode()


def read_clients(path: Path, what: str) -> Clients:
    """The list of clients.

    Raises:
        ConfigError: it cannot be read, others may write it, it is not of the form or names nobody.
    """
    text = _read(path, what, forbidden=stat.S_IWGRP | stat.S_IWOTH)
    try:
        clients = parse_clients(text)
    except BadAccess as error:
        raise ConfigError(f"{what}: {path}: {error}") from error
    if not clients:
        raise ConfigError(f"{what}: {path} lists nobody; add a table [clients.NAME] with public_key and role")
    return clients


class ClientsFile:
    """The list of clients as it stands now: read anew whenever the file has changed."""

    def __init__(self, path: Path, what: str) -> None:
        self._path, self._what = path, what
        self._stamp: tuple[int, ...] | None = None
        self._clients = NOBODY
        self.trouble = ""

    @property
    def clients(self) -> Clients:
        """Who is listed; nobody when the list cannot be read or is not of the form."""
        try:
            stamp = self._read_stamp()
            if stamp is None or stamp != self._stamp:
                self._clients, self._stamp, self.trouble = read_clients(self._path, self._what), stamp, ""
        except ConfigError as error:
            self._clients, self._stamp, self.trouble = NOBODY, None, str(error)
        return self._clients

    def _read_stamp(self) -> tuple[int, ...] | None:
        try:
            info = self._path.stat()
        except OSError:
            return None
        return info.st_ino, info.st_size, info.st_mtime_ns, info.st_ctime_ns


def _read(path: Path, what: str, forbidden: int) -> str:
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ConfigError(
            f"{what}: cannot read {path}: {error.strerror}; make keys with ccatp keys generate"
        ) from error
    if mode & forbidden:
        raise ConfigError(f"{what}: {path} is open to others (mode {stat.S_IMODE(mode):04o}); chmod go= {path}")
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f"{what}: {path} is longer than {MAX_FILE_BYTES} bytes; name the right file")
    return data.decode("utf-8", "replace")


def _keys_in(text: str, path: Path, what: str) -> dict[str, str]:
    keys = dict(_KEY_LINE.findall(text))
    for key in keys.values():
        try:
            decode_key(key)
        except BadAccess as error:
            # The text of a key that is not of the form may still be most of a secret: it is not shown.
            raise ConfigError(f"{what}: {path}: {error}") from error
    return keys


def make_key_dir(path: Path) -> None:
    """Make a folder for keys with mode 0700, or check that it is the caller's own and closed to others.

    Raises:
        ConfigError: it cannot be made or is open to others.
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
    """Make a new CURVE pair; returns its two files, the public one first."""
    public, secret = (key.decode() for key in zmq.curve_keypair())
    head = f'# CURVE key {name}, for the observatory channel of ccatp.\nmetadata\n    name = "{name}"\ncurve\n'
    line = f'    public-key = "{public}"\n'
    files = [folder / f"{name}{PUBLIC_SUFFIX}", folder / f"{name}{SECRET_SUFFIX}"]
    _write(files[0], head + line, 0o644, is_replacing)
    _write(files[1], head + line + f'    secret-key = "{secret}"\n', 0o600, is_replacing)
    return files


def write_link_key(folder: Path, name: str, *, is_replacing: bool) -> Path:
    """Make a new key of the robot link, as ``robot.key_file`` wants it; returns its file."""
    path = folder / f"{name}{LINK_SUFFIX}"
    _write(path, secrets.token_hex(LINK_KEY_BYTES) + "\n", 0o600, is_replacing)
    return path


def write_clients(folder: Path, name: str) -> Path:
    """Begin a list of clients, unless there is one already; returns its file."""
    path = folder / f"{name}{CLIENTS_SUFFIX}"
    if not path.exists():
        _write(path, CLIENTS_TEXT, 0o600, is_replacing=False)
    return path


def files_in_the_way(folder: Path, name: str, suffixes: Sequence[str]) -> list[Path]:
    """Those of the files to be made that exist."""
    return [path for suffix in suffixes if (path := folder / f"{name}{suffix}").exists()]


def _write(path: Path, text: str, mode: int, is_replacing: bool) -> None:
    """Write a file that has its mode from the beginning; an existing one is replaced whole, or not at all."""
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
                os.link(new, path)  # unlike a rename, this fails where somebody was quicker
        finally:
            new.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"--dir: cannot write {path}: {error.strerror}") from error
