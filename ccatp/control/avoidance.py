"""Pure. Going round obstacles: a short memory of what the distance sensors saw; the free heading nearest to the aim."""

from collections import deque
from collections.abc import Iterator, Sequence
from math import asin, cos, hypot, inf, pi, sin, tau
from typing import NamedTuple

from ccatp.angles import bearing, wrap_pi
from ccatp.config.radio_models import AvoidanceConfig
from ccatp.control.waypoint_steering import Aim, PlanarPose, Point

_AHEAD_RAD = pi / 3.0  # what lies within this of the course is in the way of the body


class _Echo(NamedTuple):
    time_s: float
    x_m: float
    y_m: float


class Way(NamedTuple):
    """What the obstacles leave of an aim.

    Attributes:
        aim: changed where something stands in the way.
        speed_factor: 1 far from everything, 0 where nothing but standing is safe.
        is_blocked: no heading is free.
        nearest_m: distance to the nearest obstacle that is remembered; infinite without one.
    """

    aim: Aim
    speed_factor: float
    is_blocked: bool
    nearest_m: float


class ObstacleAvoider:
    """Chooses the free heading nearest to the aim, after Borenstein and Koren's vector field histogram (1991).

    Echoes are kept as points in the room for a while, because a few sensors look past what stands between them. A point
    at distance d blocks the headings within asin((radius + margin) / d) of its own. Of the free ones that heading is
    taken whose distance from the aim, and a tenth of that from straight ahead, is least: that keeps to one side.

    Args:
        cfg: sensors and distances.
        radius_m: of the circle round the vehicle's body.
    """

    def __init__(self, cfg: AvoidanceConfig, radius_m: float) -> None:
        self._cfg = cfg
        self._reach_m = radius_m + cfg.margin_m
        self._echoes: deque[_Echo] = deque()

    def see(self, time_s: float, pose: PlanarPose, distances_m: Sequence[float]) -> None:
        """Remember what the sensors show, and forget what is old.

        Args:
            time_s: now.
            pose: x m, y m, heading rad.
            distances_m: in the order of the configured sensors.
        """
        while self._echoes and time_s - self._echoes[0].time_s > self._cfg.memory_s:
            self._echoes.popleft()
        for direction_rad, distance_m in zip(self._cfg.sensors_rad, distances_m, strict=True):
            if distance_m < min(self._cfg.range_max_m, 2.0 * self._cfg.influence_m):
                course_rad = pose[2] + direction_rad
                self._echoes.append(
                    _Echo(time_s, pose[0] + distance_m * cos(course_rad), pose[1] + distance_m * sin(course_rad))
                )

    def way(self, pose: PlanarPose, aim: Aim) -> Way:
        """What is left of an aim at a pose."""
        near = list(self._near(pose))
        nearest_m = min((distance_m for distance_m, _ in near), default=inf)
        # What stands behind the aim is not in the way to it.
        near = [echo for echo in near if echo[0] - self._reach_m < aim.distance_m]
        blocked = [(wrap_pi(angle_rad), asin(min(1.0, self._reach_m / max(d, 1e-6)))) for d, angle_rad in near]
        error_rad = self._free_heading(aim.error_rad, blocked)
        if error_rad is None:
            return Way(aim, 0.0, True, nearest_m)
        return Way(Aim(aim.distance_m, error_rad), self._speed_factor(near), False, nearest_m)

    def clear_m(self, pose: PlanarPose, direction_rad: float) -> float:
        """Distance to the nearest remembered obstacle in the way of a body that moves in a direction, m.

        Args:
            pose: x m, y m, heading rad.
            direction_rad: of the motion, left of the heading: 0 forwards, pi backwards.
        """
        in_way = (d for d, angle_rad in self._near(pose) if abs(wrap_pi(angle_rad - direction_rad)) < _AHEAD_RAD)
        return min(in_way, default=inf)

    def points_m(self) -> list[Point]:
        """What is remembered, in the room."""
        return [(echo.x_m, echo.y_m) for echo in self._echoes]

    def _near(self, pose: PlanarPose) -> Iterator[tuple[float, float]]:
        for echo in self._echoes:
            dx_m, dy_m = echo.x_m - pose[0], echo.y_m - pose[1]
            distance_m = hypot(dx_m, dy_m)
            if distance_m < self._cfg.influence_m:
                yield distance_m, bearing(dx_m, dy_m) - pose[2]

    def _free_heading(self, wanted_rad: float, blocked: Sequence[tuple[float, float]]) -> float | None:
        def is_free(heading_rad: float) -> bool:
            return all(abs(wrap_pi(heading_rad - at_rad)) >= half_rad for at_rad, half_rad in blocked)

        if is_free(wanted_rad):
            return wanted_rad
        headings = (wrap_pi(k * tau / self._cfg.directions) for k in range(self._cfg.directions))
        free = [heading_rad for heading_rad in headings if is_free(heading_rad)]
        return min(free, key=lambda h: abs(wrap_pi(h - wanted_rad)) + 0.1 * abs(h), default=None)

    def _speed_factor(self, near: Sequence[tuple[float, float]]) -> float:
        """Of what lies ahead: 1 at the edge of influence, 0 at the distance to stop."""
        cfg = self._cfg
        ahead_m = min((d for d, angle_rad in near if abs(wrap_pi(angle_rad)) < _AHEAD_RAD), default=cfg.influence_m)
        return max(0.0, min(1.0, (ahead_m - cfg.stop_m) / (cfg.influence_m - cfg.stop_m)))
