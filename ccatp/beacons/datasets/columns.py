"""Recorded runs as tables with a header: readings by time and beacon in one file, odometry in another beside it."""

import re
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.beacons.datasets.events import EVENTS, READING_KINDS, Recording, is_events_csv, name_of
from ccatp.beacons.datasets.placeholders import true_positions
from ccatp.beacons.datasets.tables import (
    COMMENTS,
    NotTextError,
    RadioDataError,
    Table,
    content_lines,
    delimiter_of,
    is_number,
    number,
    read_text,
    split_cells,
    tables_of,
)
from ccatp.beacons.datasets.trajectory import motions_between
from ccatp.core import FloatArray

# Headers of each quantity, in lower case with underscores, without unit; of several columns the earlier name counts.
HEADERS = {
    "time": ("time", "t", "timestamp", "stamp", "secs", "seconds"),
    "beacon": (
        "beacon", "anchor", "beacon_id", "anchor_id", "beaconid", "anchorid", "node", "node_id", "mote", "landmark",
        "address", "id",
    ),
    "range": ("range", "distance", "dist", "r"),
    "bearing": ("bearing", "aoa", "azimuth"),
    "rssi": ("rssi", "level"),
    "x": ("x", "pos_x", "position_x", "px", "tx"),
    "y": ("y", "pos_y", "position_y", "py", "ty"),
    "z": ("z", "pos_z", "position_z", "pz", "tz"),
    "sigma": ("sigma", "std", "accuracy"),
    "heading": ("heading", "yaw", "theta", "phi", "orientation"),
    "qx": ("qx", "q_x", "orientation_x"),
    "qy": ("qy", "q_y", "orientation_y"),
    "qz": ("qz", "q_z", "orientation_z"),
    "qw": ("qw", "q_w", "orientation_w"),
    "speed": ("speed", "v", "vx", "velocity", "linear"),
    "left": ("vy", "lateral_speed"),
    "rate": ("w", "omega", "rate", "yaw_rate", "turn_rate", "wz", "angular"),
    "turn": ("turn", "dtheta", "dyaw", "dphi"),
}  # fmt: skip
QUATERNION = ("qx", "qy", "qz", "qw")
# Last words of columns beside that of a reading, which are none.
OF_QUALITY = ("std", "stddev", "sigma", "var", "variance", "err", "error", "quality", "snr", "valid")
NOTHING = ("", "nan", "n/a", "na", "null", "none", "-")  # cells without a value, in lower case
UNITS = {
    "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "ft": 0.3048,
    "rad": 1.0, "deg": np.pi / 180.0, "dbm": 1.0, "m_s": 1.0, "m/s": 1.0, "mm/s": 1e-3, "rad_s": 1.0, "rad/s": 1.0,
    "deg/s": np.pi / 180.0, "deg_s": np.pi / 180.0,
}  # fmt: skip
UNIT = re.compile(r"^(?P<name>.*?)(?:[ _]*[\[(](?P<bracket>[^\])]*)[\])]|_(?P<suffix>m_s|rad_s|deg_s|[a-z]+))?$")
TRUTH_NAME = re.compile(r"truth|gt|ground|reference|mocap", re.IGNORECASE)


class Column(NamedTuple):
    """What a column has: quantity, beacon of a column of one beacon alone, factor to SI units, place of its name."""

    quantity: str
    beacon: str
    factor: float
    rank: int = 0


class ColumnFile(NamedTuple):
    """A table with a header."""

    file: Path
    columns: list[Column | None]
    rows: list[tuple[int, list[str]]]

    @property
    def quantities(self) -> set[str]:
        """The quantities of its columns."""
        return {column.quantity for column in self.columns if column}

    def values(self, *quantities: str) -> Table:
        """A table of some quantities; NaN for those that it lacks, and for empty cells."""
        found = np.full((len(self.rows), len(quantities)), np.nan)
        for row, (line, cells) in enumerate(self.rows):
            for place, quantity in enumerate(quantities):
                k = self.column_of(quantity)
                if k is not None and cells[k]:
                    found[row, place] = self.value(line, cells, k)
        return Table(self.file, found, np.array([line for line, _ in self.rows]))

    def column_of(self, quantity: str) -> int | None:
        """Index of the column of a quantity: of several that with the earliest of the names in ``HEADERS``."""
        found = [(column.rank, k) for k, column in enumerate(self.columns) if column and column.quantity == quantity]
        return min(found)[1] if found else None

    def value(self, line: int, cells: list[str], k: int) -> float:
        """The value of a cell that is not empty, in SI units; of a date the time since 1970, by default in UTC."""
        column = self.columns[k]
        if column is None:
            return np.nan
        if column.quantity == "time" and not is_number(cells[k]):
            try:
                date = datetime.fromisoformat(cells[k])
            except ValueError:
                date = None
            if date is not None:
                return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
        return column.factor * number(self.file, line, cells[k], column.quantity)

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
    """Read a table of readings, and beside it those of odometry and, if there are, of truth and surveyed beacons.

    ``path``: the table of readings, or a folder with one. Raises RadioDataError: one of the first two is missing.
    """
    folder = path if path.is_dir() else path.parent
    texts = _texts(folder)
    readings = [file for file, text in texts.items() if is_columns(text)] if path.is_dir() else [path]
    if len(readings) != 1:
        raise RadioDataError(path, f"holds {len(readings)} tables of readings: name one")
    if not is_columns(text := read_text(readings[0])):
        raise RadioDataError(readings[0], "has no header with a time and ranges, bearings or levels by beacon")
    others = {file: text for file, text in texts.items() if file not in readings and _is_other_table(text)}
    tables = {file: _read(file, text) for file, text in others.items()}
    tracks = {file: one for file, one in tables.items() if "time" in one.quantities and _is_motion(one.quantities)}
    truths = {file: one for file, one in tracks.items() if TRUTH_NAME.search(file.name)}
    odometry = [one for file, one in tracks.items() if file not in truths]
    if len(odometry) != 1 or len(truths) > 1:
        what = f"{len(odometry)} tables of odometry and {len(truths)} of truth"
        raise RadioDataError(
            folder, f"has {what} beside {readings[0].name}: one with time and x, y, heading or speed, rate is needed"
        )
    warnings: list[str] = []
    numbers: dict[str, float] = {}
    events = tables_of(readings[0], _readings(_read(readings[0], text), numbers))
    events |= dict([_motion(odometry[0], warnings)])
    for truth in truths.values():
        events["truth"] = truth.poses()
    for survey in (one for one in tables.values() if "time" not in one.quantities):
        events["beacon"] = _survey(survey, numbers)
    return Recording(readings[0], name_of(readings[0]), "csv", events, tuple(numbers), tuple(warnings))


def read_survey(file: Path, text: str) -> tuple[list[str], FloatArray, FloatArray]:
    """Names of beacons, their places x, y, z (n, 3), and the standard deviation of each coordinate (n,), NaN if none.

    Raises RadioDataError: it is no table of places.
    """
    header = _header(text)
    if not {"beacon", "x", "y"} <= {column.quantity for column in header if column}:
        raise RadioDataError(file, "has no header with beacon, x and y, so it is no map")
    table = _read(file, text)
    at = table.column_of("beacon") or 0
    names = [cells[at] for _, cells in table.rows]
    if "" in names:
        raise RadioDataError(file, "the place has no name of a beacon", table.rows[names.index("")][0])
    return names, table.values("x", "y", "z").values, table.values("sigma").values[:, 0]


def _texts(folder: Path) -> dict[Path, str]:
    """The texts of a folder that may be tables, by file."""
    texts = {}
    for file in sorted(folder.iterdir()):
        if file.is_file() and {".csv", ".txt", ".tsv"} & {*file.suffixes}:
            with suppress(NotTextError):
                texts[file] = read_text(file)
    return texts


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
    return [_column(cell) for cell in cells]


def _column(header: str) -> Column | None:
    text = header.strip().lower()
    match = UNIT.match(text)
    name, unit = (match["name"], match["bracket"] or match["suffix"] or "") if match else (text, "")
    if unit not in UNITS:
        name, unit = text, ""
    words = name.strip().replace(" ", "_")
    for quantity, names in HEADERS.items():
        if words in names:
            return Column(quantity, "", UNITS.get(unit, 1.0), names.index(words))
    for quantity in READING_KINDS:  # a column of one beacon, as "range A", "dist_A" or "rssi_B [dBm]"
        for synonym in HEADERS[quantity]:
            if len(synonym) > 1 and words.startswith(f"{synonym}_") and words.split("_")[-1] not in OF_QUALITY:
                return Column(quantity, header.strip()[len(synonym) + 1 : len(name)], UNITS.get(unit, 1.0))
    return None


def _read(file: Path, text: str) -> ColumnFile:
    first, header = _first_line(text)
    mark, columns = delimiter_of(header), _header(text)
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
    return ColumnFile(file, columns, rows)


def _is_other_table(text: str) -> bool:
    """Whether the header of a text is that of odometry, a truth or a survey: other files of the folder are not read."""
    quantities = {column.quantity for column in _header(text) if column}
    if is_events_csv(text):
        return False
    return _is_motion(quantities) if "time" in quantities else {"beacon", "x", "y"} <= quantities


def _is_motion(quantities: set[str]) -> bool:
    return {"x", "y"} <= quantities or {"speed", "rate"} <= quantities or {"turn"} <= quantities


def _readings(table: ColumnFile, numbers: dict[str, float]) -> Iterator[tuple[str, int, list[float]]]:
    time, named = table.column_of("time"), table.column_of("beacon")
    readings = [(k, column) for k, column in enumerate(table.columns) if column and column.quantity in READING_KINDS]
    if named is not None:  # beside a column of names, others than "range" itself are no beacons
        readings = [(k, column) for k, column in readings if not column.beacon]
        kinds = [column.quantity for _, column in readings]
        if not kinds or len(set(kinds)) < len(kinds):
            what = "no column" if not kinds else "several columns"
            raise RadioDataError(table.file, f"{what} of a range, bearing or rssi beside the names of the beacons", 1)
    for line, cells in table.rows:
        if time is None or not cells[time]:
            raise RadioDataError(table.file, "the reading has no time", line)
        time_s = table.value(line, cells, time)
        for k, column in readings:
            if not cells[k]:
                continue  # an empty cell: the beacon was not heard
            name = column.beacon if named is None else cells[named]
            if not name:
                raise RadioDataError(table.file, "the reading has no name of a beacon", line)
            yield (
                column.quantity,
                line,
                [time_s, numbers.setdefault(name, float(len(numbers))), table.value(line, cells, k)],
            )


def _motion(table: ColumnFile, warnings: list[str]) -> tuple[str, Table]:
    if {"x", "y"} <= table.quantities:
        if "heading" not in table.quantities and not {"qz", "qw"} <= table.quantities:
            raise RadioDataError(table.file, "odometry with x and y has no heading; give it, or speed and rate", 1)
        poses = true_positions(table.poses(), "odometry", warnings)
        return "odom", motions_between(poses)
    kind, names = ("speed", ("speed", "rate")) if "speed" in table.quantities else ("odom", ("range", "turn"))
    moves = table.values("time", *names, "left")
    if "left" not in table.quantities:
        moves.values[:, 3] = 0.0
    return kind, moves


def _survey(table: ColumnFile, numbers: dict[str, float]) -> Table:
    at = table.column_of("beacon") or 0
    names: FloatArray = np.array([numbers.setdefault(cells[at], float(len(numbers))) for _, cells in table.rows])
    places = table.values("x", "y", "z")
    return places._replace(values=np.column_stack([names, places.values])[:, : len(EVENTS["beacon"])])
