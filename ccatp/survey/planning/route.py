"""The route of a survey: the order of the measurement points, and the stops from each to the next."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, chain, groupby
from math import ceil, hypot

import numpy as np

from ccatp.config.models import FOUR_STATE, Config, LimitsConfig
from ccatp.core import DeckPose, PanelId, PointId, Stop, StopKind
from ccatp.kinematics import difference
from ccatp.mirror.layout import POINTS_PER_ROW
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.escape import find_escape, find_turning_places, plan_calibration
from ccatp.survey.planning.legs import (
    LegPlace,
    LegRules,
    OutsideMirrorError,
    UnreachablePointError,
    build_body,
    build_places,
    course_of_heading,
)
from ccatp.survey.planning.search import Search, SearchNode, path_time, stop_times, turn_time

_REPLANNED_POINTS = 4  # least number of points planned again before the old route continues
_LONGEST_LEG_HOME_M = 0.75  # about one stop per panel, at which the robot turns to base again


@dataclass(frozen=True, slots=True)
class Route:
    """The stops of a survey, with the least time from before stop k to the end, s, shape (stops + 1,)."""

    stops: tuple[Stop, ...]
    times_s: tuple[float, ...]

    def remaining_s(self, index: int) -> float:
        """Least remaining time while stop ``index`` is being approached, s; 0 after the last."""
        return self.times_s[min(index, len(self.stops))]


class RoutePlanner:
    """Plans the routes of a survey on a mirror.

    The robot turns in place and moves straight, forward or in reverse. On every leg its origin keeps
    ``leg_clearance_m`` from the rim, and all its edge sensors keep ``turn_clearance_m``, also in turns. Where the
    thesis's straight way does not, stops are inserted.
    """

    def __init__(self, mirror: Mirror, cfg: Config) -> None:
        self._mirror, self._limits, self._mission = mirror, cfg.limits, cfg.mission
        self._measuring_s = cfg.etalon.measuring_time_s
        self._body = build_body(cfg.robot, cfg.mission)
        self._search = Search(LegRules(mirror, self._body), cfg.limits)

    def route(
        self,
        start: DeckPose,
        points: Sequence[PointId],
        skip: Collection[PointId] = (),
        out_of_reach: list[PointId] | None = None,
    ) -> Route:
        """The fastest drivable sequence of stops through the points from a deck pose.

        Raises ``OutsideMirrorError`` (start). An unreachable point raises ``UnreachablePointError``, or is added to
        ``out_of_reach``.
        """
        left = set(points).difference(skip)
        wanted = [point for point in points if point in left]
        return self._timed(self._stops(wanted, start, out_of_reach), start)

    def rejoin(self, route: Route, start: DeckPose, skip: Collection[PointId]) -> Route:
        """Plan the next points of a route again from a deck pose; the rest stays as it was. Raises as ``route``.

        Planning a whole mirror takes too long within a frame. The new part ends at a point where the robot can turn
        freely, so that the course of its arrival does not matter.
        """
        left = [k for k, stop in enumerate(route.stops) if stop.point is not None and stop.point not in skip]
        free = (
            n
            for n, k in enumerate(left)
            if n >= _REPLANNED_POINTS
            and self._mirror.rim.signed_distance_m(route.stops[k].x_m, route.stops[k].y_m) >= self._body.turning_depth_m
        )
        count = next(free, len(left) - 1) + 1
        points = [point for k in left[:count] if (point := route.stops[k].point) is not None]
        return _followed(self.route(start, points), route, left[count - 1] + 1 if left else len(route.stops))

    def with_calibration(self, route: Route) -> Route:
        """A route from base, with the calibration drive before it."""
        base = self._mirror.base_pose
        return _followed(self._timed(plan_calibration(self._mirror, self._body, self._mission, base), base), route, 0)

    def home(self, start: DeckPose, base: DeckPose | None = None) -> tuple[Stop, ...]:
        """Stops from a deck pose anywhere on the mirror to base; the last is base itself, with its heading.

        Near the rim the first leg leads straight away from it, forward or in reverse, to a place where the robot can
        turn. From there legs and turns keep the clearances of a survey. Raises ``OutsideMirrorError`` (start), and
        ``UnreachablePointError`` if the clearances allow no way to base.
        """
        base = base or self._mirror.base_pose
        places, first = self._places(start, [(base.x_m, base.y_m)])
        goal, course = places[1], course_of_heading(self._mirror, base)
        arrivals = self._search.advance([first], (), goal, self._turning_places(places)[1])
        if not arrivals:
            raise self._unreachable(f"base at ({base.x_m:.3f}, {base.y_m:.3f}) m", goal)

        def rank(arrival: SearchNode) -> tuple[bool, float]:
            """Prefer an arrival with a safe turn to the final course; then the cheapest, with that turn."""
            turned_s = turn_time(difference(course, arrival.course_rad), self._limits)
            return not arrival.place.can_turn(arrival.course_rad, course), arrival.cost_s + turned_s

        path = min(arrivals, key=rank).path()
        ends = [Stop(a.place.x_m, a.place.y_m, StopKind.VIA, None, a.reverse) for a in path[:-1]]
        ends.append(Stop(base.x_m, base.y_m, StopKind.BASE, None, path[-1].reverse, base.heading_rad))
        return in_parts((start.x_m, start.y_m), ends, _LONGEST_LEG_HOME_M)

    def _places(self, start: DeckPose, targets: list[tuple[float, float]]) -> tuple[list[LegPlace], SearchNode]:
        """Places of start and targets, and the first node: the start, or the end of its escape from the rim."""
        mirror, body = self._mirror, self._body
        xy = np.array([(start.x_m, start.y_m), *targets])
        places = build_places(mirror, body, xy[:, 0], xy[:, 1])
        if not places[0].depth_m > 0.0:
            where, beyond_m = f"({start.x_m:.3f}, {start.y_m:.3f}) m", -places[0].depth_m
            raise OutsideMirrorError(f"start {where} is {beyond_m:.3f} m beyond the rim of {mirror.name}")
        first = SearchNode(places[0], course_of_heading(mirror, start), 0.0)
        return places, first if places[0].blocked is None else find_escape(mirror, body, first, self._limits)

    def _turning_places(self, places: list[LegPlace]) -> list[tuple[LegPlace, ...]]:
        """Places to turn near each place; none for the start, which has its escape from the rim."""
        return [(), *find_turning_places(self._mirror, self._body, places[1:])]

    def _unreachable(self, what: str, place: LegPlace) -> UnreachablePointError:
        mission = self._mission
        return UnreachablePointError(
            f"mission: no safe way to {what}, {place.depth_m:.3f} m from the rim of {self._mirror.name}, with "
            f"leg_clearance_m = {mission.leg_clearance_m} and turn_clearance_m = {mission.turn_clearance_m}"
        )

    def _stops(self, points: list[PointId], start: DeckPose, out_of_reach: list[PointId] | None) -> tuple[Stop, ...]:
        places, first = self._places(start, [self._mirror.point_on_deck(point) for point in points])
        turning_places = self._turning_places(places)
        arrivals, before = [first], 0
        for k, point in enumerate(points, start=1):
            found = self._search.advance(arrivals, turning_places[before], places[k], turning_places[k])
            if found:
                arrivals, before = found, k
            elif out_of_reach is not None:
                out_of_reach.append(point)
            else:
                raise self._unreachable(f"point {point.row}-{point.col}-{point.point}", places[k])
        point_of = dict(zip(places[1:], points, strict=True))
        ends = []
        for arrival in min(arrivals, key=lambda arrival: arrival.cost_s).path():
            place, point_there = arrival.place, point_of.get(arrival.place)
            kind = StopKind.VIA if point_there is None else StopKind.MEASURE
            ends.append(Stop(place.x_m, place.y_m, kind, point_there, arrival.reverse))
        # A heading error of 10 mrad gives 10 mm after a metre, so long legs get stops on the way.
        return in_parts((start.x_m, start.y_m), ends, self._mission.longest_leg_m)

    def _timed(self, stops: tuple[Stop, ...], start: DeckPose) -> Route:
        times = [
            time_s + (self._measuring_s if stop.is_measured else 0.0)
            for stop, time_s in zip(stops, stop_times(stops, start, self._limits, self._mirror), strict=True)
        ]
        return Route(stops, tuple(accumulate(reversed(times), initial=0.0))[::-1])


def _followed(head: Route, route: Route, index: int) -> Route:
    """``head``, followed by ``route`` from stop ``index``."""
    rest_s = route.times_s[index]
    times_s = tuple(t + rest_s for t in head.times_s[:-1]) + route.times_s[index:]
    return Route(head.stops + route.stops[index:], times_s)


def in_parts(start: tuple[float, float], ends: Sequence[Stop], longest_m: float) -> tuple[Stop, ...]:
    """The stops with via points inserted, so that the straight legs have equal parts not longer than ``longest_m``."""
    stops: list[Stop] = []
    x_m, y_m = start
    for end in ends:
        dx, dy = end.x_m - x_m, end.y_m - y_m
        parts = max(1, ceil(hypot(dx, dy) / longest_m))
        for k in range(1, parts):
            stops.append(Stop(x_m + dx * k / parts, y_m + dy * k / parts, StopKind.VIA, reverse=end.reverse))
        stops.append(end)
        x_m, y_m = end.x_m, end.y_m
    return tuple(stops)


def fastest_serpentine(mirror: Mirror, points: Sequence[PointId], limits: LimitsConfig) -> list[PointId]:
    """The points line by line, every second line backwards: the fastest from base of all eight such orders.

    The robot turns only at the ends of the lines, by quarter turns. The least times of the straight legs, with turns,
    are compared; of equal ones the first of ``serpentines`` is taken.
    """
    return min(serpentines(points), key=lambda order: _straight_time(mirror, order, limits))


def serpentines(points: Sequence[PointId]) -> Iterator[list[PointId]]:
    """All eight serpentines: along the rows and along the columns, from each of the four corners."""
    for split in (_on_row, _on_column):
        # Line, and place within the line, both counted over the whole grid of panels.
        by_line = groupby(sorted(points, key=split), key=lambda point: split(point)[0])
        lines = [list(line) for _, line in by_line]
        for stacked in (lines, lines[::-1]):
            for odd in (0, 1):
                turned = (line[::-1] if k % 2 != odd else line for k, line in enumerate(stacked))
                yield list(chain.from_iterable(turned))


def _on_row(point: PointId) -> tuple[int, int]:
    upward, along = divmod(point.point - 1, POINTS_PER_ROW)
    return point.row * POINTS_PER_ROW + upward, point.col * POINTS_PER_ROW + along


def _on_column(point: PointId) -> tuple[int, int]:
    line, place = _on_row(point)
    return place, line


def _straight_time(mirror: Mirror, order: Sequence[PointId], limits: LimitsConfig) -> float:
    stops = [Stop(x, y, StopKind.MEASURE, point) for point in order for x, y in (mirror.point_on_deck(point),)]
    return path_time(stops, mirror.base_pose, limits, mirror, 0.0)


# From mirror and number of panels (0 = all). It depends on nothing else, so that a resumed mission and its summary get
# the same order.
Order = Callable[[Mirror, int], list[PointId]]

# Limits by which orders are compared: the speed of the thesis's robot, and the rest of the stand-in (UNVERIFIED). They
# are not the configured ones, so that a resumed survey keeps its order whatever its limits are.
NOMINAL_LIMITS = LimitsConfig(v_max_m_s=0.1, a_max_m_s2=0.2, omega_max_rad_s=1.0, alpha_max_rad_s2=2.0)

# Points 1 to 9 are numbered row by row from the panel's lower left (thesis fig. 2.2). Each order is a serpentine over
# the three rows of points; it begins on the side on which the robot enters the panel.
PANEL_ORDERS: dict[int, tuple[int, ...]] = {
    1: (1, 2, 3, 6, 5, 4, 7, 8, 9),  # lower left to upper right
    2: (3, 2, 1, 4, 5, 6, 9, 8, 7),  # lower right to upper left
    3: (9, 8, 7, 4, 5, 6, 3, 2, 1),  # upper right to lower left
    4: (7, 8, 9, 6, 5, 4, 1, 2, 3),  # upper left to lower right
}

# Thesis table 3.1, keyed by (row mod 2, column mod 2), both counted from 1 over the mirror's whole grid.
ORDER_BY_PARITY: dict[tuple[int, int], int] = {(1, 1): 1, (1, 0): 4, (0, 1): 2, (0, 0): 3}


def panel_order(panel: PanelId) -> tuple[int, ...]:
    """Numbers of the nine points of a panel in the order of thesis table 3.1."""
    return PANEL_ORDERS[ORDER_BY_PARITY[panel.row % 2, panel.col % 2]]


def thesis_order(mirror: Mirror, panels: int = 0) -> list[PointId]:
    """Points in the order of the thesis (table 3.1, fig. 3.2): panel by panel, odd rows towards +column, even back.

    ``panels``: number of panels, 0 = all; raises ``ValueError`` if negative.
    """
    if panels < 0:
        raise ValueError(f"panels = {panels}: a survey takes 0 (= all) or more panels")
    serpentine = sorted(mirror.panels, key=lambda p: (p.row, p.col if p.row % 2 else -p.col))
    chosen = serpentine[:panels] if panels else serpentine
    return [PointId(panel.row, panel.col, number) for panel in chosen for number in panel_order(panel)]


def optimised_order(mirror: Mirror, panels: int = 0, limits: LimitsConfig = NOMINAL_LIMITS) -> list[PointId]:
    """The same points in lines across all panels, see ``fastest_serpentine``; raises as ``thesis_order``."""
    return fastest_serpentine(mirror, thesis_order(mirror, panels), limits)


def no_points(mirror: Mirror, panels: int = 0) -> list[PointId]:
    """No points, for a run that consists of the calibration drive alone."""
    del mirror, panels
    return []


ORDERS: dict[str, Order] = {"thesis": thesis_order, "optimised": optimised_order, "calibration": no_points}


def plan_survey(
    cfg: Config,
    mirror: Mirror,
    points: Sequence[PointId],
    done: Collection[PointId] = (),
    out_of_reach: list[PointId] | None = None,
    *,
    calibrates: bool = True,
) -> Route:
    """The route of a survey from base, with the calibration drive first if the localizer uses one.

    Points that cannot be reached are added to ``out_of_reach``; without this list they raise ``PlanError``, as does a
    base that is not on the mirror.
    """
    planner = RoutePlanner(mirror, cfg)
    route = planner.route(mirror.base_pose, points, done, out_of_reach)
    # The four-state localizer has no parameters to calibrate.
    return planner.with_calibration(route) if calibrates and cfg.run.filter not in FOUR_STATE else route
