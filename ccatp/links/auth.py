"""Keys of the observatory channel and of the robot link, and the clients that may use the channel over TCP.

A CURVE pair is two files in the format of ``zmq.auth``: ``NAME.key`` for others, ``NAME.key_secret`` with both halves.
A secret file that others may read is refused. The list of clients is TOML, a table for each client::

    [clients.observatory]
    public_key = "<40 characters, Z85>"
    role = "clear"

``raise`` may report emergencies and ask for the event code; ``clear`` may also end emergencies.
"""

import secrets
import stat
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import zmq
from pydantic import Field
from zmq.auth import load_certificate
from zmq.utils import z85

from ccatp.config.files import FOR_OTHERS, read_private, write_file
from ccatp.config.load import read_source, validated
from ccatp.config.messages import ConfigProblem
from ccatp.config.models import Model
from ccatp.errors import ConfigError

KEY_CHARACTERS = 40
PUBLIC_SUFFIX, SECRET_SUFFIX, LINK_SUFFIX, CLIENTS_SUFFIX = ".key", ".key_secret", "-robot.key_secret", "-clients.toml"
LINK_KEY_BYTES = 32
CLIENTS_TEXT = """\
# Who may use the observatory channel over TCP; all others are refused. Read again when it changes.
# role: raise = may report emergencies; clear = may also end them. Public keys: ccatp keys show-public.
#
# [clients.observatory]
# public_key = "..."
# role = "clear"
"""
ClientRole = Literal["raise", "clear"]


class AuthorizedClient(NamedTuple):
    """A client and what it may do."""

    name: str
    role: ClientRole


Clients = Mapping[str, AuthorizedClient]
"""Clients by their public key, 40 characters of Z85."""


class ClientEntry(Model):
    """A table of the list of clients."""

    public_key: str
    role: ClientRole


class ClientList(Model):
    """The list of clients, which may be empty."""

    clients: Annotated[dict[str, ClientEntry], Field(default_factory=dict)]


class KeyPair(NamedTuple):
    """A CURVE pair, each half as 40 characters of Z85. Never print or log one."""

    public: bytes
    secret: bytes

    def __repr__(self) -> str:
        """Without the secret."""
        return f"KeyPair(public={self.public!r})"


def check_key(text: str | bytes) -> str:
    """Why a text is not a CURVE key (32 bytes in Z85, ZeroMQ RFC 32), or empty. Does not quote it: it may be secret."""
    try:
        if len(text) == KEY_CHARACTERS:
            z85.decode(text)
            return ""
    except struct.error:
        return "is a key whose characters stand for more than 32 bytes; copy it once more"
    except (KeyError, ValueError):  # a character that is not in the alphabet
        pass
    return f"is no key: a key has {KEY_CHARACTERS} characters of Z85, this one {len(text)}"


def _check_clients(listed: ClientList) -> Iterator[ConfigProblem]:
    names: dict[str, str] = {}
    for name, entry in listed.clients.items():
        why = check_key(entry.public_key)
        if (other := names.setdefault(entry.public_key, name)) != name:
            why = f"is that of {other}, too; each client has a key of its own"
        if why:
            yield ConfigProblem(("clients", name, "public_key"), why)


def read_clients(path: Path, what: str) -> Clients:
    """The clients in a file; ``what`` is the option or the key that names it, for the error.

    ``ConfigError``: the file cannot be read, others may write it, it is malformed, or it lists no client.
    """
    read_private(path, what, stat.S_IWGRP | stat.S_IWOTH)
    try:
        source = read_source(path)
        listed = validated(ClientList, source.tree, [source], _check_clients).clients
    except ConfigError as error:
        raise ConfigError(f"{what}: {error.problems[0]}") from error
    if not listed:
        raise ConfigError(f"{what}: {path} lists no client; add a table [clients.NAME] with public_key and role")
    return {entry.public_key: AuthorizedClient(name, entry.role) for name, entry in listed.items()}


class ClientsFile:
    """A list of clients that is read again whenever its file has changed."""

    def __init__(self, path: Path, what: str) -> None:
        self._path, self._what = path, what
        self._stamp: tuple[int, ...] | None = None
        self._clients: Clients = {}
        self.trouble = ""

    @property
    def clients(self) -> Clients:
        """The clients listed now; none if the list cannot be read or is malformed (``trouble`` says why)."""
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


def read_pair(path: Path, what: str) -> KeyPair:
    """The pair in a secret file.

    ``ConfigError``: the file cannot be read, is open to others, or holds no pair.
    """
    public, secret = _load(path, what, FOR_OTHERS, SECRET_SUFFIX)
    if secret is None:
        raise ConfigError(f"{what}: {path} holds no secret key; name the file that ends in {SECRET_SUFFIX}")
    if zmq.curve_public(secret) != public:
        raise ConfigError(f"{what}: {path}: public and secret key are no pair; make a new one with ccatp keys generate")
    return KeyPair(public, secret)


def read_public(path: Path, what: str) -> bytes:
    """The public key in a file, secret or not; ``ConfigError``: it cannot be read, or holds no valid key."""
    return _load(path, what, 0, PUBLIC_SUFFIX)[0]


def _load(path: Path, what: str, forbidden: int, suffix: str) -> tuple[bytes, bytes | None]:
    read_private(path, what, forbidden)
    try:
        public, secret = load_certificate(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{what}: {path} holds no public key; name the file that ends in {suffix}") from error
    if why := check_key(public) or check_key(secret or public):
        raise ConfigError(f"{what}: {path} {why}")
    return public, secret


def write_pair(folder: Path, name: str, *, is_replacing: bool) -> list[Path]:
    """Write a new CURVE pair; returns its two files, the public one first."""
    public, secret = (key.decode() for key in zmq.curve_keypair())
    head = f'# CURVE key {name}, for the observatory channel of ccatp.\nmetadata\n    name = "{name}"\ncurve\n'
    line = f'    public-key = "{public}"\n'
    files = [folder / f"{name}{PUBLIC_SUFFIX}", folder / f"{name}{SECRET_SUFFIX}"]
    write_file(files[0], head + line, 0o644, is_replacing=is_replacing)
    write_file(files[1], head + line + f'    secret-key = "{secret}"\n', 0o600, is_replacing=is_replacing)
    return files


def write_link_key(folder: Path, name: str, *, is_replacing: bool) -> Path:
    """Write a new key of the robot link (``robot.key_file``); returns its file."""
    path = folder / f"{name}{LINK_SUFFIX}"
    write_file(path, secrets.token_hex(LINK_KEY_BYTES) + "\n", 0o600, is_replacing=is_replacing)
    return path


def write_clients(folder: Path, name: str) -> Path:
    """Write a list without clients, unless the file exists; returns its file."""
    path = folder / f"{name}{CLIENTS_SUFFIX}"
    if not path.exists():
        write_file(path, CLIENTS_TEXT, 0o600, is_replacing=False)
    return path
