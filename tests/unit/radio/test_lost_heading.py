"""A gap in the odometry: place and heading are lost, and found again by the beacons."""

from dataclasses import replace
from time import perf_counter

import numpy as np
import pytest

from ccatp.beacons.datasets.checks import suspicions
from ccatp.beacons.datasets.tables import bridged
from ccatp.beacons.slam.batch_smoother import smooth
from ccatp.beacons.slam.causal import filter_run
from ccatp.beacons.slam.evaluation import judge
from ccatp.beacons.slam.recording import RecordedRun, Steps
from ccatp.beacons.slam.settings import batch_settings, slam_settings
from ccatp.config.load import load_recordings_config
from tests.unit.radio_data.sets import recorded, world

CONFIG = load_recordings_config(None, {})


def with_gap(begin_s: float, long_s: float, *, bearings: bool) -> RecordedRun:
    """A run whose odometry is silent for a while; ranges are heard throughout."""
    run = recorded(world(3, 120.0, range_sigma_m=0.1, bearing_sigma_rad=0.05), bearings=bearings)
    s = run.steps
    keep = (s.times_s <= begin_s) | (s.times_s >= begin_s + long_s)
    steps = Steps(s.times_s[keep], *(column[keep[1:]] for column in s[1:4]))
    return replace(run, steps=bridged(steps))


@pytest.mark.parametrize(("begin_s", "bearings"), [(40.0, False), (60.0, False), (80.0, False), (60.0, True)])
def test_the_filter_finds_itself_again(begin_s: float, bearings: bool) -> None:
    run = with_gap(begin_s, 15.0, bearings=bearings)
    found = judge(filter_run(run, slam_settings(CONFIG.csv, CONFIG.filter), (0.05, 0.05), perf_counter), run)
    assert found.trajectory_rmse_m is not None
    assert found.trajectory_rmse_m < 0.5  # the vehicle drove 7 m unseen
    assert found.beacon_rmse_m is not None
    assert found.beacon_rmse_m < 0.4
    assert found.nees is not None
    assert found.nees.mean < 4.0


def test_the_smoother_joins_both_ends() -> None:
    run = with_gap(60.0, 15.0, bearings=False)
    found = judge(smooth(run, batch_settings(CONFIG.csv), perf_counter), run)
    assert found.trajectory_rmse_m is not None
    assert found.trajectory_rmse_m < 0.3
    assert found.beacon_rmse_m is not None
    assert found.beacon_rmse_m < 0.3


def test_a_guessed_way_is_told_and_no_scale_of_the_odometry() -> None:
    told = suspicions(with_gap(60.0, 15.0, bearings=False))
    assert any("odometry: 1 gap, the longest of 15.0 s" in line and "is guessed" in line for line in told)
    assert not any("true ways are" in line for line in told)
    assert np.isfinite(with_gap(60.0, 15.0, bearings=False).steps.distance_m).all()
