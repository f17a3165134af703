"""Telemetry of a run as an MCAP file: JSON messages with a JSON schema for every channel; and its readers.

Chunks are small, none is held back for long, and the file is not buffered, so that a ``kill -9`` costs the last moment
at most; the reader takes a file that ends anywhere. Recording never disturbs a mission: the first write that fails ends
it, with one report.

``scan`` yields every intact record of a damaged file. A chunk carries a checksum, so a damaged one is left out. Where
the lengths are damaged, the next chunk is found by how it begins, and taken if its checksum is right.
"""

import json
import mmap
import os
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.writer import Writer
from zstandard import ZstdError

from ccatp.links.runtime_dir import is_held

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
# Times, size and checksum stand between a chunk's head and the name of its compression.
_TO_COMPRESSION = _HEAD.size + 8 + 8 + 8 + 4
_COMPRESSIONS = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")
_LAST_OPCODE = max(opcode.value for opcode in Opcode)
_READ: Mapping[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
    Opcode.DATA_END: DataEnd,
}
# What the reader of the format raises on bytes that are not what they should be.
DAMAGE = (
    McapError,
    CRCValidationError,
    ZstdError,
    struct.error,
    ValueError,
    ArithmeticError,
    LookupError,
    MemoryError,
    EOFError,
)


@dataclass(slots=True)
class Condition:
    """What is wrong with a file, known when the scan has come to its end.

    Attributes:
        lost: beginning and end of each stretch of bytes that holds no intact record.
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
        """Note a stretch; one that follows another is the same."""
        if self.lost and self.lost[-1][1] >= begin:
            begin = self.lost.pop()[0]
        if end > begin:
            self.lost.append((begin, end))


def scan(path: Path, condition: Condition) -> Iterator[McapRecord]:
    """The intact records of a file, chunks broken up.

    Raises:
        OSError: the file cannot be read.
    """
    condition.size_bytes = path.stat().st_size
    if not condition.size_bytes:
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        yield from _records(data, condition)


NO_INDEX = "no index: it was not closed"


def strict_faults(path: Path) -> list[str]:
    """What the format's own reader says against a file, all checksums compared; empty where it is in order.

    Raises:
        OSError: the file cannot be read.
    """
    faults = []
    with path.open("rb") as file:
        try:
            for _ in StreamReader(file, validate_crcs=True, record_size_limit=path.stat().st_size).records:
                pass
        except DAMAGE as error:
            faults.append(f"read from the beginning: {told(error)}")
        file.seek(-min(len(MAGIC), path.stat().st_size), SEEK_END)
        if file.read() != MAGIC:
            return [*faults, NO_INDEX]
        file.seek(0)
        try:
            for _ in make_reader(file, validate_crcs=True).iter_messages():
                pass
        except DAMAGE as error:
            faults.append(f"read by its index: {told(error)}")
    return faults


def told(error: Exception) -> str:
    """What an error of the format's reader says; some of them have a name alone."""
    name = type(error).__name__
    return f"{name}: {error}" if str(error) else name


def _records(data: mmap.mmap, condition: Condition) -> Iterator[McapRecord]:
    size, at = len(data), 0
    if data[: len(MAGIC)] == MAGIC:
        at = len(MAGIC)
    has_footer = False
    while at < size:
        if has_footer and data[at:] == MAGIC:
            condition.is_complete = not condition.lost
            return
        end = _end_of_record(data, at)
        records = None if end is None else _parsed(data, at, end)
        if records is None or end is None:
            # A record that is whole but for its contents is followed by another one; else we have to look for one.
            is_framed = end is not None and _is_boundary(data, end)
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


def _is_boundary(data: mmap.mmap, at: int) -> bool:
    return data[at:] == MAGIC or _end_of_record(data, at) is not None


def _parsed(data: mmap.mmap, at: int, end: int) -> list[McapRecord] | None:
    """The records in a record: those of a chunk, itself, or none where it is of no interest; ``None`` if damaged."""
    opcode, body = data[at], data[at + _HEAD.size : end]
    stream = ReadDataStream(BytesIO(body))
    try:
        if opcode == Opcode.MESSAGE:
            return [Message.read(stream, len(body))]
        if opcode not in _READ:
            return []
        record: McapRecord = _READ[opcode].read(stream)
        return breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]
    except DAMAGE:
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


CHUNK_BYTES = 16 * 1024
FLUSH_AFTER_S = 1.0  # of message time: slow topics do not wait for a full chunk
HELD_BACK_S = 0.25  # of the machine's time: nor does anything else
_METADATA = "ccatp"
_SIMULATION = "simulation"
_MAX_T_S = 1e9  # thirty years of uptime: anything beyond is not a time since boot
_NS = 1e9


class RecordedMessage(NamedTuple):
    """One message: topic, robot time (s), and the JSON as it was recorded."""

    topic: str
    t_s: float
    payload: bytes


class _RawFile:
    """A file without a buffer that writes everything or raises.

    The MCAP writer puts a buffer of its own around a plain unbuffered file; what lies in it dies with the process.
    """

    def __init__(self, path: Path) -> None:
        self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._position = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            done = os.write(self._handle, rest)
            self._position += done
            rest = rest[done:]
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        os.close(self._handle)


class Recorder:
    """Writes messages of a fixed set of topics to one MCAP file.

    An existing file at ``path`` is kept: it is renamed ``<stem>.<n><suffix>`` (see ``recordings``).

    Attributes:
        is_recording: False after ``close`` or a failure.
        dropped: messages not recorded: after a failure, of an unknown topic, or with a time that is none.

    Args:
        topics: name and JSON schema of each topic; the schema's title is what viewers know it by.
        is_simulation: marks the file and every channel as simulation, or as real.
        metadata: what tells runs apart (mirror, seed, ...), kept in the file.
        on_failure: called once with the reason when recording ends early.
    """

    def __init__(
        self,
        path: Path,
        topics: Iterable[tuple[str, Mapping[str, Any]]],
        *,
        is_simulation: bool,
        metadata: Mapping[str, str] | None = None,
        on_failure: Callable[[str], None] | None = None,
    ) -> None:
        self.path = path
        self.is_recording = False
        self.dropped = 0
        self._on_failure = on_failure
        self._channels: dict[str, int] = {}
        self._flushed_s = 0.0
        self._waiting_since_s: float | None = None
        self._sequence = 0
        self._file: _RawFile | None = None
        try:
            _keep_existing(path)
            self._file = _RawFile(path)
            self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)  # type: ignore[arg-type]
            self._begin(topics, {**(metadata or {}), _SIMULATION: str(is_simulation).lower()})
            self.is_recording = True
        except Exception as error:
            self._fail(error)

    def write(self, topic: str, t_s: float, payload: bytes) -> None:
        """Record one message; never raises.

        Args:
            t_s: robot time, s since its boot; becomes the log time.
        """
        channel = self._channels.get(topic)
        if channel is None or not self.is_recording or not 0.0 <= t_s < _MAX_T_S:
            self.dropped += 1
            return
        time_ns = round(t_s * _NS)
        self._sequence += 1
        try:
            self._writer.add_message(channel, time_ns, payload, time_ns, self._sequence)
            if not 0.0 <= t_s - self._flushed_s < FLUSH_AFTER_S:
                self._flush(t_s)
            elif self._waiting_since_s is None:
                self._waiting_since_s = time.monotonic()
        except Exception as error:
            # Whatever it is, the mission is worth more than its recording.
            self.dropped += 1
            self._fail(error)

    def flush_if_due(self) -> None:
        """To be called several times a second: what waits for a full chunk does not wait for long. Never raises."""
        if self._waiting_since_s is None or not self.is_recording:
            return
        if time.monotonic() - self._waiting_since_s >= HELD_BACK_S:
            try:
                self._flush(self._flushed_s)
            except Exception as error:
                self._fail(error)

    def _flush(self, t_s: float) -> None:
        self._flushed_s, self._waiting_since_s = t_s, None
        self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Write what is left and the index; again is harmless. Never raises."""
        if self.is_recording:
            self.is_recording = False
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]
            except Exception as error:
                self._fail(error)
        self._close_file()

    def _begin(self, topics: Iterable[tuple[str, Mapping[str, Any]]], metadata: dict[str, str]) -> None:
        self._writer.start(library="ccatp")
        self._writer.add_metadata(_METADATA, metadata)
        for name, schema in topics:
            data = json.dumps(schema, separators=(",", ":")).encode()
            title = str(schema.get("title", name))
            schema_id = int(self._writer.register_schema(name=title, encoding="jsonschema", data=data))
            channel_metadata = {_SIMULATION: metadata[_SIMULATION]}
            self._channels[name] = self._writer.register_channel(name, "json", schema_id, channel_metadata)

    def _fail(self, error: Exception) -> None:
        self.is_recording = False
        self._close_file()
        if self._on_failure is not None:
            self._on_failure(f"{self.path}: recording ended: {error}")

    def _close_file(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None


def recordings(path: Path) -> list[Path]:
    """The files of a run that was resumed, oldest first: those kept by later recorders, then ``path`` itself."""
    kept = {_part_number(p): p for p in path.parent.glob(f"{path.stem}.*{path.suffix}")}
    parts = [kept[n] for n in sorted(n for n in kept if n > 0)]
    return [*parts, path] if path.exists() else parts


def iter_messages(path: Path, on_damage: Callable[[str], None] | None = None) -> Iterator[RecordedMessage]:
    """All messages of a file, in the order of recording.

    Args:
        path: an MCAP file; it may end anywhere, as after a ``kill -9``.
        on_damage: called with the reason where the file ends early or is damaged; nothing behind that is read.

    Yields:
        The messages up to the end, or to the first damage. A damaged chunk gives none of its messages.

    Raises:
        OSError: the file cannot be read.
    """
    channels: dict[int, str] = {}
    for record in _iter_records(path, on_damage):
        if isinstance(record, Channel):
            channels[record.id] = record.topic
        elif isinstance(record, Message) and record.channel_id in channels:
            yield RecordedMessage(channels[record.channel_id], record.log_time / _NS, record.data)


def read_metadata(path: Path) -> dict[str, str]:
    """What the recorder was told of the run; ``simulation`` is ``"true"`` or ``"false"``. Empty if there is none."""
    for record in _iter_records(path, None):
        if isinstance(record, Metadata) and record.name == _METADATA:
            return dict(record.metadata)
    return {}


def _iter_records(path: Path, on_damage: Callable[[str], None] | None) -> Iterator[McapRecord]:
    with path.open("rb") as file:
        # No record is longer than the file; without this limit a flipped bit in a length asks for any amount of memory.
        reader = StreamReader(file, emit_chunks=True, record_size_limit=path.stat().st_size)
        records = iter(reader.records)
        while True:
            try:
                record = next(records)
                inner = breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]
            except StopIteration:
                return
            except DAMAGE as error:
                if on_damage is not None:
                    on_damage(f"{path}: damaged or cut off before byte {file.tell()}: {told(error)}")
                return
            yield from inner


def _keep_existing(path: Path) -> None:
    if path.exists():
        number = 1 + max((_part_number(p) for p in recordings(path)), default=0)
        path.rename(path.with_name(f"{path.stem}.{number}{path.suffix}"))


def _part_number(path: Path) -> int:
    number = Path(path.stem).suffix[1:]
    return int(number) if number.isdecimal() else 0


RUN_LOCK = ".lock"
"""In a run directory; held by the daemon that writes there."""


def is_being_written(path: Path) -> bool:
    """Whether a run that goes on writes this recording: the newest one of its directory, which has no number."""
    return "." not in path.stem and is_held(path.parent / RUN_LOCK)


def damage_text(path: Path, damage: str) -> str:
    """Why a recording could not be read to its end, for a reader of the run."""
    if is_being_written(path):
        return f"{path.name}: still being written; what it holds so far is in this report"
    return f"{damage.replace(str(path), path.name)}; what came before it is in this report"
