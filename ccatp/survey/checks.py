"""Checks of a survey beside its frames: a fault that nobody looks after, and a mirror that contradicts gravity."""

from collections.abc import Sequence
from enum import StrEnum
from math import acos, degrees, pi, radians, sqrt
from statistics import median

from ccatp.config.models import Config
from ccatp.core import DeckPose
from ccatp.mirror.mirror import Mirror

_EARLY = 1.05  # from the decision to the first turn of a wheel some charge goes, too


class FaultAction(StrEnum):
    """What the timer asks for."""

    NOTHING = ""
    REMIND = "remind"
    RETURN = "return"


class UnattendedFaultTimer:
    """A reminder while no operator resumes a faulted robot, and home before the battery no longer lasts for it.

    ``falls``: without fans the robot falls off this mirror; only there it is worth moving without an operator.
    """

    def __init__(self, cfg: Config, *, falls: bool) -> None:
        self._alarm_period_s, self._health, self._falls = cfg.mission.alarm_period_s, cfg.health, falls
        self._since_s: float | None = None
        self._remind_at_s = 0.0
        self._has_returned = False

    def held_s(self, t_s: float) -> float:
        """How long the fault lasts."""
        return 0.0 if self._since_s is None else t_s - self._since_s

    def over(self) -> None:
        """There is no fault any more."""
        self._since_s = None

    def watch(self, t_s: float, soc: float, home_s: float | None) -> FaultAction:
        """One frame of a fault; charge 0 to 1; ``home_s`` is None where the robot does not know where it is."""
        if self._since_s is None or t_s < self._since_s:
            self._since_s, self._remind_at_s = t_s, t_s + self._alarm_period_s
        # Once: a return that failed may have failed for the reason of the fault.
        if self._falls and not self._has_returned and home_s is not None and self.is_low(soc, home_s):
            self._has_returned = True
            return FaultAction.RETURN
        if t_s < self._remind_at_s:
            return FaultAction.NOTHING
        self._remind_at_s = t_s + self._alarm_period_s
        return FaultAction.REMIND

    def is_low(self, soc: float, home_s: float) -> bool:
        """Whether the charge above the reserve is less than the way home may take."""
        needed = _EARLY * self._health.battery_margin * home_s / self._health.battery_life_s
        return not soc - self._health.battery_reserve > needed


# A mirror that is more than 5 deg off must never pass. The median of so many readings of 2 deg each is right within 0.4
# deg, one standard deviation; what else may differ (the start pose, the sensor's mounting) is far below the limit.
LIMIT_RAD = radians(3.5)
READINGS = 40
# What has come in after this time has to do, s; none at all: the robot has no such sensor.
PATIENCE_S = 4.0


class MirrorCheck:
    """Before the first motion: does gravity agree with the slope of the configured mirror? The heading plays no part.

    ``contradiction``: why the mirror cannot be this one, or empty; ``warning``: what could not be checked.
    """

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._slopes_rad: list[float] = []
        self._first_s: float | None = None
        self.contradiction = self.warning = ""

    def update(self, t_s: float, gravity: Sequence[float] | None, pose: DeckPose) -> bool:
        """Take a frame and gravity's direction in the robot frame, where it was read; whether the check is complete."""
        if self._first_s is None:
            self._first_s = t_s
        if gravity is not None:
            self._slopes_rad.append(_slope(gravity[1:]))
        is_over = abs(t_s - self._first_s) >= PATIENCE_S
        if len(self._slopes_rad) < READINGS and not is_over:
            return False
        if not self._slopes_rad:
            self.warning = "the robot tells no gravity: nobody knows whether it stands on the configured mirror"
            return True
        felt_rad, expected_rad = median(self._slopes_rad), _slope(self._mirror.gravity_in_robot(pose))
        if abs(felt_rad - expected_rad) > LIMIT_RAD:
            self.contradiction = (
                f"the robot stands on a slope of {degrees(felt_rad):.1f} deg, {self._mirror.name} has one of "
                f"{degrees(expected_rad):.1f} deg there: is this the right mirror (run.mirror, --mirror)?"
            )
        return True


def _slope(gravity: Sequence[float]) -> float:
    """Angle between the surface and the horizontal, rad; more than a right angle where the surface overhangs."""
    x, y, z = gravity
    return pi - acos(max(-1.0, min(1.0, z / sqrt(x * x + y * y + z * z))))
