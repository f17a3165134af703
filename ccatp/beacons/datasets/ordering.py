"""Order of time in the tables of a recording: clocks that were set, rows out of order, doubled rows, equal times."""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from ccatp.beacons.datasets.events import MOTIONS, READING_KINDS
from ccatp.beacons.datasets.tables import RadioDataError, Table, instant, plural
from ccatp.core import FloatArray

LONGEST_PAUSE_S = 3600.0  # of the odometry; a longer one means that the clock was set
TIMED = (*MOTIONS, *READING_KINDS, "truth")
# Times between 1973 and 5138 in these units; in s, they would be later than the year 5138.
EPOCHS = (
    (1e11, 1e14, 1e-3, "milliseconds"),
    (1e14, 1e17, 1e-6, "microseconds"),
    (1e17, 1e20, 1e-9, "nanoseconds"),
)
LEAST_OVERLAP = 3  # rows on each side whose times interleave after a clock was set back
ASCENDING = 0.8  # share of ascending rows on both sides of it; shuffled rows have half
NEAR = 20  # rows on each side that are looked at
MOST_SETS = 50  # backward steps that are looked at, the largest first


def ordered(tables: Mapping[str, Table], warnings: list[str]) -> dict[str, Table]:
    """Tables by kind of event, each sorted by time, of one clock, without doubled rows.

    A clock that was set divides the recording into parts, of which one is kept: if it was set back, the one with the
    longest time of odometry; if forward, the one with most rows of it. Motions of equal times are added up; of equal
    times of truth, poses or speeds the last row counts. Rows must be finite, except for motions that are unknown.
    """
    found = dict(tables)
    motion = next((kind for kind in MOTIONS if kind in found), "")
    if motion:
        found = _of_one_clock(found, motion, warnings)
    found = {kind: in_order(table, warnings) if kind in TIMED else table for kind, table in found.items()}
    if motion:
        found[motion] = _without_jumps(found[motion], warnings)
        found[motion] = _of_distinct_times(found[motion], "odometry", warnings, adds_up=motion == "odom")
    if "truth" in found:
        found["truth"] = _of_distinct_times(found["truth"], "truth", warnings, adds_up=False)
    return found


def in_seconds(table: Table, warnings: list[str]) -> Table:
    """The rows with times in seconds, if they are in milli-, micro- or nanoseconds since 1970.

    ``table``: times in the first column.
    """
    if not len(table.values):
        return table
    with np.errstate(all="ignore"):
        usual = float(np.nanmedian(table.values[:, 0]))
    for least, most, factor, unit in EPOCHS:
        if least < usual < most:
            warnings.append(f"{table.file.name}: times of {usual:.4g} are taken as {unit} since 1970")
            return table._replace(values=np.column_stack([factor * table.values[:, 0], table.values[:, 1:]]))
    return table


def in_order(table: Table, warnings: list[str]) -> Table:
    """The rows sorted by time (column 0) without duplicates; warns of unsorted and duplicate rows.

    Rows that are equal in every column count once; different rows of the same time all stay, in their order.
    """
    file, values, lines = table
    back = np.flatnonzero(np.diff(values[:, 0]) < 0.0)
    if back.size:
        warnings.append(
            f"{file.name}:{int(lines[back[0] + 1])}: time goes back {plural(back.size, 'time')} (the first here, by "
            f"{values[back[0], 0] - values[back[0] + 1, 0]:.6g} s); rows were sorted by time"
        )
        order = np.argsort(values[:, 0], kind="stable")
        values, lines = values[order], lines[order]
    keep = np.ones(len(values), dtype=bool)
    for row in (np.flatnonzero(np.diff(values[:, 0]) == 0.0) + 1).tolist():
        first = int(np.searchsorted(values[:, 0], values[row, 0]))
        keep[row] = not any(np.array_equal(values[k], values[row], equal_nan=True) for k in range(first, row))
    if not keep.all():
        warnings.append(Table(file, values, lines).note(~keep, "doubled (the first here), not used"))
    return Table(file, values[keep], lines[keep])


def clock_sets(times_s: FloatArray) -> list[int]:
    """First rows after each time that the clock was set back.

    There, rows ascend before and after, and times of both sides interleave. A late or moved block of rows interleaves
    with none; shuffled rows do not ascend.
    """
    drops = np.diff(times_s)
    backward = np.flatnonzero(drops < 0.0)
    largest = backward[np.argsort(drops[backward], kind="stable")[:MOST_SETS]]
    found: list[int] = []
    for row in sorted((largest + 1).tolist()):
        before, after = times_s[found[-1] if found else 0 : row], times_s[row:]
        over, under = before[before > after[0]], after[after < before[-1]]
        if min(over.size, under.size) < LEAST_OVERLAP or over.min() >= under.max():
            continue
        if all(np.mean(np.diff(side) > 0.0) >= ASCENDING for side in (before[-NEAR:], after[:NEAR]) if side.size > 1):
            found.append(row)
    return found


def _of_one_clock(tables: dict[str, Table], motion: str, warnings: list[str]) -> dict[str, Table]:
    odometry = tables[motion]
    all_sets = {kind: clock_sets(tables[kind].values[:, 0]) for kind in TIMED if kind in tables}
    sets = all_sets[motion]
    parts = _parts(sets, len(odometry.values))
    kept = int(np.argmax([np.ptp(odometry.values[part, 0]) for part in parts]))
    found = dict(tables)
    for kind, own in all_sets.items():
        table = tables[kind]
        cuts = _at_lines(table, odometry, sets) or own
        own_parts = _parts(cuts, len(table.values))
        if len(own_parts) == 1:
            continue
        spans_s = [np.ptp(table.values[part, 0]) for part in own_parts]
        part = kept if len(cuts) == len(sets) else int(np.argmax(spans_s))
        found[kind] = Table(table.file, table.values[own_parts[part]], table.lines[own_parts[part]])
        for row in own:
            warnings.append(
                f"{table.file.name}:{int(table.lines[row])}: {kind}: the clock was set back by "
                f"{table.values[row - 1, 0] - table.values[row, 0]:.6g} s at {instant(table.values[row - 1, 0])}: of "
                f"{len(own_parts)} parts only the one of {spans_s[part]:.6g} s from "
                f"{instant(table.values[own_parts[part], 0].min())} on is used"
            )
    return found


def _at_lines(table: Table, odometry: Table, sets: list[int]) -> list[int]:
    """Rows at which the clock of the odometry was set, if the table is of the same file and continues there."""
    if table.file != odometry.file:
        return []
    cuts = np.searchsorted(table.lines, odometry.lines[sets]).tolist()
    edges = [0, *cuts, len(table.lines)]
    return cuts if all(first < stop for first, stop in pairwise(edges)) else []


def _parts(sets: list[int], count: int) -> list[slice]:
    return [slice(first, stop) for first, stop in zip([0, *sets], [*sets, count], strict=True)]


def _without_jumps(odometry: Table, warnings: list[str]) -> Table:
    """The part with most rows of the odometry without a pause of an hour, which is a clock that was set forward."""
    t = odometry.values[:, 0]
    with np.errstate(all="ignore"):
        pauses_s = np.diff(t)
    if not pauses_s.size:
        return odometry
    if (usual_s := float(np.median(pauses_s))) > LONGEST_PAUSE_S:
        unit = "nanoseconds" if usual_s > 1e6 else "microseconds"
        raise RadioDataError(odometry.file, f"odometry comes every {usual_s:.3g} s: are its times in {unit}?")
    jumps = (np.flatnonzero(~(pauses_s <= LONGEST_PAUSE_S)) + 1).tolist()
    if not jumps:
        return odometry
    parts = _parts(jumps, len(t))
    longest = max(parts, key=lambda part: part.stop - part.start)
    line = int(odometry.lines[jumps[0]])
    warnings.append(
        f"{odometry.file.name}:{line}: odometry pauses for {pauses_s[jumps[0] - 1]:.3g} s at "
        f"{instant(t[jumps[0] - 1])}: was the clock set? Only the part with most rows is used, "
        f"{plural(longest.stop - longest.start, 'row')} of {len(t)} from {instant(t[longest.start])} on"
    )
    return Table(odometry.file, odometry.values[longest], odometry.lines[longest])


def _of_distinct_times(table: Table, what: str, warnings: list[str], *, adds_up: bool) -> Table:
    t = table.values[:, 0]
    later = np.concatenate([np.diff(t) > 0.0, [True]])  # the last row of its time
    if later.all():
        return table
    how = "added up" if adds_up else "the last one counts"
    warnings.append(table.note(~later, f"of {what} of the same time as the next (the first here), {how}"))
    values = table.values[later]
    if adds_up:
        first = np.concatenate([[0], np.flatnonzero(later)[:-1] + 1])
        values[:, 1:] = np.add.reduceat(table.values[:, 1:], first, axis=0)
    return Table(table.file, values, table.lines[later])
