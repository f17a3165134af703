"""Pure. The cheapest sequence of turns and straight legs through given places: dynamic programming along the order."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import hypot, pi
from typing import NamedTuple

from ccatp.angles import bearing, difference
from ccatp.config.models import LimitsConfig
from ccatp.planning.bound import leg_time, turn_time
from ccatp.planning.legs import LegRules
from ccatp.planning.stance import Place

# What a stop costs beyond the bang-bang time of its legs: the servo's lag and settling.
STOP_S = 0.15
# Of two ways that cost the same take the one driven forward.
_REVERSE_S = 0.01
# What a way may cost more on which no sensor runs along a seam, by ``Grazing``. Met, such an edge costs ten seconds; of
# those beside the way few are met. Those along it are met again and again, until the robot waits for an operator.
_GRAZING_S = (0.0, 3.0, 60.0)


class Target(NamedTuple):
    """A place to be reached, and the places near it where the robot may turn before and after."""

    place: Place
    retreats: tuple[Place, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """The robot has arrived at a place by the cheapest way that ends with this leg.

    Attributes:
        place: where it is.
        course_rad: what it faces, as a direction in the deck plane.
        cost_s: time so far.
        reverse: the leg was driven backwards.
        before: the arrival before; ``None`` at the start.
    """

    place: Place
    course_rad: float
    cost_s: float
    reverse: bool = False
    before: "Arrival | None" = None

    def path(self) -> list["Arrival"]:
        """The arrivals on the way here, the start left out."""
        path = []
        arrival = self
        while arrival.before is not None:
            path.append(arrival)
            arrival = arrival.before
        return path[::-1]


Frontier = dict[Place, list[Arrival]]


class Search:
    """Finds the way through targets in their order.

    Between two targets the robot may drive straight on, turn at a retreat of the first or of the second or of both,
    and has to drive around stepped corners; each leg forward or in reverse.

    Args:
        rules: which legs are allowed.
        limits: motion limits.
    """

    def __init__(self, rules: LegRules, limits: LimitsConfig) -> None:
        """Keep the rules."""
        self._rules, self._limits = rules, limits

    def advance(self, arrivals: Sequence[Arrival], retreats: tuple[Place, ...], target: Target) -> list[Arrival]:
        """All sensible ways on from one place to the next target; none where there is no way.

        Args:
            arrivals: ways to the present place.
            retreats: places near it where the robot may turn.
            target: where to go.
        """
        here = arrivals[0].place
        frontier: Frontier = {here: list(arrivals)}
        frontier |= self._extend(frontier, retreats)
        elbows = self._rules.elbows(frontier, (target.place, *target.retreats))
        if elbows:
            frontier = _merged(frontier, self._extend(frontier, elbows))
        around = frontier
        for corner in self._rules.way_around(here, target.place):
            around = self._extend(around, (corner,))
        if around is not frontier:
            frontier = _merged(frontier, around)
        frontier = _merged(frontier, self._extend(frontier, target.retreats))
        return self._extend(frontier, (target.place,)).get(target.place, [])

    def _extend(self, frontier: Frontier, targets: Iterable[Place]) -> Frontier:
        """One leg further: for each target, each place it is reached from and each direction the cheapest way."""
        reached: Frontier = {}
        for target in targets:
            ways = [way for source, arrivals in frontier.items() for way in self._legs(source, arrivals, target)]
            if ways:
                reached[target] = ways
        return reached

    def _legs(self, source: Place, arrivals: list[Arrival], target: Place) -> Iterator[Arrival]:
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
                yield Arrival(target, course, total_s, reverse, arrival)

    def _cheapest_turn(self, place: Place, arrivals: list[Arrival], course: float) -> tuple[float, Arrival] | None:
        best: tuple[float, Arrival] | None = None
        for arrival in arrivals:
            cost_s = arrival.cost_s + turn_time(difference(course, arrival.course_rad), self._limits)
            if (best is None or cost_s < best[0]) and place.can_turn(arrival.course_rad, course):
                best = cost_s, arrival
        return best


def _merged(a: Frontier, b: Frontier) -> Frontier:
    return {place: [*a.get(place, ()), *b.get(place, ())] for place in (a | b)}
