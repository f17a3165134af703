"""Recorded runs as tables with a header: readings by time and beacon in one file, odometry in another beside it."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.beacons.datasets.events import EVENTS, READING_KINDS, Recording, is_events_csv, name_of
from ccatp.beacons.datasets.placeholders import true_positions
from ccatp.beacons.datasets.tables import (
    RadioDataError,
    Table,
    content_lines,
    is_number,
    number,
    read_text,
    split_cells,
    tables_of,
)
from ccatp.beacons.datasets.trajectory import motions_between
from ccatp.core import FloatArray

# Headers of each quantity, in lower case, without unit.
HEADERS = {
    "time": ("time", "t", "timestamp", "stamp", "secs", "seconds"),
    "beacon": ("beacon", "anchor", "anchor_id", "beacon_id", "id", "node", "mote", "address", "landmark"),
    "range": ("range", "distance", "dist", "r"),
    "bearing": ("bearing", "aoa", "azimuth"),
    "rssi": ("rssi", "level"),
    "x": ("x", "pos_x", "position_x", "px"),
    "y": ("y", "pos_y", "position_y", "py"),
    "z": ("z", "pos_z", "position_z", "pz"),
    "heading": ("heading", "yaw", "theta", "phi", "orientation"),
    "speed": ("speed", "v", "vx", "velocity", "linear"),
    "left": ("vy", "lateral_speed"),
    "rate": ("w", "omega", "rate", "yaw_rate", "turn_rate", "wz", "angular"),
    "turn": ("turn", "dtheta", "dyaw", "dphi"),
}
UNITS = {
    "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "ft": 0.3048,
    "rad": 1.0, "deg": np.pi / 180.0, "dbm": 1.0, "m_s": 1.0, "m/s": 1.0, "mm/s": 1e-3, "rad_s": 1.0, "rad/s": 1.0,
    "deg/s": np.pi / 180.0, "deg_s": np.pi / 180.0,
}  # fmt: skip
UNIT = re.compile(r"^(?P<name>.*?)(?:[ _]*[\[(](?P<bracket>[^\])]*)[\])]|_(?P<suffix>m_s|rad_s|deg_s|[a-z]+))?$")
TRUTH_NAME = re.compile(r"truth|gt|ground|reference|mocap", re.IGNORECASE)


class Column(NamedTuple):
    """What a column has: quantity, beacon of a column of one beacon alone, factor to SI units."""

    quantity: str
    beacon: str
    factor: float


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
        at = {column.quantity: (k, column.factor) for k, column in reversed(list(enumerate(self.columns))) if column}
        found = np.full((len(self.rows), len(quantities)), np.nan)
        for row, (line, cells) in enumerate(self.rows):
            for place, quantity in enumerate(quantities):
                k, factor = at.get(quantity, (-1, 1.0))
                if 0 <= k < len(cells) and cells[k]:
                    found[row, place] = factor * number(self.file, line, cells[k], quantity)
        return Table(self.file, found, np.array([line for line, _ in self.rows]))


def is_columns(text: str) -> bool:
    """Whether the header of a text has a time and readings by beacon."""
    if is_events_csv(text):
        return False
    found = {column.quantity for column in _header(text) if column}
    by_beacon = any(column and column.beacon for column in _header(text))
    return "time" in found and bool(found & {*READING_KINDS}) and ("beacon" in found or by_beacon)


def read_columns(path: Path) -> Recording:
    """Read a table of readings, and beside it those of odometry and, if there are, of truth and surveyed beacons.

    ``path``: the table of readings, or a folder with one. Raises RadioDataError: one of the first two is missing.
    """
    folder = path if path.is_dir() else path.parent
    texts = {file: read_text(file) for file in sorted(folder.iterdir()) if _is_text(file)}
    readings = [file for file, text in texts.items() if is_columns(text)] if path.is_dir() else [path]
    if len(readings) != 1:
        raise RadioDataError(path, f"holds {len(readings)} tables of readings: name one; see docs/radio_data.md")
    tables = {file: _read(file, text) for file, text in texts.items() if file not in readings and any(_header(text))}
    tracks = {file: one for file, one in tables.items() if "time" in one.quantities and _is_motion(one)}
    truths = {file: one for file, one in tracks.items() if TRUTH_NAME.search(file.name)}
    odometry = [one for file, one in tracks.items() if file not in truths]
    if len(odometry) != 1 or len(truths) > 1:
        what = f"{len(odometry)} tables of odometry and {len(truths)} of truth"
        raise RadioDataError(
            folder, f"has {what} beside {readings[0].name}: one with time and x, y, heading or speed, rate is needed"
        )
    warnings: list[str] = []
    numbers: dict[str, float] = {}
    events = tables_of(readings[0], _readings(_read(readings[0], read_text(readings[0])), numbers))
    events |= dict([_motion(odometry[0], warnings)])
    for truth in truths.values():
        events["truth"] = truth.values("time", "x", "y", "heading")
    for survey in (one for one in tables.values() if "time" not in one.quantities):
        if {"beacon", "x", "y"} <= survey.quantities:
            events["beacon"] = _survey(survey, numbers)
    return Recording(readings[0], name_of(readings[0]), "csv", events, tuple(numbers), tuple(warnings))


def _is_text(file: Path) -> bool:
    return file.is_file() and bool({".csv", ".txt", ".tsv"} & {*file.suffixes})


def _cells(content: str) -> list[str]:
    mark = next((mark for mark in ",;\t" if mark in content), None)
    return split_cells(content, mark)


def _header(text: str) -> list[Column | None]:
    lines = content_lines(text[:20_000])
    cells = _cells(lines[0][1]) if lines else []
    if not cells or any(is_number(cell) for cell in cells):
        return []
    return [_column(cell) for cell in cells]


def _column(header: str) -> Column | None:
    text = header.strip().lower()
    match = UNIT.match(text)
    name, unit = (match["name"], match["bracket"] or match["suffix"] or "") if match else (text, "")
    if unit not in UNITS:
        name, unit = text, ""
    for quantity, names in HEADERS.items():
        if name in names:
            return Column(quantity, "", UNITS.get(unit, 1.0))
    for quantity in READING_KINDS:  # a column of one beacon, as "range A" or "rssi_B [dBm]"
        if name.startswith((f"{quantity} ", f"{quantity}_")):
            return Column(quantity, header.strip()[len(quantity) + 1 : len(name)], UNITS.get(unit, 1.0))
    return None


def _read(file: Path, text: str) -> ColumnFile:
    rows = [(line, _cells(content)) for line, content in content_lines(text)[1:]]
    if not rows:
        raise RadioDataError(file, "holds no rows below its header")
    return ColumnFile(file, _header(text), rows)


def _is_motion(table: ColumnFile) -> bool:
    return {"x", "y"} <= table.quantities or {"speed", "rate"} <= table.quantities or {"turn"} <= table.quantities


def _readings(table: ColumnFile, numbers: dict[str, float]) -> Iterator[tuple[str, int, list[float]]]:
    by_name = {column.quantity: k for k, column in reversed(list(enumerate(table.columns))) if column}
    time_of = table.columns[by_name["time"]]
    for line, cells in table.rows:
        padded = [*cells, *[""] * (len(table.columns) - len(cells))]
        time_s = (time_of.factor if time_of else 1.0) * number(table.file, line, padded[by_name["time"]], "time")
        for k, column in enumerate(table.columns):
            if column is None or column.quantity not in READING_KINDS or not padded[k]:
                continue  # an empty cell: the beacon was not heard
            name = column.beacon or padded[by_name["beacon"]]
            if not name:
                raise RadioDataError(table.file, "the reading has no name of a beacon", line)
            value = column.factor * number(table.file, line, padded[k], column.quantity)
            yield column.quantity, line, [time_s, numbers.setdefault(name, float(len(numbers))), value]


def _motion(table: ColumnFile, warnings: list[str]) -> tuple[str, Table]:
    if {"x", "y"} <= table.quantities:
        if "heading" not in table.quantities:
            raise RadioDataError(table.file, "odometry with x and y has no heading; give it, or speed and rate", 1)
        poses = true_positions(table.values("time", "x", "y", "heading"), "odometry", warnings)
        return "odom", motions_between(poses)
    kind, names = ("speed", ("speed", "rate")) if "speed" in table.quantities else ("odom", ("range", "turn"))
    moves = table.values("time", *names, "left")
    if "left" not in table.quantities:
        moves.values[:, 3] = 0.0
    return kind, moves


def _survey(table: ColumnFile, numbers: dict[str, float]) -> Table:
    at = next(k for k, column in enumerate(table.columns) if column and column.quantity == "beacon")
    names: FloatArray = np.array([numbers.setdefault(cells[at], float(len(numbers))) for _, cells in table.rows])
    places = table.values("x", "y", "z")
    return places._replace(values=np.column_stack([names, places.values])[:, : len(EVENTS["beacon"])])
