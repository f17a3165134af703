"""Recorded sets with ground truth, read beside the checkout: what the estimators make of them."""

import time

import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.datasets.reader import read_run
from ccatp.beacons.estimation.batch_smoother import smooth
from ccatp.beacons.estimation.evaluation import TrackEvaluation, judge, result_data
from ccatp.beacons.estimation.predictions import predicted
from ccatp.beacons.estimation.recording import EstimatedPath, RecordedRun
from ccatp.beacons.studies.recorded_sets import recorded_window
from ccatp.beacons.studies.recordings import estimate
from tests.support.scenario import RADIO_DATA

PLAZA2_S = 409.523  # how long it takes
DATA = RADIO_DATA
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"the recorded radio data are not at {DATA}")


def smoothed(path: str, robot: int | None = None) -> tuple[RecordedRun, EstimatedPath, TrackEvaluation]:
    """A set through the smoother as it is configured."""
    run = read_run(DATA / path, None, robot)
    assumed = load_recordings_config()
    track = smooth(run, getattr(assumed, run.kind), assumed.filter, time.perf_counter)
    return run, track, judge(track, run)


def test_plaza2_smoothed() -> None:
    run, track, found = smoothed("plaza/Plaza2_.mat")
    assert found.trajectory_rmse_m is not None
    assert found.beacon_rmse_m is not None
    assert found.trajectory_rmse_m < 0.25  # the goal
    assert found.beacon_rmse_m < 0.3
    scale, sigma = track.calibration["range_scale"]
    assert 1.0 + scale == pytest.approx(1.0693, rel=0.007)  # the slope of ranges over true distances
    assert abs(scale - 0.0693) < 3.0 * sigma
    reported = " | ".join(run.warnings)
    for warning in ("turned by pi", "odometry distance equals the truth", "ranges read +7.0 per cent"):
        assert warning in reported


@pytest.mark.parametrize("share", [pytest.param(0.1, marks=pytest.mark.slow), 0.4])
def test_plaza2_started_later(share: float) -> None:
    """The filter, and the fixed-lag smoother; of four tenths a beacon joined 16 m off and its path was 3.2 m off."""
    run = recorded_window(str(DATA), "Plaza2", None, share * PLAZA2_S, PLAZA2_S)
    track = estimate(run, load_recordings_config(), "fixed-lag")
    found, late = judge(track, run), result_data(run, "fixed-lag", track, judge(track, run))["delayed"]
    assert found.trajectory_rmse_m is not None
    assert found.nees is not None
    assert found.trajectory_rmse_m < 0.8
    assert found.nees.mean < 2.0
    assert late["trajectory_rmse_m"] < found.trajectory_rmse_m


def test_mrclam7_smoothed() -> None:
    _, track, found = smoothed("mrclam/set7", 1)
    assert found.trajectory_rmse_m is not None
    assert found.trajectory_rmse_m < 0.08  # with ranges by height as distances 0.12
    assert len(track.beacons) == 15
    assert track.calibration["odometry_delay_s"].value == pytest.approx(0.25, abs=0.1)  # odometry is what was commanded


@pytest.mark.slow
def test_mrclam7_smoothed_mean_of_all_robots() -> None:
    errors = [smoothed("mrclam/set7", robot)[2].trajectory_rmse_m or 9.0 for robot in range(1, 6)]
    assert sum(errors) / len(errors) < 0.06


@pytest.mark.slow
def test_mrclam7_filtered_mean_of_all_robots() -> None:
    runs = [read_run(DATA / "mrclam/set7", None, robot) for robot in range(1, 6)]
    found = [judge(estimate(run, load_recordings_config(), "ekf-slam"), run) for run in runs]
    assert sum(one.trajectory_rmse_m or 9.0 for one in found) / len(found) < 0.17
    assert (
        0.5 < sum(one.nees.mean if one.nees else 99.0 for one in found) / len(found) < 2.0
    )  # with depths as distances 4.7


@pytest.mark.slow
def test_mrclam7_landmarks_by_the_fixed_lag_mean_of_all_robots() -> None:
    """Its map rests on what was received up to the end, its alignment on the path of each instant."""
    runs = [read_run(DATA / "mrclam/set7", None, robot) for robot in range(1, 6)]
    errors = [judge(estimate(run, load_recordings_config(), "fixed-lag"), run).beacon_rmse_m or 9.0 for run in runs]
    assert sum(errors) / len(errors) < 0.08


@pytest.mark.slow
@pytest.mark.parametrize("robot", [3, 5])
def test_mrclam3_maps_the_landmarks_without_truth_of_the_path(robot: int) -> None:
    _, _, found = smoothed("mrclam/set3", robot)
    assert found.trajectory_rmse_m is None
    assert found.beacon_rmse_m is not None
    assert found.beacon_rmse_m < 0.09


def test_labyrinth_smoothed() -> None:
    run, _, found = smoothed("uwb_labyrinth")
    assert found.trajectory_rmse_m is not None
    assert found.trajectory_rmse_m < 0.065
    reported = " | ".join(run.warnings)
    assert "wheel columns are read as left, right and half the track of 0.157 m" in reported
    assert "ranges read +5.0 per cent" in reported


def test_a_beacon_that_could_not_be_placed_does_not_bend_the_map_of_the_others() -> None:
    """The errors of the Jackal's ranges last; a beacon at its mirror image turned the others by 1.1 m."""
    run = read_run(DATA / "uwb_jackal/jackal_complex_tag_p.csv.gz", None, None)
    track = estimate(run, load_recordings_config(), "fixed-lag")
    found = judge(track, run)
    assert len(track.beacons) == len(run.beacon_ids) - 1
    assert found.beacon_rmse_m is not None
    assert found.beacon_rmse_m < 0.3
    by = predicted(run, track, 0.0)
    assert by is not None
    assert by.estimate_m < 0.15  # 0.23 with half of each prior, and so worse than dead reckoning
