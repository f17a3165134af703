"""Pure. The route of a survey: measurement points in their order and the stops that lead from each to the next."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from ccatp.config.models import LimitsConfig, MissionConfig, RobotConfig
from ccatp.mirror.mirror import Mirror
from ccatp.planning.bound import leg_lengths, stop_times
from ccatp.planning.course import course_of_heading
from ccatp.planning.errors import OutsideMirrorError, UnreachableError
from ccatp.planning.escape import find_escape
from ccatp.planning.legs import LegRules
from ccatp.planning.parts import in_parts
from ccatp.planning.retreats import find_retreats
from ccatp.planning.search import Arrival, Search, Target
from ccatp.planning.stance import build_body, build_places
from ccatp.samples import DeckPose, PointId, Stop, StopKind

_REPLANNED_POINTS = 4  # at least, before the old route is joined again


@dataclass(frozen=True, slots=True)
class Route:
    """The stops of a survey.

    Attributes:
        stops: in order; points to measure and stops on the way.
        times_s: least time from before stop k to the end, shape (stops + 1,); the last is 0.
        lengths_m: way from before stop k to the end, likewise.
    """

    stops: tuple[Stop, ...]
    times_s: tuple[float, ...]
    lengths_m: tuple[float, ...]

    def remaining_s(self, index: int) -> float:
        """Least time that is left while stop ``index`` is being approached, s; 0 behind the last."""
        return self.times_s[min(index, len(self.stops))]

    def remaining_m(self, index: int) -> float:
        """Way that is left while stop ``index`` is being approached, m; 0 behind the last."""
        return self.lengths_m[min(index, len(self.stops))]


def plan_route(
    mirror: Mirror,
    points: Sequence[PointId],
    robot: RobotConfig,
    limits: LimitsConfig,
    mission: MissionConfig,
    start: DeckPose,
    skip: Collection[PointId] = (),
    measuring_time_s: float = 0.0,
    out_of_reach: list[PointId] | None = None,
) -> Route:
    """The fastest drivable sequence of stops through the points.

    The robot turns in place and moves straight, forward or in reverse. On every leg its origin keeps
    ``leg_clearance_m`` from the rim and all its edge sensors ``turn_clearance_m``, during turns too; where the thesis's
    straight way does not, stops are put in between.

    Args:
        mirror: the mirror.
        points: what to measure, in order.
        robot, limits, mission: sensors, motion limits, clearances.
        start: pose of the robot, deck frame.
        skip: points already measured.
        measuring_time_s: standstill at each point, for the remaining time only.
        out_of_reach: takes the points that cannot be reached, and the route goes without them.

    Raises:
        OutsideMirrorError: if the start is not on the mirror.
        UnreachableError: if a point cannot be reached with the clearances, and there is no ``out_of_reach``.
    """
    left = set(points).difference(skip)
    wanted = [point for point in points if point in left]
    stops = _stops(mirror, wanted, robot, limits, mission, start, out_of_reach)
    return _with_remains(mirror, stops, limits, start, measuring_time_s)


def with_prelude(
    mirror: Mirror,
    route: Route,
    prelude: tuple[Stop, ...],
    limits: LimitsConfig,
    start: DeckPose,
    measuring_time_s: float = 0.0,
) -> Route:
    """A route with stops before it that lead from its start back to its start."""
    head = _with_remains(mirror, prelude, limits, start, measuring_time_s)
    return Route(
        prelude + route.stops,
        tuple(t + route.times_s[0] for t in head.times_s[:-1]) + route.times_s,
        tuple(t + route.lengths_m[0] for t in head.lengths_m[:-1]) + route.lengths_m,
    )


def plan_rejoin(
    mirror: Mirror,
    route: Route,
    robot: RobotConfig,
    limits: LimitsConfig,
    mission: MissionConfig,
    start: DeckPose,
    skip: Collection[PointId],
    measuring_time_s: float = 0.0,
) -> Route:
    """The way from ``start`` back to a route: its next points planned anew, the rest as it was.

    Planning a whole mirror anew takes longer than the robot's frames may wait. The new part ends at a point where the
    robot can turn freely, so that it does not matter how it arrives there.

    Args:
        mirror: the mirror.
        route: the route that was left.
        robot, limits, mission: sensors, motion limits, clearances.
        start: pose of the robot, deck frame.
        skip: points that are done with.
        measuring_time_s: standstill at each point, for the remaining time only.

    Raises:
        OutsideMirrorError: if the start is not on the mirror.
        UnreachableError: if a point cannot be reached with the clearances.
    """
    body = build_body(robot, mission)
    left = [k for k, stop in enumerate(route.stops) if stop.point is not None and stop.point not in skip]
    free = (
        n
        for n, k in enumerate(left)
        if n >= _REPLANNED_POINTS
        and mirror.rim.signed_distance_m(route.stops[k].x_m, route.stops[k].y_m) >= body.turning_depth_m
    )
    count = next(free, len(left) - 1) + 1
    points = [point for k in left[:count] if (point := route.stops[k].point) is not None]
    head = plan_route(mirror, points, robot, limits, mission, start, (), measuring_time_s)
    rest = left[count - 1] + 1 if left else len(route.stops)
    return Route(
        head.stops + route.stops[rest:],
        tuple(t + route.times_s[rest] for t in head.times_s[:-1]) + route.times_s[rest:],
        tuple(t + route.lengths_m[rest] for t in head.lengths_m[:-1]) + route.lengths_m[rest:],
    )


def _stops(
    mirror: Mirror,
    points: list[PointId],
    robot: RobotConfig,
    limits: LimitsConfig,
    mission: MissionConfig,
    start: DeckPose,
    out_of_reach: list[PointId] | None,
) -> tuple[Stop, ...]:
    body = build_body(robot, mission)
    xy = np.array([(start.x_m, start.y_m), *(mirror.point_on_deck(point) for point in points)])
    places = build_places(mirror, body, xy[:, 0], xy[:, 1])
    if not places[0].depth_m > 0.0:
        raise OutsideMirrorError(
            f"start ({start.x_m:.3f}, {start.y_m:.3f}) m is {-places[0].depth_m:.3f} m beyond the rim of {mirror.name}"
        )
    search = Search(LegRules(mirror, body), limits)
    retreats = find_retreats(mirror, body, places)
    first = Arrival(places[0], course_of_heading(mirror, start), 0.0)
    if places[0].stance is not None:  # too near the rim to turn: away from it first, as on the way home
        first, retreats[0] = find_escape(mirror, body, first, limits), ()
    arrivals, before = [first], 0
    for k, point in enumerate(points, start=1):
        found = search.advance(arrivals, retreats[before], Target(places[k], retreats[k]))
        if found:
            arrivals, before = found, k
        elif out_of_reach is not None:
            out_of_reach.append(point)
        else:
            raise UnreachableError(
                f"mission: no safe way to point {point.row}-{point.col}-{point.point} of {mirror.name}, "
                f"{places[k].depth_m:.3f} m from the rim, with leg_clearance_m = {mission.leg_clearance_m} and "
                f"turn_clearance_m = {mission.turn_clearance_m}"
            )
    point_of = dict(zip(places[1:], points, strict=True))
    best = min(arrivals, key=lambda arrival: arrival.cost_s)
    ends = [
        Stop(
            arrival.place.x_m,
            arrival.place.y_m,
            StopKind.MEASURE if arrival.place in point_of else StopKind.VIA,
            point_of.get(arrival.place),
            arrival.reverse,
        )
        for arrival in best.path()
    ]
    begins = [(start.x_m, start.y_m), *((stop.x_m, stop.y_m) for stop in ends)]
    # A heading that is off by 10 mrad misses by a centimetre after a metre: long legs are looked after on the way.
    return tuple(
        part for begin, end in zip(begins, ends, strict=False) for part in in_parts(*begin, end, mission.longest_leg_m)
    )


def _with_remains(
    mirror: Mirror, stops: tuple[Stop, ...], limits: LimitsConfig, start: DeckPose, measuring_time_s: float
) -> Route:
    times = [
        time_s + (measuring_time_s if stop.kind in (StopKind.MEASURE, StopKind.CALIBRATE) else 0.0)
        for stop, time_s in zip(stops, stop_times(stops, start, limits, mirror), strict=True)
    ]
    return Route(stops, _sums_to_the_end(times), _sums_to_the_end(leg_lengths(stops, start, mirror)))


def _sums_to_the_end(parts: list[float]) -> tuple[float, ...]:
    return tuple(accumulate(reversed(parts), initial=0.0))[::-1]
