"""What a recording holds, and how one that was cut off or damaged is saved."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.writer import Writer

from ccatp.errors import CcatpError, ExitStatus
from ccatp.records.recorder import CHUNK_BYTES, Condition, is_being_written, recordings, scan, strict_faults

TELEMETRY = "telemetry.mcap"
_NS = 1e9
_HOUR_S = 3600.0


class RecordingError(CcatpError):
    """A recording that cannot be used."""

    exit_status = ExitStatus.USAGE


@dataclass(slots=True)
class TopicFacts:
    """What a recording holds of a topic.

    Attributes:
        payload_bytes: of all of them, before compression.
    """

    schema: str
    messages: int = 0
    payload_bytes: int = 0
    first_s: float = inf
    last_s: float = -inf


@dataclass(slots=True)
class RecordingFacts:
    """What a recording holds.

    Attributes:
        faults: what the format's own strict reader says against it.
    """

    path: Path
    condition: Condition
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    topics: dict[str, TopicFacts] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    is_being_written: bool = False

    @property
    def state(self) -> str:
        """In what order it is, for a reader."""
        if not self.faults:
            return "complete, every checksum right"
        return "still being written, so without an index" if self.is_being_written else "cut off or damaged"

    @property
    def is_in_order(self) -> bool:
        """Nothing is wrong with it, but that it may have no end yet."""
        return not self.faults or self.is_being_written

    @property
    def messages(self) -> int:
        """Of all topics."""
        return sum(topic.messages for topic in self.topics.values())

    @property
    def span_s(self) -> tuple[float, float] | None:
        """Times of the first and the last message."""
        told = [topic for topic in self.topics.values() if topic.messages]
        return (min(t.first_s for t in told), max(t.last_s for t in told)) if told else None

    @property
    def bytes_per_hour(self) -> float | None:
        """Of the file, by its messages' times; ``None`` where they span no time."""
        span = self.span_s
        if span is None or span[1] <= span[0]:
            return None
        return self.condition.size_bytes * _HOUR_S / (span[1] - span[0])

    def as_json(self) -> dict[str, Any]:
        """For ``--json``."""
        span, condition = self.span_s, self.condition
        known = {name: dict(values) for name, values in self.metadata.items()}
        for values in known.values():
            values.pop("config", None)  # a file of its own beside the recording
        return {
            "file": str(self.path),
            "complete": condition.is_complete,
            "verified": not self.faults,
            "being_written": self.is_being_written,
            "faults": self.faults,
            "size_bytes": condition.size_bytes,
            "lost_bytes": condition.lost_bytes,
            "lost": condition.lost,
            "chunks": condition.chunks,
            "messages": self.messages,
            "start_s": None if span is None else span[0],
            "end_s": None if span is None else span[1],
            "bytes_per_hour": None if self.bytes_per_hour is None else round(self.bytes_per_hour),
            "metadata": known,
            "topics": {
                name: {
                    "schema": topic.schema,
                    "messages": topic.messages,
                    "payload_bytes": topic.payload_bytes,
                    "start_s": topic.first_s if topic.messages else None,
                    "end_s": topic.last_s if topic.messages else None,
                }
                for name, topic in sorted(self.topics.items())
            },
        }


def recording_files(path: Path) -> list[Path]:
    """The file itself, or all recordings of a run directory, oldest first.

    Raises:
        RecordingError: there is none.
    """
    if path.is_dir():
        found = recordings(path / TELEMETRY)
        if not found:
            raise RecordingError(f"{path}: no {TELEMETRY} there; name a recording, or the directory of a run")
        return found
    if not path.exists():
        raise RecordingError(f"{path}: no such file; name a recording, or the directory of a run")
    return [path]


def read_facts(path: Path) -> RecordingFacts:
    """Look through a recording.

    Raises:
        RecordingError: it cannot be read, or is no recording.
    """
    condition = Condition()
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
                topic, t_s = channels[record.channel_id], record.log_time / _NS
                topic.messages += 1
                topic.payload_bytes += len(record.data)
                topic.first_s, topic.last_s = min(topic.first_s, t_s), max(topic.last_s, t_s)
        facts.is_being_written = is_being_written(path)
        facts.faults = strict_faults(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    _check_is_recording(path, facts.topics, condition)
    return facts


@dataclass(frozen=True, slots=True)
class Saved:
    """A recording that was saved.

    Attributes:
        end_s: time of the latest, ``None`` where there is none.
    """

    path: Path
    messages: int
    end_s: float | None
    condition: Condition


def recover(path: Path, out: Path) -> Saved:
    """Write every intact message of a recording to a new one, in the same order, with an index.

    Args:
        path: the old file; it is left as it is.

    Raises:
        RecordingError: one cannot be read or written, or nothing in it is a recording.
    """
    condition = Condition()
    try:
        records = list(scan(path, condition))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    # The end of a file repeats its schemas and channels: they may be all that is left of them.
    schemas = {record.id: record for record in records if isinstance(record, Schema)}
    channels = {record.id: record for record in records if isinstance(record, Channel)}
    _check_is_recording(path, channels, condition)
    try:
        with out.open("xb") as file:
            messages, end_s = _rewrite(Writer(file, chunk_size=CHUNK_BYTES), records, schemas, channels)
    except FileExistsError as error:
        raise RecordingError(f"{out}: exists already; name another file with --out") from error
    except OSError as error:
        out.unlink(missing_ok=True)
        raise RecordingError(f"{out}: cannot be written: {error.strerror or error}") from error
    if faults := strict_faults(out):
        raise RecordingError(f"{out}: was written and does not read back ({faults[0]}); is the disk in order?")
    return Saved(out, messages, end_s, condition)


def _rewrite(
    writer: Writer, records: list[Any], schemas: Mapping[int, Schema], channels: Mapping[int, Channel]
) -> tuple[int, float | None]:
    library = next((record.library for record in records if isinstance(record, Header)), "")
    writer.start(library=f"ccatp recording repair ({library})" if library else "ccatp recording repair")
    new_schemas = {
        number: int(writer.register_schema(s.name, s.encoding, s.data)) for number, s in sorted(schemas.items())
    }
    new_channels = {
        number: int(
            writer.register_channel(c.topic, c.message_encoding, new_schemas.get(c.schema_id, 0), dict(c.metadata))
        )
        for number, c in sorted(channels.items())
    }
    count, end_ns = 0, -1
    for record in records:
        if isinstance(record, Metadata):
            writer.add_metadata(record.name, dict(record.metadata))
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Message) and record.channel_id in new_channels:
            writer.add_message(
                new_channels[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence
            )
            count, end_ns = count + 1, max(end_ns, record.log_time)
    writer.finish()  # type: ignore[no-untyped-call]
    return count, end_ns / _NS if count else None


def _check_is_recording(path: Path, channels: Mapping[Any, Any], condition: Condition) -> None:
    if not channels:
        what = "is empty" if not condition.size_bytes else "holds no intact channel of an MCAP recording"
        raise RecordingError(f"{path}: {what}; nothing can be shown or saved")
