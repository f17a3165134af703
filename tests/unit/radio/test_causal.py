"""The filter over a recorded run: times of its parts, and what it tells of data that do not fit together."""

from dataclasses import replace
from time import perf_counter

import numpy as np
import pytest

from ccatp.beacons.datasets.checks import suspicions
from ccatp.beacons.slam.causal import filter_run
from ccatp.beacons.slam.evaluation import judge
from ccatp.beacons.slam.recording import EstimatedPath, Readings, RecordedRun, ReferencePath
from ccatp.beacons.slam.settings import slam_settings
from ccatp.config.load import load_recordings_config
from tests.unit.radio_data.sets import recorded, world


def track_of(run: RecordedRun) -> EstimatedPath:
    cfg = load_recordings_config(None, {})
    return filter_run(run, slam_settings(cfg.csv, cfg.filter), (0.05, 0.05), perf_counter)


def test_sound_data_raise_no_doubt_and_parts_are_timed() -> None:
    run = recorded(world())
    track = track_of(run)
    assert track.warnings == ()
    assert len(track.predict_s) == len(track.times_s) - 1
    assert len(track.update_s) == len(run.readings.times_s)
    joined = 4 * 2  # each beacon's first reading is no update of it
    assert len(track.scalar_s) == 2 * len(run.readings.times_s) - joined
    assert 0.0 < np.median(track.scalar_s) < np.median(track.update_s)


def test_readings_of_another_time_are_told() -> None:
    run = recorded(world(seconds=120.0))
    late = run.readings.times_s + 4.0
    shifted = replace(run, readings=run.readings._replace(times_s=late).where(late < run.steps.times_s[-1]))
    assert any("innovations are" in w or "had to be doubted" in w for w in track_of(shifted).warnings)


def test_beacons_that_are_misread_half_the_time_are_told() -> None:
    run = recorded(world(seconds=120.0))
    beacon = run.readings.beacon.copy()
    rng = np.random.default_rng(2)
    misread = rng.uniform(size=beacon.size) < 0.5
    beacon[misread] = rng.integers(0, 4, int(misread.sum()))
    told = track_of(replace(run, readings=run.readings._replace(beacon=beacon))).warnings
    assert any("had to be doubted" in w for w in told)
    assert any("readings were refused" in w for w in told)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_names_that_are_misread_now_and_then_do_not_cost_the_map(seed: int) -> None:
    """The worst time for it is the first sight of a beacon: here the first four are all taken for others."""
    run = recorded(world(seed, 120.0))
    beacon, rng = run.readings.beacon.copy(), np.random.default_rng(seed)
    misread = rng.uniform(size=beacon.size) < 0.05
    misread[:4] = True
    beacon[misread] = (beacon[misread] + rng.integers(1, 4, int(misread.sum()))) % 4
    misnamed = replace(run, readings=run.readings._replace(beacon=beacon))
    found = judge(track_of(misnamed), misnamed)
    assert found.trajectory_rmse_m is not None
    assert found.trajectory_rmse_m < 0.1
    assert found.beacon_rmse_m is not None
    assert found.beacon_rmse_m < 0.15


def test_bearings_of_times_of_their_own_are_used_once_their_beacon_is_placed() -> None:
    run = recorded(world(3, 120.0, range_sigma_m=0.3))
    r = run.readings
    nothing = np.full(len(r.times_s), np.nan)
    both = Readings(
        np.concatenate([r.times_s, r.times_s + 0.01]), np.tile(r.beacon, 2), np.concatenate([r.range_m, nothing]),
        np.concatenate([nothing, r.bearing_rad]), np.tile(nothing, 2),
    )  # fmt: skip
    apart = replace(run, readings=both.where(np.argsort(both.times_s, kind="stable")))
    ranges = replace(run, readings=r._replace(bearing_rad=nothing))
    track, without = track_of(apart), track_of(ranges)
    assert track.updates > 1.3 * without.updates
    assert np.median(track.covariances[:, 2, 2]) < 0.5 * np.median(without.covariances[:, 2, 2])
    found = judge(track, apart)
    assert found.trajectory_rmse_m is not None
    assert found.trajectory_rmse_m < 0.2
    assert any("bearings had no range or strength of the same time and came before" in w for w in track.warnings)


def test_a_beacon_of_which_only_bearings_were_heard_is_told_so() -> None:
    run = recorded(world(3, 20.0))
    blind = run.readings._replace(range_m=np.full(len(run.readings.times_s), np.nan))
    told = track_of(replace(run, readings=blind)).warnings
    assert "beacon 6 could not be placed: only bearings of it were heard, no range" in told


def test_no_nees_where_the_truth_did_not_tell_the_first_pose() -> None:
    run = recorded(world(seconds=20.0))
    track = track_of(run)
    assert judge(track, run).nees is not None
    assert run.truth is not None
    late = replace(run, truth=ReferencePath(*(column[50:] for column in run.truth)))
    assert judge(track, late).nees is None
    assert judge(track, late).trajectory_rmse_m is not None


def test_beacons_that_are_exchanged_on_the_way_are_told() -> None:
    run = recorded(world(seconds=120.0))
    swap = np.where(run.readings.times_s > 60.0, np.array([1, 0, 2, 3])[run.readings.beacon], run.readings.beacon)
    told = track_of(replace(run, readings=run.readings._replace(beacon=swap))).warnings
    for name in ("6", "7"):
        assert any(w.startswith(f"beacon {name} was placed anew at ") and "exchanged" in w for w in told)


@pytest.mark.parametrize("steps", [1, 3])
def test_a_wild_step_of_the_odometry_is_told(steps: int) -> None:
    run = replace(recorded(world()), truth=None)
    distance = run.steps.distance_m.copy()
    distance[100 : 100 + steps] = 1e6
    told = suspicions(replace(run, steps=run.steps._replace(distance_m=distance)))
    assert any(
        f"{steps} step{'s' * (steps > 1)} faster than 50 m/s, the first of 1e+06 m at 10.000 s" in w for w in told
    )
    assert not any("faster than" in w for w in suspicions(run))
