"""Signal strengths by distance or by place: CSV, sheets of a workbook, and folders of XBee logs ("Node A: -56")."""

import csv
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ccatp.beacons.datasets.tables import RadioDataError, read_text
from ccatp.beacons.slam.level_fix import HeardPlace
from ccatp.beacons.slam.path_loss import LevelPair

_LARGEST_PART = 50_000_000  # bytes: a table that people measured is smaller, a decompression bomb is not

# What zipfile, zlib, the XML parser and openpyxl raise on damaged files.
_DAMAGE = (
    OSError, EOFError, LookupError, NotImplementedError, RuntimeError, SyntaxError, TypeError, ValueError,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip

Sheets = dict[str, list[list[str]]]


def read_workbook(file: Path) -> Sheets:
    """Rows of cells by name of the sheet, in the workbook's order; empty cells are empty text.

    Raises:
        RadioDataError: it is missing or no workbook.
    """
    from openpyxl import load_workbook  # noqa: PLC0415 - the other formats do not wait for it

    try:
        with zipfile.ZipFile(file) as archive:
            for part in archive.infolist():
                if part.file_size > _LARGEST_PART:
                    raise RadioDataError(
                        file, f"{part.filename} in it has {part.file_size} bytes; save the sheet as CSV"
                    )
                if part.filename.endswith(".xml") and b"<!ENTITY" in archive.read(part):
                    raise RadioDataError(file, f"{part.filename} in it defines entities, which no workbook does")
        book = load_workbook(file, read_only=True, data_only=True)
        try:
            return {
                sheet.title: [["" if cell is None else str(cell) for cell in row] for row in sheet.values]
                for sheet in book.worksheets
            }
        finally:
            book.close()
    except FileNotFoundError as error:
        raise RadioDataError(file, "no such file") from error
    except _DAMAGE as error:
        raise RadioDataError(
            file, f"is no .xlsx workbook: {' '.join(str(error).split())}; save it again, or as CSV"
        ) from error


_LOG_LINE = re.compile(r"Node\s+(?P<node>\S+?)\s*:\s*(?P<level>[-+]?\d+(?:\.\d+)?)")
_DISTANCE = re.compile(r"distance|range|^r$|^d$|_m$", re.IGNORECASE)
_LEVEL = re.compile(r"rssi|level|dbm", re.IGNORECASE)
_LEVEL_OF = re.compile(r"(?:rssi|level)[\s_]+(?P<node>\S+)", re.IGNORECASE)

_LARGEST = 1e5  # of metres as of dBm


class LevelTable(NamedTuple):
    """Pairs of distance and level, and what was odd about them."""

    name: str
    pairs: tuple[LevelPair, ...]
    warnings: tuple[str, ...]


class PlaceTable(NamedTuple):
    """Places with levels, and what was odd about them: see ``LevelTable``."""

    name: str
    places: tuple[HeardPlace, ...]
    warnings: tuple[str, ...]


def read_levels(path: Path, sheet: str | None = None, points: Path | None = None) -> LevelTable:
    """Pairs of distance (m) and level (dBm) of a CSV, a workbook, or XBee logs with a table of their ``points``.

    Raises:
        RadioDataError: it cannot be read, or has no such columns.
    """
    if path.is_dir():
        return _read_folder(path, sheet, points)
    name, rows = _read_rows(path, sheet)
    head = rows[0]
    at = [
        _levels_column(path, head, _DISTANCE, "distances, as distance_m"),
        _levels_column(path, head, _LEVEL, "levels, as rssi_dbm"),
    ]
    numbers = [[_number(path, index, row, column) for column in at] for index, row in enumerate(rows[1:], 2)]
    levels, warnings = _signed([level for _, level in numbers])
    pairs = tuple(LevelPair(r_m, level) for (r_m, _), level in zip(numbers, levels, strict=True))
    return LevelTable(name, pairs, tuple(warnings))


def read_places(path: Path, sheet: str | None = None) -> PlaceTable:
    """Places and levels: columns ``x``, ``y`` (m) and ``RSSI A``, ``RSSI B``, ... (dBm).

    Raises:
        RadioDataError: it cannot be read, or has no such columns.
    """
    name, rows = _read_rows(path, sheet)
    head = [cell.strip() for cell in rows[0]]
    nodes = {match["node"]: i for i, cell in enumerate(head) if (match := _LEVEL_OF.fullmatch(cell))}
    x, y = (
        _levels_column(path, head, re.compile(rf"^{axis}(_m)?$", re.IGNORECASE), f"places, as {axis}") for axis in "xy"
    )
    if not nodes:
        raise RadioDataError(path, 'has no column of levels by node; name one "RSSI A" for each node')
    body = rows[1:]
    places = [tuple(_number(path, i, row, column) for column in (x, y)) for i, row in enumerate(body, 2)]
    flat = [_number(path, i, row, column) for i, row in enumerate(body, 2) for column in nodes.values()]
    levels, warnings = _signed(flat)
    n = len(nodes)
    heard = tuple(
        HeardPlace((place[0], place[1]), dict(zip(nodes, levels[i * n : (i + 1) * n], strict=True)))
        for i, place in enumerate(places)
    )
    return PlaceTable(name, heard, tuple(warnings))


def read_log(file: Path) -> dict[str, list[float]]:
    """Levels by node of an XBee log with lines as ``Node A: -56``.

    Raises:
        RadioDataError: it cannot be read, or a line is none of these.
    """
    found: dict[str, list[float]] = {}
    for number, line in enumerate(read_text(file).splitlines(), 1):
        if not line.strip():
            continue
        match = _LOG_LINE.fullmatch(line.strip())
        if match is None:
            raise RadioDataError(file, f'"{line.strip()[:40]}" is no line like "Node A: -56"', number)
        found.setdefault(match["node"], []).append(float(match["level"]))
    return found


def _read_folder(folder: Path, sheet: str | None, points: Path | None) -> LevelTable:
    if points is None:
        raise RadioDataError(folder, "is a folder of logs; name the table of their distances with --points")
    name, rows = _read_rows(points, sheet)
    column = _levels_column(points, rows[0], re.compile("point", re.IGNORECASE), "points")
    at = _levels_column(points, rows[0], _DISTANCE, "distances, as distance_m")
    pairs, missing = [], []
    for index, row in enumerate(rows[1:], 2):
        point, distance_m = int(_number(points, index, row, column)), _number(points, index, row, at)
        file = folder / f"{point}.txt"
        if not file.is_file():
            missing.append(file.name)
            continue
        pairs += [LevelPair(distance_m, level) for levels in read_log(file).values() for level in levels]
    if not pairs:
        raise RadioDataError(folder, f"holds none of the logs that {points.name} names, as {missing[0]}")
    warnings = [f"{len(missing)} logs are missing, the first {missing[0]}"] if missing else []
    return LevelTable(f"{folder.name}, distances of {name}", tuple(pairs), tuple(warnings))


def _read_rows(path: Path, sheet: str | None) -> tuple[str, list[list[str]]]:
    if path.suffix.lower() != ".xlsx":
        text = read_text(path, "a CSV file or an .xlsx workbook with columns of levels")
        lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
        delimiter = next((mark for mark in ",;\t" if lines and mark in lines[0]), None)
        rows = list(csv.reader(lines, delimiter=delimiter)) if delimiter else [line.split() for line in lines]
        name = path.name
    else:
        sheets = read_workbook(path)
        chosen = sheet or next(iter(sheets), "")
        if chosen not in sheets:
            raise RadioDataError(path, f'has no sheet "{chosen}"; there are {", ".join(sheets)}')
        rows = [row for row in sheets[chosen] if any(cell.strip() for cell in row)]
        name = f"{path.name}, sheet {chosen}"
    if len(rows) < 2:
        raise RadioDataError(path, "holds no rows below a head; the first row names the columns")
    return name, rows


def _levels_column(path: Path, head: Sequence[str], pattern: re.Pattern[str], what: str) -> int:
    found = next((i for i, cell in enumerate(head) if pattern.search(cell.strip())), None)
    if found is None:
        raise RadioDataError(path, f"has no column of {what}; its columns are {', '.join(head)}", 1)
    return found


def _number(path: Path, line: int, row: Sequence[str], column: int) -> float:
    text = row[column].strip() if column < len(row) else ""
    try:
        value = float(text)
    except ValueError as error:
        raise RadioDataError(path, f'"{text[:40]}" in column {column + 1} is no number', line) from error
    if not abs(value) <= _LARGEST:
        raise RadioDataError(path, f"{value:g} in column {column + 1} is no level and no place, m", line)
    return value


def _signed(levels: list[float]) -> tuple[list[float], list[str]]:
    if levels and min(levels) > 0.0:
        return [-level for level in levels], ["all levels are positive: taken for dBm without their sign"]
    return levels, []
