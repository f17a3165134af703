"""Pure. Bang-bang times against closed forms, integration and the thesis's mirror."""

from math import pi, sqrt
from typing import Any

import pytest

from ccatp.control.pid import Profile
from ccatp.core import DeckPose, Stop, StopKind
from ccatp.survey.planning.route import thesis_order
from ccatp.survey.planning.search import (
    STRAIGHT_RAD,
    bang_bang_time,
    leg_lengths,
    path_length,
    path_time,
    stop_times,
    turn_time,
)

FLAT = 1e-3  # the patch at the apex of M1 that these tests drive on is flat to 1 mm in a metre


@pytest.mark.parametrize(
    ("distance", "time_s"),
    [
        (0.0, 0.0),
        (0.0125, 2 * sqrt(0.0125 / 0.2)),  # triangle: 0.0125 < v^2/a = 0.05
        (0.05, 1.0),  # the triangle's peak just reaches v: two ramps of v/a
        (0.22, 2.2 + 0.5),  # trapezoid: d/v + v/a
        (-0.22, 2.7),
    ],
)
def test_closed_form(distance: float, time_s: float) -> None:
    assert bang_bang_time(distance, 0.1, 0.2) == pytest.approx(time_s, rel=1e-12)


@pytest.mark.parametrize("distance", [1e-4, 0.03, 0.0499999, 0.0500001, 0.744, 3.0])
def test_agrees_with_the_profile_that_is_driven(distance: float) -> None:
    assert bang_bang_time(distance, 0.1, 0.2) == pytest.approx(
        Profile.rest_to_rest(distance, 0.1, 0.2).duration_s, rel=1e-9
    )


@pytest.mark.parametrize(("v", "a"), [(0.0, 0.2), (0.1, 0.0), (-0.1, 0.2)])
def test_limits_must_be_positive(v: float, a: float) -> None:
    with pytest.raises(ValueError, match=f"limits must be positive, got v_max={v}, a_max={a}"):
        bang_bang_time(1.0, v, a)


def test_small_turns_are_steered_on_the_way(thesis: Any) -> None:
    limits = thesis.cfg.limits
    assert thesis.cfg.control.straight_tolerance_rad == STRAIGHT_RAD == 0.05  # what the tracker does
    assert turn_time(0.0499, limits) == turn_time(-0.0499, limits) == 0.0
    assert turn_time(0.0501, limits) == pytest.approx(2.0 * sqrt(0.0501 / 2.0))
    assert turn_time(-pi / 2.0, limits) == pytest.approx(pi / 2.0 + 0.5)
    assert turn_time(0.02, limits, straight_rad=0.01) == pytest.approx(2.0 * sqrt(0.01))


def test_an_l_with_a_reverse_leg_and_a_final_heading(thesis: Any) -> None:
    start = DeckPose(0.0, 0.0, 0.0)
    stops = (
        Stop(0.3, 0.0, StopKind.MEASURE),
        Stop(0.3, -0.2, StopKind.VIA, reverse=True),  # facing +y: a quarter turn
        Stop(0.3, -0.3, StopKind.MEASURE, reverse=True),  # straight on
        Stop(0.3, -0.4, StopKind.BASE, heading_rad=pi / 2.0),  # facing -y: half a turn, and half a turn at base
    )
    quarter, half = pi / 2.0 + 0.5, pi + 0.5
    times = [3.5, quarter + 2.5, 1.5, half + 1.5 + half]
    mirror, limits = thesis.mirror, thesis.cfg.limits
    assert stop_times(stops, start, limits, mirror) == pytest.approx(times, abs=FLAT)
    assert path_time(stops, start, limits, mirror, 0.5) == pytest.approx(sum(times) + 1.0, abs=4 * FLAT)
    assert path_length(stops, start, mirror) == pytest.approx(0.7, abs=FLAT)


def test_staying_where_one_is_costs_nothing(thesis: Any) -> None:
    stop = Stop(0.5, 0.5, StopKind.VIA)
    assert stop_times((stop,), DeckPose(0.5, 0.5, 2.0), thesis.cfg.limits, thesis.mirror) == [0.0]
    assert path_time((), DeckPose(0.5, 0.5, 2.0), thesis.cfg.limits, thesis.mirror, 0.5) == 0.0


def test_legs_are_measured_on_the_surface(thesis: Any) -> None:
    mirror = thesis.mirror
    a, b = (2.4, 0.0), (2.7, 0.0)
    rise = mirror.surface.height_m(*b) - mirror.surface.height_m(*a)
    length = leg_lengths((Stop(*b, StopKind.VIA),), DeckPose(*a, 0.0), mirror)[0]
    assert length == pytest.approx(sqrt(0.3**2 + rise**2), rel=1e-12)
    assert length > 0.3 + 5e-5  # a slope of 0.04 adds a thousandth


def test_no_tour_through_the_points_beats_the_bound_of_its_legs(world: Any) -> None:
    mirror, limits = world.mirror, world.cfg.limits
    points = thesis_order(mirror, 9)
    bare = tuple(Stop(x, y, StopKind.MEASURE) for x, y in map(mirror.point_on_deck, points))
    time_s = path_time(bare, mirror.base_pose, limits, mirror, 0.5)
    assert time_s >= path_length(bare, mirror.base_pose, mirror) / limits.v_max_m_s + 0.5 * len(points)
