"""Telemetry of a run as an MCAP file: JSON messages with a JSON schema for every channel; and its readers.

Chunks are small, none is held back for long, and the file is not buffered, so that a ``kill -9`` costs the last moment
at most; the reader takes a file that ends anywhere. Recording never disturbs a mission: the first write that fails ends
it, with one report.
"""

import json
import os
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.writer import Writer
from zstandard import ZstdError

from ccatp.links.runtime_dir import is_held

TELEMETRY = "telemetry.mcap"
RUN_LOCK = ".lock"  # in a run directory; held by the daemon that writes there
CHUNK_BYTES = 16 * 1024
FLUSH_AFTER_S = 1.0  # of message time: slow topics do not wait for a full chunk
HELD_BACK_S = 0.25  # of the machine's time: nor does anything else
# Errors of the format's reader on damaged bytes.
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
_COPIED_BYTES = 1 << 20  # at a time
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


class _ChunkIndexes:
    """The records of the chunks that end the file, until then on the disk: those of a day take hundreds of megabytes.

    The MCAP writer keeps a list of them, adds to it and iterates over it once.
    """

    def __init__(self, folder: Path) -> None:
        self._file = TemporaryFile(dir=folder)  # noqa: SIM115 - open as long as the recording

    def append(self, index: ChunkIndex) -> None:
        builder = RecordBuilder()
        index.write(builder)
        self._file.write(builder.end())  # type: ignore[no-untyped-call]

    def __iter__(self) -> Iterator["_ChunkIndexes"]:
        yield self

    def write(self, builder: RecordBuilder) -> None:
        """Write all of them, as each would write itself."""
        self._file.seek(0)
        while part := self._file.read(_COPIED_BYTES):
            builder.write(part)

    def close(self) -> None:
        self._file.close()


class Recorder:
    """Writes messages of a fixed set of topics to one MCAP file.

    An existing file at ``path`` is kept: it is renamed ``<stem>.<n><suffix>`` (see ``recordings``).

    Attributes:
        is_recording: False after ``close`` or a failure.
        dropped: messages not recorded: after a failure, of an unknown topic, or with an invalid time.

    Args:
        topics: name and JSON schema of each topic; viewers show the schema's title.
        is_simulation: marks the file and every channel as simulation, or as real.
        metadata: what distinguishes runs (mirror, seed, ...), kept in the file.
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
        self._chunk_indexes: _ChunkIndexes | None = None
        mark = str(is_simulation).lower()
        try:
            if path.exists():
                number = 1 + max(map(_part_number, recordings(path)), default=0)
                path.rename(path.with_name(f"{path.stem}.{number}{path.suffix}"))
            self._file = _RawFile(path)
            self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)  # type: ignore[arg-type]
            self._chunk_indexes = _ChunkIndexes(path.parent)
            vars(self._writer)["_Writer__chunk_indices"] = self._chunk_indexes
            self._writer.start(library="ccatp")
            self._writer.add_metadata(_METADATA, {**(metadata or {}), _SIMULATION: mark})
            for name, schema in topics:
                data = json.dumps(schema, separators=(",", ":")).encode()
                title = str(schema.get("title", name))
                schema_id = int(self._writer.register_schema(name=title, encoding="jsonschema", data=data))
                self._channels[name] = self._writer.register_channel(name, "json", schema_id, {_SIMULATION: mark})
            self.is_recording = True
        except Exception as error:
            self._fail(error)

    def write(self, topic: str, t_s: float, payload: bytes) -> None:
        """Record one message with the robot time, s since its boot, as log time; never raises."""
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
        """Write what is left and the index; may be repeated. Never raises."""
        if self.is_recording:
            self.is_recording = False
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]
            except Exception as error:
                self._fail(error)
        self._close_file()

    def _fail(self, error: Exception) -> None:
        self.is_recording = False
        self._close_file()
        if self._on_failure is not None:
            self._on_failure(f"{self.path}: recording ended: {error}")

    def _close_file(self) -> None:
        for file in (self._file, self._chunk_indexes):
            if file is not None:
                with suppress(OSError):
                    file.close()
        self._file = self._chunk_indexes = None


def recordings(path: Path) -> list[Path]:
    """The files of a run that was resumed, oldest first: those kept by later recorders, then ``path`` itself."""
    kept = {_part_number(p): p for p in path.parent.glob(f"{path.stem}.*{path.suffix}")}
    parts = [kept[n] for n in sorted(n for n in kept if n > 0)]
    return [*parts, path] if path.exists() else parts


def _part_number(path: Path) -> int:
    number = Path(path.stem).suffix[1:]
    return int(number) if number.isdecimal() else 0


def iter_messages(path: Path, on_damage: Callable[[str], None] | None = None) -> Iterator[RecordedMessage]:
    """All messages of a file in the order of recording, up to its end or to the first damage.

    A damaged chunk gives none of its messages.

    Args:
        path: an MCAP file; it may end anywhere, as after a ``kill -9``.
        on_damage: called with the reason where the file ends early or is damaged; nothing behind that is read.

    ``OSError``: the file cannot be read.
    """
    channels: dict[int, str] = {}
    for record in _iter_records(path, on_damage):
        if isinstance(record, Channel):
            channels[record.id] = record.topic
        elif isinstance(record, Message) and record.channel_id in channels:
            yield RecordedMessage(channels[record.channel_id], record.log_time / _NS, record.data)


def read_metadata(path: Path) -> dict[str, str]:
    """The recorder's metadata; ``simulation`` is ``"true"`` or ``"false"``. Empty if there is none."""
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
                    on_damage(f"{path}: damaged or cut off before byte {file.tell()}: {error_text(error)}")
                return
            yield from inner


def error_text(error: Exception) -> str:
    """Name and message of an error of the format's reader; some of them have a name alone."""
    name = type(error).__name__
    return f"{name}: {error}" if str(error) else name


def is_being_written(path: Path) -> bool:
    """Whether a run that goes on writes this recording: the newest one of its directory, which has no number."""
    return "." not in path.stem and is_held(path.parent / RUN_LOCK)


def damage_text(path: Path, damage: str) -> str:
    """Why a recording could not be read to its end, for a reader of the run."""
    if is_being_written(path):
        return f"{path.name}: still being written; what it holds so far is in this report"
    return f"{damage.replace(str(path), path.name)}; what came before it is in this report"
