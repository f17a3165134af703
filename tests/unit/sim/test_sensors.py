"""What the simulated sensors read, and the simulated laser metrology."""

from functools import cache
from itertools import product
from math import acos, pi, sqrt

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from ccatp.config.load import load_config
from ccatp.config.models import Config, SimEtalonConfig, WorldConfig
from ccatp.core import DeckPose, PanelId
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.sim.laser import EtalonModel, PuckTruth
from ccatp.sim.plant import Plant
from ccatp.sim.sensors import (
    MIN_GAP_M,
    CountingEncoders,
    EdgeSensors,
    InertialUnit,
    Rectangle,
    SensorSuite,
    draw_rectangles,
    sample_times,
)
from tests.support.cases import slow_case

OFFSETS = ((0.09, 0.09), (0.09, -0.09), (-0.09, 0.09), (-0.09, -0.09))
DT_S = 0.01


def plant_at(mirror: Mirror, start: DeckPose) -> Plant:
    return Plant(mirror.surface, start, wheel_radius_m=0.03, wheel_base_m=0.15, wheel_lag_s=0.08)


def suite(config: Config, mirror: Mirror, **rates: float) -> SensorSuite:
    robot = config.sim.robot.model_copy(update=rates)
    cfg = config.model_copy(update={"sim": config.sim.model_copy(update={"robot": robot})})
    return SensorSuite(cfg, mirror, np.random.default_rng(1), lag_s=robot.wheel_lag_s)


@pytest.mark.parametrize(
    ("hz", "frame_hz"), [(1000.0, 100.0), (100.0, 100.0), (20.0, 100.0), (333.0, 100.0), (50.0, 30.0), (7.3, 100.0)]
)
def test_every_instant_falls_into_exactly_one_frame(hz: float, frame_hz: float) -> None:
    found: list[float] = []
    for frame, times in enumerate(sample_times(hz, frame_hz, 0.08, 1, 300), start=1):
        for t, fraction, decay in zip(times.times_s, times.fractions, times.decays, strict=True):
            assert (frame - 1) / frame_hz < t + 1e-12  # times are rounded to the last bit
            assert t <= frame / frame_hz + 1e-12
            assert fraction == pytest.approx(t * frame_hz - (frame - 1), abs=1e-9)
            assert decay == pytest.approx(np.exp(-fraction / frame_hz / 0.08), abs=1e-9)
        found += times.times_s
    assert found == [n / hz for n in range(1, len(found) + 1)]
    assert len(found) == int(300 / frame_hz * hz + 1e-9)


# -- inertial unit, encoders, gravity ---------------------------------------------------------------------------------


def test_readings_are_the_truth_plus_noise_of_the_world(config: Config, mirror: Mirror) -> None:
    sensors = suite(config, mirror)
    plant = plant_at(mirror, DeckPose(0.0, 0.0, 0.3))
    errors: dict[str, list[float]] = {"ax": [], "wz": [], "enc": []}
    for frame in range(1, 1501):
        side = 1.0 if frame % 100 < 50 else -1.0
        plant.step((frame - 1) * DT_S, DT_S, 3.0 * side, 2.0 * side)
        _, ((t, ax, wz),), encoders, _ = sensors.read(frame, plant)
        assert t == frame / 100.0
        speed_rate = 0.03 * ((3.0 + 2.0) * side - plant.right_rad_s - plant.left_rad_s) / 2.0 / 0.08
        errors["ax"].append(ax - speed_rate)
        errors["wz"].append(wz - 0.03 * (plant.right_rad_s - plant.left_rad_s) / 0.15)
        assert len(encoders) == 10
        errors["enc"] += [encoders[-1][1] - plant.right_rad_s, encoders[-1][2] - plant.left_rad_s]
    world = config.world
    for name, sigma in (
        ("ax", world.accelerometer_sigma_m_s2),
        ("wz", world.gyroscope_sigma_rad_s),
        ("enc", world.encoder_sigma_rad_s),
    ):
        found = np.array(errors[name])
        # 4.5 standard errors of a standard deviation and of a mean; the seed is fixed.
        assert found.std() == pytest.approx(sigma, rel=4.5 / np.sqrt(2.0 * len(found)))
        assert abs(found.mean()) < 4.5 * sigma / np.sqrt(len(found))


def test_gravity_comes_at_its_own_rate_within_its_noise(config: Config, mirror: Mirror) -> None:
    sensors, plant = suite(config, mirror), plant_at(mirror, DeckPose(0.5, 0.5, 1.0))
    g = np.array(mirror.gravity_in_robot(plant.pose))
    angles, times = [], []
    for frame in range(1, 5001):
        if (reading := sensors.read(frame, plant)[3]) is not None:
            times.append(reading[0])
            assert np.linalg.norm(reading[1:]) == pytest.approx(1.0, abs=1e-6)  # rounded to 1e-7 each
            angles.append(acos(min(1.0, float(np.dot(reading[1:], g)))))
    assert times == [k / 20.0 for k in range(1, 1001)]
    # Two components across the direction: rms angle is sqrt(2) sigma; 1000 draws.
    sigma = config.sim.robot.gravity_sigma_rad
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(2.0**0.5 * sigma, rel=0.08)


# -- edge sensors -----------------------------------------------------------------------------------------------------


def test_a_sensor_that_stops_over_a_gap_stays_off(config: Config, mirror: Mirror) -> None:
    panel = mirror.panels[next(iter(mirror.panels))]
    gap_x = panel.x_m + panel.half_x_m + mirror.gap_m / 2.0
    start = DeckPose(gap_x, panel.y_m, 0.0)
    # Put the front left sensor over the gap: walk the robot back along its own x axis.
    hx, _, lx, _ = mirror.body_axes(start)
    plant = plant_at(mirror, DeckPose(gap_x - 0.09 * hx - 0.09 * lx, panel.y_m, 0.0))
    edges = EdgeSensors(mirror, OFFSETS, edges_of(config, mirror, sigma_m=0.0))
    edges.place(plant)
    for k in range(3):
        plant.step(k * DT_S, DT_S, 0.0, 0.0)
        readings = edges.read(plant, [0.001, 0.002], [0.1, 0.2])
        assert [reading[1] for reading in readings] == [0, 0]
        assert [reading[3:] for reading in readings] == [(1, 1), (1, 1)]


SIGMA_M = 2e-4


@pytest.fixture(scope="module")
def wide() -> Config:
    """A mirror with gaps of 10 mm, where no shift is ever limited."""
    return load_config(overrides={"run.mirror": "thesis-m1"})


def edges_of(cfg: Config, mirror: Mirror, seed: int = 1, sigma_m: float = SIGMA_M) -> dict[PanelId, Rectangle]:
    return draw_rectangles(mirror, cfg.mirror.panels, sigma_m, np.random.default_rng(seed))


def shifts_of(cfg: Config, seed: int = 1) -> NDArray[np.float64]:
    """Outward shifts, shape (panels, 4)."""
    mirror = build_mirror(cfg.mirror)
    found, nominal = edges_of(cfg, mirror, seed), edges_of(cfg, mirror, sigma_m=0.0)
    return np.array([np.subtract(found[p], nominal[p]) * (-1, 1, -1, 1) for p in nominal])


def test_edges_shift_by_their_sigma_each_for_itself(wide: Config) -> None:
    shifts = np.concatenate([shifts_of(wide, seed) for seed in range(20)])
    n = len(shifts)
    assert shifts.std(axis=0) == pytest.approx([SIGMA_M] * 4, rel=4.5 / sqrt(2 * n))
    assert np.abs(shifts.mean(axis=0)).max() < 4.5 * SIGMA_M / sqrt(n)
    assert np.abs(np.corrcoef(shifts.T)[np.triu_indices(4, 1)]).max() < 4.5 / sqrt(n)


@pytest.mark.parametrize("sigma_m", [SIGMA_M, 2e-3])
def test_neighbours_keep_a_gap(config: Config, sigma_m: float) -> None:
    mirror = build_mirror(config.mirror)
    for seed in range(20):
        found = edges_of(config, mirror, seed, sigma_m)
        for pid, (_, x1, _, y1) in found.items():
            if right := found.get(PanelId(pid.row, pid.col + 1)):
                assert right[0] - x1 >= MIN_GAP_M - 1e-9  # rounding of metres
            if above := found.get(PanelId(pid.row + 1, pid.col)):
                assert above[2] - y1 >= MIN_GAP_M - 1e-9


def test_material_is_inside_the_shifted_edges_and_nowhere_else(config: Config) -> None:
    mirror = build_mirror(config.mirror)
    rectangles = edges_of(config, mirror)
    sensors = EdgeSensors(mirror, OFFSETS, rectangles)
    for x0, x1, y0, y1 in rectangles.values():
        x, y, d = (x0 + x1) / 2.0, (y0 + y1) / 2.0, 1e-9
        for (px, py), (qx, qy) in zip(
            ((x0 + d, y), (x1 - d, y), (x, y0 + d), (x, y1 - d)),
            ((x0 - d, y), (x1 + d, y), (x, y0 - d), (x, y1 + d)),
            strict=True,
        ):
            assert sensors.is_on(px, py)
            assert not sensors.is_on(qx, qy)
    assert not sensors.is_on(99.0, 0.0)


@pytest.mark.parametrize("is_shifted", [True, slow_case(False)])
@pytest.mark.parametrize("seed", [0])
def test_sensors_see_the_edges_at_every_millisecond(config: Config, seed: int, is_shifted: bool) -> None:
    """Against the plain question asked at each sample, along drives and turns across seams and over the rim."""
    mirror = build_mirror(config.mirror)
    material = edges_of(config, mirror, seed, SIGMA_M if is_shifted else 0.0)
    rng = np.random.default_rng(seed)
    fractions = [(k + 1) / 10.0 for k in range(10)]
    times = [0.001 * (k + 1) for k in range(10)]
    off = ideal = 0
    for _ in range(12):
        centre = mirror.panels[list(mirror.panels)[int(rng.integers(len(mirror.panels)))]]
        dx, dy = rng.uniform(-1, 1, 2)
        start = DeckPose(centre.x_m + dx * centre.half_x_m, centre.y_m + dy * centre.half_y_m, rng.uniform(-pi, pi))
        plant = Plant(mirror.surface, start, wheel_radius_m=0.03, wheel_base_m=0.15, wheel_lag_s=0.08)
        sensors = EdgeSensors(mirror, OFFSETS, material)
        sensors.place(plant)
        right, left = rng.uniform(-7, 7, 2)
        for k in range(150):
            before = [mirror.body_offset(plant.pose, *o) for o in OFFSETS]
            plant.step(k * DT_S, DT_S, right, left)
            after = [mirror.body_offset(plant.pose, *o) for o in OFFSETS]
            for (_, *values), f in zip(sensors.read(plant, times, fractions), fractions, strict=True):
                for value, (x0, y0), (x1, y1) in zip(values, before, after, strict=True):
                    x, y = x0 + f * (x1 - x0), y0 + f * (y1 - y0)
                    if value != sensors.is_on(x, y):
                        # Within a nanometre of an edge rounding may decide.
                        near = [sensors.is_on(x + a, y + b) for a, b in product((-1e-9, 1e-9), repeat=2)]
                        assert len(set(near)) == 2
                    off += 1 - value
                    ideal += value != mirror.is_on_panel(x, y)
    assert off > 100
    assert bool(ideal > 10) is is_shifted


COUNTS, HZ, FRAME_HZ, LAG_S = 1200, 1000.0, 100.0, 0.08
QUANTUM_RAD = 2.0 * pi / COUNTS


def world_of(config: Config, **values: float) -> WorldConfig:
    return config.world.model_copy(update=values)


def plant_on_deck(mirror: Mirror) -> Plant:
    start = DeckPose(0.0, 0.0, 0.3)
    return Plant(mirror.surface, start, wheel_radius_m=0.03, wheel_base_m=0.15, wheel_lag_s=LAG_S)


def orders(frames: int) -> list[tuple[float, float]]:
    """Drives forwards, backwards, turns and stops long enough for the wheels to rest."""
    rng = np.random.default_rng(4)
    found: list[tuple[float, float]] = []
    while len(found) < frames:
        right, left = rng.uniform(-6.0, 6.0, 2).tolist()
        found += [(right, left)] * int(rng.integers(5, 60)) + [(0.0, 0.0)] * int(rng.choice([0, 250]))
    return found[:frames]


@pytest.mark.parametrize("hz", [slow_case(1000.0), 333.0])
def test_the_sum_of_the_rates_is_the_counted_angle(config: Config, mirror: Mirror, hz: float) -> None:
    world = world_of(config, encoder_counts_per_rev=COUNTS)
    plant, encoders = plant_on_deck(mirror), CountingEncoders(world, hz, DT_S, np.random.default_rng(2))
    phases = np.random.default_rng(2).random(2)
    sums, turned = np.zeros(2), 0.0
    for frame, ((right, left), times) in enumerate(
        zip(orders(4000), sample_times(hz, FRAME_HZ, LAG_S, 1, 4000), strict=True), start=1
    ):
        plant.step((frame - 1) * DT_S, DT_S, right, left)
        for _, *rates in encoders.read(plant, times):
            counts = np.array(rates) / hz / QUANTUM_RAD
            assert counts == pytest.approx(np.round(counts), abs=1e-9)  # whole counts but for rounding
            sums += np.array(rates) / hz
            turned += abs(rates[0]) / hz
        if times.fractions and times.fractions[-1] == 1.0:
            angles = np.array([plant.right_angle_rad, plant.left_angle_rad])
            expected = np.floor(angles / QUANTUM_RAD + phases)
            # A wheel that rests on the border of two counts may stand on either.
            fraction = (angles / QUANTUM_RAD + phases) % 1.0
            sure = (fraction > 1e-6) & (fraction < 1.0 - 1e-6)
            assert (np.round(sums / QUANTUM_RAD)[sure] == expected[sure]).all()
    assert turned > 10.0


# -- inertial unit ----------------------------------------------------------------------------------------------------


BIASES = {
    "accelerometer_bias_sigma_m_s2": 0.3,
    "accelerometer_bias_walk_m_s2_sqrt_s": 0.01,
    "gyroscope_bias_sigma_rad_s": 0.0175,
    "gyroscope_bias_walk_rad_s_sqrt_s": 0.003,
    "gyroscope_scale_sigma": 0.01,
}
OFF = dict.fromkeys((*BIASES, "accelerometer_sigma_m_s2", "gyroscope_sigma_rad_s"), 0.0)


@cache
def turning_on(mirror: Mirror) -> Plant:
    """A robot that turns at 0.8 rad/s; the same for all readings, which leave it as it is."""
    plant = plant_on_deck(mirror)
    plant.right_rad_s, plant.left_rad_s = 2.0, -2.0
    plant.step(0.0, DT_S, 2.0, -2.0)
    return plant


def readings(config: Config, mirror: Mirror, seed: int, frames: int, **values: float) -> list[tuple[float, float]]:
    """(ax, wz) of a robot that turns at 0.8 rad/s."""
    plant = turning_on(mirror)
    noise, biases = np.random.default_rng(seed).spawn(2)
    unit = InertialUnit(world_of(config, **{**OFF, **values}), 100.0, noise, biases)
    found = []
    for times in sample_times(100.0, FRAME_HZ, LAG_S, 1, frames):
        ((_, ax, wz),) = unit.read(plant, times)
        found.append((ax, wz))
    return found


def test_biases_and_scale_have_their_sigmas(config: Config, mirror: Mirror) -> None:
    error = 4.5 / sqrt(2 * 200)
    biases = {key: BIASES[key] for key in ("accelerometer_bias_sigma_m_s2", "gyroscope_bias_sigma_rad_s")}
    found = np.array([readings(config, mirror, seed, 1, **biases)[0] for seed in range(200)])
    assert found.std(axis=0) == pytest.approx([0.3, 0.0175], rel=error)
    assert found.mean(axis=0) == pytest.approx([0.0, 0.8], abs=4.5 * 0.3 / sqrt(200))
    assert abs(np.corrcoef(found.T)[0, 1]) < 4.5 / sqrt(200)
    scaled = np.array([readings(config, mirror, seed, 1, gyroscope_scale_sigma=0.01)[0] for seed in range(200)])
    assert (scaled[:, 1] / 0.8).std() == pytest.approx(0.01, rel=error)
    assert (scaled[:, 0] == 0.0).all()


def test_biases_walk(config: Config, mirror: Mirror) -> None:
    walks = {key: value for key, value in BIASES.items() if "walk" in key}
    ends = np.array([readings(config, mirror, seed, 100, **walks)[-1] for seed in range(150)])
    assert ends.std(axis=0) == pytest.approx([0.01, 0.003], rel=4.5 / sqrt(2 * 150))  # one second
    assert ends.mean(axis=0) == pytest.approx([0.0, 0.8], abs=4.5 * 0.01 / sqrt(150))


@pytest.mark.parametrize("key", [*BIASES, "accelerometer_sigma_m_s2", "gyroscope_sigma_rad_s"])
def test_each_error_of_the_inertial_unit_is_switched_off_by_itself(config: Config, mirror: Mirror, key: str) -> None:
    """Errors add up, but for the scale, which multiplies only the true rate: none changes the draws of another."""
    every = {**BIASES, "accelerometer_sigma_m_s2": 0.0059, "gyroscope_sigma_rad_s": 0.0087}
    whole = np.array(readings(config, mirror, 3, 30, **every))
    without = np.array(readings(config, mirror, 3, 30, **{**every, key: 0.0}))
    alone = np.array(readings(config, mirror, 3, 30, **{key: every[key]}))
    nothing = np.array(readings(config, mirror, 3, 30))
    assert whole - without == pytest.approx(alone - nothing, abs=3e-7)  # readings are rounded to 1e-7
    assert np.abs(whole - without).max() > 1e-4


# -- the laser metrology -----------------------------------------------------------------------------------------------

CHANNELS = (1, 2, 5, 9)
COLLIMATORS = np.array([[0.0, 0.0, 10.0], [3.0, 0.0, 9.0], [0.0, 4.0, 8.0], [-3.0, -4.0, 12.0]])
PUCK = PuckTruth(t_s=12.5, position_m=(0.1, -0.2, 0.3), moved_m=0.0)
CFG = SimEtalonConfig(host="127.0.0.1", port=0, length_sigma_m=1e-6, length_sigma_per_m=2.5e-7, motion_tolerance_m=1e-4)


def model(cfg: SimEtalonConfig = CFG, seed: int = 1) -> EtalonModel:
    return EtalonModel(cfg, CHANNELS, COLLIMATORS, np.random.default_rng(seed))


def test_noise_is_normal_with_the_configured_sigma_per_channel() -> None:
    lengths_m = np.linalg.norm(COLLIMATORS - PUCK.position_m, axis=1)
    sigmas_m = 1e-6 + 2.5e-7 * lengths_m
    etalon = model()
    draws = np.array(
        [
            [r.length_mm * 1e-3 for r in etalon.records(CHANNELS, msgspec.structs.replace(PUCK, t_s=0.01 * k))]
            for k in range(500)
        ]
    )
    normalised = ((draws - lengths_m) / sigmas_m).ravel()
    # Kolmogorov-Smirnov of 2000 draws; the seed is fixed, so this is a check of the code and not of luck.
    assert stats.kstest(normalised, "norm").pvalue > 0.01
    # Channels are independent: correlations of 500 pairs stay within 4.5/sqrt(500).
    correlations = np.corrcoef((draws - lengths_m).T)[np.triu_indices(4, 1)]
    assert np.all(np.abs(correlations) < 0.2)


def test_noise_belongs_to_seed_time_and_channel_and_to_nothing_else() -> None:
    first = model()
    reference = first.records(CHANNELS, PUCK)
    other = model()
    other.records(CHANNELS, msgspec.structs.replace(PUCK, t_s=3.0))
    assert other.records(CHANNELS[::-1], PUCK) == reference[::-1]
    assert (
        first.records(CHANNELS[2:], msgspec.structs.replace(PUCK, t_s=PUCK.t_s + 4e-7)) == reference[2:]
    )  # less than half a us
    assert first.records(CHANNELS, msgspec.structs.replace(PUCK, t_s=PUCK.t_s + 1e-6)) != reference
    assert model(seed=2).records(CHANNELS, PUCK) != reference


def test_a_blocked_channel_has_no_length_no_light_and_beam_break() -> None:
    etalon = model()
    etalon.blocked = {2}
    blocked = etalon.records(CHANNELS, PUCK)[1]
    assert blocked.errors == ("beam_break",)
    assert (blocked.length_mm, blocked.intensity_min, blocked.intensity_max) == (0.0, 0, 0)


def test_channels_and_collimators_must_fit() -> None:
    assert model().channels == CHANNELS
    with pytest.raises(ValueError, match=r"3 channels, collimators of shape \(4, 3\)"):
        EtalonModel(CFG, (1, 2, 3), COLLIMATORS, np.random.default_rng(1))
