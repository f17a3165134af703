"""Mission database and checkpoint: what is acknowledged stays, what is damaged is noticed, versions are refused."""

import hashlib
import random
import sqlite3
import subprocess
import sys
import threading
import zlib
from concurrent.futures import Future
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from ccatp.core import DeckPose, Fix, PointId
from ccatp.records import store
from ccatp.records.checkpoint import CheckpointError, CheckpointFile, read_checkpoint
from ccatp.records.store import AlreadyMeasuredError, MissionStore, StoredPoint, StoreError, StoreRefusal

PANEL = [PointId(1, 2, n) for n in range(1, 10)]
POSE = DeckPose(0.1, 0.2, 0.3)


def a_fix(t_s: float = 1.5) -> Fix:
    return Fix(t_s, (1.0, 2.0 + t_s, 3.0), tuple(i * 1e-12 for i in range(9)), 1.7, (1, 2, 5, 8), 2e-6)


def make(path: Path, reserve_bytes: int = 0, points: list[PointId] = PANEL) -> MissionStore:
    plan = [StoredPoint(p, 0.22, -0.25) for p in points]
    return MissionStore.create(
        path, mirror="fyst-m1", seed=1, config_toml="[run]\n", points=plan, reserve_bytes=reserve_bytes
    )


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "mission.sqlite"


def measured(db: MissionStore) -> set[PointId]:
    return {p.point for p in db.points() if p.status == "measured"}


def test_a_fix_comes_back_as_it_was(path: Path) -> None:
    with make(path) as db:
        assert db.record_fix(PANEL[4], a_fix(), POSE).result() == 1
        db.record_arrival(PANEL[1], 3.5, 0.0004)
        assert measured(db) == {PANEL[4]}
    with MissionStore.open(path, mirror="fyst-m1") as db:
        assert db.fixes() == [(PANEL[4], a_fix())]
        rows = {row.point: row[1:5] for row in db.points()}
        assert (rows[PANEL[4]], rows[PANEL[0]]) == ((0.22, -0.25, "measured", 1.5), (0.22, -0.25, "planned", None))
        assert db.damaged == ()
    assert select(path, "SELECT row, col, point, t_s, estimated_error_m FROM arrivals") == [(*PANEL[1], 3.5, 0.0004)]
    assert select(path, "SELECT estimate_x_m, estimate_y_m, estimate_heading_rad FROM fixes") == [
        (POSE.x_m, POSE.y_m, POSE.heading_rad)
    ]
    meta = dict(select(path, "SELECT key, value FROM meta"))
    assert (meta["seed"], meta["config_sha256"]) == ("1", hashlib.sha256(b"[run]\n").hexdigest())


def test_lengths_and_their_judgement_come_back(path: Path) -> None:
    judged = replace(a_fix(), left_out=(7,), lengths_m=(4.1, 5.2, 6.3, 7.4, 0.1))
    fix = replace(judged, metrology="unreliable", suspects=(1, 7), detectable_m=3e-5, protection_m=None)
    with make(path) as db:
        db.record_fix(PANEL[0], fix, POSE).result()
    assert store.read_survey(path, "fyst-m1").fixes[0].fix == fix


def test_a_database_of_version_1_is_read_and_continued(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as old:
        old.setattr(store, "SCHEMA_VERSION", 1)
        old.setattr(store, "_SCHEMA", store._SCHEMAS["1"])
        make(path).close()
    assert "lengths_m" not in store._SCHEMAS["1"]
    with MissionStore.open(path, mirror="fyst-m1") as db:
        db.record_fix(PANEL[0], replace(a_fix(), lengths_m=(1.0,), metrology="good"), POSE).result()
        assert db.fixes()[0].fix == a_fix()
    with MissionStore.open(path, mirror="fyst-m1") as db:
        assert (db.damaged, measured(db)) == ((), {PANEL[0]})


def test_a_measured_point_is_not_measured_again(path: Path) -> None:
    with make(path) as db:
        gate = hold(db)
        first, second = db.record_fix(PANEL[0], a_fix(1.0), POSE), db.record_fix(PANEL[0], a_fix(2.0), POSE)
        gate.set()
        assert first.result() == 1
        with pytest.raises(AlreadyMeasuredError, match="1/2/1 has been measured; its fix is not replaced"):
            second.result()
        assert [f.fix.t_s for f in db.fixes()] == [1.0]
    assert select(path, "SELECT count(*) FROM fixes") == [(1,)]


def test_a_skipped_point_may_be_measured_later_and_not_the_other_way_round(path: Path) -> None:
    with make(path) as db:
        db.record_skipped(PANEL[0], 9.0).result()
        assert [p.point for p in db.points() if p.status == "skipped"] == [PANEL[0]]
        db.record_fix(PANEL[0], a_fix(), POSE).result()
        with pytest.raises(AlreadyMeasuredError, match="cannot be skipped"):
            db.record_skipped(PANEL[0], 10.0).result()


def test_a_refused_request_harms_no_other(path: Path) -> None:
    with make(path) as db:
        gate = hold(db)
        short = Fix(1.0, (0.0, 0.0, 0.0), (1.0,), 1.0, (1,), 0.0)
        refused: dict[str, Future[Any]] = {
            "9/9/9 is not one": db.record_fix(PointId(9, 9, 9), a_fix(), POSE),
            "1/2/2: a value is not finite": db.record_fix(PANEL[1], a_fix(float("nan")), POSE),
            "covariance is not of 9": db.record_fix(PANEL[2], short, POSE),
            "not storable": db.record_skipped(PANEL[0], object()),  # type: ignore[arg-type]
        }
        db.record_arrival(PANEL[0], None, 0.0)  # type: ignore[arg-type]
        good = db.record_fix(PANEL[0], a_fix(), POSE)
        gate.set()
        for why, request in refused.items():
            with pytest.raises(StoreRefusal, match=why):
                request.result()
        assert good.result() == 1
        assert db.failure is None
    assert select(path, "SELECT * FROM arrivals") == []


def test_a_request_refused_half_way_leaves_nothing_behind(path: Path) -> None:
    def half(connection: sqlite3.Connection) -> None:
        connection.execute("INSERT INTO meta VALUES ('half', '1')")
        connection.execute("INSERT INTO meta VALUES ('half', '2')")

    with make(path) as db:
        with pytest.raises(StoreRefusal, match="not storable: UNIQUE"):
            db._submit(half).result()
        assert db._submit(lambda c: c.execute("SELECT * FROM meta WHERE key = 'half'").fetchall()).result() == []


def test_the_queue_is_bounded_and_drops_arrivals(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "QUEUE_LIMIT", 3)
    with make(path) as db:
        gate = hold(db)
        for i in range(5):
            db.record_arrival(PANEL[0], float(i), 0.0)
        gate.set()
    assert select(path, "SELECT t_s FROM arrivals") == [(0.0,), (1.0,), (2.0,)]


def test_a_cancelled_request_is_not_executed(path: Path) -> None:
    with make(path) as db:
        gate = hold(db)
        late = db.record_fix(PANEL[0], a_fix(), POSE)
        assert late.cancel()
        gate.set()
        assert db.fixes() == []
        assert measured(db) == set()


def test_close_commits_what_is_queued_and_ends_the_store(path: Path) -> None:
    db = make(path)
    gate = hold(db)
    waiting = db.record_fix(PANEL[0], a_fix(), POSE)
    gate.set()
    db.close()
    db.close()
    assert waiting.result() == 1
    assert [p.name for p in path.parent.iterdir()] == ["mission.sqlite"]  # no journal is left behind
    with pytest.raises(StoreError, match="is closed"):
        db.record_fix(PANEL[1], a_fix(), POSE).result()
    db.record_arrival(PANEL[0], 1.0, 0.0)  # dropped


def test_close_says_when_the_writer_does_not_end(path: Path) -> None:
    db = make(path)
    gate = hold(db)
    with pytest.raises(StoreError, match="writer still busy"):
        db.close(timeout_s=0.0)
    gate.set()
    db.close()


def test_create_refuses_an_existing_file_and_an_impossible_one(path: Path) -> None:
    make(path).close()
    with pytest.raises(StoreError, match="exists already"):
        make(path)
    with pytest.raises(StoreError, match="cannot be made"):
        make(path.parent / "nowhere" / "mission.sqlite")


def test_create_survives_the_leftovers_of_a_killed_one(path: Path) -> None:
    path.with_name("mission.sqlite.new").write_bytes(b"half")
    path.with_name("mission.sqlite.new-journal").write_bytes(b"half")
    with make(path) as db:
        assert len(db.points()) == 9


@pytest.mark.parametrize(
    ("statement", "why"),
    [
        ("UPDATE meta SET value = 'fyst-m2' WHERE key = 'mirror'", "meta data or targets do not match their checksum"),
        ("UPDATE meta SET value = '99' WHERE key = 'schema_version'", "schema version 99, this program has 2"),
        ("UPDATE points SET x_m = 0.23 WHERE point = 3", "do not match their checksum"),
        ("ALTER TABLE events RENAME COLUMN cause TO clause", "its tables are not those of schema version 2"),
    ],
)
def test_open_refuses_what_was_altered(path: Path, statement: str, why: str) -> None:
    make(path).close()
    alter(path, statement)
    with pytest.raises(StoreError, match=why):
        MissionStore.open(path, mirror="fyst-m1")


def test_open_refuses_what_is_not_this_mission(path: Path) -> None:
    with pytest.raises(StoreError, match="no such file"):
        MissionStore.open(path, mirror="fyst-m1")
    make(path).close()
    with pytest.raises(StoreError, match="is a survey of fyst-m1, not of fyst-m2"):
        MissionStore.open(path, mirror="fyst-m2")
    sound = path.read_bytes()
    path.write_bytes(sound[:-100])
    with pytest.raises(StoreError, match=rf"cut off at {len(sound) - 100} of {len(sound)} bytes"):
        MissionStore.open(path, mirror="fyst-m1")
    path.write_bytes(b"something else entirely" * 100)
    with pytest.raises(StoreError, match="not a mission store"):
        MissionStore.open(path, mirror="fyst-m1")


@pytest.mark.parametrize("change", ["z_m = z_m + 1e-9", "channels = CAST(x'a0' AS TEXT)"])  # the latter is no text
def test_a_damaged_fix_makes_its_point_planned_again(path: Path, change: str) -> None:
    with make(path) as db:
        for point in PANEL[:2]:
            db.record_fix(point, a_fix(), POSE).result()
    alter(path, f"UPDATE fixes SET {change} WHERE id = 2")
    with MissionStore.open(path, mirror="fyst-m1") as db:
        assert db.damaged == (PANEL[1],)
        assert measured(db) == {PANEL[0]}
        assert db.record_fix(PANEL[1], a_fix(), POSE).result() == 3


def test_arrivals_give_way_to_fixes_when_the_disk_is_full(path: Path) -> None:
    make(path, reserve_bytes=20_000).close()
    with MissionStore.open(path, mirror="fyst-m1") as db:
        gate = hold(db)
        refused = db._submit(lambda c: c.execute("PRAGMA max_page_count = 1"))  # "disk full": no further page
        db.record_arrival(PANEL[0], "far too long" * 5000, 0.0)  # type: ignore[arg-type]
        fix = db.record_fix(PANEL[0], a_fix(), POSE)
        gate.set()
        refused.result()
        assert fix.result() == 1
        assert db.failure is None
    assert select(path, "SELECT * FROM arrivals") == []


def test_a_lock_of_another_program_is_no_end(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "BUSY_TIMEOUT_S", 0.05)
    make(path).close()
    with MissionStore.open(path, mirror="fyst-m1") as db:
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN EXCLUSIVE")
            with pytest.raises(StoreError, match=r"locked by another program: database is locked \(SQLITE_BUSY\)"):
                db.record_fix(PANEL[0], a_fix(), POSE).result(timeout=5.0)
        assert db.failure is None
        assert db.record_fix(PANEL[0], a_fix(), POSE).result(timeout=5.0) == 1


def test_a_surprise_in_the_writer_ends_the_store(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def surprise(*_: object) -> int:
        raise RuntimeError("surprise")

    monkeypatch.setattr(store, "_insert_fix", surprise)
    db = make(path)
    with pytest.raises(StoreError, match="RuntimeError: surprise"):
        db.record_fix(PANEL[0], a_fix(), POSE).result(timeout=5.0)
    db.close()


WRITER = """
import sys
from pathlib import Path
from ccatp.core import DeckPose, Fix, PointId
from ccatp.records.store import MissionStore
db = MissionStore.open(Path(sys.argv[1]), mirror="fyst-m1")
for point in (p.point for p in db.points() if p.status != "measured"):
    db.record_arrival(point, 1.0, 0.0)
    fix = Fix(float(point.row), (1.0, 2.0, 3.0), (0.0,) * 9, 1.0, (1, 2, 3, 4), 0.0)
    db.record_fix(point, fix, DeckPose(0.0, 0.0, 0.0)).result()
    print(*point, flush=True)
"""


def test_what_was_acknowledged_survives_kill_9_at_any_instant(path: Path) -> None:
    points = [PointId(row, 1, n) for row in range(1, 201) for n in range(1, 10)]
    make(path, reserve_bytes=200_000, points=points).close()
    rng = random.Random(3)
    acknowledged: set[PointId] = set()
    for run in range(1, 5):
        with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            for _ in range(rng.randrange(1, 40)):
                acknowledged.add(PointId(*map(int, child.stdout.readline().split())))
            for _ in range(rng.randrange(20_000)):  # up to a millisecond: somewhere inside the next commit
                pass
            child.kill()
            acknowledged |= {PointId(*map(int, line.split())) for line in child.stdout if line.endswith("\n")}
        with MissionStore.open(path, mirror="fyst-m1") as db:  # checks integrity
            assert db.damaged == ()
            assert acknowledged <= measured(db)
            assert len(measured(db) - acknowledged) <= run  # at most the one in flight of each run
            assert {f.point for f in db.fixes()} == measured(db)


def hold(db: MissionStore) -> threading.Event:
    """Keep the writer thread busy until the event is set."""
    gate, began = threading.Event(), threading.Event()

    def wait(_: sqlite3.Connection) -> None:
        began.set()
        gate.wait(30.0)

    db._submit(wait)
    assert began.wait(10.0)
    return gate


def select(path: Path, query: str) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(path)) as db:
        return db.execute(query).fetchall()


def alter(path: Path, statement: str) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute(statement)
    connection.close()


# -- the checkpoint ----------------------------------------------------------------------------------------------------

SLOT = 65536


class Place(msgspec.Struct, frozen=True, tag=2, forbid_unknown_fields=True):
    number: int
    x_m: float = 1.25
    note: str = "driving"


class NewerPlace(Place, frozen=True, tag=2, forbid_unknown_fields=True):
    y_m: float = -0.5


@pytest.mark.parametrize("is_patient", [True, False])
def test_the_newest_record_is_read_back(tmp_path: Path, is_patient: bool) -> None:
    path = tmp_path / "checkpoint"
    file = CheckpointFile(path, is_patient=is_patient)
    for count in range(1, 8):
        file.write(Place(count), is_durable=count % 3 == 0)
    file.close()
    assert read_checkpoint(path, Place) == Place(7)
    assert file.failure == ""
    again = CheckpointFile(path, is_patient=is_patient)
    again.write(Place(8))
    again.close()
    assert read_checkpoint(path, Place) == Place(8)


def test_nothing_there(tmp_path: Path) -> None:
    assert read_checkpoint(tmp_path / "none", Place) is None
    (tmp_path / "empty").touch()
    with pytest.raises(CheckpointError, match="empty: empty, so the robot's place is not known; set it at base"):
        read_checkpoint(tmp_path / "empty", Place)
    CheckpointFile(tmp_path / "new", is_patient=True).close()
    assert not (tmp_path / "new").exists()  # until it has a record


@pytest.mark.fault("P16")
def test_flipped_bits_and_cuts_leave_a_whole_record_or_none(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    file = CheckpointFile(path, is_patient=True)
    file.write(Place(1))
    file.write(Place(2))
    file.close()
    whole = path.read_bytes()
    length = len(whole) - SLOT  # of either slot: length, checksum, count and record
    for offset in (*range(length), *range(SLOT, len(whole))):
        path.write_bytes(whole[:offset] + bytes([whole[offset] ^ 1 << offset % 8]) + whole[offset + 1 :])
        assert read_checkpoint(path, Place) == Place(1 if offset < length else 2)  # the other slot is untouched
    for cut in (*range(1, length), *range(length, SLOT, 997), *range(SLOT, len(whole))):
        path.write_bytes(whole[:cut])
        # Nobody knows where the robot is, and least of all is it at base; of two records the newer one may be gone.
        if cut <= SLOT:
            with pytest.raises(CheckpointError, match="damaged" if cut < length else "cut off"):
                read_checkpoint(path, Place)
        else:
            assert read_checkpoint(path, Place) == Place(2)


def test_a_checkpoint_that_lost_its_second_slot_is_refused(tmp_path: Path) -> None:
    """Its first slot alone may be the older one, with another place or without an operator's hold."""
    path = tmp_path / "checkpoint"
    writer = CheckpointFile(path, is_patient=True)
    for k in (1, 2, 3):
        writer.write(Place(k))
    writer.close()
    whole = path.read_bytes()
    assert read_checkpoint(path, Place) == Place(3)
    for kept in (0, 1, 30, len(whole) // 2, whole.rindex(b"\0" * 64) + 64):
        path.write_bytes(whole[:kept])
        with pytest.raises(CheckpointError, match="so the robot's place is not known"):
            read_checkpoint(path, Place)


def test_a_record_longer_than_a_slot_takes_the_older_one_with_it(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    file = CheckpointFile(path, is_patient=True)
    for number in (1, 2, 3):
        file.write(Place(number, note=SLOT * "x"))
        found = read_checkpoint(path, Place)
        assert found is not None
        assert found.number == number
    file.close()


@pytest.mark.parametrize(
    "record", [{"count": 1, "boot": 7}, {"type": 1, "number": 1}, NewerPlace(1), {"type": 2, "x_m": 0.0}, 1]
)
def test_a_record_of_another_version_is_refused(tmp_path: Path, record: object) -> None:
    path = tmp_path / "checkpoint"
    file = CheckpointFile(path, is_patient=True)
    file.write(record)  # type: ignore[arg-type]
    file.close()
    refusal = r"^\S*checkpoint: written by a version of ccatp with another format, so the robot's place is not known"
    with pytest.raises(CheckpointError, match=refusal):
        read_checkpoint(path, Place)


def test_a_record_of_before_is_refused(tmp_path: Path) -> None:
    """Slots of 4096 bytes with JSON behind length and checksum."""
    body = b'{"count": 1, "boot": 7, "state": "driving"}'
    path = tmp_path / "checkpoint"
    path.write_bytes(len(body).to_bytes(4, "little") + zlib.crc32(body).to_bytes(4, "little") + body)
    with pytest.raises(CheckpointError, match="with another format"):
        read_checkpoint(path, Place)


def test_a_disk_that_refuses_is_reported_and_the_mission_is_unaffected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> int:
        raise OSError(28, "No space left on device")

    file = CheckpointFile(tmp_path / "checkpoint", is_patient=True)
    with monkeypatch.context() as patch:
        patch.setattr("os.pwrite", refuse)
        file.write(Place(1))
    assert file.failure == "No space left on device"
    file.write(Place(2))
    assert file.failure == ""
    file.close()
