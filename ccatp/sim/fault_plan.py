"""Plans of faults for the simulated robot and its link: one model per type, and the types that each signal takes.

The plan is TOML and strict: each mistake is one line with file, line, key and a hint. Keys that may be left out are
``None`` then; every other value has to be named, as in a configuration.
"""

import json
import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from pydantic import BaseModel, Field, ValidationError

from ccatp.config.messages import choice_hint, faults_of, format_key, format_value, nearest
from ccatp.config.models import Model, NonNegative, Positive
from ccatp.errors import ConfigError

_SAME_TIME_S = 1e-9  # times of frames and samples are multiples of their periods to within rounding
_SECTIONS = ("fault", "link")
_Model = TypeVar("_Model", bound=BaseModel)

Share = Annotated[float, Field(ge=0.0, le=1.0)]
EveryNth = Annotated[int, Field(ge=1, le=1_000_000)]
EverySecondOrLess = Annotated[int, Field(ge=2, le=1_000_000)]
Direction = Literal["to_client", "to_robot", "both"]
ByteCount = Annotated[int, Field(ge=1, le=65536)]
RaisedName = Literal["imu", "encoder_left", "encoder_right", "edge", "fan_left", "fan_right", "battery_low", "stall"]

# Ranges of random readings: those of common parts (accelerometer 2 g, gyroscope 2000 deg/s), twice the wheels' limit.
_AX_M_S2, _WZ_RAD_S, _WHEEL_RAD_S = 19.6, 34.9, 16.0


class Signal(NamedTuple):
    """Where a signal stands: its rows, its places in a row (the time being place 0), its range."""

    rows: str
    columns: tuple[int, ...]
    low: float
    high: float
    is_binary: bool = False


SIGNALS = {
    "imu_ax": Signal("imu", (1,), -_AX_M_S2, _AX_M_S2),
    "imu_wz": Signal("imu", (2,), -_WZ_RAD_S, _WZ_RAD_S),
    "encoder_right": Signal("enc", (1,), -_WHEEL_RAD_S, _WHEEL_RAD_S),
    "encoder_left": Signal("enc", (2,), -_WHEEL_RAD_S, _WHEEL_RAD_S),
    "edge_front_left": Signal("edge", (1,), 0.0, 1.0, is_binary=True),
    "edge_front_right": Signal("edge", (2,), 0.0, 1.0, is_binary=True),
    "edge_rear_left": Signal("edge", (3,), 0.0, 1.0, is_binary=True),
    "edge_rear_right": Signal("edge", (4,), 0.0, 1.0, is_binary=True),
    "gravity": Signal("gravity", (1, 2, 3), -1.0, 1.0),
    "fans": Signal("fans", (1, 2), 0.0, 1.0),
    "soc": Signal("soc", (1,), 0.0, 1.0),
}
SENSOR_SIGNALS = tuple(SIGNALS)


class InjectedFault(Model):
    """A fault of the simulated robot; ``at_s`` is robot time since the first boot."""

    signal: str
    type: str
    at_s: NonNegative

    @property
    def end_s(self) -> float:
        """When it ends; infinite without ``for_s``."""
        for_s = getattr(self, "for_s", None)
        return float("inf") if for_s is None else self.at_s + for_s

    def is_active(self, t_s: float) -> bool:
        """Whether it acts at a time."""
        return self.has_begun(t_s) and t_s < self.end_s - _SAME_TIME_S

    def has_begun(self, t_s: float) -> bool:
        """Whether a time is at its beginning or after it."""
        return t_s >= self.at_s - _SAME_TIME_S


class LastingFault(InjectedFault):
    """A fault that lasts for ``for_s``, or until the end."""

    for_s: Positive | None = None


class Off(LastingFault):
    """No samples."""


class Stuck(LastingFault):
    """Always the same reading: ``value``, or the last one before."""

    value: float | None = None


class Garbage(LastingFault):
    """Random readings; the share ``beyond`` of them far beyond the signal's range, the others uniform within it."""

    beyond: Share


class Wrong(LastingFault):
    """``sign * factor * reading + offset``."""

    offset: float | None = None
    factor: float | None = None
    sign: Literal[1, -1] | None = None


class Slow(LastingFault):
    """Only every n-th sample."""

    every: EverySecondOrLess


class Delayed(LastingFault):
    """Readings late by ``by_s``: under the sample's time (``fresh``), or arriving late under their own (``old``)."""

    by_s: Positive
    stamps: Literal["fresh", "old"]


class Intermittent(LastingFault):
    """Sound for the first ``duty`` of each period; then no samples, or the reading ``value``."""

    period_s: Positive
    duty: Share
    value: float | None = None


class Saturated(LastingFault):
    """Clamped to ``low`` and ``high``."""

    low: float | None = None
    high: float | None = None


class NonFinite(LastingFault):
    """The number is replaced in the raw line by a token that is no number of JSON."""

    token: Literal["NaN", "Infinity", "1e999"]


class Blocked(LastingFault):
    """The wheel stands still, whatever its servo wants."""


class Runaway(LastingFault):
    """The wheel turns at ``rate_rad_s``, whatever its set point."""

    rate_rad_s: float


class Slip(LastingFault):
    """The body moves by ``factor`` of what the wheels give, of both or of one."""

    factor: Annotated[float, Field(ge=0.0, le=2.0)]


class Weak(LastingFault):
    """The fan gives the share ``share`` of its thrust; its echo does not show it."""

    share: Share


class Kidnap(InjectedFault):
    """The body is put elsewhere, relative to where it stands: deck frame."""

    dx_m: float
    dy_m: float
    dheading_rad: float


class Drift(LastingFault):
    """The body glides downhill while the wheels are held at zero; level ground has no downhill."""

    speed_m_s: Positive


class Jump(LastingFault):
    """All time stamps are off by ``by_s``, which may be negative."""

    by_s: float


class Wrap(LastingFault):
    """All time stamps are counted modulo ``modulo_s``, as by a counter that overflows."""

    modulo_s: Positive


class Drop(LastingFault):
    """Every n-th frame is lost."""

    every: EveryNth


class Duplicate(LastingFault):
    """Every n-th frame is sent twice."""

    every: EveryNth


class Reorder(LastingFault):
    """Every n-th frame is sent after the one that follows it."""

    every: EverySecondOrLess


class Raise(LastingFault):
    """The robot itself reports ``names`` in its frames."""

    names: Annotated[tuple[RaisedName, ...], Field(min_length=1)]


class Reboot(InjectedFault):
    """The robot reboots: boot number, clock, sequence numbers and fans; every session is lost."""


_ON_SENSORS: dict[str, type[InjectedFault]] = {
    "off": Off,
    "stuck": Stuck,
    "garbage": Garbage,
    "wrong": Wrong,
    "slow": Slow,
    "delayed": Delayed,
    "intermittent": Intermittent,
    "saturated": Saturated,
    "non_finite": NonFinite,
}
_ON_WHEELS: dict[str, type[InjectedFault]] = {"blocked": Blocked, "runaway": Runaway, "slip": Slip}
_ON_FANS: dict[str, type[InjectedFault]] = {"weak": Weak}

TYPES: dict[str, dict[str, type[InjectedFault]]] = {
    **dict.fromkeys(SENSOR_SIGNALS, _ON_SENSORS),
    "right_wheel": _ON_WHEELS,
    "left_wheel": _ON_WHEELS,
    "right_fan": _ON_FANS,
    "left_fan": _ON_FANS,
    "body": {"kidnap": Kidnap, "slip": Slip, "drift": Drift},
    "clock": {"jump": Jump, "wrap": Wrap},
    "frames": {"drop": Drop, "duplicate": Duplicate, "reorder": Reorder},
    "faults": {"raise": Raise},
    "robot": {"reboot": Reboot},
}
"""The types that each signal takes."""


class LinkFault(Model):
    """A fault of the link; it begins at a robot time, or once so much has gone to all clients."""

    type: str
    at_s: NonNegative | None = None
    after_lines: Annotated[int, Field(ge=1)] | None = None
    after_bytes: Annotated[int, Field(ge=1)] | None = None


class LastingLinkFault(LinkFault):
    """One that lasts for ``for_s`` of robot time, or until the end, in one direction or both."""

    direction: Direction
    for_s: Positive | None = None


class Reset(LinkFault):
    """Every connection is broken by RST."""


class Close(LinkFault):
    """Every connection is ended by FIN."""


class BlackHole(LastingLinkFault):
    """What is sent disappears, and so does the end of a connection: a half-open connection."""


class Stall(LastingLinkFault):
    """Nothing is passed on; at the end everything at once."""


class Delay(LastingLinkFault):
    """Everything comes ``delay_s`` late, and up to ``jitter_s`` more, drawn for each piece; the order stays."""

    delay_s: NonNegative
    jitter_s: NonNegative


class ReorderLines(LastingLinkFault):
    """Every n-th line is passed on after the one that follows it."""

    every: Annotated[int, Field(ge=2)]


class DuplicateLines(LastingLinkFault):
    """Every n-th line is passed on twice."""

    every: EveryNth


class Fragment(LastingLinkFault):
    """Passed on in writes of so many bytes."""

    write_bytes: ByteCount


class Flood(LastingLinkFault):
    """Further lines at a rate: random ones, or copies of the last line that passed."""

    rate_hz: Positive
    lines: Literal["garbage", "copies"]


class Slowloris(LastingLinkFault):
    """Passed on byte by byte, at a rate."""

    bytes_per_s: Positive


class GarbageBytes(LastingLinkFault):
    """A line of so many random bytes before every n-th line."""

    garbage_bytes: ByteCount
    every: EveryNth


class Corrupt(LastingLinkFault):
    """One byte of every n-th line is another one."""

    every: EveryNth


LINK_TYPES: dict[str, type[LinkFault]] = {
    "reset": Reset,
    "close": Close,
    "black_hole": BlackHole,
    "stall": Stall,
    "delay": Delay,
    "reorder": ReorderLines,
    "duplicate": DuplicateLines,
    "fragment": Fragment,
    "flood": Flood,
    "slowloris": Slowloris,
    "garbage": GarbageBytes,
    "corrupt": Corrupt,
}

LOCKSTEP_TYPES = ("reset", "close", "duplicate", "fragment", "garbage")
"""What makes sense where simulated time waits for every line: the others would only make it wait, some for ever."""


class Injected(NamedTuple):
    """What became of one fault of the plan.

    Attributes:
        at_s: when it was to begin; ``None`` for a fault of the link that waits for something else.
        from_s, until_s: the first and last sample, frame or step that it acted on, robot time; ``None``: none yet.
        changed: how many of them came out different, or not at all.
    """

    signal: str
    type: str
    at_s: float | None
    from_s: float | None
    until_s: float | None
    samples: int
    changed: int


class FaultPlan(NamedTuple):
    """What shall go wrong in a run; the robot's faults in the order of the file, which is that of their application."""

    faults: tuple[InjectedFault, ...] = ()
    link: tuple[LinkFault, ...] = ()


def parse_plan(text: str, name: str) -> FaultPlan:
    """The plan in a text; a ``ConfigError`` has a line per problem with file, line, key, what is wrong, what to do."""
    try:
        tree = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, deep nesting
        raise ConfigError(f"{name}: is not TOML: {error}") from error
    problems = [
        f"{_place(name, text, section, 0, '')}: {section} is unknown; {choice_hint(section, _SECTIONS)}"
        for section in tree
        if section not in _SECTIONS
    ]
    rows, link_rows = (_rows(tree, section, problems, name) for section in _SECTIONS)
    faults = [_Entry(name, text, "fault", k, row, problems).fault() for k, row in enumerate(rows)]
    link = [_Entry(name, text, "link", k, row, problems).link() for k, row in enumerate(link_rows)]
    if problems:
        raise ConfigError(*problems, shows_all=True)
    return FaultPlan(tuple(f for f in faults if f is not None), tuple(f for f in link if f is not None))


def read_plan(file: Path, *, lockstep: bool) -> FaultPlan:
    """The plan in a file; errors as of ``parse_plan`` and ``check_pacing``."""
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{file}: {(error.strerror or str(error)).lower()}; name a TOML file that exists") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: is not UTF-8 text (byte {error.start}); save it as UTF-8") from error
    plan = parse_plan(text, str(file))
    check_pacing(plan, str(file), lockstep=lockstep)
    return plan


def check_pacing(plan: FaultPlan, name: str, *, lockstep: bool) -> None:
    """Refuse faults of the link that make no sense in lockstep, with a ``ConfigError``."""
    if not lockstep:
        return
    problems = [
        f"{name}: link[{k}].type = {format_value(one.type)} makes no sense in lockstep, where simulated time waits for "
        f"every line; add --realtime, or take one of {', '.join(LOCKSTEP_TYPES)}"
        for k, one in enumerate(plan.link)
        if one.type not in LOCKSTEP_TYPES
    ]
    if problems:
        raise ConfigError(*problems, shows_all=True)


@dataclass(frozen=True, slots=True)
class _Entry:
    """One table of the file on its way to a model."""

    name: str
    text: str
    section: str
    index: int
    row: Mapping[str, Any]
    problems: list[str]

    def fault(self) -> InjectedFault | None:
        types = self._choice("signal", TYPES)
        model = self._choice("type", types) if types is not None else None
        fault = self._validated(model) if model is not None else None
        if isinstance(fault, Wrong) and (fault.offset, fault.factor, fault.sign) == (None, None, None):
            self._complain("type", '= "wrong" needs an offset, a factor or a sign')
        if isinstance(fault, Saturated):
            low = -math.inf if fault.low is None else fault.low
            high = math.inf if fault.high is None else fault.high
            if not low < high or (low, high) == (-math.inf, math.inf):
                self._complain("type", '= "saturated" needs low or high, and low below high')
        return fault

    def link(self) -> LinkFault | None:
        model = self._choice("type", LINK_TYPES)
        fault = self._validated(model) if model is not None else None
        if fault is not None and [fault.at_s, fault.after_lines, fault.after_bytes].count(None) != 2:
            self._complain("type", f"= {format_value(fault.type)} needs one of at_s, after_lines, after_bytes")
        return fault

    def _choice(self, key: str, choices: Mapping[str, Any]) -> Any:
        value = self.row.get(key)
        if value is None:
            self._complain(key, f"is missing; {choice_hint('', choices)}")
        elif not isinstance(value, str):
            self._complain(key, f"= {format_value(value)} must be text in quotes")
        elif value not in choices:
            of = f" of {self.row['signal']}" if key == "type" and self.section == "fault" else ""
            self._complain(key, f"= {format_value(value)} is no {key}{of}; {choice_hint(value, choices)}")
        else:
            return choices[value]
        return None

    def _validated(self, model: type[_Model]) -> _Model | None:
        try:
            # by way of JSON, where strict means what it should for TOML: an array is a tuple, "1" is no number
            return model.model_validate_json(json.dumps(self.row, default=str), strict=True)
        except ValidationError as error:
            for one in sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden"):
                key = format_key(tuple(one["loc"]))
                if one["type"] == "extra_forbidden":
                    self._complain(key, _unknown(key, model.model_fields))
                else:
                    self._complain(key, faults_of([one])[0].what)
        return None

    def _complain(self, key: str, what: str) -> None:
        place = _place(self.name, self.text, self.section, self.index, key.split("[", maxsplit=1)[0])
        self.problems.append(f"{place}: {self.section}[{self.index}].{key} {what}")


def _rows(tree: Mapping[str, Any], section: str, problems: list[str], name: str) -> Sequence[Mapping[str, Any]]:
    rows = tree.get(section, [])
    if isinstance(rows, list) and all(isinstance(row, dict) for row in rows):
        return rows
    problems.append(f"{name}: {section} must be a list of tables; begin each with [[{section}]]")
    return []


def _unknown(key: str, fields: Iterable[str]) -> str:
    fields = list(fields)
    near = nearest(key, fields)
    return f"is unknown; did you mean {near}?" if near else f"is unknown; known here: {', '.join(fields)}"


def _place(name: str, text: str, section: str, index: int, key: str) -> str:
    """``file:line`` of a key in the table of that number, or of the table; the bare name where neither is found."""
    header = re.compile(rf"\s*\[\[?\s*{re.escape(section)}\s*\]")
    seen, found = -1, 0
    for number, line in enumerate(text.splitlines(), start=1):
        if header.match(line):
            seen += 1
            if seen > index:
                break
            found = number
        elif seen == index and key and re.match(rf"\s*{re.escape(key)}\s*=", line):
            return f"{name}:{number}"
    return f"{name}:{found}" if seen >= index and found else name
