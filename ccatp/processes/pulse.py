"""Glue. A process is seen alive: its presence on the bus, also while it waits for another one."""

import os
import time

from ccatp.bus import Publisher
from ccatp.wire.topics import Presence

PERIOD_S = 0.1


class Pulse:
    """Tells the presence of one process.

    Args:
        publisher: the process's publisher.
        process: its name.

    Attributes:
        phase: starting, ready, joined, rejoining (the robot is away), done.
        frame_s: time of the monotonic clock at which the newest frame was served, ``None`` before the first.
    """

    def __init__(self, publisher: Publisher, process: str) -> None:
        """Starting."""
        self._publisher, self._topic, self._process = publisher, f"presence.{process}", process
        self.phase = "starting"
        self.frame_s: float | None = None
        self._count, self._told_s = 0, 0.0

    @property
    def frame_age_s(self) -> float | None:
        """Since the newest frame was served."""
        return None if self.frame_s is None else time.monotonic() - self.frame_s

    def tell(self) -> None:
        """Tell it now."""
        self._told_s = now_s = time.monotonic()
        presence = Presence(
            seq=self._count,
            t_s=now_s,
            process=self._process,
            pid=os.getpid(),
            phase=self.phase,
            frame_age_s=self.frame_age_s,
        )
        self._publisher.send(self._topic, presence)
        self._count += 1

    def tell_if_due(self) -> None:
        """Tell it if it has been a while."""
        if time.monotonic() - self._told_s >= PERIOD_S:
            self.tell()
