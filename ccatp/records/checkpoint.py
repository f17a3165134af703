"""The checkpoint beside the mission's database: the robot's place and what is in force, for the next main loop.

Two slots in one file, written in turn, each with a count and a checksum: whatever instant the writer dies at, one of
them is whole. A pose is left to the kernel, which keeps it when the process dies; what an operator or the observatory
decided is synchronised to the disk, by a thread: neither may keep the control loop waiting.
"""

import os
import threading
import zlib
from pathlib import Path

import msgspec

from ccatp.errors import CcatpError, ExitStatus

FILE = "checkpoint"
# Each in a page of its own: a torn page takes one slot with it.
_SLOT_BYTES = 4096
_HEAD_BYTES = 8  # length and checksum
_AT_BASE = "set it at base, remove this file and resume"


class CheckpointError(CcatpError):
    """There is a checkpoint that cannot be read: the robot's place has to be set by hand."""

    exit_status = ExitStatus.USAGE


class Checkpoint(msgspec.Struct, kw_only=True):
    """State that one main loop leaves to the next.

    Attributes:
        boot: the robot's boot; its clock counts from there.
        x_m, y_m, heading_rad: pose, deck frame.
        abort_cause: why the survey was given up, or empty.
        last_fix: the point whose fix was the last one stored, or empty.
    """

    count: int
    boot: int
    seq: int
    t_s: float
    x_m: float
    y_m: float
    heading_rad: float
    sigma_m: float
    heading_sigma_rad: float
    speed_m_s: float
    rate_rad_s: float
    state: str
    abort_cause: str
    held_cause: str
    elapsed_s: float
    last_fix: str


class CheckpointFile:
    """Writes checkpoints.

    Args:
        is_patient: simulated time waits for the writer, so that a pose may be written at once and not by the thread.

    Attributes:
        failure: why the last record could not be written, or empty.
    """

    def __init__(self, path: Path, *, is_patient: bool) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self.failure = ""
        self._is_patient = is_patient
        self._newest: Checkpoint | None = None
        self._is_durable = self._is_closing = False
        self._wake = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="checkpoint", daemon=True)
        self._thread.start()

    def write(self, record: Checkpoint, *, is_durable: bool = False) -> None:
        """Take a record, whose count is one more than the last one's; it replaces one that waits. Returns at once."""
        if self._is_patient and not is_durable:
            self._put(record, is_durable=False)
            return
        with self._wake:
            self._newest = record
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
                record, self._newest = self._newest, None
                is_durable, self._is_durable = self._is_durable, False
            if record is None:
                return
            self._put(record, is_durable=is_durable)

    def _put(self, record: Checkpoint, *, is_durable: bool) -> None:
        body = msgspec.json.encode(record)
        head = len(body).to_bytes(4, "little") + zlib.crc32(body).to_bytes(4, "little")
        try:
            os.pwrite(self._fd, head + body, record.count % 2 * _SLOT_BYTES)
            if is_durable:
                os.fdatasync(self._fd)
            self.failure = ""
        except OSError as error:
            self.failure = error.strerror or str(error)


def read_checkpoint(path: Path) -> Checkpoint | None:
    """The newest whole record of a file, ``None`` where nothing was written.

    ``CheckpointError``: something was written, and none of it is whole.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CheckpointError(f"{path}: {error.strerror or error}; {_AT_BASE}") from error
    records = [record for k in range(2) if (record := _slot(data[k * _SLOT_BYTES : (k + 1) * _SLOT_BYTES])) is not None]
    if data and not records:
        raise CheckpointError(f"{path}: damaged, so the robot's place is not known; {_AT_BASE}")
    return max(records, key=lambda record: record.count, default=None)


def _slot(data: bytes) -> Checkpoint | None:
    length, crc = int.from_bytes(data[:4], "little"), int.from_bytes(data[4:8], "little")
    body = data[_HEAD_BYTES : _HEAD_BYTES + length]
    if not body or len(body) != length or zlib.crc32(body) != crc:
        return None
    try:
        return msgspec.json.decode(body, type=Checkpoint)
    except msgspec.MsgspecError:
        return None
