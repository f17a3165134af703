"""Pure. What the robot can face and where it can turn, at the rim."""

from itertools import pairwise
from math import asin, degrees, hypot, pi, radians, sqrt
from typing import Any

import numpy as np
import pytest

from ccatp.core import DeckPose, PanelId, PointId, Stop, StopKind, difference
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.escape import find_retreats
from ccatp.survey.planning.legs import (
    Body,
    LegPlace,
    Stance,
    build_body,
    build_places,
    course_of_heading,
    heading_of_course,
    in_parts,
    sensor_depths,
)


def body_of(world: Any) -> Body:
    return build_body(world.cfg.robot, world.cfg.mission)


def place(mirror: Mirror, body: Body, x: float, y: float) -> LegPlace:
    return build_places(mirror, body, np.array([x]), np.array([y]))[0]


def at(mirror: Mirror, body: Body, point: PointId) -> LegPlace:
    return place(mirror, body, *mirror.point_on_deck(point))


def test_body(thesis: Any) -> None:
    body = body_of(thesis)
    assert body.reach_m == pytest.approx(0.09 * sqrt(2.0))
    assert body.turning_depth_m == pytest.approx(0.1273 + 0.005 + 0.001, abs=1e-4)  # reach rounded to 0.1 mm


def test_sensor_depths_are_those_of_the_mirror(thesis: Any) -> None:
    mirror, body = thesis.mirror, body_of(thesis)
    pose = DeckPose(3.6, 0.4, 0.3)
    hx, hy, _, _ = mirror.body_axes(pose)
    expected = min(
        mirror.rim.signed_distance_m(*mirror.body_offset(pose, ox, oy)) for ox, oy in thesis.cfg.robot.edge_sensors_m
    )
    depths = sensor_depths(mirror, body, np.array(3.6), np.array(0.4), np.array(np.arctan2(hy, hx)))
    assert float(depths) == pytest.approx(expected, abs=1e-12)


def test_a_place_far_from_the_rim_has_no_limits(thesis: Any) -> None:
    inner = place(thesis.mirror, body_of(thesis), 0.1, 0.2)
    assert inner.stance is None
    assert inner.can_face(0.7)
    assert inner.can_turn(0.0, 3.1)


@pytest.mark.parametrize("k", range(4))
def test_headings_at_115_mm_lie_around_multiples_of_90_degrees(k: int, thesis: Any) -> None:
    """0.09 (cos a + sin a) = 0.115 - 0.005 gives a = 14.8 degrees."""
    limit = degrees(asin(0.110 / 0.09 / sqrt(2.0))) - 45.0
    spot = at(thesis.mirror, body_of(thesis), PointId(5, 11, 6))
    assert spot.depth_m == pytest.approx(0.115, abs=5e-4)  # dropped along the panel's normal
    for sign in (-1.0, 1.0):
        assert spot.can_face(radians(90.0 * k + sign * (limit - 2.0)))  # bins of 1 degree, 0.5 mm of 115
        assert not spot.can_face(radians(90.0 * k + sign * (limit + 2.0)))
        assert spot.can_turn(radians(90.0 * k - 10.0), radians(90.0 * k + 10.0))
        assert not spot.can_turn(radians(90.0 * k), radians(90.0 * (k + sign)))
        assert not spot.can_turn(radians(90.0 * k), radians(90.0 * k + 180.0))


def test_half_a_turn_needs_room_on_both_sides() -> None:
    free = np.ones(360, dtype=np.bool_)
    free[90] = False
    stance = Stance(free)
    assert stance.can_turn(0.0, radians(-170.0))
    assert not stance.can_turn(0.0, radians(170.0))
    assert not stance.can_turn(0.0, radians(-176.0))  # the noise of the heading may take it through 90 degrees
    assert not stance.can_turn(radians(-176.0), 0.0)
    assert not stance.can_turn(0.0, pi)


def test_turns_across_north_and_many_turns_around() -> None:
    free = np.zeros(360, dtype=np.bool_)
    free[350:] = free[:11] = True
    stance = Stance(free)
    for turns in (-3, 0, 5):
        offset = 2.0 * pi * turns
        assert stance.can_turn(radians(351.5) + offset, radians(8.5))
        assert stance.can_turn(radians(8.5), radians(-8.5) + offset)
        assert not stance.can_turn(radians(8.5), radians(12.0) + offset)
        assert not stance.can_face(radians(180.0) + offset)


def test_retreats_allow_turning_and_are_straight_moves_the_place_allows(world: Any) -> None:
    mirror, body = world.mirror, body_of(world)
    points = [point for panel in mirror.panels for point in mirror.point_ids(panel)]
    xy = np.array([mirror.point_on_deck(point) for point in points])
    places = build_places(mirror, body, xy[:, 0], xy[:, 1])
    retreats = find_retreats(mirror, body, places)
    assert len(retreats) == len(points)
    for spot, around in zip(places, retreats, strict=True):
        assert bool(around) == (spot.stance is not None)
        for retreat in around:
            dx, dy = retreat.x_m - spot.x_m, retreat.y_m - spot.y_m
            assert 0.0199 < hypot(dx, dy) < 0.301
            assert retreat.depth_m >= body.turning_depth_m
            course = float(np.arctan2(dy, dx))
            assert spot.can_face(course) or spot.can_face(course + pi)


def test_retreat_at_a_straight_rim_leads_straight_inward(thesis: Any) -> None:
    mirror, body = thesis.mirror, body_of(thesis)
    spot = at(mirror, body, PointId(5, 11, 6))
    inward = [(r.x_m - spot.x_m, r.y_m - spot.y_m) for r in find_retreats(mirror, body, [spot])[0]]
    assert any(dx == pytest.approx(-0.02) and dy == pytest.approx(0.0, abs=1e-12) for dx, dy in inward)


def test_retreat_in_a_corner_is_slanted(thesis: Any) -> None:
    mirror, body = thesis.mirror, body_of(thesis)
    assert PanelId(1, 3) in mirror.panels
    spot = at(mirror, body, PointId(1, 3, 1))
    moves = [(r.x_m - spot.x_m, r.y_m - spot.y_m) for r in find_retreats(mirror, body, [spot])[0]]
    assert moves
    assert all(dx > 0.015 and dy > 0.01 for dx, dy in moves)  # 133 mm are needed, 115 and 122 there


def test_no_retreat_where_there_is_none(small: Any) -> None:
    mirror, body = small.mirror, body_of(small)
    assert find_retreats(mirror, body, [place(mirror, body, mirror.base_pose.x_m, mirror.base_pose.y_m)]) == [()]


ROUNDING = 1e-12


@pytest.mark.parametrize("heading", [-3.1, -1.0, 0.0, 0.5, pi / 2.0, 2.0])
def test_there_and_back(heading: float, world: Any) -> None:
    course = course_of_heading(world.mirror, DeckPose(1.5, -2.0, heading))
    assert difference(heading_of_course(world.mirror, 1.5, -2.0, course), heading) == pytest.approx(0.0, abs=ROUNDING)


def test_along_x_both_are_the_same(world: Any) -> None:
    assert heading_of_course(world.mirror, 1.5, -2.0, 0.0) == pytest.approx(0.0, abs=ROUNDING)


def test_they_differ_where_the_mirror_slopes_both_ways(world: Any) -> None:
    mirror = world.mirror
    fx, fy = mirror.surface.gradient(2.0, 2.0)
    # The tangents of the lines x = const and y = const are fx fy off a right angle, to first order.
    assert heading_of_course(mirror, 2.0, 2.0, pi / 2.0) == pytest.approx(pi / 2.0 - fx * fy, abs=2e-5)


STOP = Stop(0.7, 0.0, StopKind.MEASURE, PointId(1, 2, 3), True)


def test_a_short_leg_stays_whole() -> None:
    assert in_parts(0.35, 0.0, STOP, 0.36) == [STOP]
    assert in_parts(0.7, 0.0, STOP, 0.36) == [STOP]


@pytest.mark.parametrize("longest_m", [0.36, 0.2, 0.05])
def test_a_long_leg_has_equal_parts_in_the_same_direction(longest_m: float) -> None:
    parts = in_parts(0.0, 0.1, STOP, longest_m)
    assert parts[-1] is STOP
    assert all((part.kind, part.point, part.reverse) == (StopKind.VIA, None, True) for part in parts[:-1])
    places = [(0.0, 0.1), *((part.x_m, part.y_m) for part in parts)]
    lengths = [hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(places)]
    assert max(lengths) <= longest_m < 2.0 * max(lengths)
    assert max(lengths) - min(lengths) < 1e-12
    assert sum(lengths) == pytest.approx(hypot(0.7, 0.1))
