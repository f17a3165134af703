"""Each format gives back the run that was written, whatever liberties its files take."""

import gzip
import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from openpyxl import Workbook

from ccatp.beacons.datasets.events_csv import EVENTS
from ccatp.beacons.datasets.levels import read_levels, read_log, read_places, read_workbook
from ccatp.beacons.datasets.reader import found_format, read_run
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.datasets.trajectory import LOST_RAD, bridged
from ccatp.beacons.slam.recording import RecordedRun, Steps, dead_reckoned
from ccatp.cli import main
from ccatp.core import FloatArray
from tests.unit.beacons.datasets.sets import (
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


DOCS = Path(__file__).parents[4] / "docs"
EXAMPLE = DOCS / "radio_example.csv"
PAGE = DOCS / "radio_data.md"


def test_the_example_reads_without_a_warning() -> None:
    run = read_run(EXAMPLE, None, None)
    assert run.warnings == ()
    assert run.beacon_ids == ("door", "window", "desk")
    assert run.first_pose == (1.0, 1.0, 0.0)


@pytest.mark.parametrize("filter_name", ["ekf-slam", "smoother"])
def test_the_example_is_solved(filter_name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["radio", "slam", str(EXAMPLE), "--filter", filter_name, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["trajectory_rmse_m"] < 0.15
    assert data["beacon_rmse_m"] < 0.3


def test_the_page_lists_every_event_with_its_columns() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `([^`]*)`", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert dict(rows) == {
        event: ", ".join(columns).replace("(", "[").replace(")", "]") for event, columns in EVENTS.items()
    }


def test_the_page_shows_lines_of_the_example() -> None:
    text = PAGE.read_text(encoding="utf-8")
    shown = text.split("```text\n")[1].split("```")[0].splitlines()
    lines = EXAMPLE.read_text(encoding="utf-8").splitlines()
    assert all(line in lines for line in shown if line != "...")


ROWS: list[list[str | float | None]] = [["Distance", None, "RSSI"], [0.5, None, -40], [1, None, -47]]


def workbook(file: Path) -> Path:
    book = Workbook()
    sheet = book.active
    assert sheet is not None
    sheet.title = "Zigbee"
    for row in ROWS:
        sheet.append(row)
    book.save(file)
    return file


def test_a_workbook_is_read_with_its_gaps(tmp_path: Path) -> None:
    file = workbook(tmp_path / "a.xlsx")
    assert read_workbook(file) == {"Zigbee": [["Distance", "", "RSSI"], ["0.5", "", "-40"], ["1", "", "-47"]]}
    table = read_levels(file)
    assert [pair[:2] for pair in table.pairs] == [(0.5, -40.0), (1.0, -47.0)]
    assert table.name == "a.xlsx, sheet Zigbee"


def test_what_is_no_workbook_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.xlsx").write_text("distance,rssi\n")
    with pytest.raises(RadioDataError, match=r"is no \.xlsx workbook"):
        read_workbook(tmp_path / "a.xlsx")
    with pytest.raises(RadioDataError, match="no such file"):
        read_workbook(tmp_path / "b.xlsx")
    with zipfile.ZipFile(tmp_path / "c.xlsx", "w") as archive:
        archive.writestr("other", "")
    with pytest.raises(RadioDataError, match=r"is no \.xlsx workbook"):
        read_workbook(tmp_path / "c.xlsx")
    with zipfile.ZipFile(workbook(tmp_path / "d.xlsx"), "a") as archive:
        archive.writestr("xl/theme/more.xml", '<!DOCTYPE a [<!ENTITY b "c">]><a/>')
    with pytest.raises(RadioDataError, match="defines entities"):
        read_workbook(tmp_path / "d.xlsx")
    with pytest.raises(RadioDataError, match='has no sheet "BLE"; there are Zigbee'):
        read_levels(workbook(tmp_path / "e.xlsx"), "BLE")


@pytest.mark.parametrize("damage", range(0, 4000, 157))
def test_a_damaged_workbook_is_read_or_refused_in_one_line(tmp_path: Path, damage: int) -> None:
    data = bytearray(workbook(tmp_path / "a.xlsx").read_bytes())
    data[damage % len(data)] ^= 0x55
    (tmp_path / "a.xlsx").write_bytes(data)
    said = "as it was"
    try:
        assert read_workbook(tmp_path / "a.xlsx")["Zigbee"][1][0] == "0.5"
    except RadioDataError as error:
        said = str(error)
    assert "\n" not in said


@pytest.mark.parametrize(
    "text", ["distance_m,rssi_dbm\n1,-40\n2,-46\n", "# note\nd level\n1 -40\n2 -46\n", "range;dBm\n1;40\n2;46\n"]
)
def test_csv_in_its_usual_shapes(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    table = read_levels(tmp_path / "a.csv")
    assert [pair[:2] for pair in table.pairs] == [(1.0, -40.0), (2.0, -46.0)]
    assert bool(table.warnings) == ("-" not in text)


def test_places_with_levels_by_node(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("Point,x,y,RSSI A,RSSI B\n1,0.5,1,56,60\n2,1,0,57,61\n")
    table = read_places(tmp_path / "a.csv")
    assert table.places[1].place_m == (1.0, 0.0)
    assert table.places[0].levels_dbm == {"A": -56.0, "B": -60.0}
    (tmp_path / "b.csv").write_text("x,y,level\n1,2,-40\n")
    with pytest.raises(RadioDataError, match="has no column of levels by node"):
        read_places(tmp_path / "b.csv")


def test_a_folder_of_logs_with_their_distances(tmp_path: Path) -> None:
    (tmp_path / "1.txt").write_text("Node A: -29\nNode A: -30\n\n")
    (tmp_path / "2.txt").write_text("Node A: -35\n")
    (tmp_path / "points.csv").write_text("distance_m,point\n0.1,1\n0.2,2\n0.3,3\n")
    table = read_levels(tmp_path, None, tmp_path / "points.csv")
    assert [pair[:2] for pair in table.pairs] == [(0.1, -29.0), (0.1, -30.0), (0.2, -35.0)]
    assert table.warnings == ("1 logs are missing, the first 3.txt",)
    with pytest.raises(RadioDataError, match="name the table of their distances with --points"):
        read_levels(tmp_path)
    (tmp_path / "none").mkdir()
    with pytest.raises(RadioDataError, match="holds none of the logs"):
        read_levels(tmp_path / "none", None, tmp_path / "points.csv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "has no column of distances"),
        ("distance_m,b\n1,2\n", "has no column of levels"),
        ("distance_m,rssi\n", "holds no rows below a head"),
        ("distance_m,rssi\n1,loud\n", r":2: \"loud\" in column 2 is no number"),
    ],
)
def test_tables_that_say_nothing_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(RadioDataError, match=message):
        read_levels(tmp_path / "a.csv")


def test_a_log_line_of_another_kind_is_told_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "1.txt").write_text("Node A: -29\nNode A -30\n")
    with pytest.raises(RadioDataError, match=r"1\.txt:2: .*is no line like"):
        read_log(tmp_path / "1.txt")


def steps_of(distance_m: FloatArray, turn_rad: FloatArray, interval_s: float = 0.1) -> Steps:
    return Steps(interval_s * np.arange(distance_m.size + 1.0), distance_m, turn_rad, np.zeros(distance_m.size))


def test_steps_without_a_gap_stay_as_they_are() -> None:
    steps = steps_of(np.full(100, 0.05), np.full(100, 0.01))
    assert bridged(steps) is steps


def test_a_row_that_is_lost_goes_on_as_before() -> None:
    rng = np.random.default_rng(1)
    distance: FloatArray = 0.05 + 0.001 * rng.standard_normal(1000)
    distance[400] = np.nan
    found = bridged(steps_of(distance, np.full(1000, 0.01)))
    assert found.distance_m[400] == pytest.approx(0.05, abs=0.002)
    assert found.turn_rad[400] == pytest.approx(0.01)
    assert np.sqrt(found.guess_m2[400]) == pytest.approx(0.001, rel=0.3)  # type: ignore[index]  # as steps differ
    assert np.count_nonzero(found.guess_m2) == 1


def test_a_long_gap_leaves_the_heading_lost_and_the_place_as_far_as_it_may_have_driven() -> None:
    t = np.arange(6000)
    turn = 0.03 * np.sign(np.sin(0.013 * t))  # lanes up and down
    whole = steps_of(np.full(6000, 0.05), turn)
    keep = np.concatenate([[True], (t < 3000) | (t >= 3200)])
    cut = Steps(whole.times_s[keep], *(column[keep[1:]] for column in whole[1:4]))
    found = bridged(cut)
    assert found.times_s[3001] - found.times_s[3000] == pytest.approx(20.1)
    guess_m2, guess_rad2 = np.asarray(found.guess_m2)[3000], np.asarray(found.guess_rad2)[3000]
    assert guess_rad2 == pytest.approx(LOST_RAD**2)
    assert np.sqrt(guess_m2) == pytest.approx(10.0, rel=0.15)  # at 0.5 m/s, anywhere about where it was
    assert abs(found.distance_m[3000]) < 3.0


@pytest.mark.parametrize("form", ["plaza", "csv"])
def test_a_row_that_is_not_finite_keeps_its_time(tmp_path: Path, form: str) -> None:
    w = world()
    if form == "plaza":
        write_plaza(tmp_path, w, mat=False)
        table = plaza_tables(w)["DR"]
        table[50, 1] = np.nan
        file = tmp_path / "Field1_DR.txt"
        np.savetxt(file, table)
    else:
        lines = csv_lines(w)
        row = next(k for k, line in enumerate(lines) if line.startswith(f"odom,{w.times_s[51]},"))
        lines[row] = f"odom,{w.times_s[51]},nan,{w.turn_rad[50]}"
        file = write_lines(tmp_path / "mine.csv", lines)
    run = read_run(file, None, None)
    assert run.steps.times_s.size == w.times_s.size
    assert run.steps.distance_m.sum() == pytest.approx(w.distance_m.sum(), abs=2e-3)
    assert any("1 row not finite (the first here): the way there is guessed" in line for line in run.warnings)
