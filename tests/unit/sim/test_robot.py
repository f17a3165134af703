"""The whole simulated robot, frame by frame, in virtual time."""

import json
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from ccatp.config.models import Config
from ccatp.config.robot_limits import FRAME_HZ
from ccatp.core import DeckPose, PanelId
from ccatp.links.robot_codec import MAX_LINE_BYTES, decode_from_robot
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import Mirror
from ccatp.sim import ground_truth
from ccatp.sim.ground_truth import GroundTruthPublisher
from ccatp.sim.robot import Robot
from ccatp.sim.world import TruthRow
from tests.support.scenario import boot, config_of, drive, mirror_of, sensors_of


@pytest.fixture(scope="module")
def overhang() -> Config:
    return config_of("fyst-m2")


def test_boot_is_frame_zero(config: Config, mirror: Mirror) -> None:
    sensors = sensors_of(boot(config, mirror))
    assert (sensors.seq, sensors.t, sensors.fans, sensors.faults) == (0, 0.0, (0.0, 0.0), [])
    assert [sample.t_s for sample in sensors.imu] == [0.0]
    assert [sample.t_s for sample in sensors.enc] == [0.0]
    assert [sample[:] for sample in sensors.edge] == [(0.0, 1, 1, 1, 1)]
    assert sensors.gravity is not None
    assert (sensors.cmd.seq, sensors.cmd.age, sensors.cmd.held) == (0, 0.0, True)


def test_misalignment_and_start_have_the_configured_spread(config: Config, mirror: Mirror) -> None:
    starts, pistons, tips, tilts = [], [], [], []
    base = mirror.base_panel_pose
    for seed in range(40):
        world = boot(config, mirror, seed).world
        start = world.start_panel_pose
        starts.append((start.x_m - base.x_m, start.y_m - base.y_m, start.heading_rad - base.heading_rad))
        for m in world.misalignments.values():
            pistons.append(m.piston_m)
            tips.append(m.tip_rad)
            tilts.append(m.tilt_rad)
    sigmas = np.array(starts).std(axis=0)
    # 120 numbers of 40 draws: 4.5 standard errors are 50 %; some 3000 draws: 6 %.
    assert sigmas == pytest.approx([0.002, 0.002, 0.01], rel=0.5)
    truth = config.sim.truth
    assert np.std(pistons) == pytest.approx(truth.piston_sigma_m, rel=0.06)
    assert np.std(tips) == pytest.approx(truth.tilt_sigma_rad, rel=0.06)
    assert np.std(tilts) == pytest.approx(truth.tilt_sigma_rad, rel=0.06)


def test_moved_looks_back_over_one_measuring_time(config: Config, mirror: Mirror) -> None:
    robot = boot(config, mirror)
    assert robot.world.moved_m() == 0.0
    drive(robot, 3.0, 3.0, 100)
    # 50 frames at 0.09 m/s.
    assert robot.world.moved_m() == pytest.approx(0.045, abs=1e-4)
    drive(robot, 3.0, -3.0, 100)
    drive(robot, 0.0, 0.0, 250)
    assert robot.world.moved_m() < 1e-9
    drive(robot, 3.0, 3.0, 10)
    drive(robot, -3.0, -3.0, 10)
    assert robot.world.moved_m() > 1e-3  # there and back counts


# -- falling ----------------------------------------------------------------------------------------------------------


def drive_off(robot: Robot, frames: int = 3000) -> list[TruthRow]:
    rows = []
    for _ in range(frames):
        drive(robot, 3.0, 3.0, 1)
        rows.append(robot.world.truth_row(robot.seq, robot.t_s))
    return rows


def test_it_falls_when_its_centre_passes_the_rim_and_never_moves_again(config: Config, mirror: Mirror) -> None:
    robot = boot(config, mirror)
    rows = drive_off(robot)
    rim = mirror.rim
    first = next(k for k, row in enumerate(rows) if row[9])
    x, y = rows[first][2:4]
    assert -0.001 <= rim.signed_distance_m(x, y) <= 0.0  # within a frame of 0.9 mm
    assert all(rim.signed_distance_m(row[2], row[3]) >= 0.0 for row in rows[:first])
    assert {row[2:8] for row in rows[first:]} == {rows[first][2:8]}
    assert sensors_of(robot).cmd.held
    # The truth is never on the link.
    assert sensors_of(robot).faults == []


def test_a_sensor_that_is_off_at_the_rim_is_beyond_it_wherever_the_panel_ends() -> None:
    """Panels end some 0.2 mm off: a sensor that is off there has no clearance, short of the rim as drawn or not."""
    cfg, mirror, short = config_of(run__world="hard"), mirror_of(), 0
    for seed in range(1, 9):
        robot = boot(cfg, mirror, seed)
        is_off, clearance_m = False, 1.0
        while not (clearance_m < 0.0 or (is_off and clearance_m < 5e-3)):
            rate_rad_s = -3.0 if clearance_m > 0.02 else -0.3
            drive(robot, rate_rad_s, rate_rad_s, 1)
            is_off = any(0 in sample[1:] for sample in sensors_of(robot).edge)
            clearance_m = robot.world.truth_row(robot.seq, robot.t_s)[8]
        assert clearance_m < 0.0
        assert robot.world.sensors is not None
        short += min(mirror.rim.signed_distance_m(*place) for place in robot.world.sensors.places) > 0.0
    assert short > 0


def test_the_distance_to_the_rim_is_never_missed_after_a_long_drive_inside(config: Config, mirror: Mirror) -> None:
    """It is measured anew only when the distance driven could have brought it near."""
    robot = boot(config, mirror)
    plant = robot.world.plant
    plant.x_m = plant.y_m = 0.0  # far from every rim
    robot.world._rim_bound_m = mirror.rim.signed_distance_m(0.0, 0.0)
    while not robot.world.is_fallen:
        assert robot.t_s < 60.0
        drive(robot, 8.0, 8.0, 1)
        assert mirror.rim.signed_distance_m(plant.x_m, plant.y_m) > -0.003  # a frame of 2.4 mm
    drive(robot, 8.0, 8.0, 2)
    assert not plant.is_moving


def test_clearance_and_mask_of_the_truth_are_those_of_the_sensors(config: Config, mirror: Mirror) -> None:
    robot = boot(config, mirror)
    seen = set()
    for row in drive_off(robot):
        if row[9]:
            break
        pose = DeckPose(*row[2:5])
        clearances = [
            mirror.rim.signed_distance_m(*mirror.body_offset(pose, *offset)) for offset in config.robot.edge_sensors_m
        ]
        if mirror.rim.signed_distance_m(pose.x_m, pose.y_m) < 0.25:
            assert row[8] == pytest.approx(min(clearances), abs=1e-8)
            assert row[10] == sum((c < 0.0) << k for k, c in enumerate(clearances))
            seen.add(row[10])
        else:
            assert (row[8], row[10]) == (1.0, 0)
        assert row[7] == pytest.approx(mirror.surface.height_m(pose.x_m, pose.y_m), abs=1e-9)
    assert len(seen) >= 2


def test_on_an_overhang_thrust_below_the_floor_lets_it_fall(overhang: Config) -> None:
    robot = boot(overhang, mirror_of("fyst-m2"))
    assert sensors_of(robot).fans == (0.6, 0.6)
    drive(robot, 0.0, 0.0, 100)
    robot.fans.command(0.0, 0.0)
    drive(robot, 0.0, 0.0, 100)
    assert not robot.world.is_fallen  # clamped to the floor
    robot.fans.health = (1.0, 0.5)
    drive(robot, 0.0, 0.0, 19)
    robot.fans.health = (1.0, 1.0)
    drive(robot, 0.0, 0.0, 1)
    robot.fans.health = (1.0, 0.5)
    drive(robot, 0.0, 0.0, 19)
    assert not robot.world.is_fallen
    drive(robot, 0.0, 0.0, 1)
    assert robot.world.is_fallen  # 0.2 s without a break
    assert sensors_of(robot).cmd.held


# -- configuration ----------------------------------------------------------------------------------------------------


def with_rates(config: Config, **rates: float) -> Config:
    robot = config.sim.robot.model_copy(update=rates)
    return config.model_copy(update={"sim": config.sim.model_copy(update={"robot": robot})})


def test_the_longest_frame_within_the_limits_fits_a_line(config: Config, mirror: Mirror) -> None:
    rates = {"frame_hz": FRAME_HZ.low, "encoder_hz": 1000.0, "edge_hz": 1000.0, "imu_hz": 100.0, "gravity_hz": 100.0}
    world = config.world.model_copy(update={"encoder_counts_per_rev": 4096})  # counted rates have all their digits
    robot = boot(with_rates(config.model_copy(update={"world": world}), **rates), mirror)
    lines = []
    for number in range(1, 20):
        robot.drive(number, 7.1234567, 7.7654321)
        robot.advance()
        lines.append(robot.delivered_line)
    assert 3000 < max(map(len, lines)) <= MAX_LINE_BYTES


# -- what the truth gives away ----------------------------------------------------------------------------------------


class Outbox:
    """Keeps what is published."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Any]] = []

    def send(self, topic: str, message: Any) -> None:
        self.sent.append((topic, message))

    def close(self) -> None:
        pass


@pytest.fixture
def outbox(monkeypatch: pytest.MonkeyPatch) -> Outbox:
    found = Outbox()
    monkeypatch.setattr(ground_truth, "Publisher", lambda _context, _endpoint: found)
    return found


def test_truth_comes_in_batches(config: Config, mirror: Mirror, outbox: Outbox) -> None:
    robot = boot(config, mirror)
    with closing(GroundTruthPublisher(robot, pub="inproc://truth")) as truth:
        for _ in range(250):
            drive(robot, 3.0, 3.0, 1)
            truth.add()
        assert [topic for topic, _ in outbox.sent] == ["misalignment", "truth", "truth"]
        assert truth.answer(b"flush") == truth.answer(b"flush") == b'{"rows":251}'
    batches = [message for topic, message in outbox.sent if topic == "truth"]
    assert [batch.seq for batch in batches] == [99, 199, 250]
    assert [row[0] for batch in batches for row in batch.rows] == list(range(251))


def test_a_fall_is_reported_at_once(config: Config, mirror: Mirror, outbox: Outbox) -> None:
    robot = boot(config, mirror)
    with closing(GroundTruthPublisher(robot, pub="inproc://truth")) as truth:
        while not robot.world.is_fallen:
            truth.flush()
            outbox.sent.clear()
            drive(robot, 3.0, 3.0, 1)
            truth.add()
            assert bool(outbox.sent) is robot.world.is_fallen


def test_answers(config: Config, mirror: Mirror) -> None:
    robot = boot(config, mirror)
    with closing(GroundTruthPublisher(robot)) as truth:
        puck, reported, unknown = (json.loads(truth.answer(name)) for name in (b"puck", b"misalignment", b"x" * 1000))
    assert (puck["t"], puck["moved_m"], tuple(puck["puck"])) == (0.0, 0.0, robot.world.puck_world())
    assert [PanelId(*row[:2]) for row in reported["panels"]] == list(mirror.panels)
    assert [list(row) for row in robot.truth_preface()[1].panels] == reported["panels"]
    assert reported["start"][:2] == [robot.world.start_pose.x_m, robot.world.start_pose.y_m]
    assert "unknown request" in unknown["error"]


# -- disturbed worlds -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hard() -> Config:
    return config_of(run__world="hard")


Row = tuple[object, ...]


def survey(config: Config, mirror: Mirror, seed: int = 1, frames: int = 400) -> list[tuple[Row, Sensors | None]]:
    """Turn, drive, stop, again and again, with the fans on: the truth and what is delivered, frame by frame."""
    robot = boot(config, mirror, seed)
    robot.join("controller")
    robot.command_fans(0, 0.8, 0.8)
    rows: list[tuple[Row, Sensors | None]] = []
    for k in range(frames):
        phase = k % 100
        robot.drive(k, *((-2.0, 2.0) if phase < 20 else (3.0, 3.0) if phase < 60 else (0.0, 0.0)))
        robot.advance()
        rows.append((robot.world.truth_row(robot.seq, robot.t_s), robot.delivered))
    return rows


@pytest.mark.parametrize("world", ["thesis", "hard", "extreme"])
def test_what_is_delivered_equals_its_line(mirror: Mirror, world: str) -> None:
    cfg = config_of(run__world=world)
    robot = boot(cfg, mirror)
    robot.join("controller")
    robot.join("monitor")
    seen = 0
    for k in range(600):
        robot.command_fans(k, 0.8, 0.7)
        robot.permit(k, True, k % 100 < 90, True)
        robot.drive(k, 5.0 * np.cos(0.1 * k), 5.0 * np.sin(0.07 * k))
        robot.advance()
        if robot.delivered is None:
            assert (robot.delivered_line, robot.delivered_seq) == (b"", -1)
            continue
        assert decode_from_robot(robot.delivered_line[:-1]) == robot.delivered
        # Equal is not enough: 1 == 1.0, and a named tuple equals a plain one.
        assert repr(decode_from_robot(robot.delivered_line[:-1])) == repr(robot.delivered)
        assert robot.delivered is robot.delivered
        seen += 1
    assert seen >= 598


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_a_frame_is_delivered_when_the_clock_shows_its_time_and_the_delay(
    config: Config, mirror: Mirror, frames: int
) -> None:
    at_once = survey(config, mirror)
    late = survey(config_of(world__sensors_delay_s=0.01 * frames), mirror)
    assert [row for row, _ in late] == [row for row, _ in at_once]  # only the news is late
    for k in range(frames + 1, 300):
        assert late[k][1] == at_once[k - frames][1]
    boot_frame = late[frames - 1][1] if frames else None
    assert [sensors is None for _, sensors in late[:frames]] == [True] * (frames - 1) + [False] * min(frames, 1)
    assert boot_frame is None or boot_frame.seq == 0


KINDS = {
    "encoders": ["encoder_counts_per_rev"],
    "gyroscope": ["gyroscope_bias_sigma_rad_s", "gyroscope_bias_walk_rad_s_sqrt_s", "gyroscope_scale_sigma"],
    "accelerometer": ["accelerometer_bias_sigma_m_s2", "accelerometer_bias_walk_m_s2_sqrt_s"],
    "slip": ["slip_min", "slip_max", "slip_walk_sigma"],
    "creep": ["creep_fraction"],
    "vibration": ["vibration_rate_rad_s", "vibration_speed_m_s", "vibration_acceleration_m_s2"],
    "wheels": ["wheel_radius_sigma", "wheel_base_sigma", "wheel_lag_spread"],
    "edges": ["panel_edge_sigma_m"],
}
BODY = {"slip", "creep", "vibration", "wheels"}


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_alone_changes_what_is_its_own(config: Config, hard: Config, mirror: Mirror, kind: str) -> None:
    """In an otherwise quiet world: a body that is pushed moves elsewhere, a sensor that errs does not move it."""
    alone = config_of(**{f"world__{key}": getattr(hard.world, key) for key in KINDS[kind]})
    quiet, found = survey(config, mirror), survey(alone, mirror)
    places, quiet_places = ([row[:8] for row, _ in rows] for rows in (found, quiet))
    assert (places != quiet_places) is (kind in BODY)

    def column(rows: list[tuple[Row, Sensors | None]], name: str) -> list[object]:
        return [getattr(sensors, name) for _, sensors in rows]

    same = {name for name in ("imu", "enc", "gravity", "edge") if column(found, name) == column(quiet, name)}
    expected = {
        "encoders": {"imu", "gravity", "edge"},
        "gyroscope": {"enc", "gravity", "edge"},
        "accelerometer": {"enc", "gravity", "edge"},
        "edges": {"imu", "enc", "gravity"},
    }
    assert same >= expected.get(kind, set())
    assert ("enc" in same) is (kind not in {"encoders", "wheels"})  # a wheel never feels what the body does


def test_hello_stays_nominal(hard: Config, mirror: Mirror) -> None:
    robot = boot(hard, mirror)
    reported = robot.hello(boot=1, nonce="0" * 32, auth="none", lockstep=True).robot
    assert (reported.wheel_radius_m, reported.wheel_base_m) == (hard.robot.wheel_radius_m, hard.robot.wheel_base_m)
    assert robot.world.wheels.base_m != hard.robot.wheel_base_m
    assert robot.world.plant.lag_s != hard.sim.robot.wheel_lag_s
