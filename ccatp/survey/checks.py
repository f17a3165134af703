"""Two checks of a survey: a fault that no operator attends to, and gravity that contradicts the mirror."""

from collections.abc import Sequence
from enum import StrEnum
from math import acos, atan2, degrees, dist, hypot, pi, radians, sqrt
from statistics import median

from ccatp.config.models import Config
from ccatp.core import DeckPose, Vector3
from ccatp.kinematics import wrap_pi
from ccatp.mirror.mirror import Mirror

_EARLY = 1.05  # factor for the charge used between the decision and the start of the motion


class FaultAction(StrEnum):
    """What the timer requests."""

    NOTHING = ""
    REMIND = "remind"
    RETURN = "return"


class UnattendedFaultTimer:
    """Reminds operators of a faulted robot, and sends it home before the battery is too low for that.

    ``falls``: without fans the robot falls off this mirror. Only there it moves without an operator.
    """

    def __init__(self, cfg: Config, *, falls: bool) -> None:
        self._alarm_period_s, self._health, self._falls = cfg.mission.alarm_period_s, cfg.health, falls
        self._since_s: float | None = None
        self._remind_at_s = 0.0
        self._has_returned = False

    def held_s(self, t_s: float) -> float:
        """Duration of the fault, s."""
        return 0.0 if self._since_s is None else t_s - self._since_s

    def over(self) -> None:
        """The fault has ended."""
        self._since_s = None

    def watch(self, t_s: float, soc: float, home_s: float | None) -> FaultAction:
        """One frame of a fault. ``soc``: 0 to 1; ``home_s``: time of the way home, None while the pose is unknown."""
        if self._since_s is None or t_s < self._since_s:
            self._since_s, self._remind_at_s = t_s, t_s + self._alarm_period_s
        # Only once, because the return may fail for the reason of the fault.
        if self._falls and not self._has_returned and home_s is not None and self.is_low(soc, home_s):
            self._has_returned = True
            return FaultAction.RETURN
        if t_s < self._remind_at_s:
            return FaultAction.NOTHING
        self._remind_at_s = t_s + self._alarm_period_s
        return FaultAction.REMIND

    def is_low(self, soc: float, home_s: float) -> bool:
        """Whether the charge above the reserve is less than the way home may need."""
        needed = _EARLY * self._health.battery_margin * home_s / self._health.battery_life_s
        return not soc - self._health.battery_reserve > needed


# A mirror whose slope differs by more than 5 deg must never pass. The median of 40 readings of 2 deg each has a
# standard deviation of 0.4 deg; errors of start pose and mounting are far below the limit.
LIMIT_RAD = radians(3.5)
READINGS = 40
# The check uses the readings received in this time, s; without any, the robot has no such sensor.
PATIENCE_S = 4.0


# Limit of the heading error at base: the robot is placed there within some degrees, and gravity shows the heading
# within 4 deg.
BEARING_RAD = radians(15.0)
_LEAST_TILT = 0.1  # on flatter ground gravity does not show a heading
# Possible mistakes of a robot in its report of gravity: what it reports as x, y and z.
_MISTAKES = {
    "gravity points the other way: the robot reports the reaction (up) instead of the direction of fall": "-x -y -z",
    "gravity is mirrored: x has the wrong sign": "-x y z",
    "gravity is mirrored: y has the wrong sign": "x -y z",
    "gravity is mirrored: z has the wrong sign": "x y -z",
    "x and y of gravity have the wrong sign": "-x -y z",
    "x and z of gravity have the wrong sign": "-x y -z",
    "y and z of gravity have the wrong sign": "x -y -z",
    "x and y of gravity are exchanged": "y x z",
    "x and z of gravity are exchanged": "z y x",
    "y and z of gravity are exchanged": "x z y",
    "the robot reports y, z, x of gravity as x, y, z": "y z x",
    "the robot reports z, x, y of gravity as x, y, z": "z x y",
}


class MirrorCheck:
    """Before the first motion: does gravity agree with the slope of the configured mirror?

    The heading is checked only with ``is_heading_known``. ``contradiction``: why the robot is not on this mirror, or
    the mistake in its report, or empty. ``warning``: what could not be checked. ``unseen``: mistakes that would not
    show in this pose.
    """

    def __init__(self, mirror: Mirror, *, is_heading_known: bool = False) -> None:
        self._mirror, self._is_heading_known = mirror, is_heading_known
        self._readings: list[Vector3] = []
        self._first_s: float | None = None
        self.contradiction = self.warning = ""
        self.unseen: list[str] = []

    def update(self, t_s: float, gravity: Sequence[float] | None, pose: DeckPose) -> bool:
        """Take a frame with a gravity sample (robot frame) or ``None``; returns whether the check is complete."""
        if self._first_s is None:
            self._first_s = t_s
        if gravity is not None:
            _, x, y, z = gravity
            self._readings.append((x, y, z))
        is_over = abs(t_s - self._first_s) >= PATIENCE_S
        if len(self._readings) < READINGS and not is_over:
            return False
        if not self._readings:
            self.warning = "the robot reports no gravity: it is unknown whether it stands on the configured mirror"
            return True
        self._judge(self._mirror.gravity_in_robot(pose))
        return True

    def _judge(self, expected: Vector3) -> None:
        x, y, z = (median(values) for values in zip(*self._readings, strict=True))
        felt = x, y, z
        # The median of the slopes, because with noise the slope of the median differs from it.
        felt_rad, expected_rad = median(map(_slope, self._readings)), _slope(expected)
        is_slope_right = abs(felt_rad - expected_rad) <= LIMIT_RAD
        mistakes = {what: _mistaken(expected, axes) for what, axes in _MISTAKES.items()}
        fitting = [what for what, wrong in mistakes.items() if _is_alike(felt, wrong)]
        if is_slope_right and (not self._is_heading_known or _is_alike(felt, expected)):
            self.unseen = fitting
        elif fitting:
            fitting.sort(key=lambda what: dist(felt, mistakes[what]))
            self.contradiction = f"{', or '.join(fitting)}; it is {_shown(felt)}, expected is {_shown(expected)}"
        elif is_slope_right:
            self.contradiction = (
                f"gravity points {degrees(_bearing(felt, expected)):+.0f} deg to the left of where it does at base: "
                "is the robot turned, or the axes of its gravity?"
            )
        else:
            self.contradiction = (
                f"the robot stands on a slope of {degrees(felt_rad):.1f} deg, {self._mirror.name} has one of "
                f"{degrees(expected_rad):.1f} deg there: is this the right mirror (run.mirror, --mirror)?"
            )


def _mistaken(gravity: Vector3, axes: str) -> Vector3:
    """Gravity as reported with a mistake; ``axes`` as in ``_MISTAKES``."""
    x, y, z = (gravity["xyz".index(axis[-1])] * (-1.0 if axis[0] == "-" else 1.0) for axis in axes.split())
    return x, y, z


def _is_alike(felt: Vector3, gravity: Vector3) -> bool:
    """Whether the slopes agree and, on ground that is not flat, their directions."""
    if abs(_slope(felt) - _slope(gravity)) > LIMIT_RAD:
        return False
    return hypot(gravity[0], gravity[1]) < _LEAST_TILT or abs(_bearing(felt, gravity)) <= BEARING_RAD


def _bearing(felt: Vector3, gravity: Vector3) -> float:
    return wrap_pi(atan2(felt[1], felt[0]) - atan2(gravity[1], gravity[0]))


def _shown(gravity: Vector3) -> str:
    return "({:.2f}, {:.2f}, {:.2f})".format(*gravity)


def _slope(gravity: Sequence[float]) -> float:
    """Angle between the surface and the horizontal, rad; more than a right angle where the surface overhangs."""
    x, y, z = gravity
    return pi - acos(max(-1.0, min(1.0, z / sqrt(x * x + y * y + z * z))))
