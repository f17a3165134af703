"""Storage that fails: full, slow, broken. Measurements survive, or the run holds with a clear message."""

import asyncio
import gc
import sqlite3
import time
from concurrent.futures import Future
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import pytest

from ccatp.config.models import Config
from ccatp.core import DeckPose, Fix, PointId
from ccatp.daemon.loops import fix_service as measuring
from ccatp.daemon.supervision.process import LogStream, open_log
from ccatp.records.store import MissionStore, StoredPoint, StoreError
from tests.faults.linking import Measured
from tests.support.sim_survey import Desk, serving
from tests.unit.records.test_recorder import full_beyond
from tests.unit.records.test_store import hold

POINTS = [PointId(row, col, n) for row in range(1, 10) for col in range(1, 9) for n in range(1, 10)][: 77 * 9]
FIX = Fix(1.5, (1.0, 2.0, 3.0), (1e-12,) * 9, 1.7, (1, 2, 5, 8), 2e-6)
POSE = DeckPose(0.1, 0.2, 0.3)


def make(path: Path, points: list[PointId] = POINTS) -> MissionStore:
    plan = [StoredPoint(p, 0.22, -0.25) for p in points]
    return MissionStore.create(path, mirror="fyst-m1", seed=1, config_toml="", points=plan)


# -- P13: a disk that is full -----------------------------------------------------------------------------------------


@pytest.mark.fault("P13")
def test_a_whole_mirror_is_measured_on_a_disk_that_gives_nothing_more(tmp_path: Path, measured: Measured) -> None:
    path = tmp_path / "mission.sqlite"
    with make(path) as store, full_beyond(path.stat().st_size):
        with pytest.raises(OSError, match="File too large"):  # the limit is real
            (tmp_path / "probe").write_bytes(bytes(2 * path.stat().st_size))
        for first in range(0, len(POINTS), 9):
            fixes = []
            for k, point in enumerate(POINTS[first : first + 9], first):
                store.record_arrival(point, float(k), 0.001)
                fixes.append(store.record_fix(point, FIX, POSE))
            assert all(fix.result(timeout=30.0) for fix in fixes)
    with MissionStore.open(path, mirror="fyst-m1") as store:
        lost = set(POINTS) - {fix.point for fix in store.fixes()}
    with closing(sqlite3.connect(path)) as db:
        assert db.execute("SELECT count(*) FROM arrivals").fetchone() == (len(POINTS),)
    measured("P13", len(lost))
    assert not lost


@pytest.mark.fault("P13")
def test_a_log_on_a_full_disk_drops_lines_and_reports_it_once(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    log = open_log(tmp_path / "log.jsonl", "main")
    with full_beyond(4096):
        for k in range(500):
            log.warning("held", cause="no fresh verdict", seq=k)
    complaint = capfd.readouterr().err
    assert complaint.count("\n") == 1
    assert "ccatp main" in complaint
    assert "lines are dropped" in complaint


def test_a_log_continues_where_there_is_room_again(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    with LogStream(path, "main") as stream:
        with full_beyond(100):
            for k in range(20):
                stream.write(f'{{"line": {k}}}\n')
        stream.write('{"line": "last"}\n')
        assert stream.dropped > 5
    lines = path.read_text().splitlines()
    assert lines[-1] == '{"line": "last"}'
    assert lines[:7] == [f'{{"line": {k}}}' for k in range(7)]


# -- P14: a disk that is slow -----------------------------------------------------------------------------------------


@pytest.mark.fault("P14")
def test_nobody_waits_for_a_stalled_disk(tmp_path: Path, measured: Measured) -> None:
    with make(tmp_path / "mission.sqlite", POINTS[:9]) as store:
        release = hold(store)
        gc.collect()  # or it comes due in between, and visits all that other tests have left
        futures, longest_s = list[Future[int]](), 0.0
        for point in POINTS[:9]:  # what a pass of the control loop does at a stop, and more
            begun_s = time.thread_time()
            futures.append(store.record_fix(point, FIX, POSE))
            for _ in range(50):
                store.record_arrival(point, 1.0, 0.001)
            longest_s = max(longest_s, time.thread_time() - begun_s)
        # All of it came back while the writer was stuck: it cannot have waited.
        assert not release.is_set()
        assert not any(future.done() for future in futures)
        measured("P14", 1e3 * longest_s)
        release.set()
        assert [future.result(timeout=30.0) for future in futures] == list(range(1, 10))


async def a_fix(*_: object) -> Fix:
    return FIX


@pytest.mark.fault("P14")
async def test_the_robot_is_held_where_the_disk_stalls_and_the_point_counts_once_it_is_stored(
    tmp_path: Path, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measuring, "SLOW_DISK_S", 0.05)
    monkeypatch.setattr(measuring, "STALLED_DISK_S", 0.15)
    with make(tmp_path / "mission.sqlite", POINTS[:9]) as store:
        desk = Desk(config, a_fix, store)
        async with serving(desk.service), asyncio.timeout(20.0):
            release = hold(store)
            desk.begin(POINTS[0])
            await desk.faulted.wait()
            assert any("the disk is slow: point 1-1-1" in text for text in desk.said)
            assert "the disk stalls: point 1-1-1 is not stored" in desk.faults[0]
            assert desk.done == []
            desk.over.clear()
            release.set()
            await desk.over.wait()
        assert desk.done == [POINTS[0]]
        assert [stored.point for stored in store.fixes()] == [POINTS[0]]


# -- P15: a disk that is broken ---------------------------------------------------------------------------------------


class Broken:
    """A connection whose commits fail as SQLite says it when fsync returns EIO; afterwards it would work again."""

    def __init__(self, db: sqlite3.Connection, name: str) -> None:
        self._db, self._name, self.is_armed, self.commits = db, name, False, 0

    def execute(self, sql: str, *parameters: Any) -> Any:
        if sql == "COMMIT":
            self.commits += 1
            if self.is_armed:
                self.is_armed = False
                error = sqlite3.OperationalError("disk I/O error")
                error.sqlite_errorname = self._name
                raise error
        return self._db.execute(sql, *parameters)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._db, name)


ERRORS = (
    "SQLITE_IOERR_FSYNC", "SQLITE_IOERR_WRITE", "SQLITE_IOERR_DIR_FSYNC", "SQLITE_CORRUPT", "SQLITE_READONLY",
    "SQLITE_FULL",
)  # fmt: skip


@pytest.mark.fault("P15")
@pytest.mark.parametrize("name", ERRORS)
def test_after_an_error_nothing_is_acknowledged(tmp_path: Path, name: str, measured: Measured) -> None:
    path = tmp_path / "mission.sqlite"
    with make(path, POINTS[:9]) as store:
        broken = Broken(store._db, name)
        store._db = cast(sqlite3.Connection, broken)
        assert store.record_fix(POINTS[0], FIX, POSE).result(timeout=10.0) == 1
        broken.is_armed = True
        with pytest.raises(StoreError, match=rf"cannot write any more: disk I/O error \({name}\)"):
            store.record_fix(POINTS[1], FIX, POSE).result(timeout=10.0)
        commits = broken.commits
        late = [store.record_fix(point, FIX, POSE) for point in POINTS[2:9]]
        acknowledged = sum(future.exception(timeout=10.0) is None for future in late)
        store.record_arrival(POINTS[0], 1.0, 0.0)
        assert broken.commits == commits  # it is not even tried
        assert store.failure is not None
    assert store.record_skipped(POINTS[1], 1.0).exception() is store.failure
    measured("P15", acknowledged)
    assert acknowledged == 0
    with MissionStore.open(path, mirror="fyst-m1") as store:
        assert [stored.point for stored in store.fixes()] == [POINTS[0]]


@pytest.mark.fault("P15")
async def test_a_broken_disk_holds_the_robot_with_the_reason(tmp_path: Path, config: Config) -> None:
    with make(tmp_path / "mission.sqlite", POINTS[:9]) as store:
        broken = Broken(store._db, "SQLITE_IOERR_FSYNC")
        store._db = cast(sqlite3.Connection, broken)
        desk = Desk(config, a_fix, store)
        broken.is_armed = True
        async with serving(desk.service), asyncio.timeout(20.0):
            for point in POINTS[:2]:
                desk.begin(point)
                await desk.over.wait()
    assert desk.done == []
    assert len(desk.faults) == 2
    assert "the fix of point 1-1-1 cannot be stored" in desk.faults[0]
    assert "SQLITE_IOERR_FSYNC" in desk.faults[1]
