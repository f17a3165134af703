"""The smoother on simulated runs: it finds path, beacons and calibration, and knows how well."""

from dataclasses import replace

import numpy as np
import pytest

from ccatp.beacons.slam.batch_smoother import place_by_distances, smooth
from ccatp.beacons.slam.evaluation import judge
from ccatp.beacons.slam.recording import EstimatedPath, RecordedRun, Steps
from ccatp.config.beacon_models import RecordingConfig
from ccatp.config.load import load_recordings_config
from tests.unit.beacons.datasets.sets import BEACONS, changed, recorded, world

SETTINGS = load_recordings_config().csv


def no_clock() -> float:
    """Time stands still."""
    return 0.0


def with_priors(**priors: float) -> RecordingConfig:
    return SETTINGS.model_copy(update={"priors": SETTINGS.priors.model_copy(update=priors)})


def noisy(run: RecordedRun, seed: int, distance_scale: float = 1.0, bias_rad_s: float = 0.0) -> RecordedRun:
    """Odometry with the noise that the settings assume, a wrong scale and a bias."""
    rng = np.random.default_rng(seed)
    s, noise = run.steps, SETTINGS.odometry
    way, dt = np.abs(s.distance_m), np.diff(s.times_s)
    e = rng.standard_normal((3, way.size))
    sigma_turn = np.sqrt(
        noise.turn_per_sqrt_m**2 * way + noise.turn_per_sqrt_rad**2 * np.abs(s.turn_rad) + noise.turn_per_sqrt_s**2 * dt
    )
    steps = Steps(
        s.times_s,
        (s.distance_m + noise.distance_per_sqrt_m * np.sqrt(way) * e[0]) / distance_scale,
        s.turn_rad + sigma_turn * e[1] + bias_rad_s * dt,
        noise.lateral_per_sqrt_m * np.sqrt(way) * e[2],
    )
    return replace(run, steps=steps)


def run_of(seed: int, *, bearings: bool, seconds: float = 120.0, **wrong: float) -> RecordedRun:
    """A simulated run with readings as noisy as the settings assume."""
    return noisy(
        recorded(world(seed, seconds, range_sigma_m=0.1, bearing_sigma_rad=0.05), bearings=bearings), seed, **wrong
    )


@pytest.mark.parametrize("bearings", [True, False], ids=["range-bearing", "range-only"])
def test_path_beacons_and_calibration_are_found(bearings: bool) -> None:
    run = run_of(3, bearings=bearings, distance_scale=1.02, bias_rad_s=0.008)
    long = replace(run, readings=run.readings._replace(range_m=1.04 * run.readings.range_m + 0.15))
    track = smooth(long, SETTINGS, no_clock)
    found = judge(track, long)
    assert found.trajectory_rmse_m == pytest.approx(0.0, abs=0.08)  # less than the noise of one range
    assert found.beacon_rmse_m == pytest.approx(0.0, abs=0.1)
    for name, true in (
        ("distance_scale", -0.02 / 1.02),  # positive where the odometry reads too much
        ("turn_bias_rad_s", 0.008),
        ("range_scale", 0.04),
        ("range_offset_m", 0.15),
    ):
        value, sigma = track.calibration[name]
        assert abs(value - true) < 3.5 * sigma, name
    assert track.calibration["turn_bias_rad_s"].sigma < 0.6 * SETTINGS.priors.turn_bias_rad_s
    assert ("bearing_offset_rad" in track.calibration) is False  # it has no prior
    assert track.warnings == ()
    assert track.updates == len(run.readings.times_s)


def test_errors_are_as_large_as_the_covariance_says() -> None:
    """NEES over ten runs: of the map in the 95 % band; of the path about one, since it is one long correlation."""
    paths, maps = [], []
    for seed in range(10):
        run = run_of(100 + seed, bearings=True, seconds=60.0)
        # priors that the simulation draws from: what is exact must be known as exact
        tight = with_priors(
            distance_scale=0.0,
            turn_scale=0.0,
            turn_per_m=0.0,
            turn_bias_rad_s=0.0,
            range_scale=0.0,
            range_offset_m=0.0,
            pose_m=1e-3,
            heading_rad=1e-3,
        ).priors
        gaussian = SETTINGS.radio.model_copy(update={"freedom": 1e6, "range_sigma_per_m": 0.0})
        track = smooth(run, SETTINGS.model_copy(update={"radio": gaussian, "priors": tight}), no_clock)
        judged = judge(track, run)
        assert judged.nees is not None
        paths.append(judged.nees.mean)
        maps += [_nees(track, name, place) for name, place in BEACONS.items()]
    assert np.mean(paths) == pytest.approx(1.0, abs=0.35)
    assert 57.2 < np.sum(maps) < 106.6  # chi-squared of 80 degrees of freedom


def _nees(track: EstimatedPath, name: str, place: tuple[float, float]) -> float:
    fix = track.beacons[name]
    e = np.array((fix.x_m - place[0], fix.y_m - place[1]))
    return float(e @ np.linalg.solve(fix.covariance, e))


def test_outliers_hardly_move_it() -> None:
    run = run_of(5, bearings=True)
    rng = np.random.default_rng(9)
    wild = rng.random(len(run.readings.times_s)) < 0.1
    ranges = np.where(wild, run.readings.range_m + rng.uniform(2.0, 6.0, wild.size), run.readings.range_m)
    bearings = np.where(wild, rng.uniform(-3.0, 3.0, wild.size), run.readings.bearing_rad)
    hit = replace(run, readings=run.readings._replace(range_m=ranges, bearing_rad=bearings))
    clean, found = smooth(run, SETTINGS, no_clock), smooth(hit, SETTINGS, no_clock)
    assert judge(clean, run).trajectory_rmse_m == pytest.approx(0.0, abs=0.06)
    assert judge(found, hit).trajectory_rmse_m == pytest.approx(0.0, abs=0.08)
    assert found.refused > 0.8 * wild.sum()


def test_noise_wider_than_assumed_widens_the_covariance() -> None:
    settings = with_priors(range_scale=0.0, range_offset_m=0.0, pose_m=1e-3, heading_rad=1e-3)
    run = noisy(recorded(world(6, 60.0, range_sigma_m=0.5, bearing_sigma_rad=0.25)), 6)
    usual = smooth(run_of(6, bearings=True, seconds=60.0), settings, no_clock)
    track = smooth(run, settings, no_clock)
    ratio = np.sqrt(track.beacons["8"].covariance[0, 0] / usual.beacons["8"].covariance[0, 0])
    assert 2.0 < ratio < 5.0  # of noise five times as wide; odometry is the same


def test_signal_strengths_alone_place_beacons() -> None:
    run = run_of(7, bearings=False)
    rng = np.random.default_rng(1)
    w = world(7, 120.0, range_sigma_m=0.0)
    rssi = -43.0 - 10.0 * 2.1 * np.log10(w.range_m) + 2.0 * rng.standard_normal(w.range_m.size)
    nothing = np.full(rssi.size, np.nan)
    heard = replace(run, readings=run.readings._replace(range_m=nothing, rssi_dbm=rssi))
    track = smooth(heard, SETTINGS, no_clock)
    judged = judge(track, heard)
    assert judged.beacon_rmse_m == pytest.approx(0.0, abs=0.6)  # 2 dB are a quarter of the distance
    assert set(track.calibration) >= {"rssi_reference_db", "rssi_exponent"}
    assert "range_scale" not in track.calibration


def test_commands_that_the_vehicle_follows_late() -> None:
    w = world(8, 120.0, range_sigma_m=0.05, bearing_sigma_rad=0.01)
    early = changed(w, times_s=w.times_s - 0.25)
    run = recorded(w)
    lagged = replace(run, steps=run.steps._replace(times_s=early.times_s))
    begin = lagged.steps.times_s >= 0.0
    steps = Steps(
        lagged.steps.times_s[begin], lagged.steps.distance_m[begin[:-1]], lagged.steps.turn_rad[begin[:-1]],
        lagged.steps.lateral_m[begin[:-1]],
    )  # fmt: skip
    inside = lagged.readings.times_s < steps.times_s[-1]
    lagged = replace(lagged, steps=steps, readings=lagged.readings.where(inside))
    settings = with_priors(delay_s=0.3)
    delay, sigma = smooth(lagged, settings, no_clock).calibration["odometry_delay_s"]
    assert delay == pytest.approx(0.25, abs=max(4.0 * sigma, 0.02))


def test_a_straight_path_leaves_the_side_in_doubt() -> None:
    w = world(9, 40.0)
    n = w.distance_m.size
    x = 3.0 + 0.05 * np.arange(n + 1)
    poses = np.column_stack([x, np.ones(n + 1), np.zeros(n + 1)])
    sx = np.interp(w.read_s, w.times_s, x)
    places = np.array(list(BEACONS.values()))[w.read_beacon]
    ranges = np.hypot(places[:, 0] - sx, places[:, 1] - 1.0)
    straight = changed(w, poses=poses, distance_m=np.full(n, 0.05), turn_rad=np.zeros(n), range_m=ranges)
    track = smooth(recorded(straight, bearings=False), SETTINGS, no_clock)
    assert "beacon 7 may lie at its mirror image" in " ".join(track.warnings)


def test_a_beacon_with_too_few_readings_is_told() -> None:
    run = run_of(10, bearings=False)
    keep = (run.readings.beacon != 2) | (np.arange(len(run.readings.times_s)) < 8)
    track = smooth(replace(run, readings=run.readings.where(keep)), SETTINGS, no_clock)
    assert "beacon 8 could not be placed: too few readings of it, or all from one place" in track.warnings
    assert set(track.beacons) == {"6", "7", "9"}


@pytest.mark.parametrize("range_m", [0.0, 3.0])
def test_a_robot_that_stands_places_no_beacon(range_m: float) -> None:
    w = world(10, 20.0)
    n = w.distance_m.size
    stood = changed(
        w, poses=np.zeros((n + 1, 3)), distance_m=np.zeros(n), turn_rad=np.zeros(n), range_m=0.0 * w.range_m + range_m
    )
    track = smooth(recorded(stood, bearings=False), SETTINGS, no_clock)
    assert track.beacons == {}
    assert np.isfinite(track.covariances).all()
    assert sum("or all from one place" in warning for warning in track.warnings) == len(BEACONS)


def test_mirror_images_of_a_straight_path_cost_the_same() -> None:
    x = np.linspace(0.0, 4.0, 30)
    poses = np.column_stack([x, np.zeros(30), np.zeros(30)])
    distance = np.hypot(x - 2.5, 3.0)
    found = place_by_distances(poses, distance, np.full(30, 0.01))
    assert (found.x_m, abs(found.y_m)) == pytest.approx((2.5, 3.0), abs=0.01)
    assert found.margin == pytest.approx(0.0, abs=0.1)
    poses[:, 1] = np.linspace(0.0, 2.0, 30) ** 2
    bent = place_by_distances(poses, np.hypot(x - 2.5, poses[:, 1] - 3.0), np.full(30, 0.01))
    assert (bent.x_m, bent.y_m) == pytest.approx((2.5, 3.0), abs=0.01)
    assert bent.margin > 8.0
