"""Pure. Order and completeness of recorded rows: what is mended, and how it is told."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ccatp.radio_data.text_table import Table
from ccatp.samples import FloatArray

GAP_S = 2.0  # pauses shorter than that are how recorders work,
GAP_RATIO = 20.0  # and so are those of a few usual intervals


def plural(count: int, what: str) -> str:
    """``3 rows``, ``1 row``."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def without_gaps_in_numbers(table: Table, warnings: list[str], columns: int | None = None) -> Table:
    """Rows of finite numbers alone, in the first ``columns`` if given; tells how many others there were, and where."""
    finite = np.isfinite(table.values[:, :columns]).all(axis=1)
    if not finite.all():
        first = int(table.lines[np.flatnonzero(~finite)[0]])
        left_out = plural(int((~finite).sum()), "row")
        warnings.append(f"{table.file.name}:{first}: {left_out} not finite (the first here), left out")
    return Table(table.file, table.values[finite], table.lines[finite])


def in_order(table: Table, warnings: list[str], columns: int | None = None) -> Table:
    """Rows by time (column 0) without repetitions; tells what was out of order or doubled.

    Rows that are the same in every column are one; rows of the same time that differ all stay, in their order.
    """
    table = without_gaps_in_numbers(table, warnings, columns)
    values, lines = table.values, table.lines
    back = np.flatnonzero(np.diff(values[:, 0]) < 0.0)
    if back.size:
        line = int(lines[back[0] + 1])
        warnings.append(
            f"{table.file.name}:{line}: time goes back {plural(back.size, 'time')} (the first here, by "
            f"{values[back[0], 0] - values[back[0] + 1, 0]:.6g} s); rows were sorted by time"
        )
        order = np.argsort(values[:, 0], kind="stable")
        values, lines = values[order], lines[order]
    keep = _first_of_each(values)
    if not keep.all():
        doubled = np.flatnonzero(~keep)
        line = int(lines[doubled[0]])
        warnings.append(f"{table.file.name}:{line}: {plural(doubled.size, 'row')} doubled (the first here), left out")
        values, lines = values[keep], lines[keep]
    return Table(table.file, values, lines)


def _first_of_each(values: FloatArray) -> npt.NDArray[np.bool_]:
    """Rows that repeat no other row of the same time (rows are sorted by time)."""
    keep = np.ones(len(values), dtype=bool)
    same_time = np.flatnonzero(np.diff(values[:, 0]) == 0.0) + 1
    for row in same_time.tolist():
        k = row - 1
        while k >= 0 and values[k, 0] == values[row, 0]:
            if np.array_equal(values[k], values[row], equal_nan=True):
                keep[row] = False
                break
            k -= 1
    return keep


def names_of(ids: FloatArray) -> tuple[tuple[str, ...], npt.NDArray[np.int64]]:
    """Names of beacons and the index of each row into them, from a column of whole numbers."""
    unique, index = np.unique(ids.astype(np.int64), return_inverse=True)
    return tuple(str(i) for i in unique.tolist()), index.astype(np.int64)


def within(times_s: FloatArray, span_s: tuple[float, float], what: str, warnings: list[str]) -> npt.NDArray[np.bool_]:
    """Which of the times lie in the span of the odometry; tells how many do not."""
    inside = (times_s >= span_s[0]) & (times_s <= span_s[1])
    if not inside.all():
        warnings.append(f"{plural(int((~inside).sum()), what)} before the first or after the last odometry, left out")
    return np.asarray(inside)


def listed(names: Sequence[str], most: int = 8) -> str:
    """``6, 7, 8``, shortened where there are many."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def long_pauses(times_s: FloatArray, least_s: float = GAP_S) -> npt.NDArray[np.int64]:
    """Where a recording pauses: the rows after which nothing comes for longer than is usual."""
    pauses = np.diff(times_s)
    if not (pauses > 0.0).any():
        return np.empty(0, dtype=np.int64)
    usual_s = float(np.median(pauses[pauses > 0.0]))
    return np.asarray(np.flatnonzero(pauses > max(least_s, GAP_RATIO * usual_s)), dtype=np.int64)


def with_unknown_ways(table: Table, warnings: list[str]) -> Table:
    """Odometry by increments: rows with a time and no finite way keep the time, the way is NaN; tells how many."""
    dumb = np.isfinite(table.values[:, 0]) & ~np.isfinite(table.values).all(axis=1)
    if not dumb.any():
        return table
    first = int(table.lines[np.flatnonzero(dumb)[0]])
    warnings.append(
        f"{table.file.name}:{first}: {plural(int(dumb.sum()), 'row')} not finite (the first here): the way there is "
        "guessed by the speed before"
    )
    values = table.values.copy()
    values[dumb, 1:] = np.nan
    return Table(table.file, values, table.lines)
