"""Tables of a survey: astropy reads units, types, metadata and values as the database has them; CSV says the same."""

import csv
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import Table

from ccatp.cli import main
from ccatp.errors import ConfigError
from ccatp.report.run_page import report_run
from tests.support.command import answered, refused
from tests.unit.reporting.recorded import record

# What a header of YAML in comments could take for something else.
OPERATOR = 'J. D\u00f6\u00e9: "night" # {1}, \u2028 \\ \U0001f52d \''
FIX = (
    "x_m", "y_m", "z_m", "cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2", "t_s", "dop",
    "residual_rms_m",
)  # fmt: skip
UNITS = {"t_s": "s", "x_m": "m", "cov_xx_m2": "m2", "deviation_um": "um", "first_arrival_mm": "mm", "dop": None}


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four points of one panel, aborted, with metadata; its tables in ``tables``."""
    run_dir = record(
        tmp_path_factory.mktemp("tables") / "tonight",
        only=4,
        observation__telescope="FYST",
        observation__operator=OPERATOR,
        observation__robot_serial_number="7",
        observation__laser_serial_number="null",
        observation__retroreflector_serial_number="0012",
    )
    report_run(run_dir, tables_dir=run_dir / "tables")
    return run_dir


def read(run_dir: Path, name: str) -> Any:
    return Table.read(run_dir / "tables" / f"{name}.ecsv", format="ascii.ecsv")


def test_fixes_are_those_of_the_database(survey: Path) -> None:
    table = read(survey, "fixes")
    for name, unit in UNITS.items():
        assert table[name].unit == unit
    assert (table["row"].dtype, table["x_m"].dtype, table["status"].dtype.kind) == (np.int64, np.float64, "U")
    with closing(sqlite3.connect(survey / "mission.sqlite")) as db:
        points = db.execute("SELECT row, col, point, status FROM points ORDER BY row, col, point").fetchall()
        fixes = db.execute(f"SELECT row, col, point, {', '.join(FIX)} FROM fixes").fetchall()
    assert [tuple(row) for row in table["row", "col", "point", "status"]] == points
    stored = {row[:3]: row[3:] for row in fixes}
    assert 4 <= len(stored) < 9
    for row in table:
        values = stored.get((row["row"], row["col"], row["point"]))
        if values is None:
            assert all(np.ma.is_masked(row[name]) for name in (*FIX, "channels", "deviation_um", "first_arrival_mm"))
        else:
            assert tuple(row[FIX]) == values  # to the last bit
            assert row["channels"].split()


def test_panels_and_moves_are_those_of_the_alignment(survey: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (panel,) = answered(capsys, "align", survey)["panels"]
    (row,) = read(survey, "panels")
    found = read(survey, "panels")
    assert [str(found[name].unit) for name in ("piston_um", "tip_urad", "sigma_tilt_urad")] == ["um", "urad", "urad"]
    assert [row["piston_um"], row["tip_urad"], row["tilt_urad"]] == [
        panel["piston_um"], panel["tip_urad"], panel["tilt_urad"],
    ]  # fmt: skip
    assert [row[f"sigma_{name}"] for name in ("piston_um", "tip_urad", "tilt_urad")] == panel["sigma"]
    assert np.ma.is_masked(row["outliers"])
    moves = read(survey, "moves")
    assert moves["move_um"].unit == "um"
    assert list(moves["move_um"]) == panel["adjusters_um"]
    assert list(moves["sigma_move_um"]) == panel["adjusters_sigma_um"]
    assert list(moves["adjuster"]) == ["V1", "V2", "V3", "V4", "V5"]
    # A move takes the fitted plane away where the adjuster is.
    plane = panel["piston_um"] + panel["tip_urad"] * moves["y_m"] + panel["tilt_urad"] * moves["x_m"]
    assert np.allclose(moves["move_um"], -plane, rtol=0.0, atol=1e-3)  # 1 nm: places are rounded to 1 um


def test_the_worst_corner_is_that_of_the_plane(survey: Path) -> None:
    (row,) = read(survey, "panels")
    # A panel of fyst-m1 is 0.67 m by 0.75 m, a little more along its slopes.
    reach = abs(row["tilt_urad"]) * 0.67 / 2.0 + abs(row["tip_urad"]) * 0.75 / 2.0
    assert abs(row["worst_corner_um"]) == pytest.approx(abs(row["piston_um"]) + reach, rel=0.03)
    assert row["sigma_worst_corner_um"] > row["sigma_piston_um"]


@pytest.mark.parametrize("name", ["fixes", "panels", "moves"])
def test_every_table_says_what_it_is_of(survey: Path, name: str) -> None:
    told = read(survey, name).meta
    assert told["operator"] == OPERATOR
    assert (told["telescope"], told["mirror"], told["run"]) == ("FYST", "fyst-m1", "tonight")
    assert told["robot_serial_number"] == "7"
    assert told["laser_serial_number"] == "null"  # not a null of YAML
    assert told["retroreflector_serial_number"] == "0012"  # nor a number
    assert told["date_obs"] == told["date_end"] == "2026-01-01T12:00:00.5Z"
    assert "comment" not in told
    assert told["points_of_the_mirror"] == 9 * told["panels_of_the_mirror"]
    lines = (survey / "tables" / f"{name}.csv").read_text(encoding="utf-8").split("\n")
    head = [line for line in lines if line.startswith("#")]
    assert '# telescope: "FYST"' in head
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    table = read(survey, name)
    assert len(rows) == len(table)
    assert list(rows[0]) == table.colnames


def test_panels_without_a_result_have_masked_values(tmp_path: Path) -> None:
    run_dir = record(tmp_path / "short", only=1)
    report_run(run_dir, tables_dir=run_dir / "tables")
    (row,) = read(run_dir, "panels")
    assert row["points"] < 3
    assert np.ma.is_masked(row["piston_um"])
    assert len(read(run_dir, "moves")) == 0
    (run_dir / "mission.sqlite").unlink()
    report_run(run_dir, tables_dir=tmp_path / "none")
    assert len(Table.read(tmp_path / "none" / "fixes.ecsv", format="ascii.ecsv")) == 0
    assert sorted(path.name for path in (tmp_path / "none").iterdir()) == ["fixes.csv", "fixes.ecsv"]


def test_the_command_writes_tables(survey: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = answered(capsys, "report", survey, "--out", tmp_path / "a.html", "--tables", tmp_path / "tables")
    assert told["observation"]["operator"] == OPERATOR
    assert told["coverage"]["panels_determined"] == 1
    assert len(list((tmp_path / "tables").iterdir())) == 6
    page = (tmp_path / "a.html").read_text()
    for text in ("FYST", "J. D\u00f6\u00e9: &#34;night&#34;", "robot serial number", "0012"):
        assert text in page
    (tmp_path / "file").write_text("")
    assert "cannot be written" in refused(capsys, "report", survey, "--tables", tmp_path / "file" / "tables")
    assert main(["config", "schema"]) == 0
    assert "FITS: TELESCOP" in capsys.readouterr().out


def test_a_table_that_cannot_be_written_is_named(survey: Path, tmp_path: Path) -> None:
    (tmp_path / "tables" / "fixes.csv").mkdir(parents=True)
    with pytest.raises(ConfigError, match=r"fixes\.csv: cannot be written: Is a directory"):
        report_run(survey, tmp_path / "a.html", tables_dir=tmp_path / "tables")
