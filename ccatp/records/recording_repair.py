"""Content of a recording, and the repair of one that was cut off or damaged."""

from collections.abc import Sized
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from io import SEEK_END
from pathlib import Path
from typing import Any, NamedTuple

from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from ccatp.errors import UsageError
from ccatp.records.recorder import (
    CHUNK_BYTES,
    DAMAGE,
    MAGIC,
    TELEMETRY,
    FileCondition,
    is_being_written,
    recordings,
    scan,
)
from ccatp.records.timeline import read_timeline

NO_INDEX = "no index: it was not closed"
_NS = 1e9
_HOUR_S = 3600.0


class RecordingError(UsageError):
    """A recording that cannot be used."""


def strict_faults(path: Path) -> list[str]:
    """Objections of the format's own reader, all checksums compared; raises ``OSError`` where it cannot be read."""
    faults = []
    with path.open("rb") as file:
        try:
            for _ in StreamReader(file, validate_crcs=True, record_size_limit=path.stat().st_size).records:
                pass
        except DAMAGE as error:
            faults.append(f"read from the beginning: {_text(error)}")
        file.seek(-min(len(MAGIC), path.stat().st_size), SEEK_END)
        if file.read() != MAGIC:
            return [*faults, NO_INDEX]
        file.seek(0)
        try:
            for _ in make_reader(file, validate_crcs=True).iter_messages():
                pass
        except DAMAGE as error:
            faults.append(f"read by its index: {_text(error)}")
    return faults


def _text(error: Exception) -> str:
    """Name and message of an error; some of the format's reader have a name alone."""
    return f"{type(error).__name__}: {error}".removesuffix(": ")


@dataclass(slots=True)
class TopicFacts:
    """Content of a topic; ``payload_bytes`` of all messages, before compression.

    Times are of the robot's clock; None without a message, and in a recording in which this clock steps.
    """

    schema: str
    messages: int = 0
    payload_bytes: int = 0
    start_s: float | None = None
    end_s: float | None = None


@dataclass(slots=True)
class RecordingFacts:
    """Content of a recording; ``faults`` are the objections of the format's own strict reader.

    ``notes``: restarts of the robot and steps of its clock, and missing frames, one line each. ``mission_s``: mission
    times of the first and the last frame, where the robot's clock steps.
    """

    path: Path
    condition: FileCondition
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    topics: dict[str, TopicFacts] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    is_being_written: bool = False
    utc_ns: tuple[int, ...] = ()  # of the first and the last message, since 1970
    notes: list[str] = field(default_factory=list)
    mission_s: tuple[float, float] | None = None

    @property
    def utc(self) -> list[str]:
        """UTC of the first and the last message in ISO format; empty where it was not recorded."""
        return [f"{datetime.fromtimestamp(ns / _NS, UTC):%Y-%m-%dT%H:%M:%SZ}" for ns in self.utc_ns]

    @property
    def state(self) -> str:
        """The condition, for a reader."""
        if not self.faults:
            return "complete, every checksum right"
        return "still being written, so without an index" if self.is_being_written else "cut off or damaged"

    @property
    def is_in_order(self) -> bool:
        """Nothing is wrong with it, but that it may have no end yet."""
        return not self.faults or self.is_being_written

    @property
    def messages(self) -> int:
        """Messages of all topics."""
        return sum(topic.messages for topic in self.topics.values())

    @property
    def span_s(self) -> tuple[float, float] | None:
        """Times of the first and the last message; where the robot's clock steps, of the first and the last frame."""
        if self.mission_s is not None:
            return self.mission_s
        times = [(one.start_s, one.end_s) for one in self.topics.values()]
        starts, ends = ([t_s for t_s in column if t_s is not None] for column in zip(*times, strict=True))
        return (min(starts), max(ends)) if starts else None

    @property
    def bytes_per_hour(self) -> float | None:
        """Bytes of the file per hour of its messages' times; ``None`` where they span no time."""
        start_s, end_s = self.span_s or (0.0, 0.0)
        return self.condition.size_bytes * _HOUR_S / (end_s - start_s) if end_s > start_s else None

    def as_json(self) -> dict[str, Any]:
        """For ``--json``; without the configuration, a file of its own beside the recording."""
        start_s, end_s = self.span_s or (None, None)
        known = {
            name: {key: value for key, value in values.items() if key != "config"}
            for name, values in self.metadata.items()
        }
        return {
            "file": str(self.path),
            "complete": self.condition.is_complete,
            "verified": not self.faults,
            "being_written": self.is_being_written,
            "faults": self.faults,
            "notes": self.notes,
            "size_bytes": self.condition.size_bytes,
            "lost_bytes": self.condition.lost_bytes,
            "lost": self.condition.lost,
            "chunks": self.condition.chunks,
            "messages": self.messages,
            "start_s": start_s,
            "end_s": end_s,
            "utc": self.utc,
            "bytes_per_hour": None if self.bytes_per_hour is None else round(self.bytes_per_hour),
            "metadata": known,
            "topics": {name: asdict(topic) for name, topic in sorted(self.topics.items())},
        }


def recording_files(path: Path) -> list[Path]:
    """The file itself, or all recordings of a run directory, oldest first; raises ``RecordingError`` without any."""
    found = recordings(path / TELEMETRY) if path.is_dir() else [path]
    if not found or not path.exists():
        what = f"no {TELEMETRY} there" if path.is_dir() else "no such file"
        raise RecordingError(f"{path}: {what}; name a recording, or the directory of a run (ccatp runs list)")
    return found


def read_facts(path: Path) -> RecordingFacts:
    """Read the content of a recording; raises ``RecordingError`` where it cannot be read or is no recording."""
    condition = FileCondition()
    facts = RecordingFacts(path, condition)
    schemas: dict[int, str] = {}
    channels: dict[int, TopicFacts] = {}
    try:
        for record in scan(path, condition):
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                topic = facts.topics.setdefault(record.topic, TopicFacts(schemas.get(record.schema_id, "")))
                channels[record.id] = topic
            elif isinstance(record, Metadata):
                facts.metadata[record.name] = dict(record.metadata)
            elif isinstance(record, Message) and record.channel_id in channels:
                topic, t_s = channels[record.channel_id], record.publish_time / _NS
                topic.messages += 1
                topic.payload_bytes += len(record.data)
                topic.start_s = t_s if topic.start_s is None else min(topic.start_s, t_s)
                topic.end_s = t_s if topic.end_s is None else max(topic.end_s, t_s)
                if record.log_time != record.publish_time:  # the same in recordings up to format 2
                    times_ns = *facts.utc_ns, record.log_time
                    facts.utc_ns = min(times_ns), max(times_ns)
        _add_axis(facts, path)
        facts.is_being_written = is_being_written(path)
        facts.faults = strict_faults(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    _check_is_recording(path, facts.topics, condition)
    return facts


def _add_axis(facts: RecordingFacts, path: Path) -> None:
    """Replace times by the robot's clock, where it steps, by mission times."""
    is_simulation = any(record.get("simulation") == "true" for record in facts.metadata.values())
    timeline = read_timeline(path, is_simulation=is_simulation)
    facts.notes += timeline.notes
    if timeline.missing:
        facts.notes.append(f"{timeline.missing} frames are missing in between")
    if timeline.steps:
        facts.mission_s = float(timeline.t_s[0]), float(timeline.t_s[-1])
        for topic in facts.topics.values():
            topic.start_s = topic.end_s = None


class Saved(NamedTuple):
    """A recording that was saved; ``end_s`` is the latest message's time, ``None`` without a message."""

    path: Path
    messages: int
    end_s: float | None
    condition: FileCondition


def recover(path: Path, out: Path) -> Saved:
    """Write every intact message of a recording to a new one, in the same order, with an index.

    The old file is left as it is. ``RecordingError``: one cannot be read or written, or nothing in it is a recording.
    """
    condition = FileCondition()
    try:
        records = list(scan(path, condition))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    _check_is_recording(path, [record for record in records if isinstance(record, Channel)], condition)
    try:
        with out.open("xb") as file:
            times_ns = _rewrite(Writer(file, chunk_size=CHUNK_BYTES), records)
    except FileExistsError as error:
        raise RecordingError(f"{out}: exists already; name another file with --out") from error
    except OSError as error:
        out.unlink(missing_ok=True)
        raise RecordingError(f"{out}: cannot be written: {error.strerror or error}") from error
    if faults := strict_faults(out):
        raise RecordingError(f"{out}: was written and does not read back ({faults[0]}); is the disk in order?")
    return Saved(out, len(times_ns), max(times_ns) / _NS if times_ns else None, condition)


def _rewrite(writer: Writer, records: list[McapRecord]) -> list[int]:
    """Robot times of the messages that were written, ns."""
    library = next((record.library for record in records if isinstance(record, Header)), "")
    writer.start(library=f"ccatp recording repair ({library})" if library else "ccatp recording repair")
    # The end of a file repeats its schemas and channels: they may be all that is left of them.
    schemas = {record.id: record for record in records if isinstance(record, Schema)}
    new_schemas = {number: writer.register_schema(s.name, s.encoding, s.data) for number, s in sorted(schemas.items())}
    channels = {record.id: record for record in records if isinstance(record, Channel)}
    new_channels = {}
    for number, c in sorted(channels.items()):
        schema = new_schemas.get(c.schema_id, 0)
        new_channels[number] = writer.register_channel(c.topic, c.message_encoding, schema, dict(c.metadata))
    times_ns = []
    for record in records:
        if isinstance(record, Metadata):
            writer.add_metadata(record.name, dict(record.metadata))
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Message) and record.channel_id in new_channels:
            channel = new_channels[record.channel_id]
            writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
            times_ns.append(record.publish_time)
    writer.finish()  # type: ignore[no-untyped-call]
    return times_ns


def _check_is_recording(path: Path, channels: Sized, condition: FileCondition) -> None:
    if not channels:
        what = "is empty" if not condition.size_bytes else "holds no intact channel of an MCAP recording"
        raise RecordingError(f"{path}: {what}; nothing can be shown or saved")
