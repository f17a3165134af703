"""Pure. The radio that moves: at random or along waypoints, at a steady speed, inside the room."""

from collections.abc import Sequence
from math import atan2, cos, hypot, pi, sin, sqrt

import numpy as np

from ccatp.config.radio_models import SimObstacleConfig, SimTargetConfig

Point = tuple[float, float]


class MovingTarget:
    """A point that moves.

    At random: its course is a random walk, turned back by walls and obstacles as light is by mirrors. Along waypoints:
    straight from one to the next, from the last to the first, through whatever stands there.

    Args:
        cfg: motion, start, speed.
        size_m: the room.
        obstacles: in it.
        rng: of the course.
    """

    def __init__(
        self, cfg: SimTargetConfig, size_m: Point, obstacles: Sequence[SimObstacleConfig], rng: np.random.Generator
    ) -> None:
        self._cfg = cfg
        self._obstacles = obstacles
        self._size_m = size_m
        self._rng = rng
        self._course_rad = rng.uniform(-pi, pi)
        self._next = 0
        self.position_m: Point = (cfg.x_m, cfg.y_m)

    def step(self, interval_s: float) -> None:
        """Move on for an interval, s."""
        if self._cfg.motion == "random":
            self._wander(interval_s)
        elif self._cfg.motion == "waypoints" and self._cfg.waypoints_m:
            self._walk(self._cfg.speed_m_s * interval_s)

    def approach(self, place_m: Point, travel_m: float) -> None:
        """Go straight at a place, so far."""
        dx_m, dy_m = place_m[0] - self.position_m[0], place_m[1] - self.position_m[1]
        share = min(1.0, travel_m / max(hypot(dx_m, dy_m), 1e-9))
        self.position_m = (self.position_m[0] + share * dx_m, self.position_m[1] + share * dy_m)

    def _wander(self, interval_s: float) -> None:
        self._course_rad += self._cfg.turn_sigma_rad_sqrt_s * sqrt(interval_s) * self._rng.standard_normal()
        travel_m = self._cfg.speed_m_s * interval_s
        x_m = self.position_m[0] + travel_m * cos(self._course_rad)
        y_m = self.position_m[1] + travel_m * sin(self._course_rad)
        if not 0.0 <= x_m <= self._size_m[0]:
            x_m, self._course_rad = _folded(x_m, self._size_m[0]), pi - self._course_rad
        if not 0.0 <= y_m <= self._size_m[1]:
            y_m, self._course_rad = _folded(y_m, self._size_m[1]), -self._course_rad
        self.position_m = self._turned_back(x_m, y_m)

    def _turned_back(self, x_m: float, y_m: float) -> Point:
        """Out of an obstacle that a step would lead into, with the course mirrored at its surface."""
        for obstacle in self._obstacles:
            dx_m, dy_m = x_m - obstacle.x_m, y_m - obstacle.y_m
            distance_m = hypot(dx_m, dy_m)
            if 0.0 < distance_m < obstacle.radius_m:
                normal_rad = atan2(dy_m, dx_m)
                self._course_rad = 2.0 * normal_rad + pi - self._course_rad
                x_m = obstacle.x_m + obstacle.radius_m * cos(normal_rad)
                y_m = obstacle.y_m + obstacle.radius_m * sin(normal_rad)
        return x_m, y_m

    def _walk(self, travel_m: float) -> None:
        for _ in range(len(self._cfg.waypoints_m) + 1):
            goal = self._cfg.waypoints_m[self._next]
            dx_m, dy_m = goal[0] - self.position_m[0], goal[1] - self.position_m[1]
            left_m = hypot(dx_m, dy_m)
            if left_m > travel_m:
                course_rad = atan2(dy_m, dx_m)
                self.position_m = (
                    self.position_m[0] + travel_m * cos(course_rad),
                    self.position_m[1] + travel_m * sin(course_rad),
                )
                return
            self.position_m, travel_m = goal, travel_m - left_m
            self._next = (self._next + 1) % len(self._cfg.waypoints_m)


def _folded(value_m: float, size_m: float) -> float:
    return max(0.0, min(size_m, -value_m if value_m < 0.0 else 2.0 * size_m - value_m))
