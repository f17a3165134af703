"""Encoders that count, and the inertial unit's offsets."""

from math import floor, pi, sqrt

import numpy as np
import pytest

from ccatp.config.models import Config, WorldConfig
from ccatp.core import DeckPose
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.sim.plant import Plant
from ccatp.sim.sensors import CountingEncoders, InertialUnit, RateEncoders, SampleTimes

COUNTS, HZ, FRAME_HZ, LAG_S = 1200, 1000.0, 100.0, 0.08
QUANTUM_RAD = 2.0 * pi / COUNTS
DT_S = 0.01


@pytest.fixture(scope="module")
def mirror(config: Config) -> Mirror:
    return build_mirror(config.mirror)


def world_of(config: Config, **values: float) -> WorldConfig:
    return config.world.model_copy(update=values)


def plant_on(mirror: Mirror) -> Plant:
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


@pytest.mark.parametrize("hz", [1000.0, 333.0])
def test_the_sum_of_the_rates_is_the_counted_angle(config: Config, mirror: Mirror, hz: float) -> None:
    world = world_of(config, encoder_counts_per_rev=COUNTS)
    plant, encoders = plant_on(mirror), CountingEncoders(world, hz, DT_S, np.random.default_rng(2))
    phases = np.random.default_rng(2).random(2)
    times = SampleTimes(hz, FRAME_HZ, LAG_S)
    sums, turned = np.zeros(2), 0.0
    for frame, (right, left) in enumerate(orders(4000), start=1):
        plant.step((frame - 1) * DT_S, DT_S, right, left)
        times.enter(frame)
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


def test_the_counted_angle_is_that_of_the_wheel_at_every_sample(config: Config, mirror: Mirror) -> None:
    """Against an integration of the servo's equation by many small steps."""
    world = world_of(config, encoder_counts_per_rev=100_000)
    plant, encoders = plant_on(mirror), CountingEncoders(world, HZ, DT_S, np.random.default_rng(2))
    times = SampleTimes(HZ, FRAME_HZ, LAG_S)
    rate = angle = counted = 0.0
    small = 1e-5
    for frame in range(1, 21):
        set_point = 5.0 if frame <= 10 else -2.0
        plant.step((frame - 1) * DT_S, DT_S, set_point, 0.0)
        times.enter(frame)
        for _, right, left in encoders.read(plant, times):
            assert left == 0.0
            for _ in range(100):
                middle = rate + 0.5 * small * (set_point - rate) / LAG_S
                angle += small * middle
                rate += small * (set_point - middle) / LAG_S
            counted += right / HZ
            assert counted == pytest.approx(angle, abs=2.0 * 2.0 * pi / 100_000)  # a count, and where the first began


def test_the_place_of_the_first_count_is_uniform(config: Config, mirror: Mirror) -> None:
    """A wheel that turns a third of a count passes one in a third of all robots."""
    world = world_of(config, encoder_counts_per_rev=COUNTS)
    plant, times = plant_on(mirror), SampleTimes(HZ, FRAME_HZ, LAG_S)
    plant.step(0.0, DT_S, 5.0, 5.0)
    share = plant.right_angle_rad / QUANTUM_RAD
    share -= floor(share)
    times.enter(1)
    passed = []
    for seed in range(1500):
        rows = CountingEncoders(world, HZ, DT_S, np.random.default_rng(seed)).read(plant, times)
        passed.append(
            round(sum(row[1] for row in rows) / HZ / QUANTUM_RAD) - floor(plant.right_angle_rad / QUANTUM_RAD)
        )
    assert set(passed) <= {0, 1}
    assert np.mean(passed) == pytest.approx(share, abs=4.5 * 0.5 / sqrt(1500))


def test_counting_adds_no_white_noise(config: Config, mirror: Mirror) -> None:
    found = []
    for sigma in (0.0, 0.5):
        world = world_of(config, encoder_counts_per_rev=COUNTS, encoder_sigma_rad_s=sigma)
        plant, encoders = plant_on(mirror), CountingEncoders(world, HZ, DT_S, np.random.default_rng(2))
        times = SampleTimes(HZ, FRAME_HZ, LAG_S)
        plant.step(0.0, DT_S, 3.0, 2.0)
        times.enter(1)
        found.append(encoders.read(plant, times))
    assert found[0] == found[1]


def test_noise_at_rest_is_that_in_motion(config: Config, mirror: Mirror) -> None:
    """The short way for wheels that stand takes the same numbers of the stream."""
    still, moving = plant_on(mirror), plant_on(mirror)
    moving.step(0.0, DT_S, 1e-12, 1e-12)  # so slow that nothing of it is left after rounding
    times = SampleTimes(HZ, FRAME_HZ, LAG_S)
    encoders = [RateEncoders(0.001, np.random.default_rng(2)) for _ in range(2)]
    for frame in range(1, 700):  # more than two blocks of the stream
        times.enter(frame)
        at_rest, in_motion = (e.read(plant, times) for e, plant in zip(encoders, (still, moving), strict=True))
        assert np.array(at_rest) == pytest.approx(np.array(in_motion), abs=1.5e-7)  # the last digit


# -- inertial unit ----------------------------------------------------------------------------------------------------

BIASES = {
    "accelerometer_bias_sigma_m_s2": 0.3,
    "accelerometer_bias_walk_m_s2_sqrt_s": 0.01,
    "gyroscope_bias_sigma_rad_s": 0.0175,
    "gyroscope_bias_walk_rad_s_sqrt_s": 0.003,
    "gyroscope_scale_sigma": 0.01,
}
OFF = dict.fromkeys((*BIASES, "accelerometer_sigma_m_s2", "gyroscope_sigma_rad_s"), 0.0)


def readings(config: Config, mirror: Mirror, seed: int, frames: int, **values: float) -> list[tuple[float, float]]:
    """(ax, wz) of a robot that turns at 0.8 rad/s."""
    noise, biases = np.random.default_rng(seed).spawn(2)
    unit = InertialUnit(world_of(config, **{**OFF, **values}), 100.0, noise, biases)
    plant, times = plant_on(mirror), SampleTimes(100.0, FRAME_HZ, LAG_S)
    plant.right_rad_s, plant.left_rad_s = 2.0, -2.0
    plant.step(0.0, DT_S, 2.0, -2.0)
    found = []
    for frame in range(1, frames + 1):
        times.enter(frame)
        ((_, ax, wz),) = unit.read(plant, times)
        found.append((ax, wz))
    return found


def test_biases_and_scale_have_their_sigmas(config: Config, mirror: Mirror) -> None:
    error = 4.5 / sqrt(2 * 800)
    biases = {key: BIASES[key] for key in ("accelerometer_bias_sigma_m_s2", "gyroscope_bias_sigma_rad_s")}
    found = np.array([readings(config, mirror, seed, 1, **biases)[0] for seed in range(800)])
    assert found.std(axis=0) == pytest.approx([0.3, 0.0175], rel=error)
    assert found.mean(axis=0) == pytest.approx([0.0, 0.8], abs=4.5 * 0.3 / sqrt(800))
    assert abs(np.corrcoef(found.T)[0, 1]) < 4.5 / sqrt(800)
    scaled = np.array([readings(config, mirror, seed, 1, gyroscope_scale_sigma=0.01)[0] for seed in range(800)])
    assert (scaled[:, 1] / 0.8).std() == pytest.approx(0.01, rel=error)
    assert (scaled[:, 0] == 0.0).all()


def test_biases_walk(config: Config, mirror: Mirror) -> None:
    walks = {key: value for key, value in BIASES.items() if "walk" in key}
    ends = np.array([readings(config, mirror, seed, 100, **walks)[-1] for seed in range(400)])
    assert ends.std(axis=0) == pytest.approx([0.01, 0.003], rel=4.5 / sqrt(2 * 400))  # one second
    assert ends.mean(axis=0) == pytest.approx([0.0, 0.8], abs=4.5 * 0.01 / sqrt(400))


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
