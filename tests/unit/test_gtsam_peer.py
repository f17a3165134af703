"""GTSAM on the same input: it solves what it can, and says so where it cannot."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ccatp.beacons.slam.evaluation import judge, markdown, with_means
from ccatp.cli import main
from ccatp.config.load import load_recordings_config
from ccatp.studies.gtsam_peer import PeerError, run_gtsam
from tests.unit.beacons.datasets.sets import BEACONS, csv_lines, recorded, world, write_lines, write_mrclam

SETTINGS = load_recordings_config().csv


def no_clock() -> float:
    """Time stands still."""
    return 0.0


@pytest.mark.parametrize("bearings", [True, False], ids=["range-bearing", "range-only"])
def test_both_solve_a_run_without_calibration_errors(bearings: bool) -> None:
    pytest.importorskip("gtsam", reason="the extra peers is not installed")
    run = recorded(world(seconds=60.0), bearings=bearings)
    peers = run_gtsam(run, SETTINGS, no_clock)
    for track in peers:
        found = judge(track, run)
        assert found.trajectory_rmse_m == pytest.approx(0.0, abs=0.1)
        assert found.beacon_rmse_m == pytest.approx(0.0, abs=0.15)
        assert set(track.beacons) == set(BEACONS)
    assert len(peers.isam2.update_s) == len(run.readings.times_s)


def test_what_cannot_be_solved_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gtsam", reason="the extra peers is not installed")
    run = recorded(world(seconds=20.0))
    nothing = np.full(len(run.readings.times_s), np.nan)
    heard = replace(run, readings=run.readings._replace(range_m=nothing, rssi_dbm=nothing - 50.0))
    with pytest.raises(PeerError, match="no factor of signal strengths"):
        run_gtsam(heard, SETTINGS, no_clock)
    with pytest.raises(PeerError, match=r"^GTSAM gave up on simulated: .*$"):
        run_gtsam(replace(run, first_pose=(np.nan, 0.0, 0.0)), SETTINGS, no_clock)
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(PeerError, match=r"ccatp\[peers\]"):
        run_gtsam(run, SETTINGS, no_clock)


def test_slam_with_peers_prints_all_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("gtsam", reason="the extra peers is not installed")
    file = write_lines(tmp_path / "mine.csv", csv_lines(world(seconds=20.0)))
    assert main(["radio", "slam", str(file), "--peers"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| mine")]
    assert [line.split("|")[2].strip() for line in rows] == ["ekf-slam", "smoother", "GTSAM iSAM2", "GTSAM batch"]


def test_compare_takes_all_robots_and_gives_their_mean(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_mrclam(tmp_path, world(seed=1, seconds=20.0), robot=1)
    write_mrclam(tmp_path, world(seed=2, seconds=20.0), robot=4)
    assert main(["radio", "compare", str(tmp_path)]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith(f"| {tmp_path.name}")]
    assert len(rows) == 6
    assert [cell.strip() for cell in rows[-1].split("|")[1:3]] == [f"{tmp_path.name}, mean", "smoother"]
    assert main(["radio", "compare", str(tmp_path / "missing")]) == 2
    assert "missing: no such file or folder" in capsys.readouterr().err


def test_means_are_of_each_estimator_and_missing_figures_are_dashes() -> None:
    blank = dict.fromkeys(
        ("heading_rmse_rad", "beacon_rmse_m", "range_scale", "nis_mean", "nees_mean", "update_us_p50", "run_s")
    )
    rows = [{"dataset": "a", "filter": "f", "trajectory_rmse_m": value, **blank} for value in (1.0, 3.0)]
    found = with_means(rows, "all")
    assert found[-1]["trajectory_rmse_m"] == 2.0
    assert with_means(rows[:1], "all") == rows[:1]
    lines = markdown(found)
    assert len({len(line) for line in lines}) == 1
    assert lines[-1].split("|")[4].strip() == "-"
