"""Edge. Tables of numbers in text files, plain or gzipped: comments skipped, each fault told with file and line."""

import gzip
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ccatp.radio_data.errors import RadioDataError
from ccatp.samples import FloatArray

GZIP_MAGIC = b"\x1f\x8b"
COMMENTS = ("#", "%", "//")


class Table(NamedTuple):
    """Rows of numbers and where they stood.

    Args:
        file: where they were read.
        values: shape (n, columns).
        lines: number of the line of each row, from 1, shape (n,).
    """

    file: Path
    values: FloatArray
    lines: npt.NDArray[np.int64]


def read_text(file: Path, wanted: str = "a data set of the formats plaza, mrclam, labyrinth or csv") -> str:
    """The text of a file, unpacked if it is gzipped, whatever its name.

    Args:
        file: where it is.
        wanted: what to give in place of a file that is no text.

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
        file: plain or gzipped text.
        names: what the columns hold, for messages.
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
