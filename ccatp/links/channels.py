"""Observatory channel and operator channel: their requests, replies and codec (interface control document 3, 4).

One request is one frame with one JSON object of at most 4096 bytes. Unknown keys are ignored, as on the robot link; a
request that is not of the form gets ``{"ok": false, "error": why}`` and changes nothing.
"""

import json
from enum import StrEnum
from typing import Annotated, Any, Literal, NoReturn, Protocol, TypeVar
from uuid import UUID

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from ccatp.core import EmergencyKind, EventCode

T = TypeVar("T")

MAX_REQUEST_BYTES = 4096
MAX_NOTE_CHARACTERS = 2000


class BadRequest(ValueError):
    """A frame that is no request of its channel; the text is the reply's ``error``."""


def _check_uuid(text: str) -> str:
    UUID(text)  # raises ValueError; the id itself is answered as it was sent
    return text


class _Request(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)


class EmergencyRequest(_Request):
    """The observatory reports an emergency; the same id again is harmless."""

    cmd: Literal["emergency"]
    kind: Annotated[EmergencyKind, Field(strict=False)]
    id: Annotated[str, AfterValidator(_check_uuid)]
    note: Annotated[str, Field(max_length=MAX_NOTE_CHARACTERS)] = ""


class ClearRequest(_Request):
    """The observatory says that the cause of an emergency is gone."""

    cmd: Literal["clear"]
    id: Annotated[str, AfterValidator(_check_uuid)]


class PingRequest(_Request):
    """Request of the event code."""

    cmd: Literal["ping"]


ObservatoryRequest = EmergencyRequest | ClearRequest | PingRequest


class OperatorCommand(StrEnum):
    """Commands of the operator channel."""

    STATUS = "status"
    PAUSE = "pause"
    RESUME = "resume"
    ABORT = "abort"
    STOP = "stop"


class OperatorRequest(_Request):
    """One command of an operator."""

    cmd: Annotated[OperatorCommand, Field(strict=False)]


_observatory: TypeAdapter[ObservatoryRequest] = TypeAdapter(Annotated[ObservatoryRequest, Field(discriminator="cmd")])
_operator: TypeAdapter[OperatorRequest] = TypeAdapter(OperatorRequest)


def parse_observatory(frame: bytes) -> ObservatoryRequest:
    """The request in a frame of the observatory channel.

    ``BadRequest``: too long, not JSON, not an object, or not of the form.
    """
    return _validated(_observatory, _parse_object(frame))


def parse_operator(frame: bytes) -> OperatorRequest:
    """The request in a frame of the operator channel; errors as of ``parse_observatory``."""
    return _validated(_operator, _parse_object(frame))


def format_request(cmd: str, **fields: object) -> bytes:
    """A request of either channel as it goes over the wire."""
    return _dump({"cmd": cmd, **fields})


def format_ok(**fields: object) -> bytes:
    """``{"ok": true, ...}``."""
    return _dump({"ok": True, **fields})


def format_error(error: str, **fields: object) -> bytes:
    """``{"ok": false, ..., "error": why}``."""
    return _dump({"ok": False, **fields, "error": error})


def parse_reply(frame: bytes) -> dict[str, Any]:
    """The object in a reply; ``BadRequest``: not a JSON object with a boolean ``ok``."""
    reply = _object_in(frame)
    if not isinstance(reply.get("ok"), bool):
        raise BadRequest('a reply without "ok"')
    return reply


class EmergencyHandler(Protocol):
    """What answers the observatory; ``ccatp.danger.DangerMonitor`` is one."""

    @property
    def code(self) -> EventCode:
        """The event code now."""

    def emergency(self, kind: str, emergency_id: str, note: str = "") -> str | None:
        """Latch; returns why it was refused, or None."""

    def holds(self, emergency_id: str) -> bool:
        """Whether the emergency with that id is latched."""

    def clear(self, emergency_id: str, at_base_or_held: bool) -> str | None:
        """Clear; returns why it was refused, or None."""


def answer_observatory(
    frame: bytes, handler: EmergencyHandler, *, at_base_or_held: bool, age_s: float | None, may_clear: bool = True
) -> bytes:
    """The reply to one request of the observatory channel; ``age_s`` of the last verdict, ``None`` before the first."""
    try:
        request = parse_observatory(frame)
    except BadRequest as error:
        return format_error(str(error))
    if isinstance(request, PingRequest):
        return format_ok(code=int(handler.code), age_s=age_s)
    key = str(UUID(request.id))  # one of many ways to write it
    if isinstance(request, EmergencyRequest):
        refusal = handler.emergency(request.kind.value, key, request.note)
        # An edge may hide the abort's code until the robot is off it; the answer is about the latch. What was cleared
        # before is not latched again: whoever means another emergency has to know.
        is_held = handler.holds(key)
        accepted = format_ok(id=request.id, latched=is_held, code=int(EventCode.ABORTED if is_held else handler.code))
    elif not may_clear:
        refusal, accepted = "this client may raise emergencies, not clear them", b""
    else:
        refusal = handler.clear(key, at_base_or_held)
        accepted = format_ok(id=request.id, code=int(handler.code))
    return accepted if refusal is None else format_error(refusal, id=request.id)


def _dump(value: dict[str, object]) -> bytes:
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()


def _parse_object(frame: bytes) -> dict[str, Any]:
    if len(frame) > MAX_REQUEST_BYTES:
        raise BadRequest(f"request of {len(frame)} bytes; at most {MAX_REQUEST_BYTES}")
    return _object_in(frame)


def _object_in(frame: bytes) -> dict[str, Any]:
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


def _validated(adapter: TypeAdapter[T], value: dict[str, Any]) -> T:
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"] if part not in ("emergency", "clear", "ping"))
        message = first["msg"]
        raise BadRequest(f"{where}: {message}" if where else message) from error
