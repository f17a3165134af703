"""Tests of the recorder: readable by the format's own reader, cut off anywhere, never in the mission's way."""

import json
import os
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from ccatp.records.recorder import Recorder, iter_messages, read_metadata, recordings

SCHEMA: dict[str, Any] = {"type": "object", "properties": {"n": {"type": "integer"}}}
TOPICS = [("track", SCHEMA), ("fix", SCHEMA)]


def payload(n: int, size: int = 0) -> bytes:
    return json.dumps({"n": n, "x": random.Random(n).randbytes(size).hex()}).encode()


def record(path: Path, count: int, size: int = 200, **more: Any) -> Recorder:
    made = Recorder(path, TOPICS, is_simulation=True, **more)
    for n in range(count):
        made.write("track", n / 100, payload(n, size))
    return made


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "telemetry.mcap"


def test_messages_come_back_and_the_formats_own_reader_agrees(path: Path) -> None:
    with_metadata = record(path, 500, metadata={"mirror": "fyst-m1"})
    with_metadata.write("fix", 5.25, b'{"n":7}')
    with_metadata.close()
    found = list(iter_messages(path, on_damage=pytest.fail))
    assert len(found) == 501
    assert found[-1] == ("fix", 5.25, b'{"n":7}')
    assert [m.payload for m in found[:500]] == [payload(n, 200) for n in range(500)]
    with path.open("rb") as file:
        reader = make_reader(file)
        official = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages(log_time_order=False)]
        assert official == [(m.topic, round(m.t_s * 1e9), m.payload) for m in found]
        summary = reader.get_summary()
        assert summary is not None
        assert {s.name: json.loads(s.data) for s in summary.schemas.values()} == dict(TOPICS)
        assert {s.encoding for s in summary.schemas.values()} == {"jsonschema"}
        assert {(c.message_encoding, c.metadata["simulation"]) for c in summary.channels.values()} == {("json", "true")}
        # 501 messages of 450 bytes in chunks of 16 KiB
        assert len(summary.chunk_indexes) > 10


@pytest.mark.parametrize(("is_simulation", "mark"), [(True, "true"), (False, "false")])
def test_simulation_is_marked(path: Path, is_simulation: bool, mark: str) -> None:
    Recorder(path, TOPICS, is_simulation=is_simulation, metadata={"seed": "1"}).close()
    assert read_metadata(path) == {"seed": "1", "simulation": mark}
    assert list(iter_messages(path, on_damage=pytest.fail)) == []


def test_a_file_cut_off_anywhere_gives_what_was_whole(path: Path) -> None:
    record(path, 300).close()
    whole = path.read_bytes()
    everything = list(iter_messages(path))
    rng = random.Random(2)
    counts = []
    for cut in sorted([0, 1, 8, 9, len(whole) - 1, *(rng.randrange(len(whole)) for _ in range(60))]):
        path.write_bytes(whole[:cut])
        damage: list[str] = []
        found = list(iter_messages(path, damage.append))
        assert found == everything[: len(found)]
        assert len(damage) == 1
        assert "damaged or cut off before byte" in damage[0]
        read_metadata(path)
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[-1] == 300


def test_a_flipped_bit_never_alters_a_message(path: Path) -> None:
    record(path, 200).close()
    whole = path.read_bytes()
    everything = [m.payload for m in iter_messages(path)]
    rng = random.Random(4)
    for _ in range(100):
        at = rng.randrange(len(whole))
        path.write_bytes(whole[:at] + bytes([whole[at] ^ (1 << rng.randrange(8))]) + whole[at + 1 :])
        found = [m.payload for m in iter_messages(path)]
        assert found == everything[: len(found)]


def test_slow_topics_reach_the_file_without_a_full_chunk(path: Path) -> None:
    slow = Recorder(path, TOPICS, is_simulation=True)
    for t_s in (0.5, 1.5, 1.6, 0.1):
        slow.write("fix", t_s, b"{}")
    # 0.5 s waits, 1.5 s takes it along, 1.6 s waits, a clock that went back (another boot) takes it along
    assert [m.t_s for m in iter_messages(path)] == [0.5, 1.5, 1.6, 0.1]
    slow.close()


WRITER = """
import sys
from pathlib import Path
from ccatp.records.recorder import Recorder
recorder = Recorder(Path(sys.argv[1]), [("track", {})], is_simulation=True)
n = 0
while True:
    recorder.write("track", n / 100, b'{"n":%d,"x":"%s"}' % (n, b"x" * 200))
    n += 1
    if n % 1000 == 0:
        print(n, flush=True)
"""


def test_kill_9_costs_the_last_bit_only(path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        written = [int(child.stdout.readline()) for _ in range(5)][-1]
        child.kill()
    numbers = [json.loads(m.payload)["n"] for m in iter_messages(path)]
    assert numbers == list(range(len(numbers)))
    assert len(numbers) > written - 100  # a chunk of 16 KiB holds about 70 of these messages


def test_messages_that_cannot_be_recorded_are_counted(path: Path) -> None:
    made = Recorder(path, TOPICS, is_simulation=True, on_failure=pytest.fail)
    made.write("unknown", 1.0, b"{}")
    for t_s in (float("nan"), float("inf"), -1.0):
        made.write("fix", t_s, b"{}")
    made.write("fix", 1.0, b"{}")
    made.close()
    made.write("fix", 2.0, b"{}")
    assert made.dropped == 5
    assert len(list(iter_messages(path))) == 1


def test_a_full_disk_ends_recording_with_one_report(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[str] = []
    room, real_write = 50_000, os.write

    def write(handle: int, data: memoryview) -> int:
        nonlocal room
        if room <= 0:
            raise OSError(28, "No space left on device")
        done = real_write(handle, data[:room])  # a disk that fills up takes a part first
        room -= done
        return done

    monkeypatch.setattr(os, "write", write)
    made = record(path, 2000, on_failure=reports.append)
    monkeypatch.undo()
    assert not made.is_recording
    assert made.dropped > 0
    made.close()
    made.close()
    assert len(reports) == 1
    assert "recording ended: [Errno 28] No space left" in reports[0]
    found = list(iter_messages(path))
    assert [m.payload for m in found] == [payload(n, 200) for n in range(len(found))]
    assert len(found) > 50  # of the 50 kB that went through


def test_a_system_that_writes_in_small_pieces_loses_nothing(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real_write = os.write
    monkeypatch.setattr(os, "write", lambda handle, data: real_write(handle, data[:1000]))
    record(path, 300).close()
    monkeypatch.undo()
    assert len(list(iter_messages(path, on_damage=pytest.fail))) == 300


def test_a_full_disk_at_close_is_reported_and_does_not_raise(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[str] = []
    made = record(path, 3, on_failure=reports.append)

    def write(*_: object) -> int:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "write", write)
    made.close()
    assert len(reports) == 1


def test_a_file_that_cannot_be_made_is_reported_and_does_not_raise(tmp_path: Path) -> None:
    reports: list[str] = []
    made = Recorder(tmp_path / "nowhere" / "x.mcap", TOPICS, is_simulation=True, on_failure=reports.append)
    made.write("fix", 1.0, b"{}")
    made.close()
    assert made.dropped == 1
    assert len(reports) == 1
    silent = Recorder(tmp_path / "nowhere" / "x.mcap", TOPICS, is_simulation=True)
    assert not silent.is_recording


def test_an_existing_recording_is_kept(path: Path) -> None:
    for n in range(12):
        made = Recorder(path, TOPICS, is_simulation=True)
        made.write("fix", float(n), b"{}")
        made.close()
    path.with_name("telemetry.old.mcap").write_bytes(b"not one of them")
    parts = recordings(path)
    assert [p.name for p in parts][:2] == ["telemetry.1.mcap", "telemetry.2.mcap"]
    assert parts[-1] == path
    assert [next(iter_messages(p)).t_s for p in parts] == [float(n) for n in range(12)]
    assert recordings(path.with_name("none.mcap")) == []
