"""Navigation by mapped motes: errors by the second, missions put together, and whole missions in their band."""

from pathlib import Path

import numpy as np
import pytest

from ccatp.config.load import load_radio_config
from ccatp.links.beacon_messages import PoseTrack, PoseTruth, pose_track, pose_truth
from ccatp.studies.campaign import CellResult, JobOutcome
from ccatp.studies.mote_navigation import STUDY, band, combine, draw, rehearse_beacons, seconds_of


def poses(frames: int) -> tuple[PoseTrack, PoseTruth]:
    """Estimates with sigmas of 0.02, 0.02 m and 0.1 rad, and a truth 0.04 m and a turn of 0.2 rad away from them."""
    track, truth = np.zeros((frames, 13)), np.zeros((frames, 8))
    track[:, 0] = truth[:, 0] = np.arange(frames)
    track[:, 1] = truth[:, 1] = 0.1 * np.arange(frames)
    track[:, [5, 7]], track[:, 10] = 4e-4, 1e-2
    truth[:, 2], truth[:, 4] = 0.04, 2.0 * np.pi - 0.2
    return pose_track(track), pose_truth(truth)


def test_errors_by_the_second_from_the_map_on() -> None:
    found = seconds_of(*poses(60), 2.0)
    assert {name: len(values) for name, values in found.items()} == {"nees": 4, "error_m": 4, "sigma_m": 4}
    assert found["nees"] == pytest.approx(8.0)  # (0.04 / 0.02)^2 + (0.2 / 0.1)^2: the turn is wrapped
    assert found["error_m"] == pytest.approx(0.04)
    assert found["sigma_m"] == pytest.approx(0.02 * 2**0.5)


def outcome(nees: float) -> JobOutcome:
    values = {
        "outcome": "complete", "reached": 6, "within": 5, "position_m": 0.004, "map_m": 0.002, "map_expected_m": 0.005,
        "nis_mean": 1.0, "readings": 100, "updates": 20.0,
    }  # fmt: skip
    seconds = np.full(4, 1.0)
    return JobOutcome(values, {"nees": nees * seconds, "error_m": 0.004 * seconds, "sigma_m": 0.005 * seconds})


def test_missions_put_together_and_drawn(tmp_path: Path) -> None:
    found = combine({}, [outcome(2.0), outcome(5.0)])
    assert found.values["nees"] == pytest.approx(3.5 / 3)
    assert found.values["in_band"] == 1.0
    assert (found.values["complete"], found.values["waypoints"], found.values["within_3_sigma"]) == (2, 12, 10)
    assert combine({}, [outcome(30.0), outcome(30.0)]).values["in_band"] == 0.0
    draw([CellResult({"case": "route"}, found.values, found.arrays)], tmp_path)
    assert (tmp_path / "mote_navigation.png").stat().st_size > 10_000


def test_the_band_narrows() -> None:
    few, many = band(2), band(50)
    assert few[0] < many[0] < 1.0 < many[1] < few[1]
    assert many == pytest.approx((0.787, 1.239), abs=1e-3)
    assert STUDY.runs == 50


@pytest.mark.slow
def test_missions_are_consistent() -> None:
    each = []
    for seed in range(1, 13):
        run = rehearse_beacons(load_radio_config(None, {"system": "cricket", "run.seed": seed}))
        assert run.outcome == "complete"
        each.append(seconds_of(*run.poses, run.summary["map"]["map_time_s"])["nees"].mean() / 3.0)
    low, high = band(len(each))  # of single seconds: a mean over a mission's varies less
    assert low < np.mean(each) < high
