"""Edge. Every intact record of an MCAP file, whatever lies between them: for looking into recordings and saving them.

A chunk carries a checksum, so one that is damaged is known and left out. Where the lengths themselves are damaged, the
next chunk is found by how it begins, and taken if its checksum is right.
"""

import mmap
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from zstandard import ZstdError

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
        size_bytes: of the file.
        lost: beginning and end of each stretch of bytes that holds no intact record.
        is_complete: the file was closed in good order.
        chunks: intact chunks.
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

    Args:
        path: an MCAP file, in whatever state.
        condition: told what is wrong with it.

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
