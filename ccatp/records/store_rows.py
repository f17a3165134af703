"""The rows of the mission database: schema, statements, and the checks of a file that is opened again.

Every fix carries a checksum over all its values, and so do the targets with the meta data: a flipped bit that leaves
the file a valid database is found, and the point is measured again.
"""

import os
import sqlite3
import zlib
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from ccatp.core import DeckPose, Fix, PointId

SCHEMA_VERSION = 1
BUSY_TIMEOUT_S = 30.0  # an outside reader may hold its lock for this long

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
_PAGE_FILLER = 3900  # bytes; one row fills a page
_JOURNAL_PAGES = 48  # room kept in the journal; a commit of one fix touches about six pages
_CRC_KEY = "crc"
_INSERT_FIX = "INSERT INTO fixes VALUES (NULL,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?) RETURNING id"
_ALL_FIXES = "SELECT * FROM fixes ORDER BY id"
_NEWEST_FIXES = "SELECT * FROM fixes WHERE id IN (SELECT fix_id FROM points) ORDER BY id"
_STATUS = "SELECT status FROM points WHERE row = ? AND col = ? AND point = ?"
_SET_STATUS = "UPDATE points SET status = ?, t_s = ?, fix_id = ? WHERE row = ? AND col = ? AND point = ?"


class StoreError(Exception):
    """The store cannot be used, or a write failed for good: nothing after it is acknowledged."""


class StoreRefusal(StoreError):
    """One request was refused; the store goes on."""


class AlreadyMeasuredError(StoreRefusal):
    """The point already has a committed fix."""


class UnknownPointError(StoreRefusal):
    """The point is not one of this mission's."""


class PlannedPoint(NamedTuple):
    """A point to be measured and its target in the tangent plane of its panel, panel frame."""

    point: PointId
    x_m: float
    y_m: float


class StoredPoint(NamedTuple):
    """A row of ``points``; ``status`` is planned, measured or skipped, ``t_s`` the time of the latter two."""

    point: PointId
    x_m: float
    y_m: float
    status: str
    t_s: float | None
    fix_id: int | None


class StoredFix(NamedTuple):
    """A committed fix: its number, its point, the fix (world frame) and the estimated pose (deck) at that time."""

    id: int
    point: PointId
    fix: Fix
    estimate: DeckPose


@dataclass(frozen=True, slots=True)
class StoreEvent:
    """Something an operator wants to find again. Fields as in ``ccatp.core.Verdict``; ``text`` is free."""

    t_s: float
    kind: str
    code: int = 0
    cause: str = ""
    signal: str = ""
    value: float = 0.0
    limit: float = 0.0
    text: str = ""


def point_name(point: PointId) -> str:
    """A point as people write it: ``row/column/number``."""
    return "/".join(map(str, point))


def make_file(path: Path, points: Iterable[PlannedPoint], meta: Mapping[str, str], reserve_bytes: int) -> None:
    """Make a store file that appears complete or not at all; raises ``StoreError``."""
    if path.exists():
        raise StoreError(f"{path}: exists already; resume it or choose another run directory")
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
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except (OSError, sqlite3.Error) as error:
        raise StoreError(f"{path}: cannot be made: {error}") from error


def open_file(path: Path, mirror: str) -> sqlite3.Connection:
    """Open a store file after checking that it is sound and of this schema and mirror; raises ``StoreError``."""
    if not path.is_file():
        raise StoreError(f"{path}: no such file; nothing to resume")
    db: sqlite3.Connection | None = None
    try:
        db = _connect(path)
        check_file(db, path, mirror)
        # Touches so many pages that the journal keeps the room which later commits need.
        db.execute("UPDATE reserve SET used = used + 1")
    except (sqlite3.Error, UnicodeDecodeError, StoreError) as error:
        if db is not None:
            db.close()
        if isinstance(error, StoreError):
            raise
        raise StoreError(f"{path}: damaged or not a mission store: {error}") from error
    return db


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


def _fill(db: sqlite3.Connection, points: Iterable[PlannedPoint], meta: Mapping[str, str], reserve_bytes: int) -> None:
    db.executescript(f"BEGIN; {_SCHEMA} COMMIT;")
    db.execute("BEGIN")
    rows = [(*p.point, float(p.x_m), float(p.y_m)) for p in points]
    db.executemany("INSERT INTO points (row, col, point, x_m, y_m) VALUES (?, ?, ?, ?, ?)", rows)
    db.executemany("INSERT INTO meta VALUES (?, ?)", [*meta.items(), ("schema_version", str(SCHEMA_VERSION))])
    db.execute("INSERT INTO meta VALUES (?, ?)", (_CRC_KEY, str(_plan_crc(db))))
    filler = [(0, bytes(_PAGE_FILLER))] * (_JOURNAL_PAGES if reserve_bytes else 0)
    db.executemany("INSERT INTO reserve (used, filler) VALUES (?, ?)", filler)
    db.execute("INSERT INTO ballast VALUES (zeroblob(?))", (reserve_bytes,))
    db.execute("COMMIT")
    # Its pages were written once, so the disk has given them; now they are free inside the file.
    db.execute("DROP TABLE ballast")


def check_file(db: sqlite3.Connection, path: Path, mirror: str) -> None:
    """Raises ``StoreError``, or ``sqlite3.Error``, unless the file is a sound store of this schema and mirror."""
    verdict = db.execute("PRAGMA integrity_check(1)").fetchone()[0]
    if verdict != "ok":
        raise StoreError(f"{path}: damaged: {verdict}")
    pages, page_bytes = (db.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "page_size"))
    if path.stat().st_size < pages * page_bytes:  # SQLite fills up a page that is cut off
        raise StoreError(f"{path}: damaged: cut off at {path.stat().st_size} of {pages * page_bytes} bytes")
    meta = dict(db.execute("SELECT key, value FROM meta"))
    version = meta.get("schema_version")
    if version != str(SCHEMA_VERSION):
        raise StoreError(
            f"{path}: schema version {version}, this program has {SCHEMA_VERSION}; use a new run directory"
        )
    if _tables(db) != _expected_tables():
        raise StoreError(f"{path}: damaged: its tables are not those of schema version {SCHEMA_VERSION}")
    if meta.get(_CRC_KEY) != str(_plan_crc(db)):
        raise StoreError(f"{path}: damaged: meta data or targets do not match their checksum")
    if meta.get("mirror") != mirror:
        raise StoreError(f"{path}: is a survey of {meta.get('mirror')}, not of {mirror}; use a new run directory")


def _tables(db: sqlite3.Connection) -> list[tuple[str, str]]:
    # Ballast is gone in a sound file; where dropping it was cut short the file was never complete.
    rows = db.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL AND name <> 'ballast' ORDER BY name")
    return [(str(name), str(sql)) for name, sql in rows]


def _expected_tables() -> list[tuple[str, str]]:
    with closing(sqlite3.connect(":memory:")) as db:
        db.executescript(_SCHEMA)
        return _tables(db)


def replan_damaged(db: sqlite3.Connection) -> list[PointId]:
    """Plan again the points whose fix is missing or does not match its checksum; returns them."""
    damaged = damaged_points(db)
    for point in damaged:
        db.execute(_SET_STATUS, ("planned", None, None, *point))
    return damaged


def damaged_points(db: sqlite3.Connection) -> list[PointId]:
    """The points whose fix is missing or does not match its checksum."""
    damaged = []
    for key in db.execute("SELECT row, col, point, fix_id, t_s FROM points WHERE fix_id IS NOT NULL").fetchall():
        fix = db.execute("SELECT * FROM fixes WHERE id = ?", (key[3],)).fetchone()
        if fix is None or fix[1:5] != (*key[:3], key[4]) or fix[-1] != _crc(fix[1:-1]):
            damaged.append(PointId(*key[:3]))
    return damaged


def fix_values(point: PointId, fix: Fix, estimate: DeckPose) -> tuple[Any, ...]:
    """The columns of a fix after its number, checksum last; raises ``StoreRefusal`` where a value has no place."""
    numbers = (fix.t_s, *fix.position_m, *fix.covariance_m2, fix.dop, fix.residual_rms_m)
    numbers += (estimate.x_m, estimate.y_m, estimate.heading_rad)
    if len(fix.covariance_m2) != 9 or not all(map(isfinite, numbers)):
        raise StoreRefusal(f"fix of {point_name(point)}: a value is not finite, or the covariance is not of 9 values")
    head, tail = map(float, numbers[:-3]), map(float, numbers[-3:])
    values = (*map(int, point), *head, ",".join(str(int(c)) for c in fix.channels), *tail)
    return (*values, _crc(values))


def insert_fix(db: sqlite3.Connection, point: PointId, values: tuple[Any, ...], remeasure: bool) -> int:
    """Insert a fix and make its point measured; raises ``StoreRefusal`` before anything is written."""
    if _status(db, point) == "measured" and not remeasure:
        raise AlreadyMeasuredError(f"point {point_name(point)} has been measured; its fix is not replaced")
    number = int(db.execute(_INSERT_FIX, values).fetchall()[0][0])
    db.execute(_SET_STATUS, ("measured", values[3], number, *point))
    return number


def skip_point(db: sqlite3.Connection, point: PointId, t_s: float) -> None:
    """Mark a point as skipped; raises ``StoreRefusal`` before anything is written."""
    if _status(db, point) == "measured":
        raise AlreadyMeasuredError(f"point {point_name(point)} has been measured; it cannot be skipped")
    db.execute(_SET_STATUS, ("skipped", t_s, None, *point))


def insert_event(db: sqlite3.Connection, event: StoreEvent, wall_utc: str) -> None:
    """Insert an event with its wall time, a label only."""
    e = event
    row = (e.t_s, wall_utc, e.kind, int(e.code), e.cause, e.signal, e.value, e.limit, e.text)
    db.execute("INSERT INTO events VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)


def insert_arrival(db: sqlite3.Connection, point: PointId, t_s: float, estimated_error_m: float) -> None:
    """Insert an arrival."""
    db.execute("INSERT INTO arrivals VALUES (NULL, ?, ?, ?, ?, ?)", (*point, t_s, estimated_error_m))


def select_points(db: sqlite3.Connection) -> list[StoredPoint]:
    """All points, by row, column and number."""
    rows = db.execute("SELECT * FROM points ORDER BY row, col, point")
    return [StoredPoint(PointId(*r[:3]), *r[3:8]) for r in rows]


def select_fixes(db: sqlite3.Connection, history: bool) -> list[StoredFix]:
    """The fixes in the order of measuring; replaced ones only with ``history``."""
    fixes = []
    for r in db.execute(_ALL_FIXES if history else _NEWEST_FIXES):
        channels = tuple(int(c) for c in r[19].split(",") if c)
        fix = Fix(r[4], (r[5], r[6], r[7]), tuple(r[8:17]), r[17], channels, r[18])
        fixes.append(StoredFix(r[0], PointId(*r[1:4]), fix, DeckPose(*r[20:23])))
    return fixes


def select_events(db: sqlite3.Connection) -> list[tuple[int, StoreEvent, str]]:
    """All events: number, event, wall time."""
    return [(r[0], StoreEvent(r[1], *r[3:]), r[2]) for r in db.execute("SELECT * FROM events ORDER BY id")]


def select_arrivals(db: sqlite3.Connection) -> list[tuple[PointId, float, float]]:
    """All arrivals: point, time (s), estimated error (m)."""
    return [(PointId(*r[1:4]), r[4], r[5]) for r in db.execute("SELECT * FROM arrivals ORDER BY id")]


def _status(db: sqlite3.Connection, point: PointId) -> str:
    found = db.execute(_STATUS, tuple(point)).fetchone()
    if found is None:
        raise UnknownPointError(f"point {point_name(point)} is not one of this mission's points")
    return str(found[0])


def _crc(values: Iterable[Any]) -> int:
    return zlib.crc32(repr(tuple(values)).encode())


def _plan_crc(db: sqlite3.Connection) -> int:
    meta = db.execute("SELECT key, value FROM meta WHERE key <> ? ORDER BY key", (_CRC_KEY,)).fetchall()
    targets = db.execute("SELECT row, col, point, x_m, y_m FROM points ORDER BY row, col, point").fetchall()
    return _crc([*meta, *targets])
