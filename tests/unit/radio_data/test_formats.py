"""Each format gives back the run that was written, whatever liberties its files take."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from ccatp.beacons.datasets.reader import found_format, read_run
from ccatp.beacons.slam.recording import RecordedRun, dead_reckoned
from tests.unit.radio_data.sets import (
    BEACONS,
    World,
    changed,
    csv_lines,
    labyrinth_lines,
    plaza_tables,
    world,
    write_lines,
    write_mrclam,
    write_plaza,
)

W = world()


def check(run: RecordedRun, w: World, bearings: bool, headings: bool = True) -> None:
    """The run is the one of the world: path, readings, beacons, first pose."""
    assert run.beacon_ids == tuple(BEACONS)
    assert dict(run.beacon_truth_m) == BEACONS
    assert run.first_pose[:2] == pytest.approx(w.poses[0, :2], abs=1e-6)
    if headings:
        assert run.first_pose[2] == pytest.approx(w.poses[0, 2], abs=1e-6)
    path = dead_reckoned(run.steps, tuple(w.poses[0]))
    ends = np.column_stack([np.interp(w.times_s, run.steps.times_s, path[:, k]) for k in range(3)])
    assert ends == pytest.approx(w.poses, abs=2e-6)  # texts are rounded to 1e-9, over 600 steps
    assert run.readings.times_s == pytest.approx(w.read_s)
    assert run.readings.beacon.tolist() == w.read_beacon.tolist()
    assert run.readings.range_m == pytest.approx(w.range_m, abs=1e-8)
    assert np.isnan(run.readings.rssi_dbm).all()
    if bearings:
        assert run.readings.bearing_rad == pytest.approx(w.bearing_rad, abs=1e-8)
    else:
        assert np.isnan(run.readings.bearing_rad).all()
    assert run.truth is not None
    assert run.truth.x_m == pytest.approx(w.poses[:, 0], abs=1e-6)


def test_plaza_as_matlab_file_as_texts_and_as_folder(tmp_path: Path) -> None:
    mat = write_plaza(tmp_path, W)
    check(read_run(mat, None, None), W, bearings=False)
    (tmp_path / "texts").mkdir()
    texts = write_plaza(tmp_path / "texts", W, mat=False)
    check(read_run(texts, None, None), W, bearings=False)
    check(read_run(texts.with_name("Field1_TD.txt"), None, None), W, bearings=False)
    check(read_run(tmp_path / "texts", None, None), W, bearings=False)
    run = read_run(tmp_path, None, None)
    assert (run.name, run.kind) == ("Field1", "plaza")


def test_plaza_texts_without_truth_begin_at_the_origin(tmp_path: Path) -> None:
    file = write_plaza(tmp_path, W, mat=False)
    (tmp_path / "Field1_GT.txt").unlink()
    (tmp_path / "Field1_TL.txt").unlink()
    run = read_run(file, None, None)
    assert run.truth is None
    assert run.first_pose == (0.0, 0.0, 0.0)
    assert dict(run.beacon_truth_m) == {}
    assert len(run.steps.times_s) == len(run.steps.distance_m) + 1
    assert any("no reference trajectory" in warning for warning in run.warnings)


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "gzipped"])
def test_mrclam_plain_and_gzipped(tmp_path: Path, packed: bool) -> None:
    folder = write_mrclam(tmp_path, W, packed=packed)
    check(read_run(folder, None, None), W, bearings=True)
    check(read_run(folder, "mrclam", 1), W, bearings=True)
    file = next(folder.glob("Robot1_Measurement.dat*"))
    check(read_run(file, None, None), W, bearings=True)


def test_mrclam_takes_the_robot_asked_for_and_leaves_out_robots_and_strangers(tmp_path: Path) -> None:
    write_mrclam(tmp_path, changed(W, range_m=W.range_m + 1.0), robot=2)
    write_mrclam(tmp_path, W, robot=4)
    seen = tmp_path / "Robot4_Measurement.dat"
    lines = seen.read_text(encoding="utf-8").splitlines()
    seen.write_text("\n".join([*lines, "30.5 20 1.0 0.1", "30.6 77 1.0 0.1"]), encoding="utf-8")
    run = read_run(tmp_path, None, 4)
    assert run.readings.range_m == pytest.approx(W.range_m, abs=1e-8)  # neither robot 2 (code 20) nor code 77
    assert any("1 reading of barcodes that Barcodes.dat does not list (77)" in warning for warning in run.warnings)
    assert read_run(tmp_path, None, None).readings.range_m == pytest.approx(W.range_m + 1.0, abs=1e-8)


def test_mrclam_without_truth_still_reads(tmp_path: Path) -> None:
    write_mrclam(tmp_path, W)
    (tmp_path / "Robot1_Groundtruth.dat").unlink()
    (tmp_path / "Landmark_Groundtruth.dat").unlink()
    run = read_run(tmp_path, None, None)
    assert run.truth is None
    assert any("no Landmark_Groundtruth.dat" in warning for warning in run.warnings)


def test_mrclam_velocities_hold_until_the_next_row(tmp_path: Path) -> None:
    write_mrclam(tmp_path, W)
    rows = ["0.0 1.0 0.0", "2.0 1.0 0.0", "2.0 3.0 0.5", "4.0 0.0 0.0"]  # two rows of one time: the last one holds
    (tmp_path / "Robot1_Odometry.dat").write_text("\n".join(rows), encoding="utf-8")
    run = read_run(tmp_path, None, 1)
    assert run.steps.times_s.tolist() == [0.0, 2.0, 4.0]
    assert run.steps.distance_m.tolist() == [2.0, 6.0]
    assert run.steps.turn_rad.tolist() == [0.0, 1.0]


def test_labyrinth_plain_gzipped_and_as_folder(tmp_path: Path) -> None:
    file = write_lines(tmp_path / "labyrinth_0_60s.txt", labyrinth_lines(W))
    run = read_run(file, None, None)
    check(run, W, bearings=False, headings=False)
    assert run.first_pose[2] == pytest.approx(W.poses[0, 2], abs=0.02)  # told by the first two metres of positions
    packed = tmp_path / "packed"
    packed.mkdir()
    (packed / "part.txt.gz").write_bytes(gzip.compress(file.read_bytes()))
    check(read_run(packed, None, None), W, bearings=False, headings=False)
    assert read_run(packed, None, None).name == "part"


def test_csv_merges_what_was_heard_at_once(tmp_path: Path) -> None:
    run = read_run(write_lines(tmp_path / "mine.csv", csv_lines(W)), None, None)
    check(run, W, bearings=True)


def test_csv_of_signal_strengths_lateral_ways_and_names(tmp_path: Path) -> None:
    lines = [
        "odom,0,0,0", "odom,1,0.5,0.1,0.2", "odom,2,0.5,0.1", "odom,3,0.5,0.1,,",
        "rssi,0.5,door,-61", "rssi,1.5,window,-70", "rssi,1.5,window,-71", "truth,0,1,2", "truth,3,2,3",
    ]  # fmt: skip
    run = read_run(write_lines(tmp_path / "mine.csv", lines), None, None)
    assert run.beacon_ids == ("door", "window")
    assert run.readings.rssi_dbm.tolist() == [-61.0, -70.0, -71.0]
    assert np.isnan(run.readings.range_m).all()
    assert run.steps.lateral_m.tolist() == [0.2, 0.0, 0.0]
    assert run.truth is not None
    assert np.isnan(run.truth.heading_rad).all()


def test_the_format_is_found_by_name_or_first_line(tmp_path: Path) -> None:
    write_mrclam(tmp_path, W)
    assert found_format(tmp_path) == "mrclam"
    assert found_format(tmp_path / "Robot1_Odometry.dat") == "mrclam"
    assert found_format(write_lines(tmp_path / "a.txt", labyrinth_lines(W))) == "labyrinth"
    assert found_format(write_lines(tmp_path / "b.txt", csv_lines(W))) == "csv"


def test_rows_out_of_order_doubled_or_not_finite_are_mended_and_told(tmp_path: Path) -> None:
    write_mrclam(tmp_path, W)
    seen = tmp_path / "Robot1_Measurement.dat"
    head, rows = seen.read_text(encoding="utf-8").splitlines()[:2], seen.read_text(encoding="utf-8").splitlines()[2:]
    rows[10], rows[11] = rows[11], rows[10]
    rows.insert(50, rows[49])
    rows.insert(100, "19.971 60 nan 0.1")
    seen.write_text("\n".join([*head, *rows]), encoding="utf-8")
    run = read_run(tmp_path, None, None)
    check(run, W, bearings=True)
    told = " | ".join(run.warnings)
    assert "Robot1_Measurement.dat:14: time goes back 1 time" in told
    assert "Robot1_Measurement.dat:53: 1 row doubled" in told
    assert "Robot1_Measurement.dat:103: 1 row not finite" in told


def test_readings_beyond_the_odometry_are_left_out_and_told(tmp_path: Path) -> None:
    tables = plaza_tables(W)
    early = np.array([[-5.0, 2.0, 6.0, 3.0]])
    write_plaza(tmp_path, W, mat=False)
    np.savetxt(tmp_path / "Field1_TD.txt", np.concatenate([early, tables["TD"]]))
    run = read_run(tmp_path, None, None)
    assert len(run.readings.times_s) == len(W.read_s)
    assert any("1 range before the first or after the last odometry" in warning for warning in run.warnings)


def test_csv_with_a_head_of_words_or_quoted_cells(tmp_path: Path) -> None:
    lines = csv_lines(W)
    check(read_run(write_lines(tmp_path / "head.csv", ["time,x,y", *lines]), None, None), W, bearings=True)
    quoted = [line if line.startswith("#") else ",".join(f'"{cell}"' for cell in line.split(",")) for line in lines]
    check(read_run(write_lines(tmp_path / "quoted.csv", quoted), None, None), W, bearings=True)


def test_csv_with_a_truth_that_lacks_some_headings_is_told(tmp_path: Path) -> None:
    lines = csv_lines(W)
    row = next(k for k, line in enumerate(lines) if line.startswith("truth,5.0,"))
    lines[row] = lines[row].rsplit(",", 1)[0]
    run = read_run(write_lines(tmp_path / "mine.csv", lines), None, None)
    assert any(f"mine.csv:{row + 1}: 1 row of truth without heading" in warning for warning in run.warnings)
