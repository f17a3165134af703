"""Pure. What the distance sensors saw lately, seen from where the robot is now: carried on by the wheels alone."""

from collections import deque
from collections.abc import Sequence
from math import atan2, cos, hypot, inf, pi, sin
from typing import NamedTuple

from ccatp.angles import wrap_pi


class _Echo(NamedTuple):
    time_s: float
    x_m: float  # in the frame in which the robot stood when this memory began
    y_m: float


class EchoMemory:
    """Points in the frame of dead reckoning. Over its short memory that drifts by less than a sensor's noise.

    Args:
        sensors_rad: where the sensors look, left of the heading.
        reach_m: farther echoes are not kept.
        memory_s: how long one is believed.
    """

    def __init__(self, sensors_rad: Sequence[float], reach_m: float, memory_s: float) -> None:
        """Nothing seen."""
        self._sensors_rad, self._reach_m, self._memory_s = tuple(sensors_rad), reach_m, memory_s
        self._echoes: deque[_Echo] = deque()
        self._x_m = self._y_m = self._heading_rad = self._steer_rad = 0.0

    def roll(self, way_m: float, course_rad: float, turn_rad: float) -> None:
        """The robot has moved.

        Args:
            way_m: negative in reverse.
            course_rad: of the way, left of the heading before: the steering angle of a steered front wheel.
            turn_rad: of the heading.
        """
        along_rad = self._heading_rad + course_rad
        self._x_m += way_m * cos(along_rad)
        self._y_m += way_m * sin(along_rad)
        self._heading_rad += turn_rad

    def see(self, time_s: float, distances_m: Sequence[float]) -> None:
        """Take the readings of a frame, in the order of the sensors, and forget what is old."""
        while self._echoes and time_s - self._echoes[0].time_s > self._memory_s:
            self._echoes.popleft()
        for angle_rad, distance_m in zip(self._sensors_rad, distances_m, strict=False):
            if distance_m < self._reach_m:
                at_rad = self._heading_rad + angle_rad
                x_m, y_m = self._x_m + distance_m * cos(at_rad), self._y_m + distance_m * sin(at_rad)
                self._echoes.append(_Echo(time_s, x_m, y_m))

    def nearest_m(self, course_rad: float, within_rad: float) -> float:
        """Distance to the nearest point within an angle of a course left of the heading; infinite without one."""
        found = inf
        for echo in self._echoes:
            dx_m, dy_m = echo.x_m - self._x_m, echo.y_m - self._y_m
            distance_m = hypot(dx_m, dy_m)
            if distance_m < found:
                off_rad = wrap_pi(atan2(dy_m, dx_m) - self._heading_rad - course_rad)
                if abs(off_rad) <= within_rad:
                    found = distance_m
        return found

    def behind_m(self, course_rad: float, within_rad: float) -> float:
        """The same, opposite to the course."""
        return self.nearest_m(course_rad + pi, within_rad)
