"""Calibration that is told: one convention for both estimators, no prior as a result, doubt beyond the prior."""

from dataclasses import replace

import numpy as np
import pytest

from ccatp.beacons.slam.batch_smoother import smooth
from ccatp.beacons.slam.causal import filter_run
from ccatp.beacons.slam.evaluation import judge, result_data
from ccatp.beacons.slam.recording import EstimatedPath, RecordedRun
from ccatp.beacons.slam.settings import batch_settings, slam_settings
from ccatp.config.load import load_recordings_config
from tests.unit.radio_data.sets import recorded, world

CONFIG = load_recordings_config(None, {})


def no_clock() -> float:
    """Time stands still."""
    return 0.0


def both(run: RecordedRun, **priors: float) -> list[EstimatedPath]:
    """The run by filter and smoother, with other priors."""
    wide = CONFIG.csv.priors.model_copy(update=priors)
    cfg = CONFIG.csv.model_copy(update={"priors": wide})
    return [
        filter_run(run, slam_settings(cfg, CONFIG.filter), (0.05, 0.05), no_clock),
        smooth(run, batch_settings(cfg), no_clock),
    ]


def test_filter_and_smoother_mean_the_same_by_a_name() -> None:
    run = recorded(world(3, 120.0))
    more = run.steps._replace(distance_m=1.1 * run.steps.distance_m, turn_rad=0.92 * run.steps.turn_rad)
    tracks = both(replace(run, steps=more), distance_scale=0.2, turn_scale=0.2, delay_s=0.2)
    for track in tracks:
        assert track.calibration["distance_scale"].value == pytest.approx(0.1, abs=0.03)
        assert track.calibration["turn_scale"].value == pytest.approx(-0.08, abs=0.03)
        assert track.calibration["odometry_delay_s"].value == pytest.approx(0.0, abs=0.05)


def test_a_calibration_that_no_reading_told_is_not_told() -> None:
    run = recorded(world(3, 30.0), bearings=False)
    few = replace(run, readings=run.readings.where(run.readings.times_s < 1.0))
    track = filter_run(few, slam_settings(CONFIG.csv, CONFIG.filter), (0.05, 0.05), no_clock)
    assert track.updates == 0
    data = result_data(few, "ekf-slam", track, judge(track, few))
    assert data["range_scale"] is None
    assert data["range_offset_m"] is None
    assert not {"range_scale", "range_offset_m"} & {*data["calibration"]}


@pytest.mark.parametrize("filter_name", ["ekf-slam", "smoother"])
def test_a_value_that_its_prior_excludes_is_told_with_the_key(filter_name: str) -> None:
    run = recorded(world(3, 60.0))
    long = replace(run, truth=None, readings=run.readings._replace(range_m=1.4 * run.readings.range_m))
    track = both(long)[filter_name == "smoother"]
    told = [w for w in track.warnings if w.startswith("range_scale comes out as")]
    assert len(told) == 1
    assert "widen csv.priors.range_scale (now 0.05)" in told[0]
    assert not any("comes out as" in w for w in both(run)[filter_name == "smoother"].warnings)


def test_names_that_mean_nothing_show_in_the_noise_of_the_smoother() -> None:
    run = recorded(world(3, 12.0), bearings=False)
    beacon = np.random.default_rng(1).integers(0, 4, run.readings.beacon.size)
    told = smooth(replace(run, readings=run.readings._replace(beacon=beacon)), batch_settings(CONFIG.csv), no_clock)
    assert any("range readings are" in w and "times as noisy as assumed" in w for w in told.warnings)
