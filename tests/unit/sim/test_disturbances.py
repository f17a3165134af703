"""What keeps the body from doing what its wheels say, one disturbance at a time."""

from math import exp, pi, sqrt

import numpy as np
import pytest
from numpy.typing import NDArray

from ccatp.config.models import Config, WorldConfig
from ccatp.core import DeckPose
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.sim.disturbances import Creep, Vibration, WheelSlip, draw_wheels
from ccatp.sim.plant import Disturbance, Plant

DT_S = 0.01
START = DeckPose(0.9, -1.4, 0.7)


@pytest.fixture(scope="module")
def mirror(config: Config) -> Mirror:
    return build_mirror(config.mirror)


def world_of(config: Config, **values: float) -> WorldConfig:
    return config.world.model_copy(update=values)


def plant_on(mirror: Mirror, *disturbances: Disturbance, start: DeckPose = START) -> Plant:
    return Plant(
        mirror.surface, start, wheel_radius_m=0.03, wheel_base_m=0.15, wheel_lag_s=0.08, disturbances=disturbances
    )


# -- measures of the true robot ---------------------------------------------------------------------------------------


def test_measures_scatter_about_the_nominal_ones(config: Config) -> None:
    world = world_of(config, wheel_radius_sigma=0.005, wheel_base_sigma=0.01, wheel_lag_spread=0.2)
    drawn = np.array([draw_wheels(config.robot, 0.08, world, np.random.default_rng(seed)) for seed in range(1500)])
    relative = drawn / np.array([config.robot.wheel_radius_m, 1.0, 1.0, config.robot.wheel_base_m, 0.08]) - 1.0
    error = 4.5 / sqrt(2 * 1500)  # 4.5 standard errors of a standard deviation
    assert relative.std(axis=0)[1:4] == pytest.approx([0.005, 0.005, 0.01], rel=error)
    assert np.abs(relative.mean(axis=0)[1:4]).max() < 4.5 * 0.01 / sqrt(1500)
    # Each error is of its own, the two radii included.
    assert np.abs(np.atleast_2d(np.corrcoef(relative[:, 1:].T))[np.triu_indices(4, 1)]).max() < 4.5 / sqrt(1500)
    lag = relative[:, 4]
    assert (lag.min(), lag.max()) == pytest.approx((-0.2, 0.2), abs=0.2 * 2 * 10 / 1500)  # ten mean spacings
    assert lag.std() == pytest.approx(0.2 / sqrt(3.0), rel=error)


def test_each_measure_is_switched_off_by_itself(config: Config) -> None:
    spreads = {"wheel_radius_sigma": 0.005, "wheel_base_sigma": 0.01, "wheel_lag_spread": 0.2}
    every = draw_wheels(config.robot, 0.08, world_of(config, **spreads), np.random.default_rng(1))
    for key, names in (
        ("wheel_radius_sigma", {"right_scale", "left_scale"}),
        ("wheel_base_sigma", {"base_m"}),
        ("wheel_lag_spread", {"lag_s"}),
    ):
        without = draw_wheels(config.robot, 0.08, world_of(config, **{**spreads, key: 0.0}), np.random.default_rng(1))
        changed = {name for name in every._fields if getattr(every, name) != getattr(without, name)}
        assert changed == names
    nominal = draw_wheels(config.robot, 0.08, world_of(config), np.random.default_rng(1))
    assert nominal == (config.robot.wheel_radius_m, 1.0, 1.0, config.robot.wheel_base_m, 0.08)


# -- slip -------------------------------------------------------------------------------------------------------------


def slips_of(config: Config, orders: list[bool], seed: int = 1, **values: float) -> NDArray[np.float64]:
    values = {"slip_min": 0.01, "slip_max": 0.05, "slip_walk_sigma": 0.0, **values}
    slip = WheelSlip(world_of(config, **values), np.random.default_rng(seed))
    found = []
    for k, is_ordered in enumerate(orders):
        slip.step(k * DT_S, DT_S, is_ordered)
        found.append((slip.right, slip.left))
    return np.array(found)


@pytest.mark.parametrize(("pause", "legs"), [(1, 1), (19, 1), (20, 2), (21, 2), (300, 2)])
def test_slip_is_drawn_anew_after_a_stop_of_two_tenths_of_a_second(config: Config, pause: int, legs: int) -> None:
    found = slips_of(config, [True] * 100 + [False] * pause + [True] * 100)
    assert len({tuple(row) for row in found}) == legs
    assert len({tuple(row) for row in found[: 100 + pause]}) == 1  # the coasting belongs to the leg


def test_slip_of_a_leg_is_uniform_and_each_wheel_has_its_own(config: Config) -> None:
    found = slips_of(config, ([True] + [False] * 20) * 1500)[::21]
    assert found.min() >= 0.01
    assert found.max() <= 0.05
    assert found.mean(axis=0) == pytest.approx([0.03, 0.03], abs=4.5 * 0.04 / sqrt(12 * 1500))
    assert found.std(axis=0) == pytest.approx([0.04 / sqrt(12.0)] * 2, rel=4.5 / sqrt(2 * 1500))
    assert abs(np.atleast_2d(np.corrcoef(found.T))[0, 1]) < 4.5 / sqrt(1500)
    assert abs(np.corrcoef(found[1:, 0], found[:-1, 0])[0, 1]) < 4.5 / sqrt(1500)


def test_slip_walks_within_a_leg(config: Config) -> None:
    lagged = []
    for seed in range(800):
        walk = slips_of(config, [True] * 101, seed, slip_min=0.0, slip_max=0.0, slip_walk_sigma=0.005)
        lagged.append((walk[0, 0], walk[-1, 0], walk[0, 1]))
    found = np.array(lagged)
    assert found.std(axis=0) == pytest.approx([0.005] * 3, rel=4.5 / sqrt(2 * 800))
    correlation = np.corrcoef(found.T)
    assert correlation[0, 1] == pytest.approx(exp(-0.5), abs=4.5 / sqrt(800))  # 1 s of 2 s
    assert abs(correlation[0, 2]) < 4.5 / sqrt(800)  # right and left are independent


def test_the_walk_and_the_legs_do_not_know_of_each_other(config: Config) -> None:
    orders = ([True] * 5 + [False] * 25) * 20
    legs = slips_of(config, orders)
    walk = slips_of(config, orders, slip_min=0.0, slip_max=0.0, slip_walk_sigma=0.005)
    both = slips_of(config, orders, slip_walk_sigma=0.005)
    assert both == pytest.approx(legs + walk, abs=1e-15)  # a sum in another order


# -- creep ------------------------------------------------------------------------------------------------------------


def test_creep_goes_downhill(config: Config, mirror: Mirror) -> None:
    """Against the gradient of the height in the world, found by small steps on the surface."""
    creep = Creep(mirror, world_of(config, creep_fraction=0.05, creep_walk_fraction=0.0), np.random.default_rng(1))
    rng = np.random.default_rng(7)
    step = 1e-5

    def depth(x: float, y: float) -> float:  # gravity points along world +z
        return mirror.world_from_deck(mirror.surface.point(x, y))[2]

    for _ in range(50):
        start = DeckPose(rng.uniform(-2.0, 2.0), rng.uniform(-2.0, 2.0), rng.uniform(-pi, pi))
        plant = plant_on(mirror, start=start)
        for forward_m in (0.001, -0.001):
            ahead, left, turn = creep.displace(plant, 0.0, DT_S, forward_m, 0.0, 0.1)
            assert turn == 0.1
            axes = mirror.robot_axes(start)
            moved = (ahead - forward_m) * np.array(axes[0]) + left * np.array(axes[1])
            # Steepest descent in the tangent plane: derivatives along its two axes.
            slopes = []
            for axis in axes[:2]:
                dx, dy = step * axis[0], step * axis[1]
                rise = depth(start.x_m + dx, start.y_m + dy) - depth(start.x_m - dx, start.y_m - dy)
                slopes.append(rise / (2.0 * step))
            downhill = slopes[0] * np.array(axes[0]) + slopes[1] * np.array(axes[1])
            downhill /= np.linalg.norm(downhill)
            # 5 % of 1 mm; the differences of the depth are good to 1e-6.
            assert moved == pytest.approx(0.05 * 0.001 * downhill, abs=1e-9)
            assert moved @ downhill > 0.0


def test_creep_needs_a_slope_and_a_speed(config: Config, mirror: Mirror) -> None:
    creep = Creep(mirror, world_of(config, creep_fraction=0.05, creep_walk_fraction=0.2), np.random.default_rng(1))
    assert creep.displace(plant_on(mirror), 0.0, DT_S, 0.0, 0.0, 0.1) == (0.0, 0.0, 0.1)

    def slope_at(x_m: float) -> float:
        g = mirror.gravity_in_robot(DeckPose(x_m, 0.3, 0.0))
        return float(np.hypot(g[0], g[1]))

    # Along this line the bottom of the dish comes nearest to level at the minimum of a fine scan.
    level = min(np.linspace(-3.0, 3.0, 20001), key=slope_at)
    creeps = creep.displace(plant_on(mirror, start=DeckPose(level, 0.3, 0.0)), 0.0, DT_S, 0.001, 0.0, 0.0)
    assert (creeps == (0.001, 0.0, 0.0)) == (slope_at(level) < 1e-3)


def test_creep_walks(config: Config, mirror: Mirror) -> None:
    plant = plant_on(mirror)
    shares = []
    for seed in range(800):
        creep = Creep(
            mirror, world_of(config, creep_fraction=0.02, creep_walk_fraction=0.2), np.random.default_rng(seed)
        )
        row = []
        for t in (0.0, 1.0):
            ahead, left, _ = creep.displace(plant, t, DT_S, 0.001, 0.0, 0.0)
            row.append(np.hypot(ahead - 0.001, left) / 0.001 / 0.02)
        shares.append(row)
    found = np.array(shares)
    assert found.mean(axis=0) == pytest.approx([1.0, 1.0], abs=4.5 * 0.2 / sqrt(800))
    assert found.std(axis=0) == pytest.approx([0.2, 0.2], rel=4.5 / sqrt(2 * 800))
    assert np.corrcoef(found.T)[0, 1] == pytest.approx(exp(-0.5), abs=4.5 / sqrt(800))


# -- vibration --------------------------------------------------------------------------------------------------------


def shaken(config: Config, mirror: Mirror, frames: int, **values: float) -> NDArray[np.float64]:
    """Rows of forward and turn displacement, rate and acceleration, with the fans on."""
    values = {"vibration_rate_rad_s": 0.02, "vibration_speed_m_s": 0.001, "vibration_acceleration_m_s2": 0.3, **values}
    vibration = Vibration(world_of(config, **values), DT_S, np.random.default_rng(1))
    vibration.is_thrusting = True
    plant = plant_on(mirror, vibration)
    rows = []
    for k in range(frames):
        plant.step(k * DT_S, DT_S, 0.0, 0.0)
        rows.append((plant.forward_m, plant.turn_rad, plant.turn_rate_at(1.0), plant.acceleration_at(1.0)))
    return np.array(rows)


def test_vibration_has_its_sigmas_and_stays_where_it_is(config: Config, mirror: Mirror) -> None:
    n = 20_000
    found = shaken(config, mirror, n)
    # Differences of white noise are correlated by -1/2: a standard deviation errs by sqrt(3/2) times as much.
    error = 4.5 * sqrt(1.5) / sqrt(2 * n)
    assert (found / [DT_S, DT_S, 1.0, 1.0]).std(axis=0) == pytest.approx([0.001, 0.02, 0.02, 0.3], rel=error)
    assert found[:, 2] == pytest.approx(found[:, 1] / DT_S, abs=1e-12)  # the gyroscope reads what the body does
    place, heading = found[:, 0].cumsum(), found[:, 1].cumsum()
    speed = found[:, 3].cumsum() * DT_S
    # White jitter of sigma dt / sqrt(2), of which 20,000 stay within 5.5 sigma.
    for path, sigma in ((place, 0.001), (heading, 0.02), (speed, 0.3)):
        assert np.abs(path).max() < 5.5 * sigma * DT_S / sqrt(2.0)
        assert path[n // 2 :].std() == pytest.approx(path[: n // 2].std(), rel=2 * 4.5 / sqrt(n))
    assert np.abs(np.atleast_2d(np.corrcoef(found[:, [0, 1, 3]].T))[np.triu_indices(3, 1)]).max() < 4.5 * sqrt(
        1.5
    ) / sqrt(n)


@pytest.mark.parametrize(
    ("key", "columns"),
    [("vibration_rate_rad_s", [1, 2]), ("vibration_speed_m_s", [0]), ("vibration_acceleration_m_s2", [3])],
)
def test_each_vibration_is_switched_off_by_itself(config: Config, mirror: Mirror, key: str, columns: list[int]) -> None:
    every, without = shaken(config, mirror, 50), shaken(config, mirror, 50, **{key: 0.0})
    others = [k for k in range(4) if k not in columns]
    assert (without[:, columns] == 0.0).all()
    assert (without[:, others] == every[:, others]).all()


def test_without_thrust_the_body_comes_back_and_rests(config: Config, mirror: Mirror) -> None:
    values = {"vibration_rate_rad_s": 0.02, "vibration_speed_m_s": 0.001, "vibration_acceleration_m_s2": 0.3}
    vibration = Vibration(world_of(config, **values), DT_S, np.random.default_rng(1))
    plant = plant_on(mirror, vibration)
    for k in range(40):
        vibration.is_thrusting = 10 <= k < 30
        plant.step(k * DT_S, DT_S, 0.0, 0.0)
        assert plant.is_moving is (10 <= k <= 30)
    assert (plant.x_m, plant.y_m) == pytest.approx((START.x_m, START.y_m), abs=1e-8)  # steps along a heading that shook
    assert plant.heading_rad == pytest.approx(START.heading_rad, abs=1e-8)
    assert (plant.turn_rate_at(1.0), plant.acceleration_at(1.0)) == (0.0, 0.0)
