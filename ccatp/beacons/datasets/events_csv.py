"""The CSV of our own: an event a line, for recordings of any vehicle among any beacons."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ccatp.beacons.datasets.tables import (
    RadioDataError,
    Table,
    content_lines,
    in_order,
    is_number,
    number,
    plural,
    read_text,
    tables_of,
    with_unknown_ways,
    within,
)
from ccatp.beacons.datasets.trajectory import bridged, checked_heading, recorded_run
from ccatp.beacons.slam.recording import Readings, RecordedRun, ReferencePath, Steps

# Columns after the event's name; those in parentheses may be missing. "beacon" is a name, all others are numbers.
EVENTS = {
    "odom": ("time_s", "distance_m", "turn_rad", "(lateral_m)"),
    "range": ("time_s", "beacon", "range_m"),
    "bearing": ("time_s", "beacon", "bearing_rad"),
    "rssi": ("time_s", "beacon", "rssi_dbm"),
    "truth": ("time_s", "x_m", "y_m", "(heading_rad)"),
    "beacon": ("beacon", "x_m", "y_m"),
}
HEARD = ("range", "bearing", "rssi")
HEADER = "event"
NEEDED = {kind: sum(not column.startswith("(") for column in columns) for kind, columns in EVENTS.items()}


def is_events_csv(text: str) -> bool:
    """Whether the text's first line, or the second below one of words, is an event or the header."""
    lines = [_cells(content) for _, content in content_lines(text[:4096])[:2]]
    if lines and not any(is_number(cell) for cell in lines[0]):
        return any(cells[0] in (*EVENTS, HEADER) for cells in lines)
    return bool(lines) and lines[0][0] in EVENTS


def _cells(content: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([content], skipinitialspace=True))]


def read_events_csv(file: Path) -> RecordedRun:
    """Read a run from a CSV of events (docs/radio_data.md), plain or gzipped.

    Raises:
        RadioDataError: a line is no event, or there is no odometry or no reading of a beacon.
    """
    if file.is_dir():
        raise RadioDataError(file, "is a folder: name the CSV file in it")
    names: dict[str, float] = {}
    warnings: list[str] = []
    tables = tables_of(file, _rows(file, names))
    surveyed = tables.pop("beacon", None)
    needed = dict(NEEDED)
    if "odom" in tables:
        tables["odom"], needed["odom"] = with_unknown_ways(tables["odom"], warnings), 1
    tables = {kind: in_order(table, warnings, needed[kind]) for kind, table in tables.items()}
    if "odom" not in tables:
        raise RadioDataError(file, f"no event odom ({', '.join(EVENTS['odom'])})")
    if not any(kind in tables for kind in HEARD):
        raise RadioDataError(file, f"nothing heard of beacons: no event {', '.join(HEARD)}")
    steps = _steps(tables["odom"])
    beacon_ids = tuple(names)
    readings, heard_ids = _readings(tables, steps, beacon_ids, warnings)
    if not heard_ids:
        raise RadioDataError(file, "nothing was heard of beacons within the time of the odometry")
    truth = _truth(tables["truth"], steps, warnings) if "truth" in tables else None
    places_m = _surveyed(surveyed, beacon_ids)
    return recorded_run(file.name.split(".")[0], "csv", steps, readings, heard_ids, places_m, truth, warnings)


def _truth(table: Table, steps: Steps, warnings: list[str]) -> ReferencePath:
    t, x, y, heading = table.values.T
    known = np.isfinite(heading)
    if known.any() and not known.all():
        count = plural(int((~known).sum()), "row")
        warnings.append(
            f"{table.file.name}:{table.first_line(~known)}: {count} of truth without heading (the first here): no "
            "heading is used"
        )
    whole = np.unwrap(heading) if known.all() else np.full(len(t), np.nan)
    return checked_heading(ReferencePath(t, x, y, whole), steps, warnings)


def _rows(file: Path, names: dict[str, float]) -> Iterator[tuple[str, int, list[float]]]:
    is_first = True
    for line, content in content_lines(read_text(file)):
        kind, *words = _cells(content)
        if kind == HEADER or (is_first and kind not in EVENTS and not any(is_number(word) for word in words)):
            continue
        if kind not in EVENTS:
            raise RadioDataError(file, f"no event {kind!r}; there are {', '.join(EVENTS)}", line)
        yield kind, line, _row(file, line, kind, words, names)
        is_first = False


def _row(file: Path, line: int, kind: str, words: Sequence[str], names: dict[str, float]) -> list[float]:
    columns = EVENTS[kind]
    while words and not words[-1] and len(words) > 1:
        words = words[:-1]  # empty cells at the end, as spreadsheets write them
    if not NEEDED[kind] <= len(words) <= len(columns):
        raise RadioDataError(file, f"{len(words)} values after {kind}, wanted {', '.join(columns)}", line)
    if "beacon" in columns and not words[columns.index("beacon")]:
        raise RadioDataError(file, f"{kind} has no name of a beacon", line)
    values = [
        names.setdefault(word, float(len(names)))
        if column == "beacon"
        else number(file, line, word, column.strip("()"))
        for word, column in zip(words, columns, strict=False)
    ]
    missing = 0.0 if kind == "odom" else np.nan  # no travel sideways; heading unknown
    return values + [missing] * (len(columns) - len(values))


def _surveyed(table: Table | None, beacon_ids: Sequence[str]) -> dict[str, tuple[float, float]]:
    places: dict[str, tuple[float, float]] = {}
    if table is None:
        return places
    for line, (index, x_m, y_m) in zip(table.lines.tolist(), table.values.tolist(), strict=True):
        name = beacon_ids[int(index)]
        if places.setdefault(name, (x_m, y_m)) != (x_m, y_m):
            raise RadioDataError(table.file, f"beacon {name} was surveyed at another place before", line)
    return places


def _steps(odometry: Table) -> Steps:
    # Each row is the way since the row before; of the first row only its time counts.
    t, distance, turn, lateral = odometry.values.T
    odometry.check_steps("events odom")
    if (np.diff(t) <= 0.0).any():
        line = int(odometry.lines[1:][np.diff(t) <= 0.0][0])
        raise RadioDataError(odometry.file, "two events odom at the same time say different things", line)
    return bridged(Steps(t, distance[1:], turn[1:], lateral[1:]))


def _readings(
    tables: dict[str, Table], steps: Steps, beacon_ids: Sequence[str], warnings: list[str]
) -> tuple[Readings, tuple[str, ...]]:
    """Readings, with range, bearing and strength of the same time and beacon in one row, and the beacons' names."""
    merged: dict[tuple[float, float], list[float]] = {}
    extra: list[tuple[float, float, list[float]]] = []
    for place, kind in enumerate(HEARD):
        if kind not in tables:
            continue
        values = tables[kind].values
        for t, who, value in values[within(values[:, 0], steps.times_s, kind, warnings)].tolist():
            row = merged.setdefault((t, who), [np.nan] * len(HEARD))
            if np.isnan(row[place]):
                row[place] = value
            else:  # twice at the same time
                extra.append((t, who, [value if k == place else np.nan for k in range(len(HEARD))]))
    rows = sorted([(t, who, row) for (t, who), row in merged.items()] + extra, key=lambda item: item[:2])
    heard, index = np.unique([int(who) for _, who, _ in rows], return_inverse=True)
    data = np.array([row for _, _, row in rows]).reshape(-1, len(HEARD))
    readings = Readings(np.array([t for t, _, _ in rows]), index.astype(np.int64), *data.T.copy())
    return readings, tuple(beacon_ids[int(who)] for who in heard)
