"""What looks wrong in a set is told; what is sound is not."""

import gzip
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from ccatp.beacons.datasets.checks import suspicions
from ccatp.beacons.datasets.reader import read_run
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.slam.recording import RecordedRun, ReferencePath, Steps
from ccatp.errors import ExitStatus
from tests.unit.beacons.datasets.sets import (
    BEACONS,
    csv_lines,
    labyrinth_lines,
    plaza_tables,
    recorded,
    world,
    write_lines,
    write_mrclam,
    write_plaza,
)

W = world(seconds=120.0)


def noisy(run: RecordedRun, scale: float = 1.0, turn_scale: float = 1.0) -> RecordedRun:
    """Odometry as wheels would tell it, so that it is not the truth itself."""
    rng = np.random.default_rng(7)
    steps = run.steps
    distance = scale * steps.distance_m * (1.0 + 0.05 * rng.standard_normal(steps.distance_m.size))
    turn = turn_scale * steps.turn_rad * (1.0 + 0.05 * rng.standard_normal(steps.turn_rad.size))
    return replace(run, steps=Steps(steps.times_s, distance, turn, steps.lateral_m))


SOUND = noisy(recorded(W))


def with_readings(run: RecordedRun, **columns: np.ndarray) -> RecordedRun:
    """The run with other readings."""
    return replace(run, readings=run.readings._replace(**columns))


def with_truth(run: RecordedRun, **columns: np.ndarray) -> RecordedRun:
    """The run with another truth."""
    assert run.truth is not None
    return replace(run, truth=run.truth._replace(**columns))


def told(run: RecordedRun) -> str:
    """All warnings as one text."""
    return " | ".join(suspicions(run))


def test_a_sound_run_raises_no_suspicion() -> None:
    assert suspicions(SOUND) == []


def test_odometry_that_equals_the_truth() -> None:
    found = told(recorded(W))
    assert "odometry distance equals the truth" in found
    assert "odometry turns equal the truth" in found


READ, COURSE = SOUND.readings, SOUND.truth
assert COURSE is not None
SHUFFLED = np.random.default_rng(3).permutation(SOUND.steps.turn_rad) * np.where(np.arange(1200) % 2, 1.0, -1.0)
KEPT = (W.times_s < 30.0) | (W.times_s > 35.0)
ONE_NEGATIVE = np.where(np.arange(READ.range_m.size) == 5, -1.0, READ.range_m)
SURVEYS: dict[str, dict[str, tuple[float, float]]] = {
    "moved": {**BEACONS, "8": (9.0, 4.0)},
    "taken": {**BEACONS, "8": (60.0, 60.0), "77": BEACONS["8"]},
    "few": {name: BEACONS[name] for name in ("6", "7")},
}
WRONG: list[tuple[RecordedRun, str]] = [
    (noisy(recorded(W), scale=0.8), "odometry distance: true ways are 1.25 times it"),
    (noisy(recorded(W), scale=1000.0), "true ways are 0.001 times it: are they in millimetres?"),
    (noisy(recorded(W), turn_scale=0.8), "true turns are 1.24 times them (track of the wheels?)"),
    (noisy(recorded(W), turn_scale=180.0 / np.pi), "are the turns in degrees?"),
    (noisy(recorded(W), turn_scale=-1.0), "odometry turns the other way than the truth"),
    (
        replace(SOUND, steps=SOUND.steps._replace(turn_rad=SHUFFLED)),
        "odometry turns have little to do with the truth",
    ),
    (replace(noisy(recorded(W), scale=1000.0), truth=None), "odometry moves by up to"),
    (with_readings(SOUND, range_m=1.07 * READ.range_m), "ranges read +7."),
    (with_readings(SOUND, range_m=READ.range_m + 0.25), "ranges read +0.2"),
    (with_readings(SOUND, range_m=100.0 * READ.range_m), "are they in centimetres?"),
    (with_readings(SOUND, range_m=READ.range_m / 0.3048), "are they in feet?"),
    (with_readings(SOUND, range_m=ONE_NEGATIVE), "1 range below zero"),
    (with_readings(SOUND, bearing_rad=np.degrees(READ.bearing_rad)), "bearings reach"),
    (with_readings(SOUND, bearing_rad=READ.bearing_rad + 0.3), "bearings read +0.299 rad off"),
    (
        with_readings(SOUND, rssi_dbm=np.full(READ.range_m.size, 56.0)),
        "signal strengths above 0 dBm: is the sign missing?",
    ),
    (with_readings(SOUND, beacon=np.array([1, 0, 2, 3])[READ.beacon]), "beacons 6 and 7 look exchanged"),
    (replace(SOUND, beacon_truth_m=SURVEYS["moved"]), "ranges of beacon 8 miss its surveyed place by"),
    (replace(SOUND, beacon_truth_m=SURVEYS["taken"]), "surveyed beacons that were never heard: 77"),
    (replace(SOUND, beacon_truth_m=SURVEYS["few"]), "beacons without a surveyed place: 8, 9"),
    (
        replace(SOUND, readings=READ.where((READ.times_s < 30.0) | (READ.times_s > 50.0))),
        "readings: 1 gap, the longest of 20.",
    ),
    (
        replace(SOUND, truth=ReferencePath(*(column[KEPT] for column in COURSE))),
        "truth: 1 gap, the longest of 5.",
    ),
    (with_truth(SOUND, heading_rad=np.degrees(COURSE.heading_rad)), "is its heading in degrees?"),
]


@pytest.mark.parametrize(("run", "what"), WRONG, ids=[what for _, what in WRONG])
def test_what_looks_wrong_is_reported(run: RecordedRun, what: str) -> None:
    assert what in told(run)


def test_beacons_that_are_exchanged_halfway() -> None:
    swap = np.where(SOUND.readings.times_s > 60.0, np.array([1, 0, 2, 3])[SOUND.readings.beacon], SOUND.readings.beacon)
    found = told(with_readings(SOUND, beacon=swap))
    assert "from 60 to 120 s alone: beacons 6 and 7 look exchanged" in found
    assert "off (fit to the truth)" not in found


def test_neighbours_that_are_exchanged_show_by_their_bearings() -> None:
    x, y = BEACONS["8"]
    near = replace(SOUND, beacon_truth_m={**BEACONS, "8": (x + 0.3, y)})
    assert "exchanged" not in told(near)
    survey = {**BEACONS, "9": (x + 0.3, y)}
    rows = SOUND.readings.beacon == 3
    pose = [np.interp(SOUND.readings.times_s, W.times_s, column) for column in W.poses.T]
    dx, dy = x + 0.3 - pose[0], y - pose[1]
    ranges = np.where(rows, np.hypot(dx, dy), SOUND.readings.range_m)
    bearings = np.where(rows, np.arctan2(dy, dx) - pose[2], SOUND.readings.bearing_rad)
    run = replace(with_readings(SOUND, range_m=ranges, bearing_rad=bearings), beacon_truth_m=survey)
    assert "exchanged" not in told(run)
    swapped = replace(run, beacon_truth_m={**survey, "8": survey["9"], "9": survey["8"]})
    assert "beacons 8 and 9 look exchanged" in told(swapped)


def test_exchanged_beacons_with_a_neighbour_are_not_taken_for_it() -> None:
    survey = {**BEACONS, "7": (BEACONS["6"][0] + 0.5, BEACONS["6"][1])}  # what the ranges of 8 fit nearly as well
    swapped = {**survey, "6": survey["8"], "8": survey["6"]}
    assert "beacons 6 and 8 look exchanged" in told(replace(SOUND, beacon_truth_m=swapped))


def test_bearings_with_the_other_sign() -> None:
    found = told(with_readings(SOUND, bearing_rad=-SOUND.readings.bearing_rad))
    assert "bearings fit the truth with the other sign: are they clockwise?" in found
    assert "miss its surveyed place" not in found


def test_what_never_moves() -> None:
    zeros = np.zeros(SOUND.steps.distance_m.size)
    still = replace(SOUND, steps=SOUND.steps._replace(distance_m=zeros, turn_rad=zeros))
    assert "odometry never moves (0 m) while the truth gets" in told(still)
    assert SOUND.truth is not None
    there = np.zeros(SOUND.truth.x_m.size)
    found = told(with_truth(SOUND, x_m=there, y_m=there, heading_rad=there))
    assert "the truth never moves (0 m) while the odometry travels" in found
    assert "off (fit to the truth)" not in found


def test_ranges_that_fit_another_beacon() -> None:
    rows = np.where(SOUND.readings.beacon == 0, 1, SOUND.readings.beacon)
    ranges = SOUND.readings.range_m.copy()
    seen_of_1 = np.interp(SOUND.readings.times_s, SOUND.readings.times_s[rows == 1], ranges[rows == 1])
    true = np.hypot(
        *(
            np.array(BEACONS["7"])[:, None]
            - np.array([np.interp(SOUND.readings.times_s, W.times_s, W.poses[:, k]) for k in range(2)])
        )
    )
    ranges = np.where(SOUND.readings.beacon == 0, true, ranges)
    assert seen_of_1.size
    assert "ranges of beacon 6 fit the place of 7, not its own" in told(with_readings(SOUND, range_m=ranges))


@pytest.mark.parametrize(("turned", "what"), [(np.pi, "pi"), (-1.2, "-1.200 rad")])
def test_a_truth_heading_that_is_turned_is_turned_back(tmp_path: Path, turned: float, what: str) -> None:
    tables = plaza_tables(W)
    tables["GT"][:, 3] -= turned
    np.savetxt(tmp_path / "x", tables["GT"])
    write_plaza(tmp_path, W, mat=False)
    np.savetxt(tmp_path / "Field1_GT.txt", tables["GT"])
    run = read_run(tmp_path / "Field1_DR.txt", None, None)
    assert any(warning.startswith(f"truth heading is turned by {what}") for warning in run.warnings)
    off = (run.first_pose[2] - W.poses[0, 2] + np.pi) % (2.0 * np.pi) - np.pi
    assert off == pytest.approx(0.0, abs=0.05)  # the mean of the course knows no better


def test_a_truth_that_begins_after_the_odometry(tmp_path: Path) -> None:
    write_plaza(tmp_path, W, mat=False)
    np.savetxt(tmp_path / "Field1_GT.txt", plaza_tables(W)["GT"][100:])
    run = read_run(tmp_path / "Field1_DR.txt", None, None)
    assert any("does not cover the first odometry" in warning for warning in run.warnings)


def test_labyrinth_wheel_columns_by_the_true_path(tmp_path: Path) -> None:
    run = read_run(write_lines(tmp_path / "a.txt", labyrinth_lines(W)), None, None)
    assert any("left, right, track 0.300 m (the readme says" in warning for warning in run.warnings)
    run = read_run(write_lines(tmp_path / "b.txt", labyrinth_lines(W, exchanged=True)), None, None)
    assert any("right, left, track 0.300 m; they were read as left, right" in warning for warning in run.warnings)
    assert any("turns the other way" in warning for warning in run.warnings)


W_ERRORS = world(seconds=20.0)
Make = Callable[[Path], Path]


def _mat(**changes: object) -> Make:
    def make(folder: Path) -> Path:
        tables: dict[str, object] = {**plaza_tables(W_ERRORS), **changes}
        scipy.io.savemat(folder / "Field1.mat", {k: v for k, v in tables.items() if v is not None})
        return folder / "Field1.mat"

    return make


def _plaza_without(kind: str) -> Make:
    def make(folder: Path) -> Path:
        file = write_plaza(folder, W_ERRORS, mat=False)
        (folder / f"Field1_{kind}.txt").unlink()
        return file if kind == "TD" else folder / "Field1_TD.txt"

    return make


def _plaza_file(kind: str, text: str) -> Make:
    def make(folder: Path) -> Path:
        file = write_plaza(folder, W_ERRORS, mat=False)
        (folder / f"Field1_{kind}.txt").write_text(text, encoding="utf-8")
        return file

    return make


def _two_sets(folder: Path) -> Path:
    write_plaza(folder, W_ERRORS, "Field1")
    write_plaza(folder, W_ERRORS, "Field2")
    return folder


def _mrclam_file(name: str, text: str | None) -> Make:
    def make(folder: Path) -> Path:
        write_mrclam(folder, W_ERRORS)
        if text is None:
            (folder / name).unlink()
        else:
            (folder / name).write_text(text, encoding="utf-8")
        return folder

    return make


def _text(*lines: str) -> Make:
    return lambda folder: write_lines(folder / "data.txt", list(lines))


def _bytes(name: str, data: bytes) -> Make:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    return make


def _two_labyrinths(folder: Path) -> Path:
    for name in ("a.txt", "b.txt"):
        write_lines(folder / name, labyrinth_lines(W_ERRORS))
    return folder


def _folder(folder: Path) -> Path:
    return folder


def _nothing(folder: Path) -> Path:
    return folder / "missing"


def _with(line: str) -> Make:
    return lambda folder: write_lines(folder / "mine.csv", [*csv_lines(W_ERRORS), line])


LAST = len(csv_lines(W_ERRORS)) + 1
CUT = gzip.compress("\n".join(labyrinth_lines(W_ERRORS)).encode())[:2000]
FAULTS: list[tuple[Make, str | None, str]] = [
    (_nothing, None, r"missing: no such file or folder$"),
    (_folder, None, r"none of the formats plaza, mrclam, labyrinth, csv"),
    (_text("hello, world", "1 2 3"), None, r"data\.txt: none of the formats"),
    (_bytes("data.bin", b"\xff\xfe\x00\x81"), None, r"data\.bin: is not text"),
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
    (_mat(DR=np.ones((2, 3))), None, r"odometry rows: too few for a run"),
    (_mat(TD=np.array([[1e6, 2.0, 6.0, 3.0]])), None, r"no range within the time of the odometry"),
    (_plaza_without("DR"), None, r"Field1_DR\.txt: no such file; it goes with Field1_TD\.txt"),
    (_plaza_without("TD"), None, r"Field1_TD\.txt: no such file; it goes with"),
    (_text("1 2 3"), "plaza", r"data\.txt: is no file of a Plaza set"),
    (_plaza_file("TD", "1.0 2 6\n"), None, r"Field1_TD\.txt:1: 3 columns, wanted 4: time"),
    (_plaza_file("TD", "# only a comment\n"), None, r"Field1_TD\.txt: no rows; wanted lines of time"),
    (_plaza_file("TD", "1.0 2 6 3.0\n1.1 2 6 far\n"), None, r"Field1_TD\.txt:2: range \[m\] is 'far', not a number"),
    (_mrclam_file("Robot1_Measurement.dat", None), None, r"Robot1_Measurement\.dat: no such file \(nor gzipped\)"),
    (_mrclam_file("Barcodes.dat", None), None, r"Barcodes\.dat: no such file \(nor gzipped\): readings name barcodes"),
    (_mrclam_file("Robot1_Odometry.dat", "1 0 0\n2 0 0\n"), None, r"Robot1_Odometry\.dat: 2 rows: too few for a run"),
    (_mrclam_file("Robot1_Measurement.dat", "5.0 20 1 0\n"), None, r"no reading of a landmark within the time"),
    (_text("range2 0.1 2 0.1 0 0 105", "gps 1 2"), None, r"data\.txt:2: 'gps' is none of range2, odom2diff, gt2"),
    (_text("range2 0.1 2 0.1 0 0"), None, r"data\.txt:1: 5 values after range2, wanted 6: time"),
    (_text("range2 0.1 2 0.1 0 0 105"), None, r"data\.txt: no line odom2diff \(time"),
    (_text(*[f"odom2diff {k} 0 0 0 0.1 0 0 0" for k in range(3)]), None, r"data\.txt: no line range2"),
    (
        _text("range2 9 2 0.1 0 0 105", *[f"odom2diff {k} 0 0 0 0.1 0 0 0" for k in range(3)]), None,
        r"no range within the time of the odometry",
    ),
    (
        _text("range2 0 2 0.1 0 0 105", *[f"odom2diff {k} 0 0 0 0.1 0 0 0" for k in range(2)]), None,
        r"2 lines odom2diff: too few for a run",
    ),
    (
        _text("range2 0 2 0.1 0 0 105", *[f"odom2diff {k} 0 0 0 {k - 1} 0 0 0" for k in range(3)]), None,
        r"data\.txt:2: the distance between the wheels is not positive",
    ),
    (_text("", "# a comment"), None, r"data\.txt: is empty: no line but comments"),
    (_with("lidar,1,2"), None, rf"mine\.csv:{LAST}: no event 'lidar'; there are odom, range"),
    (_with("range,1,6"), None, rf"mine\.csv:{LAST}: 2 values after range, wanted time_s, beacon, range_m"),
    (_with("range,soon,6,2"), None, rf"mine\.csv:{LAST}: time_s is 'soon', not a number"),
    (_with("odom,3.0,7,7"), None, r"mine\.csv:\d+: two events odom at the same time say different things"),
    (_text("range,1,6,2.0"), None, r"data\.txt: no event odom \(time_s, distance_m, turn_rad"),
    (_text("odom,0,0,0", "odom,1,0,0"), None, r"nothing heard of beacons: no event range, bearing, rssi"),
    (_text("odom,0,0,0", "odom,1,0,0", "range,0,a,1"), None, r"2 events odom: too few for a run"),
    (
        _text("odom,0,0,0", "odom,1,0,0", "odom,2,0,0", "range,9,a,1"), None,
        r"nothing was heard of beacons within the time of the odometry",
    ),
    (_with("range,1,,3"), None, rf"mine\.csv:{LAST}: range has no name of a beacon"),
    (_with("beacon,6,9,9"), None, rf"mine\.csv:{LAST}: beacon 6 was surveyed at another place before"),
    (_with("odom,20.5,1e300,0"), None, r"a step forward of 1e\+300 m at 20\.5 s cannot be; at most 1000 is taken"),
    (_with("odom,20.5,0,0,-1e300"), None, r"a step to the left of -1e\+300 m at 20\.5 s cannot be"),
    (_with("odom,20.5,0,1e200"), None, r"a turn of 1e\+200 rad at 20\.5 s cannot be"),
    (_with("odom,1e300,0,0"), None, r"time of odometry of 1e\+300 s after its first row cannot be"),
    (_with("truth,20.5,1e200,0,0"), None, r"truth: x of 1e\+200 m at 20\.5 s cannot be"),
    (
        _text("odom,0,0,0", "odom,1,0,0", "odom,2,0,0", "range,1,a,1e200"), None,
        r"none of its readings can be \(1 range beyond 1e\+06 m",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("make", "data_format", "told"), FAULTS, ids=[told for _, _, told in FAULTS])
def test_a_fault_is_one_line(tmp_path: Path, make: Make, data_format: str | None, told: str) -> None:
    with pytest.raises(RadioDataError, match=told) as caught:
        read_run(make(tmp_path), data_format, None)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == ExitStatus.USAGE


def test_a_robot_that_is_not_there(tmp_path: Path) -> None:
    write_mrclam(tmp_path, W_ERRORS, robot=2)
    with pytest.raises(RadioDataError, match=r"has no odometry of robot 1; there are 2$"):
        read_run(tmp_path, None, 1)


def test_a_robot_of_a_set_with_one_vehicle(tmp_path: Path) -> None:
    with pytest.raises(RadioDataError, match=r"a plaza set has one vehicle: leave out --robot"):
        read_run(write_plaza(tmp_path, W_ERRORS), None, 1)


def test_readings_that_cannot_be_are_left_out(tmp_path: Path) -> None:
    lines = ["range,1.01,6,1e200", "rssi,1.02,6,-1e9", "bearing,1.03,6,inf", "range,1.04,7,2.5", "bearing,1.04,7,1e9"]
    run = read_run(write_lines(tmp_path / "mine.csv", [*csv_lines(W_ERRORS), *lines, "beacon,far,1e200,0"]), None, None)
    assert len(run.readings.times_s) == len(W_ERRORS.read_s) + 1
    assert "far" not in run.beacon_truth_m
    told = " ".join(run.warnings)
    for words in (
        "1 range beyond 1e+06 m, the first 1e+200 m at 1.01 s",
        "1 signal strength beyond",
        "1 bearing beyond",
    ):
        assert words in told
    assert "surveyed place of far: is no place" in told
