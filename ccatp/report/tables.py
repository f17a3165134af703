"""Points with their fixes, panels, and moves of adjusters as files: CSV, and ECSV with units, types and metadata.

A column carries its unit in its name. What is not known is an empty cell, which ECSV takes as masked. ECSV is that of
astropy (APE 6): a header of YAML in comments, then CSV.
"""

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import NamedTuple

from ccatp.config.files import write_file
from ccatp.core import PointId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.mirror_alignment import SurveyResult
from ccatp.mirror.panel_alignment import adjuster_places
from ccatp.report.alignment import panel_data
from ccatp.report.findings import Findings, metadata_of

FILE_MODE = 0o644
_INT, _FLOAT, _TEXT = "int64", "float64", "string"
_UNITS = frozenset(("um", "urad", "mm", "m", "m2", "s"))


class Column(NamedTuple):
    """A column; ``datatype`` as ECSV names it, ``description`` without double meaning."""

    name: str
    datatype: str
    description: str

    @property
    def unit(self) -> str:
        """The last part of the name, where that is a unit; else empty."""
        last = self.name.rpartition("_")[2]
        return last if last in _UNITS else ""


class Table(NamedTuple):
    """Rows by the names of the columns; a value that a row lacks, or that is None, is not known; others are ignored."""

    columns: Sequence[Column]
    rows: Sequence[Mapping[str, object]]


_PLACE = (Column("row", _INT, "row of the panel"), Column("col", _INT, "column of the panel"))
_COVARIANCE = {"cov_xx_m2": 0, "cov_xy_m2": 1, "cov_xz_m2": 2, "cov_yy_m2": 4, "cov_yz_m2": 5, "cov_zz_m2": 8}
_FIXES = (
    *_PLACE,
    Column("point", _INT, "number of the point on its panel"),
    Column("status", _TEXT, "planned, measured or skipped"),
    Column("t_s", _FLOAT, "time of the fix, clock of the robot"),
    *(Column(f"{axis}_m", _FLOAT, f"retroreflector, {axis} in the world frame") for axis in "xyz"),
    *(Column(name, _FLOAT, "covariance of the retroreflector, world frame") for name in _COVARIANCE),
    Column("dop", _FLOAT, "dilution of precision"),
    Column("residual_rms_m", _FLOAT, "rms of the residuals of the lengths"),
    Column("channels", _TEXT, "channels of the laser system that were used"),
    Column("deviation_um", _FLOAT, "surface less the ideal one along its normal, > 0 towards the robot"),
    Column("sigma_deviation_um", _FLOAT, "standard deviation"),
    Column("residual_um", _FLOAT, "deviation less the fitted plane of the panel"),
    Column("is_outlier", _INT, "1: left out of the fit of the panel"),
    Column("first_arrival_mm", _FLOAT, "distance of the retroreflector from the point at the first arrival"),
    Column("measured_at_mm", _FLOAT, "distance of the retroreflector from the point at the fix"),
)
_FIT = {
    "piston_um": "displacement along the normal of the panel, > 0 towards the robot",
    "tip_urad": "slope along y of the panel",
    "tilt_urad": "slope along x of the panel",
}
_MOVES = (
    *_PLACE,
    Column("adjuster", _TEXT, "name of the adjuster"),
    Column("x_m", _FLOAT, "place of the adjuster in the frame of the panel"),
    Column("y_m", _FLOAT, "place of the adjuster in the frame of the panel"),
    Column("move_um", _FLOAT, "move to be made, > 0 towards the robot"),
    Column("sigma_move_um", _FLOAT, "standard deviation"),
)


def write_tables(found: Findings, folder: Path) -> None:
    """Write each table as CSV and as ECSV into a folder that exists; ConfigError: one cannot be written."""
    mirror, result, metadata = found.record.mirror, found.alignment, metadata_of(found)
    tables = {"fixes": _fixes_table(found)}
    if result is not None:
        panels = panel_table(mirror, result)
        others = [{**one.panel._asdict(), "points": one.points} for one in result.undetermined]
        tables |= {"panels": Table(panels.columns, [*panels.rows, *others]), "moves": _moves_table(mirror, result)}
    for name, table in tables.items():
        lines = [f"# {key}: {value}" for key, value in metadata.items()]
        write_file(folder / f"{name}.csv", "\n".join([*lines, *csv_lines(table), ""]), FILE_MODE)
        write_file(folder / f"{name}.ecsv", "\n".join([*_ecsv_head(table, metadata), *csv_lines(table), ""]), FILE_MODE)


def csv_lines(table: Table) -> Iterator[str]:
    """The names of the columns, and a line a row."""
    names = [column.name for column in table.columns]
    text = StringIO()
    writer = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(table.rows)
    yield from text.getvalue().splitlines()


def _ecsv_head(table: Table, metadata: Mapping[str, object]) -> Iterator[str]:
    yield from ("# %ECSV 1.0", "# ---", "# delimiter: ','", "# datatype:")
    for column in table.columns:
        unit = f"unit: {column.unit}, " if column.unit else ""
        yield (
            f"# - {{name: {column.name}, {unit}datatype: {column.datatype}, description: {_yaml(column.description)}}}"
        )
    yield "# meta: !!omap"
    yield from (f"# - {{{key}: {_yaml(value)}}}" for key, value in metadata.items())
    yield "# schema: astropy-2.0"


def _yaml(value: object) -> str:
    """A value of JSON is one of YAML; what does not print, such as a separator of lines, is escaped as YAML does it."""
    text = json.dumps(value, ensure_ascii=False)
    return "".join(char if char.isprintable() else f"\\U{ord(char):08x}" for char in text)


def _fixes_table(found: Findings) -> Table:
    """Every point of the mission, measured or not."""
    record = found.record
    fixes = {one.point: one.fix for one in record.measured}
    arrivals = {one.point: one for one in found.points}
    fitted = () if found.alignment is None else found.alignment.panels
    deviations = {
        PointId(*panel.panel, one["point"]): one
        for panel in fitted
        for one in panel_data(record.mirror, panel)["deviations"]
    }
    rows = []
    for stored in record.points or ():
        point = stored.point
        arrival = arrivals[point]
        row: dict[str, object] = {
            **point._asdict(), "status": stored.status,
            "first_arrival_mm": arrival.first_mm, "measured_at_mm": arrival.left_mm,
        }  # fmt: skip
        if (fix := fixes.get(point)) is not None:
            row |= {"t_s": fix.t_s, "dop": fix.dop, "residual_rms_m": fix.residual_rms_m}
            row |= {f"{axis}_m": value for axis, value in zip("xyz", fix.position_m, strict=True)}
            row |= {name: fix.covariance_m2[at] for name, at in _COVARIANCE.items()}
            row["channels"] = " ".join(map(str, fix.channels))
        if (one := deviations.get(point)) is not None:
            row |= {"deviation_um": one["deviation_um"], "sigma_deviation_um": one["sigma_um"]}
            row |= {"residual_um": one["residual_um"], "is_outlier": int(one["is_outlier"])}
        rows.append(row)
    return Table(_FIXES, rows)


def panel_table(mirror: Mirror, result: SurveyResult) -> Table:
    """How each panel that is determined lies, and how to turn its adjusters."""
    names = result.panels[0].adjusters if result.panels else ()
    columns = [
        *_PLACE,
        Column("points", _INT, "measured points"),
        *(Column(name, _FLOAT, description) for name, description in _FIT.items()),
        *(Column(f"sigma_{name}", _FLOAT, "standard deviation") for name in _FIT),
        Column("chi2", _FLOAT, "chi-square of the fitted plane"),
        Column("dof", _INT, "degrees of freedom of the fitted plane"),
        Column("outliers", _TEXT, "numbers of the points that were left out of the fit"),
        *(Column(f"{name}_um", _FLOAT, f"move of adjuster {name}, > 0 towards the robot") for name in names),
        *(Column(f"sigma_{name}_um", _FLOAT, "standard deviation") for name in names),
        Column("is_bent", _INT, "1: the curvatures of the panel are significant"),
        Column("rms_before_um", _FLOAT, "half-wavefront error before the moves"),
        Column("rms_after_um", _FLOAT, "half-wavefront error predicted after the moves"),
        Column("worst_corner_um", _FLOAT, "displacement of the corner that is furthest off, > 0 towards the robot"),
        Column("sigma_worst_corner_um", _FLOAT, "standard deviation"),
    ]
    rows: list[dict[str, object]] = []
    for panel in result.panels:
        data = panel_data(mirror, panel)
        data["outliers"] = " ".join(map(str, data["outliers"]))
        data["is_bent"] = int(panel.shape is not None and panel.shape.is_significant)
        data |= zip([f"sigma_{name}" for name in _FIT], data["sigma"], strict=True)
        data |= zip([f"{name}_um" for name in names], data["adjusters_um"], strict=True)
        data |= zip([f"sigma_{name}_um" for name in names], data["adjusters_sigma_um"], strict=True)
        rows.append(data)
    return Table(columns, rows)


def _moves_table(mirror: Mirror, result: SurveyResult) -> Table:
    rows = []
    for panel in result.panels:
        data, (_, places) = panel_data(mirror, panel), adjuster_places(mirror, panel.panel)
        moves = zip(panel.adjusters, places.tolist(), data["adjusters_um"], data["adjusters_sigma_um"], strict=True)
        for name, (x_m, y_m), move, sigma in moves:
            row = {**panel.panel._asdict(), "adjuster": name, "x_m": round(x_m, 6), "y_m": round(y_m, 6)}
            rows.append({**row, "move_um": move, "sigma_move_um": sigma})
    return Table(_MOVES, rows)
