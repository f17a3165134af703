"""Glue. What the main loop tells of any mission: lines and times in batches, its status, and what operators read."""

import time

import msgspec
import structlog

from ccatp.bus import Publisher
from ccatp.wire.topics import Log, Message, MissionStatus, SensorLines, Timing

# Frames per batch: a second of them, small enough for the bus and large enough that the cost per frame vanishes.
BATCH_FRAMES = 100
# A batch is sent after this much wall time even when it is not full, so that displays stay alive in real time.
BATCH_WALL_S = 0.25


class Teller:
    """Publishes for the main loop; a mission adds its estimates by a class of its own.

    Args:
        publisher: main's publisher.
        log: the process's logger.
    """

    def __init__(self, publisher: Publisher, log: structlog.typing.FilteringBoundLogger) -> None:
        """Start with empty batches."""
        self._publisher, self.log = publisher, log
        self._lines: list[msgspec.Raw] = []
        self._tick_us: list[float] = []
        self._flushed_wall_s = time.monotonic()
        self._frames_before = 0
        self.seq = -1
        self.t_s = 0.0

    def count_on(self) -> None:
        """The robot's frames count anew: what is recorded counts on, as far as we know how many there were."""
        self._frames_before += max(self.seq, 0)

    def stale_frame(self, seq: int, raw: bytes) -> None:
        """Keep the line of a frame that is not newer than the last one: the mission has seen it."""
        self.seq = seq
        self.keep(raw)

    def keep(self, raw: bytes) -> None:
        """Keep a frame's line for the batch."""
        self._lines.append(msgspec.Raw(raw))
        if len(self._lines) >= BATCH_FRAMES:
            self.flush()

    def tick(self, microseconds: float) -> None:
        """Note the wall time of a tick."""
        self._tick_us.append(microseconds)

    def take_estimates(self) -> tuple[str, Message] | None:
        """The pending batch of estimates and its topic, which is empty then; ``None`` without any."""
        return None

    def flush_if_due(self) -> None:
        """Publish the batches where the last time is long ago."""
        if time.monotonic() - self._flushed_wall_s >= BATCH_WALL_S:
            self.flush()

    def flush(self) -> None:
        """Publish the batches."""
        self._flushed_wall_s = time.monotonic()
        if not self._lines:
            return
        seq, t_s = self.seq, self.t_s
        estimates = self.take_estimates()
        if estimates is not None:
            self._publisher.send(*estimates)
            self._publisher.send("timing", Timing(seq=seq, t_s=t_s, tick_us=self._tick_us))
        self._publisher.send("sensors", SensorLines(seq=seq, t_s=t_s, lines=self._lines))
        self._lines, self._tick_us = [], []

    def status(self, message: MissionStatus) -> None:
        """Publish the mission's status."""
        self._publisher.send("mission", message)

    def say(self, level: str, text: str) -> None:
        """One line for the log file and for the operator's terminal."""
        self.log.log({"info": 20, "warning": 30, "error": 40}[level], text, seq=self.seq, t_s=self.t_s)
        self._publisher.send("log", Log(seq=self.seq, t_s=self.t_s, level=level, process="main", text=text))
