"""Data that grow during a run, with a limit: series of the plots, driven path, messages, errors against the truth."""

import asyncio
import os
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from math import dist, hypot, inf
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from ccatp.conditions import danger_text
from ccatp.links.bus_codec import BadMessage
from ccatp.links.liveness import kind_of
from ccatp.links.topics import OPERATOR_MESSAGE, Message
from ccatp.records.recorder import decode_recorded, iter_messages

Row = tuple[Any, ...]

# Batches come at least once a second, so a longer time without rows is a gap.
GAP_S = 3.0
# Not visible on a map of six metres.
PATH_STEP_M = 0.02


def is_gap(row: Row) -> bool:
    """Whether a row marks a gap between the row before it and the row after it."""
    return all(value is None for value in row[1:])


class Growing:
    """Rows that begin with the mission's time (s); with more than ``limit`` the older half is thinned.

    A time without rows longer than ``gap_s`` is marked by a row without values: no line is drawn across it.
    """

    def __init__(self, limit: int, gap_s: float = inf) -> None:
        self._limit, self._gap_s = limit, gap_s
        self._seen_s = inf  # time of the last row, kept or not
        self.rows: list[Row] = []
        self._new: list[Row] = []

    def add(self, t_s: float | None, *values: Any) -> None:
        """Add a row if its time is known; a time before that of the last row is replaced by it."""
        if t_s is None:
            return
        t_s = max(t_s, self.rows[-1][0]) if self.rows else t_s
        if t_s - self._seen_s > self._gap_s:
            self._append((t_s, *(None for _ in values)))
        self._seen_s = t_s
        if self._is_kept(values):
            self._append((t_s, *values))

    def take_new(self) -> list[Row]:
        """The rows since the last call, at most ``limit``."""
        new, self._new = self._new[-self._limit :], []
        return new

    def prepend(self, rows: Sequence[Row]) -> None:
        """Put earlier rows before the first one."""
        first = self.rows[:1]
        before = [row for row in rows if not first or row[0] < first[0][0]]
        if before and first and first[0][0] - before[-1][0] > self._gap_s:
            before.append((first[0][0], *(None for _ in first[0][1:])))
        self.rows[:0] = before
        while len(self.rows) > self._limit:
            self._thin()

    def _is_kept(self, values: Row) -> bool:
        del values
        return True

    def _append(self, row: Row) -> None:
        self.rows.append(row)
        self._new.append(row)
        if len(self.rows) > self._limit:
            self._thin()

    def _thin(self) -> None:
        """Keep the row with the larger value of each pair in the older half; keep the first row and gaps."""
        half, kept, is_first = len(self.rows) // 2, self.rows[:1], True
        for row in self.rows[1:half]:
            if is_gap(row):
                is_first = True
                if kept and not is_gap(kept[-1]):
                    kept.append(row)
            elif is_first:
                kept.append(row)
                is_first = False
            else:
                kept[-1] = max(kept[-1], row, key=_size)
                is_first = True
        self.rows[:half] = kept if len(kept) < half else self.rows[1:half]


def _size(row: Row) -> float:
    return -inf if row[1] is None else float(row[1])


class Trail(Growing):
    """The driven path: rows of time (s), x and y (m), in steps of at least ``PATH_STEP_M``."""

    def _is_kept(self, values: Row) -> bool:
        return not self.rows or is_gap(self.rows[-1]) or dist(values, self.rows[-1][1:]) >= PATH_STEP_M


class Lines:
    """Newest message of each kind to the operator: time (UTC, ISO format), level, text, count, number of its kind.

    ``left_out``: how many older messages were dropped.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._rows: dict[tuple[str, str], Row] = {}
        self._new: dict[tuple[str, str], Row] = {}
        self._kinds = self.left_out = 0

    def add(self, utc: str, level: str, text: str) -> None:
        """Add a message."""
        key = level, kind_of(text)
        before = self._rows.pop(key, None)
        self._new.pop(key, None)
        self._kinds += before is None
        times, kind = (1, self._kinds) if before is None else (before[3] + 1, before[4])
        self._rows[key] = self._new[key] = (utc, level, text, times, kind)
        if len(self._rows) > self._limit:
            self.left_out += self._rows.pop(next(iter(self._rows)))[3]
        if len(self._new) > self._limit:
            del self._new[next(iter(self._new))]

    @property
    def rows(self) -> list[Row]:
        """All rows, the newest last."""
        return list(self._rows.values())

    def take_new(self) -> list[Row]:
        """The rows since the last call."""
        new, self._new = list(self._new.values()), {}
        return new


# Every tenth frame is compared, ten a second.
EVERY = 10
# Largest number of frames that wait for their counterpart: batches of one second, with a margin.
WAITING = 500


class TruthCompare:
    """Joins estimates with the simulated truth of the same frame; either may arrive first.

    The largest error of each second is a row of ``errors``: time (s), error and three sigma of the position (mm).
    """

    def __init__(self, errors: Growing) -> None:
        self._errors = errors
        self._waiting: tuple[dict[int, tuple[float, ...]], dict[int, tuple[float, ...]]] = ({}, {})
        self._worst: tuple[float, float, float] | None = None

    @staticmethod
    def is_compared(seq: int) -> bool:
        """Whether a frame is compared."""
        return seq % EVERY == 0

    def estimate(self, seq: int, x_m: float, y_m: float, sigma_m: float) -> None:
        """Add the estimate after frame ``seq``, deck frame."""
        self._join(seq, 0, (x_m, y_m, sigma_m))

    def truth(self, seq: int, t_s: float, x_m: float, y_m: float) -> None:
        """Add the true position in frame ``seq``."""
        if self.is_compared(seq):
            self._join(seq, 1, (t_s, x_m, y_m))

    def _join(self, seq: int, side: int, value: tuple[float, ...]) -> None:
        own = self._waiting[side]
        own[seq] = value
        if len(own) > WAITING:
            del own[next(iter(own))]
        if not all(seq in waiting for waiting in self._waiting):
            return
        (x_m, y_m, sigma_m), (t_s, true_x_m, true_y_m) = (waiting.pop(seq) for waiting in self._waiting)
        here, before = (t_s, 1e3 * hypot(x_m - true_x_m, y_m - true_y_m), 3e3 * sigma_m), self._worst
        if before is not None and int(t_s) == int(before[0]):
            self._worst = max(before, here, key=lambda second: second[1])
            return
        self._worst = here
        if before is not None:
            self._errors.add(round(before[0], 2), round(before[1], 3), round(before[2], 3))


# -- what the run directory holds ----------------------------------------------------------------------------------

LOG, EMERGENCIES = "log.jsonl", "emergencies.json"
MAX_READ_BYTES = 1 << 20  # at a time: a log of a day must not delay the pages
SHOWN_EVENTS = (OPERATOR_MESSAGE, "verdict_changed")
_MARKS = tuple(f'"{event}"'.encode() for event in SHOWN_EVENTS)


class LogEntry(msgspec.Struct):
    """The parts of a log line that the page shows."""

    event: str = ""
    timestamp: str = ""
    level: str = "info"
    text: str = ""
    cause: str = ""
    condition: str = ""
    signal: str = ""
    value: float = 0.0
    limit: float = 0.0


_entry = msgspec.json.Decoder(LogEntry)


class RunFollower:
    """Follows the log of a run, whose messages go to ``lines``, and the file of its emergencies.

    ``started``: when the run began, UTC in ISO format, empty while that is not known; ``emergencies``: those that are
    latched, each with kind, id and note.
    """

    def __init__(self, folder: Path | None, lines: Lines) -> None:
        folder = folder or Path(os.devnull)  # in which there is nothing
        self._log, self._latch, self._lines = folder / LOG, folder / EMERGENCIES, lines
        self._file: BinaryIO | None = None
        self._rest = b""
        self._changed_ns = 0
        self.started = ""
        self.emergencies: list[dict[str, str]] = []

    def read(self) -> None:
        """Read new data; data that cannot be read are ignored."""
        with suppress(OSError):
            self._file = self._file or self._log.open("rb")
            *lines, rest = (self._rest + self._file.read(MAX_READ_BYTES)).split(b"\n")
            self._rest = rest[:MAX_READ_BYTES]
            for line in lines:
                if not self.started or any(mark in line for mark in _MARKS):
                    self._take(line)
        with suppress(OSError, msgspec.MsgspecError, KeyError, TypeError):
            changed_ns = self._latch.stat().st_mtime_ns
            if changed_ns != self._changed_ns:
                self.emergencies = msgspec.json.decode(self._latch.read_bytes())["active"]
                self._changed_ns = changed_ns

    def close(self) -> None:
        """Close the log."""
        if self._file is not None:
            self._file.close()

    def _take(self, line: bytes) -> None:
        try:
            entry = _entry.decode(line)
        except (msgspec.MsgspecError, UnicodeDecodeError):
            return
        self.started = self.started or entry.timestamp
        if entry.event == OPERATOR_MESSAGE:
            self._lines.add(entry.timestamp, entry.level, entry.text)
        elif entry.event in SHOWN_EVENTS and entry.cause:
            text = danger_text(entry.condition, entry.cause, entry.signal, entry.value, entry.limit)
            self._lines.add(entry.timestamp, "warning", f"danger: {text}")


# Reading a recording of hours takes minutes; pages, heartbeats and messages must continue meanwhile.
READ_S, PAUSE_S = 0.02, 0.08


async def replay(paths: Iterable[Path], topics: Iterable[str], receive: Callable[[Message], None]) -> None:
    """Pass the recorded messages of these topics to ``receive``, oldest first; damaged ones are left out."""
    wanted, due_s = frozenset(topics), time.monotonic() + READ_S
    for path in paths:
        with suppress(OSError):
            for recorded in iter_messages(path):
                if recorded.topic in wanted:
                    with suppress(BadMessage):
                        message = decode_recorded(recorded.topic, recorded.payload)
                        if isinstance(message, Message):
                            receive(message)
                if time.monotonic() > due_s:
                    await asyncio.sleep(PAUSE_S)
                    due_s = time.monotonic() + READ_S
