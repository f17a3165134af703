"""Edge. Reads a mission database without writing to it: of a run that goes on, was killed, or is an archive."""

import shutil
import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from ccatp.samples import PointId
from ccatp.storage import store_rows as rows
from ccatp.storage.store_rows import StoredFix, StoredPoint, StoreError

_BUSY_TIMEOUT_S = 10.0
# What SQLite says of a file whose last transaction was cut off: it cannot be read before it has been rolled back.
_CUT_OFF = ("SQLITE_READONLY", "SQLITE_CANTOPEN")


class StoredSurvey(NamedTuple):
    """What a mission database holds.

    Attributes:
        points: all points, by row, column and number.
        fixes: the fix of each measured point that is sound.
        damaged: points whose fix does not match its checksum.
    """

    points: list[StoredPoint]
    fixes: list[StoredFix]
    damaged: list[PointId]


def read_survey(path: Path, mirror: str) -> StoredSurvey:
    """Read a mission database; the file is not changed.

    Args:
        path: the file.
        mirror: the mirror that it has to be of.

    Raises:
        StoreError: no such file, not a mission store, another schema or mirror, or damaged.
    """
    if not path.is_file():
        raise StoreError(f"{path}: no such file; name the directory of a run")
    try:
        try:
            return _read(f"file:{quote(str(path.absolute()))}?mode=ro", path, mirror)
        except sqlite3.OperationalError as error:
            if not error.sqlite_errorname.startswith(_CUT_OFF):
                raise
            return _read_copy(path, mirror)
    except (sqlite3.Error, UnicodeDecodeError, OSError, ValueError, TypeError) as error:
        raise StoreError(f"{path}: damaged or not a mission store: {error}") from error


def _read_copy(path: Path, mirror: str) -> StoredSurvey:
    """Read a copy, in which SQLite may undo what was cut off."""
    journal = path.with_name(path.name + "-journal")
    with tempfile.TemporaryDirectory(prefix="ccatp-read-") as folder:
        copy = Path(folder) / path.name
        for file in (path, journal):
            if file.exists():
                shutil.copyfile(file, copy.with_name(file.name))
        return _read(f"file:{quote(str(copy))}?mode=rw", path, mirror)


def _read(uri: str, path: Path, mirror: str) -> StoredSurvey:
    with closing(sqlite3.connect(uri, timeout=_BUSY_TIMEOUT_S, uri=True, isolation_level=None)) as db:
        db.execute("BEGIN")  # all of it at one instant, while a run goes on
        rows.check_file(db, path, mirror)
        damaged = rows.damaged_points(db)
        bad = set(damaged)
        fixes = [stored for stored in rows.select_fixes(db, history=False) if stored.point not in bad]
        return StoredSurvey(rows.select_points(db), fixes, damaged)
