"""Pure. Before the first motion: does gravity agree with the slope of the configured mirror where the robot stands?"""

from collections.abc import Sequence
from math import acos, degrees, pi, radians, sqrt
from statistics import median

from ccatp.mirror.mirror import Mirror
from ccatp.samples import DeckPose

# A mirror that is more than 5 deg off must never pass. The median of so many readings of 2 deg each is right within 0.4
# deg, one standard deviation; what else may differ (the start pose, the sensor's mounting) is far below the limit.
LIMIT_RAD = radians(3.5)
READINGS = 40
# What has come in after this time has to do, s; none at all: the robot has no such sensor.
PATIENCE_S = 4.0


class MirrorCheck:
    """Compares the slope that gravity shows with the map's. The heading plays no part, so that it need not be known.

    Args:
        mirror: the configured mirror.

    Attributes:
        contradiction: why the mirror cannot be this one; empty while nothing speaks against it.
        warning: what could not be checked.
    """

    def __init__(self, mirror: Mirror) -> None:
        """Nothing heard."""
        self._mirror = mirror
        self._slopes_rad: list[float] = []
        self._first_s: float | None = None
        self.contradiction = self.warning = ""

    def hear(self, t_s: float, gravity: Sequence[float] | None, pose: DeckPose) -> bool:
        """Take a frame; true once all is known that will be.

        Args:
            t_s: time of the frame, s.
            gravity: time and direction of gravity in the robot frame, where the frame has a reading.
            pose: where the robot is thought to stand.
        """
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
