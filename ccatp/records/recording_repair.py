"""Content of a recording, and the repair of one that was cut off or damaged.

``scan`` yields every intact record. A chunk carries a checksum, so a damaged one is left out. Where the lengths are
damaged, the next chunk is found by how it begins, and taken if its checksum is right.
"""

import mmap
import struct
from collections.abc import Iterator, Mapping, Sized
from dataclasses import asdict, dataclass, field
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from ccatp.errors import CcatpError, ExitStatus
from ccatp.records.recorder import CHUNK_BYTES, DAMAGE, TELEMETRY, error_text, is_being_written, recordings

MAGIC = b"\x89MCAP0\r\n"
NO_INDEX = "no index: it was not closed"
_HEAD = struct.Struct("<BQ")
# Times, size and checksum stand between a chunk's head and the name of its compression.
_TO_COMPRESSION = _HEAD.size + 8 + 8 + 8 + 4
_COMPRESSIONS = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")
_LAST_OPCODE = max(opcode.value for opcode in Opcode)
_NS = 1e9
_HOUR_S = 3600.0


class RecordingError(CcatpError):
    """A recording that cannot be used."""

    exit_status = ExitStatus.USAGE


@dataclass(slots=True)
class Condition:
    """Condition of a file, known when the scan has come to its end.

    ``lost``: beginning and end of each stretch of bytes that holds no intact record.
    """

    size_bytes: int = 0
    lost: list[tuple[int, int]] = field(default_factory=list)
    is_complete: bool = False
    chunks: int = 0

    @property
    def lost_bytes(self) -> int:
        """Bytes in ``lost``."""
        return sum(end - begin for begin, end in self.lost)

    def lose(self, begin: int, end: int) -> None:
        """Note a stretch; it is joined to an adjacent one before it."""
        if self.lost and self.lost[-1][1] >= begin:
            begin = self.lost.pop()[0]
        if end > begin:
            self.lost.append((begin, end))


def scan(path: Path, condition: Condition) -> Iterator[McapRecord]:
    """The intact records of a file, chunks broken up. Raises ``OSError`` where it cannot be read."""
    condition.size_bytes = path.stat().st_size
    if not condition.size_bytes:
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        size = len(data)
        at = len(MAGIC) if data[: len(MAGIC)] == MAGIC else 0
        has_footer = False
        while at < size:
            if has_footer and data[at:] == MAGIC:
                condition.is_complete = not condition.lost
                return
            end = _end_of_record(data, at)
            records = None if end is None else _parsed(data, at, end)
            if end is None or records is None:
                # A record that is whole but for its contents is followed by another; otherwise one has to be searched.
                is_framed = end is not None and (data[end:] == MAGIC or _end_of_record(data, end) is not None)
                after = end if is_framed and end is not None else _next_chunk(data, at + 1)
                condition.lose(at, after)
                at = after
                continue
            condition.chunks += data[at] == Opcode.CHUNK
            has_footer = has_footer or data[at] == Opcode.FOOTER
            yield from records
            at = end


def _end_of_record(data: mmap.mmap, at: int) -> int | None:
    if at + _HEAD.size > len(data):
        return None
    opcode, length = _HEAD.unpack_from(data, at)
    end = at + _HEAD.size + int(length)
    return end if 0 < opcode <= _LAST_OPCODE and end <= len(data) else None


def _parsed(data: mmap.mmap, at: int, end: int) -> list[McapRecord] | None:
    """The records in a record: those of a chunk, or itself; ``None`` if damaged."""
    stream = BytesIO(data[at:end])
    try:
        record = next(StreamReader(stream, skip_magic=True, emit_chunks=True, record_size_limit=None).records)
        return breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]
    except (StopIteration, *DAMAGE):
        return None


def _next_chunk(data: mmap.mmap, start: int) -> int:
    """Where the next intact chunk begins; the end of the file where there is none."""
    place = start + _TO_COMPRESSION
    while True:
        found = [at for name in _COMPRESSIONS if (at := data.find(name, place)) >= 0]
        if not found:
            return len(data)
        at, place = min(found) - _TO_COMPRESSION, min(found) + 1
        end = _end_of_record(data, at)
        if end is not None and data[at] == Opcode.CHUNK and _parsed(data, at, end):
            return at


def strict_faults(path: Path) -> list[str]:
    """Objections of the format's own reader, all checksums compared; raises ``OSError`` where it cannot be read."""
    faults = []
    with path.open("rb") as file:
        try:
            for _ in StreamReader(file, validate_crcs=True, record_size_limit=path.stat().st_size).records:
                pass
        except DAMAGE as error:
            faults.append(f"read from the beginning: {error_text(error)}")
        file.seek(-min(len(MAGIC), path.stat().st_size), SEEK_END)
        if file.read() != MAGIC:
            return [*faults, NO_INDEX]
        file.seek(0)
        try:
            for _ in make_reader(file, validate_crcs=True).iter_messages():
                pass
        except DAMAGE as error:
            faults.append(f"read by its index: {error_text(error)}")
    return faults


@dataclass(slots=True)
class TopicFacts:
    """Content of a topic; ``payload_bytes`` of all messages, before compression; times None without a message."""

    schema: str
    messages: int = 0
    payload_bytes: int = 0
    start_s: float | None = None
    end_s: float | None = None


@dataclass(slots=True)
class RecordingFacts:
    """Content of a recording; ``faults`` are the objections of the format's own strict reader."""

    path: Path
    condition: Condition
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    topics: dict[str, TopicFacts] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    is_being_written: bool = False

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
        """Times of the first and the last message."""
        starts = [topic.start_s for topic in self.topics.values() if topic.start_s is not None]
        ends = [topic.end_s for topic in self.topics.values() if topic.end_s is not None]
        return (min(starts), max(ends)) if starts and ends else None

    @property
    def bytes_per_hour(self) -> float | None:
        """Bytes of the file per hour of its messages' times; ``None`` where they span no time."""
        span = self.span_s
        if span is None or span[1] <= span[0]:
            return None
        return self.condition.size_bytes * _HOUR_S / (span[1] - span[0])

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
            "size_bytes": self.condition.size_bytes,
            "lost_bytes": self.condition.lost_bytes,
            "lost": self.condition.lost,
            "chunks": self.condition.chunks,
            "messages": self.messages,
            "start_s": start_s,
            "end_s": end_s,
            "bytes_per_hour": None if self.bytes_per_hour is None else round(self.bytes_per_hour),
            "metadata": known,
            "topics": {name: asdict(topic) for name, topic in sorted(self.topics.items())},
        }


def recording_files(path: Path) -> list[Path]:
    """The file itself, or all recordings of a run directory, oldest first; raises ``RecordingError`` without any."""
    if path.is_dir():
        found = recordings(path / TELEMETRY)
        if not found:
            raise RecordingError(f"{path}: no {TELEMETRY} there; name a recording, or the directory of a run")
        return found
    if not path.exists():
        raise RecordingError(f"{path}: no such file; name a recording, or the directory of a run")
    return [path]


def read_facts(path: Path) -> RecordingFacts:
    """Read the content of a recording; raises ``RecordingError`` where it cannot be read or is no recording."""
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
                topic.start_s = t_s if topic.start_s is None else min(topic.start_s, t_s)
                topic.end_s = t_s if topic.end_s is None else max(topic.end_s, t_s)
        facts.is_being_written = is_being_written(path)
        facts.faults = strict_faults(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    _check_is_recording(path, facts.topics, condition)
    return facts


@dataclass(frozen=True, slots=True)
class Saved:
    """A recording that was saved; ``end_s`` is the latest message's time, ``None`` without a message."""

    path: Path
    messages: int
    end_s: float | None
    condition: Condition


def recover(path: Path, out: Path) -> Saved:
    """Write every intact message of a recording to a new one, in the same order, with an index.

    The old file is left as it is. ``RecordingError``: one cannot be read or written, or nothing in it is a recording.
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
            channel = new_channels[record.channel_id]
            writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
            count, end_ns = count + 1, max(end_ns, record.log_time)
    writer.finish()  # type: ignore[no-untyped-call]
    return count, end_ns / _NS if count else None


def _check_is_recording(path: Path, channels: Sized, condition: Condition) -> None:
    if not channels:
        what = "is empty" if not condition.size_bytes else "holds no intact channel of an MCAP recording"
        raise RecordingError(f"{path}: {what}; nothing can be shown or saved")
