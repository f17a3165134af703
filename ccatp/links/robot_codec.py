"""Codec of the robot link (interface control document 1): JSON lines between the robot and its clients.

Decoding is strict: numbers must be finite and in range, keys must be unique, booleans are not numbers. Unknown keys are
ignored. A message of an unknown type is not a bad line. Nothing of a bad line is used.
"""

import hashlib
import hmac
import json
import math
import re
from collections import deque
from collections.abc import Sequence
from typing import Any

import msgspec

from ccatp.links.robot_messages import (
    CommandEcho,
    Drive,
    Fans,
    FromClient,
    FromRobot,
    Join,
    Permit,
    RobotLinkMessage,
    Sensors,
    Unknown,
)

_GRAVITY_NORM = (0.5, 1.5)  # a unit vector, however noisy
# A number beyond its range in a sample, as msgspec reports it, and the sample's name in the reason.
_BEYOND_RANGE = re.compile(r"Expected `(?:float|int)` [<>]=.* at `\$\.(imu|enc|edge|gravity)\b")
_SAMPLES = {"imu": "imu sample", "enc": "encoder sample", "edge": "edge sample", "gravity": "gravity"}


class BadLine(ValueError):
    """A line that fails a check.

    Attributes:
        message_type: the ``type`` it claims, where that much could be read.
    """

    def __init__(self, reason: str, message_type: str = "") -> None:
        super().__init__(f"bad line: {reason}")
        self.message_type = message_type


# Number of keys of the messages whose keys are all required. If a line has all of them and exactly this many colons, it
# has no other key and no key twice, because every key has a colon.
_KEYS: dict[type, int] = {Sensors: 15, Drive: 5, Permit: 6, Fans: 3}
_MAX_INTEGER_DIGITS = 400
_NAMES_NOT_FINITE = {"nan": "NaN", "inf": "Infinity", "-inf": "-Infinity"}
_FROM_ROBOT_TYPES = frozenset(("hello", "joined", "refused", "sensors"))
_FROM_CLIENT_TYPES = frozenset(("join", "drive", "permit", "fans"))

_robot_decoder: msgspec.json.Decoder[FromRobot] = msgspec.json.Decoder(FromRobot)
_client_decoder: msgspec.json.Decoder[FromClient] = msgspec.json.Decoder(FromClient)
_encoder = msgspec.json.Encoder()


def decode_from_robot(line: bytes) -> FromRobot | Unknown:
    """The message in a line of the robot (without its LF); ``BadLine``: the line fails a check."""
    try:
        message = _robot_decoder.decode(line)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        beyond = _BEYOND_RANGE.match(str(error))
        reason = f"{_SAMPLES[beyond[1]]} out of range" if beyond else str(error)
        return _unknown_or_bad(line, reason, _FROM_ROBOT_TYPES)
    if line.count(b":") != _KEYS.get(type(message)):
        _check_keys(line)
    if type(message) is Sensors and message.gravity is not None:
        _, gx, gy, gz = message.gravity
        if not _GRAVITY_NORM[0] <= math.hypot(gx, gy, gz) <= _GRAVITY_NORM[1]:
            raise BadLine("gravity out of range", "sensors")
    return message


def decode_from_client(line: bytes) -> FromClient | Unknown:
    """The message in a line of a client (without its LF); errors as of ``decode_from_robot``."""
    try:
        message = _client_decoder.decode(line)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        return _unknown_or_bad(line, str(error), _FROM_CLIENT_TYPES)
    if line.count(b":") != _KEYS.get(type(message)):
        _check_keys(line)
    return message


class RobotFrame(RobotLinkMessage, tag="sensors", omit_defaults=True):
    """A frame as it is encoded: the fields of ``Sensors`` in the same places, samples as plain tuples (finite, SI).

    Named tuples of twenty samples take as long to make as to read, so they are made only where names are needed.
    """

    seq: int
    t: float
    imu: Sequence[tuple[float, float, float]]
    enc: Sequence[tuple[float, float | None, float | None]]
    edge: Sequence[tuple[float, int, int, int, int]]
    gravity: tuple[float, float, float, float] | None
    fans: tuple[float, float]
    soc: float
    cmd: CommandEcho
    faults: Sequence[str]
    sliding: bool = False


def encode(message: FromRobot | FromClient | RobotFrame) -> bytes:
    """The message as one line with its LF; ``ValueError``: a drive that is not finite (JSON has no such number)."""
    if isinstance(message, Drive):
        return format_drive(message.seq, message.ack, message.wr, message.wl, message.steer)
    return _encoder.encode(message) + b"\n"


def format_drive(seq: int, ack: int, wr: float, wl: float, steer: float | None = None) -> bytes:
    """A drive as one line; the key ``steer`` only where there is an angle.

    ``ValueError``: a set point that is not finite.
    """
    if not math.isfinite(wr) or not math.isfinite(wl):
        raise ValueError(f"drive set points must be finite: wr {wr}, wl {wl}")
    if steer is not None:
        if not math.isfinite(steer):
            raise ValueError(f"drive set points must be finite: steer {steer}")
        return b'{"type":"drive","seq":%d,"ack":%d,"wr":%.9g,"wl":%.9g,"steer":%.9g}\n' % (seq, ack, wr, wl, steer)
    return b'{"type":"drive","seq":%d,"ack":%d,"wr":%.9g,"wl":%.9g}\n' % (seq, ack, wr, wl)


def set_point_on_wire(rate_rad_s: float) -> float:
    """What arrives of a set point: the nine digits of ``format_drive``."""
    return float(b"%.9g" % rate_rad_s) if rate_rad_s else rate_rad_s


def format_permit(seq: int, ack: int, forward: bool, reverse: bool, turn: bool) -> bytes:
    """A permit as one line."""
    return b'{"type":"permit","seq":%d,"ack":%d,"forward":%b,"reverse":%b,"turn":%b}\n' % (
        seq,
        ack,
        b"true" if forward else b"false",
        b"true" if reverse else b"false",
        b"true" if turn else b"false",
    )


def join_mac(key: bytes, nonce: str, role: str) -> str:
    """HMAC-SHA256 over nonce, colon and role, as hex digits."""
    return hmac.new(key, f"{nonce}:{role}".encode("ascii"), hashlib.sha256).hexdigest()


def is_mac_right(key: bytes, nonce: str, join: Join) -> bool:
    """Whether the code of a join is that of key, nonce and role; the time does not depend on where it differs."""
    return hmac.compare_digest(join_mac(key, nonce, join.role).encode(), join.mac.lower().encode())


def _unknown_or_bad(line: bytes, reason: str, known: frozenset[str]) -> Unknown:
    """What a line is that the fast decoder refused: a message of an unknown type, or bad."""
    value = _check_keys(line)
    message_type = value.get("type") if isinstance(value, dict) else None
    if not isinstance(message_type, str):
        raise BadLine("no object with a type")
    if message_type in known:
        raise BadLine(reason, message_type)
    return Unknown(message_type)


def _check_keys(line: bytes) -> Any:
    """Check the whole line, with keys that the fast decoder skips: no key twice, every number finite."""
    try:
        value = json.loads(line.decode("utf-8"), object_pairs_hook=_object, parse_int=_integer)
        place = _place_not_finite(value)
    except BadLine:
        raise
    except (ValueError, RecursionError) as error:
        raise BadLine(f"{type(error).__name__}: {str(error)[:80]}") from None
    if place:
        raise BadLine(place)
    return value


def _place_not_finite(value: Any, place: str = "") -> str:
    """Place and text of the first number that is not JSON; empty if there is none."""
    if isinstance(value, float):
        return "" if math.isfinite(value) else f"{place or 'the line'} is {_NAMES_NOT_FINITE[str(value)]}"
    if isinstance(value, dict):
        parts = ((f"{place}.{key}" if place else key, item) for key, item in value.items())
    elif isinstance(value, list):
        parts = ((f"{place}[{k}]", item) for k, item in enumerate(value))
    else:
        return ""
    return next(filter(None, (_place_not_finite(item, name) for name, item in parts)), "")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise BadLine("a key stands twice")
    return found


def _integer(text: str) -> int:
    # As a float it would be infinite. All readers must agree on whether it is a valid number.
    if len(text) > _MAX_INTEGER_DIGITS or not math.isfinite(float(text)):
        raise BadLine("integer of too many digits")
    return int(text)


MAX_LINE_BYTES = 8192


class LineTooLong(ValueError):
    """A line over the limit; its session cannot continue."""


class LineBuffer:
    """Splits a byte stream into lines, whatever the pieces in which it arrives.

    ``limit``: largest number of bytes of a line without its LF. No more than this is kept between two calls.

    Attributes:
        error: set from the first line on, finished or not, that is over the limit.
    """

    def __init__(self, limit: int = MAX_LINE_BYTES) -> None:
        self._limit = limit
        self._rest = b""
        self.error: LineTooLong | None = None

    def feed(self, data: bytes) -> list[bytes]:
        """Whole lines, without their LF, after ``data`` was appended; up to one over the limit: see ``error``."""
        if self._rest:
            data = self._rest + data
        lines = data.split(b"\n")
        self._rest = lines.pop()
        limit = self._limit
        if len(data) > limit:  # else no line in it can be longer
            for k, line in enumerate((*lines, self._rest)):
                if len(line) > limit:
                    self._rest = b""
                    self.error = LineTooLong(f"line of more than {limit} bytes")
                    return lines[:k]
        return lines


class BadLineLimit:
    """Allows a number of lines at once and a rate in the long run; more is a flood."""

    def __init__(self, lines: float, rate_hz: float) -> None:
        self._lines = self._left = lines
        self._rate_hz = rate_hz
        self._then_s = 0.0

    def take(self, lines: int, now_s: float) -> bool:
        """Count lines at ``now_s``; false if they exceed the limit."""
        self._left = min(self._lines, self._left + self._rate_hz * (now_s - self._then_s)) - lines
        self._then_s = now_s
        return self._left >= 0.0


class BadLineCounter:
    """Counts bad lines, and whether there are too many of them in a window of time."""

    def __init__(self, limit: int = 20, window_s: float = 1.0) -> None:
        self._limit, self._window_s = limit, window_s
        self._lines: deque[tuple[float, str]] = deque(maxlen=limit + 1)
        self.total = 0

    @property
    def first_reason(self) -> str:
        """Reason of the oldest bad line that is kept."""
        return self._lines[0][1] if self._lines else ""

    def add(self, now_s: float, reason: str) -> bool:
        """Count one bad line at ``now_s``; true when the session has to be closed."""
        self.total += 1
        self._lines.append((now_s, reason))
        return len(self._lines) > self._limit and now_s - self._lines[0][0] <= self._window_s
