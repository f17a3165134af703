"""Pure. Who may use the observatory channel over TCP: the list of clients, and the answers of ZAP (ZeroMQ RFC 27).

The list is TOML, a table for each client::

    [clients.observatory]
    public_key = "<40 characters, Z85>"
    role = "clear"

``raise`` may report emergencies and ask how things are; ``clear`` may end emergencies, too.
"""

import string
import tomllib
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

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


class Client(NamedTuple):
    """One line of the list."""

    name: str
    role: Role


Clients = Mapping[bytes, Client]
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
    clients: dict[bytes, Client] = {}
    for name, table in tables.items():
        key, client = _parse_client(name, table)
        if key in clients:
            raise BadAccess(f"{clients[key].name} and {name} have the same key")
        clients[key] = client
    return clients


def _parse_client(name: str, table: Any) -> tuple[bytes, Client]:
    if not isinstance(table, dict) or table.keys() != {"public_key", "role"}:
        raise BadAccess(f"clients.{name} must have public_key and role, nothing else")
    if table["role"] not in Role.__members__.values():
        raise BadAccess(f"clients.{name}.role = {table['role']!r} must be raise or clear")
    try:
        key = decode_key(str(table["public_key"]))
    except BadAccess as error:
        raise BadAccess(f"clients.{name}.public_key: {error}") from error
    return key, Client(name, Role(table["role"]))


class Admission(NamedTuple):
    """The answer to one ZAP request, and what the log should say where it is a refusal (empty where it is none)."""

    reply: list[bytes]
    refusal: str


def answer_zap(frames: Sequence[bytes], domain: str, clients: Clients) -> Admission:
    """Admit the listed clients of one domain, and nobody else.

    Args:
        frames: the request.
        domain: what is guarded.
        clients: who is listed.

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
