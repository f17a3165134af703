"""Pure. The bound on all tours against every tour of a few points, closed forms and the orders of whole mirrors."""

from collections.abc import Sequence
from itertools import pairwise, permutations
from math import pi
from typing import Any

import numpy as np
import pytest

from ccatp.config.models import LimitsConfig
from ccatp.core import DeckPose, PointId, Stop, StopKind, bearing, difference
from ccatp.mirror.mirror import build_mirror
from ccatp.survey.planning.legs import heading_of_course
from ccatp.survey.planning.route import optimised_order, plan_route, thesis_order
from ccatp.survey.planning.search import leg_time, path_time, turn_time
from ccatp.survey.planning.tour_bound import tour_bound

ROUNDING_S = 1e-6  # sums of some thousand terms, at prices of some seconds


def fastest_drive(world: Any, order: Sequence[PointId], limits: LimitsConfig) -> float:
    """Each leg driven forward or in reverse, whichever turn is shorter, timed by ``path_time``."""
    mirror = world.mirror
    x, y, heading = mirror.base_pose.x_m, mirror.base_pose.y_m, mirror.base_pose.heading_rad
    stops = []
    for point in order:
        to_x, to_y = mirror.point_on_deck(point)
        course = bearing(to_x - x, to_y - y)
        reverse = abs(difference(heading_of_course(mirror, x, y, course), heading)) > pi / 2.0
        heading = heading_of_course(mirror, to_x, to_y, course + (pi if reverse else 0.0))
        x, y = to_x, to_y
        stops.append(Stop(x, y, StopKind.MEASURE, point, reverse))
    return path_time(stops, mirror.base_pose, limits, mirror, 0.5)


@pytest.mark.parametrize("seed", range(12))
def test_no_tour_of_a_few_points_beats_it(seed: int, world: Any) -> None:
    """All 120 orders of five points, from far apart to neighbours; slow and fast turns."""
    rng = np.random.default_rng(seed)
    points = thesis_order(world.mirror, 1 + seed)
    chosen = [points[k] for k in rng.choice(len(points), 5, replace=False)]
    limits = world.cfg.limits.model_copy(update={"omega_max_rad_s": float(rng.uniform(0.1, 3.0))})
    bound = tour_bound(world.mirror, chosen, limits, 0.5)
    best = min(fastest_drive(world, order, limits) for order in permutations(chosen))
    assert bound <= best + ROUNDING_S
    assert bound > 0.6 * best  # measured: from 0.7 up; what it lacks are closed rounds that no tour may take


@pytest.mark.parametrize("near", [1, 2, 3])
@pytest.mark.parametrize("seed", range(6))
def test_legs_that_are_not_near_make_it_lower_only(
    seed: int, near: int, thesis: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = thesis_order(thesis.mirror, 1 + seed)
    chosen = [points[k] for k in np.random.default_rng(seed).choice(len(points), 5, replace=False)]
    best = min(fastest_drive(thesis, order, thesis.cfg.limits) for order in permutations(chosen))
    whole = tour_bound(thesis.mirror, chosen, thesis.cfg.limits, 0.5)
    monkeypatch.setattr("ccatp.survey.planning.tour_bound._NEAR", near)
    bound = tour_bound(thesis.mirror, chosen, thesis.cfg.limits, 0.5)
    assert 0.3 * best < bound <= whole + ROUNDING_S <= best + 2.0 * ROUNDING_S


def test_no_tour_of_one_panel_beats_it(thesis: Any) -> None:
    """Nine points have far legs too; the best of many thousand orders comes near."""
    points = thesis_order(thesis.mirror, 1)
    bound = tour_bound(thesis.mirror, points, thesis.cfg.limits, 0.5)
    first, rest = points[0], points[1:7]
    best = min(fastest_drive(thesis, (first, *order, *points[7:]), thesis.cfg.limits) for order in permutations(rest))
    assert 0.85 * best < bound <= best + ROUNDING_S  # measured: 0.88


def test_one_point_exactly(world: Any) -> None:
    mirror, limits = world.mirror, world.cfg.limits
    for point in thesis_order(mirror)[::50]:
        exact = fastest_drive(world, (point,), limits)
        assert tour_bound(mirror, [point], limits, 0.5) == pytest.approx(exact, abs=ROUNDING_S)


def test_two_points_exactly(thesis: Any) -> None:
    """The nearer one first, both legs and the turns at base and at it."""
    near, far = PointId(1, 3, 1), PointId(1, 3, 2)
    exact = min(fastest_drive(thesis, order, thesis.cfg.limits) for order in ((near, far), (far, near)))
    assert tour_bound(thesis.mirror, [far, near], thesis.cfg.limits, 0.5) == pytest.approx(exact, abs=ROUNDING_S)


def test_a_straight_row_is_bounded_exactly(thesis: Any) -> None:
    """Nothing has to be turned for between its ends: all legs but the first are those of the row."""
    row = [PointId(1, col, number) for col in (3, 4) for number in (1, 2, 3)]
    exact = fastest_drive(thesis, row, thesis.cfg.limits)
    assert tour_bound(thesis.mirror, row, thesis.cfg.limits, 0.5) == pytest.approx(exact, abs=1e-3)


def test_turns_at_the_ends_of_lines_count(thesis: Any) -> None:
    """A serpentine needs 52 quarter turns; of at least half of them the bound knows that no tour does without."""
    mirror, limits = thesis.mirror, thesis.cfg.limits
    points = optimised_order(mirror)
    at_once = limits.model_copy(update={"omega_max_rad_s": 5.0, "alpha_max_rad_s2": 20.0})
    quarter_s = turn_time(pi / 2.0, limits) - turn_time(pi / 2.0, at_once)
    more = tour_bound(mirror, points, limits, 0.5) - tour_bound(mirror, points, at_once, 0.5)
    assert 25 * quarter_s < more < 2 * 27 * quarter_s  # measured: 29


def test_measuring_time_counts_per_point(thesis: Any) -> None:
    points = thesis_order(thesis.mirror, 2)
    bound = tour_bound(thesis.mirror, points, thesis.cfg.limits, 0.0)
    assert tour_bound(thesis.mirror, points, thesis.cfg.limits, 2.0) == pytest.approx(bound + 36.0)
    assert tour_bound(thesis.mirror, points[::-1], thesis.cfg.limits, 0.0) == pytest.approx(bound, abs=1e-4)
    assert tour_bound(thesis.mirror, [], thesis.cfg.limits, 2.0) == 0.0


def test_base_on_a_point(thesis: Any) -> None:
    """A leg of no length takes no time and has no direction: neither to turn to from base nor to turn from."""
    mirror = build_mirror(thesis.cfg.mirror)
    points = [PointId(1, 3, 1), PointId(1, 3, 4)]
    (x, y), (_, next_y) = map(mirror.point_on_deck, points)
    mirror.base_pose = DeckPose(x, y, pi / 2.0)
    bound = tour_bound(mirror, points, thesis.cfg.limits, 0.0)
    assert bound == pytest.approx(leg_time(next_y - y, thesis.cfg.limits), abs=0.01)  # a slope of 0.06


def test_whole_mirrors(world: Any) -> None:
    """Planned with all stops on the way: within 6 % of what no tour can beat, and a fifth faster than the thesis's."""
    cfg, mirror = world.cfg, world.mirror
    orders = (thesis_order(mirror), optimised_order(mirror))
    thesis_s, optimised_s = (
        plan_route(mirror, order, cfg.robot, cfg.limits, cfg.mission, mirror.base_pose, (), 0.5).remaining_s(0)
        for order in orders
    )
    bound_s = tour_bound(mirror, orders[0], cfg.limits, 0.5)
    assert bound_s < optimised_s < 1.06 * bound_s  # measured: 1.037 to 1.050
    assert optimised_s < (0.8 if mirror.name == "thesis-m1" else 0.81) * thesis_s  # measured: 0.797 to 0.808
    assert optimised_s < 0.8 * cfg.run.budget_s
    shuffled = np.random.default_rng(1).permutation(len(orders[0])).tolist()
    for order in (*orders, [orders[0][k] for k in shuffled]):
        assert bound_s <= fastest_drive(world, order, cfg.limits)
    legs = [mirror.surface_point(*mirror.point_on_deck(point)) for point in orders[1]]
    shortest_s = min(leg_time(float(np.linalg.norm(np.subtract(a, b))), cfg.limits) for a, b in pairwise(legs))
    assert bound_s > len(legs) * (shortest_s + 0.5)
