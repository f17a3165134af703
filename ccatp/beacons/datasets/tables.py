"""Tables of numbers in text files, plain or gzipped: comments skipped, each fault told with file and line.

What is wrong with a recorded data set: one line that names the file and, where there is one, the line.

Order and completeness of recorded rows: what is mended, and how it is told.

Numbers that no vehicle and no radio gives: refused, or left out and told, before anything uses them.

Steps of which the odometry tells nothing: what the vehicle most likely did, and how far that may be off.
"""

import gzip
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ccatp.beacons.slam.recording import Readings, RecordedRun, Steps
from ccatp.core import FloatArray
from ccatp.errors import CcatpError, ExitStatus


class RadioDataError(CcatpError):
    """A recorded data set that cannot be used.

    Args:
        line: number of the line, from 1, where it is a line's fault.
    """

    exit_status = ExitStatus.USAGE

    def __init__(self, where: Path | str, problem: str, line: int | None = None) -> None:
        super().__init__(f"{where}:{line}: {problem}" if line is not None else f"{where}: {problem}")


GZIP_MAGIC = b"\x1f\x8b"
COMMENTS = ("#", "%", "//")


class Table(NamedTuple):
    """Rows of numbers and where they stood.

    Args:
        values: shape (n, columns).
        lines: number of the line of each row, from 1, shape (n,).
    """

    file: Path
    values: FloatArray
    lines: npt.NDArray[np.int64]


def read_text(file: Path, wanted: str = "a data set of the formats plaza, mrclam, labyrinth or csv") -> str:
    """The text of a file, unpacked if it is gzipped, whatever its name.

    Raises:
        RadioDataError: it is missing, cannot be read, or is no text.
    """
    try:
        data = file.read_bytes()
        if data.startswith(GZIP_MAGIC):
            data = gzip.decompress(data)
        return data.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise RadioDataError(file, "no such file") from error
    except (OSError, EOFError, zlib.error) as error:
        raise RadioDataError(file, f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    except UnicodeDecodeError as error:
        raise RadioDataError(file, f"is not text; give {wanted}") from error


def content_lines(text: str) -> list[tuple[int, str]]:
    """Number, from 1, and content of the lines that are neither empty nor a comment."""
    stripped = ((number, line.strip()) for number, line in enumerate(text.splitlines(), 1))
    return [(number, line) for number, line in stripped if line and not line.startswith(COMMENTS)]


def number(file: Path, line: int, text: str, what: str) -> float:
    """A number, which may be NaN or infinite: who reads rows leaves those out and says so.

    Raises:
        RadioDataError: it is none.
    """
    try:
        return float(text)
    except ValueError as error:
        raise RadioDataError(file, f"{what} is {text!r}, not a number", line) from error


def read_table(file: Path, names: tuple[str, ...], *, more: bool = False) -> Table:
    """A table of numbers between white space or commas; a first line of words is a header.

    Args:
        more: further columns are allowed, and left out.

    Raises:
        RadioDataError: the file cannot be read, has no rows, or a row is not ``names``.
    """
    rows: list[list[float]] = []
    lines: list[int] = []
    for line, content in content_lines(read_text(file)):
        words = content.replace(",", " ").split()
        if not rows and not any(is_number(word) for word in words):
            continue  # a header without a comment sign
        if len(words) != len(names) and not (more and len(words) > len(names)):
            raise RadioDataError(file, f"{len(words)} columns, wanted {len(names)}: {', '.join(names)}", line)
        rows.append([number(file, line, word, name) for word, name in zip(words, names, strict=False)])
        lines.append(line)
    if not rows:
        raise RadioDataError(file, f"no rows; wanted lines of {', '.join(names)}")
    return Table(file, np.array(rows), np.array(lines, dtype=np.int64))


def is_number(text: str) -> bool:
    """Whether a cell holds one."""
    try:
        float(text)
    except ValueError:
        return False
    return True


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


LONGEST_RUN_S = 1e8  # three years
LONGEST_STEP_M = 1e3  # between two rows of odometry
LARGEST_TURN_RAD = 1e4  # likewise; degrees for radians stay far below it, and are told elsewhere
LONGEST_RANGE_M = 1e6
LARGEST_BEARING_RAD = 1e4
LARGEST_LEVEL_DBM = 1e3
FARTHEST_M = 1e8  # of coordinates; those of maps reach 1e7


def bounded(run: RecordedRun, where: Path) -> RecordedRun:
    """The run without readings and surveyed places that cannot be; each kind that was left out makes a warning.

    Odometry and truth are refused as a whole: without one of its steps a path leads elsewhere.

    Raises:
        RadioDataError: odometry or truth cannot be, or no reading is left.
    """
    steps, truth = run.steps, run.truth
    _refuse(where, "time of odometry", steps.times_s - steps.times_s[0], LONGEST_RUN_S, "s after its first row")
    for what, column in (("forward", steps.distance_m), ("to the left", steps.lateral_m)):
        _refuse(where, f"odometry: a step {what}", column, LONGEST_STEP_M, "m", steps.times_s[1:])
    _refuse(where, "odometry: a turn", steps.turn_rad, LARGEST_TURN_RAD, "rad", steps.times_s[1:])
    if truth is not None:
        for name, column in (("x", truth.x_m), ("y", truth.y_m)):
            _refuse(where, f"truth: {name}", column, FARTHEST_M, "m", truth.times_s)
    warnings = list(run.warnings)
    readings = _sensible(run.readings, warnings)
    if not len(readings.times_s):
        raise RadioDataError(where, f"none of its readings can be ({'; '.join(warnings[len(run.warnings) :])})")
    placed = {
        name: place_m
        for name, place_m in run.beacon_truth_m.items()
        if all(abs(axis_m) <= FARTHEST_M for axis_m in place_m)
    }
    if lost := [name for name in run.beacon_truth_m if name not in placed]:
        warnings.append(f"surveyed place of {', '.join(lost)}: is no place within {FARTHEST_M:g} m, left out")
    return replace(run, readings=readings, beacon_truth_m=placed, warnings=tuple(warnings))


def _refuse(
    where: Path, what: str, values: FloatArray, most: float, unit: str, times_s: FloatArray | None = None
) -> None:
    beyond = np.flatnonzero(~(np.abs(values) <= most))
    if beyond.size:
        first = int(beyond[0])
        at = "" if times_s is None else f" at {times_s[first]:.6g} s"
        raise RadioDataError(where, f"{what} of {values[first]:.3g} {unit}{at} cannot be; at most {most:g} is taken")


def _sensible(readings: Readings, warnings: list[str]) -> Readings:
    columns = {}
    for field, what, most, unit in (
        ("range_m", "range", LONGEST_RANGE_M, "m"),
        ("bearing_rad", "bearing", LARGEST_BEARING_RAD, "rad"),
        ("rssi_dbm", "signal strength", LARGEST_LEVEL_DBM, "dBm"),
    ):
        column: FloatArray = getattr(readings, field)
        beyond = ~(np.abs(column) <= most) & ~np.isnan(column)
        if beyond.any():
            first = int(np.flatnonzero(beyond)[0])
            warnings.append(
                f"{plural(int(beyond.sum()), what)} beyond {most:g} {unit}, the first {column[first]:.3g} {unit} at "
                f"{readings.times_s[first]:.6g} s, left out"
            )
            columns[field] = np.where(beyond, np.nan, column)
    if not columns:
        return readings
    cleaned = readings._replace(**columns)
    known = np.asarray(
        np.isfinite(np.column_stack([cleaned.range_m, cleaned.bearing_rad, cleaned.rssi_dbm])).any(axis=1)
    )
    return cleaned.where(known)


BEFORE_S = 1.0  # over so long the speed before a gap is taken
WINDOWS = 1000  # spans of the run by which speeds are compared with those before
LOST_RAD = float(np.pi / np.sqrt(3.0))  # standard deviation of a heading that is anything: more cannot be unknown


class _Guess(NamedTuple):
    share: float
    sigma: float


def bridged(steps: Steps) -> Steps:
    """Steps without gaps: ways and turns that are NaN, or span a pause of the recording, are guessed.

    A vehicle goes on as it did. How much so, and how far that is off, the run tells itself: by the least-squares ratio,
    over all spans as long as the gap, of what was travelled to the rate in the ``BEFORE_S`` before. If the heading is
    lost by sigma, the mean of the way is shorter by exp(-sigma^2 / 2), and the rest of it is spread about that.
    """
    interval_s = np.diff(steps.times_s)
    unknown = np.isnan(steps.distance_m + steps.turn_rad + steps.lateral_m)
    unknown[long_pauses(steps.times_s)] = True
    if not unknown.any() or unknown.all():
        return steps
    known_s = np.concatenate([[0.0], np.cumsum(interval_s[~unknown])])
    way, turn = (np.concatenate([[0.0], np.cumsum(c[~unknown])]) for c in (steps.distance_m, steps.turn_rad))
    distance_m, turn_rad, lateral_m = steps.distance_m.copy(), steps.turn_rad.copy(), steps.lateral_m.copy()
    guess_m2, guess_rad2 = np.zeros(unknown.size), np.zeros(unknown.size)
    for first, stop in _runs(unknown):
        span_s = float(interval_s[first:stop].sum())
        begin_s = float(interval_s[:first][~unknown[:first]].sum())
        by_way, by_turn = _guessed(known_s, way, span_s), _guessed(known_s, turn, span_s)
        lost_rad = min(by_turn.sigma, LOST_RAD)
        kept = float(np.exp(-0.5 * lost_rad**2))
        went_m = by_way.share * _rate_before(known_s, way, begin_s) * span_s
        part = interval_s[first:stop] / span_s
        distance_m[first:stop] = kept * went_m * part
        turn_rad[first:stop] = by_turn.share * _rate_before(known_s, turn, begin_s) * span_s * part
        lateral_m[first:stop] = 0.0
        guess_m2[first:stop] = (by_way.sigma * by_way.sigma + went_m * went_m * (1.0 - kept * kept)) * part
        guess_rad2[first:stop] = lost_rad**2 * part
    return Steps(steps.times_s, distance_m, turn_rad, lateral_m, guess_m2, guess_rad2)


def _runs(marked: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _rate_before(times_s: FloatArray, total: FloatArray, at_s: float) -> float:
    from_s = max(at_s - BEFORE_S, float(times_s[0]))
    if at_s <= from_s:
        return 0.0
    begin, end = np.interp((from_s, at_s), times_s, total).tolist()
    return float((end - begin) / (at_s - from_s))


def _guessed(times_s: FloatArray, total: FloatArray, span_s: float) -> _Guess:
    whole_s = float(times_s[-1] - times_s[0])
    before_s, seen_s = min(BEFORE_S, 0.25 * whole_s), min(span_s, 0.5 * whole_s)
    t = np.linspace(times_s[0] + before_s, times_s[-1] - seen_s, WINDOWS)
    at, later, sooner = (np.interp(t + shift, times_s, total) for shift in (0.0, seen_s, -before_s))
    rate, went = (at - sooner) / before_s, (later - at) / seen_s
    square = float(rate @ rate)
    share = float(rate @ went) / square if square > 0.0 else 0.0
    return _Guess(share, float(np.sqrt(np.mean((went - share * rate) ** 2))) * span_s)
