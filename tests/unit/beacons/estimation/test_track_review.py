"""What else a track says: residuals by beacon, the file for evo, the range that lessens the map's error most."""

import json
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.estimation.causal import filter_run
from ccatp.beacons.estimation.recording import antenna_path
from ccatp.beacons.estimation.track_review import next_range, range_residuals, residuals_by_beacon
from ccatp.beacons.rigid_motion import rigid_modes
from ccatp.cli import main
from tests.unit.beacons.datasets.sets import BEACONS, World, csv_lines, recorded, world, write_lines


def test_residuals_are_the_noise_of_the_ranges() -> None:
    cfg, run = load_recordings_config(), recorded(world(seconds=60.0, range_sigma_m=0.05))
    track = filter_run(run, cfg.csv, cfg.filter, perf_counter)
    found = residuals_by_beacon(run, range_residuals(run, track, 0.0))
    assert found.keys() == BEACONS.keys()
    for one in found.values():
        assert abs(one["median_m"]) < 0.05
        assert 0.03 < one["sigma_m"] < 0.08
    assert track.map_covariance.shape == (8, 8)


def test_the_next_range_is_the_one_that_an_update_makes_best_of() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(0.0, 10.0, (5, 2))
    root = rng.normal(0.0, 0.1, (10, 10))
    modes = rigid_modes(points)
    S = np.eye(10) - modes @ modes.T
    P = S @ root @ root.T @ S
    ends = np.array([(i, j) for i in range(5) for j in range(i)] + [(2, 5)])  # the last from a place off the map
    place = np.array((3.0, -2.0))
    ways = np.array([points[i] - (points[j] if j < 5 else place) for i, j in ends.tolist()])
    traces = []
    for (i, j), way in zip(ends.tolist(), ways, strict=True):
        h, u = np.zeros(10), way / np.linalg.norm(way)
        h[2 * i : 2 * i + 2] = u
        if j < 5:
            h[2 * j : 2 * j + 2] = -u
        traces.append(np.trace(P - np.outer(P @ h, P @ h) / (h @ P @ h + 0.05**2)))
    found = next_range(points, P, ends, ways, np.full(len(ends), 0.05))
    assert found is not None
    assert found.ends == tuple(ends[int(np.argmin(traces))].tolist())
    assert found.before_m == pytest.approx(np.sqrt(np.trace(P) / 5))
    assert found.after_m == pytest.approx(np.sqrt(min(traces) / 5))
    assert next_range(points[:2], P[:4, :4], ends[:1], ways[:1], np.ones(1)) is None


def evo_rmse_m(truth_file: Path, path_file: Path) -> float:
    """The error that evo finds after its alignment."""
    from evo.core import metrics, sync
    from evo.tools import file_interface

    truth, path = map(file_interface.read_tum_trajectory_file, (truth_file, path_file))
    truth, path = sync.associate_trajectories(truth, path, max_diff=0.06)
    path.align(truth)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((truth, path))
    return float(error.get_statistic(metrics.StatisticsType.rmse))


def test_evo_finds_the_error_of_the_path(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("evo", reason="evo is not installed")
    file, out = write_lines(tmp_path / "mine.csv", csv_lines(world(seconds=30.0))), tmp_path / "path.tum"
    assert main(["radio", "slam", str(file), "--json", "--tum", str(out)]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["measure_next"]["after_m"] < data["measure_next"]["map_m"]
    # evo takes the nearest pose of the truth, up to half an interval of 0.1 s and 2.5 cm away.
    assert evo_rmse_m(tmp_path / "path_truth.tum", out) == pytest.approx(data["trajectory_rmse_m"], abs=0.02)


def with_antenna(w: World, antenna_m: tuple[float, float], *, headings: bool) -> list[str]:
    """The run with its radio at a lever arm; a truth without headings is that of the radio."""
    read = np.column_stack([np.interp(w.read_s, w.times_s, w.poses[:, k]) for k in range(3)])
    ranges_m = np.hypot(*(np.array([*BEACONS.values()])[w.read_beacon] - antenna_path(read, antenna_m)).T)
    lines = [line for line in csv_lines(replace(w, range_m=ranges_m)) if not line.startswith(("truth", "bearing"))]
    places = w.poses if headings else antenna_path(w.poses, antenna_m)
    truth = [f"truth,{t}," + ",".join(map(str, at)) for t, at in zip(w.times_s.tolist(), places.tolist(), strict=True)]
    return [*lines, "antenna,{},{}".format(*antenna_m), *truth]


@pytest.mark.parametrize("headings", [True, False])
def test_evo_finds_the_error_of_the_path_of_an_antenna(
    headings: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without headings nobody knows where the vehicle was: both files are of the antenna, and one line says so."""
    pytest.importorskip("evo", reason="evo is not installed")
    w, out, antenna_m = world(seconds=60.0), tmp_path / "path.tum", (0.9, -0.4)
    file = write_lines(tmp_path / "mine.csv", with_antenna(w, antenna_m, headings=headings))
    assert main(["radio", "slam", str(file), "--json", "--tum", str(out)]) == 0
    said = capsys.readouterr()
    data = json.loads(said.out)
    assert data["trajectory_rmse_m"] < 0.1
    assert evo_rmse_m(tmp_path / "path_truth.tum", out) == pytest.approx(data["trajectory_rmse_m"], abs=0.02)
    what = "path_truth.tum: the truth has no headings: they are written as 0, and path.tum and it are of the antenna"
    assert (what in said.err) == (not headings)
    truth = np.loadtxt(tmp_path / "path_truth.tum")
    wanted = w.poses[:, :2] if headings else antenna_path(w.poses, antenna_m)
    assert truth[:, 1:3] == pytest.approx(wanted, abs=1e-6)
