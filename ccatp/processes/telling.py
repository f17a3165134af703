"""Glue. What the main loop tells the others: its estimate every frame, the rest in batches and events."""

import time

import msgspec
import structlog

from ccatp.bus import Publisher
from ccatp.localizer import Localizer
from ccatp.processes.painting import Painter
from ccatp.samples import Fix, PointId
from ccatp.wire.topics import (
    Arrival,
    Estimate,
    FixMessage,
    Log,
    MissionStatus,
    Rest,
    SensorLines,
    Timing,
    Track,
    Treatment,
    TreatmentKind,
    is_estimate_due,
)

# Frames per batch: a second of them, small enough for the bus and large enough that the cost per frame vanishes.
BATCH_FRAMES = 100
# A batch is sent after this much wall time even when it is not full, so that displays stay alive in real time.
BATCH_WALL_S = 0.25


class Teller:
    """Publishes for the main loop.

    Args:
        publisher: main's publisher.
        log: the process's logger.
    """

    def __init__(self, publisher: Publisher, log: structlog.typing.FilteringBoundLogger) -> None:
        """Start with empty batches."""
        self._publisher, self.log = publisher, log
        self._painter = Painter(publisher)
        self._track: list[tuple[int, float, int, int, float, float, float, float]] = []
        self._lines: list[msgspec.Raw] = []
        self._tick_us: list[float] = []
        self._flushed_wall_s = time.monotonic()
        self._frames_before = 0
        self.seq = -1
        self.t_s = 0.0

    def frame(
        self,
        seq: int,
        t_s: float,
        localizer: Localizer,
        state: str,
        raw: bytes,
        told: tuple[tuple[float, float, float, float], int] | None = None,
        *,
        is_first: bool = False,
    ) -> None:
        """Keep the estimate after frame ``seq`` and the frame's line for the batch; publish it where it is due.

        Args:
            seq, t_s: the frame.
            localizer: has the estimate.
            state: of the mission.
            raw: the frame's line.
            told: span of the set points since the last estimate, rad/s, and the number of the newest drive.
            is_first: of a session; it is always due, because the danger loop may wait for it.
        """
        self.seq, self.t_s = seq, t_s
        self._painter.sees(localizer, raw)
        pose, sigma = localizer.pose, localizer.position_sigma_m
        if is_first or is_estimate_due(seq):
            deck = localizer.deck_pose
            x, y, heading = deck.x_m, deck.y_m, deck.heading_rad
            commanded, drive_seq = told if told is not None else (None, -1)
            message = Estimate(
                seq=seq,
                t_s=t_s,
                x_m=x,
                y_m=y,
                heading_rad=heading,
                sigma_m=sigma,
                state=state,
                commanded=commanded,
                drive_seq=drive_seq,
            )
            self._publisher.send("estimate", message)
        row, col = pose.panel
        self._track.append((seq + self._frames_before, t_s, row, col, pose.x_m, pose.y_m, pose.heading_rad, sigma))
        self._keep(raw)

    def count_on(self) -> None:
        """The robot's frames count anew: what is recorded counts on, as far as we know how many there were."""
        self._frames_before += max(self.seq, 0)

    def stale_frame(self, seq: int, raw: bytes) -> None:
        """Keep the line of a frame that is not newer than the last one: the localizer has seen it."""
        self.seq = seq
        self._keep(raw)

    def _keep(self, raw: bytes) -> None:
        self._lines.append(msgspec.Raw(raw))
        if len(self._lines) >= BATCH_FRAMES:
            self.flush()

    def tick(self, microseconds: float) -> None:
        """Note the wall time of a tick."""
        self._tick_us.append(microseconds)

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
        if self._track:
            self._publisher.send("track", Track(seq=seq, t_s=t_s, rows=self._track))
            self._publisher.send("timing", Timing(seq=seq, t_s=t_s, tick_us=self._tick_us))
        self._publisher.send("sensors", SensorLines(seq=seq, t_s=t_s, lines=self._lines))
        self._track, self._lines, self._tick_us = [], [], []

    def arrival(self, seq: int, t_s: float, point: PointId, error_m: float) -> None:
        """The robot came to rest in frame ``seq``, at a point for the first time."""
        message = Arrival(
            seq=seq + self._frames_before, t_s=t_s, point=(point.row, point.col, point.point), error_mm=1e3 * error_m
        )
        self._publisher.send("arrival", message)

    def rest(self, seq: int, t_s: float) -> None:
        """The mission takes the robot to be at rest from frame ``seq`` on."""
        self._publisher.send("rest", Rest(seq=seq, t_s=t_s))

    def treatment(self, seq: int, t_s: float, kind: TreatmentKind, values: tuple[float, ...] = ()) -> None:
        """The localizer is treated in frame ``seq``; see ``Treatment``."""
        self._publisher.send("treatment", Treatment(seq=seq, t_s=t_s, kind=kind, values=values))

    def fix(self, point: PointId | None, fix: Fix, jump_m: float, *, is_fused: bool) -> None:
        """A fix was handed to the localizer after the last frame; ``None`` for one that only finds the robot."""
        message = FixMessage(
            seq=self.seq,
            t_s=fix.t_s,
            point=(point.row, point.col, point.point) if point is not None else None,
            is_fused=is_fused,
            position_m=fix.position_m,
            covariance_m2=list(fix.covariance_m2),
            dop=fix.dop,
            residual_rms_m=fix.residual_rms_m,
            channels=list(fix.channels),
            jump_mm=1e3 * jump_m,
        )
        self._publisher.send("fix", message)

    def status(self, message: MissionStatus) -> None:
        """Publish the mission's status, and a picture of all that is newest for whoever looks on."""
        self._publisher.send("mission", message)
        self._painter.tell_if_wanted(self.seq, self.t_s)

    def say(self, level: str, text: str) -> None:
        """One line for the log file and for the operator's terminal."""
        self.log.log({"info": 20, "warning": 30, "error": 40}[level], text, seq=self.seq, t_s=self.t_s)
        self._publisher.send("log", Log(seq=self.seq, t_s=self.t_s, level=level, process="main", text=text))
