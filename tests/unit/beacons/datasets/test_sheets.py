"""Sheets of levels, ranges and places; workbooks, logs; maps of beacons as files."""

import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from openpyxl import Workbook

from ccatp.beacons.datasets.sheets import (
    read_level_places,
    read_levels,
    read_log,
    read_places,
    read_ranges,
    read_workbook,
    write_beacons,
)
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.estimation.level_fix import MeasuredPlace


def text(folder: Path, content: str, name: str = "a.csv") -> Path:
    (folder / name).write_text(content, encoding="utf-8")
    return folder / name


def workbook(file: Path, far: tuple[int, int] = (3, 3)) -> Path:
    """``far``: row and column of a cell that is written as well."""
    book = Workbook()
    sheet = book.active
    assert sheet is not None
    sheet.title = "Zigbee"
    for row in (["Distance", None, "RSSI"], [0.5, None, -40], [1, None, -47]):
        sheet.append(row)
    sheet.cell(*far, -47)
    book.save(file)
    return file


def with_part(file: Path, name: str, content: str, mode: str = "a") -> Path:
    with zipfile.ZipFile(file, mode) as archive:  # type: ignore[call-overload]
        archive.writestr(name, content)
    return file


def test_a_workbook_is_read_with_its_gaps(tmp_path: Path) -> None:
    file = workbook(tmp_path / "a.xlsx")
    assert read_workbook(file) == {"Zigbee": [["Distance", "", "RSSI"], ["0.5", "", "-40"], ["1", "", "-47"]]}
    name, pairs, _ = read_levels(file)
    assert [pair[:2] for pair in pairs] == [(0.5, -40.0), (1.0, -47.0)]
    assert name == "a.xlsx, sheet Zigbee"


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
    "content", ["distance_m,rssi_dbm\n1,-40\n2,-46\n", "# note\nd level\n1 -40\n2 -46\n", "range;dBm\n1;40\n2;46\n"]
)
def test_levels_in_the_usual_shapes(tmp_path: Path, content: str) -> None:
    _, pairs, warnings = read_levels(text(tmp_path, content))
    assert [pair[:2] for pair in pairs] == [(1.0, -40.0), (2.0, -46.0)]
    assert bool(warnings) == ("-" not in content)


def test_places_with_levels_by_node(tmp_path: Path) -> None:
    _, places, _ = read_level_places(text(tmp_path, "Point,x,y,RSSI A,RSSI B\n1,0.5,1,56,60\n2,1,0,57,61\n"))
    assert places[1].place_m == (1.0, 0.0)
    assert places[0].levels_dbm == {"A": -56.0, "B": -60.0}


def test_a_node_that_was_not_heard_is_an_empty_cell_or_a_placeholder(tmp_path: Path) -> None:
    rows = [f"{k},0,{-40 - k},{-70 + k}" for k in range(12)]
    rows += ["12,0,100,-60", "13,0,,-61", "14,0,100,", "15,0,100,-62"]
    _, places, warnings = read_level_places(text(tmp_path, "x,y,RSSI A,RSSI B\n" + "\n".join(rows) + "\n"))
    assert places[-2].levels_dbm == {"B": -61.0}
    assert places[-1] == MeasuredPlace((15.0, 0.0), {"B": -62.0})
    assert len(places) == 15
    assert warnings[0] == "3 levels of 100 dBm stand for nodes not received, not used"
    assert warnings[1] == "1 place where no node was received, not used"


def test_a_folder_of_logs_with_their_distances(tmp_path: Path) -> None:
    text(tmp_path, "Node A: -29\nNode A: -30\n\n", "1.txt")
    text(tmp_path, "Node A: -35\n", "2.txt")
    points = text(tmp_path, "distance_m,point\n0.1,1\n0.2,2\n0.3,3\n")
    _, pairs, warnings = read_levels(tmp_path, None, points)
    assert [pair[:2] for pair in pairs] == [(0.1, -29.0), (0.1, -30.0), (0.2, -35.0)]
    assert warnings == ["1 logs are missing, the first 3.txt"]
    with pytest.raises(RadioDataError, match="name the table of their distances with --points"):
        read_levels(tmp_path)
    (tmp_path / "none").mkdir()
    with pytest.raises(RadioDataError, match="holds none of the logs"):
        read_levels(tmp_path / "none", None, points)


def test_ranges_of_both_forms_and_places(tmp_path: Path) -> None:
    found = read_ranges(text(tmp_path, "\ufeff# two\n\nfirst, second ,range_m,sigma_m\n A ,B,1.5,\nB,C,2.0,0.3\n"), 0.1)
    assert [tuple(row) for row in found.readings] == [("A", "B", 1.5, 0.1), ("B", "C", 2.0, 0.3)]
    rows = "8_14,1,60,2,0,10,4.8,4.8,0.02\n8_14,1,60,2,1,10,4.5,4.5,0.02\n"
    found = read_ranges(text(tmp_path, f"session,pos,deg,anchor,tag,n,mean_m,median_m,std_m\n{rows}"), 0.1)
    assert found.groups == {"1/60": ("1/60/tag0", "1/60/tag1")}
    assert found.tags == {"1/60/tag0": "tag0", "1/60/tag1": "tag1"}
    assert found.readings[0].first == "anchor2"
    assert read_places(text(tmp_path, "name,x_m,y_m,z_m\na,1,2,3\n")) == {"a": (1.0, 2.0, 3.0)}


def _ranges(path: Path) -> object:
    return read_ranges(path, 0.1)


TWO, SIGMA, SESSION = "first,second,range_m\n", "first,second,range_m,sigma_m\n", "session,pos,deg,anchor,tag,mean_m\n"
NO_ROWS = "holds no rows below a head; the first row names the columns"
REFUSALS: list[tuple[Callable[[Path], object], str, str]] = [
    (read_levels, "a,b\n1,2\n", "a.csv:1: has no column of distances, as distance_m; its columns are a, b"),
    (read_levels, "distance_m,b\n1,2\n", "has no column of levels"),
    (read_levels, "distance_m,rssi\n", NO_ROWS),
    (read_levels, "distance_m,rssi\n# far\n1,loud\n", r":3: column 2 is 'loud', not a number"),
    (read_levels, "distance_m,rssi\n1,-1e300\n", r":2: -1e\+300 in column 2 is no level and no place"),
    (read_level_places, "x,y,level\n1,2,-40\n", "has no column of levels by node"),
    (read_log, "Node A: -29\nNode A -30\n", r"a\.csv:2: .*is no line like"),
    (_ranges, f"{TWO}A,B,-1.0\n", ":2: range of -1 m is no distance"),
    (_ranges, f"{TWO}A,B,nan\n", ":2: range of nan m is no distance"),
    (_ranges, f"{TWO}A,B,0\n", ":2: range of 0 m is no distance"),
    (_ranges, f"{TWO}A,B,1e-300\n", ":2: range of 1e-300 m is no distance"),
    (_ranges, f"{TWO}A,B,inf\n", r":2: range of inf m is more than the 1e\+06 m"),
    (_ranges, f"{TWO}# hello\nA,B,1.0,more\nB,C\n", ":4: range_m is '', not a number"),
    (_ranges, f"{TWO}A,B,far\n", ":2: range_m is 'far', not a number"),
    (_ranges, f"{TWO}A,A,1.0\n", ":2: from A to itself"),
    (_ranges, f"{TWO}A,,1.0\n", ":2: second is empty"),
    (_ranges, f"{SIGMA}A,B,1.0,0\n", r":2: sigma of 0 m, must be 1e-06 to 1e\+06 m"),
    (_ranges, "\n \n# nothing\n", NO_ROWS),
    (_ranges, SESSION, NO_ROWS),
    (_ranges, "a,b,c\n1,2,3\n", ":1: columns a,b,c; wanted first,second,range_m"),
    (_ranges, f"{TWO}{'x' * 200_000},B,1\n", ":2: has 200004 characters, at most 20000 are taken"),
    (read_places, "name,x_m,y_m\n", NO_ROWS),
    (read_places, "name,x\nM0,0\n", r"a\.csv:1: columns name,x; wanted name,x_m,y_m"),
    (read_places, "name,x_m,y_m\nM0,0,0\nM1,nan,0\n", r"a\.csv:3: x_m = nan is no place within 1e\+06 m"),
    (read_workbook, "distance,rssi\n", r"is no \.xlsx workbook"),
]  # fmt: skip


@pytest.mark.parametrize(("read", "content", "reported"), REFUSALS, ids=[reported for _, _, reported in REFUSALS])
def test_what_cannot_be_used_is_refused(
    read: Callable[[Path], object], content: str, reported: str, tmp_path: Path
) -> None:
    with pytest.raises(RadioDataError, match=reported):
        read(text(tmp_path, content))


def test_what_is_no_workbook_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RadioDataError, match="no such file"):
        read_workbook(tmp_path / "b.xlsx")
    with pytest.raises(RadioDataError, match=r"is no \.xlsx workbook"):
        read_workbook(with_part(tmp_path / "c.xlsx", "other", "", "w"))
    entities = '<!DOCTYPE a [<!ENTITY b "c">]><a/>'
    with pytest.raises(RadioDataError, match="defines entities"):
        read_workbook(with_part(workbook(tmp_path / "d.xlsx"), "xl/theme/more.xml", entities))
    with pytest.raises(RadioDataError, match='has no sheet "BLE"; there are Zigbee'):
        read_levels(workbook(tmp_path / "e.xlsx"), "BLE")
    bomb = with_part(tmp_path / "f.xlsx", "large.xml", " " * 5_000_001, "w")
    with pytest.raises(RadioDataError, match="longer than 5000000 bytes"):
        read_workbook(bomb)
    with pytest.raises(RadioDataError, match="more than 500000 cells"):
        read_workbook(workbook(tmp_path / "g.xlsx", far=(1_048_576, 16_384)))


def test_beacon_files(tmp_path: Path) -> None:
    path, rng = tmp_path / "b.toml", np.random.default_rng(1)
    places, root = rng.normal(size=(3, 3)), rng.normal(size=(9, 9))
    given = (("N1-1", "b", "c"), places, root @ root.T, "here")
    write_beacons(path, *given)
    found = tomllib.loads(path.read_text(encoding="utf-8"))
    assert (tuple(found["beacons"]), found["frame"]) == (given[0], "here")
    assert [beacon["position_m"] for beacon in found["beacons"].values()] == places.tolist()
    assert found["joint"]["covariance_m2"] == (root @ root.T).tolist()
    with pytest.raises(RadioDataError, match="cannot be written"):
        write_beacons(tmp_path / "no" / "b.toml", *given)
