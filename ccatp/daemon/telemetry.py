"""Publications of the main loop: lines, tracks and times in batches, and messages for the operator."""

import time
from collections.abc import Callable
from typing import Any

import msgspec
import structlog

from ccatp.daemon.process import LEVELS, OPERATOR_MESSAGE
from ccatp.links.bus import Publisher
from ccatp.links.topics import LogMessage, Message, SensorLines, Timing

# Frames per batch: a second of them, small enough for the bus and large enough that the cost per frame vanishes.
BATCH_FRAMES = 100
# A batch is sent after this much wall time even when it is not full, so that displays stay alive in real time.
BATCH_WALL_S = 0.25


class Telemetry:
    """Publishes for the main loop.

    Args:
        topic, track: topic and message of a batch of estimates.

    Attributes:
        send: publishes one message of a topic.
        seq, t_s: the newest frame.
        frames_before: the recorded number of a frame is its ``seq`` and this.
        newest_line: of the newest frame with an estimate.
        tick_us: wall times of frames for the next batch.
    """

    def __init__(
        self,
        publisher: Publisher,
        log: structlog.typing.FilteringBoundLogger,
        topic: str,
        track: Callable[..., Message],
    ) -> None:
        self.send, self.log, self._topic, self._track = publisher.send, log, topic, track
        self._lines: list[msgspec.Raw] = []
        self._rows: list[tuple[Any, ...]] = []
        self.tick_us: list[float] = []
        self._flushed_wall_s = time.monotonic()
        self.frames_before = 0
        self.newest_line = msgspec.Raw(b"null")
        self.seq = -1
        self.t_s = 0.0

    def continue_numbering(self) -> None:
        """The robot's frames restarted: recorded numbers go on, as far as the number of frames is known."""
        self.frames_before += max(self.seq, 0)

    def add_frame(self, seq: int, t_s: float, raw: bytes, row: tuple[Any, ...]) -> None:
        """Keep the line of frame ``seq`` and its row of the track, which has the recorded number."""
        self.t_s, self.newest_line = t_s, msgspec.Raw(raw)
        self._rows.append(row)
        self.seq = seq
        self._lines.append(self.newest_line)
        if len(self._lines) >= BATCH_FRAMES:
            self.flush()

    def add_line(self, seq: int, raw: bytes) -> None:
        """Keep the line alone, of a frame that is not newer than the last one."""
        self.seq = seq
        self._lines.append(msgspec.Raw(raw))
        if len(self._lines) >= BATCH_FRAMES:
            self.flush()

    def flush(self, least_age_s: float = 0.0) -> None:
        """Publish the batches where the last time is at least so long ago."""
        now_s = time.monotonic()
        if now_s - self._flushed_wall_s < least_age_s:
            return
        self._flushed_wall_s = now_s
        if not self._lines:
            return
        seq, t_s = self.seq, self.t_s
        if self._rows:
            self.send(self._topic, self._track(seq=seq, t_s=t_s, rows=self._rows))
            self.send("timing", Timing(seq=seq, t_s=t_s, tick_us=self.tick_us))
        self.send("sensors", SensorLines(seq=seq, t_s=t_s, lines=self._lines))
        self._lines, self._rows, self.tick_us = [], [], []

    def notify_operator(self, level: str, text: str) -> None:
        """One line for the log file and for the operator's terminal."""
        self.log.log(LEVELS[level], OPERATOR_MESSAGE, text=text, seq=self.seq, t_s=self.t_s)
        self.send("log", LogMessage(seq=self.seq, t_s=self.t_s, level=level, process="main", text=text))
