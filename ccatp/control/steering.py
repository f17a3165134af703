"""Pure. The line of a leg: where the robot stands beside it, and the rate that brings it back."""

from math import asin, atan2, cos, pi, sin, sqrt
from typing import NamedTuple

from ccatp.angles import wrap_pi
from ccatp.control.profile import clamped

# Drift per metre beyond which an estimate is nonsense: a robot carried off that fast has lost its wheels' grip.
CREEP_LIMIT = 0.3


class Sight(NamedTuple):
    """The line as seen from the robot.

    Attributes:
        ahead_m: what remains along the line.
        beside_m: how far to the left of the line the robot stands.
        off_rad: its direction of motion minus the direction that keeps it on the line.
        gain: progress along the line per metre that the wheels drive.
    """

    ahead_m: float
    beside_m: float
    off_rad: float
    gain: float


class Line:
    """The straight line through the stop along which a leg is driven.

    It is held by its course alone, so it passes through the stop wherever an update moves that. A stop whose
    coordinates change is one seen in another frame: from afar the line is then laid anew from the robot to the stop;
    near by it keeps its angle to the robot, because the bearing of a near stop is noise.

    Args:
        lookahead_m: nearer than this a stop's bearing is not to be trusted.
    """

    __slots__ = ("_cos", "_course_rad", "_lookahead_m", "_off_rad", "_reverse", "_sin", "_target")

    def __init__(self, lookahead_m: float) -> None:
        """No line yet: ``begin`` lays it."""
        self._lookahead_m = lookahead_m
        self._target = (0.0, 0.0)
        self._off_rad = 0.0
        self._reverse = False
        self._lay(0.0)

    def begin(self, pose: tuple[float, float, float], target: tuple[float, float], reverse: bool) -> None:
        """Lay the line from the robot to the stop."""
        self._reverse, self._target = reverse, target
        self._lay(atan2(target[1] - pose[1], target[0] - pose[0]))
        self._off_rad = 0.0

    def look(self, pose: tuple[float, float, float], target: tuple[float, float], creep: tuple[float, float]) -> Sight:
        """Where the robot stands.

        The body moves along its axis m and drifts by c per metre: (m + c) lies along the line when the part of m across
        it cancels that of c, ``sin(crab) = -c_across``; progress is ``cos(crab) + c_along``.

        Args:
            pose: (x, y, heading), m and rad.
            target: the stop in the same plane.
            creep: drift per metre in that plane.
        """
        x, y, heading = pose
        motion = heading + pi if self._reverse else heading
        dx, dy = target[0] - x, target[1] - y
        if target != self._target:
            self._move_to(target, motion, dx, dy, crab(self._course_rad, creep))
        c, s = self._cos, self._sin
        creep_x, creep_y = creep
        angle = -asin(clamped(c * creep_y - s * creep_x, CREEP_LIMIT))
        self._off_rad = off = wrap_pi(motion - self._course_rad - angle)
        along = clamped(c * creep_x + s * creep_y, CREEP_LIMIT)
        return Sight(c * dx + s * dy, s * dx - c * dy, off, cos(angle) + along)

    def _move_to(self, target: tuple[float, float], motion: float, dx: float, dy: float, angle: float) -> None:
        self._target = target
        is_far = dx * dx + dy * dy > self._lookahead_m * self._lookahead_m
        self._lay(atan2(dy, dx) if is_far else wrap_pi(motion - angle - self._off_rad))

    def _lay(self, course_rad: float) -> None:
        self._course_rad, self._cos, self._sin = course_rad, cos(course_rad), sin(course_rad)


def crab(course_rad: float, creep: tuple[float, float]) -> float:
    """Angle by which the body has to point beside a course so that it is not carried off it, rad."""
    across = cos(course_rad) * creep[1] - sin(course_rad) * creep[0]
    return -asin(clamped(across, CREEP_LIMIT))


def line_rate(sight: Sight, v_m_s: float, cross_gain_rad_m2: float, heading_weight_1_s2: float) -> float:
    """Angular rate of the optimal regulator of ``e' = v theta, theta' = omega``, rad/s.

    Minimising the integral of ``(g v e)^2 + w theta^2 + omega^2`` the Riccati equation is solved by

        omega = -g v e - sqrt(w + 2 g v^2) theta.

    The weight of e grows with the speed: a robot that has all but stopped cannot remove it, and would only turn.

    Args:
        sight: the line.
        v_m_s: planned speed along it.
        cross_gain_rad_m2: g; the error decays over about 1/sqrt(g) of travel.
        heading_weight_1_s2: w.
    """
    gain = cross_gain_rad_m2 * v_m_s
    return -gain * sight.beside_m - sqrt(heading_weight_1_s2 + 2.0 * gain * v_m_s) * sight.off_rad
