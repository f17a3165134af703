"""The faults that a plan may hold, for the robot and for its link, and the record of what was injected.

There is one model per type, and tables of the types that go with each signal. Keys that may be left out are ``None``
then; every other value has to be named, as in a configuration.
"""

from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from ccatp.config.models import Model, NonNegative, Positive

_SAME_TIME_S = 1e-9  # times of frames and samples are multiples of their periods to within rounding

Share = Annotated[float, Field(ge=0.0, le=1.0)]
EveryNth = Annotated[int, Field(ge=1, le=1_000_000)]

SENSOR_SIGNALS = (
    "imu_ax", "imu_wz", "encoder_right", "encoder_left",
    "edge_front_left", "edge_front_right", "edge_rear_left", "edge_rear_right",
    "gravity", "fans", "soc",
)  # fmt: skip
FAULT_NAMES = (
    "imu", "encoder_left", "encoder_right", "edge", "fan_left", "fan_right", "battery_low", "stall",
)  # fmt: skip


class InjectedFault(Model):
    """A fault of the simulated robot.

    Attributes:
        at_s: when it begins: robot time since the first boot.
    """

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

    every: Annotated[int, Field(ge=2, le=1_000_000)]


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

    every: Annotated[int, Field(ge=2, le=1_000_000)]


class Raise(LastingFault):
    """The robot itself reports ``names`` in its frames."""

    names: Annotated[tuple[Literal[
        "imu", "encoder_left", "encoder_right", "edge", "fan_left", "fan_right", "battery_low", "stall",
    ], ...], Field(min_length=1)]  # fmt: skip


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

Direction = Literal["to_client", "to_robot", "both"]
ByteCount = Annotated[int, Field(ge=1, le=65536)]


class LinkFault(Model):
    """A fault of the link.

    Attributes:
        at_s: robot time at which it begins; or else
        after_lines, after_bytes: it begins once so much has gone to the clients, counted over all connections.
    """

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


class InjectionRecord:
    """The record of one fault while it is written."""

    __slots__ = ("_changed", "_from_s", "_reported", "_samples", "_until_s", "fault")

    def __init__(self, fault: InjectedFault) -> None:
        self.fault = fault
        self._from_s: float | None = None
        self._until_s: float | None = None
        self._samples = self._changed = 0
        self._reported = 0

    def add(self, t_s: float, *, is_changed: bool = True) -> None:
        """Count one sample, frame or step."""
        if self._from_s is None:
            self._from_s = t_s
        self._until_s = t_s
        self._samples += 1
        self._changed += is_changed

    @property
    def injected(self) -> Injected:
        """The record so far."""
        fault = self.fault
        return Injected(fault.signal, fault.type, fault.at_s, self._from_s, self._until_s, self._samples, self._changed)

    def change(self, t_s: float) -> str:
        """``begins`` or ``ended`` once each, else empty; a fault of an instant ends as it begins."""
        if self._reported == 0 and self._from_s is not None:
            self._reported = 1
            return "begins"
        is_over = t_s >= self.fault.end_s
        if self._reported == 1 and is_over:
            self._reported = 2
            return "ended"
        return ""


# Ranges of random readings: those of common parts (accelerometer 2 g, gyroscope 2000 deg/s), twice the wheels' limit.
_AX_M_S2, _WZ_RAD_S, _WHEEL_RAD_S = 19.6, 34.9, 16.0


class Signal(NamedTuple):
    """Where a signal stands.

    Attributes:
        columns: places in a row, the time being place 0.
        is_binary: it is 0 or 1.
    """

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
