"""The first move away from the rim, places to turn near a point at the rim, and the calibration drive at base."""

from collections.abc import Sequence
from math import ceil, cos, hypot, pi, sin

import numpy as np

from ccatp.config.models import LimitsConfig, MissionConfig
from ccatp.core import DeckPose, FloatArray, Stop, StopKind
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.legs import (
    Footprint,
    LegPlace,
    UnreachablePointError,
    course_of_heading,
    room_m,
    sensor_depths,
)
from ccatp.survey.planning.search import SearchNode, leg_time, turn_time

# At 0.1 m from the rim the robot has room for 7 deg, and 3 to 5 deg lead it away: the steps must be finer than these.
_TURNS_RAD = np.radians(np.arange(-180, 181))
_NO_TURN = len(_TURNS_RAD) // 2
# Straight away from the rim, or out of a corner, 0.2 m are enough. Beside the rim, with room for 3 deg, it takes 0.6 m.
_DISTANCES_M = np.r_[0:601:20] * 1e-3
# Between two turns a sensor at 0.13 m is at most 0.13 (1 - cos(0.5 deg)) = 5 um further out than at them.
_BETWEEN_TURNS_M = 5e-6
_ROUNDING_M = 1e-6
_MILLIMETRE_M = 1e-3


def find_escape(mirror: Mirror, body: Footprint, start: SearchNode, limits: LimitsConfig) -> SearchNode:
    """The best single turn and straight leg, forward or in reverse, to a place where the robot can turn freely.

    It brings no sensor nearer to the rim than ``turn_clearance_m``, or than it is already. If every motion does so, the
    one that brings a sensor least near is best. Otherwise the fastest is best, and then the smallest turn. Raises
    ``UnreachablePointError`` if there is no such place within 0.6 m.
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
    best: tuple[int, float, float, SearchNode] | None = None
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
        place = LegPlace(float(xs[turn, way, step]), float(ys[turn, way, step]), float(depths[turn, way, step]))
        # The leg never leads outward, not even past a re-entrant corner.
        if mirror.rim.segment_clearance_m(x0, y0, place.x_m, place.y_m) >= start.place.depth_m - _ROUNDING_M:
            best = deficit_mm, cost_s, turn_rad, SearchNode(place, float(courses[turn]), cost_s, way == 1, start)
    if best is None:
        raise UnreachablePointError(
            f"no place to turn within 0.6 m of ({x0:.3f}, {y0:.3f}) m, {start.place.depth_m:.3f} m from the rim of "
            f"{mirror.name}"
        )
    return best[3]


def _swept(at_turn: FloatArray) -> FloatArray:
    """Least sensor depth during a turn in place to each of ``_TURNS_RAD``, m; ``at_turn``: depth at each of them."""
    left = np.minimum.accumulate(at_turn[_NO_TURN:])
    right = np.minimum.accumulate(at_turn[_NO_TURN::-1])
    return np.concatenate((right[:0:-1], left))


_AWAY_M = np.r_[20:100:5, 100:301:10] * 1e-3
_SLANTS_RAD = np.radians([0, 2, -2, 4, -4, 6, -6, 8, -8, 10, -10, 12, -12, 14, -14])
_COURSES_RAD = np.radians([0, 90, 180, 270])[:, None] + _SLANTS_RAD  # (sides, slants)


def find_turning_places(mirror: Mirror, body: Footprint, places: list[LegPlace]) -> list[tuple[LegPlace, ...]]:
    """For each place where the robot cannot turn freely, the nearest places around it where it can; else none.

    At most one in each direction of the grid of panels, straight or slightly slanted (for a place in a corner, or to
    move off along the rim).
    """
    near = [k for k, place in enumerate(places) if place.blocked is not None]
    x0 = np.array([places[k].x_m for k in near]).reshape(-1, 1, 1, 1)
    y0 = np.array([places[k].y_m for k in near]).reshape(-1, 1, 1, 1)
    depths = mirror.rim.signed_distances_m(
        x0 + _AWAY_M * np.cos(_COURSES_RAD)[..., None], y0 + _AWAY_M * np.sin(_COURSES_RAD)[..., None]
    )
    found: list[tuple[LegPlace, ...]] = [()] * len(places)
    for k, sides in zip(near, depths, strict=True):
        nearest = [_nearest(places[k], body, *side) for side in zip(sides, _COURSES_RAD, strict=True)]
        found[k] = tuple(place for place in nearest if place is not None)
    return found


def _nearest(place: LegPlace, body: Footprint, depths: FloatArray, courses_rad: FloatArray) -> LegPlace | None:
    faced = np.array([place.can_face(course) or place.can_face(course + pi) for course in courses_rad.tolist()])
    is_good = (depths >= body.turning_depth_m) & faced[:, None] & (body.shortest_move_m <= _AWAY_M)
    if not is_good.any():
        return None
    step = int(np.argmax(is_good.any(axis=0)))
    slant = int(np.argmax(is_good[:, step]))
    distance_m, course = float(_AWAY_M[step]), float(courses_rad[slant])
    return LegPlace(
        place.x_m + distance_m * cos(course), place.y_m + distance_m * sin(course), float(depths[slant, step])
    )


_SHORTEST_M = 0.08  # a shorter leg calibrates too little for the time it takes
_STEP_M = 0.02
_BESIDE_M = 0.03  # largest distance from its line at which a drive can continue


def plan_calibration(mirror: Mirror, body: Footprint, mission: MissionConfig, base: DeckPose) -> tuple[Stop, ...]:
    """Rounds of four legs between base and a place behind or before it; they end at base with the heading of the start.

    The robot drives forth and back along a line twice, with opposite headings. A wrong heading shifts the two ends
    against each other, creep shifts both downhill, slip shortens both legs, and the two half turns separate the errors
    of wheel base and gyroscope. So these errors are known before the first leg of the survey. A second round shows
    whether slip and creep are constant. Without room there are no stops.
    """
    depth_m = max(body.turning_depth_m, mission.leg_clearance_m)
    course, home = course_of_heading(mirror, base), (base.x_m, base.y_m)
    if mirror.rim.signed_distance_m(*home) < depth_m:
        return ()
    for is_reverse in (True, False):
        sign = -1.0 if is_reverse else 1.0
        cx, cy = sign * cos(course), sign * sin(course)
        way_m = room_m(mirror.rim, base, (cx, cy), mission.calibration_length_m, _STEP_M, depth_m)
        if way_m >= _SHORTEST_M:
            away = base.x_m + way_m * cx, base.y_m + way_m * cy
            legs = (away, is_reverse), (home, not is_reverse), (away, not is_reverse), (home, not is_reverse)
            drive = tuple(Stop(x, y, StopKind.CALIBRATE, reverse=reverse) for (x, y), reverse in legs)
            return drive * mission.calibration_rounds
    return ()


def is_on_drive(stops: Sequence[Stop], x_m: float, y_m: float) -> bool:
    """Whether a deck place lies on the line of a calibration drive, so that the drive can continue there."""
    ends = dict.fromkeys((stop.x_m, stop.y_m) for stop in stops if stop.kind is StopKind.CALIBRATE)
    if len(ends) != 2:
        return False
    (ax, ay), (bx, by) = ends
    dx, dy = bx - ax, by - ay
    share = min(max(((x_m - ax) * dx + (y_m - ay) * dy) / (dx * dx + dy * dy), 0.0), 1.0)
    return hypot(x_m - ax - share * dx, y_m - ay - share * dy) <= _BESIDE_M
