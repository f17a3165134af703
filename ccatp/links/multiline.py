"""Codec of the MultiLine online interface, both sides: requests, replies, channel records.

ASCII, one request or reply a line, closed by CR LF; a bare LF is taken too. ``_`` separates the name of a reply, its
records and its server error, ``,`` separates fields. Lengths are millimetres on the wire and in ``ChannelRecord``;
``valid_lengths`` gives metres.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

MAX_LINE_BYTES = 65536
CHANNEL_NUMBERS = range(1, 33)  # the vendor's instrument has up to 32 channels
EOL = b"\r\n"


class BadMultilineRequest(ValueError):
    """A line that is not a request; ``reason`` is sent in the error reply."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"not a MultiLine request: {reason}")
        self.reason = reason


class BadReply(ValueError):
    """A line that is not a reply."""


class Command(StrEnum):
    """The requests."""

    IS_CONNECTED = "isconnected"
    LASER_READY = "laserready"
    ENVIRONMENT_DATA = "environmentdata"
    LATEST_LENGTH_VALID = "latestlengthvalid"
    START_MEASUREMENT = "startmeasnogui"
    STOP_MEASUREMENT = "stopmeasnogui"


class MultilineRequest(NamedTuple):
    """One request; ``channels`` only with ``LATEST_LENGTH_VALID``."""

    command: Command
    channels: tuple[int, ...] = ()


class ChannelRecord(NamedTuple):
    """One channel of a ``channeldata`` reply, in the order of the wire. The last ten fields are error flags."""

    channel: int
    length_mm: float
    intensity_min: int
    intensity_max: int
    temperature_c: float
    pressure_hpa: float
    humidity_pct: float
    analysis_error: int = 0
    beam_break: int = 0
    temp_error: int = 0
    motion_tolerance_error: int = 0
    intensity_error: int = 0
    usb_error: int = 0
    dll_error: int = 0
    laser_speed_error: int = 0
    laser_temp_error: int = 0
    daq_error: int = 0

    @property
    def errors(self) -> tuple[str, ...]:
        """Names of the flags that are not zero."""
        values = self[_FIRST_FLAG:]
        return tuple(name for name, value in zip(FLAGS, values, strict=True) if value) if any(values) else ()


_FIRST_FLAG = 7
FLAGS: tuple[str, ...] = ChannelRecord._fields[_FIRST_FLAG:]


@dataclass(frozen=True, slots=True)
class Connected:
    """Reply to ``isconnected``: the lasers are connected."""

    value: bool


@dataclass(frozen=True, slots=True)
class LaserReady:
    """Reply to ``laserready``: the lasers are warm."""

    value: bool


@dataclass(frozen=True, slots=True)
class Environment:
    """Reply to ``environmentdata``."""

    temperature_c: float
    pressure_hpa: float
    humidity_pct: float


@dataclass(frozen=True, slots=True)
class ChannelData:
    """Reply to ``latestlengthvalid`` and line of the push stream. ``server_error`` 0 = no error."""

    records: tuple[ChannelRecord, ...]
    server_error: int = 0


@dataclass(frozen=True, slots=True)
class Remark:
    """A reply kept as text: ``defanadata`` (the vendor's own analysis, within a stream) or ``error``.

    ``error_<reason>`` is how the simulated server answers a line that is no request: the grammar's source is silent.
    """

    name: str
    text: str


class Notice(StrEnum):
    """Replies that are one word."""

    STARTED = "measstarted"
    STOPPED = "measstopped"
    FINISHED = "measurementfinished"


Reply = Connected | LaserReady | Environment | ChannelData | Remark | Notice


def format_request(request: MultilineRequest) -> bytes:
    """The request as it goes over the wire."""
    return ",".join((request.command, *map(str, request.channels))).encode("ascii") + EOL


def parse_request(line: bytes) -> MultilineRequest:
    """Read one line of a client.

    ``BadMultilineRequest``: unknown name, arguments where none belong, or channels that are not 1 to 32, each once.
    """
    name, *arguments = line.decode("ascii", "replace").split(",")
    try:
        command = Command(name)
    except ValueError:
        raise BadMultilineRequest("unknown-request") from None
    if bool(arguments) != (command is Command.LATEST_LENGTH_VALID):
        raise BadMultilineRequest("bad-arguments")
    channels = tuple(int(text) for text in arguments if text.isascii() and text.isdigit() and len(text) <= 2)
    if len(set(channels) & set(CHANNEL_NUMBERS)) != len(arguments):
        raise BadMultilineRequest("bad-channel")
    return MultilineRequest(command, channels)


def format_reply(reply: Reply) -> bytes:
    """The reply as it goes over the wire."""
    match reply:
        case Connected(value) | LaserReady(value):
            text = f"{'isconnected' if isinstance(reply, Connected) else 'laserready'}_{value:d}"
        case Environment(temperature_c, pressure_hpa, humidity_pct):
            text = f"environmentdata_{temperature_c!r},{pressure_hpa!r},{humidity_pct!r}"
        case ChannelData(records, server_error):
            text = "_".join(("channeldata", *(",".join(map(repr, record)) for record in records), str(server_error)))
        case Remark(name, payload):
            text = f"{name}_{payload}"
        case _:
            text = reply.value
    return text.encode("ascii") + EOL


def parse_reply(line: bytes) -> Reply:
    """Read one line of a server, without its CR LF; ``BadReply`` for anything that the grammar does not allow."""
    text = line.decode("ascii", "replace")
    name, separator, payload = text.partition("_")
    try:
        return _PARSERS[name](payload) if separator and name in _PARSERS else Notice(text)
    except ValueError as error:
        raise BadReply(f"bad reply {text[:60]!r}: {error!s:.80}") from None


def _parse_channel_data(payload: str) -> ChannelData:
    *records, server_error = payload.split("_")
    parsed = tuple(map(_parse_record, records))
    if len({record.channel for record in parsed}) != len(parsed):
        raise ValueError("a channel stands twice")
    return ChannelData(parsed, _integer(server_error))


def _parse_record(text: str) -> ChannelRecord:
    fields = text.split(",")
    if len(fields) != len(ChannelRecord._fields):
        raise ValueError(f"record of {len(fields)} fields")
    channel = _integer(fields[0])
    if channel not in CHANNEL_NUMBERS:
        raise ValueError(f"channel {channel}")
    # Lengths and air that are not finite concern their channel only (valid_lengths): they may pass here.
    length_mm, temperature_c, pressure_hpa, humidity_pct = map(float, (fields[1], *fields[4:_FIRST_FLAG]))
    low, high, *flags = map(_integer, (*fields[2:4], *fields[_FIRST_FLAG:]))
    return ChannelRecord(channel, length_mm, low, high, temperature_c, pressure_hpa, humidity_pct, *flags)


def _bit(text: str) -> bool:
    return bool(("0", "1").index(text))


def _integer(text: str) -> int:
    # int() alone would also take blanks and thousands of digits.
    digits = text[1:] if text[:1] in ("-", "+") else text
    if digits.isdigit() and digits.isascii() and len(digits) <= 18:
        return int(text)
    raise ValueError(f"{text[:20]!r} is no integer")


def _parse_environment(payload: str) -> Environment:
    numbers = tuple(map(float, payload.split(",")))
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise ValueError("not three finite fields")
    return Environment(*numbers)


_PARSERS: dict[str, Callable[[str], Reply]] = {
    "channeldata": _parse_channel_data,
    "isconnected": lambda payload: Connected(_bit(payload)),
    "laserready": lambda payload: LaserReady(_bit(payload)),
    "environmentdata": _parse_environment,
    "defanadata": lambda payload: Remark("defanadata", payload),
    "error": lambda payload: Remark("error", payload),
}


_MAX_LENGTH_M = 1e6  # of a length in any unit that may have been confused; far from overflow in its square


def valid_lengths(data: ChannelData, channels: Sequence[int]) -> tuple[dict[int, float], dict[int, str]]:
    """Length in m by asked channel, and for those without a usable one the reason; both in the order asked.

    Any flag that is not zero makes a length invalid. Records of channels that were not asked for are passed over.
    """
    by_channel = {record.channel: record for record in data.records}
    lengths_m: dict[int, float] = {}
    reasons: dict[int, str] = {}
    for channel in channels:
        record = by_channel.get(channel)
        if record is None:
            reasons[channel] = "absent"
        elif record.errors:
            reasons[channel] = "+".join(record.errors)
        elif not 0.0 < record.length_mm * 1e-3 <= _MAX_LENGTH_M:  # the smallest numbers become zero
            reasons[channel] = f"length {record.length_mm} mm"
        else:
            lengths_m[channel] = record.length_mm * 1e-3
    return lengths_m, reasons
