"""Observatory channel and operator channel: their requests, replies and codec (interface control document 3, 4).

One request is one frame with one JSON object of at most 4096 bytes. Unknown keys are ignored, as on the robot link; a
request that is not of the form gets ``{"ok": false, "error": why}`` and changes nothing.
"""

import json
from enum import StrEnum
from typing import Annotated, Any, NoReturn
from uuid import UUID

import msgspec

from ccatp.core import EmergencyKind

MAX_REQUEST_BYTES = 4096
MAX_NAME_CHARACTERS = 100


class BadRequest(ValueError):
    """A frame that is not a request of its channel; the text is the ``error`` of the reply."""


class EmergencyRequest(msgspec.Struct, frozen=True, tag_field="cmd", tag="emergency"):
    """The observatory reports an emergency; the same id again is harmless."""

    kind: EmergencyKind
    id: str
    note: str = ""

    def __post_init__(self) -> None:
        uuid_of(self.id)


class ClearRequest(msgspec.Struct, frozen=True, tag_field="cmd", tag="clear"):
    """The observatory says that the cause of an emergency is gone."""

    id: str

    def __post_init__(self) -> None:
        uuid_of(self.id)


class PingRequest(msgspec.Struct, frozen=True, tag_field="cmd", tag="ping"):
    """Request of the event code."""


ObservatoryRequest = EmergencyRequest | ClearRequest | PingRequest


class OperatorCommand(StrEnum):
    """Commands of the operator channel."""

    STATUS = "status"
    PAUSE = "pause"
    RESUME = "resume"
    ABORT = "abort"
    STOP = "stop"
    ACKNOWLEDGE = "acknowledge"


class OperatorRequest(msgspec.Struct, frozen=True):
    """A request of the operator channel.

    ``name``: the alarm to acknowledge. ``by``: who asks, for the log: a user of this machine, or a token's name.
    """

    cmd: OperatorCommand
    name: Annotated[str, msgspec.Meta(max_length=MAX_NAME_CHARACTERS)] = ""
    by: Annotated[str, msgspec.Meta(max_length=MAX_NAME_CHARACTERS)] = ""


def parse_observatory(frame: bytes) -> ObservatoryRequest:
    """The request in a frame of the observatory channel.

    ``BadRequest``: too long, not JSON, not an object, or not of the form.
    """
    try:
        return msgspec.convert(_parse_request(frame), ObservatoryRequest)  # type: ignore[no-any-return]
    except (msgspec.ValidationError, UnicodeError) as error:  # JSON may hold half a surrogate pair
        raise BadRequest(str(error)) from error


def parse_operator(frame: bytes) -> OperatorRequest:
    """The request in a frame of the operator channel; errors as of ``parse_observatory``."""
    fields = _parse_request(frame)
    command = str(fields.get("cmd"))
    if command not in set(OperatorCommand):
        raise BadRequest(f"cmd: {command!a} is none of {', '.join(OperatorCommand)}")
    try:
        return msgspec.convert(fields, OperatorRequest)
    except (msgspec.ValidationError, UnicodeError) as error:
        raise BadRequest(str(error)) from error


def format_request(cmd: str, **fields: object) -> bytes:
    """A request of either channel as it goes over the wire."""
    return msgspec.json.encode({"cmd": cmd, **fields})


def format_ok(**fields: object) -> bytes:
    """``{"ok": true, ...}``."""
    return msgspec.json.encode({"ok": True, **fields})


def format_error(error: str, **fields: object) -> bytes:
    """``{"ok": false, ..., "error": why}``."""
    return msgspec.json.encode({"ok": False, **fields, "error": error})


def parse_reply(frame: bytes) -> dict[str, Any]:
    """The object in a reply; ``BadRequest``: not a JSON object with a boolean ``ok``."""
    reply = parse_object(frame)
    if not isinstance(reply.get("ok"), bool):
        raise BadRequest('a reply without "ok"')
    return reply


def uuid_of(text: str) -> str:
    """The canonical form of a UUID; the reply contains the id as it was sent."""
    return str(UUID(text))


def _parse_request(frame: bytes) -> dict[str, Any]:
    if len(frame) > MAX_REQUEST_BYTES:
        raise BadRequest(f"request of {len(frame)} bytes; at most {MAX_REQUEST_BYTES}")
    return parse_object(frame)


def parse_object(frame: bytes) -> dict[str, Any]:
    """The JSON object in a text, without duplicate keys; ``BadRequest``: the text is none."""
    try:
        value = json.loads(frame.decode(), object_pairs_hook=_without_duplicates, parse_constant=_refuse_constant)
    except BadRequest:
        raise
    except (ValueError, RecursionError) as error:
        raise BadRequest("not UTF-8 JSON") from error
    if not isinstance(value, dict):
        raise BadRequest("not a JSON object")
    return value


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(value := dict(pairs)) != len(pairs):
        raise BadRequest("a key stands twice")
    return value


def _refuse_constant(text: str) -> NoReturn:
    raise BadRequest(f"{text} is no number")
