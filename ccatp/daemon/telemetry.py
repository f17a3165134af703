"""What the main loop publishes: lines, tracks and times in batches, status, messages, display state, survey events."""

import time
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import msgspec
import structlog

from ccatp.core import Fix, PointId
from ccatp.daemon.process import LEVELS, OPERATOR_MESSAGE
from ccatp.links.bus import Publisher
from ccatp.links.topics import (
    ArrivalMessage,
    DisplayState,
    EstimateMessage,
    FixMessage,
    LogMessage,
    Message,
    MissionStatus,
    Rest,
    SensorLines,
    Timing,
    TrackMessage,
    Treatment,
    TreatmentKind,
    is_estimate_due,
)
from ccatp.localizer import Localizer

# Frames per batch: a second of them, small enough for the bus and large enough that the cost per frame vanishes.
BATCH_FRAMES = 100
# A batch is sent after this much wall time even when it is not full, so that displays stay alive in real time.
BATCH_WALL_S = 0.25


class TelemetryPublisher:
    """Publishes for the main loop; a mission adds its estimates by a class of its own."""

    def __init__(self, publisher: Publisher, log: structlog.typing.FilteringBoundLogger) -> None:
        self._publisher, self.log = publisher, log
        self._lines: list[msgspec.Raw] = []
        self._tick_us: list[float] = []
        self._flushed_wall_s = time.monotonic()
        self._frames_before = 0
        self.seq = -1
        self.t_s = 0.0

    def continue_numbering(self) -> None:
        """The robot's frames count anew: what is recorded counts on, as far as we know how many there were."""
        self._frames_before += max(self.seq, 0)

    def stale_frame(self, seq: int, raw: bytes) -> None:
        """Keep the line of a frame that is not newer than the last one: the mission has seen it."""
        self.seq = seq
        self.add_line(raw)

    def add_line(self, raw: bytes) -> None:
        """Keep a frame's line for the batch."""
        self._lines.append(msgspec.Raw(raw))
        if len(self._lines) >= BATCH_FRAMES:
            self.flush()

    def add_tick(self, microseconds: float) -> None:
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

    def publish_status(self, message: MissionStatus) -> None:
        """Publish the mission's status."""
        self._publisher.send("mission", message)

    def notify_operator(self, level: str, text: str) -> None:
        """One line for the log file and for the operator's terminal."""
        self.log.log(LEVELS[level], OPERATOR_MESSAGE, text=text, seq=self.seq, t_s=self.t_s)
        self._publisher.send("log", LogMessage(seq=self.seq, t_s=self.t_s, level=level, process="main", text=text))


class PoseSnapshot(NamedTuple):
    """The pose as ``DisplayState`` tells it."""

    x_m: float
    y_m: float
    heading_rad: float
    covariance_m2: tuple[float, float, float]
    heading_sigma_rad: float
    nis: float
    size: int


Source = TypeVar("Source")


class DisplayStatePublisher(Generic[Source]):
    """Publishes ``DisplayState`` for the main loop."""

    def __init__(self, publisher: Publisher, snapshot_of: Callable[[Source], PoseSnapshot]) -> None:
        self._publisher, self._snapshot_of = publisher, snapshot_of
        self._source: Source | None = None
        self._line = b"null"

    def update(self, source: Source, line: bytes) -> None:
        """A frame was served: who knows the pose, and its line. Called in every frame, so it only notes them."""
        self._source, self._line = source, line

    def publish_if_subscribed(self, seq: int, t_s: float) -> None:
        """Publish, if there are subscribers.

        Args:
            seq, t_s: the newest frame.
        """
        if self._source is None or not self._publisher.has_subscriber("display_state"):
            return
        snapshot = self._snapshot_of(self._source)
        self._publisher.send(
            "display_state", DisplayState(seq=seq, t_s=t_s, line=msgspec.Raw(self._line), **snapshot._asdict())
        )


class SurveyTelemetry(TelemetryPublisher):
    """Publishes for a survey."""

    def __init__(self, publisher: Publisher, log: structlog.typing.FilteringBoundLogger) -> None:
        super().__init__(publisher, log)
        self._display = DisplayStatePublisher(publisher, localizer_pose)
        self._track: list[tuple[int, float, int, int, float, float, float, float]] = []

    def publish_frame(
        self,
        seq: int,
        t_s: float,
        localizer: Localizer,
        state: str,
        raw: bytes,
        commands: tuple[tuple[float, float, float, float], int] | None = None,
        *,
        is_first: bool = False,
    ) -> None:
        """Keep the estimate after frame ``seq`` and the frame's line for the batch; publish it where it is due.

        Args:
            seq, t_s: the frame.
            raw: the frame's line.
            commands: span of the set points since the last estimate, rad/s, and the number of the newest drive.
            is_first: of a session; it is always due, because the danger loop may wait for it.
        """
        self.seq, self.t_s = seq, t_s
        self._display.update(localizer, raw)
        pose, sigma = localizer.pose, localizer.position_sigma_m
        if is_first or is_estimate_due(seq):
            deck = localizer.deck_pose
            x, y, heading = deck.x_m, deck.y_m, deck.heading_rad
            commanded, drive_seq = commands if commands is not None else (None, -1)
            message = EstimateMessage(
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
        self.add_line(raw)

    def take_estimates(self) -> tuple[str, Message] | None:
        """The pending rows of the track."""
        rows, self._track = self._track, []
        return ("track", TrackMessage(seq=self.seq, t_s=self.t_s, rows=rows)) if rows else None

    def publish_arrival(self, seq: int, t_s: float, point: PointId, error_m: float) -> None:
        """The robot came to rest in frame ``seq``, at a point for the first time."""
        message = ArrivalMessage(
            seq=seq + self._frames_before, t_s=t_s, point=(point.row, point.col, point.point), error_mm=1e3 * error_m
        )
        self._publisher.send("arrival", message)

    def publish_rest(self, seq: int, t_s: float) -> None:
        """The mission takes the robot to be at rest from frame ``seq`` on."""
        self._publisher.send("rest", Rest(seq=seq, t_s=t_s))

    def publish_treatment(self, seq: int, t_s: float, kind: TreatmentKind, values: tuple[float, ...] = ()) -> None:
        """The localizer is treated in frame ``seq``; see ``Treatment``."""
        self._publisher.send("treatment", Treatment(seq=seq, t_s=t_s, kind=kind, values=values))

    def publish_fix(
        self, point: PointId | None, fix: Fix, jump_m: float, *, is_fused: bool, is_set_aside: bool = False
    ) -> None:
        """A fix was measured after the last frame; no point for one that only finds the robot.

        Args:
            is_set_aside: the localizer was not given it.
        """
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
            is_set_aside=is_set_aside,
        )
        self._publisher.send("fix", message)

    def publish_status(self, message: MissionStatus) -> None:
        """Publish the mission's status, and a picture of all that is newest for whoever looks on."""
        super().publish_status(message)
        self._display.publish_if_subscribed(self.seq, self.t_s)


def localizer_pose(localizer: Localizer) -> PoseSnapshot:
    """The pose on the deck, and the filter's last update."""
    pose, covariance, innovation = localizer.deck_pose, localizer.pose_covariance, localizer.innovation
    return PoseSnapshot(
        x_m=pose.x_m,
        y_m=pose.y_m,
        heading_rad=pose.heading_rad,
        covariance_m2=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
        heading_sigma_rad=localizer.heading_sigma_rad,
        nis=innovation.nis if innovation is not None else 0.0,
        size=innovation.size if innovation is not None else 0,
    )
