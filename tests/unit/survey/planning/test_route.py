"""Pure. Stops between the points, remaining time, refusals."""

from itertools import pairwise
from math import atan2, hypot
from typing import Any

import numpy as np
import pytest

from ccatp.core import DeckPose, PanelId, PointId, Stop, StopKind
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.legs import (
    Grazing,
    LegPlace,
    LegRules,
    OutsideMirrorError,
    PlanError,
    UnreachablePointError,
    build_body,
    build_places,
)
from ccatp.survey.planning.route import (
    NOMINAL_LIMITS,
    Route,
    RoutePlanner,
    fastest_serpentine,
    optimised_order,
    panel_order,
    serpentines,
    thesis_order,
)
from ccatp.survey.planning.search import Search, SearchNode, path_time
from tests.support.scenario import mirror_of, world_of


def plan(world: Any, points: list[PointId], **options: Any) -> Route:
    return RoutePlanner(world.mirror, world.cfg).route(world.mirror.base_pose, points, **options)


def with_clearances(world: Any, **clearances: float) -> RoutePlanner:
    mission = world.cfg.mission.model_copy(update=clearances)
    return RoutePlanner(world.mirror, world.cfg.model_copy(update={"mission": mission}))


def bare(world: Any, points: list[PointId]) -> tuple[Stop, ...]:
    return tuple(Stop(x, y, StopKind.MEASURE) for x, y in map(world.mirror.point_on_deck, points))


def test_whole_surveys_fit_into_the_hour(world: Any) -> None:
    points = thesis_order(world.mirror)
    route = plan(world, points)
    straight_s = path_time(bare(world, points), world.mirror.base_pose, world.cfg.limits, world.mirror, 0.5)
    settled_s = route.remaining_s(0) + 0.15 * len(route.stops)  # the servo's lag and settling, each stop
    assert settled_s < world.cfg.run.budget_s
    # Measured: 1.020 to 1.041. On the ways around corners no sensor runs along a seam.
    assert straight_s < route.remaining_s(0) < 1.045 * straight_s


def test_ways_home_are_not_longer_than_their_estimate(world: Any) -> None:
    """Battery, budget and the report of an unattended fault use it."""
    mirror, planner = world.mirror, RoutePlanner(world.mirror, world.cfg)
    points = [point for panel in mirror.panels for point in mirror.point_ids(panel)]
    for point in points[::29]:
        x_m, y_m = mirror.point_on_deck(point)
        places = [(x_m, y_m), *((stop.x_m, stop.y_m) for stop in planner.home(DeckPose(x_m, y_m, 1.0)))]
        way_m = sum(hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(places))
        assert way_m <= mirror.home_way_m(x_m, y_m) + 0.1, point  # at base the robot turns


def test_start_beyond_the_rim(thesis: Any) -> None:
    with pytest.raises(OutsideMirrorError, match=r"start \(9\.000, 0\.000\) m is 5\.\d+ m beyond the rim of thesis-m1"):
        RoutePlanner(thesis.mirror, thesis.cfg).route(DeckPose(9.0, 0.0, 0.0), [])


def test_points_out_of_reach_may_be_left_out(thesis: Any) -> None:
    mirror, planner = thesis.mirror, with_clearances(thesis, leg_clearance_m=0.13)
    points = thesis_order(mirror, 1)
    lost: list[PointId] = []
    x, y = mirror.point_on_deck(PointId(1, 3, 5))
    start = DeckPose(x, y, 0.0)
    route = planner.route(start, points, (), lost)
    # The panel in the lower left corner: a point is 115 mm from either side of it that is a rim.
    assert sorted(point.point for point in lost) == [1, 2, 3, 4, 7]
    reached = [stop.point for stop in route.stops if stop.point is not None]
    assert reached == [point for point in points if point not in lost]
    # The way is that of a survey of the others alone.
    assert route == planner.route(start, reached)


@pytest.mark.parametrize("clearances", [{"leg_clearance_m": 0.13}, {"turn_clearance_m": 0.04}])
def test_points_too_near_the_rim(clearances: dict[str, float], thesis: Any) -> None:
    points = thesis_order(thesis.mirror, 1)
    with pytest.raises(
        UnreachablePointError, match=r"no safe way to point 1-3-1, 0\.115 m from the rim of thesis-m1"
    ) as e:
        with_clearances(thesis, **clearances).route(thesis.mirror.base_pose, points)
    assert isinstance(e.value, PlanError)
    for name, value in clearances.items():
        assert f"{name} = {value}" in str(e.value)


def test_way_around_several_corners(thesis: Any) -> None:
    mirror, body = thesis.mirror, build_body(thesis.cfg.robot, thesis.cfg.mission)
    rules = LegRules(mirror, body)
    xs, ys = np.array([3.4, 2.2, -3.4, 0.0]), np.array([1.6, 3.2, -1.6, 0.0])
    upper, top, lower, middle = build_places(mirror, body, xs, ys)
    chain = [upper, *rules.way_around(upper, top), top]
    assert len(chain) == 3  # by the elbow, along rows and columns
    assert all(rules.is_clear(a, b) for a, b in pairwise(chain))
    slanted = [lower, *rules.way_around(lower, middle), middle]
    assert len(slanted) == 3  # clear, but at 25 degrees it would lead a sensor along the seams between rows
    assert rules.is_clear(lower, middle)


def test_no_leg_whose_sensors_clip_a_re_entrant_corner(thesis: Any) -> None:
    """Slanting past the corner at 0.1002 m: all sensors are clear at both ends, the right front one is not between."""
    mirror, body = thesis.mirror, build_body(thesis.cfg.robot, thesis.cfg.mission)
    rules = LegRules(mirror, body)
    search = Search(rules, thesis.cfg.limits)
    course = float(np.pi / 4.0)
    along, right = np.array((1.0, 1.0)) / np.sqrt(2.0), np.array((1.0, -1.0)) / np.sqrt(2.0)
    for beside, passes in ((0.0868, False), (0.0960, True)):  # a sensor runs 0.09 m beside the origin, and keeps 5 mm
        end = np.array((2.375, -2.599)) - 0.05 * along - beside * right
        ends = np.stack((end - 0.3 * along, end))
        a, b = build_places(mirror, body, ends[:, 0], ends[:, 1])
        assert rules.is_clear(a, b)
        assert a.can_face(course)
        assert b.can_face(course)
        assert bool(search.advance([SearchNode(a, course, 0.0)], (), b)) == passes


def test_no_sensor_runs_along_a_seam(thesis: Any) -> None:
    """A robot a few millimetres beside its way would take the seam for the rim."""
    body = build_body(thesis.cfg.robot, thesis.cfg.mission)
    rules = LegRules(thesis.mirror, body)
    stops = plan(thesis, thesis_order(thesis.mirror)).stops
    places = build_places(thesis.mirror, body, *np.array([(stop.x_m, stop.y_m) for stop in stops]).T)
    grazing = [
        (stop.x_m, stop.y_m)
        for (a, b), stop in zip(pairwise(places), stops[1:], strict=True)
        if rules.grazing(a, b, atan2(b.y_m - a.y_m, b.x_m - a.x_m))
    ]
    assert grazing == []


@pytest.mark.parametrize(("name", "slanted"), [("thesis-m1", 11), ("fyst-m1", 28), ("fyst-m2", 28)])
def test_no_way_off_the_route_leads_along_a_seam(name: str, slanted: int) -> None:
    """Home from anywhere, or to a point at the other end of the mirror: straight there, a slanted way would."""
    cfg, mirror = world_of(name)
    planner, points = RoutePlanner(mirror, cfg), thesis_order(mirror)
    rules = LegRules(mirror, build_body(cfg.robot, cfg.mission))
    rng, straight, found = np.random.default_rng(1), 0, []
    for k in range(60):
        x, y = next(p for p in rng.uniform(-3.0, 3.0, (99, 2)).tolist() if mirror.rim.signed_distance_m(*p) > 0.2)
        start = DeckPose(x, y, float(rng.uniform(-np.pi, np.pi)))
        if k % 2:
            stops = planner.home(start)
        else:
            point = points[int(rng.integers(len(points)))]
            stops = planner.route(start, [point]).stops
        places = [LegPlace(x, y, 1.0), *(LegPlace(stop.x_m, stop.y_m, 1.0) for stop in stops)]
        for (a, b), stop in zip(pairwise(places), stops, strict=True):
            if (b.x_m, b.y_m) != (a.x_m, a.y_m):
                course = atan2(b.y_m - a.y_m, b.x_m - a.x_m) + (np.pi if stop.reverse else 0.0)
                found.append(rules.grazing(a, b, course))
        a, b = places[0], places[-1]
        straight += rules.grazing(a, b, atan2(b.y_m - a.y_m, b.x_m - a.x_m)) is Grazing.ALONG
    assert straight >= slanted
    assert Grazing.ALONG not in found


@pytest.mark.parametrize(
    ("from_m", "to_m", "grazes"),
    [
        ((-0.34, 0.0), (-0.34, 0.2), Grazing.NONE),  # far beside it: the sensors at -0.25 and -0.43, the seam at -0.34
        ((-0.26, 0.0), (-0.26, 0.2), Grazing.BESIDE),  # the left sensors 10 mm from its middle: the gap begins at 5
        ((-0.25, 0.0), (-0.25, 0.2), Grazing.ALONG),  # the left sensors over it all the way
        ((-0.27, 0.0), (-0.23, 0.2), Grazing.ALONG),  # across it, but so slanted that they stay over it for long
        ((-0.40, 0.0), (-0.28, 0.02), Grazing.NONE),  # straight across
    ],
)
def test_which_legs_graze_a_seam(
    thesis: Any, from_m: tuple[float, float], to_m: tuple[float, float], grazes: Grazing
) -> None:
    body = build_body(thesis.cfg.robot, thesis.cfg.mission)
    rules = LegRules(thesis.mirror, body)
    seam = thesis.mirror.nearest_seam(-0.34, 0.05)
    shift = seam.position_m + 0.34
    a, b = build_places(
        thesis.mirror, body, np.array([from_m[0] + shift, to_m[0] + shift]), np.array([from_m[1], to_m[1]])
    )
    assert seam.axis == "x"
    assert rules.grazing(a, b, atan2(b.y_m - a.y_m, b.x_m - a.x_m)) is grazes


def bends(mirror: Mirror, order: list[PointId]) -> int:
    """Points of an order at which it turns by more than 10 degrees, driven either way."""
    xy = [mirror.point_on_deck(point) for point in order]
    steps = [(bx - ax, by - ay) for (ax, ay), (bx, by) in pairwise(xy)]
    sines = [(ax * by - ay * bx) / hypot(ax, ay) / hypot(bx, by) for (ax, ay), (bx, by) in pairwise(steps)]
    return sum(abs(sine) > 0.17 for sine in sines)


def bare_time(world: Any, order: list[PointId]) -> float:
    stops = [Stop(x, y, StopKind.MEASURE) for x, y in map(world.mirror.point_on_deck, order)]
    return path_time(stops, world.mirror.base_pose, world.cfg.limits, world.mirror, 0.5)


def test_one_straight_run_per_line(world: Any) -> None:
    """27 lines of points lie over 9 rows of panels: two quarter turns from each to the next, and no others."""
    assert bends(world.mirror, optimised_order(world.mirror)) == 2 * 26
    assert bends(world.mirror, thesis_order(world.mirror)) > 250  # four or so on each panel


def test_the_fastest_is_taken(world: Any) -> None:
    points = thesis_order(world.mirror)
    times = [bare_time(world, order) for order in serpentines(points)]
    assert bare_time(world, fastest_serpentine(world.mirror, points, world.cfg.limits)) == min(times)
    assert max(times) > min(times) + 60.0  # the choice counts: from 2 % of a mirror up


def test_nominal_limits_are_the_shipped_ones(world: Any) -> None:
    assert world.cfg.limits == NOMINAL_LIMITS


def test_negative_number_of_panels(thesis: Any) -> None:
    with pytest.raises(ValueError, match=r"panels = -1: .* 0 \(= all\)"):
        optimised_order(thesis.mirror, -1)


@pytest.mark.parametrize(
    ("panel", "numbers"),
    [
        (PanelId(3, 5), (1, 2, 3, 6, 5, 4, 7, 8, 9)),  # order 1: odd row, odd column
        (PanelId(3, 6), (7, 8, 9, 6, 5, 4, 1, 2, 3)),  # order 4: odd row, even column
        (PanelId(4, 5), (3, 2, 1, 4, 5, 6, 9, 8, 7)),  # order 2: even row, odd column
        (PanelId(4, 6), (9, 8, 7, 4, 5, 6, 3, 2, 1)),  # order 3: even row, even column
    ],
)
def test_orders_of_table_3_1(panel: PanelId, numbers: tuple[int, ...], thesis: Any) -> None:
    assert panel_order(panel) == numbers
    order = [point.point for point in thesis_order(thesis.mirror) if point.panel == panel]
    assert tuple(order) == numbers


def test_first_panels() -> None:
    mirror = mirror_of()
    assert thesis_order(mirror, 3) == thesis_order(mirror)[:27]
    assert thesis_order(mirror, 1000) == thesis_order(mirror)
