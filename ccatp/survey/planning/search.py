"""The cheapest sequence of turns and straight legs through given places, by dynamic programming; bang-bang times."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import dist, hypot, pi, sqrt

from ccatp.config.models import LimitsConfig
from ccatp.core import DeckPose, Stop
from ccatp.kinematics import bearing, difference
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.legs import LegPlace, LegRules, heading_of_course

# A leg whose bearing differs less than this from the heading needs no turn in place, as control.straight_tolerance_rad.
# The points of a row, projected on the curved surface, lie on a straight line to 10 mrad.
STRAIGHT_RAD = 0.05


def bang_bang_time(distance: float, v_max: float, a_max: float) -> float:
    """Least time from rest to rest, s: ``2 sqrt(d/a)`` for d < v^2/a, else ``d/v + v/a``; d > 0 or < 0."""
    length = abs(distance)
    if length * a_max < v_max * v_max:
        return 2.0 * sqrt(length / a_max)
    return length / v_max + v_max / a_max


def leg_time(length_m: float, limits: LimitsConfig) -> float:
    """Bang-bang time of a straight leg, s."""
    return bang_bang_time(length_m, limits.v_max_m_s, limits.a_max_m_s2)


def turn_time(angle_rad: float, limits: LimitsConfig, straight_rad: float = STRAIGHT_RAD) -> float:
    """Bang-bang time of a turn in place, s; 0 for less than ``straight_rad``, which is steered on the way."""
    if abs(angle_rad) <= straight_rad:
        return 0.0
    return bang_bang_time(angle_rad, limits.omega_max_rad_s, limits.alpha_max_rad_s2)


def stop_times(stops: Sequence[Stop], start: DeckPose, limits: LimitsConfig, mirror: Mirror) -> list[float]:
    """Bang-bang time from each stop's predecessor to the stop, s; turns in the tangent plane there, the short way."""
    times = []
    x, y, heading = start.x_m, start.y_m, start.heading_rad
    for stop, length_m in zip(stops, leg_lengths(stops, start, mirror), strict=True):
        time_s = leg_time(length_m, limits)
        if length_m > 0.0:
            course = bearing(stop.x_m - x, stop.y_m - y) + (pi if stop.reverse else 0.0)
            time_s += turn_time(difference(heading_of_course(mirror, x, y, course), heading), limits)
            heading = heading_of_course(mirror, stop.x_m, stop.y_m, course)
        x, y = stop.x_m, stop.y_m
        if stop.heading_rad is not None:
            time_s += turn_time(difference(stop.heading_rad, heading), limits)
            heading = stop.heading_rad
        times.append(time_s)
    return times


def path_time(
    stops: Sequence[Stop], start: DeckPose, limits: LimitsConfig, mirror: Mirror, measuring_time_s: float
) -> float:
    """Least time to drive a path from a deck pose, rest to rest, and to measure at its measurement points, s."""
    measurements = sum(stop.is_measured for stop in stops)
    return sum(stop_times(stops, start, limits, mirror)) + measurements * measuring_time_s


def leg_lengths(stops: Sequence[Stop], start: DeckPose, mirror: Mirror) -> list[float]:
    """Length of the leg to each stop on the surface, m, as a chord: short of the arc by less than 0.1 mm in a metre."""
    first = mirror.surface_point(start.x_m, start.y_m)
    points = [first, *(mirror.surface_point(stop.x_m, stop.y_m) for stop in stops)]
    return [dist(a, b) for a, b in pairwise(points)]


# Cost of a stop in addition to the bang-bang time of its legs: lag of the servo and settling.
STOP_S = 0.15
# Of two ways with the same cost, the one driven forward is taken.
_REVERSE_S = 0.01
# Cost of a leg on which a sensor runs along a seam, by ``Grazing``. A seam taken for an edge costs ten seconds. Beside
# the track this is rare; along the track it repeats until the robot waits for an operator.
_GRAZING_S = (0.0, 3.0, 60.0)


@dataclass(frozen=True, slots=True, eq=False)
class SearchNode:
    """The cheapest arrival at a place with this leg, facing ``course_rad``; ``before``: None at the start."""

    place: LegPlace
    course_rad: float
    cost_s: float
    reverse: bool = False
    before: "SearchNode | None" = None

    def path(self) -> list["SearchNode"]:
        """The arrivals on the way to this one, without the start."""
        path = []
        arrival = self
        while arrival.before is not None:
            path.append(arrival)
            arrival = arrival.before
        return path[::-1]


Frontier = dict[LegPlace, list[SearchNode]]


class Search:
    """Finds the way through targets in their order, each leg forward or in reverse.

    Between two targets the robot may drive straight, or turn at a turning place of the first, the second or both. It
    drives around stepped corners.
    """

    def __init__(self, rules: LegRules, limits: LimitsConfig) -> None:
        self._rules, self._limits = rules, limits

    def advance(
        self,
        arrivals: Sequence[SearchNode],
        turning_places: tuple[LegPlace, ...],
        target: LegPlace,
        target_turning_places: tuple[LegPlace, ...] = (),
    ) -> list[SearchNode]:
        """Arrivals at the next target over the places to turn near either end; empty if there is no way."""
        here = arrivals[0].place
        frontier: Frontier = {here: list(arrivals)}
        frontier |= self._extend(frontier, turning_places)
        elbows = self._rules.elbows(frontier, (target, *target_turning_places))
        frontier = _merged(frontier, self._extend(frontier, elbows))
        around = frontier
        for corner in self._rules.way_around(here, target):
            around = self._extend(around, (corner,))
        if around is not frontier:
            frontier = _merged(frontier, around)
        frontier = _merged(frontier, self._extend(frontier, target_turning_places))
        return self._extend(frontier, (target,)).get(target, [])

    def _extend(self, frontier: Frontier, targets: Iterable[LegPlace]) -> Frontier:
        reached: Frontier = {}
        for target in targets:
            ways = [way for source, arrivals in frontier.items() for way in self._legs(source, arrivals, target)]
            if ways:
                reached[target] = ways
        return reached

    def _legs(self, source: LegPlace, arrivals: list[SearchNode], target: LegPlace) -> Iterator[SearchNode]:
        dx, dy = target.x_m - source.x_m, target.y_m - source.y_m
        clearance_m = self._rules.clearance_m(source, target)
        if not self._rules.is_enough(clearance_m):
            return
        cost_s = leg_time(hypot(dx, dy), self._limits) + STOP_S
        for reverse in (False, True):
            course = bearing(dx, dy) + (pi if reverse else 0.0)
            if not target.can_face(course):
                continue
            best = self._cheapest_turn(source, arrivals, course)
            if best is not None and self._rules.are_sensors_clear(source, target, course, clearance_m):
                turned_s, arrival = best
                total_s = turned_s + cost_s + (_REVERSE_S if reverse else 0.0)
                total_s += _GRAZING_S[self._rules.grazing(source, target, course)]
                yield SearchNode(target, course, total_s, reverse, arrival)

    def _cheapest_turn(
        self, place: LegPlace, arrivals: list[SearchNode], course: float
    ) -> tuple[float, SearchNode] | None:
        best: tuple[float, SearchNode] | None = None
        for arrival in arrivals:
            cost_s = arrival.cost_s + turn_time(difference(course, arrival.course_rad), self._limits)
            if (best is None or cost_s < best[0]) and place.can_turn(arrival.course_rad, course):
                best = cost_s, arrival
        return best


def _merged(a: Frontier, b: Frontier) -> Frontier:
    return {place: [*a.get(place, ()), *b.get(place, ())] for place in (a | b)}
