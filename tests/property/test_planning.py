"""Pure but for reading the shipped configuration. Every route and every way home, driven by brute force."""

from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from math import atan2, ceil, hypot, pi, radians, tau

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ccatp.config.models import Config
from ccatp.core import DeckPose, Stop, StopKind
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.route import ORDERS, RoutePlanner, thesis_order
from ccatp.survey.planning.search import path_time
from tests.support.cases import slow_case
from tests.support.scenario import config_of, mirror_of

NAMES = ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")
# A primary and a secondary mirror, one of each size; the other two are tried by the slow tests.
ONE_OF_EACH = [slow_case("fyst-m1"), "fyst-m2", "thesis-m1", slow_case("thesis-m2")]
ROUNDING_M = 1e-8  # the rim's segment clearance is exact to 1 nm
# The planner looks along each turn in steps of one degree and allows 10 um for what lies between; so do we.
SWEEP_M = 1e-5

FloatArray = NDArray[np.float64]
mirror_names = st.sampled_from(NAMES)
SURVEYS = sorted(ORDERS.keys() - {"calibration"})  # which has no points
order_names = st.sampled_from(SURVEYS)


@cache
def load(name: str) -> tuple[Config, Mirror]:
    return config_of(name), mirror_of(name)


def sensor_depths(cfg: Config, mirror: Mirror, x: FloatArray, y: FloatArray, course: FloatArray) -> FloatArray:
    """Distance to the rim of the worst sensor, from the tangent plane's own vectors."""
    fx, fy = mirror.surface.gradients(x, y)
    normal = np.stack((-fx, -fy, np.ones_like(fx)), axis=-1)
    ahead = np.stack((np.cos(course), np.sin(course), fx * np.cos(course) + fy * np.sin(course)), axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    left = np.cross(normal, ahead)
    tips = [ox * ahead + oy * left for ox, oy in cfg.robot.edge_sensors_m]
    depths = np.stack([mirror.rim.signed_distances_m(x + t[..., 0], y + t[..., 1]) for t in tips])
    return np.asarray(depths.min(axis=0), dtype=np.float64)


def course_of(mirror: Mirror, pose: DeckPose) -> float:
    hx, hy, _, _ = mirror.body_axes(pose)
    return atan2(hy, hx)


def turn(x: float, y: float, course: float, angle: float) -> FloatArray:
    """A turn in place in steps of at most one degree; poses of shape (n, 3)."""
    n = max(1, ceil(abs(angle) / radians(1.0)))
    return np.stack([np.array((x, y, course + angle * k / n)) for k in range(n + 1)])


def drive(mirror: Mirror, start: DeckPose, stops: Sequence[Stop]) -> list[FloatArray]:
    """All poses (x, y, course) of a path, per stop: turns by one degree, legs by 5 mm."""
    x, y, course = start.x_m, start.y_m, course_of(mirror, start)
    legs = []
    for stop in stops:
        length = hypot(stop.x_m - x, stop.y_m - y)
        wanted = atan2(stop.y_m - y, stop.x_m - x) + (pi if stop.reverse else 0.0)
        angle = (wanted - course + pi) % tau - pi
        poses = [turn(x, y, course, angle)]
        if abs(angle) > radians(176.0):  # which way round is up to the noise
            poses.append(turn(x, y, course, angle - tau if angle > 0.0 else angle + tau))
        s = np.linspace(0.0, 1.0, max(2, ceil(length / 0.005)))
        poses.append(np.stack((x + s * (stop.x_m - x), y + s * (stop.y_m - y), np.full_like(s, wanted)), axis=-1))
        x, y, course = stop.x_m, stop.y_m, wanted
        if stop.heading_rad is not None:
            final = course_of(mirror, DeckPose(x, y, stop.heading_rad))
            poses.append(turn(x, y, course, (final - course + pi) % tau - pi))
        legs.append(np.concatenate(poses))
    return legs


def worst_sensor(cfg: Config, mirror: Mirror, legs: Sequence[FloatArray]) -> float:
    poses = np.concatenate(legs)
    return float(sensor_depths(cfg, mirror, poses[:, 0], poses[:, 1], poses[:, 2]).min())


def least_clearance(mirror: Mirror, start: DeckPose, stops: Sequence[Stop]) -> float:
    ends = [(start.x_m, start.y_m), *((stop.x_m, stop.y_m) for stop in stops)]
    return min(mirror.rim.segment_clearance_m(*a, *b) for a, b in pairwise(ends))


@settings(max_examples=15, deadline=None)
@given(mirror_names, order_names, st.integers(0, 120))
def test_every_point_exactly_once(name: str, order: str, panels: int) -> None:
    _, mirror = load(name)
    points = ORDERS[order](mirror, panels)
    whole = thesis_order(mirror)
    assert len(set(points)) == len(points)
    assert sorted(points) == sorted(whole[: 9 * panels if panels else None])
    assert set(whole) == {point for panel in mirror.panels for point in mirror.point_ids(panel)}


def check_route(cfg: Config, mirror: Mirror, stops: Sequence[Stop]) -> None:
    assert least_clearance(mirror, mirror.base_pose, stops) >= cfg.mission.leg_clearance_m - ROUNDING_M
    assert worst_sensor(cfg, mirror, drive(mirror, mirror.base_pose, stops)) >= cfg.mission.turn_clearance_m - SWEEP_M


@pytest.mark.parametrize("panels", [16, pytest.param(0, marks=pytest.mark.slow, id="whole")])
@pytest.mark.parametrize("order", SURVEYS)
@pytest.mark.parametrize("name", NAMES)
def test_a_survey_stays_on_the_mirror(name: str, order: str, panels: int) -> None:
    cfg, mirror = load(name)
    points = ORDERS[order](mirror, panels)
    route = RoutePlanner(mirror, cfg).route(mirror.base_pose, points)
    check_route(cfg, mirror, route.stops)
    measured = [stop for stop in route.stops if stop.kind is StopKind.MEASURE]
    assert [stop.point for stop in measured] == points
    assert [(stop.x_m, stop.y_m) for stop in measured] == [mirror.point_on_deck(point) for point in points]
    assert all(stop.kind is StopKind.VIA and stop.point is None for stop in route.stops if stop not in measured)


@settings(max_examples=6, deadline=None)
@given(mirror_names, order_names, st.integers(1, 90), st.integers(0, 2**32), st.floats(0.0, 1.0))
def test_any_rest_of_a_survey_stays_on_the_mirror(name: str, order: str, panels: int, seed: int, part: float) -> None:
    cfg, mirror = load(name)
    points = ORDERS[order](mirror, panels)
    is_done = np.random.default_rng(seed).random(len(points)) < part
    skip = {point for point, done in zip(points, is_done, strict=True) if done}
    route = RoutePlanner(mirror, cfg).route(mirror.base_pose, points, skip)
    assert [stop.point for stop in route.stops if stop.point] == [point for point in points if point not in skip]
    if route.stops:
        check_route(cfg, mirror, route.stops)


@settings(max_examples=6, deadline=None)
@given(mirror_names, order_names, st.data())
def test_back_to_a_route_from_anywhere_on_it(name: str, order: str, data: st.DataObject) -> None:
    """Off the route after any of its points, at any heading: the rest is driven safely, each point of it once."""
    cfg, mirror = load(name)
    points = ORDERS[order](mirror, 20)
    route = RoutePlanner(mirror, cfg).route(mirror.base_pose, points)
    done = data.draw(st.integers(0, len(points) - 1))
    # Well inside: how it leaves the rim is the way home's affair.
    inner = [xy for xy in map(mirror.point_on_deck, points) if mirror.rim.signed_distance_m(*xy) > 0.2]
    start = DeckPose(*data.draw(st.sampled_from(inner)), data.draw(st.floats(-7.0, 7.0)))
    back = RoutePlanner(mirror, cfg).rejoin(route, start, set(points[:done]))
    assert [stop.point for stop in back.stops if stop.point] == points[done:]
    assert least_clearance(mirror, start, back.stops) >= cfg.mission.leg_clearance_m - ROUNDING_M
    assert worst_sensor(cfg, mirror, drive(mirror, start, back.stops)) >= cfg.mission.turn_clearance_m - SWEEP_M


def check_way_home(cfg: Config, mirror: Mirror, start: DeckPose) -> None:
    """Every leg clear and every turn safe, but for the first move away from the rim, which only leads inward."""
    base = mirror.base_pose
    stops = RoutePlanner(mirror, cfg).home(start, base)
    assert stops[-1] == Stop(base.x_m, base.y_m, StopKind.BASE, None, stops[-1].reverse, base.heading_rad)
    assert all(stop.kind is StopKind.VIA and stop.heading_rad is None for stop in stops[:-1])
    legs = drive(mirror, start, stops)
    depth = mirror.rim.signed_distance_m(start.x_m, start.y_m)
    if depth < 0.134:  # where a turn in place sweeps a sensor over the rim: 127.3 + 5 mm, and 1 mm to spare
        away = mirror.rim.segment_clearance_m(start.x_m, start.y_m, stops[0].x_m, stops[0].y_m)
        assert away >= depth - 1e-5  # the first leg leads inward
        assert mirror.rim.signed_distance_m(stops[0].x_m, stops[0].y_m) >= 0.1323
        middle = legs[0][-1]
        start, stops, legs = DeckPose(middle[0], middle[1], 0.0), stops[1:], legs[1:]
    assert least_clearance(mirror, start, stops) >= cfg.mission.leg_clearance_m - ROUNDING_M
    assert worst_sensor(cfg, mirror, legs) >= cfg.mission.turn_clearance_m - SWEEP_M


@pytest.mark.parametrize("panels", [1, slow_case(2), 8, pytest.param(0, marks=pytest.mark.slow, id="whole")])
@pytest.mark.parametrize("order", SURVEYS)
@pytest.mark.parametrize("name", NAMES)
def test_home_from_the_end_of_a_survey(name: str, order: str, panels: int) -> None:
    """As it stands at the last stop."""
    cfg, mirror = load(name)
    points = ORDERS[order](mirror, panels)
    last = RoutePlanner(mirror, cfg).route(mirror.base_pose, points).stops[-2:]
    course = atan2(last[1].y_m - last[0].y_m, last[1].x_m - last[0].x_m) + (pi if last[1].reverse else 0.0)
    check_way_home(cfg, mirror, DeckPose(last[1].x_m, last[1].y_m, course))


@pytest.mark.parametrize(("inner", "rim"), [(96, 9), pytest.param(24, 1, marks=pytest.mark.slow, id="all")])
@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_home_from_points(name: str, inner: int, rim: int) -> None:
    """From every so many of the points, and of those at the rim."""
    cfg, mirror = load(name)
    for k, point in enumerate(thesis_order(mirror)):
        x, y = mirror.point_on_deck(point)
        if k % inner == 0 or (k % rim == 0 and mirror.rim.signed_distance_m(x, y) < 0.134):
            check_way_home(cfg, mirror, DeckPose(x, y, radians(37.0 * k)))


@pytest.mark.parametrize("step", [6, pytest.param(1, marks=pytest.mark.slow, id="all")])
@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_home_from_a_point_at_the_rim_without_a_sweep(name: str, step: int) -> None:
    """As a survey stands there, along the rim or across it, no sensor comes nearer to it than on a survey."""
    cfg, mirror = load(name)
    near = [xy for xy in map(mirror.point_on_deck, thesis_order(mirror)) if mirror.rim.signed_distance_m(*xy) < 0.1323]
    for k, (x, y) in list(enumerate(near))[::step]:
        start = DeckPose(x, y, radians(90.0 * k + (4.0, -4.0)[k // 4 % 2]))  # all four directions, on both sides
        stops = RoutePlanner(mirror, cfg).home(start)
        assert worst_sensor(cfg, mirror, drive(mirror, start, stops)) >= cfg.mission.turn_clearance_m - SWEEP_M


@settings(max_examples=25, deadline=None)
@given(mirror_names, st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), st.floats(-7.0, 7.0))
def test_home_from_anywhere(name: str, x: float, y: float, heading: float) -> None:
    cfg, mirror = load(name)
    if mirror.rim.signed_distance_m(x, y) > 0.0:
        check_way_home(cfg, mirror, DeckPose(x, y, heading))


@settings(max_examples=25, deadline=None)
@given(mirror_names, st.integers(0, 1000), st.floats(0.0, 1.0), st.floats(1e-6, 0.13), st.floats(-7.0, 7.0))
def test_home_from_the_rim(name: str, edge: int, along: float, depth: float, heading: float) -> None:
    cfg, mirror = load(name)
    corners = mirror.rim.vertices
    a, b = corners[edge % len(corners)], corners[(edge + 1) % len(corners)]
    u = (b - a) / np.linalg.norm(b - a)
    x, y = a + along * (b - a) + depth * np.array((-u[1], u[0]))  # the outline runs counter-clockwise
    if mirror.rim.signed_distance_m(float(x), float(y)) > 0.0:
        check_way_home(cfg, mirror, DeckPose(float(x), float(y), heading))


@settings(max_examples=15, deadline=None)
@given(mirror_names, order_names, st.integers(1, 6))
def test_stops_on_the_way_cost_time_and_nothing_else(name: str, order: str, panels: int) -> None:
    cfg, mirror = load(name)
    points = ORDERS[order](mirror, panels)
    route = RoutePlanner(mirror, cfg).route(mirror.base_pose, points)
    time_s = path_time(route.stops, mirror.base_pose, cfg.limits, mirror, 0.5)
    assert route.remaining_s(0) == pytest.approx(time_s, abs=1e-6)  # two sums of some hundred terms
    assert all(a > b for a, b in pairwise(route.times_s))
    assert route.remaining_s(len(route.stops)) == route.remaining_s(10**6) == 0.0
