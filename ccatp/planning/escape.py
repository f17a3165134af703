"""Pure. The first move away from the rim, from wherever the robot happens to stand and whatever it faces."""

from math import ceil, pi

import numpy as np

from ccatp.config.models import LimitsConfig
from ccatp.mirror.mirror import Mirror
from ccatp.planning.bound import leg_time, turn_time
from ccatp.planning.errors import UnreachableError
from ccatp.planning.search import Arrival
from ccatp.planning.stance import Body, FloatArray, Place, sensor_depths

_TURNS_RAD = np.radians(np.arange(-180, 181, 2))
_NO_TURN = len(_TURNS_RAD) // 2
# Further it would creep along the rim; straight away from it, or out of a corner, 0.2 m are enough.
_DISTANCES_M = np.r_[0:401:10] * 1e-3
# Half way between two turns a sensor at 0.13 m is at most 0.13 (1 - cos(1 deg)) = 20 um further out than in them.
_BETWEEN_TURNS_M = 2e-5
_ROUNDING_M = 1e-6
_MILLIMETRE_M = 1e-3


def find_escape(mirror: Mirror, body: Body, start: Arrival, limits: LimitsConfig) -> Arrival:
    """The best single turn and straight leg, forward or in reverse, to a place where the robot can turn freely.

    Best is what brings no sensor nearer to the rim than ``turn_clearance_m``, or than it is already; of those the
    fastest, with the smallest turn. Where a sensor has to come nearer, the one that brings it least far.

    Args:
        mirror: the mirror.
        body: the robot and its clearances.
        start: place on the mirror and what the robot faces there.
        limits: motion limits.

    Raises:
        UnreachableError: if there is no such place within 0.4 m.
    """
    x0, y0 = start.place.x_m, start.place.y_m
    courses = start.course_rad + _TURNS_RAD
    ways = np.stack((courses, courses + pi), axis=1)  # forward, in reverse; shape (turns, 2)
    xs = x0 + _DISTANCES_M * np.cos(ways)[..., None]
    ys = y0 + _DISTANCES_M * np.sin(ways)[..., None]
    depths = mirror.rim.signed_distances_m(xs, ys)
    sensors = sensor_depths(mirror, body, xs, ys, courses[:, None, None])
    least_sensors = np.minimum(np.minimum.accumulate(sensors, axis=2), _swept(sensors[:, 0, 0])[:, None, None])
    allowed_m = min(body.turn_clearance_m + _BETWEEN_TURNS_M, float(sensors[_NO_TURN, 0, 0])) - _ROUNDING_M
    best: tuple[int, float, float, Arrival] | None = None
    for turn, way in np.ndindex(ways.shape):
        free = depths[turn, way] >= body.turning_depth_m
        step = int(np.argmax(free))
        if not free[step]:
            continue
        deficit_mm = ceil(max(allowed_m - float(least_sensors[turn, way, step]), 0.0) / _MILLIMETRE_M)
        turn_rad = abs(float(_TURNS_RAD[turn]))
        cost_s = turn_time(turn_rad, limits) + leg_time(float(_DISTANCES_M[step]), limits)
        if best is not None and (deficit_mm, cost_s, turn_rad) >= best[:3]:
            continue
        place = Place(float(xs[turn, way, step]), float(ys[turn, way, step]), float(depths[turn, way, step]))
        # Never outward, not even past a re-entrant corner.
        if mirror.rim.segment_clearance_m(x0, y0, place.x_m, place.y_m) >= start.place.depth_m - _ROUNDING_M:
            best = deficit_mm, cost_s, turn_rad, Arrival(place, float(courses[turn]), cost_s, way == 1, start)
    if best is None:
        raise UnreachableError(
            f"no place to turn within 0.4 m of ({x0:.3f}, {y0:.3f}) m, {start.place.depth_m:.3f} m from the rim of "
            f"{mirror.name}"
        )
    return best[3]


def _swept(at_turn: FloatArray) -> FloatArray:
    """Least sensor depth during a turn in place to each of ``_TURNS_RAD``, given that at each of them, m."""
    left = np.minimum.accumulate(at_turn[_NO_TURN:])
    right = np.minimum.accumulate(at_turn[_NO_TURN::-1])
    return np.concatenate((right[:0:-1], left))
