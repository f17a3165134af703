"""BeaconSlam: beacons join, mirror images, calibration, outliers, lost poses, exchanged beacons, removal."""

from collections.abc import Callable
from dataclasses import replace
from math import atan2, cos, hypot, log10, sin
from statistics import median

import numpy as np
import pytest

from ccatp.beacons.slam.beacon_map import (
    BearingModel,
    GaussMarkovBias,
    NoiseLevel,
    RangeModel,
    RobustLoss,
    RssiModel,
    SlamSettings,
)
from ccatp.beacons.slam.motion import DifferentialDrive, DifferentialNoise, Increment
from ccatp.beacons.slam.range_slam import BeaconEstimate, BeaconSlam
from ccatp.beacons.slam.recording import BeaconId, RangeBearingReading, RangeReading, Reading, RssiReading
from ccatp.core import wrap_pi
from ccatp.filters.ekf_slam import BlockError

TRUST = RobustLoss(6.0, 3.0, 100.0, 5.0, 3, 20, 0.3, 0.3, True)
MOTION = DifferentialNoise(0.01, 0.0, 0.005, 0.005, 0.0, 0.0)
SETTINGS = SlamSettings(DifferentialDrive(MOTION), TRUST, RangeModel(0.05, 0.0, 0.0, 0.0), BearingModel(0.03))
BEACONS: dict[BeaconId, tuple[float, float]] = {"a": (4.0, 1.0), "b": (2.0, 6.0), "c": (-3.0, 4.0), "d": (-1.0, -2.0)}
P0 = np.diag((1e-6, 1e-6, 1e-6))
Sense = Callable[[float, "World", BeaconId], Reading]


class World:
    """A vehicle that drives where it is told, beacons, and a random generator."""

    def __init__(self, slam: BeaconSlam, sense: Sense, seed: int = 1) -> None:
        self.slam, self.sense, self.rng = slam, sense, np.random.default_rng(seed)
        self.x, self.y, self.heading, self.time_s = 0.0, 0.0, 0.0, 0.0
        self.beacons = dict(BEACONS)
        self.told_m, self.told_rad = 1.0, 1.0  # what odometry says of a metre and of a radian
        self.bias_rad_s = 0.0

    def drive(self, steps: int, turn_rad: float = 0.05, way_m: float = 0.1) -> None:
        for _ in range(steps):
            self.time_s += 0.1
            self.x += way_m * cos(self.heading + turn_rad / 2)
            self.y += way_m * sin(self.heading + turn_rad / 2)
            self.heading += turn_rad
            told_rad = turn_rad * self.told_rad + 0.1 * self.bias_rad_s
            self.slam.predict(Increment(self.time_s, 0.1, way_m * self.told_m, told_rad))
            self.slam.observe([self.sense(self.time_s, self, beacon) for beacon in self.beacons])

    def range_m(self, beacon: BeaconId) -> float:
        bx, by = self.beacons[beacon]
        return hypot(bx - self.x, by - self.y)

    def bearing_rad(self, beacon: BeaconId) -> float:
        bx, by = self.beacons[beacon]
        return wrap_pi(atan2(by - self.y, bx - self.x) - self.heading)

    def error_m(self, beacon: BeaconId) -> float:
        x, y = self.slam.beacons[beacon].mean[:2].tolist()
        return hypot(x - self.beacons[beacon][0], y - self.beacons[beacon][1])

    def pose_error_m(self) -> float:
        return hypot(self.slam.pose.x_m - self.x, self.slam.pose.y_m - self.y)


def ranges(time_s: float, world: World, beacon: BeaconId) -> Reading:
    return RangeReading(time_s, beacon, world.range_m(beacon) + 0.05 * world.rng.normal())


def both(time_s: float, world: World, beacon: BeaconId) -> Reading:
    range_m = world.range_m(beacon) + 0.05 * world.rng.normal()
    bearing_rad = wrap_pi(world.bearing_rad(beacon) + 0.03 * world.rng.normal())
    return RangeBearingReading(time_s, beacon, range_m, bearing_rad)


def start(settings: SlamSettings = SETTINGS, sense: Sense = both) -> World:
    return World(BeaconSlam(settings, (0.0, 0.0, 0.0), P0), sense)


def test_range_and_bearing_join_at_once_and_any_may_be_missing() -> None:
    world = start()
    world.drive(1)
    assert set(world.slam.beacons) == set(BEACONS)
    gone = world.beacons.pop("b")
    world.drive(100)
    world.beacons = {"b": gone}
    world.drive(100)
    world.beacons = dict(BEACONS)
    assert world.pose_error_m() < 0.1  # two sigmas
    assert max(world.error_m(b) for b in BEACONS) < 0.1


def test_the_first_covariance_is_that_of_range_and_bearing() -> None:
    world = start(sense=lambda t, w, b: RangeBearingReading(t, b, w.range_m(b), w.bearing_rad(b)))
    world.drive(1, turn_rad=0.0)
    range_m, angle = world.range_m("a"), world.bearing_rad("a")
    turn = np.array(((cos(angle), -sin(angle)), (sin(angle), cos(angle))))
    expected = turn @ np.diag((0.05**2, (0.03 * range_m) ** 2)) @ turn.T
    # what the pose leaves unknown is a hundredth of it
    assert world.slam.beacons["a"].covariance == pytest.approx(expected, abs=0.03 * expected.max())


def test_ranges_on_a_straight_way_leave_two_places_and_a_turn_decides() -> None:
    world = start(sense=ranges)
    world.beacons = {"a": BEACONS["a"]}
    world.drive(60, turn_rad=0.0)
    assert world.slam.beacons == {}
    sides = sorted(candidate.mean[1] for candidate in world.slam.waiting["a"].candidates)
    assert sides == pytest.approx([-1.0, 1.0], abs=0.4)
    world.drive(40, turn_rad=0.06)
    assert world.error_m("a") < 0.2
    assert world.slam.waiting == {}


def test_a_beacon_that_joins_late_is_correlated_with_the_way_there() -> None:
    """The ranges bend the past way: pose and beacon know of each other, and the pose is surer than before."""
    world, alone = start(sense=ranges), start(sense=ranges)
    alone.beacons = {}
    for each in (world, alone):
        each.drive(125)
    block = world.slam.engine.block("a")
    assert np.abs(world.slam.engine.covariance[:3, block]).max() > 1e-5
    assert np.trace(world.slam.pose_covariance[:2, :2]) < 0.5 * np.trace(alone.slam.pose_covariance[:2, :2])
    assert world.slam.engine.size == 3 + 2 * len(BEACONS)  # no place waits any more


def test_ranges_calibrate_themselves_and_the_gyroscope() -> None:
    noise = replace(MOTION, turn_bias_sigma_rad_s=0.02, rest_speed_m_s=0.03, rest_turn_rad_s=0.03)
    settings = replace(SETTINGS, motion=DifferentialDrive(noise), range=RangeModel(0.05, 0.0, 0.1, 0.2))
    world = start(settings, lambda t, w, b: RangeReading(t, b, 1.07 * w.range_m(b) + 0.15 + 0.05 * w.rng.normal()))
    world.bias_rad_s = 0.01
    for turn_rad in (0.05, -0.04, 0.05, -0.04):
        world.drive(150, turn_rad)
    found = world.slam.calibration
    assert found["range_scale"][0] == pytest.approx(0.07, abs=3.0 * found["range_scale"][1])
    assert found["range_offset_m"][0] == pytest.approx(0.15, abs=3.0 * found["range_offset_m"][1])
    assert found["turn_bias_rad_s"][0] == pytest.approx(0.01, abs=3.0 * found["turn_bias_rad_s"][1])
    assert found["range_scale"][1] < 0.02
    assert found["turn_bias_rad_s"][1] < 0.002


def test_rest_shows_the_bias_of_the_gyroscope_before_any_beacon() -> None:
    noise = replace(
        MOTION, turn_per_sqrt_s=0.002, turn_bias_sigma_rad_s=0.02, rest_speed_m_s=0.03, rest_turn_rad_s=0.03
    )
    world = start(replace(SETTINGS, motion=DifferentialDrive(noise)))
    world.beacons, world.bias_rad_s = {}, -0.007
    world.drive(100, turn_rad=0.0, way_m=0.0)
    assert world.slam.calibration["turn_bias_rad_s"][0] == pytest.approx(-0.007, abs=1e-4)
    assert world.slam.pose.heading_rad == 0.0


def test_scales_of_the_wheels_are_found() -> None:
    noise = replace(MOTION, turn_scale_sigma=0.1, distance_scale_sigma=0.1)
    world = start(replace(SETTINGS, motion=DifferentialDrive(noise)))
    world.told_m, world.told_rad = 1.08, 0.95
    world.drive(300)
    assert world.slam.calibration["distance_scale"][0] == pytest.approx(0.08, abs=0.02)
    assert world.slam.calibration["turn_scale"][0] == pytest.approx(-0.05, abs=0.02)


def test_the_delay_of_a_vehicle_that_follows_its_commands_late_is_found() -> None:
    slam = BeaconSlam(replace(SETTINGS, delay_sigma_s=0.2), (0.0, 0.0, 0.0), P0)
    world = World(BeaconSlam(SETTINGS, (0.0, 0.0, 0.0), P0), both)
    turns = [0.1 if (k // 15) % 2 else -0.06 for k in range(400)]
    for k, turn_rad in enumerate(turns):
        slam.predict(Increment(0.1 * (k + 1), 0.1, 0.1, turn_rad))
        if k < 2:
            world.drive(1, 0.0, 0.0)
        else:
            world.drive(1, turns[k - 2])
        slam.observe([both(0.1 * (k + 1), world, beacon) for beacon in BEACONS])
    assert slam.calibration["odometry_delay_s"][0] == pytest.approx(0.2, abs=0.02)
    assert hypot(slam.pose.x_m - world.x, slam.pose.y_m - world.y) < 0.1


@pytest.mark.parametrize("has_bearing", [True, False])
def test_signal_strengths_with_levels_of_their_own(has_bearing: bool) -> None:
    levels = {"a": -43.0, "b": -34.0, "c": -39.0, "d": -36.0}

    def heard(time_s: float, world: World, beacon: BeaconId) -> Reading:
        rssi = levels[str(beacon)] - 20.0 * log10(world.range_m(beacon)) + 0.5 * world.rng.normal()
        return RssiReading(time_s, beacon, rssi, world.bearing_rad(beacon) if has_bearing else None)

    settings = replace(SETTINGS, rssi=RssiModel(0.5, -38.0, 5.0, 2.0, 0.0))
    world = start(settings, heard)
    for turn_rad in (
        0.05,
        -0.04,
        0.03,
        -0.05,
    ):  # on one circle, levels of a point and of its inverse differ by a constant
        world.drive(100, turn_rad)
    for beacon, level_dbm in levels.items():
        found = world.slam.beacons[beacon]
        assert found.mean[2] == pytest.approx(level_dbm, abs=1.0)
        assert world.error_m(beacon) < 0.4


def test_an_outlier_is_refused_and_long_readings_weigh_little() -> None:
    world = start()
    world.drive(100)
    before = world.slam.pose
    bearing = world.bearing_rad("a")
    learned = world.slam.observe([RangeBearingReading(world.time_s, "a", world.range_m("a") + 3.0, bearing)])
    assert not learned[0].accepted
    assert learned[0].nis > 36.0
    assert hypot(world.slam.pose.x_m - before.x_m, world.slam.pose.y_m - before.y_m) < 0.01

    def round_a_corner(time_s: float, world: World, beacon: BeaconId) -> Reading:
        longer = abs(world.rng.normal()) if world.rng.uniform() < 0.15 else 0.0
        return RangeReading(time_s, beacon, world.range_m(beacon) + longer + 0.05 * world.rng.normal())

    errors = []
    for trust in (TRUST, replace(TRUST, gate_sigmas=1e3, knee_sigmas=1e3, learn_memory=0.0)):
        largest = []
        for seed in range(1, 4):
            world = World(BeaconSlam(replace(SETTINGS, trust=trust), (0.0, 0.0, 0.0), P0), round_a_corner, seed)
            world.drive(450)
            assert set(world.slam.beacons) == set(BEACONS)
            largest.append(max(world.error_m(b) for b in world.slam.beacons))
        errors.append(median(largest))  # the first run takes a beacon for its mirror image when long ranges are learned
    assert errors[0] < 0.6 * errors[1]


def test_a_robot_that_was_pushed_finds_itself_again() -> None:
    world = start()
    world.drive(150)
    world.x, world.heading = world.x + 0.8, world.heading + 0.5
    world.drive(60)
    assert world.slam.jumps > 0
    assert world.pose_error_m() < 0.15
    assert max(world.error_m(b) for b in BEACONS) < 0.2


def test_exchanged_beacons_show_in_the_nis_and_are_placed_anew() -> None:
    world = start()
    world.drive(150)
    world.beacons["a"], world.beacons["b"] = world.beacons["b"], world.beacons["a"]
    world.drive(1)
    refused = {learned.beacon for learned in world.slam.learned if not learned.accepted}
    assert refused == {"a", "b"}
    assert min(learned.nis for learned in world.slam.learned if learned.beacon in refused) > 36.0
    world.drive(80)
    assert all(learned.accepted for learned in world.slam.learned)
    assert max(world.error_m(b) for b in BEACONS) < 0.3


def test_known_beacons_stay_and_the_pose_is_found_among_them() -> None:
    known = {b: BeaconEstimate(np.array(place), np.diag((1e-4, 1e-4))) for b, place in BEACONS.items()}
    world = World(BeaconSlam(SETTINGS, (0.3, -0.2, 0.1), np.diag((0.2, 0.2, 0.02)), known), ranges)
    world.drive(100)
    assert world.pose_error_m() < 0.06
    assert max(world.error_m(b) for b in BEACONS) < 0.03


def test_removal() -> None:
    world = start()
    world.drive(50)
    size = world.slam.engine.size
    kept = world.slam.beacons["d"]
    world.slam.remove("b")
    assert set(world.slam.beacons) == {"a", "c", "d"}
    assert world.slam.engine.size == size - 2
    assert world.slam.beacons["d"].mean == pytest.approx(kept.mean)
    assert world.slam.beacons["d"].covariance == pytest.approx(kept.covariance)
    with pytest.raises(BlockError, match="block 'b' is not on the map"):
        world.slam.remove("b")
    world.drive(30)
    assert world.error_m("b") < 0.2

    waits = start(sense=ranges)
    waits.drive(5, turn_rad=0.0)
    assert "a" in waits.slam.waiting
    waits.slam.remove("a")
    assert "a" not in waits.slam.waiting
    waits.drive(150)
    assert waits.error_m("a") < 0.3


def test_errors_that_stay_while_the_vehicle_does_are_not_averaged_away() -> None:
    """A vehicle that hardly moves hears the same wrong range again and again: it believes in it none the more."""
    sigmas = []
    for wander in (None, GaussMarkovBias(0.8, 0.5, 60.0)):
        settings = replace(SETTINGS, range=RangeModel(0.05, 0.0, 0.0, 0.0, wander))
        world = start(replace(settings, trust=replace(TRUST, learn_memory=0.0)))
        world.drive(200, turn_rad=0.0, way_m=0.0005)
        assert set(world.slam.beacons) == set(BEACONS)
        along = np.array(BEACONS["a"]) / hypot(*BEACONS["a"])
        sigmas.append(np.sqrt(along @ world.slam.beacons["a"].covariance @ along))
    assert sigmas[0] < 0.01
    assert sigmas[1] > 3.0 * sigmas[0]


def test_beacons_join_though_the_settings_promise_less_noise_than_there_is() -> None:
    world = start(replace(SETTINGS, range=RangeModel(0.025, 0.0, 0.0, 0.0)), ranges)
    world.drive(250)
    assert set(world.slam.beacons) == set(BEACONS)
    assert max(world.error_m(b) for b in BEACONS) < 0.2
    assert world.slam.levels["range"].factor == pytest.approx(4.0, rel=0.5)


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_a_noise_level_is_learned(share: float) -> None:
    rng, level, truth = np.random.default_rng(2), NoiseLevel(5.0, 1e4), 4.0
    for _ in range(8000):
        other = (1.0 - share) / share  # the rest of the variance, for a level of one
        true, thought = truth + other, level.factor + other
        level.learn(true * rng.normal() ** 2 / thought, level.factor / thought)
    assert level.factor == pytest.approx(truth, rel=0.15)  # three sigmas at the smaller share
    for _ in range(100):
        level.learn(1e6, 1.0)
    assert level.factor == 100.0  # beyond it readings are refused instead
    fixed = NoiseLevel(5.0, 0.0)
    fixed.learn(100.0, 1.0)
    assert fixed.factor == 1.0
