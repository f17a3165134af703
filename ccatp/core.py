"""Value types shared by all packages: samples, poses, fixes, causes, verdicts, stops."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Annotated, NamedTuple, Self

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]

# Ranges that a decoder of samples checks.
MAX_TIME_S = 1e9  # about thirty years
GRAVITY_M_S2 = 9.771  # at latitude -22.99 deg, 5,612 m
MAX_RATE_RAD_S = 1e4  # of wheels and body; no machine reaches it, and squares stay finite
MAX_ACCELERATION_M_S2 = 1e4
Time = Annotated[float, Meta(ge=0.0, le=MAX_TIME_S)]
Rate = Annotated[float, Meta(ge=-MAX_RATE_RAD_S, le=MAX_RATE_RAD_S)]
Acceleration = Annotated[float, Meta(ge=-MAX_ACCELERATION_M_S2, le=MAX_ACCELERATION_M_S2)]
Bit = Annotated[int, Meta(ge=0, le=1)]


class ImuSample(NamedTuple):
    """One reading of the inertial unit: acceleration along robot x (gravity removed) and angular rate about robot z."""

    t_s: Time
    ax_m_s2: Acceleration
    wz_rad_s: Rate


class WheelSample(NamedTuple):
    """One reading of the wheel encoders. ``None`` marks a wheel that gave no sample."""

    t_s: Time
    right_rad_s: Rate | None
    left_rad_s: Rate | None


class EdgeSample(NamedTuple):
    """One reading of the edge sensors: 1 = panel under the sensor, 0 = none."""

    t_s: Time
    front_left: Bit
    front_right: Bit
    rear_left: Bit
    rear_right: Bit


class GravitySample(NamedTuple):
    """Unit direction of gravity in the robot frame."""

    t_s: Time
    gx: float
    gy: float
    gz: float


class PanelId(NamedTuple):
    """Row and column of a panel, both counted from 1 as in the mirror's data file."""

    row: int
    col: int


class PointId(NamedTuple):
    """A measurement point: panel and number 1 to 9 (row by row from the panel's lower left, thesis fig. 2.2)."""

    row: int
    col: int
    point: int

    @property
    def panel(self) -> PanelId:
        """The panel on which the point lies."""
        return PanelId(self.row, self.col)


class PanelPose(msgspec.Struct, frozen=True):
    """Pose in a panel frame, ``(x, y, theta)_p`` of the thesis."""

    panel: PanelId
    x_m: float
    y_m: float
    heading_rad: float


class DeckPose(msgspec.Struct, frozen=True):
    """Pose of the robot's origin in the deck frame.

    ``heading_rad`` is measured in the local tangent plane from the tangent of the line y = const (towards +x).
    """

    x_m: float
    y_m: float
    heading_rad: float


@dataclass(frozen=True, slots=True)
class Fix:
    """A multilaterated position of the puck, world frame; covariance 3 x 3, row-major; DOP sqrt(trace((J^T J)^-1)).

    ``covariance_m2`` includes what lengths that contradict each other leave open. ``lengths_m``: of ``channels``, then
    of ``left_out``. ``metrology``: ``good``, ``unchecked``, ``unreliable``, or empty if it was not judged.
    ``suspects``: channels that contradict each other. ``detectable_m``: error of a length that is detected with
    probability 0.999; ``protection_m``: error of the position by a smaller one, with the noise.
    ``warnings``: for operators.
    """

    t_s: float
    position_m: Vector3
    covariance_m2: tuple[float, ...]
    dop: float
    channels: tuple[int, ...]
    residual_rms_m: float
    left_out: tuple[int, ...] = ()
    lengths_m: tuple[float, ...] = ()
    metrology: str = ""
    suspects: tuple[int, ...] = ()
    detectable_m: float | None = None
    protection_m: float | None = None
    warnings: tuple[str, ...] = ()


# What the redundant lengths of a fix say about it (``Fix.metrology``).
GOOD, UNCHECKED, UNRELIABLE = "good", "unchecked", "unreliable"


class Measured(NamedTuple):
    """A point and its fix."""

    point: PointId
    fix: Fix


def unreliable_points(measured: Iterable[Measured]) -> int:
    """Number of points whose lengths contradict each other."""
    return len({one.point for one in measured if one.fix.metrology == UNRELIABLE})


class EventCode(IntEnum):
    """Event codes of the thesis, table 3.2. Labels, not priorities."""

    NORMAL = 0
    NEAR_EDGE = 1
    ABORTED = 2


_NORMAL = EventCode.NORMAL  # looking up a member of the enum in every frame costs more than making a verdict


class Severity(IntEnum):
    """Severity of a finding; of several findings the highest counts."""

    NONE = 0
    INFORM = 1  # report only
    SLOW = 2  # continue at reduced speed
    PAUSE = 3  # hold the wheels until the cause is gone
    HOLD = 4  # hold the wheels until the cause is gone, then take a fix
    RETURN = 5  # drive home, at reduced speed
    FAULT = 6  # hold the wheels until an operator resumes


class Corner(StrEnum):
    """Edge sensors, in the order of the robot link."""

    FRONT_LEFT = "front_left"
    FRONT_RIGHT = "front_right"
    REAR_LEFT = "rear_left"
    REAR_RIGHT = "rear_right"


class Cause(msgspec.Struct, frozen=True, omit_defaults=True):
    """Why something happens: a condition by its name, with its numbers; false without a name.

    It is kept as it was found. So a number that grows while the condition lasts is not in it, but the limit that it has
    passed. ``ccatp.conditions.text_of`` makes the text for people, and nothing is decided by that text.
    ``values``: of the variable parts of the message. ``lasted_s``, ``repetition``: least time or number that raised the
    severity. ``besides``: what is found besides it.
    """

    condition: str = ""
    values: dict[str, int | float | str] = {}
    lasted_s: float = 0.0
    repetition: int = 0
    besides: "Cause | None" = None

    def __bool__(self) -> bool:
        return bool(self.condition)


NO_CAUSE = Cause()


class Permits(NamedTuple):
    """Motion that is permitted; a turn is one in place."""

    forward: bool
    reverse: bool
    turn: bool


ALL_MOTION, NO_MOTION = Permits(True, True, True), Permits(False, False, False)


class Verdict(msgspec.Struct, frozen=True):
    """The danger loop's verdict on one sensors frame."""

    seq: int
    t_s: float
    code: EventCode
    cause: Cause
    signal: str  # source of ``cause`` ("front_left", "estimate", "emergency:fire"), or empty
    value: float  # of the signal, in the unit of ``limit``
    limit: float
    forward: bool
    reverse: bool
    turn: bool
    off: tuple[bool, bool, bool, bool] = (False, False, False, False)  # the edge sensors of a declared edge
    severity: Severity = Severity.NONE  # of the cause; NONE for an edge, which code and permits describe
    full_fans: bool = False
    raised: int = 0  # number of emergencies raised so far while one is latched
    is_shaking: bool = False  # an earthquake is latched, even if code and cause are of another rule

    @classmethod
    def normal(cls, seq: int, t_s: float) -> Self:
        """Nothing is found, and all motion is permitted."""
        return cls(seq, t_s, _NORMAL, NO_CAUSE, "", 0.0, 0.0, *ALL_MOTION)

    @property
    def permits(self) -> Permits:
        """The motion that it permits."""
        return Permits(self.forward, self.reverse, self.turn)


class Twist(msgspec.Struct, frozen=True):
    """Velocity of the robot's origin: forward speed and angular rate about its z axis."""

    v_m_s: float
    omega_rad_s: float


class Predicted(msgspec.Struct, frozen=True):
    """A predicted state: a pose in a plane, (x_m, y_m, heading_rad), and the speeds."""

    pose: Vector3
    v_m_s: float
    omega_rad_s: float


class StopKind(StrEnum):
    """Purpose of a stop."""

    MEASURE = "measure"
    CALIBRATE = "calibrate"
    VIA = "via"
    BASE = "base"


@dataclass(frozen=True, slots=True)
class Stop:
    """One stop of a route: target of the robot's origin, deck frame.

    ``reverse``: the leg to this stop is driven in reverse. ``heading_rad``: deck heading to turn to after arrival.
    """

    x_m: float
    y_m: float
    kind: StopKind
    point: PointId | None = None
    reverse: bool = False
    heading_rad: float | None = None

    @property
    def is_measured(self) -> bool:
        """The robot measures there."""
        return self.kind in (StopKind.MEASURE, StopKind.CALIBRATE)


class EmergencyKind(StrEnum):
    """Causes of an abort (interface control document 3)."""

    EARTHQUAKE = "earthquake"
    FIRE = "fire"
    POWER = "power"
    WEATHER = "weather"
    OPERATOR = "operator"
