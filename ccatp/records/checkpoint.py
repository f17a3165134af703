"""The checkpoint beside the mission's database: the state of one main loop for the next one.

The file has two slots, written in turn, each with a checksum and a count. So one of them is complete at whatever
instant the writer ends. A pose is written to the kernel, which keeps it if the process ends. A decision of an operator
or of the observatory is synchronised to the disk by a thread. Neither delays the control loop.
"""

import os
import threading
import zlib
from pathlib import Path
from typing import TypeVar

import msgspec

from ccatp.config.files import read_input
from ccatp.errors import UsageError

CHECKPOINT_FILE = "checkpoint"
# Offset of the second slot. A longer record overwrites the older one, and is complete itself.
_SLOT_BYTES = 65536
_HEAD_BYTES = 8  # length and checksum of count and record
_COUNT_BYTES = 8
Record = TypeVar("Record", bound=msgspec.Struct)
AT_BASE = "so the robot's place is not known; set it at base, remove this file and resume"


class CheckpointError(UsageError):
    """The checkpoint cannot be read, so the operator has to give the robot's pose."""


class CheckpointFile:
    """Writes records; ``failure``: why the last one could not be written, or empty.

    ``is_patient``: simulated time waits for the writer, so records are written at once and not by the thread.
    """

    def __init__(self, path: Path, *, is_patient: bool) -> None:
        # It is named with its first record, so an empty file has lost its content.
        self._path, self._is_named = path, path.exists()
        self._fd = os.open(path if self._is_named else _unnamed(path), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self.failure = ""
        self._encode = msgspec.msgpack.Encoder().encode
        self._is_patient = is_patient
        self._count = max((count for count, _ in _slots(read_input(path))), default=0) if self._is_named else 0
        self._newest: tuple[int, msgspec.Struct] | None = None
        self._is_durable = self._is_closing = False
        self._wake = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="checkpoint", daemon=True)
        self._thread.start()

    def write(self, record: msgspec.Struct, *, is_durable: bool = False) -> None:
        """Take a frozen record; it replaces one that waits. Returns at once."""
        self._count += 1
        if self._is_patient and not is_durable:
            self._put(self._count, record, is_durable=False)
            return
        with self._wake:
            self._newest = self._count, record
            self._is_durable |= is_durable
            self._wake.notify()

    def close(self) -> None:
        """Write the record that waits and close the file."""
        with self._wake:
            self._is_closing = True
            self._wake.notify()
        self._thread.join()
        os.close(self._fd)

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._newest is not None or self._is_closing)
                newest, self._newest = self._newest, None
                is_durable, self._is_durable = self._is_durable, False
            if newest is None:
                return
            self._put(*newest, is_durable=is_durable)

    def _put(self, count: int, record: msgspec.Struct, *, is_durable: bool) -> None:
        body = count.to_bytes(_COUNT_BYTES, "little") + self._encode(record)
        head = len(body).to_bytes(4, "little") + zlib.crc32(body).to_bytes(4, "little")
        try:
            os.pwrite(self._fd, head + body, count % 2 * _SLOT_BYTES)
            if not self._is_named:
                _unnamed(self._path).replace(self._path)
                self._is_named = True
            if is_durable:
                os.fdatasync(self._fd)
            self.failure = ""
        except OSError as error:
            self.failure = error.strerror or str(error)


def _unnamed(path: Path) -> Path:
    return path.with_name(f"{path.name}.new")


def read_checkpoint(path: Path, kind: type[Record]) -> Record | None:
    """The newest whole record of a file, ``None`` where there is no file.

    ``CheckpointError``: none in it is whole, or it is not of this ``kind``.
    """
    try:
        data = read_input(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CheckpointError(f"{path}: {error.strerror or error}; {AT_BASE}") from error
    slots = _slots(data)
    if not slots:
        raise CheckpointError(f"{path}: {'damaged' if data else 'empty'}, {AT_BASE}")
    try:
        found = msgspec.msgpack.decode(max(slots)[1], type=kind)
    except msgspec.MsgspecError as error:
        raise CheckpointError(f"{path}: written by a version of ccatp with another format, {AT_BASE}") from error
    # The first record is in the second slot, so that a shorter file was cut off and may have lost the newest record.
    if len(data) <= _SLOT_BYTES:
        raise CheckpointError(f"{path}: cut off, {AT_BASE}")
    return found


def _slots(data: bytes) -> list[tuple[int, bytes]]:
    """Count and record of each slot that is whole."""
    found = []
    for slot in (data, data[_SLOT_BYTES:]):
        length, crc = int.from_bytes(slot[:4], "little"), int.from_bytes(slot[4:_HEAD_BYTES], "little")
        body = slot[_HEAD_BYTES : _HEAD_BYTES + length]
        if body and len(body) == length and zlib.crc32(body) == crc:
            found.append((int.from_bytes(body[:_COUNT_BYTES], "little"), body[_COUNT_BYTES:]))
    return found
