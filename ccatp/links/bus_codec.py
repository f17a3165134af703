"""The frames of the bus between the processes, which a recording has as well: topic, space, JSON."""

from functools import cache
from typing import Any

import msgspec

from ccatp.core import Verdict
from ccatp.links.topics import Message, find_topic

_encode = msgspec.json.Encoder().encode
_decoders: dict[bytes, tuple[str, msgspec.json.Decoder[Any]]] = {}  # of the topics received so far


def _decoder(prefix: bytes) -> tuple[str, msgspec.json.Decoder[Any]] | None:
    """Name and decoder of a topic; ``None``: there is none of that name."""
    topic = find_topic(prefix.decode("ascii", "replace"))
    if topic is not None:
        _decoders[prefix] = topic.name, msgspec.json.Decoder[Any](topic.message)
    return _decoders.get(prefix)


@cache
def prefix_of(name: str) -> bytes:
    """The first bytes of each frame of a topic."""
    if find_topic(name) is None:
        raise KeyError(name)
    return name.encode() + b" "


class BadMessage(Exception):
    """A frame on the bus that is no message of a known topic."""


def pack(name: str, message: Message | Verdict) -> bytes:
    """The frame of a message: topic, space, JSON."""
    return prefix_of(name) + _encode(message)


def unpack(frame: bytes) -> tuple[str, bytes, Message | Verdict]:
    """The topic's name, JSON text and message of a frame; raises ``BadMessage``."""
    prefix, _, body = frame.partition(b" ")
    known = _decoders.get(prefix) or _decoder(prefix)
    if known is None:
        raise BadMessage(f"unknown topic {prefix[:40]!r}")
    name, decoder = known
    try:
        message: Message | Verdict = decoder.decode(body)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadMessage(f"topic {name}: {error}") from error
    return name, body, message
