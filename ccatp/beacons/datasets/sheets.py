"""Sheets with a header row: signal levels by distance or position, ranges between motes, positions of motes.

CSV, sheets of a workbook, and folders of XBee logs ("Node A: -56"). Maps of beacons are written as TOML.
"""

import io
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tomlkit

from ccatp.beacons.cricket.measured_map import MeasuredRanges
from ccatp.beacons.cricket.range_network import MoteRange
from ccatp.beacons.datasets.placeholders import placeholder_values
from ccatp.beacons.datasets.tables import (
    RadioDataError,
    content_lines,
    delimiter_of,
    number,
    plural,
    read_text,
    split_cells,
)
from ccatp.beacons.estimation.level_fix import MeasuredPlace
from ccatp.beacons.estimation.path_loss import LevelPair
from ccatp.config.files import read_input
from ccatp.core import FloatArray

# Limits against decompression bombs; manually measured tables are smaller.
_MOST_BOOK_BYTES, _MOST_CELLS = 5_000_000, 500_000

# What zipfile, zlib, the XML parser and openpyxl raise on damaged files.
_DAMAGE = (
    EOFError, LookupError, NotImplementedError, RuntimeError, SyntaxError, TypeError, ValueError,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip


class Sheet(NamedTuple):
    """The header of a sheet, and its other rows with their line numbers, from 1."""

    path: Path
    name: str
    head: list[str]
    rows: list[tuple[int, list[str]]]

    def column(self, pattern: re.Pattern[str], what: str) -> int:
        """The first column whose header matches. Raises RadioDataError: none does."""
        found = next((i for i, cell in enumerate(self.head) if pattern.search(cell)), None)
        if found is None:
            raise RadioDataError(self.path, f"has no column of {what}; its columns are {', '.join(self.head)}", 1)
        return found

    def numbers(self, *columns: int, may_lack: Sequence[int] = ()) -> list[list[float]]:
        """The numbers in some columns, row by row; NaN for an empty cell in those of ``may_lack``.

        Raises RadioDataError: a cell is not a number, or too large for a level or a coordinate.
        """
        found = []
        for line, row in self.rows:
            values = [
                np.nan
                if column in may_lack and not row[column]
                else number(self.path, line, row[column], f"column {column + 1}")
                for column in columns
            ]
            for column, value in zip(columns, values, strict=True):
                if not abs(value) <= _LARGEST and not (column in may_lack and not row[column]):
                    what = f"{value:g} in column {column + 1} is no level and no place, m"
                    raise RadioDataError(self.path, what, line)
            found.append(values)
        return found


def read_sheet(path: Path, sheet: str | None = None) -> Sheet:
    """Read a CSV file with commas, semicolons, tabs or white space, or a sheet of a workbook (default: the first).

    Raises RadioDataError: it cannot be read, or has no rows below the header.
    """
    if path.suffix.lower() == ".xlsx":
        sheets = read_workbook(path)
        chosen = sheet or next(iter(sheets), "")
        if chosen not in sheets:
            raise RadioDataError(path, f'has no sheet "{chosen}"; there are {", ".join(sheets)}')
        name = f"{path.name}, sheet {chosen}"
        rows = [(line, row) for line, row in enumerate(sheets[chosen], 1) if any(cell.strip() for cell in row)]
    else:
        name = path.name
        lines = content_lines(read_text(path, "a CSV file or an .xlsx workbook with columns of levels or ranges"))
        delimiter = delimiter_of(lines[0][1]) if lines else None
        rows = [(line, split_cells(content, delimiter)) for line, content in lines]
    if len(rows) < 2:
        raise RadioDataError(path, "holds no rows below a head; the first row names the columns")
    head = [cell.strip() for cell in rows[0][1]]
    padding = [""] * len(head)
    return Sheet(path, name, head, [(line, [cell.strip() for cell in row] + padding) for line, row in rows[1:]])


def read_workbook(file: Path) -> dict[str, list[list[str]]]:
    """Rows of cells by name of the sheet, in the order of the workbook; empty cells are empty strings.

    Raises RadioDataError: it is missing, or not a workbook.
    """
    from openpyxl import load_workbook  # noqa: PLC0415 - slow to import, and not needed for other formats

    found: dict[str, list[list[str]]] = {}
    cells = 0
    try:
        packed = io.BytesIO(read_input(file, _MOST_BOOK_BYTES))
        with zipfile.ZipFile(packed) as archive:
            if sum(part.file_size for part in archive.infolist()) > _MOST_BOOK_BYTES:
                raise RadioDataError(file, f"holds more than {_MOST_BOOK_BYTES} bytes; save the sheet as CSV")
            for part in archive.infolist():
                if part.filename.endswith(".xml") and b"<!ENTITY" in archive.read(part):
                    raise RadioDataError(file, f"{part.filename} in it defines entities, which no workbook does")
        book = load_workbook(packed, read_only=True, data_only=True)
        for sheet in book.worksheets:
            rows = found.setdefault(sheet.title, [])
            for row in sheet.values:
                cells += 1 + len(row)
                if cells > _MOST_CELLS:
                    raise RadioDataError(file, f"has more than {_MOST_CELLS} cells; save the sheet as CSV")
                rows.append(["" if cell is None else str(cell) for cell in row])
        return found
    except FileNotFoundError as error:
        raise RadioDataError(file, "no such file") from error
    except OSError as error:
        raise RadioDataError(file, f"cannot be read: {error.strerror or error}") from error
    except _DAMAGE as error:
        raise RadioDataError(
            file, f"is no .xlsx workbook: {' '.join(str(error).split())}; save it again, or as CSV"
        ) from error


_LOG_LINE = re.compile(r"Node\s+(?P<node>\S+?)\s*:\s*(?P<level>[-+]?\d+(?:\.\d+)?)")
_DISTANCE = re.compile(r"distance|range|^r$|^d$|_m$", re.IGNORECASE)
_LEVEL = re.compile(r"rssi|level|dbm", re.IGNORECASE)
_LEVEL_OF = re.compile(r"(?:rssi|level)[\s_]+(?P<node>\S+)", re.IGNORECASE)
_POINT = re.compile("point", re.IGNORECASE)
_DISTANCES = "distances, as distance_m"
_LARGEST = 1e5  # m or dBm

Levels = tuple[str, tuple[LevelPair, ...], list[str]]
LevelsByPlace = tuple[str, tuple[MeasuredPlace, ...], list[str]]


def read_levels(path: Path, sheet: str | None = None, points: Path | None = None) -> Levels:
    """Pairs of distance (m) and level (dBm) from a sheet, or from a folder of XBee logs with a table of ``points``.

    Returns the name of the data, the pairs, and warnings. Raises RadioDataError: it cannot be read, or lacks the
    columns.
    """
    if path.is_dir():
        return _read_logs(path, sheet, points)
    table = read_sheet(path, sheet)
    distance, level = table.column(_DISTANCE, _DISTANCES), table.column(_LEVEL, "levels, as rssi_dbm")
    numbers = np.array(table.numbers(distance, level, may_lack=(level,)))
    levels, warnings = _heard(numbers[:, 1:])
    rows = zip(numbers[:, 0].tolist(), levels[:, 0].tolist(), strict=True)
    return table.name, tuple(LevelPair(r_m, z) for r_m, z in rows if not np.isnan(z)), warnings


def read_level_places(path: Path, sheet: str | None = None) -> LevelsByPlace:
    """Positions and levels: columns ``x``, ``y`` (m) and ``RSSI A``, ``RSSI B``, ... (dBm); see ``read_levels``.

    Raises RadioDataError: it cannot be read, or lacks the columns.
    """
    table = read_sheet(path, sheet)
    nodes = {match["node"]: i for i, cell in enumerate(table.head) if (match := _LEVEL_OF.fullmatch(cell))}
    at = [table.column(re.compile(rf"^{axis}(_m)?$", re.IGNORECASE), f"places, as {axis}") for axis in "xy"]
    if not nodes:
        raise RadioDataError(path, 'has no column of levels by node; name one "RSSI A" for each node')
    numbers = np.array(table.numbers(*at, *nodes.values(), may_lack=tuple(nodes.values())))
    levels, warnings = _heard(numbers[:, 2:])
    found = []
    for (x_m, y_m), row in zip(numbers[:, :2].tolist(), levels.tolist(), strict=True):
        received = {node: level for node, level in zip(nodes, row, strict=True) if not np.isnan(level)}
        if received:
            found.append(MeasuredPlace((x_m, y_m), received))
    if len(found) < len(numbers):
        warnings.append(f"{plural(len(numbers) - len(found), 'place')} where no node was received, not used")
    return table.name, tuple(found), warnings


def read_log(file: Path) -> dict[str, list[float]]:
    """Levels by node from an XBee log with lines like ``Node A: -56``.

    Raises RadioDataError: it cannot be read, or has another line.
    """
    found: dict[str, list[float]] = {}
    for line, content in content_lines(read_text(file)):
        match = _LOG_LINE.fullmatch(content)
        if match is None:
            raise RadioDataError(file, f'"{content[:40]}" is no line like "Node A: -56"', line)
        found.setdefault(match["node"], []).append(float(match["level"]))
    return found


def _read_logs(folder: Path, sheet: str | None, points: Path | None) -> Levels:
    if points is None:
        raise RadioDataError(folder, "is a folder of logs; name the table of their distances with --points")
    table = read_sheet(points, sheet)
    numbers = table.numbers(table.column(_POINT, "points"), table.column(_DISTANCE, _DISTANCES))
    pairs, missing = [], []
    for point, distance_m in numbers:
        file = folder / f"{int(point)}.txt"
        if file.is_file():
            pairs += [LevelPair(distance_m, level) for levels in read_log(file).values() for level in levels]
        else:
            missing.append(file.name)
    if not pairs:
        raise RadioDataError(folder, f"holds none of the logs that {points.name} names, as {missing[0]}")
    warnings = [f"{len(missing)} logs are missing, the first {missing[0]}"] if missing else []
    return f"{folder.name}, distances of {table.name}", tuple(pairs), warnings


def _heard(levels: FloatArray) -> tuple[FloatArray, list[str]]:
    """Levels in dBm, shape (n, nodes), NaN for nodes that were not received, and warnings."""
    levels, warnings = levels.copy(), []
    node = np.broadcast_to(np.arange(levels.shape[1]), levels.shape)[np.isfinite(levels)]
    for value in placeholder_values("rssi", node.astype(np.float64), levels[np.isfinite(levels)]):
        is_it = levels == value
        warnings.append(f"{plural(int(is_it.sum()), 'level')} of {value:g} dBm stand for nodes not received, not used")
        levels[is_it] = np.nan
    if np.isfinite(levels).any() and np.nanmin(levels) > 0.0:
        return -levels, [*warnings, "all levels are positive: taken for dBm without their sign"]
    return levels, warnings


PLAIN = ("first", "second", "range_m")
SESSION = ("session", "pos", "deg", "anchor", "tag", "mean_m")
PLACES = ("name", "x_m", "y_m")
LONGEST_M = 1e6
SHORTEST_M = 1e-3  # smallest range between motes
FINEST_M = 1e-6  # smallest sigma of a range


def read_ranges(path: Path, sigma_m: float) -> MeasuredRanges:
    """Read the ranges of a sheet, in one of two forms.

    ``first,second,range_m`` and optionally ``sigma_m``: one range per line.
    ``session,pos,deg,anchor,tag,n,mean_m,...``: a trolley with tags among anchors; each line is the mean range from an
    anchor to a tag while the trolley stood at a position and heading. Tags of one such pose form a rigid body.
    ``sigma_m``: for ranges without their own. Raises RadioDataError: it cannot be read, or a line is not a range.
    """
    table = read_sheet(path)
    is_session = set(SESSION) <= set(table.head)
    if not is_session:
        _check_columns(table, PLAIN, f"[,sigma_m], or {','.join(SESSION)}")
    readings, groups, tags = [], dict[str, dict[str, None]](), dict[str, str]()
    for line, cells in table.rows:
        row = dict(zip(table.head, cells, strict=False))
        sigma, length = sigma_m, "mean_m" if is_session else "range_m"
        if is_session:
            pose = f"{row['pos']}/{row['deg']}"
            first, second = f"anchor{row['anchor']}", f"{pose}/tag{row['tag']}"
            groups.setdefault(pose, {})[second] = None
            tags[second] = f"tag{row['tag']}"
        else:
            first, second = (_name(path, line, key, row[key]) for key in PLAIN[:2])
            if own := row.get("sigma_m"):
                sigma = number(path, line, own, "sigma_m")
        reading = MoteRange(first, second, number(path, line, row[length], length), sigma)
        _check_range(path, line, reading)
        readings.append(reading)
    return MeasuredRanges(tuple(readings), {pose: tuple(motes) for pose, motes in groups.items()}, tags)


def read_places(path: Path) -> dict[str, tuple[float, ...]]:
    """Positions of motes by name, from a sheet with ``name,x_m,y_m`` and, in three dimensions, ``z_m``.

    Raises RadioDataError: it cannot be read, or a line is not a position.
    """
    table = read_sheet(path)
    _check_columns(table, PLACES, "[,z_m]")
    axes = [axis for axis in ("x_m", "y_m", "z_m") if axis in table.head]
    found = {}
    for line, cells in table.rows:
        row = dict(zip(table.head, cells, strict=False))
        place_m = tuple(number(path, line, row[axis], axis) for axis in axes)
        for axis, value_m in zip(axes, place_m, strict=True):
            if not abs(value_m) <= LONGEST_M:
                raise RadioDataError(path, f"{axis} = {value_m:g} is no place within {LONGEST_M:g} m", line)
        found[_name(path, line, "name", row["name"])] = place_m
    return found


def _check_columns(table: Sheet, wanted: Sequence[str], more: str) -> None:
    if not set(wanted) <= set(table.head):
        raise RadioDataError(table.path, f"columns {','.join(table.head)}; wanted {','.join(wanted)}{more}", 1)


def _name(path: Path, line: int, key: str, text: str) -> str:
    if not text:
        raise RadioDataError(path, f"{key} is empty; every mote needs a name", line)
    return text


def _check_range(path: Path, line: int, reading: MoteRange) -> None:
    problem = ""
    if not SHORTEST_M <= reading.range_m <= LONGEST_M:
        is_far = reading.range_m > LONGEST_M
        what = f"is more than the {LONGEST_M:g} m that beacons reach" if is_far else "is no distance"
        problem = f"range of {reading.range_m:g} m {what}; in metres, between two places"
    elif not FINEST_M <= reading.sigma_m <= LONGEST_M:
        problem = f"sigma of {reading.sigma_m:g} m, must be {FINEST_M:g} to {LONGEST_M:g} m"
    elif reading.first == reading.second:
        problem = f"from {reading.first} to itself; leave it out"
    if problem:
        raise RadioDataError(path, problem, line)


_HEAD = "# Beacons, mapped by ccatp: m, and the covariance of all coordinates in their order, m^2.\n\n"


def write_beacons(
    path: Path, names: Sequence[str], positions_m: FloatArray, covariance_m2: FloatArray, frame: str
) -> None:
    """Write a map: positions (n, d), covariance of all coordinates (n d, n d).

    Raises RadioDataError: the file cannot be written.
    """
    sigmas_m = np.sqrt(np.maximum(covariance_m2.diagonal(), 0.0)).reshape(positions_m.shape)
    rows = zip(names, positions_m.tolist(), sigmas_m.tolist(), strict=True)
    beacons = {name: {"position_m": place_m, "sigma_m": sigma_m} for name, place_m, sigma_m in rows}
    tree = {"frame": frame, "dimension": positions_m.shape[1], "beacons": beacons}
    joint = {"joint": {"covariance_m2": covariance_m2.tolist()}}
    try:
        path.write_text(_HEAD + tomlkit.dumps(tree | joint), encoding="utf-8")
    except OSError as error:
        raise RadioDataError(path, f"cannot be written: {error.strerror or error}") from error
