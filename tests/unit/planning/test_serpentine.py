"""Pure. Whole lines across the panels, and which of the eight serpentines is taken."""

from itertools import pairwise
from math import hypot
from typing import Any

import pytest

from ccatp.config.models import LimitsConfig
from ccatp.core import PointId, Stop, StopKind
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.route import (
    NOMINAL_LIMITS,
    ORDERS,
    fastest_serpentine,
    optimised_order,
    plan_route,
    serpentines,
    thesis_order,
)
from ccatp.survey.planning.search import path_time

LONGEST_STEP_M = 0.27  # neighbours on one line are 220 to 254 mm apart


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


def test_only_the_ends_of_lines_are_further_apart(world: Any) -> None:
    xy = [world.mirror.point_on_deck(point) for point in optimised_order(world.mirror)]
    lengths = [hypot(bx - ax, by - ay) for (ax, ay), (bx, by) in pairwise(xy)]
    assert sum(length > LONGEST_STEP_M for length in lengths) <= 4  # the steps of the outline
    assert max(lengths) < 0.8


def test_eight_serpentines_of_one_panel(thesis: Any) -> None:
    found = [tuple(point.point for point in order) for order in serpentines(thesis_order(thesis.mirror, 1))]
    assert found == [
        (1, 2, 3, 6, 5, 4, 7, 8, 9),
        (3, 2, 1, 4, 5, 6, 9, 8, 7),
        (7, 8, 9, 6, 5, 4, 1, 2, 3),
        (9, 8, 7, 4, 5, 6, 3, 2, 1),
        (1, 4, 7, 8, 5, 2, 3, 6, 9),
        (7, 4, 1, 2, 5, 8, 9, 6, 3),
        (3, 6, 9, 8, 5, 2, 1, 4, 7),
        (9, 6, 3, 2, 5, 8, 7, 4, 1),
    ]


def test_the_fastest_is_taken(world: Any) -> None:
    points = thesis_order(world.mirror)
    times = [bare_time(world, order) for order in serpentines(points)]
    assert bare_time(world, fastest_serpentine(world.mirror, points, world.cfg.limits)) == min(times)
    assert max(times) > min(times) + 60.0  # the choice counts: from 2 % of a mirror up


def test_a_robot_that_turns_slowly_takes_the_longer_lines(thesis: Any) -> None:
    """Two panels side by side: three lines of six points, or six of three."""
    slow = LimitsConfig(v_max_m_s=0.1, a_max_m_s2=0.2, omega_max_rad_s=0.05, alpha_max_rad_s2=2.0)
    points = thesis_order(thesis.mirror, 2)
    order = fastest_serpentine(thesis.mirror, points, slow)
    assert bends(thesis.mirror, order) == 4  # three rows; along the columns there would be ten
    assert fastest_serpentine(thesis.mirror, [], slow) == []


def test_the_order_of_the_points_given_does_not_matter(thesis: Any) -> None:
    points = thesis_order(thesis.mirror, 12)
    expected = fastest_serpentine(thesis.mirror, points, NOMINAL_LIMITS)
    assert fastest_serpentine(thesis.mirror, points[::-1], NOMINAL_LIMITS) == expected
    assert ORDERS["optimised"](thesis.mirror, 12) == expected


def test_nominal_limits_are_the_shipped_ones(world: Any) -> None:
    assert world.cfg.limits == NOMINAL_LIMITS


def test_negative_number_of_panels(thesis: Any) -> None:
    with pytest.raises(ValueError, match=r"panels = -1: .* 0 \(= all\)"):
        optimised_order(thesis.mirror, -1)


def test_few_stops_on_the_way(world: Any) -> None:
    """At most two at each change of line, and one on the way into the mirror; long legs left whole."""
    cfg, mirror = world.cfg, world.mirror
    mission = cfg.mission.model_copy(update={"longest_leg_m": 2.0})
    route = plan_route(mirror, optimised_order(mirror), cfg.robot, cfg.limits, mission, mirror.base_pose)
    assert sum(stop.kind is StopKind.VIA for stop in route.stops) <= 2 * 26 + 1
    # In reverse it leaves the rim, and at most every third line whole.
    assert sum(stop.reverse for stop in route.stops) < len(route.stops) / 3
