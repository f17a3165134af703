"""The line of a leg, and steering along it."""

from math import asin, atan2, cos, pi, sin, sqrt

import msgspec

from ccatp.control.wheel_motion import Pose
from ccatp.core import Vector2
from ccatp.kinematics import wrap_pi

# Largest plausible drift per metre: beyond it the wheels have lost their grip.
CREEP_LIMIT = 0.3


class LegView(msgspec.Struct, frozen=True):
    """The robot relative to its line: rest of the way, offset to the left, heading error, progress per driven metre."""

    ahead_m: float
    beside_m: float
    off_rad: float
    gain: float


class LegLine(msgspec.Struct, frozen=True):
    """The straight line through the stop along which a leg is driven, defined by its course.

    It always passes through the stop. When the stop's coordinates change, the frame has changed. Then a line to a far
    stop starts again at the robot; nearer than the look-ahead it keeps its angle to the robot, because the bearing of a
    near stop is mostly noise.
    """

    target: Vector2
    course_rad: float
    cos: float
    sin: float
    off_rad: float = 0.0

    @classmethod
    def lay(cls, target: Vector2, course_rad: float) -> "LegLine":
        """The line through a stop with a given course."""
        return cls(target, course_rad, cos(course_rad), sin(course_rad))

    @classmethod
    def through(cls, pose: Pose, target: Vector2) -> "LegLine":
        """The line from the robot at (x, y, heading) to the stop."""
        return cls.lay(target, atan2(target[1] - pose[1], target[0] - pose[0]))

    def look(
        self, pose: Pose, target: Vector2, creep: Vector2, reverse: bool, lookahead_m: float
    ) -> "tuple[LegLine, LegView]":
        """The line for the next steps, and the robot at ``pose`` = (x, y, heading) relative to it.

        The body moves along its axis m and drifts by c per metre: (m + c) lies along the line when the part of m across
        it cancels that of c, ``sin(crab) = -c_across``; progress is ``cos(crab) + c_along``.
        """
        x, y, heading = pose
        motion = heading + pi if reverse else heading
        dx, dy = target[0] - x, target[1] - y
        line = self
        if target != self.target:
            is_far = dx * dx + dy * dy > lookahead_m * lookahead_m
            kept_rad = motion - crab(self.course_rad, creep) - self.off_rad
            line = LegLine.lay(target, atan2(dy, dx) if is_far else wrap_pi(kept_rad))
        course_rad, c, s = line.course_rad, line.cos, line.sin
        creep_x, creep_y = creep
        angle = -asin(min(max(c * creep_y - s * creep_x, -CREEP_LIMIT), CREEP_LIMIT))
        off = wrap_pi(motion - course_rad - angle)
        along = min(max(c * creep_x + s * creep_y, -CREEP_LIMIT), CREEP_LIMIT)
        view = LegView(c * dx + s * dy, s * dx - c * dy, off, cos(angle) + along)
        return LegLine(target, course_rad, c, s, off), view


def crab(course_rad: float, creep: Vector2) -> float:
    """Angle between body and course that compensates the drift, rad."""
    across = cos(course_rad) * creep[1] - sin(course_rad) * creep[0]
    return -asin(min(max(across, -CREEP_LIMIT), CREEP_LIMIT))


def line_rate(sight: LegView, v_m_s: float, cross_gain_rad_m2: float, heading_weight_1_s2: float) -> float:
    """Angular rate of the optimal regulator of ``e' = v theta, theta' = omega``, rad/s; see docs/mathematics.md.

        omega = -g v e - sqrt(w + 2 g v^2) theta

    With g = ``cross_gain_rad_m2`` the error decays over about 1/sqrt(g) of travel.
    """
    gain = cross_gain_rad_m2 * v_m_s
    return -gain * sight.beside_m - sqrt(heading_weight_1_s2 + 2.0 * gain * v_m_s) * sight.off_rad
