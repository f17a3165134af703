"""Points with their fixes, panels, and moves of adjusters as files: CSV, and ECSV with units, types and metadata.

The name of a column contains its unit. An unknown value is an empty cell, which ECSV reads as masked. ECSV is the
format of astropy (APE 6): a YAML header in comments, then CSV.
"""

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import NamedTuple

from ccatp.config.files import write_file
from ccatp.core import PointId
from ccatp.mirror.adjuster_work import Step
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panel_alignment import PanelResult
from ccatp.mirror.panel_modes import adjuster_places
from ccatp.report.alignment import panel_data, worst_corner
from ccatp.report.findings import Findings, fix_times_s, metadata_of

FILE_MODE = 0o644
_UNITS = frozenset(("um", "urad", "mm", "m", "m2", "s"))
_TYPES = {
    **dict.fromkeys(("row", "col", "point", "points", "dof", "is_outlier", "is_bent"), "int64"),
    **dict.fromkeys(("status", "channels", "metrology", "left_out", "outliers", "adjuster"), "string"),
}  # of ECSV; all other columns are float64

_PLACE = {"row": "row of the panel", "col": "column of the panel"}
_COVARIANCE = {"cov_xx_m2": 0, "cov_xy_m2": 1, "cov_xz_m2": 2, "cov_yy_m2": 4, "cov_yz_m2": 5, "cov_zz_m2": 8}
_SIGMA = "standard deviation"
_FIXES = {
    **_PLACE,
    "point": "number of the point on its panel",
    "status": "planned, measured or skipped",
    "t_s": "mission time of the run at the fix; unknown if its recording is not there",
    **{f"{axis}_m": f"retroreflector, {axis} in the world frame" for axis in "xyz"},
    **dict.fromkeys(_COVARIANCE, "covariance of the retroreflector, world frame"),
    "dop": "dilution of precision",
    "residual_rms_m": "rms of the residuals of the lengths",
    "channels": "channels of the laser system that were used",
    "metrology": "whether the lengths agree: good, unreliable, or unchecked; empty in runs of older versions",
    "left_out": "channels that contradict the others and were left out",
    "detectable_m": "smallest error of one length that the test of the lengths finds",
    "protection_m": "largest error of the position by an error of one length that the test does not find",
    "deviation_um": "surface less the ideal one along its normal by the adjusted laser network, > 0 towards the robot",
    "sigma_deviation_um": _SIGMA,
    "residual_um": "deviation less the fitted plane of the panel",
    "is_outlier": "1: not used for the fit of the panel",
    "first_arrival_mm": "distance of the retroreflector from the point at the first arrival",
    "measured_at_mm": "distance of the retroreflector from the point at the fix",
}
_FIT = {
    "piston_um": "displacement along the normal of the panel, > 0 towards the robot",
    "tip_urad": "slope along y of the panel",
    "tilt_urad": "slope along x of the panel",
}
_MOVES = {
    **_PLACE,
    "adjuster": "name of the adjuster",
    "x_m": "place of the adjuster in the frame of the panel",
    "y_m": "place of the adjuster in the frame of the panel",
    "move_um": "move to be made, > 0 towards the robot",
    "sigma_move_um": _SIGMA,
}


class ColumnTable(NamedTuple):
    """Columns with their descriptions, and rows by the names of the columns.

    A value that is missing in a row or None is not known; values without a column are left out.
    """

    columns: Mapping[str, str]
    rows: Sequence[Mapping[str, object]]


def write_tables(found: Findings, folder: Path) -> None:
    """Write each table as CSV and as ECSV into a folder that exists; ConfigError: one cannot be written."""
    metadata = metadata_of(found)
    tables = {"fixes": fixes_table(found)}
    if found.alignment is not None:
        tables |= {"panels": all_panels_table(found), "moves": moves_table(found)}
    for name, table in tables.items():
        lines = [f"# {key}: {_yaml(value)}" for key, value in metadata.items()]
        write_file(folder / f"{name}.csv", "\n".join([*lines, *csv_lines(table), ""]), FILE_MODE)
        write_file(folder / f"{name}.ecsv", "\n".join([*_ecsv_head(table, metadata), *csv_lines(table), ""]), FILE_MODE)


def csv_lines(table: ColumnTable) -> Iterator[str]:
    """The names of the columns, then one line for each row."""
    text = StringIO()
    writer = csv.DictWriter(text, table.columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(table.rows)
    yield from text.getvalue().splitlines()


def _ecsv_head(table: ColumnTable, metadata: Mapping[str, object]) -> Iterator[str]:
    yield from ("# %ECSV 1.0", "# ---", "# delimiter: ','", "# datatype:")
    for name, description in table.columns.items():
        unit = name.rpartition("_")[2]
        kind = (f"unit: {unit}, " if unit in _UNITS else "") + f"datatype: {_TYPES.get(name, 'float64')}"
        yield f"# - {{name: {name}, {kind}, description: {_yaml(description)}}}"
    yield "# meta: !!omap"
    yield from (f"# - {{{key}: {_yaml(value)}}}" for key, value in metadata.items())
    yield "# schema: astropy-2.0"


def _yaml(value: object) -> str:
    """A value in YAML, which includes JSON; unprintable characters, such as line separators, are escaped for YAML."""
    text = json.dumps(value, ensure_ascii=False)
    return "".join(char if char.isprintable() else f"\\U{ord(char):08x}" for char in text)


def fixes_table(found: Findings) -> ColumnTable:
    """Every point of the mission, measured or not."""
    record, alignment = found.record, found.alignment
    fixes, times_s = {one.point: one.fix for one in record.measured}, fix_times_s(record)
    deviations = {
        PointId(*panel.panel, one["point"]): one
        for panel in (() if alignment is None else alignment.panels)
        for one in panel_data(panel)["deviations"]
    }
    rows = []
    for stored, arrival in zip(record.points or (), found.points, strict=True):
        row: dict[str, object] = {**stored.point._asdict(), "status": stored.status}
        row |= {"first_arrival_mm": arrival.first_mm, "measured_at_mm": arrival.left_mm}
        if (fix := fixes.get(stored.point)) is not None:
            row |= {"t_s": times_s.get(stored.point), "dop": fix.dop, "residual_rms_m": fix.residual_rms_m}
            row |= zip(("x_m", "y_m", "z_m"), fix.position_m, strict=True)
            row |= {name: fix.covariance_m2[at] for name, at in _COVARIANCE.items()}
            row |= {"channels": _list(fix.channels), "metrology": fix.metrology, "left_out": _list(fix.left_out)}
            row |= {"detectable_m": fix.detectable_m, "protection_m": fix.protection_m}
        if (one := deviations.get(stored.point)) is not None:
            row |= {"deviation_um": one["deviation_um"], "sigma_deviation_um": one["sigma_um"]}
            row |= {"residual_um": one["residual_um"], "is_outlier": int(one["is_outlier"])}
        rows.append(row)
    return ColumnTable(_FIXES, rows)


def _list(numbers: Iterable[int]) -> str:
    return " ".join(map(str, numbers))


def panel_table(mirror: Mirror, panels: Sequence[PanelResult]) -> ColumnTable:
    """Position and tilt of each determined panel, and the turns of its adjusters."""
    names = panels[0].adjusters if panels else ()
    columns = {
        **_PLACE,
        "points": "measured points",
        **_FIT,
        **{f"sigma_{name}": _SIGMA for name in _FIT},
        "chi2": "chi-square of the fitted plane",
        "dof": "degrees of freedom of the fitted plane",
        "outliers": "numbers of the points that were not used for the fit",
        **{
            f"{name}_{axis}_m": f"place of adjuster {name} in the frame of the panel: x to the right, y up, seen "
            "from the robot"
            for name in names
            for axis in "xy"
        },
        **{f"{name}_um": f"move of adjuster {name}, > 0 towards the robot" for name in names},
        **{f"sigma_{name}_um": _SIGMA for name in names},
        **{f"bending_{name}_um": f"move of adjuster {name} that also removes twist and bowl" for name in names},
        **{f"sigma_bending_{name}_um": _SIGMA for name in names},
        "is_bent": "1: the curvatures of the panel are significant",
        "rms_before_um": "half-wavefront error before the moves",
        "rms_after_um": "half-wavefront error predicted after the moves",
        "worst_corner_um": "displacement of the corner that is furthest off, > 0 towards the robot",
        "sigma_worst_corner_um": _SIGMA,
    }
    rows: list[dict[str, object]] = []
    for panel in panels:
        data, corner_um = panel_data(panel), [round(1e6 * value, 4) for value in worst_corner(mirror, panel)]
        data["outliers"] = _list(data["outliers"])
        data["is_bent"] = int(panel.shape is not None and panel.shape.is_significant)
        data |= zip([f"sigma_{name}" for name in _FIT], data["sigma"], strict=True)
        for name, place in zip(*adjuster_places(mirror, panel.panel), strict=True):
            data |= {f"{name}_{axis}_m": round(float(at), 6) for axis, at in zip("xy", place, strict=True)}
        data |= zip([f"{name}_um" for name in names], data["adjusters_um"], strict=True)
        data |= zip([f"sigma_{name}_um" for name in names], data["adjusters_sigma_um"], strict=True)
        if panel.bending is not None:
            data |= zip([f"bending_{name}_um" for name in names], data["bending_adjusters_um"], strict=True)
            data |= zip([f"sigma_bending_{name}_um" for name in names], data["bending_adjusters_sigma_um"], strict=True)
        data |= zip(("worst_corner_um", "sigma_worst_corner_um"), corner_um, strict=True)
        rows.append(data)
    return ColumnTable(columns, rows)


def all_panels_table(found: Findings) -> ColumnTable:
    """Panels with measured points: of one that they do not determine only its place and the number of its points."""
    result = found.alignment
    table = panel_table(found.record.mirror, () if result is None else result.panels)
    others = () if result is None else result.undetermined
    return ColumnTable(table.columns, [*table.rows, *({**one.panel._asdict(), "points": one.points} for one in others)])


_WORK = {
    "round": "all adjusters of a panel are turned once in a round",
    "rounds": "number of rounds of the panel",
    **_PLACE,
    "adjuster": "name of the adjuster",
    "x_m": "place of the adjuster in the frame of the panel",
    "y_m": "place of the adjuster in the frame of the panel",
    "move_um": "move of this step, > 0 towards the robot",
    "turns": "turns of the screw; empty if its pitch is not configured",
    "sigma_move_um": "standard deviation of the whole move",
    "is_significant": "0: the whole move is less than three of its standard deviations",
}


def work_table(steps: Sequence[Step]) -> ColumnTable:
    """The steps of a work list, in their order."""
    rows = [
        {
            **step.panel._asdict(),
            "round": step.round,
            "rounds": step.rounds,
            "adjuster": step.adjuster,
            "x_m": round(step.x_m, 6),
            "y_m": round(step.y_m, 6),
            "move_um": round(1e6 * step.move_m, 4),
            "turns": None if step.turns is None else round(step.turns, 5),
            "sigma_move_um": round(1e6 * step.sigma_m, 4),
            "is_significant": int(step.is_significant),
        }
        for step in steps
    ]
    return ColumnTable(_WORK, rows)


def moves_table(found: Findings) -> ColumnTable:
    """Every adjuster of each determined panel."""
    rows = []
    for panel in () if found.alignment is None else found.alignment.panels:
        data, (_, places) = panel_data(panel), adjuster_places(found.record.mirror, panel.panel)
        moves = zip(panel.adjusters, places.tolist(), data["adjusters_um"], data["adjusters_sigma_um"], strict=True)
        for name, (x_m, y_m), move, sigma in moves:
            row = {**panel.panel._asdict(), "adjuster": name, "x_m": round(x_m, 6), "y_m": round(y_m, 6)}
            rows.append({**row, "move_um": move, "sigma_move_um": sigma})
    return ColumnTable(_MOVES, rows)
