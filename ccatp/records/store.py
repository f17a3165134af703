"""The mission database: which points are planned, measured or skipped, with their fixes, arrivals and events.

SQLite with one connection, owned by a writer thread that commits with ``synchronous=FULL``. The journal is a rollback
journal: the file alone is complete after each commit, and a curious reader from outside cannot meet the defect that
write-ahead logs of SQLite 3.7.0 to 3.51.2 have with several connections. Room for a whole mission, the journal's
included, is taken at the start: a disk that fills up later costs no measurement.

Reads a mission database without writing to it: of a run that goes on, was killed, or is an archive.
"""

import hashlib
import shutil
import sqlite3
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self
from urllib.parse import quote

from ccatp.core import DeckPose, Fix, PointId
from ccatp.records import store_rows as rows
from ccatp.records.store_rows import PlannedPoint, StoredFix, StoredPoint, StoreError, StoreEvent, StoreRefusal

RESERVE_BYTES = 2 * 1024 * 1024  # five times what 800 fixes and 2,000 events take
EVENT_QUEUE = 1000
BATCH = 256

FailureCallback = Callable[[StoreError], None]


@dataclass(slots=True)
class _Job:
    work: Callable[[sqlite3.Connection], Any]
    queued_s: float
    future: "Future[Any] | None" = None  # None: nobody waits, may be dropped where there is no room
    point: PointId | None = None  # measured once committed


class MissionStore:
    """The mission database of one run, owned by one process; made by ``create`` or ``open``.

    Recording returns at once and may be done from an asyncio loop. ``points``, ``fixes``, ``events``, ``arrivals`` and
    ``close`` wait for the writer thread.

    Attributes:
        meta: mirror, seed, config_sha256 and schema_version, as text.
        damaged: points whose stored fix did not pass its checksum at ``open``; they are planned again.
        failure: the error that ended all writing, if any.
        events_dropped: events and arrivals that found the queue or the disk full.
    """

    def __init__(self, path: Path, db: sqlite3.Connection, on_failure: FailureCallback | None) -> None:
        self.path = path
        self.meta: dict[str, str] = dict(db.execute("SELECT key, value FROM meta"))
        self.damaged = tuple(rows.replan_damaged(db))
        self.failure: StoreError | None = None
        self.events_dropped = 0
        self._db = db
        self._on_failure = on_failure
        self._measured = {p.point for p in rows.select_points(db) if p.status == "measured"}
        self._jobs: deque[_Job] = deque()
        self._batch: list[_Job] = []
        self._waiting_events = 0
        self._closing = False
        self._wake = threading.Condition()
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
        points: Iterable[PlannedPoint],
        on_failure: FailureCallback | None = None,
        reserve_bytes: int = RESERVE_BYTES,
    ) -> Self:
        """Make a new store with all points planned; the file appears complete or not at all.

        Args:
            path: a file that does not exist.
            config_toml: the run's exact configuration; its SHA-256 is kept.
            on_failure: called once, from the writer thread, when writing has ended for good.

        Raises:
            StoreError: the file exists, or cannot be made.
        """
        digest = hashlib.sha256(config_toml.encode()).hexdigest()
        rows.make_file(path, points, {"mirror": mirror, "seed": str(seed), "config_sha256": digest}, reserve_bytes)
        return cls.open(path, mirror=mirror, on_failure=on_failure)

    @classmethod
    def open(cls, path: Path, *, mirror: str, on_failure: FailureCallback | None = None) -> Self:
        """Open the store of an earlier run to go on with it.

        Args:
            mirror: the mirror about to be surveyed; must be that of the file.
            on_failure: as for ``create``.

        Raises:
            StoreError: no such file, not a mission store, another schema or mirror, or damaged.
        """
        return cls(path, rows.open_file(path, mirror), on_failure)

    def record_fix(self, point: PointId, fix: Fix, estimate: DeckPose, *, remeasure: bool = False) -> "Future[int]":
        """Store a fix and make its point measured, in one transaction.

        Args:
            fix: the puck in the world frame, with covariance.
            estimate: estimated deck pose at that time.
            remeasure: replace the fix of a point that has one; the old row stays in the table.

        Returns:
            Resolves to the number of the fix after the commit (await it with ``asyncio.wrap_future``). Fails with
            ``AlreadyMeasuredError``, ``UnknownPointError``, ``StoreRefusal`` (not finite, or a covariance not of nine
            values) or, where nothing will be stored any more, another ``StoreError``.
        """
        return self._submit(
            lambda db: rows.insert_fix(db, point, rows.fix_values(point, fix, estimate), remeasure), point
        )

    def record_skipped(self, point: PointId, t_s: float) -> "Future[None]":
        """Mark a point as skipped (it may still be measured later); resolves and fails like ``record_fix``."""
        return self._submit(lambda db: rows.skip_point(db, point, t_s))

    def record_event(self, event: StoreEvent) -> bool:
        """Store an event without waiting; False where it was dropped because the queue is full or writing has ended."""
        wall_utc = datetime.now(UTC).isoformat(timespec="milliseconds")
        return self._post(lambda db: rows.insert_event(db, event, wall_utc))

    def record_arrival(self, point: PointId, t_s: float, estimated_error_m: float) -> bool:
        """Store that the robot came to rest at a point, without waiting; returns as ``record_event``."""
        return self._post(lambda db: rows.insert_arrival(db, point, t_s, estimated_error_m))

    def measured_points(self) -> set[PointId]:
        """The points whose fix is committed."""
        with self._wake:
            return set(self._measured)

    def points(self) -> list[StoredPoint]:
        """All points, by row, column and number."""
        return list(self._submit(rows.select_points).result())

    def fixes(self, *, history: bool = False) -> list[StoredFix]:
        """The fix of each measured point in the order of measuring; with ``history`` replaced ones too."""
        return list(self._submit(lambda db: rows.select_fixes(db, history)).result())

    def events(self) -> list[tuple[int, StoreEvent, str]]:
        """All events: number, event, wall time (UTC, a label only)."""
        return list(self._submit(rows.select_events).result())

    def arrivals(self) -> list[tuple[PointId, float, float]]:
        """All arrivals: point, time (s), estimated error (m)."""
        return list(self._submit(rows.select_arrivals).result())

    @property
    def queue_age_s(self) -> float:
        """How long the oldest request has waited for its commit, s; grows when the disk stalls."""
        with self._wake:
            oldest = self._batch[0] if self._batch else self._jobs[0] if self._jobs else None
            return 0.0 if oldest is None else time.monotonic() - oldest.queued_s

    def close(self, timeout_s: float = 10.0) -> None:
        """Commit what is queued and close the file; again is harmless. Raises ``StoreError`` after the time-out."""
        with self._wake:
            self._closing = True
            self._wake.notify()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise StoreError(f"{self.path}: writer still busy after {timeout_s} s")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _submit(self, work: Callable[[sqlite3.Connection], Any], point: PointId | None = None) -> "Future[Any]":
        future: Future[Any] = Future()
        with self._wake:
            refused = self.failure or (StoreError(f"{self.path}: is closed") if self._closing else None)
            if refused is None:
                self._jobs.append(_Job(work, time.monotonic(), future, point))
                self._wake.notify()
        if refused is not None:
            future.set_exception(refused)
        return future

    def _post(self, work: Callable[[sqlite3.Connection], Any]) -> bool:
        with self._wake:
            if self._waiting_events >= EVENT_QUEUE or self._closing or self.failure is not None:
                self.events_dropped += 1
                return False
            self._waiting_events += 1
            self._jobs.append(_Job(work, time.monotonic()))
            self._wake.notify()
            return True

    def _run(self) -> None:
        try:
            while (batch := self._take_batch()) is not None:
                self._write(batch)
        except Exception as error:
            self._end(f"{type(error).__name__}: {error}", [])
            raise
        finally:
            with suppress(sqlite3.Error):
                self._db.execute("PRAGMA journal_mode = DELETE")
            self._db.close()

    def _take_batch(self) -> list[_Job] | None:
        with self._wake:
            self._batch = []
            self._wake.wait_for(lambda: self._jobs or self._closing)
            if not self._jobs:
                return None
            jobs = [self._jobs.popleft() for _ in range(min(BATCH, len(self._jobs)))]
            self._waiting_events -= sum(job.future is None for job in jobs)
            # A request cancelled before it began is left out; from here on it can no longer be cancelled.
            self._batch = [job for job in jobs if job.future is None or job.future.set_running_or_notify_cancel()]
            return self._batch

    def _write(self, batch: list[_Job]) -> None:
        try:
            self._commit(batch)
        except sqlite3.Error as error:
            waited_for = [job for job in batch if job.future is not None]
            if self._rolled_back() and error.sqlite_errorname == "SQLITE_FULL" and len(waited_for) < len(batch):
                # Events give way to fixes, for which there may be room in what was taken at the start.
                self.events_dropped += len(batch) - len(waited_for)
                self._write(waited_for)
            else:
                # Final: after a failed fsync a repeated one may report a success that never reached the disk.
                self._end(f"{error} ({error.sqlite_errorname})", batch)

    def _commit(self, batch: list[_Job]) -> None:
        done: list[tuple[_Job, Any]] = []
        self._db.execute("BEGIN IMMEDIATE")
        for job in batch:
            done.append((job, self._one(job)))
        self._db.execute("COMMIT")
        with self._wake:
            self._measured.update(j.point for j, r in done if j.point is not None and not isinstance(r, StoreError))
        for job, result in done:
            if job.future is None:
                self.events_dropped += isinstance(result, StoreError)
            elif isinstance(result, StoreError):
                job.future.set_exception(result)
            else:
                job.future.set_result(result)

    def _one(self, job: _Job) -> Any:
        # One request that the database does not take must not take the others of its batch with it.
        self._db.execute("SAVEPOINT job")
        try:
            result = job.work(self._db)
        except (StoreRefusal, sqlite3.IntegrityError, sqlite3.ProgrammingError, TypeError, OverflowError) as error:
            self._db.execute("ROLLBACK TO job")
            result = error if isinstance(error, StoreRefusal) else StoreRefusal(f"{self.path}: not storable: {error}")
        self._db.execute("RELEASE job")
        return result

    def _rolled_back(self) -> bool:
        with suppress(sqlite3.Error):
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            return True
        return False

    def _end(self, reason: str, batch: list[_Job]) -> None:
        failure = StoreError(f"{self.path}: cannot write any more: {reason}")
        with self._wake:
            self.failure = failure
            lost = [*(batch or self._batch), *self._jobs]
            self._jobs.clear()
        for job in lost:
            if job.future is None:
                self.events_dropped += 1
            elif not job.future.done():
                job.future.set_exception(failure)
        if self._on_failure is not None:
            self._on_failure(failure)


_BUSY_TIMEOUT_S = 10.0
# What SQLite says of a file whose last transaction was cut off: it cannot be read before it has been rolled back.
_CUT_OFF = ("SQLITE_READONLY", "SQLITE_CANTOPEN")


class StoredSurvey(NamedTuple):
    """What a mission database holds.

    Attributes:
        damaged: points whose fix does not match its checksum.
    """

    points: list[StoredPoint]
    fixes: list[StoredFix]
    damaged: list[PointId]


def read_survey(path: Path, mirror: str) -> StoredSurvey:
    """Read a mission database; the file is not changed.

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
