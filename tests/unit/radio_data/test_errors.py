"""Files that cannot be used: one line that names file and line, exit status 2."""

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from ccatp.beacons.datasets.reader import read_run
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.errors import ExitStatus
from tests.unit.radio_data.sets import (
    csv_lines,
    labyrinth_lines,
    plaza_tables,
    world,
    write_lines,
    write_mrclam,
    write_plaza,
)

W = world(seconds=20.0)
Make = Callable[[Path], Path]


def _mat(**changes: object) -> Make:
    def make(folder: Path) -> Path:
        tables: dict[str, object] = {**plaza_tables(W), **changes}
        scipy.io.savemat(folder / "Field1.mat", {k: v for k, v in tables.items() if v is not None})
        return folder / "Field1.mat"

    return make


def _plaza_without(kind: str) -> Make:
    def make(folder: Path) -> Path:
        file = write_plaza(folder, W, mat=False)
        (folder / f"Field1_{kind}.txt").unlink()
        return file if kind == "TD" else folder / "Field1_TD.txt"

    return make


def _plaza_file(kind: str, text: str) -> Make:
    def make(folder: Path) -> Path:
        file = write_plaza(folder, W, mat=False)
        (folder / f"Field1_{kind}.txt").write_text(text, encoding="utf-8")
        return file

    return make


def _two_sets(folder: Path) -> Path:
    write_plaza(folder, W, "Field1")
    write_plaza(folder, W, "Field2")
    return folder


def _mrclam_file(name: str, text: str | None) -> Make:
    def make(folder: Path) -> Path:
        write_mrclam(folder, W)
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
        write_lines(folder / name, labyrinth_lines(W))
    return folder


def _folder(folder: Path) -> Path:
    return folder


def _nothing(folder: Path) -> Path:
    return folder / "missing"


def _with(line: str) -> Make:
    return lambda folder: write_lines(folder / "mine.csv", [*csv_lines(W), line])


LAST = len(csv_lines(W)) + 1
CUT = gzip.compress("\n".join(labyrinth_lines(W)).encode())[:2000]
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
    write_mrclam(tmp_path, W, robot=2)
    with pytest.raises(RadioDataError, match=r"has no odometry of robot 1; there are 2$"):
        read_run(tmp_path, None, 1)


def test_a_robot_of_a_set_with_one_vehicle(tmp_path: Path) -> None:
    with pytest.raises(RadioDataError, match=r"a plaza set has one vehicle: leave out --robot"):
        read_run(write_plaza(tmp_path, W), None, 1)


def test_readings_that_cannot_be_are_left_out(tmp_path: Path) -> None:
    lines = ["range,1.01,6,1e200", "rssi,1.02,6,-1e9", "bearing,1.03,6,inf", "range,1.04,7,2.5", "bearing,1.04,7,1e9"]
    run = read_run(write_lines(tmp_path / "mine.csv", [*csv_lines(W), *lines, "beacon,far,1e200,0"]), None, None)
    assert len(run.readings.times_s) == len(W.read_s) + 1
    assert "far" not in run.beacon_truth_m
    told = " ".join(run.warnings)
    for words in (
        "1 range beyond 1e+06 m, the first 1e+200 m at 1.01 s",
        "1 signal strength beyond",
        "1 bearing beyond",
    ):
        assert words in told
    assert "surveyed place of far: is no place" in told
