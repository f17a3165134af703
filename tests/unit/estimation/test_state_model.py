"""Pure. The full-state model: its derivatives, and whether it describes a robot on a curved surface."""

from itertools import product
from math import cos, hypot, sin, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.core import DeckPose, FloatArray, PanelId
from ccatp.estimation.odometry import Slope, Terrain, axes_on
from ccatp.estimation.state_model import CT, KL, PL, PR, PSI, SL, SR, STATES, A, C, SensorRows, SurveyMotion, V, W, X, Y
from ccatp.kinematics import difference
from ccatp.mirror.mirror import Mirror
from tests.unit.estimation.drive import STEEP, Errors, Robot, build, config

R_M, BASE_M = config().robot.wheel_radius_m, config().robot.wheel_base_m
STEP = 1e-5
# Rounding of numbers up to 10, 2e-15, over the step; and its square times a third derivative below 100.
TOLERANCE = 2e-8
LEVEL = Slope(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def near(limit: float) -> st.SearchStrategy[float]:
    return st.floats(-limit, limit)


@st.composite
def states(draw: st.DrawFn) -> FloatArray:
    """Any state of a robot that drives and turns: neither way nor turn has a derivative of its size at zero."""
    x = np.array(
        [
            draw(near(limit))
            for limit in (3, 3, 7, 0.0, 0.5, 0.0, 0.05, 0.05, 1, 0.05, 0.05, 0.05, 0.1, 9, 9, 1, 1, 1, 1, 0.1)
        ]
    )
    x[W] = draw(st.sampled_from([-1.0, 1.0])) * draw(st.floats(1e-3, 2.0))
    x[V] = draw(st.sampled_from([-1.0, 1.0])) * draw(st.floats(0.06, 0.4))  # more than a dt takes away
    return x


@st.composite
def slopes(draw: st.DrawFn) -> Slope:
    """Steeper and more curved than any mirror."""
    angle = draw(near(4.0))
    fx, fy, fxx, fxy, fyy = (draw(near(limit)) for limit in (0.5, 0.5, 0.2, 0.2, 0.2))
    return Slope(fx, fy, fxx, fxy, fyy, cos(angle), sin(angle))


durations = st.floats(1e-3, 0.1)
shares = st.floats(0.3, 3.0)  # of the creep of turns
examples = settings(max_examples=60, deadline=None)


def differences(model: SurveyMotion | SensorRows, x: FloatArray) -> FloatArray:
    steps = STEP * np.eye(STATES)
    return (model.through(x + steps) - model.through(x - steps)).T / (2.0 * STEP)


@examples
@given(states(), slopes(), durations, shares)
def test_the_motions_jacobian_is_its_derivative(x: FloatArray, slope: Slope, dt_s: float, share: float) -> None:
    motion = SurveyMotion(R_M, BASE_M).over(dt_s, slope, share)
    np.testing.assert_allclose(motion.at(x)[1], differences(motion, x), atol=TOLERANCE)


@examples
@given(st.lists(states(), min_size=2, max_size=4), slopes(), durations, shares)
def test_the_motion_of_many_is_that_of_each(points: list[FloatArray], slope: Slope, dt_s: float, share: float) -> None:
    motion = SurveyMotion(R_M, BASE_M).over(dt_s, slope, share)
    for x, after in zip(points, motion.through(np.array(points)), strict=True):
        np.testing.assert_allclose(motion.at(x)[0], after, rtol=0.0, atol=1e-13)  # rounding of numbers up to 20


@examples
@given(states(), slopes(), durations, st.lists(st.floats(0.0, 1.0), min_size=6, max_size=6))
def test_noise_is_that_of_impulses_carried_through_the_step(
    x: FloatArray, slope: Slope, dt_s: float, impulses: list[float]
) -> None:
    motion, drift = SurveyMotion(R_M, BASE_M).over(dt_s, slope), np.linspace(0.0, 1.0, STATES)
    columns = differences(motion, x)[:, [A, W, SR, SL, C, CT]]
    expected = (columns * impulses).dot(columns.T) + np.diag(drift)
    # A product of two derivatives below 10, each off by the tolerance.
    np.testing.assert_allclose(motion.noise(x, np.array(impulses), drift), expected, atol=40.0 * TOLERANCE)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_creep_goes_downhill_whichever_way_the_robot_drives(sign: float) -> None:
    x = np.zeros(STATES)
    x[[V, C]] = sign * 0.1, 0.05
    slope = LEVEL._replace(gx=0.6, gy=0.8)
    after = SurveyMotion(R_M, BASE_M).over(0.1, slope).at(x)[0]
    assert after[[X, Y]] == pytest.approx([sign * 0.01 + 0.0003, 0.0004], abs=1e-15)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_turn_creeps_by_its_share_of_the_mean(sign: float) -> None:
    x = np.zeros(STATES)
    x[[W, CT]] = sign, 0.005
    after = SurveyMotion(R_M, BASE_M).over(0.1, LEVEL._replace(gx=0.6, gy=0.8), 2.0).at(x)[0]
    assert after[[X, Y]] == pytest.approx([0.0006, 0.0008], abs=1e-15)


ALL = Errors(right_slip=0.05, left_slip=0.02, base=0.02, creep=0.05, turn_creep=0.003)
CASES = {"perfect": Errors(), "all": ALL}


@pytest.mark.parametrize(("v", "omega", "limit_m"), [(0.1, 0.0, 2e-6), (-0.1, 0.7, 7e-6)])
@pytest.mark.parametrize("name", CASES)
def test_a_robot_on_the_mirror_moves_as_modelled(
    mirror: Mirror, name: str, v: float, omega: float, limit_m: float
) -> None:
    """Two seconds at constant speed in steps of the filter's length, against steps of 1 ms on the true surface."""
    wrong = CASES[name]
    robot = Robot(STEEP, lambda _: v, lambda _: omega, wrong)
    pose, angles = robot.pose, tuple(robot.angles)
    x = np.zeros(STATES)
    x[[X, Y, PSI, V, W]] = pose.x_m, pose.y_m, pose.heading_rad, v, omega
    x[[SR, SL, KL, C, CT]] = wrong.right_slip, wrong.left_slip, wrong.base, wrong.creep, wrong.turn_creep
    motion, terrain = SurveyMotion(R_M, BASE_M), Terrain(mirror)
    for _ in range(50):
        x = motion.over(0.04, terrain.at(float(x[X]), float(x[Y]))).at(x)[0].copy()
    for _ in range(2000):
        robot.move()
    pose = robot.pose
    # A step of d takes the slope f' of its beginning for that of its middle, off by f'' d/2 = 3e-5: f' f'' d/2 = 1.5e-6
    # of the way. Downhill is looked up every 5 mm: it turns by f''/0.4 of that, 2e-4, of the 10 mm of creep. An arc is
    # longer than its chord by (omega dt)^2/24 = 3e-5.
    assert hypot(x[X] - pose.x_m, x[Y] - pose.y_m) < limit_m
    assert abs(difference(float(x[PSI]), pose.heading_rad)) < 1e-6  # a hundredth of what the surface turns it by
    turned = [angle - before for angle, before in zip(robot.angles, angles, strict=True)]
    assert x[[PR, PL]] == pytest.approx(turned, abs=1e-9)  # the sum of 2000 roundings


ROWS = [rows for rows in product((False, True), repeat=3) if any(rows)]  # of none nothing is asked


@pytest.mark.parametrize("given_rows", ROWS)
def test_rows_jacobian_is_their_derivative(given_rows: tuple[bool, bool, bool]) -> None:
    rng = np.random.default_rng(3)
    rows = taken(*given_rows)
    for _ in range(5):
        x = rng.normal(size=STATES)
        expected, H = rows.at(x)
        np.testing.assert_allclose(H, differences(rows, x).reshape(H.shape), atol=1e-9)  # bilinear: rounding only
        np.testing.assert_allclose(expected, rows.through(x[None])[0], atol=1e-15)
        assert expected.shape == rows.z.shape == rows.R.shape


def taken(has_counts: bool, has_rate: bool, has_acceleration: bool) -> SensorRows:
    rate, counts, acceleration = [(W, 3.0, 0.2)], [(PR, 1.0, 0.1), (PL, 2.0, 0.1)], [(A, 4.0, 0.3)]
    return SensorRows(has_rate * rate + has_counts * counts + has_acceleration * acceleration)


REACH_M = 5e-3


def places(mirror: Mirror, count: int, seed: int) -> list[tuple[float, float]]:
    """Deck points on the panels."""
    rng = np.random.default_rng(seed)
    panels = list(mirror.panels.values())
    drawn = zip(rng.integers(len(panels), size=count), rng.uniform(-1.0, 1.0, (count, 2)).tolist(), strict=True)
    return [(panels[k].x_m + u * panels[k].half_x_m, panels[k].y_m + v * panels[k].half_y_m) for k, (u, v) in drawn]


def test_slopes_and_height_near_an_evaluated_point(mirror: Mirror) -> None:
    terrain, rng = Terrain(mirror), np.random.default_rng(2)
    away = rng.uniform(-0.999 * REACH_M, 0.999 * REACH_M, (200, 2)).tolist()
    for (x, y), (dx, dy) in zip(places(mirror, 200, 1), away, strict=True):
        terrain.at(x, y)
        assert terrain.height_m(x, y) == mirror.surface.height_m(x, y)
        found, exact = terrain.at(x + dx, y + dy), mirror.surface.gradient(x + dx, y + dy)
        assert found[2:5] == terrain.at(x, y)[2:5]  # carried on, not evaluated
        a, b, c, d = mirror.surface.third(x, y)
        third, r = sqrt(a * a + 3.0 * b * b + 3.0 * c * c + d * d), hypot(dx, dy)  # no direction has more than the norm
        off = hypot(found.fx - exact[0], found.fy - exact[1])
        assert off < 1e-7
        assert off <= 0.5 * third * r * r * 1.02 + 1e-15  # the next term is r = 7 mm over metres of the first
        assert abs(terrain.height_m(x + dx, y + dy) - mirror.surface.height_m(x + dx, y + dy)) < third * r**3 / 5.0


@pytest.mark.parametrize("far", [(2.0, 0.0), (0.0, -2.0), (1.01, 0.0), (0.0, 1.01)])
def test_further_away_the_surface_is_evaluated_again(mirror: Mirror, far: tuple[float, float]) -> None:
    x, y = places(mirror, 1, 5)[0]
    terrain = Terrain(mirror)
    terrain.at(x, y)
    x, y = x + far[0] * REACH_M, y + far[1] * REACH_M
    assert terrain.height_m(x, y) == mirror.surface.height_m(x, y)
    assert terrain.at(x, y)[:5] == mirror.surface.jet(x, y)[1:]


def test_downhill_is_where_gravity_points_along_the_surface(mirror: Mirror) -> None:
    for psi, (x, y) in enumerate(places(mirror, 50, 3)):
        pose = DeckPose(x, y, float(psi))
        along, across, _ = mirror.gravity_in_robot(pose)
        hx, hy, lx, ly = mirror.body_axes(pose)
        length = hypot(along, across)
        slope = Terrain(mirror).at(x, y)
        expected = (along * hx + across * lx) / length, (along * hy + across * ly) / length
        assert (slope.gx, slope.gy) == pytest.approx(expected, abs=1e-14)  # rounding


def test_the_robots_axes_are_the_mirrors(mirror: Mirror) -> None:
    for psi, (x, y) in enumerate(places(mirror, 20, 4)):
        expected = mirror.body_axes(DeckPose(x, y, float(psi)))
        assert axes_on(Terrain(mirror).at(x, y), float(psi)) == pytest.approx(expected, abs=1e-15)


# -- the panel's frame ------------------------------------------------------------------------------------------------


def test_a_pose_in_a_panels_frame_is_the_mirrors(mirror: Mirror) -> None:
    for k, (x, y) in enumerate(places(mirror, 50, 6)):
        found = build(start=mirror.panel_pose(mirror.nearest_panel(x, y), DeckPose(x, y, 0.37 * k - 9.0)))
        expected = mirror.panel_pose(mirror.nearest_panel(x, y), found.deck_pose)
        assert found.pose.panel == expected.panel
        assert (found.pose.x_m, found.pose.y_m) == pytest.approx((expected.x_m, expected.y_m), abs=1e-14)  # rounding
        assert abs(difference(found.pose.heading_rad, expected.heading_rad)) < 1e-14


@pytest.mark.parametrize(
    ("panel", "off_m", "under"),  # in the frame of the first
    [((4, 4), -1e-6, (4, 4)), ((4, 4), 1e-6, (4, 5)), ((4, 5), -1e-6, (4, 4)), ((5, 1), -1.0, (5, 1))],
)
def test_the_panel_changes_in_the_middle_of_the_gap_and_stays_beside_the_mirror(
    mirror: Mirror, panel: tuple[int, int], off_m: float, under: tuple[int, int]
) -> None:
    here, there = mirror.panel(PanelId(4, 4)), mirror.panel(PanelId(4, 5))
    x_m = mirror.panel(PanelId(*panel)).x_m if panel == (5, 1) else 0.5 * (here.x_m + there.x_m)
    start = mirror.panel_pose(PanelId(*panel), DeckPose(x_m + off_m, here.y_m, 0.0))
    assert build(start=start).pose.panel == under
