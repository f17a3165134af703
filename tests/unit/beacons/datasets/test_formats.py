"""Each format gives back the run that was written, whatever liberties its files take; a fault is one line."""

import gzip
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from ccatp.beacons.datasets.events import EVENTS
from ccatp.beacons.datasets.reader import found_format, read_run
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.datasets.trajectory import LOST_RAD, bridged
from ccatp.beacons.estimation.recording import Known, RecordedRun, Steps, antenna_path, dead_reckoned
from ccatp.core import FloatArray
from ccatp.errors import ExitStatus
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
MRCLAM_TRUTH = ("mrclam", "Robot1_Groundtruth.dat", "Landmark_Groundtruth.dat")


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


def _texts(folder: Path) -> Path:
    return write_plaza(folder, W, mat=False).with_name("Field1_TD.txt")


def _packed(folder: Path) -> Path:
    (folder / "part.txt.gz").write_bytes(gzip.compress("\n".join(labyrinth_lines(W)).encode()))
    return folder


def _quoted(folder: Path) -> Path:
    lines = (line if line.startswith("#") else '"' + line.replace(",", '","') + '"' for line in csv_lines(W))
    return write_lines(folder / "mine.csv", [*lines])


def _european(folder: Path) -> Path:
    text = "\r\n".join(csv_lines(W)).replace(",", ";").replace(".", ",")
    (folder / "mine.csv").write_bytes(f"# Winkel gegen Norden in \xb0\r\n{text}".encode("cp1252"))
    return folder / "mine.csv"


def _wide(folder: Path) -> Path:
    text = "\n".join(csv_lines(W)).replace(",", "\t")
    (folder / "mine.csv").write_bytes(text.encode("utf-16"))
    return folder / "mine.csv"


# What writes the run, its name, whether it has bearings, and whether the first heading is the truth's or that which the
# first two metres of positions tell.
WAYS: dict[str, tuple[Callable[[Path], Path], str, bool, bool]] = {
    "plaza": (lambda folder: write_plaza(folder, W), "Field1", False, True),
    "plaza in a folder": (lambda folder: write_plaza(folder, W).parent, "Field1", False, True),
    "plaza texts": (_texts, "Field1", False, True),
    "plaza texts in a folder": (lambda folder: _texts(folder).parent, "Field1", False, True),
    "mrclam": (lambda folder: write_mrclam(folder, W), "run robot 1", True, True),
    "mrclam packed": (lambda folder: write_mrclam(folder, W, packed=True), "run robot 1", True, True),
    "mrclam file": (lambda folder: write_mrclam(folder, W) / "Robot1_Measurement.dat", "run robot 1", True, True),
    "labyrinth": (lambda folder: write_lines(folder / "a_0.txt", labyrinth_lines(W)), "a_0", False, False),
    "labyrinth packed": (_packed, "part", False, False),
    "csv": (lambda folder: write_lines(folder / "mine.csv", csv_lines(W)), "mine", True, True),
    "csv with a head": (lambda folder: write_lines(folder / "b.txt", ["t,x,y", *csv_lines(W)]), "b", True, True),
    "csv quoted": (_quoted, "mine", True, True),
    "csv with decimal commas in Windows-1252": (_european, "mine", True, True),
    "csv with tabs in UTF-16": (_wide, "mine", True, True),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_run_comes_back(way: str, tmp_path: Path) -> None:
    make, name, bearings, headings = WAYS[way]
    folder = tmp_path / "run"
    folder.mkdir()
    run = read_run(make(folder), None, None)
    check(run, W, bearings, headings)
    assert (run.name, run.kind) == (name, way.split(maxsplit=1)[0])
    assert run.first_pose[2] == pytest.approx(W.poses[0, 2], abs=0.02)


@pytest.mark.parametrize(("form", "truth", "survey"), [("plaza", "Field1_GT.txt", "Field1_TL.txt"), MRCLAM_TRUTH])
def test_without_truth_a_run_begins_at_the_origin(form: str, truth: str, survey: str, tmp_path: Path) -> None:
    folder = write_plaza(tmp_path, W, mat=False).parent if form == "plaza" else write_mrclam(tmp_path, W)
    (folder / truth).unlink()
    (folder / survey).unlink()
    run = read_run(folder, None, None)
    assert (run.truth, run.first_pose, dict(run.beacon_truth_m)) == (None, (0.0, 0.0, 0.0), {})
    assert len(run.steps.times_s) == len(run.steps.distance_m) + 1
    reported = " | ".join(run.warnings)
    assert "no reference trajectory" in reported
    assert ("no Landmark_Groundtruth.dat" in reported) == (form == "mrclam")


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


def test_mrclam_velocities_hold_until_the_next_row(tmp_path: Path) -> None:
    write_mrclam(tmp_path, W)
    rows = ["0.0 1.0 0.0", "2.0 1.0 0.0", "2.0 3.0 0.5", "4.0 0.0 0.0"]  # two rows of one time: the last one holds
    (tmp_path / "Robot1_Odometry.dat").write_text("\n".join(rows), encoding="utf-8")
    run = read_run(tmp_path, None, 1)
    assert run.steps.times_s.tolist() == [0.0, 2.0, 4.0]
    assert run.steps.distance_m.tolist() == [2.0, 6.0]
    assert run.steps.turn_rad.tolist() == [0.0, 1.0]


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


def test_rows_out_of_order_doubled_or_not_finite_are_repaired_and_reported(tmp_path: Path) -> None:
    write_mrclam(tmp_path, W)
    seen = tmp_path / "Robot1_Measurement.dat"
    head, rows = seen.read_text(encoding="utf-8").splitlines()[:2], seen.read_text(encoding="utf-8").splitlines()[2:]
    rows[10], rows[11] = rows[11], rows[10]
    rows.insert(50, rows[49])
    rows.insert(100, "19.971 60 nan 0.1")
    seen.write_text("\n".join([*head, *rows]), encoding="utf-8")
    run = read_run(tmp_path, None, None)
    check(run, W, bearings=True)
    reported = " | ".join(run.warnings)
    assert "Robot1_Measurement.dat:14: time goes back 1 time" in reported
    assert "Robot1_Measurement.dat:53: 1 row doubled" in reported
    assert "Robot1_Measurement.dat:103: 1 row not finite" in reported


def test_readings_beyond_the_odometry_are_not_used_and_reported(tmp_path: Path) -> None:
    tables = plaza_tables(W)
    early = np.array([[-5.0, 2.0, 6.0, 3.0]])
    write_plaza(tmp_path, W, mat=False)
    np.savetxt(tmp_path / "Field1_TD.txt", np.concatenate([early, tables["TD"]]))
    run = read_run(tmp_path, None, None)
    assert len(run.readings.times_s) == len(W.read_s)
    assert any("1 range before the first or after the last odometry" in warning for warning in run.warnings)


def test_csv_with_a_truth_that_lacks_some_headings_is_reported(tmp_path: Path) -> None:
    lines = csv_lines(W)
    row = next(k for k, line in enumerate(lines) if line.startswith("truth,5.0,"))
    lines[row] = lines[row].rsplit(",", 1)[0]
    run = read_run(write_lines(tmp_path / "mine.csv", lines), None, None)
    assert any(f"mine.csv:{row + 1}: 1 row of truth without heading" in warning for warning in run.warnings)


DOCS = Path(__file__).parents[4] / "docs"
EXAMPLE = DOCS / "radio_example.csv"


def test_the_example_and_its_page() -> None:
    run = read_run(EXAMPLE, None, None)
    assert run.warnings == ()
    assert run.beacon_ids == ("door", "window", "desk")
    assert run.first_pose == (1.0, 1.0, 0.0)
    text = (DOCS / "radio_data.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| `([^`]*)`", text, re.MULTILINE)
    assert dict(rows) == {
        event: ", ".join(columns).replace("(", "[").replace(")", "]") for event, columns in EVENTS.items()
    }
    shown = text.split("```text\n")[1].split("```")[0].splitlines()
    assert {*shown} - {"..."} <= {*EXAMPLE.read_text(encoding="utf-8").splitlines()}


def steps_of(distance_m: FloatArray, turn_rad: FloatArray, interval_s: float = 0.1) -> Steps:
    return Steps(interval_s * np.arange(distance_m.size + 1.0), distance_m, turn_rad, np.zeros(distance_m.size))


def test_a_row_that_is_lost_continues_as_before() -> None:
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
    assert any(
        "1 row not finite or empty (the first here): the way there is not measured" in line for line in run.warnings
    )


W_SHORT = world(seconds=20.0)
Make = Callable[[Path], Path]


def _mat(**changes: object) -> Make:
    def make(folder: Path) -> Path:
        tables: dict[str, object] = {**plaza_tables(W_SHORT), **changes}
        scipy.io.savemat(folder / "Field1.mat", {k: v for k, v in tables.items() if v is not None})
        return folder / "Field1.mat"

    return make


def _changed(name: str, text: str | None, given: str = "") -> Make:
    """A set of texts with one file that has another text, or none; the path to it, or to ``given``."""

    def make(folder: Path) -> Path:
        if name.startswith("Field1"):
            write_plaza(folder, W_SHORT, mat=False)
        else:
            write_mrclam(folder, W_SHORT)
        if text is None:
            (folder / name).unlink()
        else:
            (folder / name).write_text(text, encoding="utf-8")
        return folder / given

    return make


def _plaza_file(kind: str, text: str) -> Make:
    return _changed(f"Field1_{kind}.txt", text, "Field1_DR.txt")


def _two_sets(folder: Path) -> Path:
    write_plaza(folder, W_SHORT, "Field1")
    write_plaza(folder, W_SHORT, "Field2")
    return folder


def _text(*lines: str) -> Make:
    return lambda folder: write_lines(folder / "data.txt", list(lines))


def _bytes(name: str, data: bytes) -> Make:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    return make


def _two_labyrinths(folder: Path) -> Path:
    for name in ("a.txt", "b.txt"):
        write_lines(folder / name, labyrinth_lines(W_SHORT))
    return folder


def test_a_file_that_is_not_text_does_not_hide_the_format_of_its_folder(tmp_path: Path) -> None:
    write_lines(tmp_path / "a_0.txt", labyrinth_lines(W_SHORT))
    (tmp_path / "0.csv").write_bytes(b"\xff\xfe\x00\xd8")
    assert found_format(tmp_path) == "labyrinth"
    with pytest.raises(RadioDataError, match="is not text"):
        found_format(tmp_path / "0.csv")


def _folder(folder: Path) -> Path:
    return folder


def _with(line: str) -> Make:
    return lambda folder: write_lines(folder / "mine.csv", [*csv_lines(W_SHORT), line])


def _far(column: int, value: float) -> Make:
    """The CSV with half of its odometry beyond what can be."""

    def make(folder: Path) -> Path:
        lines = csv_lines(W_SHORT)
        for row, line in enumerate(lines):
            cells = [*line.split(","), "0"]
            if cells[0] == "odom" and float(cells[1]) > 10.0:
                cells[1 + column] = str(value)
                lines[row] = ",".join(cells[:5])
        return write_lines(folder / "mine.csv", lines)

    return make


def _spaced(interval_s: float) -> Make:
    rows = [f"odom,{k * interval_s},0.1,0" for k in range(30)]
    return lambda folder: write_lines(folder / "mine.csv", [*rows, "range,3,a,1"])


LAST = len(csv_lines(W_SHORT)) + 1
CUT = gzip.compress("\n".join(labyrinth_lines(W_SHORT)).encode())[:2000]
FAULTS: list[tuple[Make, str | None, str]] = [
    (lambda folder: folder / "missing", None, r"missing: no such file or folder$"),
    (_folder, None, r"none of the formats plaza, mrclam, labyrinth, csv"),
    (_text("hello, world", "1 2 3"), None, r"data\.txt: none of the formats"),
    (_bytes("data.bin", b"\xff\xfe\x00\xd8"), None, r"data\.bin: is not text"),
    (_bytes("data.csv", b"odom,0,0,0\nodom,1,0\0\0\0\0"), None, r"data\.csv:2: is not text"),
    (_bytes("data.xlsx", b"PK\x03\x04\x81\x00"), None, r"data\.xlsx: is not text; give a recording as text, or a ROS"),
    (_bytes("part.txt.gz", CUT), None, r"part\.txt\.gz: cannot be read: .*end-of-stream"),
    (_folder, "csv", r"is a folder: name the CSV file in it"),
    (_folder, "plaza", r"holds no Plaza set: neither NAME\.mat nor NAME_DR\.txt"),
    (_folder, "mrclam", r"holds no MRCLAM set: no file RobotN_Odometry\.dat"),
    (_folder, "labyrinth", r"holds no Labyrinth text"),
    (_two_labyrinths, None, r"holds 2 Labyrinth texts: name one"),
    (_two_sets, None, r"holds 2 sets: name one, as in .*Field1\.mat"),
    (_bytes("Field1.mat", b"no matrix at all"), None, r"Field1\.mat: is no MATLAB file that can be read"),
    (_bytes("Field1.mat", b""), None, r"Field1\.mat: is no MATLAB file that can be read"),
    (_mat(TD=None), None, r"Field1\.mat: has no variable TD \(time"),
    (_mat(DR=np.ones((5, 2))), None, r"variable DR has shape \(5, 2\), wanted \(n, 3\): time"),
    (_mat(TD="text"), None, r"variable TD does not hold numbers"),
    (_mat(DR=np.ones((2, 3))), None, r"1 row of odometry: too few for a run"),
    (_mat(TD=np.array([[1e6, 2.0, 6.0, 3.0]])), None, r"no readings of beacons within the time of the odometry"),
    (_changed("Field1_DR.txt", None, "Field1_TD.txt"), None, r"Field1_DR\.txt: no such file .*: it goes with Field1"),
    (_changed("Field1_TD.txt", None, "Field1_DR.txt"), None, r"Field1_TD\.txt: no such file .*: it goes with"),
    (_text("1 2 3"), "plaza", r"data\.txt: is no file of a Plaza set"),
    (_plaza_file("TD", "1.0 2 6\n"), None, r"Field1_TD\.txt:1: 3 columns, wanted 4: time"),
    (_plaza_file("TD", "# only a comment\n"), None, r"Field1_TD\.txt: no rows; wanted lines of time"),
    (_plaza_file("TD", "1.0 2 6 3.0\n1.1 2 6 far\n"), None, r"Field1_TD\.txt:2: range \[m\] is 'far', not a number"),
    (_changed("Robot1_Measurement.dat", None), None, r"Robot1_Measurement\.dat: no such file \(nor gzipped\)"),
    (_changed("Barcodes.dat", None), None, r"Barcodes\.dat: no such file \(nor gzipped\): readings name barcodes"),
    (_changed("Robot1_Odometry.dat", "1 0 0\n2 0 0\n"), None, r"Robot1_Odometry\.dat: 2 rows of odometry: too few"),
    (_changed("Robot1_Measurement.dat", "5.0 20 1 0\n"), None, r"no reading of a landmark"),
    (_text("range2 0.1 2 0.1 0 0 105", "gps 1 2"), None, r"data\.txt:2: 'gps' is none of range2, odom2diff, gt2"),
    (_text("range2 0.1 2 0.1 0 0"), None, r"data\.txt:1: 5 values after range2, wanted time"),
    (_text("range2 0.1 2 0.1 0 0 105"), None, r"data\.txt: no line odom2diff \(time"),
    (_text(*[f"odom2diff {k} 0 0 0 0.1 0 0 0" for k in range(3)]), None, r"data\.txt: no line range2"),
    (
        _text("range2 9 2 0.1 0 0 105", *[f"odom2diff {k} 0 0 0 0.1 0 0 0" for k in range(3)]), None,
        r"no readings of beacons within the time of the odometry",
    ),
    (
        _text("range2 0 2 0.1 0 0 105", *[f"odom2diff {k} 0 0 0 0.1 0 0 0" for k in range(2)]), None,
        r"2 rows of odometry: too few for a run",
    ),
    (
        _text("range2 0 2 0.1 0 0 105", *[f"odom2diff {k} 0 0 0 {k - 1} 0 0 0" for k in range(3)]), None,
        r"data\.txt:2: the distance between the wheels is not positive",
    ),
    (_text("", "# a comment"), None, r"data\.txt: is empty: no line but comments"),
    (_with("lidar,1,2"), None, rf"mine\.csv:{LAST}: 'lidar' is none of odom, speed, pose, range"),
    (_with("range,1,6"), None, rf"mine\.csv:{LAST}: 2 values after range, wanted time_s, beacon, range_m"),
    (_with("range,soon,6,2"), None, rf"mine\.csv:{LAST}: time_s is 'soon', not a number"),
    (_text("range,1,6,2.0"), None, r"data\.txt: no event odom \(time_s, distance_m, turn_rad"),
    (_text("odom,0,0,0", "odom,1,0,0"), None, r"no readings of beacons: no event range, bearing, rssi"),
    (_text("odom,0,0,0", "odom,1,0,0", "range,0,a,1"), None, r"2 rows of odometry: too few for a run"),
    (
        _text("odom,0,0,0", "odom,1,0,0", "odom,2,0,0", "range,9,a,1"), None,
        r"no readings of beacons within the time of the odometry",
    ),
    (_with("range,1,,3"), None, rf"mine\.csv:{LAST}: range has no name of a beacon"),
    (_with("beacon,6,9,9"), None, rf"mine\.csv:{LAST}: beacon 6 was surveyed at another place before"),
    (_far(1, 1e300), None, r"mine\.csv:\d+: odometry: a step forward of 1e\+300 m at 10\.1 s cannot be"),
    (_far(3, -1e300), None, r"a step to the left of -1e\+300 m at 10\.1 s cannot be"),
    (_far(2, 1e200), None, r"a turn of 1e\+200 rad at 10\.1 s cannot be"),
    (_spaced(1e4), None, r"odometry comes every 1e\+04 s: are its times in microseconds\?"),
    (_spaced(1e8), None, r"odometry comes every 1e\+08 s: are its times in nanoseconds\?"),
    (
        _text("odom,0,0,0", "odom,1,0,0", "odom,2,0,0", "range,1,a,1e200"), None,
        r"none of its readings can be used \(.*1 range beyond 1e\+06 m",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("make", "data_format", "reported"), FAULTS, ids=[reported for _, _, reported in FAULTS])
def test_a_fault_is_one_line(tmp_path: Path, make: Make, data_format: str | None, reported: str) -> None:
    with pytest.raises(RadioDataError, match=reported) as caught:
        read_run(make(tmp_path), data_format, None)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == ExitStatus.USAGE


def test_a_robot_that_is_not_there(tmp_path: Path) -> None:
    write_mrclam(tmp_path, W_SHORT, robot=2)
    with pytest.raises(RadioDataError, match=r"has no odometry of robot 1; there are 2 \(see docs/radio_data\.md\)$"):
        read_run(tmp_path, None, 1)
    with pytest.raises(RadioDataError, match=r"a plaza set has one vehicle: leave out --robot"):
        read_run(write_plaza(tmp_path, W_SHORT), None, 1)


def test_readings_that_cannot_be_are_not_used(tmp_path: Path) -> None:
    lines = ["range,1.01,6,1e200", "rssi,1.02,6,-1e9", "bearing,1.03,6,inf", "range,1.04,7,2.5", "bearing,1.04,7,1e9"]
    lines.append("range,1.05,6,0")
    run = read_run(write_lines(tmp_path / "mine.csv", [*csv_lines(W_SHORT), *lines, "beacon,far,1e200,0"]), None, None)
    assert len(run.readings.times_s) == len(W_SHORT.read_s) + 1
    assert "far" not in run.beacon_truth_m
    reported = " ".join(run.warnings)
    assert "1 range beyond 1e+06 m, the first 1e+200 m at 1.01 s" in reported
    for words in (
        "1 range of 0 m, the first at 1.05 s",
        "1 signal strength beyond",
        "1 bearing beyond",
        "surveyed place of far: is no place",
    ):
        assert words in reported


def small(*lines: str) -> list[str]:
    """Four steps of odometry and two ranges of a beacon."""
    odometry = [f"odom,{t},0.1,0.2" for t in range(5)]
    return [*odometry, "range,1.5,a,2.0", "range,2.5,a,5.0", *lines]


@pytest.mark.parametrize(
    ("lines", "what"),
    [
        (("antenna,0.1,0.2", "antenna,0.3,0.2"), "csv:9: more than one antenna"),
        (("antenna,nan,0.2",), "csv:8: more than one antenna, or one at no place"),
    ],
)
def test_an_antenna_at_no_place_or_at_two_is_refused(tmp_path: Path, lines: tuple[str, ...], what: str) -> None:
    with pytest.raises(RadioDataError, match=what):
        read_run(write_lines(tmp_path / "a.csv", small(*lines)), None, None)


def test_a_range_that_is_shorter_than_the_height(tmp_path: Path) -> None:
    run = read_run(write_lines(tmp_path / "a.csv", small("beacon,a,1,1,3.5", "antenna,0,0,0.5")), None, None)
    assert "1 range shorter than the beacon is above the antenna, not used, the first at 1.5 s" in run.warnings
    assert run.readings.range_m.tolist() == [4.0]  # of 5 m, 3 m above
    assert "a" in run.levelled
    assert run.raised.tolist() == [name != "a" for name in run.beacon_ids]  # its height is not estimated again


def test_an_antenna_and_a_truth_without_headings(tmp_path: Path) -> None:
    truth = [f"truth,{t},{0.1 * t},0" for t in range(5)]
    run = read_run(write_lines(tmp_path / "a.csv", small("antenna,0.5,0", *truth)), None, None)
    assert "the truth has no headings: its positions are taken as the antenna's" in run.warnings
    assert run.truth is not None
    assert run.truth.x_m.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert run.steps.lateral_m == pytest.approx(2.0 * np.sin(0.1) * 0.5)


def test_the_first_pose_of_an_antenna(tmp_path: Path) -> None:
    """By --start it is that of the vehicle, by a truth without headings that of the antenna; one frame in any case."""
    antenna_m = (0.9, -0.4)
    (x_m, y_m), *_ = antenna_path(W.poses[:1], antenna_m).tolist()
    lines = [line for line in csv_lines(W) if not line.startswith("truth")]
    places = zip(W.times_s.tolist(), antenna_path(W.poses, antenna_m).tolist(), strict=True)
    truth = [f"truth,{t},{','.join(map(str, at))}" for t, at in places]
    file = write_lines(tmp_path / "a.csv", [*lines, *truth, "antenna,0.9,-0.4"])
    start = Known(first_pose=(3.0, 1.0, 0.4))  # of the vehicle in ``world``
    for known in (Known(), start):
        run = read_run(file, None, None, known=known)
        assert run.first_pose == pytest.approx((x_m, y_m, 0.4), abs=1e-6)
