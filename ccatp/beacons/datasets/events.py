"""What the files of a run say, as tables of events in SI units: the common form of all formats before any check."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.beacons.datasets.tables import (
    RadioDataError,
    Table,
    content_lines,
    delimiter_of,
    is_number,
    read_text,
    split_cells,
    tables_of,
    tagged_row,
)

# Columns after the name of the event; see docs/radio_data.md.
EVENTS = {
    "odom": ("time_s", "distance_m", "turn_rad", "(lateral_m)"),
    "speed": ("time_s", "speed_m_s", "turn_rad_s", "(lateral_m_s)"),
    "pose": ("time_s", "x_m", "y_m", "heading_rad"),
    "range": ("time_s", "beacon", "range_m", "(tag)"),
    "bearing": ("time_s", "beacon", "bearing_rad", "(tag)"),
    "rssi": ("time_s", "beacon", "rssi_dbm", "(tag)"),
    "truth": ("time_s", "x_m", "y_m", "(heading_rad)"),
    "beacon": ("beacon", "x_m", "y_m", "(z_m)"),
    "antenna": ("forward_m", "left_m", "(up_m)"),
    "tag": ("tag", "forward_m", "left_m", "(up_m)"),
}
MOTIONS = ("odom", "speed", "pose")  # of several, the first there is used
READING_KINDS = ("range", "bearing", "rssi")
HEADER = "event"


class Recording(NamedTuple):
    """A run as its files have it: no row is sorted, left out or changed."""

    file: Path  # that messages name
    name: str
    kind: str  # the section of the configuration: plaza, mrclam, labyrinth or csv
    # By kind of event, with the columns of ``EVENTS``; a beacon is an index of ``names``, a tag of ``tags``. Readings
    # may lack the column of the tag.
    tables: Mapping[str, Table]
    names: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    tags: tuple[str, ...] = ()  # radios of the vehicle that readings and places name


def name_of(file: Path) -> str:
    """The name of a run: that of its file without suffixes."""
    return file.name.split(".")[0]


def numbered(table: Table, beacon: int, columns: tuple[int, ...]) -> tuple[tuple[str, ...], dict[int, Table]]:
    """Names of the beacons that a column has as numbers, and for each of ``columns`` a table of readings."""
    ids, index = np.unique(table.values[:, beacon], return_inverse=True)
    rows = {
        column: Table(table.file, np.column_stack([table.values[:, 0], index, table.values[:, column]]), table.lines)
        for column in columns
    }
    return tuple(str(int(one)) for one in ids.tolist()), rows


def surveyed(places: Table, names: tuple[str, ...]) -> tuple[tuple[str, ...], Table]:
    """Names with those that are only surveyed, and the events ``beacon`` of a table of number, x and y."""
    file, values, lines = places
    own = [str(int(one)) for one in values[:, 0].tolist()]
    every = (*names, *(one for one in dict.fromkeys(own) if one not in names))
    index = [float(every.index(one)) for one in own]
    return every, Table(file, np.column_stack([index, values[:, 1:], np.full(len(own), np.nan)]), lines)


def is_events_csv(text: str) -> bool:
    """Whether the first line of a text is an event or the header, or the second line, if the first has only words."""
    lines = [cells for _, cells in _rows(text[:4096])[:2]]
    if lines and not any(is_number(cell) for cell in lines[0]):
        return any(cells[0] == HEADER for cells in lines) or any(cells[0] in EVENTS for cells in lines[1:])
    return bool(lines) and lines[0][0] in EVENTS


def _rows(text: str) -> list[tuple[int, list[str]]]:
    """Line number and cells of each line; the first line tells the delimiter."""
    lines = content_lines(text)
    delimiter = delimiter_of(lines[0][1]) if lines else None
    return [(line, split_cells(content, delimiter)) for line, content in lines]


def read_events_csv(file: Path) -> Recording:
    """Read a CSV of events (docs/radio_data.md), plain or gzipped. Raises RadioDataError: a line is not an event."""
    if file.is_dir():
        raise RadioDataError(file, "is a folder: name the CSV file in it")
    numbers: dict[str, float] = {}
    tags: dict[str, float] = {}
    rows: list[tuple[str, int, list[float]]] = []
    for line, cells in _rows(read_text(file)):
        is_head = not rows and cells[0] not in EVENTS and not any(is_number(cell) for cell in cells[1:])
        if cells[0] != HEADER and not is_head:
            rows.append(tagged_row(file, line, cells, EVENTS, numbers, tags))
    return Recording(file, name_of(file), "csv", tables_of(file, rows), tuple(numbers), tags=tuple(tags))
