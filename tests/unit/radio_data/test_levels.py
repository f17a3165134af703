"""Levels from CSV, workbooks and XBee logs; each refusal names the file and the line."""

import zipfile
from pathlib import Path

import pytest

from ccatp.beacons.datasets.levels import read_levels, read_log, read_places, read_workbook
from ccatp.beacons.datasets.tables import RadioDataError

MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
RELATIONS = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"


def workbook(file: Path, sheet: str, shared: str = "", extra: str = "") -> Path:
    with zipfile.ZipFile(file, "w") as archive:
        sheets = '<sheets><sheet name="Zigbee" r:id="r1"/></sheets>'
        archive.writestr("xl/workbook.xml", f'<workbook xmlns="{MAIN}" xmlns:r="{RELATIONS}">{sheets}</workbook>')
        archive.writestr("xl/_rels/workbook.xml.rels", '<R><r Id="r1" Target="worksheets/sheet1.xml"/></R>')
        archive.writestr(
            "xl/worksheets/sheet1.xml", f'{extra}<worksheet xmlns="{MAIN}"><sheetData>{sheet}</sheetData></worksheet>'
        )
        if shared:
            archive.writestr("xl/sharedStrings.xml", f'<sst xmlns="{MAIN}">{shared}</sst>')
    return file


HEAD = '<row r="1"><c r="A1" t="s"><v>0</v></c><c r="C1" t="s"><v>1</v></c></row>'
BODY = (
    '<row r="2"><c r="A2"><v>0.5</v></c><c r="C2"><v>-40</v></c></row>'
    '<row r="3"><c r="A3"><v>1</v></c><c r="C3"><v>-47</v></c></row>'
)
SHARED = "<si><t>Distance</t></si><si><r><t>RS</t></r><r><t>SI</t></r></si>"


def test_a_workbook_is_read_with_its_gaps(tmp_path: Path) -> None:
    file = workbook(tmp_path / "a.xlsx", HEAD + BODY, SHARED)
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
    with pytest.raises(RadioDataError, match="is missing or damaged"):
        read_workbook(tmp_path / "c.xlsx")
    bomb = workbook(tmp_path / "d.xlsx", HEAD, extra='<!DOCTYPE a [<!ENTITY b "c">]>')
    with pytest.raises(RadioDataError, match="defines entities"):
        read_workbook(bomb)
    with pytest.raises(RadioDataError, match='has no sheet "BLE"; there are Zigbee'):
        read_levels(workbook(tmp_path / "e.xlsx", HEAD + BODY, SHARED), "BLE")


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
