"""Telemetry of a run as an MCAP file: JSON messages with a JSON schema for every channel; and its readers.

Chunks are small and written soon, so ``kill -9`` loses at most the last moment. The reader accepts a file that ends
anywhere. Recording never disturbs a mission: the first write that fails ends the recording, with one report.
"""

import json
import mmap
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.writer import Writer
from zstandard import ZstdError

from ccatp.core import Verdict
from ccatp.links import topics
from ccatp.links.bus_codec import unpack
from ccatp.links.runtime_dir import RUN_LOCK, is_held

TELEMETRY = "telemetry.mcap"
CHUNK_BYTES = 16 * 1024
FLUSH_AFTER_S = 1.0  # of message time: so long a slow topic waits for a full chunk
HELD_BACK_S = 0.25  # of the machine's time: so long any message waits
MAGIC = b"\x89MCAP0\r\n"
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
_HEAD = struct.Struct("<BQ")
# Times, size and checksum stand between a chunk's head and the name of its compression.
_TO_COMPRESSION = _HEAD.size + 8 + 8 + 8 + 4
_COMPRESSIONS = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")
_LAST_OPCODE = max(opcode.value for opcode in Opcode)
_METADATA = "ccatp"
_SIMULATION = "simulation"
_MAX_T_S = 1e9  # thirty years: a larger time is not a time since boot
_NS = 1e9
_CLOCK_OFF_S = 10.0  # batches and events are this much out of order at most
_CLOCKS = 8  # that are remembered
_COMPARED_S, _UTC_OFF_NS = 10.0, 20_000_000


@dataclass(slots=True)
class _ClockBase:
    """One of the clocks: UTC at its time 0, in force and by the least delay; its last compared time."""

    zero_ns: int
    least_ns: int
    compared_s: float


class RobotClock:
    """UTC of the times in messages: compared at the first time, and again for a time that fits no clock so far.

    Such times come when the robot restarts, its clock is set, or wraps. The times of the mission and of the simulated
    truth then go on by the clock from before. Of a real robot they are compared every ``_COMPARED_S``, and UTC is
    corrected where it is off by ``_UTC_OFF_NS``. In a simulation UTC advances with the robot's clock, in lockstep
    faster than the clock of this machine.
    """

    def __init__(self, *, is_simulation: bool, now_ns: Callable[[], int] = time.time_ns) -> None:
        self._is_simulation, self._now_ns = is_simulation, now_ns
        self._bases: deque[_ClockBase] = deque(maxlen=_CLOCKS)
        self._newest_ns = 0

    def utc_ns(self, t_s: float) -> int:
        """UTC of robot time ``t_s``, ns since 1970; of a message without a time (0) that of the newest one."""
        now_ns = self._now_ns()
        if t_s <= 0.0:
            return self._newest_ns or now_ns
        base = self._base_of(t_s, now_ns)
        self._compare(base, t_s, now_ns - round(t_s * _NS))
        utc_ns = base.zero_ns + round(t_s * _NS)
        self._newest_ns = max(self._newest_ns, utc_ns)
        return utc_ns

    def _base_of(self, t_s: float, now_ns: int) -> _ClockBase:
        """The clock by which ``t_s`` is nearest to the present; a new one if it is too far from it by all of them."""
        present_ns = self._newest_ns if self._is_simulation else now_ns
        off_s = [(base.zero_ns - present_ns) / _NS + t_s for base in self._bases]
        near = [(abs(off), k) for k, off in enumerate(off_s) if abs(off) <= _CLOCK_OFF_S]
        if not near and self._is_simulation:  # its time may pass without a message
            near = [(off, k) for k, off in enumerate(off_s) if off > 0.0]
        if near:
            return self._bases[min(near)[1]]
        begin_ns = max(now_ns, self._newest_ns) if self._is_simulation else now_ns
        zero_ns = begin_ns - round(t_s * _NS)
        self._bases.append(_ClockBase(zero_ns, zero_ns, t_s))
        return self._bases[-1]

    def _compare(self, base: _ClockBase, t_s: float, zero_ns: int) -> None:
        base.least_ns = min(base.least_ns, zero_ns)
        if not self._is_simulation and t_s - base.compared_s >= _COMPARED_S:
            if abs(base.least_ns - base.zero_ns) >= _UTC_OFF_NS:
                base.zero_ns = base.least_ns
            base.least_ns, base.compared_s = zero_ns, t_s


class RecordedMessage(NamedTuple):
    """One message: topic, robot time (s), and the JSON as it was recorded."""

    topic: str
    t_s: float
    payload: bytes


class _ChunkIndexes:
    """The index records of the chunks, kept on disk until the file ends: a day has hundreds of megabytes.

    The MCAP writer keeps a list of them, adds to it and iterates over it once.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def append(self, index: ChunkIndex) -> None:
        builder = RecordBuilder()
        index.write(builder)
        self._file.write(builder.end())  # type: ignore[no-untyped-call]

    def __iter__(self) -> Iterator["_ChunkIndexes"]:
        yield self

    def write(self, builder: RecordBuilder) -> None:
        """Write all of them."""
        self._file.seek(0)
        while part := self._file.read(_COPIED_BYTES):
            builder.write(part)


class Recorder:
    """Writes messages of a fixed set of topics to one MCAP file; never raises.

    Of each message the log time is UTC by ``clock`` and the publish time that of the robot's clock, both in ns.
    An existing file at ``path`` is kept: it is renamed ``<stem>.<n><suffix>`` (see ``recordings``). ``topics``: name
    and JSON schema of each; viewers show the schema's title. ``metadata``: what distinguishes runs (mirror, seed, ...).
    ``on_failure`` is called once with the reason when recording ends early; ``is_recording`` is False from then on, and
    after ``close``.
    """

    def __init__(
        self,
        path: Path,
        topics: Iterable[tuple[str, Mapping[str, Any]]],
        *,
        is_simulation: bool,
        metadata: Mapping[str, str] | None = None,
        on_failure: Callable[[str], None] | None = None,
        clock: RobotClock | None = None,
    ) -> None:
        self.path = path
        self._utc_ns = (clock or RobotClock(is_simulation=is_simulation)).utc_ns
        self.is_recording = True
        self._on_failure = on_failure
        self._channels: dict[str, int] = {}
        self._flushed_s = 0.0
        self._waiting_since_s: float | None = None
        self._sequence = 0
        self._files = ExitStack()
        mark = str(is_simulation).lower()
        with self._ending_at_a_failure():
            if path.exists():
                number = 1 + max(map(_part_number, recordings(path)), default=0)
                path.rename(path.with_name(f"{path.stem}.{number}{path.suffix}"))
            self._file = self._files.enter_context(path.open("xb"))
            self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)
            indexes = TemporaryFile(dir=path.parent)  # noqa: SIM115 - open as long as the recording
            vars(self._writer)["_Writer__chunk_indices"] = _ChunkIndexes(self._files.enter_context(indexes))
            self._writer.start(library="ccatp")
            self._writer.add_metadata(_METADATA, {**(metadata or {}), _SIMULATION: mark})
            for name, schema in topics:
                data = json.dumps(schema, separators=(",", ":")).encode()
                title = str(schema.get("title", name))
                schema_id = int(self._writer.register_schema(name=title, encoding="jsonschema", data=data))
                self._channels[name] = self._writer.register_channel(name, "json", schema_id, {_SIMULATION: mark})
            self._file.flush()

    def write(self, topic: str, t_s: float, payload: bytes) -> None:
        """Record one message at a robot time, s since boot; an unknown topic or an invalid time is left out."""
        channel = self._channels.get(topic)
        if channel is None or not self.is_recording or not 0.0 <= t_s < _MAX_T_S:
            return
        self._sequence += 1
        with self._ending_at_a_failure():
            self._writer.add_message(channel, self._utc_ns(t_s), payload, round(t_s * _NS), self._sequence)
            if not 0.0 <= t_s - self._flushed_s < FLUSH_AFTER_S:
                self._flush(t_s)
            elif self._waiting_since_s is None:
                self._waiting_since_s = time.monotonic()
            self._file.flush()  # a chunk that was full

    def flush_if_due(self) -> None:
        """Write a chunk that has waited too long to be full; to be called several times a second."""
        waiting_s = 0.0 if self._waiting_since_s is None else time.monotonic() - self._waiting_since_s
        if self.is_recording and waiting_s >= HELD_BACK_S:
            with self._ending_at_a_failure():
                self._flush(self._flushed_s)

    def _flush(self, t_s: float) -> None:
        self._flushed_s, self._waiting_since_s = t_s, None
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._file.flush()

    def close(self) -> None:
        """Write what is left and the index; may be repeated."""
        if self.is_recording:
            with self._ending_at_a_failure():
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._files.close()
            self.is_recording = False

    @contextmanager
    def _ending_at_a_failure(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # any error: the mission is more important than its recording
            self.is_recording = False
            with suppress(OSError):
                self._files.close()
            if self._on_failure is not None:
                why = error.strerror if isinstance(error, OSError) and error.strerror else error
                self._on_failure(f"{self.path}: recording ended: {why}")


def recordings(path: Path) -> list[Path]:
    """The files of a run that was resumed, oldest first: those kept by later recorders, then ``path`` itself."""
    kept = {_part_number(p): p for p in path.parent.glob(f"{path.stem}.*{path.suffix}")}
    parts = [kept[n] for n in sorted(n for n in kept if n > 0)]
    return [*parts, path] if path.exists() else parts


def _part_number(path: Path) -> int:
    number = Path(path.stem).suffix[1:]
    return int(number) if number.isdecimal() else 0


@dataclass(slots=True)
class FileCondition:
    """Condition of a file, known at the end of a scan; ``lost``: the stretches of bytes without an intact record."""

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


def scan(path: Path, condition: FileCondition) -> Iterator[McapRecord]:
    """The intact records of a file, chunks broken up. Raises ``OSError`` where it cannot be read.

    A chunk has a checksum, so a damaged one is left out. If the lengths are damaged, the next chunk is found by its
    first bytes, and used if its checksum is right.
    """
    condition.size_bytes = path.stat().st_size
    if not condition.size_bytes:
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = len(MAGIC) if data[: len(MAGIC)] == MAGIC else 0
        has_footer = False
        while at < len(data):
            if has_footer and data[at:] == MAGIC:
                condition.is_complete = not condition.lost
                return
            end = _end_of_record(data, at)
            records = None if end is None else _parsed(data, at, end)
            if end is None or records is None:
                # If only the content of a record is damaged, another one follows it; otherwise the next one is searched
                # for.
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


def iter_messages(path: Path, on_damage: Callable[[str], None] | None = None) -> Iterator[RecordedMessage]:
    """All messages of a file, as ``iter_logged``."""
    return (message for _, message in iter_logged(path, on_damage))


def iter_logged(
    path: Path, on_damage: Callable[[str], None] | None = None
) -> Iterator[tuple[int | None, RecordedMessage]]:
    """All intact messages of a file in the order of recording.

    Each comes with UTC minus the robot's clock, ns since 1970; None in recordings up to format 2.

    The file may end anywhere, as after a ``kill -9``; a damaged chunk gives none of its messages, and what follows it
    is read. ``on_damage`` is called at the end with the reason where the file ends early or is damaged. ``OSError``:
    the file cannot be read.
    """
    channels: dict[int, str] = {}
    condition = FileCondition()
    has_searched = False
    for record in scan(path, condition):
        if isinstance(record, Channel):
            channels[record.id] = record.topic
        elif isinstance(record, Message):
            if record.channel_id not in channels and not has_searched:
                # The chunk that names it is damaged; the end of a file repeats all names.
                has_searched = True
                channels |= {one.id: one.topic for one in scan(path, FileCondition()) if isinstance(one, Channel)}
            if record.channel_id not in channels:
                continue
            # Up to format 2 both times are the robot's.
            utc_offset_ns = record.log_time - record.publish_time or None
            yield utc_offset_ns, RecordedMessage(channels[record.channel_id], record.publish_time / _NS, record.data)
    if on_damage is not None and not condition.is_complete:
        on_damage(_damage(path, condition))


def _damage(path: Path, condition: FileCondition) -> str:
    """Where a file is damaged, and how much of it is lost."""
    if not condition.lost:
        return f"{path}: damaged or cut off at byte {condition.size_bytes}"
    where = f"{path}: damaged or cut off at byte {condition.lost[0][0]}"
    more = f" and in {len(condition.lost) - 1} more places" if len(condition.lost) > 1 else ""
    return f"{where}{more}, {condition.lost_bytes} of {condition.size_bytes} bytes are lost"


def read_metadata(path: Path) -> dict[str, str]:
    """The recorder's metadata; ``simulation`` is ``"true"`` or ``"false"``. Empty if there is none."""
    for record in scan(path, FileCondition()):
        if isinstance(record, Metadata) and record.name == _METADATA:
            return dict(record.metadata)
    return {}


def is_being_written(path: Path) -> bool:
    """Whether a run that goes on writes this recording: the newest one of its directory, which has no number."""
    return "." not in path.stem and is_held(path.parent / RUN_LOCK) is True


def damage_text(path: Path, damage: str) -> str:
    """Why a recording could not be read to its end, for a reader of the run."""
    if is_being_written(path):
        return f"{path.name}: still being written; what it holds so far is used"
    return f"{damage.replace(str(path), path.name)}; the rest is used"


RECORD_FORMAT = 3
"""Version of the format, stored in each recording; increased when an older reader would misunderstand the content."""

# In recordings of older formats: topic, text there, and the present one. A key or value, with its quotation marks.
_OLD_TEXTS: dict[str, dict[bytes, bytes]] = {
    "treatment": {b'"kind":"deaf"': b'"kind":"odometry_off"', b'"kind":"hearing"': b'"kind":"odometry_on"'},
    "mission": {b'"slips":': b'"missed_deadlines":', b'"lag_ms":': b'"worst_lateness_ms":'},
}


def decode_recorded(topic: str, payload: bytes) -> topics.Message | Verdict:
    """A recorded message, of this format or an older one; raises ``BadMessage``."""
    for old, new in _OLD_TEXTS.get(topic, {}).items():
        payload = payload.replace(old, new)
    return unpack(topic.encode() + b" " + payload)[2]
