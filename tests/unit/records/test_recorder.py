"""Recordings: readable by the format's own reader, cut off anywhere, repaired, never in the mission's way."""

import json
import random
import resource
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from ccatp.cli import main
from ccatp.links.runtime_dir import RUN_LOCK, locked
from ccatp.records.recorder import (
    CHUNK_BYTES,
    FLUSH_AFTER_S,
    HELD_BACK_S,
    Recorder,
    RobotClock,
    damage_text,
    iter_logged,
    iter_messages,
    read_metadata,
    recordings,
)
from ccatp.records.recording_repair import RecordingError, read_facts, recording_files, recover, strict_faults
from tests.support.command import answered, printed, refused

SCHEMA: dict[str, Any] = {"type": "object", "title": "x.Track", "properties": {"n": {"type": "integer"}}}
TOPICS: list[tuple[str, dict[str, Any]]] = [("track", SCHEMA), ("fix", {"type": "object"})]


NOON_NS = 1_800_014_400_000_000_000


def clock_at_noon() -> RobotClock:
    """A clock by which the robot was started at noon."""
    clock = RobotClock(is_simulation=True, now_ns=lambda: NOON_NS + 1)
    clock.utc_ns(1e-9)
    return clock


def payload(n: int, size: int = 0) -> bytes:
    return json.dumps({"n": n, "x": random.Random(n).randbytes(size).hex()}).encode()


def record(path: Path, count: int, size: int = 200, **more: Any) -> Recorder:
    made = Recorder(path, TOPICS, is_simulation=True, clock=clock_at_noon(), **more)
    for n in range(count):
        made.write("track", n / 100, payload(n, size))
    return made


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "telemetry.mcap"


@contextmanager
def full_beyond(size: int) -> Iterator[None]:
    """No file of this process grows beyond a size: the kernel refuses, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


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
        messages = [(c, m) for _, c, m in reader.iter_messages(log_time_order=False)]
        assert [m.publish_time for _, m in messages] == [round(m.t_s * 1e9) for m in found]  # the robot's clock
        official = [(c.topic, m.log_time, m.data) for c, m in messages]
        assert official == [(m.topic, NOON_NS + (round(m.t_s * 1e9) or 1), m.payload) for m in found]
        summary = reader.get_summary()
        assert summary is not None
        schemas = {s.name: json.loads(s.data) for s in summary.schemas.values()}
        assert schemas == {"x.Track": SCHEMA, "fix": TOPICS[1][1]}
        assert {s.encoding for s in summary.schemas.values()} == {"jsonschema"}
        assert {(c.message_encoding, c.metadata["simulation"]) for c in summary.channels.values()} == {("json", "true")}
        # 501 messages of 450 bytes in chunks of 16 KiB
        assert len(summary.chunk_indexes) > 10


def test_a_recording_is_that_of_the_formats_own_writer_in_bounded_memory(path: Path) -> None:
    tracemalloc.start()
    made = Recorder(path, TOPICS, is_simulation=True, clock=clock_at_noon())
    sizes = []
    for n in range(1, 1201):
        made.write("track", n * FLUSH_AFTER_S, b"{}")  # a chunk each
        if n % 400 == 0:
            sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    made.close()
    assert sizes[2] - sizes[1] < 4000  # a chunk's index alone takes hundreds of bytes
    with path.with_name("own.mcap").open("wb") as own:
        writer = Writer(own, chunk_size=CHUNK_BYTES)
        writer.start(library="ccatp")
        writer.add_metadata("ccatp", {"simulation": "true"})
        for name, schema in TOPICS:
            data = json.dumps(schema, separators=(",", ":")).encode()
            number = writer.register_schema(str(schema.get("title", name)), "jsonschema", data)
            writer.register_channel(name, "json", number, {"simulation": "true"})
        for n in range(1, 1201):
            time_ns = round(n * FLUSH_AFTER_S * 1e9)
            writer.add_message(1, NOON_NS + time_ns, b"{}", time_ns, n)
            writer.flush()  # type: ignore[no-untyped-call]
        writer.finish()  # type: ignore[no-untyped-call]
    assert path.read_bytes() == Path(own.name).read_bytes()


def test_utc_follows_the_robots_clock_and_is_compared_again_when_the_robot_started() -> None:
    now_ns = NOON_NS
    clock = RobotClock(is_simulation=True, now_ns=lambda: now_ns)
    assert clock.utc_ns(0.0) == NOON_NS  # a message without a time
    now_ns += 5
    assert clock.utc_ns(7000.0) == now_ns  # a robot that was on for long
    now_ns += 1_000_000_000  # in lockstep a minute passes in a second
    assert clock.utc_ns(7060.0) == NOON_NS + 5 + 60_000_000_000
    assert clock.utc_ns(7059.0) == NOON_NS + 5 + 59_000_000_000  # a batch comes later than an event
    assert clock.utc_ns(0.0) == NOON_NS + 5 + 60_000_000_000
    now_ns += 100_000_000_000
    assert [clock.utc_ns(t_s) for t_s in (1.5, 2.0)] == [now_ns, now_ns + 500_000_000]


def test_utc_of_a_real_robot_is_corrected_where_its_clock_drifts() -> None:
    now_ns = NOON_NS
    clock = RobotClock(is_simulation=False, now_ns=lambda: now_ns)
    off_s = []
    for n in range(1, 60_001):  # ten minutes at 100 Hz of a clock that is fast by 1 per cent
        now_ns = NOON_NS + n * 10_000_000
        late_ns = 0 if n % 10 == 0 else 700_000_000  # most messages arrive as parts of batches
        off_s.append((clock.utc_ns(0.0101 * n - late_ns / 1e9) + late_ns - now_ns) / 1e9)
    assert max(map(abs, off_s[100:])) < 0.22  # 1 per cent of two intervals
    steady = RobotClock(is_simulation=False, now_ns=lambda: now_ns)
    zeros = set()
    for n in range(1, 6001):
        now_ns = NOON_NS + n * 10_000_000 + random.Random(n).randrange(5_000_000)
        zeros.add(steady.utc_ns(0.01 * n) - round(0.01 * n * 1e9))
    assert len(zeros) == 1  # what the messages take to arrive does not shift the samples


def test_a_recording_of_an_older_format_has_no_utc(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("track", "json", 0)
        writer.add_message(channel, 1_250_000_000, b"{}", 1_250_000_000)
        writer.finish()  # type: ignore[no-untyped-call]
    assert list(iter_logged(path, pytest.fail)) == [(None, ("track", 1.25, b"{}"))]
    facts = read_facts(path)
    assert (facts.span_s, facts.utc) == ((1.25, 1.25), [])


MOST_IN_A_CHUNK = 60  # 16 kB, of messages of 0.4 kB


def test_a_flipped_bit_never_alters_a_message(path: Path) -> None:
    record(path, 200).close()
    whole = path.read_bytes()
    everything = [m.payload for m in iter_messages(path)]
    rng = random.Random(4)
    for _ in range(100):
        at = rng.randrange(len(whole))
        path.write_bytes(whole[:at] + bytes([whole[at] ^ (1 << rng.randrange(8))]) + whole[at + 1 :])
        damage: list[str] = []
        found = [m.payload for m in iter_messages(path, damage.append)]
        # Of one chunk nothing is there, and everything else is.
        assert found == [one for one in everything if one in set(found)]
        first = next((k for k, (one, other) in enumerate(zip(found, everything, strict=False)) if one != other), None)
        if first is not None:
            assert found[first:] == everything[len(everything) - len(found) + first :]
        assert len(found) >= len(everything) - MOST_IN_A_CHUNK
        assert damage or found == everything


def test_slow_topics_reach_the_file_without_a_full_chunk(path: Path) -> None:
    slow = Recorder(path, TOPICS, is_simulation=True)
    for t_s in (0.5, 1.5, 1.6, 0.1):
        slow.write("fix", t_s, b"{}")
    # 0.5 s waits, 1.5 s takes it along, 1.6 s waits, a clock that went back (another boot) takes it along
    assert [m.t_s for m in iter_messages(path)] == [0.5, 1.5, 1.6, 0.1]
    slow.close()


def test_messages_that_cannot_be_recorded_are_not_used(path: Path) -> None:
    made = Recorder(path, TOPICS, is_simulation=True, on_failure=pytest.fail)
    made.write("unknown", 1.0, b"{}")
    for t_s in (float("nan"), float("inf"), -1.0):
        made.write("fix", t_s, b"{}")
    made.write("fix", 1.0, b"{}")
    made.close()
    made.write("fix", 2.0, b"{}")
    assert len(list(iter_messages(path))) == 1


def test_a_full_disk_ends_recording_with_one_report(path: Path) -> None:
    reports: list[str] = []
    with full_beyond(50_000):
        made = record(path, 2000, on_failure=reports.append)
    assert not made.is_recording
    made.write("track", 1.0, b"{}")
    made.close()
    made.close()
    assert len(reports) == 1
    assert "recording ended: File too large" in reports[0]
    found = list(iter_messages(path))
    assert [m.payload for m in found] == [payload(n, 200) for n in range(len(found))]
    assert len(found) > 50  # of the 50 kB that went through


@pytest.mark.parametrize("act", [Recorder.close, Recorder.flush_if_due])
def test_a_disk_that_fails_later_is_reported_and_does_not_raise(
    act: Callable[[Recorder], None], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reports: list[str] = []
    made = record(path, 3, on_failure=reports.append)
    monkeypatch.setattr("ccatp.records.recorder.HELD_BACK_S", 0.0)
    with full_beyond(path.stat().st_size):
        act(made)
    assert not made.is_recording
    assert len(reports) == 1
    assert "File too large" in reports[0]


def test_a_file_that_cannot_be_made_is_reported_and_does_not_raise(tmp_path: Path) -> None:
    reports: list[str] = []
    for on_failure in (reports.append, None):
        made = Recorder(tmp_path / "nowhere" / "x.mcap", TOPICS, is_simulation=True, on_failure=on_failure)
        made.write("fix", 1.0, b"{}")
        made.close()
        assert not made.is_recording
    assert len(reports) == 1


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


def numbers(path: Path) -> list[int]:
    """By the format's own reader, in the order of the file."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return [json.loads(m.data)["n"] for _, _, m in reader.iter_messages(log_time_order=False)]


@pytest.fixture
def recorded(path: Path) -> Path:
    record(path, 600, 100, metadata={"mirror": "fyst-m1"}).close()
    return path


def test_facts_of_a_recording_in_order(recorded: Path) -> None:
    facts = read_facts(recorded)
    assert facts.condition.is_complete
    assert facts.faults == []
    assert facts.condition.lost == []
    reported = facts.as_json()
    assert reported["verified"]
    assert reported["messages"] == 600
    assert (reported["start_s"], reported["end_s"]) == (0.0, 5.99)
    assert reported["utc"] == ["2027-01-15T12:00:00Z", "2027-01-15T12:00:05Z"]
    assert reported["metadata"] == {"ccatp": {"mirror": "fyst-m1", "simulation": "true"}}
    assert reported["topics"]["track"]["schema"] == "x.Track"
    assert reported["topics"]["fix"]["messages"] == 0
    assert reported["bytes_per_hour"] == pytest.approx(recorded.stat().st_size * 3600 / 5.99, abs=1)


def test_a_recording_cut_off_anywhere_gives_what_was_whole_and_is_saved(recorded: Path, tmp_path: Path) -> None:
    whole = recorded.read_bytes()
    rng = random.Random(1)
    counts = []
    cuts = [*(rng.randrange(len(whole)) for _ in range(60)), 0, 1, 8, 9, len(whole) - 1]
    for number, cut in enumerate(sorted(cuts)):
        recorded.write_bytes(whole[:cut])
        damage: list[str] = []
        there = [json.loads(m.payload)["n"] for m in iter_messages(recorded, damage.append)]
        assert len(damage) == 1
        assert "damaged or cut off at byte" in damage[0]
        assert there == list(range(len(there)))
        read_metadata(recorded)
        counts.append(len(there))
        if there and number % 3 == 0:
            saved = recover(recorded, tmp_path / f"{number}.mcap")
            assert numbers(saved.path) == there
            assert saved.messages == len(there)
            assert not saved.condition.is_complete
            assert strict_faults(saved.path) == []
            assert strict_faults(recorded)
    assert counts == sorted(counts)
    assert counts[-1] == 600


def test_damage_in_the_middle_costs_its_chunk_alone(recorded: Path, tmp_path: Path) -> None:
    whole = bytearray(recorded.read_bytes())
    rng = random.Random(3)
    lost = []
    for number in range(20):
        at = rng.randrange(20_000, len(whole) - 5000)
        length = rng.choice((1, 1, 30))
        recorded.write_bytes(bytes(whole[:at]) + rng.randbytes(length) + bytes(whole[at + length :]))
        saved = recover(recorded, tmp_path / f"{number}.mcap")
        found = numbers(saved.path)
        assert found == sorted(set(found))
        assert strict_faults(saved.path) == []
        lost.append(600 - len(found))
        facts = read_facts(recorded)
        assert facts.messages == len(found)
        assert not facts.faults or not facts.condition.is_complete or lost[-1] == 0
    # a chunk holds some 70 messages; damage may lie in an index or across two chunks
    assert max(lost) < 160
    assert sum(lost) > 20


def test_what_stands_before_the_file_is_passed_over(recorded: Path, tmp_path: Path) -> None:
    recorded.write_bytes(random.Random(4).randbytes(5000) + recorded.read_bytes())
    saved = recover(recorded, tmp_path / "out.mcap")
    assert saved.messages == 600
    assert saved.condition.lost[0][0] == 0


def test_channels_of_a_lost_first_chunk_are_found_at_the_end(recorded: Path, tmp_path: Path) -> None:
    whole = bytearray(recorded.read_bytes())
    whole[400:440] = bytes(40)
    recorded.write_bytes(bytes(whole))
    saved = recover(recorded, tmp_path / "out.mcap")
    assert 500 < saved.messages < 600


def test_files_of_a_run_directory(recorded: Path, tmp_path: Path) -> None:
    Recorder(recorded, [("track", SCHEMA)], is_simulation=True).close()
    assert [p.name for p in recording_files(tmp_path)] == ["telemetry.1.mcap", "telemetry.mcap"]
    assert recording_files(recorded) == [recorded]


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    empty, text, folder = tmp_path / "empty.mcap", tmp_path / "text.mcap", tmp_path / "run"
    empty.touch()
    text.write_text("x" * 10_000)
    folder.mkdir()
    for file, what in ((empty, "is empty"), (text, "holds no intact channel"), (folder, "cannot be read")):
        with pytest.raises(RecordingError, match=what):
            read_facts(file)
        with pytest.raises(RecordingError, match=what):
            recover(file, tmp_path / "out.mcap")
    with pytest.raises(RecordingError, match="no such file; name a recording"):
        recording_files(tmp_path / "missing.mcap")
    with pytest.raises(RecordingError, match=r"no telemetry\.mcap there; name .* \(ccatp runs list\)"):
        recording_files(folder)


def test_nothing_is_overwritten(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="exists already; name another file with --out"):
        recover(recorded, recorded)
    with pytest.raises(RecordingError, match=r"cannot be written: No such file"):
        recover(recorded, tmp_path / "missing" / "out.mcap")


def test_a_disk_that_garbles_is_noticed(recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ccatp.records.recording_repair.strict_faults", lambda _: ["crc"])
    with pytest.raises(RecordingError, match=r"does not read back \(crc\)"):
        recover(recorded, tmp_path / "out.mcap")


def test_commands(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (reported,) = answered(capsys, "recording", "info", tmp_path)["recordings"]
    assert reported["complete"]
    text = printed(capsys, "recording", "info", recorded)
    assert "complete, every checksum right" in text
    assert "0.00 to 5.99 s of the robot's clock, 2027-01-15T12:00:00Z to 2027-01-15T12:00:05Z, " in text
    assert "x.Track" in text
    recorded.write_bytes(recorded.read_bytes()[:50_000])
    said = printed(capsys, "recording", "info", recorded, status=1)
    assert "save what is intact with: ccatp recording repair" in said
    assert "telemetry.recovered.mcap: " in printed(capsys, "recording", "repair", tmp_path)
    assert answered(capsys, "recording", "repair", recorded, "--out", tmp_path / "b.mcap")["was_complete"] is False
    assert "exists already" in refused(capsys, "recording", "repair", recorded)


def test_nothing_waits_longer_than_a_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr("ccatp.records.recorder.time.monotonic", lambda: now_s)
    path = tmp_path / "telemetry.mcap"
    made = Recorder(path, [("track", {})], is_simulation=True)
    made.write("track", 0.5, b"{}")
    made.flush_if_due()
    assert list(iter_messages(path)) == []
    now_s += HELD_BACK_S
    made.flush_if_due()
    assert len(list(iter_messages(path))) == 1
    made.close()
    made.flush_if_due()


def test_a_recording_that_is_being_written_is_not_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    made = Recorder(
        run_dir / "telemetry.mcap", [("track", SCHEMA), ("beacon_map", {})], is_simulation=True, metadata={}
    )
    for n in range(600):
        made.write("track", n / 100, payload(n))
    with locked(run_dir / RUN_LOCK, "taken"):
        reported = printed(capsys, "recording", "info", run_dir)
        assert "telemetry.mcap: still being written, so without an index\n" in reported
        assert "recording repair" not in reported
        assert "beacon_map" not in reported
        assert "  1 topic without messages\n" in reported
        assert damage_text(run_dir / "telemetry.mcap", "x").startswith("telemetry.mcap: still being written")
    # Nobody writes it any more, and it has no end.
    reported = printed(capsys, "recording", "info", run_dir, status=1)
    assert "telemetry.mcap: cut off or damaged\n" in reported
    assert "  no index: it was not closed\n" in reported
    assert "RecordLengthLimitExceeded" not in reported
    assert "recording repair" in reported
    made.close()
    assert main(["recording", "info", str(run_dir)]) == 0
