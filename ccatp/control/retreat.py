"""Pure. Getting away from what comes near without touching what stands about: the best of a fan of short arcs."""

from collections.abc import Iterator, Sequence
from math import cos, hypot, inf, pi, sin, tau
from typing import NamedTuple

from ccatp.angles import wrap_pi
from ccatp.config.radio_models import RadioConfig
from ccatp.control.waypoint_steering import HALT, Drive, PlanarPose, Point

_STEPS = 6  # of an arc, where distances are looked at
_CURVES = (0.0, -0.3, 0.3, -0.6, 0.6, -1.0, 1.0)  # shares of the largest steering
_COURSES = 24  # of a vehicle that turns on the spot
_TURN_S = 1.0  # it turns by what is left in that time ...
_STRAIGHT_RAD = 0.3  # ... and goes when less is left
_KEEPING = 0.03  # metres that an arc in the direction of the last one may gain less than another


class _Arc(NamedTuple):
    drive: Drive
    places: list[Point]


class Retreat:
    """A dynamic window over arcs forwards and backwards (Fox, Burgard, Thrun 1997).

    Of a vehicle that turns on the spot over courses, each after its turn. One is possible if the vehicle stays in the
    room, and keeps ``avoidance.stop_m`` from everything that the sensors have seen or, where it is nearer already, does
    not come nearer. Of these it takes the one after which the threat, going on as it goes, is farthest; where none
    gains anything it stands.

    Args:
        cfg: vehicle, workspace, follow and avoidance are used.
    """

    def __init__(self, cfg: RadioConfig) -> None:
        self._cfg = cfg
        self._last = 0.0

    def drive(
        self, pose: PlanarPose, threat_m: Point, threat_velocity_m_s: Point, obstacles_m: Sequence[Point]
    ) -> Drive:
        """Set points for the next interval.

        Args:
            pose: x m, y m, heading rad.
            threat_m: where it is.
            threat_velocity_m_s: how it moves.
            obstacles_m: points in the room that the sensors have seen.
        """
        horizon_s = self._cfg.follow.retreat_s
        vx, vy = threat_velocity_m_s
        path = [(threat_m[0] + vx * t_s, threat_m[1] + vy * t_s) for t_s in _times_s(horizon_s)]
        best, gain_m = HALT, _far(pose[:2], path[-1])
        for arc in self._arcs(pose, horizon_s):
            if not self._is_free(pose[:2], arc.places, obstacles_m):
                continue
            far_m = _far(arc.places[-1], path[-1])
            if arc.drive.speed_m_s * self._last > 0.0:
                far_m += _KEEPING
            if far_m > gain_m:
                best, gain_m = arc.drive, far_m
        self._last = best.speed_m_s
        return best

    def _arcs(self, pose: PlanarPose, horizon_s: float) -> Iterator[_Arc]:
        speed_m_s = min(self._cfg.follow.back_speed_m_s, self._cfg.vehicle.speed_max_m_s)
        if self._cfg.vehicle.kind == "ackermann":
            for signed_m_s in (-speed_m_s, speed_m_s):
                for curve in _CURVES:
                    drive = Drive(signed_m_s, curve * self._cfg.vehicle.steer_max_rad, 0.0)
                    yield _Arc(drive, self._places(pose, drive, horizon_s))
            return
        for k in range(_COURSES):
            yield self._straight(pose, wrap_pi(pi + k * tau / _COURSES), speed_m_s, horizon_s)

    def _places(self, pose: PlanarPose, drive: Drive, horizon_s: float) -> list[Point]:
        """Along the arc of wheels that steer."""
        x_m, y_m, heading_rad = pose
        interval_s = horizon_s / _STEPS
        turn_rad = interval_s * drive.speed_m_s * sin(drive.steer_rad) / self._cfg.vehicle.wheelbase_m
        places = []
        for _ in range(_STEPS):
            course_rad = heading_rad + 0.5 * turn_rad + drive.steer_rad
            x_m += interval_s * drive.speed_m_s * cos(course_rad)
            y_m += interval_s * drive.speed_m_s * sin(course_rad)
            heading_rad += turn_rad
            places.append((x_m, y_m))
        return places

    def _straight(self, pose: PlanarPose, course_rad: float, speed_m_s: float, horizon_s: float) -> _Arc:
        """A turn on the spot and then straight on, forwards or backwards, by which the turn is less."""
        is_back = abs(course_rad) > pi / 2.0
        error_rad = wrap_pi(course_rad - pi) if is_back else course_rad
        most_rad_s = self._cfg.vehicle.turn_rate_max_rad_s
        delay_s = abs(error_rad) / most_rad_s
        rate_rad_s = max(-most_rad_s, min(most_rad_s, error_rad / _TURN_S))
        goes = abs(error_rad) < _STRAIGHT_RAD
        along_rad = pose[2] + course_rad
        ways_m = [speed_m_s * max(0.0, t_s - delay_s) for t_s in _times_s(horizon_s)]
        places = [(pose[0] + way_m * cos(along_rad), pose[1] + way_m * sin(along_rad)) for way_m in ways_m]
        return _Arc(Drive((-speed_m_s if is_back else speed_m_s) * goes, 0.0, rate_rad_s), places)

    def _is_free(self, start_m: Point, places: Sequence[Point], obstacles_m: Sequence[Point]) -> bool:
        margin_m = self._cfg.avoidance.stop_m
        nearest_m = min((_far(start_m, obstacle) for obstacle in obstacles_m), default=inf)
        for place in places:
            if any(_far(place, obstacle) < min(margin_m, nearest_m) for obstacle in obstacles_m):
                return False
        size = self._cfg.workspace.size_m
        return all(min(0.0, start_m[k]) <= places[-1][k] <= max(size[k], start_m[k]) for k in range(2))


def _times_s(horizon_s: float) -> list[float]:
    return [horizon_s * (k + 1) / _STEPS for k in range(_STEPS)]


def _far(a: Point, b: Point) -> float:
    return hypot(a[0] - b[0], a[1] - b[1])
