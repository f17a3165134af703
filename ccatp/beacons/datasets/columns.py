"""Recorded runs as tables with a header: readings by time and beacon in one file, odometry in another beside it."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.beacons.datasets.events import EVENTS, READING_KINDS, Recording, is_events_csv, name_of
from ccatp.beacons.datasets.headers import LENGTHS, SECONDS, SPEEDS, Column, column_of
from ccatp.beacons.datasets.tables import (
    COMMENTS,
    NotTextError,
    RadioDataError,
    Table,
    beacon_name,
    content_lines,
    delimiter_of,
    is_number,
    number,
    read_text,
    split_cells,
    tables_of,
)
from ccatp.core import FloatArray
from ccatp.errors import listed

LEAST_COLUMNS = 3  # of a table of readings
QUATERNION = ("qx", "qy", "qz", "qw")
PATH = ("x", "y", "heading", *QUATERNION)
NOTHING = ("", "nan", "n/a", "#n/a", "na", "null", "none", "-", "--")  # cells without a value, in lower case
TRUTH_NAME = re.compile(r"truth|gt|ground|reference|mocap|vicon|optitrack|qualisys|rtk|gnss|gps", re.IGNORECASE)


class ColumnFile(NamedTuple):
    """A table with a header."""

    file: Path
    columns: list[Column | None]
    rows: list[tuple[int, list[str]]]
    places: Mapping[str, int]  # index of the column of each quantity: of several that with the earliest name
    unknown: tuple[str, ...] = ()  # headers of columns that are not understood

    @property
    def quantities(self) -> set[str]:
        """The quantities of its columns."""
        return {*self.places}

    def values(self, *quantities: str) -> Table:
        """A table of some quantities; NaN for those that it lacks, and for empty cells."""
        found = np.full((len(self.rows), len(quantities)), np.nan)
        for row, (line, cells) in enumerate(self.rows):
            for place, quantity in enumerate(quantities):
                k = self.places.get(quantity)
                if k is not None and cells[k]:
                    found[row, place] = self.time_s(line, cells) if quantity == "time" else self.value(line, cells, k)
        return Table(self.file, found, np.array([line for line, _ in self.rows]))

    def value(self, line: int, cells: list[str], k: int) -> float:
        """The value of a cell that is not empty, in SI units."""
        column = self.columns[k]
        return np.nan if column is None else column.factor * number(self.file, line, cells[k], column.quantity)

    def time_s(self, line: int, cells: list[str]) -> float:
        """The time of a row; of a date the time since 1970, by default in UTC. NaN if its cell is empty."""
        k, fraction = self.places.get("time"), self.places.get("fraction")
        if k is None or not cells[k]:
            return np.nan
        if not is_number(cells[k]):
            with suppress(ValueError):
                date = datetime.fromisoformat(cells[k])
                return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
        time_s = self.value(line, cells, k)
        if (column := self.columns[k]) and column.rank >= SECONDS and fraction is not None and cells[fraction]:
            time_s += self.value(line, cells, fraction)
        return time_s

    def poses(self) -> Table:
        """Rows of time, x, y and heading; the heading may be written as a quaternion."""
        poses = self.values("time", "x", "y", "heading")
        if "heading" not in self.quantities and {"qz", "qw"} <= self.quantities:
            x, y, z, w = np.nan_to_num(self.values(*QUATERNION).values).T
            poses.values[:, 3] = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
            poses.values[(z == 0.0) & (w == 0.0) & (x == 0.0) & (y == 0.0), 3] = np.nan
        return poses


def is_columns(text: str) -> bool:
    """Whether the header of a text has a time and readings by beacon."""
    if is_events_csv(text):
        return False
    columns = [column for column in _header(text) if column]
    found = {column.quantity for column in columns}
    return (
        "time" in found
        and ("beacon" in found or any(column.beacon for column in columns))
        and (bool(found & {*READING_KINDS}))
    )


def read_columns(path: Path) -> Recording:
    """Read a table of readings, and beside it those of odometry and, if there are, of truth, beacons and tags.

    ``path``: the table of readings, or a folder with one. Raises RadioDataError: one of the first two is missing, or
    there are several of one of the others.
    """
    folder = path if path.is_dir() else path.parent
    texts, unread = _texts(folder)
    readings = [file for file, text in texts.items() if is_columns(text)] if path.is_dir() else [path]
    if len(readings) != 1:
        raise RadioDataError(path, f"holds {len(readings)} tables of readings: name one")
    file = readings[0]
    if not is_columns(text := read_text(file)):
        raise RadioDataError(file, "has no header with a time and ranges, bearings or levels by beacon")
    others = {other: _read(other, text) for other, text in texts.items() if other != file and _is_other_table(text)}
    tracks = {other: one for other, one in others.items() if "time" in one.quantities}
    truths = [one for other, one in tracks.items() if TRUTH_NAME.search(other.name)]
    odometry = [one for one in tracks.values() if one not in truths]
    if len(odometry) != 1 or len(truths) > 1:
        what = f"{len(odometry)} tables of odometry and {len(truths)} of truth"
        raise RadioDataError(
            folder,
            f"has {what} beside {file.name}: one with time and x, y, heading or speed, rate is needed{unread}",
        )
    still = {other: one for other, one in others.items() if "time" not in one.quantities}
    mounts = {other: one for other, one in still.items() if "tag" in one.quantities}
    surveys = {other: one for other, one in still.items() if other not in mounts}
    for what, found in (("surveyed beacons", surveys), ("places of tags", mounts)):
        if len(found) > 1:
            names = listed([other.name for other in found])
            raise RadioDataError(
                folder, f"has {len(found)} tables of {what} beside {file.name}: {names}; leave one in the folder"
            )
    numbers: dict[str, float] = {}
    tags: dict[str, float] = {}
    table = _read(file, text)
    warnings = [
        f"{one.file.name}: {'column' if len(one.unknown) == 1 else 'columns'} not understood, not used: "
        f"{listed(one.unknown)}"
        for one in (table, *others.values())
        if one.unknown
    ]
    if path_beside := [quantity for quantity in PATH if quantity in table.quantities]:
        warnings.append(
            f"{table.file.name}: a path beside the readings is not used: {listed(path_beside)}; give a truth in a "
            "table of its own, with truth in its name"
        )
    warnings += _exchanged(table)
    events = tables_of(file, _readings(table, numbers, tags))
    events |= dict([_motion(odometry[0])])
    if truths:
        events["truth"] = truths[0].poses()
    if (beside := _places_beside(table, numbers, warnings)) is not None:
        events["beacon"] = beside
    for survey in surveys.values():
        events["beacon"] = _survey(survey, numbers)
    for mount in mounts.values():
        events["tag"] = _mounted(mount, tags)
    return Recording(file, name_of(file), "csv", events, tuple(numbers), tuple(warnings), tuple(tags))


def read_survey(file: Path, text: str) -> tuple[list[str], FloatArray, FloatArray]:
    """Names of beacons, their places x, y, z (n, 3), and the standard deviation of each coordinate (n,), NaN if none.

    Raises RadioDataError: it is no table of places.
    """
    header = _header(text)
    if not {"beacon", "x", "y"} <= {column.quantity for column in header if column}:
        raise RadioDataError(file, "has no header with beacon, x and y, so it is no map")
    table = _read(file, text)
    at = table.places.get("beacon") or 0
    names = [beacon_name(cells[at]) for _, cells in table.rows]
    if "" in names:
        raise RadioDataError(file, "the place has no name of a beacon", table.rows[names.index("")][0])
    return names, table.values("x", "y", "z").values, table.values("sigma").values[:, 0]


def lacking(text: str) -> str:
    """What the header of a text lacks to be one of readings; "" if it has no header, or that of another table."""
    columns = _header(text)
    found = {column.quantity for column in columns if column} | {"beacon" for one in columns if one and one.beacon}
    beside_places = {"x", "y"} <= found and bool(found & {*READING_KINDS})
    if len(columns) < LEAST_COLUMNS or (_is_other_table(text) and not beside_places):
        return ""
    wanted = {"a time": {"time"}, "the name of a beacon": {"beacon"}, "a range, bearing or rssi": {*READING_KINDS}}
    missing = [what for what, names in wanted.items() if not found & names]
    cells = split_cells(content := _first_line(text[:20_000])[1], delimiter_of(content))
    return f"its header ({listed(cells)}) has no column with {' or '.join(missing)}" if missing else ""


def _texts(folder: Path) -> tuple[dict[Path, str], str]:
    """The texts of a folder that may be tables, by file, and those that are damaged, for a message."""
    texts, damaged = {}, []
    for file in sorted(folder.iterdir()):
        if file.is_file() and {".csv", ".txt", ".tsv"} & {*file.suffixes}:
            try:
                texts[file] = read_text(file)
            except NotTextError:
                continue
            except RadioDataError:
                damaged.append(file.name)
    return texts, f" ({listed(damaged)} cannot be read)" if damaged else ""


def _first_line(text: str) -> tuple[int, str]:
    """Number and content of the header: the first line, or above a first line of numbers the comment before it."""
    lines = content_lines(text)
    if not lines:
        return 0, ""
    line, content = lines[0]
    if any(is_number(cell) for cell in split_cells(content, delimiter_of(content))):
        above = text.splitlines()[line - 2].strip() if line > 1 else ""
        if above.startswith(COMMENTS):
            return line - 1, above.lstrip("#%/ ")
    return line, content


def _header(text: str) -> list[Column | None]:
    content = _first_line(text[:20_000])[1]
    cells = split_cells(content, delimiter_of(content))
    if not cells or any(is_number(cell) for cell in cells):
        return []
    return [column_of(cell) for cell in cells]


def _read(file: Path, text: str) -> ColumnFile:
    first, header = _first_line(text)
    mark, columns = delimiter_of(header), _header(text)
    if problems := [column.problem for column in columns if column and column.problem]:
        raise RadioDataError(file, problems[0], first)
    rows = []
    for line, content in content_lines(text):
        if line <= first:
            continue
        cells = ["" if cell.lower() in NOTHING else cell for cell in split_cells(content, mark)]
        if len(cells) > len(columns) and any(cells[len(columns) :]):
            raise RadioDataError(file, f"{len(cells)} cells below a header of {len(columns)}", line)
        rows.append((line, [*cells, *[""] * (len(columns) - len(cells))]))
    if not rows:
        raise RadioDataError(file, "holds no rows below its header")
    ranked = sorted((column.rank, k, column.quantity) for k, column in enumerate(columns) if column)
    headers = split_cells(header, mark)
    is_named = any(column and column.quantity == "beacon" for column in columns)  # a beacon's own columns are none then
    unknown = tuple(
        name
        for name, column in zip(headers, columns, strict=True)
        if name and (column is None or (is_named and column.beacon))
    )
    return ColumnFile(file, columns, rows, {quantity: k for _, k, quantity in reversed(ranked)}, unknown)


def _is_other_table(text: str) -> bool:
    """Whether the header of a text is that of odometry, a truth or a survey: other files of the folder are not read."""
    quantities = {column.quantity for column in _header(text) if column}
    if is_events_csv(text):
        return False
    if "time" in quantities:
        return _is_motion(quantities)
    return {"beacon", "x", "y"} <= quantities or {"tag", "forward_m", "left_m"} <= quantities


def _is_motion(quantities: set[str]) -> bool:
    return any(wanted <= quantities for wanted in ({"x", "y"}, {"speed", "rate"}, {"turn"}))


def _exchanged(table: ColumnFile) -> list[str]:
    """A warning if there are several tags and one beacon."""
    at, named = table.places.get("tag"), table.places.get("beacon")
    if at is None or named is None or len({cells[at] for _, cells in table.rows}) == 1:
        return []
    if len({cells[named] for _, cells in table.rows}) > 1:
        return []
    return [f"{table.file.name}: several tags and one beacon: are these two columns exchanged?"]


def _readings(
    table: ColumnFile, numbers: dict[str, float], tags: dict[str, float]
) -> Iterator[tuple[str, int, list[float]]]:
    named, tagged = table.places.get("beacon"), table.places.get("tag")
    readings = [(k, column) for k, column in enumerate(table.columns) if column and column.quantity in READING_KINDS]
    if named is not None:  # beside a column of names, others than "range" itself are no beacons
        readings = [(k, column) for k, column in readings if not column.beacon]
        kinds = [column.quantity for _, column in readings]
        if not kinds or len(set(kinds)) < len(kinds):
            what = "no column" if not kinds else "several columns"
            raise RadioDataError(table.file, f"{what} of a range, bearing or rssi beside the names of the beacons", 1)
    for line, cells in table.rows:
        if np.isnan(time_s := table.time_s(line, cells)):
            raise RadioDataError(table.file, "the reading has no time", line)
        for k, column in readings:
            if not cells[k]:
                continue  # an empty cell: the beacon was not received
            name = beacon_name(column.beacon if named is None else cells[named])
            if not name:
                raise RadioDataError(table.file, "the reading has no name of a beacon", line)
            beacon = numbers.setdefault(name, float(len(numbers)))
            tag = "" if tagged is None else beacon_name(cells[tagged])
            by = tags.setdefault(tag, float(len(tags))) if tag else np.nan
            yield column.quantity, line, [time_s, beacon, table.value(line, cells, k), by]


def _places_beside(table: ColumnFile, numbers: dict[str, float], warnings: list[str]) -> Table | None:
    """Places of the beacons beside their readings; those of a beacon that has several are not taken."""
    named = table.places.get("beacon")
    if named is None or not {"beacon_x", "beacon_y"} <= table.quantities:
        return None
    places = table.values("beacon_x", "beacon_y", "beacon_z")
    index: FloatArray = np.array([numbers.get(beacon_name(cells[named]), np.nan) for _, cells in table.rows])
    rows = np.flatnonzero(np.isfinite(index) & np.isfinite(places.values[:, :2]).all(axis=1))
    found = np.column_stack([index, places.values])[rows]
    first = np.unique(found[:, :3], axis=0, return_index=True)[1]
    found, lines = found[first], places.lines[rows[first]]
    alone = np.isin(found[:, 0], [beacon for beacon, count in Counter(found[:, 0].tolist()).items() if count == 1])
    if not alone.all():
        names = listed([name for name, number in numbers.items() if number in found[~alone, 0]])
        warnings.append(
            f"beacons with several places beside their readings: {names}; do they move? Each is taken to stand"
        )
    return Table(table.file, found[alone], lines[alone]) if alone.any() else None


def _motion(table: ColumnFile) -> tuple[str, Table]:
    if {"x", "y"} <= table.quantities:
        if "heading" not in table.quantities and not {"qz", "qw"} <= table.quantities:
            raise RadioDataError(table.file, "odometry with x and y has no heading; give it, or speed and rate", 1)
        return "pose", table.poses()
    kind, names = ("speed", ("speed", "rate")) if "speed" in table.quantities else ("odom", ("range", "turn"))
    if not {*names} <= table.quantities:
        raise RadioDataError(table.file, "odometry with a turn has no distance: time, distance, turn are needed", 1)
    aside = _sideways(table, kind)
    moves = table.values("time", *names, aside)
    if aside not in table.quantities:
        moves.values[:, 3] = 0.0
    return kind, moves


def _sideways(table: ColumnFile, kind: str) -> str:
    """The quantity of the motion to the left. Raises RadioDataError: a speed beside distances, or the reverse."""
    for quantity in ("lateral", "left_m", "left"):
        k = table.places.get(quantity)
        column = None if k is None else table.columns[k]
        if column is None:
            continue
        is_speed = quantity == "left" or column.unit in SPEEDS
        if is_speed if kind == "odom" else column.unit in LENGTHS:
            has, wanted = ("distances", "a distance") if kind == "odom" else ("speeds", "a speed")
            raise RadioDataError(table.file, f"odometry of {has} has another unit to the left: give {wanted}, too", 1)
        return quantity
    return "lateral"


def _survey(table: ColumnFile, numbers: dict[str, float]) -> Table:
    at = table.places.get("beacon") or 0
    names: FloatArray = np.array(
        [numbers.setdefault(beacon_name(cells[at]), float(len(numbers))) for _, cells in table.rows]
    )
    places = table.values("x", "y", "z")
    return places._replace(values=np.column_stack([names, places.values])[:, : len(EVENTS["beacon"])])


def _mounted(table: ColumnFile, tags: dict[str, float]) -> Table:
    """Places of the vehicle's radios. Raises RadioDataError: one has no name."""
    at, names = table.places.get("tag") or 0, []
    for line, cells in table.rows:
        if not cells[at]:
            raise RadioDataError(table.file, "the place has no name of a tag", line)
        names.append(tags.setdefault(beacon_name(cells[at]), float(len(tags))))
    places = table.values("forward_m", "left_m", "up_m")
    return places._replace(values=np.column_stack([names, places.values]))
