"""The mission database: which points are planned, measured or skipped, with their fixes and arrivals.

SQLite with one connection, owned by a writer thread that commits with ``synchronous=FULL``. The journal is a rollback
journal: the file alone is complete after each commit, and a reader from outside cannot meet the defect that write-ahead
logs of SQLite 3.7.0 to 3.51.2 have with several connections. Room for a whole mission, the journal's included, is taken
at the start: a disk that fills up later costs no measurement.

Every fix carries a checksum over all its values, and so do the targets with the meta data: a flipped bit that leaves
the file a valid database is found, and the point is measured again.
"""

import hashlib
import shutil
import sqlite3
import tempfile
import threading
import zlib
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import closing, suppress
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple, Self

from ccatp.config.files import sync_folder
from ccatp.config.models import PanelsConfig
from ccatp.core import DeckPose, Fix, Measured, PointId

SCHEMA_VERSION = 2
BUSY_TIMEOUT_S = 30.0  # an outside reader may hold its lock for this long
RESERVE_BYTES = 2 * 1024 * 1024  # five times what 800 fixes and 2,000 arrivals take
QUEUE_LIMIT = 1000

# Its text is compared with that in a file, comments included. Nothing is written to ``events``.
_SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE fixes (
  id INTEGER PRIMARY KEY, row INTEGER NOT NULL, col INTEGER NOT NULL, point INTEGER NOT NULL, t_s REAL NOT NULL,
  x_m REAL NOT NULL, y_m REAL NOT NULL, z_m REAL NOT NULL, -- puck, world frame
  cov_xx_m2 REAL NOT NULL, cov_xy_m2 REAL NOT NULL, cov_xz_m2 REAL NOT NULL,
  cov_yx_m2 REAL NOT NULL, cov_yy_m2 REAL NOT NULL, cov_yz_m2 REAL NOT NULL,
  cov_zx_m2 REAL NOT NULL, cov_zy_m2 REAL NOT NULL, cov_zz_m2 REAL NOT NULL,
  dop REAL NOT NULL, residual_rms_m REAL NOT NULL, channels TEXT NOT NULL,
  estimate_x_m REAL NOT NULL, estimate_y_m REAL NOT NULL, estimate_heading_rad REAL NOT NULL, -- deck frame
  left_out TEXT NOT NULL, -- channels, valid but contradicting the others
  lengths_m TEXT NOT NULL, -- of channels, then of left_out
  metrology TEXT NOT NULL, -- good, unchecked or unreliable
  suspects TEXT NOT NULL, -- channels that contradict each other
  detectable_m REAL, protection_m REAL,
  crc INTEGER NOT NULL);
CREATE TABLE points (
  row INTEGER NOT NULL, col INTEGER NOT NULL, point INTEGER NOT NULL,
  x_m REAL NOT NULL, y_m REAL NOT NULL, -- target, panel frame
  status TEXT NOT NULL DEFAULT 'planned' CHECK (status IN ('planned', 'measured', 'skipped')),
  t_s REAL, fix_id INTEGER UNIQUE REFERENCES fixes (id),
  CHECK ((status = 'measured') = (fix_id IS NOT NULL)), PRIMARY KEY (row, col, point)) WITHOUT ROWID;
CREATE TABLE events (
  id INTEGER PRIMARY KEY, t_s REAL, wall_utc TEXT NOT NULL, kind TEXT NOT NULL, code INTEGER NOT NULL,
  cause TEXT NOT NULL, signal TEXT NOT NULL, value REAL, "limit" REAL, text TEXT NOT NULL);
CREATE TABLE arrivals (
  id INTEGER PRIMARY KEY, row INTEGER NOT NULL, col INTEGER NOT NULL, point INTEGER NOT NULL,
  t_s REAL NOT NULL, estimated_error_m REAL NOT NULL);
CREATE TABLE reserve (id INTEGER PRIMARY KEY, used INTEGER NOT NULL, filler BLOB NOT NULL);
CREATE TABLE ballast (filler BLOB);
"""
# A database of version 1 is read and continued; its fixes have no lengths.
_NEW_COLUMNS = """  left_out TEXT NOT NULL, -- channels, valid but contradicting the others
  lengths_m TEXT NOT NULL, -- of channels, then of left_out
  metrology TEXT NOT NULL, -- good, unchecked or unreliable
  suspects TEXT NOT NULL, -- channels that contradict each other
  detectable_m REAL, protection_m REAL,
"""
_SCHEMAS = {"1": _SCHEMA.replace(_NEW_COLUMNS, ""), str(SCHEMA_VERSION): _SCHEMA}
_PAGE_FILLER = 3900  # bytes; one row fills a page
_JOURNAL_PAGES = 48  # room kept in the journal; a commit of one fix touches about six pages
_CRC_KEY, _RUN_ID_KEY = "crc", "run_id"
_OLD_VALUES, _VALUES = 22, 28  # of a fix in version 1 and now, without number and checksum
_INSERT_FIX = {
    count: f"INSERT INTO fixes VALUES (NULL{',?' * (count + 1)})"  # noqa: S608 - only marks vary
    for count in (_OLD_VALUES, _VALUES)
}
_STATUS = "SELECT status FROM points WHERE row = ? AND col = ? AND point = ?"
_SET_STATUS = "UPDATE points SET status = ?, t_s = ?, fix_id = ? WHERE row = ? AND col = ? AND point = ?"
# Errors of a request, not of the file.
_NOT_STORABLE = (sqlite3.IntegrityError, sqlite3.ProgrammingError, TypeError, OverflowError)
# SQLite's errors for a file whose last transaction was cut off: it must be rolled back before it can be read.
_CUT_OFF = ("SQLITE_READONLY", "SQLITE_CANTOPEN")


class StoreError(Exception):
    """The store cannot be used, or a write failed for good: nothing after it is acknowledged."""


class StoreRefusal(StoreError):
    """One request was refused; the store goes on."""


class AlreadyMeasuredError(StoreRefusal):
    """The point already has a committed fix."""


class StoredPoint(NamedTuple):
    """A point and its target in the tangent plane of its panel, panel frame; a row of ``points``."""

    point: PointId
    x_m: float
    y_m: float
    status: str = "planned"  # or measured, or skipped
    t_s: float | None = None  # when that happened
    fix_id: int | None = None


def planned_point(point: PointId, grid: PanelsConfig) -> StoredPoint:
    """A point that is to be measured, with its target on the grid of a panel."""
    row, column = divmod(point.point - 1, len(grid.points_x_mm))
    return StoredPoint(point, 1e-3 * grid.points_x_mm[column], 1e-3 * grid.points_y_mm[row])


class StoredSurvey(NamedTuple):
    """Points by row, column and number; fixes in the order of measuring; a line for each that is damaged."""

    points: tuple[StoredPoint, ...]
    fixes: tuple[Measured, ...]
    warnings: tuple[str, ...]


def point_name(point: PointId) -> str:
    """``row/column/number``."""
    return "/".join(map(str, point))


_Work = Callable[[sqlite3.Connection], Any]


@dataclass(frozen=True, slots=True)
class _Job:
    work: _Work
    is_optional: bool = False  # gives way where there is no room
    future: "Future[Any]" = field(default_factory=Future)


class MissionStore:
    """The mission database of one run, owned by one process; made by ``create`` or ``open``.

    Recording returns at once and may be done from an asyncio loop; each request is one transaction. ``points``,
    ``fixes`` and ``close`` wait for the writer thread. ``damaged``: points whose stored fix did not match its
    checksum at ``open``; they are planned again. ``failure``: the error that ended all writing, if any.
    """

    def __init__(self, path: Path, db: sqlite3.Connection) -> None:
        self.path = path
        self.damaged = tuple(_damaged_points(db))
        for point in self.damaged:
            db.execute(_SET_STATUS, ("planned", None, None, *point))
        self.failure: StoreError | None = None
        self._db = db
        self._jobs: SimpleQueue[_Job | None] = SimpleQueue()
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="store", daemon=True)
        self._thread.start()

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        mirror: str,
        seed: int,
        config_toml: str,
        points: Iterable[StoredPoint],
        run_id: str = "",
        reserve_bytes: int = RESERVE_BYTES,
    ) -> Self:
        """Make a new store with all points planned; the file appears complete or not at all.

        ``StoreError``: the file exists, or cannot be made. ``config_toml``: the run's exact configuration; its SHA-256
        is kept.
        """
        if path.exists():
            raise StoreError(f"{path}: exists already; resume it or choose another run directory")
        meta = [
            ("mirror", mirror),
            ("seed", str(seed)),
            ("config_sha256", hashlib.sha256(config_toml.encode()).hexdigest()),
            ("schema_version", str(SCHEMA_VERSION)),
            (_RUN_ID_KEY, run_id),
        ]
        new = path.with_name(path.name + ".new")
        try:
            for leftover in (new, path):
                leftover.with_name(leftover.name + "-journal").unlink(missing_ok=True)
            new.unlink(missing_ok=True)
            with closing(_connect(new)) as db:
                # A half-made file is thrown away, so it needs no journal on the disk.
                db.execute("PRAGMA journal_mode = MEMORY")
                _fill(db, points, meta, reserve_bytes)
            new.replace(path)
            sync_folder(path)
        except (OSError, sqlite3.Error) as error:
            raise StoreError(f"{path}: cannot be made: {error}") from error
        return cls.open(path, mirror=mirror)

    @classmethod
    def open(cls, path: Path, *, mirror: str, run_id: str = "") -> Self:
        """Open the store of an earlier run to go on with it; raises as ``read_survey``, or if ``run_id`` differs."""
        if not path.is_file():
            raise StoreError(f"{path}: no such file; nothing to resume")
        db: sqlite3.Connection | None = None
        try:
            db = _connect(path)
            _check_file(db, path, mirror)
            row = db.execute("SELECT value FROM meta WHERE key = ?", (_RUN_ID_KEY,)).fetchone()
            if run_id and row != (run_id,):
                raise StoreError(f"{path}: is of another run; put back that of this run, or use a new run directory")
            # Touches so many pages that the journal keeps the room which later commits need.
            db.execute("UPDATE reserve SET used = used + 1")
        except (sqlite3.Error, UnicodeDecodeError, StoreError) as error:
            if db is not None:
                db.close()
            if isinstance(error, StoreError):
                raise
            raise StoreError(f"{path}: damaged or not a mission store: {error}") from error
        return cls(path, db)

    def record_fix(self, point: PointId, fix: Fix, estimate: DeckPose) -> "Future[int]":
        """Store a fix (world frame) and make its point measured, in one transaction.

        Returns resolves to the number of the fix after the commit (await it with ``asyncio.wrap_future``). Fails with
        ``AlreadyMeasuredError``, ``StoreRefusal`` (not finite, a covariance not of nine values, or no point of this
        mission) or another ``StoreError``: another program locks the file, or nothing will be stored any more.
        """
        return self._submit(lambda db: _insert_fix(db, point, fix, estimate))

    def record_skipped(self, point: PointId, t_s: float) -> "Future[None]":
        """Mark a point as skipped (it may still be measured later); resolves and fails like ``record_fix``."""

        def skip(db: sqlite3.Connection) -> None:
            if _status(db, point) == "measured":
                raise AlreadyMeasuredError(f"point {point_name(point)} has been measured; it cannot be skipped")
            db.execute(_SET_STATUS, ("skipped", t_s, None, *point))

        return self._submit(skip)

    def record_arrival(self, point: PointId, t_s: float, estimated_error_m: float) -> None:
        """Store that the robot came to rest at a point; dropped where the queue or the disk is full."""
        if self._jobs.qsize() < QUEUE_LIMIT and not self._is_closed and self.failure is None:
            row = (*point, t_s, estimated_error_m)
            insert = "INSERT INTO arrivals VALUES (NULL, ?, ?, ?, ?, ?)"
            self._jobs.put(_Job(lambda db: db.execute(insert, row), is_optional=True))

    def points(self) -> list[StoredPoint]:
        """All points, by row, column and number."""
        return list(self._submit(_points).result())

    def fixes(self) -> list[Measured]:
        """The fix of each measured point in the order of measuring."""
        return list(self._submit(_fixes).result())

    def close(self, timeout_s: float = 10.0) -> None:
        """Commit what is queued and close the file; may be repeated. Raises ``StoreError`` after the time-out."""
        if not self._is_closed:
            self._is_closed = True
            self._jobs.put(None)
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise StoreError(f"{self.path}: writer still busy after {timeout_s} s")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _submit(self, work: _Work) -> "Future[Any]":
        job = _Job(work)
        if self._is_closed:
            job.future.set_exception(self.failure or StoreError(f"{self.path}: is closed"))
        else:
            self._jobs.put(job)
        return job.future

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            # A request cancelled before it began is left out; from here on it can no longer be cancelled.
            if job.future.set_running_or_notify_cancel():
                try:
                    job.future.set_result(self._commit(job))
                except StoreError as error:
                    job.future.set_exception(error)
        with suppress(sqlite3.Error):
            self._db.execute("PRAGMA journal_mode = DELETE")
        self._db.close()

    def _commit(self, job: _Job) -> Any:
        """Raises ``StoreRefusal``, or another ``StoreError``; the store can go on unless ``failure`` is set."""
        if self.failure is not None:
            raise self.failure
        try:
            self._db.execute("BEGIN IMMEDIATE")
            result = job.work(self._db)
            self._db.execute("COMMIT")
        except Exception as error:
            name = getattr(error, "sqlite_errorname", "")
            reason = f"{error} ({name})" if name else f"{type(error).__name__}: {error}"
            if name.startswith("SQLITE_BUSY") and not self._db.in_transaction:
                # It has not begun, so the next one may be stored.
                raise StoreError(f"{self.path}: locked by another program: {reason}") from error
            if self._is_rolled_back():
                if isinstance(error, StoreRefusal):
                    raise
                if isinstance(error, _NOT_STORABLE):
                    raise StoreRefusal(f"{self.path}: not storable: {error}") from error
                # Arrivals give way to fixes, for which there may be room in what was taken at the start.
                if job.is_optional and name == "SQLITE_FULL":
                    raise StoreRefusal(f"{self.path}: {reason}") from error
            # Final: after a failed fsync a repeated one may report a success that never reached the disk.
            self.failure = StoreError(f"{self.path}: cannot write any more: {reason}")
            raise self.failure from error
        return result

    def _is_rolled_back(self) -> bool:
        with suppress(sqlite3.Error):
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            return True
        return False


def read_survey(path: Path, mirror: str) -> StoredSurvey:
    """Read a mission database without writing to it: of a run that goes on, was killed, or is an archive.

    ``StoreError``: no such file, not a mission store, another schema or mirror, or damaged.
    """
    if not path.is_file():
        raise StoreError(f"{path}: no such file; name the directory of a run")
    try:
        try:
            return _read(f"{path.absolute().as_uri()}?mode=ro", path, mirror)
        except sqlite3.OperationalError as error:
            if not error.sqlite_errorname.startswith(_CUT_OFF):
                raise
        # SQLite may undo in a copy what was cut off.
        with tempfile.TemporaryDirectory(prefix="ccatp-read-") as folder:
            for file in (path, path.with_name(path.name + "-journal")):
                if file.exists():
                    shutil.copyfile(file, Path(folder) / file.name)
            return _read(f"{(Path(folder) / path.name).as_uri()}?mode=rw", path, mirror)
    except (sqlite3.Error, UnicodeDecodeError, OSError, ValueError, TypeError) as error:
        raise StoreError(f"{path}: damaged or not a mission store: {error}") from error


def _read(uri: str, path: Path, mirror: str) -> StoredSurvey:
    with closing(sqlite3.connect(uri, timeout=10.0, uri=True, isolation_level=None)) as db:
        db.execute("BEGIN")  # all of it at one instant, while a run goes on
        _check_file(db, path, mirror)
        damaged = _damaged_points(db)
        warnings = [
            f"point {point_name(point)}: its stored fix is damaged and not used; measure it again" for point in damaged
        ]
        fixes = tuple(one for one in _fixes(db) if one.point not in damaged)
        return StoredSurvey(tuple(_points(db)), fixes, tuple(warnings))


def _connect(path: Path) -> sqlite3.Connection:
    # The connection is handed to the writer thread once and never shared.
    db = sqlite3.connect(path, timeout=BUSY_TIMEOUT_S, isolation_level=None, check_same_thread=False)
    # A damaged text comes back damaged, and fails its checksum, instead of ending the program.
    db.text_factory = lambda raw: raw.decode("utf-8", "surrogateescape")
    try:
        db.execute("PRAGMA synchronous = FULL")
        db.execute("PRAGMA journal_mode = PERSIST")
    except Exception:  # not a database; its message may even be no UTF-8
        db.close()
        raise
    return db


def _fill(
    db: sqlite3.Connection, points: Iterable[StoredPoint], meta: list[tuple[str, str]], reserve_bytes: int
) -> None:
    db.executescript(f"BEGIN; {_SCHEMA} COMMIT;")
    db.execute("BEGIN")
    rows = [(*p.point, float(p.x_m), float(p.y_m)) for p in points]
    db.executemany("INSERT INTO points (row, col, point, x_m, y_m) VALUES (?, ?, ?, ?, ?)", rows)
    db.executemany("INSERT INTO meta VALUES (?, ?)", meta)
    db.execute("INSERT INTO meta VALUES (?, ?)", (_CRC_KEY, str(_plan_crc(db))))
    filler = [(0, bytes(_PAGE_FILLER))] * (_JOURNAL_PAGES if reserve_bytes else 0)
    db.executemany("INSERT INTO reserve (used, filler) VALUES (?, ?)", filler)
    db.execute("INSERT INTO ballast VALUES (zeroblob(?))", (reserve_bytes,))
    db.execute("COMMIT")
    # Its pages were written once, so the disk has given them; now they are free inside the file.
    db.execute("DROP TABLE ballast")


def _check_file(db: sqlite3.Connection, path: Path, mirror: str) -> None:
    """Raises ``StoreError``, or ``sqlite3.Error``, unless the file is a sound store of this schema and mirror."""
    verdict = db.execute("PRAGMA integrity_check(1)").fetchone()[0]
    if verdict != "ok":
        raise StoreError(f"{path}: damaged: {' '.join(verdict.split())}")
    pages, page_bytes = (db.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "page_size"))
    if path.stat().st_size < pages * page_bytes:  # SQLite fills up a page that is cut off
        raise StoreError(f"{path}: damaged: cut off at {path.stat().st_size} of {pages * page_bytes} bytes")
    meta = dict(db.execute("SELECT key, value FROM meta"))
    version = meta.get("schema_version")
    if version not in _SCHEMAS:
        raise StoreError(
            f"{path}: schema version {version}, this program has {SCHEMA_VERSION}; use a new run directory"
        )
    with closing(sqlite3.connect(":memory:")) as expected:
        expected.executescript(_SCHEMAS[version])
        if _tables(db) != _tables(expected):
            raise StoreError(f"{path}: damaged: its tables are not those of schema version {version}")
    if meta.get(_CRC_KEY) != str(_plan_crc(db)):
        raise StoreError(f"{path}: damaged: meta data or targets do not match their checksum")
    if meta.get("mirror") != mirror:
        raise StoreError(f"{path}: is a survey of {meta.get('mirror')}, not of {mirror}; use a new run directory")


def _tables(db: sqlite3.Connection) -> list[tuple[str, str]]:
    # Ballast is gone in a sound file; where dropping it was cut short the file was never complete.
    rows = db.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL AND name <> 'ballast' ORDER BY name")
    return [(str(name), str(sql)) for name, sql in rows]


def _damaged_points(db: sqlite3.Connection) -> list[PointId]:
    """The points whose fix is missing or does not match its checksum."""
    damaged = []
    for key in db.execute("SELECT row, col, point, fix_id, t_s FROM points WHERE fix_id IS NOT NULL").fetchall():
        fix = db.execute("SELECT * FROM fixes WHERE id = ?", (key[3],)).fetchone()
        if fix is None or fix[1:5] != (*key[:3], key[4]) or fix[-1] != _crc(fix[1:-1]):
            damaged.append(PointId(*key[:3]))
    return damaged


def _insert_fix(db: sqlite3.Connection, point: PointId, fix: Fix, estimate: DeckPose) -> int:
    before = (fix.t_s, *fix.position_m, *fix.covariance_m2, fix.dop, fix.residual_rms_m)
    after = (estimate.x_m, estimate.y_m, estimate.heading_rad)
    if len(fix.covariance_m2) != 9 or not all(map(isfinite, (*before, *after))):
        raise StoreRefusal(f"fix of {point_name(point)}: a value is not finite, or the covariance is not of 9 values")
    channels = ",".join(str(int(channel)) for channel in fix.channels)
    limits = (None if limit is None else float(limit) for limit in (fix.detectable_m, fix.protection_m))
    lengths = ",".join(repr(float(length)) for length in fix.lengths_m)
    lists = [",".join(str(int(channel)) for channel in some) for some in (fix.left_out, fix.suspects)]
    values: tuple[Any, ...] = (
        *map(int, point), *map(float, before), channels, *map(float, after),
        lists[0], lengths, fix.metrology, lists[1], *limits,
    )  # fmt: skip
    if db.execute("SELECT value FROM meta WHERE key = 'schema_version'").fetchone() == ("1",):
        values = values[:_OLD_VALUES]
    if _status(db, point) == "measured":
        raise AlreadyMeasuredError(f"point {point_name(point)} has been measured; its fix is not replaced")
    number = db.execute(_INSERT_FIX[len(values)], (*values, _crc(values))).lastrowid
    db.execute(_SET_STATUS, ("measured", float(fix.t_s), number, *point))
    return int(number or 0)


def _points(db: sqlite3.Connection) -> list[StoredPoint]:
    return [StoredPoint(PointId(*r[:3]), *r[3:8]) for r in db.execute("SELECT * FROM points ORDER BY row, col, point")]


def _fixes(db: sqlite3.Connection) -> list[Measured]:
    found = []
    for r in db.execute("SELECT * FROM fixes WHERE id IN (SELECT fix_id FROM points) ORDER BY id"):
        judged: dict[str, Any] = {}
        if len(r) > _OLD_VALUES + 2:
            left_out, lengths, metrology, suspects, detectable_m, protection_m = r[_OLD_VALUES + 1 : -1]
            judged = {
                "left_out": _integers(left_out), "lengths_m": tuple(float(one) for one in lengths.split(",") if one),
                "metrology": metrology, "suspects": _integers(suspects), "detectable_m": detectable_m,
                "protection_m": protection_m,
            }  # fmt: skip
        fix = Fix(r[4], (r[5], r[6], r[7]), tuple(r[8:17]), r[17], _integers(r[19]), r[18], **judged)
        found.append(Measured(PointId(*r[1:4]), fix))
    return found


def _integers(text: str) -> tuple[int, ...]:
    return tuple(int(one) for one in text.split(",") if one)


def _status(db: sqlite3.Connection, point: PointId) -> str:
    found = db.execute(_STATUS, tuple(point)).fetchone()
    if found is None:
        raise StoreRefusal(f"point {point_name(point)} is not one of this mission's points")
    return str(found[0])


def _crc(values: Iterable[Any]) -> int:
    return zlib.crc32(repr(tuple(values)).encode())


def _plan_crc(db: sqlite3.Connection) -> int:
    meta = db.execute("SELECT key, value FROM meta WHERE key <> ? ORDER BY key", (_CRC_KEY,)).fetchall()
    targets = db.execute("SELECT row, col, point, x_m, y_m FROM points ORDER BY row, col, point").fetchall()
    return _crc([*meta, *targets])
