"""BeaconSlam: beacons join, mirror images, calibration, outliers, lost poses, exchanged beacons, removal."""

from collections.abc import Callable
from dataclasses import replace
from math import atan2, cos, hypot, log10, nan, sin
from time import perf_counter

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.config.models import FixedLagConfig
from ccatp.beacons.datasets.checks import suspicions
from ccatp.beacons.datasets.trajectory import bridged
from ccatp.beacons.estimation.batch_smoother import lagged_run, smooth
from ccatp.beacons.estimation.beacon_slam import BeaconSlam, recorded_slam
from ccatp.beacons.estimation.causal import filter_run, follow
from ccatp.beacons.estimation.evaluation import judge, result_data
from ccatp.beacons.estimation.landmark_init import ReadingRecord, StackedRows
from ccatp.beacons.estimation.measurement_models import (
    LevelModel,
    MeasurementModel,
    MeasurementRow,
    MeasurementRows,
    ShadowingMap,
    recorded_models,
)
from ccatp.beacons.estimation.motion import Increment
from ccatp.beacons.estimation.path_loss import PathLoss
from ccatp.beacons.estimation.recording import BeaconId, EstimatedPath, Reading, RecordedRun, Steps
from ccatp.beacons.estimation.track_review import range_residuals
from ccatp.beacons.filters.ekf_slam import BlockError, EkfSlam
from ccatp.beacons.rigid_motion import aligned_rms_m, best_motion
from ccatp.core import FloatArray
from ccatp.kinematics import wrap_pi
from tests.support.slam_settings import Settings, odometry, settings, trust
from tests.unit.beacons.datasets.sets import recorded, world

SETTINGS = settings(
    **trust(6.0, 3.0, 100.0, 5.0, 3, 20), **odometry(0.01, 0.0, 0.005, 0.005, 0.0, 0.0), radio__range_sigma_m=0.05,
    radio__bearing_sigma_rad=0.03,
)  # fmt: skip
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
    return Reading(time_s, beacon, world.range_m(beacon) + 0.05 * world.rng.normal())


def both(time_s: float, world: World, beacon: BeaconId) -> Reading:
    range_m = world.range_m(beacon) + 0.05 * world.rng.normal()
    bearing_rad = wrap_pi(world.bearing_rad(beacon) + 0.03 * world.rng.normal())
    return Reading(time_s, beacon, range_m, bearing_rad)


def start(settings: Settings = SETTINGS, sense: Sense = both) -> World:
    return World(recorded_slam(*settings, (0.0, 0.0, 0.0), P0), sense)


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


def test_ranges_calibrate_themselves_and_the_gyroscope() -> None:
    changed = SETTINGS.but(
        priors__turn_bias_rad_s=0.02, filter__rest_speed_m_s=0.03, filter__rest_turn_rad_s=0.03,
        priors__range_scale=0.1, priors__range_offset_m=0.2,
    )  # fmt: skip
    world = start(changed, lambda t, w, b: Reading(t, b, 1.07 * w.range_m(b) + 0.15 + 0.05 * w.rng.normal()))
    world.bias_rad_s = 0.01
    for turn_rad in (0.05, -0.04, 0.05, -0.04):
        world.drive(150, turn_rad)
    found = world.slam.calibration
    assert found["range_scale"][0] == pytest.approx(0.07, abs=3.0 * found["range_scale"][1])
    assert found["range_offset_m"][0] == pytest.approx(0.15, abs=3.0 * found["range_offset_m"][1])
    assert found["turn_bias_rad_s"][0] == pytest.approx(0.01, abs=3.0 * found["turn_bias_rad_s"][1])
    assert found["range_scale"][1] < 0.02
    assert found["turn_bias_rad_s"][1] < 0.002


def test_the_delay_of_a_vehicle_that_follows_its_commands_late_is_found() -> None:
    slam = recorded_slam(*SETTINGS.but(priors__odometry_delay_s=0.2), (0.0, 0.0, 0.0), P0)
    world = World(recorded_slam(*SETTINGS, (0.0, 0.0, 0.0), P0), both)
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


def test_signal_strengths_with_levels_of_their_own() -> None:
    levels = {"a": -43.0, "b": -34.0}

    def received(time_s: float, world: World, beacon: BeaconId) -> Reading:
        rssi = levels[str(beacon)] - 20.0 * log10(world.range_m(beacon)) + 0.5 * world.rng.normal()
        return Reading(time_s, beacon, bearing_rad=world.bearing_rad(beacon), rssi_dbm=rssi)

    rssi = {"radio__rssi_sigma_db": 0.5, "radio__rssi_reference_dbm": -38.0, "radio__rssi_exponent": 2.0}
    world = start(SETTINGS.but(**rssi, priors__rssi_reference_db=5.0), received)
    world.beacons = {beacon: BEACONS[beacon] for beacon in levels}
    # On one circle, levels of a point and of its inverse differ by a constant.
    for turn_rad in (0.05, -0.04, 0.03, -0.05):
        world.drive(100, turn_rad)
    for beacon, level_dbm in levels.items():
        found = world.slam.beacons[beacon]
        assert found.mean[2] == pytest.approx(level_dbm, abs=1.0)
        assert world.error_m(beacon) < 0.4


def test_an_outlier_is_refused() -> None:
    world = start()
    world.drive(100)
    before = world.slam.pose
    bearing = world.bearing_rad("a")
    learned = world.slam.observe([Reading(world.time_s, "a", world.range_m("a") + 3.0, bearing)])
    assert not learned[0].accepted
    assert learned[0].nis > 36.0
    assert hypot(world.slam.pose.x_m - before.x_m, world.slam.pose.y_m - before.y_m) < 0.01


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


@pytest.mark.parametrize("correlation_s", [0.0, 3.0])
def test_the_covariance_stays_symmetric_to_the_last_digit(correlation_s: float) -> None:
    world = start(SETTINGS.but(radio__correlation_s=correlation_s))
    world.drive(50)
    P = world.slam.engine.covariance
    np.testing.assert_array_equal(P, P.T)


def test_errors_that_stay_while_the_vehicle_does_are_not_averaged_away() -> None:
    """A vehicle that hardly moves hears the same wrong range again and again: it believes in it none the more."""
    sigmas = []
    wander = {"filter__wander_share": 0.8, "filter__wander_length_m": 0.5}
    for correlation_s in (0.0, 60.0):
        world = start(SETTINGS.but(filter__learn_memory=0.0, radio__correlation_s=correlation_s, **wander))
        world.drive(200, turn_rad=0.0, way_m=0.0005)
        assert set(world.slam.beacons) == set(BEACONS)
        along = np.array(BEACONS["a"]) / hypot(*BEACONS["a"])
        sigmas.append(np.sqrt(along @ world.slam.beacons["a"].covariance @ along))
    assert sigmas[0] < 0.01
    assert sigmas[1] > 3.0 * sigmas[0]


@pytest.mark.parametrize(("correlation_s", "lasts"), [(0.0, False), (3.0, True)])
def test_innovations_of_errors_that_last_teach_no_less_noise_than_is_set(correlation_s: float, *, lasts: bool) -> None:
    def constant(time_s: float, world: World, beacon: BeaconId) -> Reading:
        return Reading(time_s, beacon, world.range_m(beacon) + 0.05, world.bearing_rad(beacon) + 0.02)

    world = start(SETTINGS.but(radio__correlation_s=correlation_s), constant)
    world.drive(100)
    factors = [world.slam.levels[kind].factor for kind in ("range", "bearing")]
    assert (min(factors) >= 1.0) == lasts
    assert lasts or min(factors) < 0.5


def test_beacons_join_though_the_settings_promise_less_noise_than_there_is() -> None:
    world = start(SETTINGS.but(radio__range_sigma_m=0.025), ranges)
    world.drive(250)
    assert set(world.slam.beacons) == set(BEACONS)
    assert max(world.error_m(b) for b in BEACONS) < 0.2
    assert world.slam.levels["range"].factor == pytest.approx(4.0, rel=0.5)


SIGHTINGS = settings(
    radio__range_sigma_m=0.1, radio__range_sigma_per_m=0.02, radio__bearing_sigma_rad=0.05, radio__rssi_sigma_db=2.0,
    priors__range_scale=0.1, priors__range_offset_m=0.3, priors__rssi_reference_db=3.0, priors__rssi_exponent=0.3,
).cfg  # fmt: skip
LOSS = PathLoss(-33.0, 2.0, 2.0)
MODELS: dict[str, MeasurementModel] = {
    **recorded_models(SIGHTINGS.radio, SIGHTINGS.priors).by_kind,
    "rssi, shadowing on a map": LevelModel(
        lambda _: PathLoss(-33.0, 2.0, 2.0), shadowing=ShadowingMap((4.0, 4.0), 3.0, 5.0, 1.5)
    ),
}
POSE, CALIBRATION, BEACON = [1.0, 2.0, 0.4], [0.06, -0.1], [4.0, 6.0]
EXTRA = {"rssi": [-37.0, 2.2], "rssi, shadowing on a map": [0.3, -0.2, 0.5, 0.1]}


@pytest.mark.parametrize("kind", MODELS)
def test_jacobian_of_a_row(kind: str) -> None:
    x = np.array((*POSE, *CALIBRATION, *BEACON, *EXTRA.get(kind, ())))

    def row_at(x: FloatArray) -> MeasurementRow:
        # a field of shadowing counts as that of the place: its slope is left out
        place = POSE if "map" in kind else x[:3].tolist()
        return MODELS[kind].row(place, x[3:5].tolist(), x[5:].tolist(), "b")

    row = row_at(x)
    differences = [(row_at(x + 1e-6 * e).expected - row_at(x - 1e-6 * e).expected) / 2e-6 for e in np.eye(x.size)]
    by_pose = [0.0] * 3 if "map" in kind else row.pose
    by_calibration = row.calibration or (0.0, 0.0)
    assert [*by_pose, *by_calibration, *row.beacon] == pytest.approx(differences, abs=1e-7)


@pytest.mark.parametrize("kind", MODELS)
def test_rows_of_many_readings_are_those_of_each_one(kind: str) -> None:
    poses = np.random.default_rng(3).uniform(-3.0, 3.0, (200, 3))
    beacons = np.tile([*BEACON, *EXTRA.get(kind, ())], (200, 1)) + 0.1 * poses[:, :1]
    rows = MODELS[kind].rows(poses, CALIBRATION, beacons, "b")
    for k, (pose, beacon) in enumerate(zip(poses.tolist(), beacons.tolist(), strict=True)):
        row = MODELS[kind].row(pose, CALIBRATION, beacon, "b")
        for name in rows._fields:
            np.testing.assert_array_equal(getattr(rows, name)[k], getattr(row, name))


@pytest.mark.parametrize("walk_m2_s", [0.0, 0.01])
def test_rows_at_many_places_are_those_at_each_one(walk_m2_s: float) -> None:
    places = np.random.default_rng(4).uniform(-3.0, 3.0, (4, 2))
    engine, records = EkfSlam(np.zeros(3), np.eye(3), np.array(CALIBRATION), np.eye(2)), []
    for k, place in enumerate(places):
        engine.augment(k, place, np.arange(2), np.eye(2, 2))
        records.append(ReadingRecord(Reading(float(k), "b", 4.0 if k % 2 else nan, None, -40.0), k, 4.0))

    def rows_of(kind: str, poses: FloatArray, calibration: list[float], beacons: FloatArray) -> MeasurementRows:
        found = MODELS[kind].rows(poses, calibration, beacons, "b")
        return found if kind == "rssi" else found._replace(beacon=np.pad(found.beacon, ((0, 0), (0, 2))))

    rows = StackedRows(engine, records, slice(3, 5), rows_of, walk_m2_s)
    beacons = np.column_stack([5.0 + places, np.tile(EXTRA["rssi"], (4, 1))])
    found = rows.at_each(engine.mean, beacons)
    for k, beacon in enumerate(beacons.tolist()):
        for of_all, of_one in zip(found, rows.at(engine.mean, beacon), strict=True):
            np.testing.assert_array_equal(of_all[k], of_one)


CONFIG = load_recordings_config(None, {})


def with_gap(begin_s: float, long_s: float, *, bearings: bool) -> RecordedRun:
    """A run whose odometry is silent for a while; ranges are heard throughout."""
    run = recorded(world(3, 120.0, range_sigma_m=0.1, bearing_sigma_rad=0.05), bearings=bearings)
    s = run.steps
    keep = (s.times_s <= begin_s) | (s.times_s >= begin_s + long_s)
    steps = Steps(s.times_s[keep], *(column[keep[1:]] for column in s[1:4]))
    return replace(run, steps=bridged(steps))


@pytest.mark.parametrize(("begin_s", "bearings"), [(40.0, False), (80.0, False), (60.0, True)])
def test_the_filter_finds_itself_again(begin_s: float, bearings: bool) -> None:
    run = with_gap(begin_s, 15.0, bearings=bearings)
    found = judge(filter_run(run, CONFIG.csv, CONFIG.filter, perf_counter), run)
    assert found.trajectory_rmse_m is not None
    assert found.trajectory_rmse_m < 0.5  # the vehicle drove 7 m unseen
    assert found.beacon_rmse_m is not None
    assert found.beacon_rmse_m < 0.4
    assert found.nees is not None
    assert found.nees.mean < 4.0


def test_a_guessed_way_is_reported_and_no_scale_of_the_odometry() -> None:
    reported = suspicions(with_gap(60.0, 15.0, bearings=False))
    assert any("odometry: 1 gap, the longest of 15.0 s" in line and "is guessed" in line for line in reported)
    assert not any("true ways are" in line for line in reported)
    assert np.isfinite(with_gap(60.0, 15.0, bearings=False).steps.distance_m).all()


def no_clock() -> float:
    """Time stands still."""
    return 0.0


def by_both(run: RecordedRun, **priors: float) -> list[EstimatedPath]:
    """The run by filter and smoother, with other priors."""
    cfg = CONFIG.csv.model_copy(update={"priors": CONFIG.csv.priors.model_copy(update=priors)})
    return [filter_run(run, cfg, CONFIG.filter, no_clock), smooth(run, cfg, CONFIG.filter, no_clock)]


def test_filter_and_smoother_mean_the_same_by_a_name() -> None:
    """In the mean of three runs: one tells the scale of the distance to 0.03 alone."""
    true = {"distance_scale": 0.1, "distance_per_rad": 0.06, "turn_scale": -0.08, "odometry_delay_s": 0.0}
    within = {"distance_scale": 0.03, "distance_per_rad": 0.02, "turn_scale": 0.03, "odometry_delay_s": 0.05}
    found: dict[str, list[list[float]]] = {name: [] for name in true}
    for seed in (3, 4, 5):
        run = recorded(world(seed, 120.0))
        turn_rad = 0.92 * run.steps.turn_rad
        more = run.steps._replace(distance_m=1.1 * (run.steps.distance_m + 0.06 * np.abs(turn_rad)), turn_rad=turn_rad)
        tracks = by_both(replace(run, steps=more), **dict.fromkeys(true, 0.2))
        for name, values in found.items():
            values.append([track.calibration[name].value for track in tracks])
    for name, values in found.items():
        assert np.mean(values, axis=0) == pytest.approx(true[name], abs=within[name]), name


def test_ranges_by_height_are_depths_where_a_camera_reads_them() -> None:
    field_rad, run = 0.6, recorded(world(3, 240.0))
    seen = run.readings.where(np.abs(run.readings.bearing_rad) < field_rad)
    depths_m = seen.range_m * np.cos(seen.bearing_rad) * field_rad / sin(field_rad)
    camera = replace(run, readings=seen._replace(range_m=depths_m))
    assert camera.readings.with_distances(field_rad).range_m == pytest.approx(seen.range_m, rel=1e-12)
    alone = seen._replace(bearing_rad=np.full(seen.bearing_rad.size, np.nan))
    for distances, by_rad in ((run.readings, field_rad), (alone, field_rad), (seen, 0.0)):
        assert distances.with_distances(by_rad) is distances  # seen all around, without bearings, by no camera

    noise = CONFIG.csv.radio.model_copy(update={"camera_field_rad": field_rad})
    cfg = CONFIG.csv.model_copy(update={"radio": noise})
    for estimator in (filter_run, smooth):
        by_depth = estimator(camera, cfg, CONFIG.filter, no_clock)
        by_distance = estimator(replace(run, readings=seen), CONFIG.csv, CONFIG.filter, no_clock)
        assert by_depth.poses == pytest.approx(by_distance.poses, abs=1e-6)  # the same but for rounding
        residuals = range_residuals(camera, by_depth, field_rad)
        assert residuals == pytest.approx(range_residuals(camera, by_distance, field_rad), abs=1e-6)


def test_a_twentieth_of_the_readings_refused_is_reported() -> None:
    run = recorded(world(3, 120.0))
    for every, is_told in ((200, False), (12, True)):
        far = np.arange(run.readings.range_m.size) % every == every - 1
        longer = run.readings._replace(range_m=run.readings.range_m + 20.0 * far)
        track = filter_run(replace(run, readings=longer), CONFIG.csv, CONFIG.filter, no_clock)
        assert any("readings were refused" in line for line in track.warnings) == is_told


def test_the_map_of_a_fixed_lag_fits_all_that_is_kept_in_the_frame_of_its_path() -> None:
    run, given = recorded(world(1)), (CONFIG.csv, CONFIG.filter)
    lag = FixedLagConfig(lag_s=10.0, poses=10, window_s=120.0, map_s=3600.0)
    causal, whole = (
        filter_run(run, *given, no_clock),
        smooth(run, *given, no_clock, follow(run, *given, no_clock, lag=lag)),
    )
    track = lagged_run(run, *given, no_clock, lag)
    assert track.beacons.keys() == causal.beacons.keys()
    found, best, own = (np.array([of.beacons[name][:2] for name in track.beacons]) for of in (track, whole, causal))
    assert aligned_rms_m(found, best) < 0.1 * aligned_rms_m(own, best)
    assert np.abs(best_motion(found, own).angle_rad) < 0.01
    for k, fix in enumerate(track.beacons.values()):
        at = slice(2 * k, 2 * k + 2)
        assert track.map_covariance[at, at] == pytest.approx(fix.covariance)
    one, *_ = track.beacons
    early = run.readings.where((run.readings.times_s < 30.0) | (run.readings.beacon != run.beacon_ids.index(one)))
    without_it, short = replace(run, readings=early), lag.model_copy(update={"map_s": 10.0})
    forgetful, (of_filter, *_) = (
        lagged_run(without_it, *given, no_clock, short),
        follow(without_it, *given, no_clock, lag=short),
    )
    assert forgetful.beacons[one][:2] == of_filter.beacons[one][:2]


def test_a_calibration_that_no_reading_determines_is_not_reported() -> None:
    run = recorded(world(3, 30.0), bearings=False)
    few = replace(run, readings=run.readings.where(run.readings.times_s < 1.0))
    track = filter_run(few, CONFIG.csv, CONFIG.filter, no_clock)
    assert track.updates == 0
    data = result_data(few, "ekf-slam", track, judge(track, few))
    assert data["range_scale"] is None
    assert data["range_offset_m"] is None
    assert not {"range_scale", "range_offset_m"} & {*data["calibration"]}


def test_a_value_that_its_prior_excludes_is_reported_with_the_key() -> None:
    run = recorded(world(3, 60.0))
    long = replace(run, truth=None, readings=run.readings._replace(range_m=1.4 * run.readings.range_m))
    for track, sound in zip(by_both(long), by_both(run), strict=True):
        (reported,) = [w for w in track.warnings if w.startswith("range_scale comes out as")]
        assert "widen csv.priors.range_scale (now 0.05)" in reported
        assert not any("comes out as" in w for w in sound.warnings)
