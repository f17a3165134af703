"""The plant against independent integration of its equations of motion in three dimensions."""

from math import atan2, exp

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from ccatp.config.models import Config
from ccatp.core import DeckPose
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.sim.plant import Disturbance, Plant

RADIUS_M, BASE_M, LAG_S = 0.03, 0.15, 0.08
START = DeckPose(0.9, -1.4, 0.7)
DT_S = 0.01


@pytest.fixture(scope="module")
def mirror(config: Config) -> Mirror:
    return build_mirror(config.mirror)


def plant_on(mirror: Mirror, start: DeckPose = START, disturbances: tuple[Disturbance, ...] = ()) -> Plant:
    return Plant(
        mirror.surface,
        start,
        wheel_radius_m=RADIUS_M,
        wheel_base_m=BASE_M,
        wheel_lag_s=LAG_S,
        disturbances=disturbances,
    )


def drive(plant: Plant, right: float, left: float, steps: int) -> None:
    for k in range(steps):
        plant.step(k * DT_S, DT_S, right, left)


def rates_at(plant: Plant, decays: list[float]) -> list[tuple[float, float]]:
    right_set, right_lag, left_set, left_lag = plant.servo
    return [(right_set + right_lag * e, left_set + left_lag * e) for e in decays]


def integrate(mirror: Mirror, start: DeckPose, right: float, left: float, seconds: float) -> DeckPose:
    """Point p and heading h in space: p' = v h, h' = omega n x h + (what keeps h tangent); wheels of first order."""
    surface = mirror.surface

    def rate(t: float, state: NDArray[np.float64]) -> NDArray[np.float64]:
        p, h = state[:3], state[3:]
        wr, wl = right * (1.0 - exp(-t / LAG_S)), left * (1.0 - exp(-t / LAG_S))
        v, omega = RADIUS_M * (wr + wl) / 2.0, RADIUS_M * (wr - wl) / BASE_M
        n = np.array(surface.normal(p[0], p[1]))
        step = 1e-5
        ahead, behind = p + step * h, p - step * h
        dn = (np.array(surface.normal(*ahead[:2])) - np.array(surface.normal(*behind[:2]))) / (2.0 * step) * v
        return np.concatenate([v * h, omega * np.cross(n, h) - (h @ dn) * n])

    h0 = np.array(mirror.robot_axes(start)[0])
    p0 = np.array(surface.point(start.x_m, start.y_m))
    state = solve_ivp(rate, (0.0, seconds), np.concatenate([p0, h0]), method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    e1, e2, _ = surface.axes(state[0], state[1])
    return DeckPose(state[0], state[1], atan2(state[3:] @ np.array(e2), state[3:] @ np.array(e1)))


@pytest.mark.parametrize(("right", "left"), [(3.4, 3.4), (5.0, 4.0), (4.0, 7.0), (-3.0, -3.5), (2.5, -2.5), (1.0, 0.0)])
def test_pose_after_ten_seconds(mirror: Mirror, right: float, left: float) -> None:
    plant = plant_on(mirror)
    drive(plant, right, left, 1000)
    expected = integrate(mirror, START, right, left, 10.0)
    # A thousandth of what the laser measures, a thousandth of a gyroscope's reading.
    assert plant.x_m == pytest.approx(expected.x_m, abs=1e-6)
    assert plant.y_m == pytest.approx(expected.y_m, abs=1e-6)
    turns = round((plant.heading_rad - expected.heading_rad) / (2.0 * np.pi))
    assert plant.heading_rad - 2.0 * np.pi * turns == pytest.approx(expected.heading_rad, abs=2e-6)
    assert plant.z_m == pytest.approx(mirror.surface.height_m(plant.x_m, plant.y_m), abs=1e-9)


def test_a_straight_drive_turns_against_the_lines_of_the_deck(mirror: Mirror) -> None:
    # The test above would see a missing transport term: it is a hundred times its tolerance.
    plant = plant_on(mirror, DeckPose(1.5, 1.8, 0.3))
    drive(plant, 100.0 / 30.0, 100.0 / 30.0, 1000)
    assert abs(plant.heading_rad - 0.3) > 2e-4


def test_a_long_step_follows_the_chord_of_its_arc(mirror: Mirror) -> None:
    flat = DeckPose(0.0, 0.0, 0.0)
    plant = plant_on(mirror, flat)
    drive(plant, 5.0, 4.0, 200)  # until the wheels are at speed
    x, y, psi = plant.x_m, plant.y_m, plant.heading_rad
    plant.step(2.0, 1.0, 5.0, 4.0)
    turn, forward = RADIUS_M * 1.0 / BASE_M, RADIUS_M * 4.5
    chord = 2.0 * (forward / turn) * np.sin(turn / 2.0)
    found = float(np.hypot(plant.x_m - x, plant.y_m - y))
    # Near the apex slopes below 1 % shorten projections by less than 5e-5; the arc itself is 225 um longer.
    assert chord * (1.0 - 5e-5) - 1e-6 < found < chord + 1e-6
    assert plant.heading_rad - psi == pytest.approx(turn, abs=1e-4)


def test_axes_are_those_of_the_mirror(mirror: Mirror) -> None:
    plant = plant_on(mirror)
    drive(plant, 5.0, 4.0, 300)
    axes = plant.hx, plant.hy, plant.lx, plant.ly
    # The gradient at the end of a step is extrapolated from its middle: half a step squared times the third derivative.
    assert axes == pytest.approx(mirror.body_axes(plant.pose), abs=1e-9)


def test_wheels_are_first_order_within_a_step(mirror: Mirror) -> None:
    plant = plant_on(mirror)
    drive(plant, 2.0, -1.0, 3)
    plant.step(0.03, DT_S, 4.0, 3.0)
    before = 2.0 * (1.0 - exp(-0.03 / LAG_S)), -1.0 * (1.0 - exp(-0.03 / LAG_S))
    decays = [exp(-tau / LAG_S) for tau in (0.0, 0.004, 0.01)]
    for (right, left), e in zip(rates_at(plant, decays), decays, strict=True):
        assert right == pytest.approx(4.0 + (before[0] - 4.0) * e, abs=1e-12)
        assert left == pytest.approx(3.0 + (before[1] - 3.0) * e, abs=1e-12)
    assert rates_at(plant, decays)[-1] == pytest.approx((plant.right_rad_s, plant.left_rad_s), abs=1e-12)


def test_acceleration_is_the_derivative_of_the_speed_and_turn_rate_that_of_the_wheels(mirror: Mirror) -> None:
    plant = plant_on(mirror)
    drive(plant, 2.0, -1.0, 3)
    plant.step(0.03, DT_S, 4.0, 3.0)
    tau, h = 0.006, 1e-6
    speeds = []
    for t in (tau - h, tau + h):
        ((right, left),) = rates_at(plant, [exp(-t / LAG_S)])
        speeds.append(RADIUS_M * (right + left) / 2.0)
    decay = exp(-tau / LAG_S)
    # A central difference over 2 us of a function with a 80 ms time constant.
    assert plant.acceleration_at(decay) == pytest.approx((speeds[1] - speeds[0]) / (2.0 * h), rel=1e-7)
    ((right, left),) = rates_at(plant, [decay])
    assert plant.turn_rate_at(decay) == pytest.approx(RADIUS_M * (right - left) / BASE_M, abs=1e-14)


def test_a_robot_at_rest_does_not_move_a_bit(mirror: Mirror) -> None:
    plant = plant_on(mirror)
    drive(plant, 3.0, 2.0, 50)
    drive(plant, 0.0, 0.0, 300)  # 37 time constants
    pose = plant.pose
    drive(plant, 0.0, 0.0, 100)
    assert plant.pose == pose
    assert (plant.is_moving, plant.right_rad_s, plant.left_rad_s, plant.forward_m) == (False, 0.0, 0.0, 0.0)


def test_coasting_distance_is_speed_times_lag(mirror: Mirror) -> None:
    plant = plant_on(mirror)
    drive(plant, 3.0, 3.0, 200)
    travelled = 0.0
    for k in range(300):
        plant.step(k * DT_S, DT_S, 0.0, 0.0)
        travelled += plant.forward_m
    assert travelled == pytest.approx(3.0 * RADIUS_M * LAG_S, abs=1e-9)


def test_disturbances_act_on_the_body_one_after_the_other(mirror: Mirror) -> None:
    class Creep:
        def displace(
            self, plant: Plant, t_s: float, dt_s: float, forward_m: float, left_m: float, turn_rad: float
        ) -> tuple[float, float, float]:
            return forward_m, left_m + 0.01 * dt_s, turn_rad

    class Slip:
        def displace(
            self, plant: Plant, t_s: float, dt_s: float, forward_m: float, left_m: float, turn_rad: float
        ) -> tuple[float, float, float]:
            return 0.5 * forward_m, 2.0 * left_m, turn_rad

    plant = plant_on(mirror, disturbances=(Creep(), Slip()))
    start = np.array(mirror.surface.point(plant.x_m, plant.y_m))
    axes = mirror.robot_axes(plant.pose)
    drive(plant, 0.0, 0.0, 10)
    moved = np.array(mirror.surface.point(plant.x_m, plant.y_m)) - start
    # 2 mm sideways; the surface bends away by 2 mm squared over twice 20 m.
    assert moved @ np.array(axes[1]) == pytest.approx(0.002, abs=1e-7)
    assert moved @ np.array(axes[0]) == pytest.approx(0.0, abs=1e-7)
    assert plant.is_moving


def test_wheels_that_stop_dead(mirror: Mirror) -> None:
    plant = plant_on(mirror)
    drive(plant, 3.0, 2.0, 50)
    plant.stop_dead()
    assert plant.servo == (0.0, 0.0, 0.0, 0.0)
    assert plant.acceleration_at(1.0) == 0.0
    assert plant.turn_rate_at(1.0) == 0.0


def test_a_wheel_that_slips_turns_more_than_the_body_moves(mirror: Mirror) -> None:
    plant, ideal = plant_on(mirror), plant_on(mirror)
    plant.right_scale, plant.left_scale = 0.95, 0.98
    plant.step(0.0, DT_S, 5.0, 4.0)
    ideal.step(0.0, DT_S, 5.0, 4.0)
    assert (plant.right_angle_rad, plant.left_angle_rad) == (ideal.right_angle_rad, ideal.left_angle_rad)
    right_m, left_m = 0.95 * RADIUS_M * plant.right_angle_rad, 0.98 * RADIUS_M * plant.left_angle_rad
    assert plant.forward_m == pytest.approx((right_m + left_m) / 2.0, rel=1e-12)
    assert plant.turn_rad == pytest.approx((right_m - left_m) / BASE_M, rel=1e-12)
    # The inertial unit feels the body: rates at the end of the step, and their derivative.
    plant.step(DT_S, DT_S, -2.0, 1.0)
    middle = exp(-0.004 / LAG_S)
    ((right, left),) = rates_at(plant, [middle])
    expected = RADIUS_M * (0.95 * right - 0.98 * left) / BASE_M
    assert plant.turn_rate_at(middle) == pytest.approx(expected, rel=1e-12)
    right, left = 0.95 * plant.right_rad_s, 0.98 * plant.left_rad_s
    decay = exp(-DT_S / LAG_S)
    assert plant.turn_rate_at(decay) == pytest.approx(RADIUS_M * (right - left) / BASE_M, rel=1e-12)
    expected = RADIUS_M * (0.95 * -2.0 - right + 0.98 * 1.0 - left) / 2.0 / LAG_S
    assert plant.acceleration_at(decay) == pytest.approx(expected, rel=1e-12)
