"""Tables of numbers in text files, plain or gzipped; errors name file and line; checks of order and completeness."""

import codecs
import csv
import gzip
import io
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.beacons.estimation.recording import BoolArray
from ccatp.config.files import read_input
from ccatp.core import FloatArray, IntArray
from ccatp.errors import CcatpError, ExitStatus


class RadioDataError(CcatpError):
    """A data set that cannot be used: file, line number from 1, problem."""

    exit_status = ExitStatus.USAGE

    def __init__(self, where: Path | str, problem: str, line: int | None = None) -> None:
        super().__init__(f"{where}:{line}: {problem}" if line is not None else f"{where}: {problem}")

    def with_page(self) -> "RadioDataError":
        """The same, and that ``PAGE`` describes what can be read."""
        self.args = (f"{self} (see {PAGE})",)
        return self


class NotTextError(RadioDataError):
    """A file that is not text."""


PAGE = "docs/radio_data.md"
MOST_DATA_BYTES = 50_000_000  # against decompression bombs; the longest known recording has 10 MB
LONGEST_ROW = 20_000  # characters
GZIP_MAGIC = b"\x1f\x8b"
UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1f]")  # bytes that no text of one byte a character has
COMMENTS = ("#", "%", "//")
DELIMITERS = ";\t,"  # of cells, in this order: beside another one, a comma is the decimal mark
WHOLE = re.compile(r"\d+\.0+")
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
UNOMITTABLE = ("time_s", "time [s]", "x_m", "y_m", "forward_m", "left_m")  # columns that no cell may leave empty
GAP_S = 2.0  # shorter pauses are normal for recorders,
GAP_RATIO = 20.0  # and so are pauses of fewer usual intervals


def plural(count: int, what: str) -> str:
    """``3 rows``, ``1 row``."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def read_text(file: Path, wanted: str = "a recording as text, or a ROS bag") -> str:
    """The text of a file: UTF-8, UTF-16 with its mark, or Windows-1252; a gzipped file, of any name, is unpacked.

    Raises RadioDataError: it is missing, cannot be read, is too long, or is not text.
    """
    try:
        data = read_input(file, MOST_DATA_BYTES)
        if data.startswith(GZIP_MAGIC):
            data = gzip.GzipFile(fileobj=io.BytesIO(data)).read(MOST_DATA_BYTES + 1)
            if len(data) > MOST_DATA_BYTES:
                raise RadioDataError(file, f"holds more than {MOST_DATA_BYTES} bytes once unpacked")
        text = _decoded(data)
    except FileNotFoundError as error:
        raise RadioDataError(file, "no such file") from error
    except (OSError, EOFError, zlib.error) as error:
        raise RadioDataError(file, f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    except UnicodeDecodeError as error:
        raise NotTextError(file, f"is not text; give {wanted}") from error
    for line, content in enumerate(text.splitlines(), 1):
        if "\0" in content:
            raise NotTextError(file, f"is not text; give {wanted}", line)  # NUL characters, as after a power cut
        if len(content) > LONGEST_ROW:
            raise RadioDataError(
                file, f"has {len(content)} characters, at most {LONGEST_ROW} are taken; give {wanted}", line
            )
    return text


def _decoded(data: bytes) -> str:
    if data.startswith(UTF_16):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        if CONTROL.search(data):
            raise
        return data.decode("cp1252")


def content_lines(text: str) -> list[tuple[int, str]]:
    """Line number, from 1, and content of all lines that are neither empty nor comments."""
    stripped = ((number, line.strip()) for number, line in enumerate(text.splitlines(), 1))
    return [(number, line) for number, line in stripped if line and not line.startswith(COMMENTS)]


def delimiter_of(content: str) -> str | None:
    """The delimiter of the cells of a line; ``None`` for white space."""
    return next((mark for mark in DELIMITERS if mark in content), None)


def split_cells(content: str, delimiter: str | None = ",") -> list[str]:
    """The stripped cells of a line, quoted or not; split at white space if ``delimiter`` is ``None``.

    Where the delimiter is no comma, numbers may have a decimal comma, and get a point.
    """
    if delimiter is None:
        return content.split()
    cells = [cell.strip() for cell in next(csv.reader([content], delimiter=delimiter, skipinitialspace=True))]
    if delimiter == "," or "," not in content:
        return cells
    return [cell.replace(",", ".") if DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells]


def number(file: Path, line: int, text: str, what: str) -> float:
    """A number; NaN and infinity are accepted, and ``Table.finite`` drops their rows with a warning.

    Raises RadioDataError: it is not a number.
    """
    try:
        return float(text)
    except ValueError as error:
        raise RadioDataError(file, f"{what} is {text[:40]!r}, not a number", line) from error


def beacon_name(cell: str) -> str:
    """The name of a beacon in a cell: ``7.0``, as tables with missing numbers have it, is ``7``."""
    return cell.partition(".")[0] if WHOLE.fullmatch(cell) else cell


def instant(time_s: float) -> str:
    """A time for a message, to a millisecond: six digits of a clock that began in 1970 would be a week."""
    return f"{time_s:.3f}".rstrip("0").rstrip(".") + " s"


def is_number(text: str) -> bool:
    """Whether a cell holds a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


class Table(NamedTuple):
    """Rows of numbers, shape (n, columns), and the line number of each, from 1, shape (n,)."""

    file: Path
    values: FloatArray
    lines: IntArray

    def note(self, rows: BoolArray, what: str) -> str:
        """A warning about the rows of a mask (n,), with the line of the first."""
        first = int(self.lines[np.flatnonzero(rows)[0]])
        return f"{self.file.name}:{first}: {plural(int(rows.sum()), 'row')} {what}"

    def where(self, rows: BoolArray) -> "Table":
        """The rows of a mask (n,)."""
        return Table(self.file, self.values[rows], self.lines[rows])

    def finite(self, warnings: list[str], columns: int | None = None) -> "Table":
        """Rows that are finite in the first ``columns`` (default: all); the others are dropped with a warning."""
        finite = np.asarray(np.isfinite(self.values[:, :columns]).all(axis=1))
        if not finite.all():
            warnings.append(self.note(~finite, "not finite or empty (the first here), not used"))
        return self.where(finite)

    def with_unknown_ways(self, warnings: list[str]) -> "Table":
        """Incremental odometry: a row with a time but other values not finite keeps its time, the rest becomes NaN."""
        unknown = np.isfinite(self.values[:, 0]) & ~np.isfinite(self.values).all(axis=1)
        if not unknown.any():
            return self
        warnings.append(self.note(unknown, "not finite or empty (the first here): the way there is not measured"))
        values = self.values.copy()
        values[unknown, 1:] = np.nan
        return self._replace(values=values)


def tables_of(file: Path, rows: Iterable[tuple[str, int, list[float]]]) -> dict[str, Table]:
    """A table for each kind of line, from rows of (kind, line number, values)."""
    found: dict[str, list[tuple[int, list[float]]]] = {}
    for kind, line, values in rows:
        found.setdefault(kind, []).append((line, values))
    return {
        kind: Table(file, np.array([values for _, values in own]), np.array([line for line, _ in own]))
        for kind, own in found.items()
    }


def read_table(file: Path, names: tuple[str, ...], *, more: bool = False) -> Table:
    """A table of numbers separated by white space or commas; a first line of words is a header.

    ``more``: allow further columns and ignore them. Raises RadioDataError: the file cannot be read, has no rows, or a
    row does not have the columns ``names``.
    """
    rows: list[tuple[str, int, list[float]]] = []
    for line, content in content_lines(read_text(file)):
        words = content.replace(",", " ").split()
        if not rows and not any(is_number(word) for word in words):
            continue  # a header without a comment sign
        if len(words) != len(names) and not (more and len(words) > len(names)):
            raise RadioDataError(file, f"{len(words)} columns, wanted {len(names)}: {', '.join(names)}", line)
        rows.append(("", line, [number(file, line, word, name) for word, name in zip(words, names, strict=False)]))
    if not rows:
        raise RadioDataError(file, f"no rows; wanted lines of {', '.join(names)}")
    return tables_of(file, rows)[""]


def tagged_row(
    file: Path, line: int, words: Sequence[str], layout: Mapping[str, tuple[str, ...]], names: dict[str, float],
    tags: dict[str, float] | None = None,
) -> tuple[str, int, list[float]]:  # fmt: skip
    """Parse a line whose first word is its kind: (kind, line number, values of its columns).

    ``layout``: columns by kind; those in parentheses are optional. The columns ``beacon`` and ``tag`` are names, all
    others are numbers. ``names``, ``tags``: number of each known beacon and tag; new ones are added. Raises
    RadioDataError: unknown kind, or the values do not fit the columns.
    """
    kind, *cells = words
    if kind not in layout:
        raise RadioDataError(file, f"{kind[:40]!r} is none of {', '.join(layout)}", line)
    columns = layout[kind]
    while len(cells) > max(1, needed_of(columns)) and not cells[-1]:
        cells.pop()  # empty cells at the end, as spreadsheets write them
    if not needed_of(columns) <= len(cells) <= len(columns):
        raise RadioDataError(file, f"{len(cells)} values after {kind}, wanted {', '.join(columns)}", line)
    values = []
    named = {"beacon": names, "tag": {} if tags is None else tags}
    for cell, column in zip(cells, columns, strict=False):
        what = column.strip("()")
        if what not in named or (what != column and not cell):
            # Nothing was measured; a row without a time or a place means nothing.
            is_nothing = not cell and column not in UNOMITTABLE
            values.append(np.nan if is_nothing else number(file, line, cell, what))
        elif cell:
            values.append(named[what].setdefault(beacon_name(cell), float(len(named[what]))))
        else:
            raise RadioDataError(file, f"{kind} has no name of a {what}", line)
    missing = 0.0 if kind in {"odom", "speed"} else np.nan  # no travel sideways; heading unknown
    return kind, line, values + [missing] * (len(columns) - len(values))


def needed_of(columns: Sequence[str]) -> int:
    """Number of required columns of a layout."""
    return sum(not column.startswith("(") for column in columns)


def within(times_s: FloatArray, odometry_s: FloatArray, what: str, warnings: list[str]) -> BoolArray:
    """Mask of the times within the span of the odometry; warns of the others."""
    inside = (times_s >= odometry_s[0]) & (times_s <= odometry_s[-1])
    if not inside.all():
        warnings.append(
            f"{plural(int((~inside).sum()), what)} before the first or after the last odometry in use, not used"
        )
    return np.asarray(inside)


def long_pauses(times_s: FloatArray, least_s: float = GAP_S) -> IntArray:
    """Indices of the rows that are followed by an unusually long pause."""
    pauses = np.diff(times_s)
    if not (pauses > 0.0).any():
        return np.empty(0, dtype=np.int64)
    usual_s = float(np.median(pauses[pauses > 0.0]))
    return np.asarray(np.flatnonzero(pauses > max(least_s, GAP_RATIO * usual_s)), dtype=np.int64)
