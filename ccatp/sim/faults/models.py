"""Pure. The faults that a plan may hold: one model per type, and the tables of which type goes with which signal.

Keys that may be left out are ``None`` then; every other value has to be named, as in a configuration.
"""

from typing import Annotated, Literal

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


class Fault(Model):
    """A fault of the simulated robot.

    Attributes:
        signal: what it befalls.
        type: what happens to it.
        at_s: when it begins: robot time since the first boot.
    """

    signal: str
    type: str
    at_s: NonNegative

    @property
    def end_s(self) -> float:
        """When it ends; infinite where nobody said."""
        for_s = getattr(self, "for_s", None)
        return float("inf") if for_s is None else self.at_s + for_s

    def is_active(self, t_s: float) -> bool:
        """Whether it acts at a time."""
        return self.has_begun(t_s) and t_s < self.end_s - _SAME_TIME_S

    def has_begun(self, t_s: float) -> bool:
        """Whether a time is at its beginning or after it."""
        return t_s >= self.at_s - _SAME_TIME_S


class LastingFault(Fault):
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
    """The wheel turns at ``rate_rad_s``, whatever it is told."""

    rate_rad_s: float


class Slip(LastingFault):
    """The body moves by ``factor`` of what the wheels give, of both or of one."""

    factor: Annotated[float, Field(ge=0.0, le=2.0)]


class Weak(LastingFault):
    """The fan gives the share ``share`` of its thrust; its echo knows nothing of it."""

    share: Share


class Kidnap(Fault):
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


class Reboot(Fault):
    """The robot starts anew: boot number, clock, sequence numbers and fans; every session is lost."""


_ON_SENSORS: dict[str, type[Fault]] = {
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
_ON_WHEELS: dict[str, type[Fault]] = {"blocked": Blocked, "runaway": Runaway, "slip": Slip}
_ON_FANS: dict[str, type[Fault]] = {"weak": Weak}

TYPES: dict[str, dict[str, type[Fault]]] = {
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
