"""Plans of faults for the simulated robot and its link: one model per type, and the types that each signal takes.

The plan is TOML and strict: each mistake gives one line with file, line, key and a hint. Optional keys are ``None`` by
default; all others are required, as in a configuration.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar

from pydantic import ConfigDict, Field, ValidationError, create_model

from ccatp.config.files import read_toml
from ccatp.config.messages import choice_hint, faults_of, find_line, format_key, format_value, nearest, parse_toml
from ccatp.config.models import Model, NonNegative, Positive
from ccatp.errors import ConfigError

_SAME_TIME_S = 1e-9  # times of frames and samples are multiples of their periods to within rounding
_SECTIONS = ("fault", "link")

# Ranges of random readings: those of common parts (accelerometer 2 g, gyroscope 2000 deg/s), twice the wheels' limit.
_AX_M_S2, _WZ_RAD_S, _WHEEL_RAD_S = 19.6, 34.9, 16.0


class Signal(NamedTuple):
    """Position of a signal in a frame: its list of rows, its columns in a row (column 0 is the time), its range."""

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
SENSOR_CLOCKS = {"imu_clock": "imu", "encoder_clock": "enc", "edge_clock": "edge", "gravity_clock": "gravity"}
"""List of rows in a frame, by the signal of its time stamps."""


class InjectedFault(Model):
    """A fault of the simulated robot; ``at_s`` is robot time since the first boot."""

    model_config = ConfigDict(defer_build=True)  # most runs have no plan, and each start imports this

    signal: str
    type: str
    at_s: NonNegative

    @property
    def end_s(self) -> float:
        """End time; infinite without ``for_s``."""
        for_s = getattr(self, "for_s", None)
        return math.inf if for_s is None else self.at_s + for_s

    def is_active(self, t_s: float) -> bool:
        """Whether the fault is active at ``t_s``."""
        return self.has_begun(t_s) and t_s < self.end_s - _SAME_TIME_S

    def has_begun(self, t_s: float) -> bool:
        """Whether ``t_s`` is at or after ``at_s``."""
        return t_s >= self.at_s - _SAME_TIME_S


class LastingFault(InjectedFault):
    """A fault that lasts for ``for_s``, or until the end."""

    for_s: Positive | None = None


class LinkFault(Model):
    """A fault of the link; it begins at a robot time, or after a number of lines or bytes to all clients together."""

    signal: ClassVar[str] = "link"
    type: str
    at_s: NonNegative | None = None
    after_lines: Annotated[int, Field(ge=1)] | None = None
    after_bytes: Annotated[int, Field(ge=1)] | None = None


Direction = Literal["to_client", "to_robot", "both"]


class LastingLinkFault(LinkFault):
    """A fault that lasts for ``for_s`` of robot time, or until the end, in one direction or both."""

    direction: Direction
    for_s: Positive | None = None


_Fault = TypeVar("_Fault", InjectedFault, LinkFault)


def _types(base: type[_Fault], table: Mapping[str, Mapping[str, Any]]) -> dict[str, type[_Fault]]:
    """A model for each type of fault; its further keys are required unless they have a default."""
    models = {}
    for name, keys in table.items():
        fields: dict[str, Any] = {key: kind if isinstance(kind, tuple) else (kind, ...) for key, kind in keys.items()}
        models[name] = create_model(name, __base__=base, **fields)
    return models


_Share = Annotated[float, Field(ge=0.0, le=1.0)]
_Nth = Annotated[int, Field(ge=1, le=1_000_000)]
_SecondOrLater = Annotated[int, Field(ge=2, le=1_000_000)]
_ByteCount = Annotated[int, Field(ge=1, le=65536)]
_NUMBER = (float | None, None)
_CHANNEL = (Annotated[int, Field(ge=1, le=32)] | None, None)
_RaisedName = Literal["imu", "encoder_left", "encoder_right", "edge", "fan_left", "fan_right", "battery_low", "stall"]

_SLIP = {"factor": Annotated[float, Field(ge=0.0, le=2.0)]}
_ON_SENSORS = _types(
    LastingFault,
    {
        # No samples.
        "off": {},
        # Always the same reading: ``value``, or the last one before the fault.
        "stuck": {"value": _NUMBER},
        # Random readings: a share ``beyond`` is far beyond the signal's range, the others are uniform within it.
        "garbage": {"beyond": _Share},
        # ``sign * factor * reading + offset``
        "wrong": {"offset": _NUMBER, "factor": _NUMBER, "sign": (Literal[1, -1] | None, None)},
        # Only every n-th sample.
        "slow": {"every": _SecondOrLater},
        # Late by ``by_s``: each sample has the reading of ``by_s`` ago (``fresh``), or arrives late with its own time
        # stamp (``old``).
        "delayed": {"by_s": Positive, "stamps": Literal["fresh", "old"]},
        # Normal for the share ``duty`` of each period; then no samples, or the reading ``value``.
        "intermittent": {"period_s": Positive, "duty": _Share, "value": _NUMBER},
        # Clamped to ``low`` and ``high``.
        "saturated": {"low": _NUMBER, "high": _NUMBER},
        # The number is replaced in the raw line by a token that is not a finite number of JSON.
        "non_finite": {"token": Literal["NaN", "Infinity", "1e999"]},
    },
)
# The wheel stands still or turns at ``rate_rad_s``, independent of its set point, or turns at ``factor`` times that;
# slip: the travel that one wheel (or both) gives the body is multiplied by ``factor``.
_ON_WHEELS = _types(
    LastingFault,
    {"blocked": {}, "runaway": {"rate_rad_s": float}, "gain": {"factor": NonNegative}, "slip": _SLIP},
)
# The thrust of the fan is multiplied by ``share``; the duties in the frame do not show it.
_ON_FANS = _types(LastingFault, {"weak": {"share": _Share}})

TYPES: dict[str, dict[str, type[InjectedFault]]] = {
    **dict.fromkeys(SENSOR_SIGNALS, _ON_SENSORS),
    **dict.fromkeys(("right_wheel", "left_wheel"), _ON_WHEELS),
    **dict.fromkeys(("right_fan", "left_fan"), _ON_FANS),
    # The body is moved by an offset, deck frame; or it slides downhill while the set points of the wheels are zero, not
    # on level ground.
    "body": _types(InjectedFault, {"kidnap": {"dx_m": float, "dy_m": float, "dheading_rad": float}})
    | _types(LastingFault, {"slip": _SLIP, "drift": {"speed_m_s": Positive}}),
    # The time stamps of one sensor have an error of ``by_s``, which may be negative.
    **dict.fromkeys(SENSOR_CLOCKS, _types(LastingFault, {"jump": {"by_s": float}})),
    # All time stamps have such an error, or are modulo ``modulo_s``, as of a counter that overflows.
    "clock": _types(LastingFault, {"jump": {"by_s": float}, "wrap": {"modulo_s": Positive}}),
    # Every n-th frame is lost, sent twice, or sent after the one that follows it.
    "frames": _types(
        LastingFault, {"drop": {"every": _Nth}, "duplicate": {"every": _Nth}, "reorder": {"every": _SecondOrLater}}
    ),
    # The robot itself reports ``names`` in its frames.
    "faults": _types(LastingFault, {"raise": {"names": Annotated[tuple[_RaisedName, ...], Field(min_length=1)]}}),
    # The simulated laser system. Errors of one channel, or of all without ``channel``: ``offset_m``, ``rate_m_s`` times
    # the time since the begin, in proportion, rounded, the last length again, or ``factor`` times the noise.
    # ``scale_drift``: in proportion to the length and the time. ``moved``: its collimator, world frame.
    # ``at_rest``: it stays at the puck's place of the begin, with new noise.
    "laser": _types(
        LastingFault,
        {
            "offset": {"channel": _CHANNEL, "offset_m": float},
            "drift": {"channel": _CHANNEL, "rate_m_s": float},
            "scaled": {"channel": _CHANNEL, "factor": Positive},
            "rounded": {"channel": _CHANNEL, "to_m": Positive},
            "frozen": {"channel": _CHANNEL},
            "noisy": {"channel": _CHANNEL, "factor": Positive},
            "scale_drift": {"channel": _CHANNEL, "rate_1_s": float},
            "moved": {"channel": Annotated[int, Field(ge=1, le=32)], "by_m": tuple[float, float, float]},
            "at_rest": {},
        },
    ),
    # The robot reboots: boot number (unless its firmware does not count boots), clock, sequence numbers and fans; every
    # session is lost.
    "robot": _types(InjectedFault, {"reboot": {"keeps_number": (bool, False)}}),
}
"""The types that each signal takes."""

LINK_TYPES: dict[str, type[LinkFault]] = {
    # Every connection is broken by RST, or ended by FIN.
    **_types(LinkFault, {"reset": {}, "close": {}}),
    **_types(
        LastingLinkFault,
        {
            # All data and the end of a connection are lost: a half-open connection.
            "black_hole": {},
            # Nothing is passed on; after the fault everything at once.
            "stall": {},
            # Data are late by ``delay_s`` plus up to ``jitter_s``, drawn for each piece; the order stays.
            "delay": {"delay_s": NonNegative, "jitter_s": NonNegative},
            # Every n-th line is passed on after the one that follows it.
            "reorder": {"every": Annotated[int, Field(ge=2)]},
            # Every n-th line is passed on twice.
            "duplicate": {"every": _Nth},
            # Passed on in writes of at most ``write_bytes`` bytes.
            "fragment": {"write_bytes": _ByteCount},
            # Additional lines at ``rate_hz``: random ones, or copies of the last line.
            "flood": {"rate_hz": Positive, "lines": Literal["garbage", "copies"]},
            # Passed on byte by byte, at ``bytes_per_s``.
            "slowloris": {"bytes_per_s": Positive},
            # A line of ``garbage_bytes`` random bytes before every n-th line.
            "garbage": {"garbage_bytes": _ByteCount, "every": _Nth},
            # One byte of every n-th line is changed.
            "corrupt": {"every": _Nth},
        },
    ),
}

LOCKSTEP_TYPES = ("reset", "close", "duplicate", "fragment", "garbage", "corrupt", "reorder", "delay")
"""Types of link faults that are allowed in lockstep. With the others simulated time would wait for the end of the
fault, which would never come."""


class Injected:
    """Record of when and how often one fault of the plan has acted so far; robot times."""

    def __init__(self, fault: Any) -> None:
        self.fault = fault
        self.signal, self.type = str(fault.signal), str(fault.type)
        self.at_s: float | None = fault.at_s  # planned begin; None: it begins after lines or bytes
        self.from_s: float | None = None  # the first sample, frame or step that it acted on
        self.until_s: float | None = None  # the last one
        self.samples = self.changed = 0  # how many, and how many of them were changed or removed

    def add(self, t_s: float, *, is_changed: bool = True) -> None:
        """Count one sample, frame or step."""
        if self.from_s is None:
            self.from_s = t_s
        self.until_s = t_s
        self.samples += 1
        self.changed += is_changed

    def as_fields(self) -> dict[str, Any]:
        """The record for a log."""
        return {name: value for name, value in vars(self).items() if name != "fault"}


class FaultPlan(NamedTuple):
    """The faults of a run; the robot's faults are applied in the order of the file."""

    faults: tuple[InjectedFault, ...] = ()
    link: tuple[LinkFault, ...] = ()


def parse_plan(text: str, name: str) -> FaultPlan:
    """The plan in a text; a ``ConfigError`` has a line per problem with file, line, key, the problem and a remedy."""
    tree = parse_toml(text, name)
    problems = [
        f"{name}:{find_line(text, (section,))}: {section} is unknown; {choice_hint(section, _SECTIONS)}"
        for section in tree
        if section not in _SECTIONS
    ]
    found: dict[str, list[Any]] = {section: [] for section in _SECTIONS}
    for section in _SECTIONS:
        rows = tree.get(section, [])
        if not (isinstance(rows, list) and all(isinstance(row, dict) for row in rows)):
            problems.append(f"{name}: {section} must be a list of tables; begin each with [[{section}]]")
            continue
        for index, row in enumerate(rows):
            fault, wrong = _parse_fault(row) if section == "fault" else _parse_link_fault(row)
            found[section].append(fault)
            for key, what in wrong:
                line = find_line(text, (section, index, key.split("[", maxsplit=1)[0]))
                problems.append(f"{name}:{line}: {section}[{index}].{key} {what}")
    if problems:
        raise ConfigError(*problems, shows_all=True)
    return FaultPlan(tuple(found["fault"]), tuple(found["link"]))


def read_plan(file: Path, *, lockstep: bool) -> FaultPlan:
    """The plan in a file; errors as of ``parse_plan`` and ``check_pacing``."""
    plan = parse_plan(read_toml(file), str(file))
    check_pacing(plan, str(file), lockstep=lockstep)
    return plan


def check_pacing(plan: FaultPlan, name: str, *, lockstep: bool) -> None:
    """Raise ``ConfigError`` for link faults that are not in ``LOCKSTEP_TYPES``, in lockstep."""
    problems = [
        f"{name}: link[{k}].type = {format_value(one.type)} makes no sense in lockstep, where simulated time waits for "
        f"every line; add --realtime, or take one of {', '.join(LOCKSTEP_TYPES)}"
        for k, one in enumerate(plan.link)
        if lockstep and one.type not in LOCKSTEP_TYPES
    ]
    if problems:
        raise ConfigError(*problems, shows_all=True)


_Problems = list[tuple[str, str]]
"""Keys, and what is wrong with each."""


def _parse_fault(row: Mapping[str, Any]) -> tuple[Any, _Problems]:
    types, problems = _choose(row, "signal", TYPES)
    if types is None:
        return None, problems
    model, problems = _choose(row, "type", types, f" of {row['signal']}")
    fault, problems = _validate(model, problems, row)
    if model is _ON_SENSORS["wrong"] and fault and (fault.offset, fault.factor, fault.sign) == (None, None, None):
        problems.append(("type", '= "wrong" needs an offset, a factor or a sign'))
    if model is _ON_SENSORS["saturated"] and fault:
        low = -math.inf if fault.low is None else fault.low
        high = math.inf if fault.high is None else fault.high
        if not low < high or (low, high) == (-math.inf, math.inf):
            problems.append(("type", '= "saturated" needs low or high, and low below high'))
    return fault, problems


def _parse_link_fault(row: Mapping[str, Any]) -> tuple[Any, _Problems]:
    fault, problems = _validate(*_choose(row, "type", LINK_TYPES), row)
    if fault is not None and [fault.at_s, fault.after_lines, fault.after_bytes].count(None) != 2:
        problems.append(("type", f"= {format_value(fault.type)} needs one of at_s, after_lines, after_bytes"))
    return fault, problems


def _choose(row: Mapping[str, Any], key: str, choices: Mapping[str, Any], of: str = "") -> tuple[Any, _Problems]:
    value = row.get(key)
    if value is None:
        misspelt = nearest(key, row)
        if misspelt is not None:
            return None, [(misspelt, f"is unknown; did you mean {key}?")]
        return None, [(key, f"is missing; {choice_hint('', choices)}")]
    if not isinstance(value, str):
        return None, [(key, f"= {format_value(value)} must be text in quotes")]
    if value not in choices:
        return None, [(key, f"= {format_value(value)} is no {key}{of}; {choice_hint(value, choices)}")]
    return choices[value], []


def _validate(model: Any, problems: _Problems, row: Mapping[str, Any]) -> tuple[Any, _Problems]:
    if model is None:
        return None, problems
    try:
        # through JSON, because its strict mode is right for TOML: an array is a tuple, "1" is not a number
        return model.model_validate_json(json.dumps(row, default=str), strict=True), problems
    except ValidationError as error:
        return None, [(format_key(one.key), one.what) for one in faults_of(error.errors(), model)]
