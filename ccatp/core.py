"""Value types shared by all packages (samples, poses, fixes, verdicts), angles, kinematics, steady robot time."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from math import atan2, cos, pi, sin, tau
from typing import Annotated, NamedTuple, Self, TypeVar

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

    ``ccatp.conditions.text_of`` makes the text for people, and nothing is decided by that text. ``values``: of the
    variable parts of the message. ``lasted_s``, ``repetition``: why the severity was raised. ``besides``: what is found
    besides it.
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


def wrap_pi(angle_rad: float) -> float:
    """The same direction in [-pi, pi), rad."""
    return (angle_rad + pi) % tau - pi


def difference(a_rad: float, b_rad: float) -> float:
    """Shortest signed rotation that takes ``b_rad`` to ``a_rad``, in [-pi, pi), rad."""
    return (a_rad - b_rad + pi) % tau - pi


def bearing(dx_m: float, dy_m: float) -> float:
    """Direction of (dx, dy), rad from the x axis, left positive. Thesis eq. 3.2 prints ``arctan(x, y)`` for it."""
    return atan2(dy_m, dx_m)


def rotate(x_m: float, y_m: float, angle_rad: float) -> tuple[float, float]:
    """Rotate the vector (x, y) counter-clockwise by ``angle_rad``."""
    c, s = cos(angle_rad), sin(angle_rad)
    return c * x_m - s * y_m, s * x_m + c * y_m


def wheel_rates(twist: Twist, wheel_radius_m: float, wheel_base_m: float) -> tuple[float, float]:
    """Inverse kinematics, eq. 3.3: wheel rates (right, left), rad/s, for a velocity of the robot's origin."""
    half = 0.5 * wheel_base_m * twist.omega_rad_s
    return (twist.v_m_s + half) / wheel_radius_m, (twist.v_m_s - half) / wheel_radius_m


def twist_of(right_rad_s: float, left_rad_s: float, wheel_radius_m: float, wheel_base_m: float) -> Twist:
    """Forward kinematics, the inverse of eq. 3.3."""
    return Twist(
        0.5 * wheel_radius_m * (right_rad_s + left_rad_s), wheel_radius_m * (right_rad_s - left_rad_s) / wheel_base_m
    )


_Sample = TypeVar("_Sample", ImuSample, WheelSample, EdgeSample, GravitySample)


class ClockJump(NamedTuple):
    """A jump of the robot's clock before frame ``seq``, by ``by_s`` against the expected time; < 0 backward."""

    seq: int
    by_s: float


class SteadyTime:
    """Gives each frame a time that never jumps. ``jump``: the newest jump, ``None`` before the first.

    From frame to frame the robot's clock has to advance by the period of the frames, times the frames lost in between.
    If it differs by more than ``limit_s``, or goes backward, it has jumped, and the steady time advances by the period.
    A pause of the frames with consecutive numbers looks like a jump, and is treated the same way.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._seq, self._t_s, self._period_s = -1, 0.0, 0.0
        self.offset_s = self._before_s = 0.0
        self.jump: ClockJump | None = None

    def at(self, seq: int, t_s: float) -> float:
        """The steady time of the newest frame ``seq`` at robot time ``t_s``, s."""
        if self._seq < 0:
            self._seq, self._t_s = seq, t_s
            return t_s
        frames, step_s = seq - self._seq, t_s - self._t_s
        expected_s = frames * self._period_s if self._period_s else step_s
        if step_s <= 0.0 or step_s - expected_s > self._limit_s:
            self._before_s = self.offset_s
            self.offset_s += expected_s - step_s
            self.jump = ClockJump(seq, step_s - expected_s)
        elif frames == 1:
            self._period_s = step_s
        self._seq, self._t_s = seq, t_s
        return t_s + self.offset_s

    def of(self, seq: int, t_s: float) -> float:
        """The steady time of an older frame ``seq`` at robot time ``t_s``, s; at most one jump lies in between."""
        is_before = self.jump is not None and seq < self.jump.seq
        return t_s + (self._before_s if is_before else self.offset_s)

    def of_samples(self, samples: Sequence[_Sample], t_s: float) -> list[_Sample]:
        """Samples of the newest frame at steady times; each uses the time base that is nearer to the frame."""
        now_s, before_s, limit_s = self.offset_s, self._before_s, self._limit_s
        found = []
        for sample in samples:
            own_s, other_s = sample.t_s + now_s, sample.t_s + before_s
            is_other = abs(own_s - t_s) > limit_s and abs(other_s - t_s) < abs(own_s - t_s)
            found.append(sample._replace(t_s=other_s if is_other else own_s))
        return found


class MissionClock:
    """Numbers and times of the frames of a mission.

    ``jump_s``: limit of ``SteadyTime``. ``seq``: the newest frame; ``t_s``: its time without jumps; ``before_s``: time
    of the mission before the first frame served here.
    """

    def __init__(self, jump_s: float) -> None:
        self._jump_s, self.before_s = jump_s, 0.0
        self._steady = SteadyTime(jump_s)
        self._first_s: float | None = None
        self.seq, self.t_s = -1, 0.0

    @property
    def has_begun(self) -> bool:
        """Whether a frame was served since the robot's last boot."""
        return self._first_s is not None

    @property
    def elapsed_s(self) -> float:
        """Robot time of the mission, s."""
        return self.before_s + (0.0 if self._first_s is None else self.t_s - self._first_s)

    @property
    def offset_s(self) -> float:
        """``t_s`` minus the robot's time."""
        return self._steady.offset_s

    def take(self, seq: int, t_s: float, period_s: float) -> tuple[float, float]:
        """Take a served frame; returns its time, and the time since the last one (``period_s`` for the first), s."""
        # Durations use a time that does not jump; everything else uses the robot's own time.
        before_s, steady_s = self.t_s, self.t_s
        if seq > self.seq:
            self.seq, steady_s = seq, self._steady.at(seq, t_s)
        self.t_s = steady_s
        if self._first_s is None:
            self._first_s = steady_s
            return steady_s, period_s
        return steady_s, steady_s - before_s

    def reset(self) -> None:
        """Begin again, because the robot's frame numbers and clock have restarted."""
        self.before_s, self._first_s, self.seq = self.elapsed_s, None, -1
        self._steady = SteadyTime(self._jump_s)
