"""What the simulated sensors read."""

from math import acos, cos, pi, sin

import numpy as np
import pytest

from ccatp.config.models import Config, SimRobotConfig
from ccatp.core import DeckPose
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.sim.disturbances import NoiseStream
from ccatp.sim.edge_sensors import EdgeSensors
from ccatp.sim.plant import Plant
from ccatp.sim.sensors import SampleTimes, SensorSuite

OFFSETS = ((0.09, 0.09), (0.09, -0.09), (-0.09, 0.09), (-0.09, -0.09))
DT_S = 0.01


@pytest.fixture(scope="module")
def mirror(config: Config) -> Mirror:
    return build_mirror(config.mirror)


def plant_at(mirror: Mirror, start: DeckPose) -> Plant:
    return Plant(mirror.surface, start, wheel_radius_m=0.03, wheel_base_m=0.15, wheel_lag_s=0.08)


def suite(config: Config, mirror: Mirror, **rates: float) -> SensorSuite:
    cfg: SimRobotConfig = config.sim.robot.model_copy(update=rates)
    rng = np.random.default_rng(1)
    return SensorSuite(mirror, cfg, config.world, OFFSETS, rng, panels=config.mirror.panels, lag_s=cfg.wheel_lag_s)


# -- noise and times --------------------------------------------------------------------------------------------------


def test_a_noise_stream_is_the_same_however_it_is_taken() -> None:
    whole = NoiseStream(np.random.default_rng(3)).take(20_000)
    stream = NoiseStream(np.random.default_rng(3))
    pieces: list[float] = []
    while len(pieces) < 20_000:
        pieces += stream.take(min(1 + len(pieces) % 977, 20_000 - len(pieces)))
    assert pieces == whole
    assert stream.take(0) == []


@pytest.mark.parametrize(
    ("hz", "frame_hz"), [(1000.0, 100.0), (100.0, 100.0), (20.0, 100.0), (333.0, 100.0), (50.0, 30.0), (7.3, 100.0)]
)
def test_every_instant_falls_into_exactly_one_frame(hz: float, frame_hz: float) -> None:
    times = SampleTimes(hz, frame_hz, 0.08)
    found: list[float] = []
    for frame in range(1, 301):
        times.enter(frame)
        for t, fraction, decay in zip(times.times_s, times.fractions, times.decays, strict=True):
            assert (frame - 1) / frame_hz < t + 1e-12  # times are rounded to the last bit
            assert t <= frame / frame_hz + 1e-12
            assert fraction == pytest.approx(t * frame_hz - (frame - 1), abs=1e-9)
            assert decay == pytest.approx(np.exp(-fraction / frame_hz / 0.08), abs=1e-9)
        found += times.times_s
    assert found == [n / hz for n in range(1, len(found) + 1)]
    assert len(found) == int(300 / frame_hz * hz + 1e-9)


def test_boot_is_a_single_instant() -> None:
    times = SampleTimes(1000.0, 100.0, 0.08)
    times.enter(0)
    assert (times.times_s, times.decays) == ([0.0], [1.0])
    times.enter(1)
    assert times.times_s == [n / 1000.0 for n in range(1, 11)]
    assert len(times.decays) == 10


# -- inertial unit, encoders, gravity ---------------------------------------------------------------------------------


def test_readings_are_the_truth_plus_noise_of_the_world(config: Config, mirror: Mirror) -> None:
    sensors = suite(config, mirror)
    plant = plant_at(mirror, DeckPose(0.0, 0.0, 0.3))
    errors: dict[str, list[float]] = {"ax": [], "wz": [], "enc": []}
    for frame in range(1, 1501):
        side = 1.0 if frame % 100 < 50 else -1.0
        plant.step((frame - 1) * DT_S, DT_S, 3.0 * side, 2.0 * side)
        sensors.enter(frame)
        ((t, ax, wz),) = sensors.read_imu(plant)
        assert t == frame / 100.0
        speed_rate = 0.03 * ((3.0 + 2.0) * side - plant.right_rad_s - plant.left_rad_s) / 2.0 / 0.08
        errors["ax"].append(ax - speed_rate)
        errors["wz"].append(wz - 0.03 * (plant.right_rad_s - plant.left_rad_s) / 0.15)
        encoders = sensors.read_encoders(plant)
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


def test_right_and_left_encoder_noise_are_independent(config: Config, mirror: Mirror) -> None:
    sensors, plant = suite(config, mirror), plant_at(mirror, DeckPose(0.0, 0.0, 0.0))
    rows = []
    for frame in range(1, 301):
        sensors.enter(frame)
        rows += [row[1:] for row in sensors.read_encoders(plant)]
    assert abs(np.corrcoef(np.array(rows).T)[0, 1]) < 4.5 / np.sqrt(len(rows))


def test_noise_of_one_sensor_does_not_depend_on_the_rate_of_another(config: Config, mirror: Mirror) -> None:
    plant = plant_at(mirror, DeckPose(0.0, 0.0, 0.0))
    found = []
    for encoder_hz in (1000.0, 100.0):
        sensors = suite(config, mirror, encoder_hz=encoder_hz)
        readings = []
        for frame in range(1, 50):
            sensors.enter(frame)
            sensors.read_encoders(plant)
            readings.append((sensors.read_imu(plant), sensors.read_gravity(plant)))
        found.append(readings)
    assert found[0] == found[1]


def test_gravity_comes_at_its_own_rate_within_its_noise(config: Config, mirror: Mirror) -> None:
    sensors, plant = suite(config, mirror), plant_at(mirror, DeckPose(0.5, 0.5, 1.0))
    g = np.array(mirror.gravity_in_robot(plant.pose))
    angles, times = [], []
    for frame in range(1, 5001):
        sensors.enter(frame)
        if (reading := sensors.read_gravity(plant)) is not None:
            times.append(reading[0])
            assert np.linalg.norm(reading[1:]) == pytest.approx(1.0, abs=1e-6)  # rounded to 1e-7 each
            angles.append(acos(min(1.0, float(np.dot(reading[1:], g)))))
    assert times == [k / 20.0 for k in range(1, 1001)]
    # Two components across the direction: rms angle is sqrt(2) sigma; 1000 draws.
    sigma = config.sim.robot.gravity_sigma_rad
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(2.0**0.5 * sigma, rel=0.08)


# -- edge sensors -----------------------------------------------------------------------------------------------------


def test_edges_are_those_of_the_panels_at_every_millisecond(mirror: Mirror) -> None:
    """Against the plain question asked at each sample, along drives and turns across seams and over the rim."""
    rng = np.random.default_rng(5)
    times = [0.001 * (k + 1) for k in range(10)]
    fractions = [(k + 1) / 10.0 for k in range(10)]
    off = 0
    for _ in range(40):
        centre = mirror.panels[list(mirror.panels)[int(rng.integers(len(mirror.panels)))]]
        start = DeckPose(
            centre.x_m + rng.uniform(-1, 1) * centre.half_x_m, centre.y_m + rng.uniform(-1, 1) * centre.half_y_m,
            rng.uniform(-pi, pi),
        )  # fmt: skip
        plant, edges = plant_at(mirror, start), EdgeSensors(mirror, OFFSETS)
        edges.place(plant)
        right, left = rng.uniform(-7, 7, 2)
        for k in range(150):
            before = [mirror.body_offset(plant.pose, *o) for o in OFFSETS]
            plant.step(k * DT_S, DT_S, right, left)
            after = [mirror.body_offset(plant.pose, *o) for o in OFFSETS]
            for (_, *values), f in zip(edges.read(plant, times, fractions), fractions, strict=True):
                for value, (x0, y0), (x1, y1) in zip(values, before, after, strict=True):
                    x, y = x0 + f * (x1 - x0), y0 + f * (y1 - y0)
                    if value != mirror.is_on_panel(x, y):
                        # Within a nanometre of a panel's edge rounding may decide.
                        assert mirror.is_on_panel(x + 1e-9, y) != mirror.is_on_panel(x - 1e-9, y) or (
                            mirror.is_on_panel(x, y + 1e-9) != mirror.is_on_panel(x, y - 1e-9)
                        )
                    off += 1 - value
    assert off > 1000  # the drives did meet edges


def test_a_sensor_that_stops_over_a_gap_stays_off(mirror: Mirror) -> None:
    panel = mirror.panels[next(iter(mirror.panels))]
    gap_x = panel.x_m + panel.half_x_m + mirror.gap_m / 2.0
    start = DeckPose(gap_x, panel.y_m, 0.0)
    # Put the front left sensor over the gap: walk the robot back along its own x axis.
    hx, _, lx, _ = mirror.body_axes(start)
    plant = plant_at(mirror, DeckPose(gap_x - 0.09 * hx - 0.09 * lx, panel.y_m, 0.0))
    edges = EdgeSensors(mirror, OFFSETS)
    edges.place(plant)
    for k in range(3):
        plant.step(k * DT_S, DT_S, 0.0, 0.0)
        readings = edges.read(plant, [0.001, 0.002], [0.1, 0.2])
        assert [reading[1] for reading in readings] == [0, 0]
        assert [reading[3:] for reading in readings] == [(1, 1), (1, 1)]


def test_places_follow_the_robot(mirror: Mirror) -> None:
    plant, edges = plant_at(mirror, DeckPose(0.1, 0.2, 0.5)), EdgeSensors(mirror, OFFSETS)
    edges.place(plant)
    for (x, y), (ox, oy) in zip(edges.places, OFFSETS, strict=True):
        # The slope at this place shortens projections by less than 1 %.
        assert x == pytest.approx(0.1 + ox * cos(0.5) - oy * sin(0.5), abs=1e-3)
        assert y == pytest.approx(0.2 + ox * sin(0.5) + oy * cos(0.5), abs=1e-3)
