"""Publications of the main loop: lines, tracks and times in batches, status, messages, display state, survey events."""

import time
from dataclasses import asdict

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
    """Publishes for the main loop; a mission adds its estimates in a subclass.

    Attributes:
        seq, t_s: the newest frame.
    """

    def __init__(self, publisher: Publisher, log: structlog.typing.FilteringBoundLogger) -> None:
        self._publisher, self.log = publisher, log
        self._lines: list[msgspec.Raw] = []
        self._newest_line = msgspec.Raw(b"null")
        self._tick_us: list[float] = []
        self._flushed_wall_s = time.monotonic()
        self._frames_before = 0
        self.seq = -1
        self.t_s = 0.0

    def continue_numbering(self) -> None:
        """The robot's frames restarted: recorded numbers go on, as far as the number of frames is known."""
        self._frames_before += max(self.seq, 0)

    def stale_frame(self, seq: int, raw: bytes) -> None:
        """Keep the line of a frame that is not newer than the last one, without an estimate."""
        self.seq = seq
        self._add_line(msgspec.Raw(raw))

    def _add_line(self, line: msgspec.Raw) -> None:
        self._lines.append(line)
        if len(self._lines) >= BATCH_FRAMES:
            self.flush()

    def add_tick(self, microseconds: float) -> None:
        """Note the wall time of a tick."""
        self._tick_us.append(microseconds)

    def take_estimates(self) -> tuple[str, Message] | None:
        """Topic and message of the pending estimates, which are then cleared; ``None`` without any."""
        return None

    def display_state(self) -> DisplayState | None:
        """The newest values for a display; ``None`` before the first frame."""
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
        """Publish the mission's status, and the display state if it is subscribed."""
        self._publisher.send("mission", message)
        if self._publisher.has_subscriber("display_state") and (state := self.display_state()) is not None:
            self._publisher.send("display_state", state)

    def notify_operator(self, level: str, text: str) -> None:
        """One line for the log file and for the operator's terminal."""
        self.log.log(LEVELS[level], OPERATOR_MESSAGE, text=text, seq=self.seq, t_s=self.t_s)
        self._publisher.send("log", LogMessage(seq=self.seq, t_s=self.t_s, level=level, process="main", text=text))


class SurveyTelemetry(TelemetryPublisher):
    """Publishes for a survey."""

    def __init__(self, publisher: Publisher, log: structlog.typing.FilteringBoundLogger) -> None:
        super().__init__(publisher, log)
        self._localizer: Localizer | None = None
        self._track: list[tuple[int, float, int, int, float, float, float, float]] = []

    def publish_frame(
        self,
        seq: int,
        t_s: float,
        localizer: Localizer,
        state: str,
        raw: bytes,
        commands: tuple[tuple[float, float, float, float] | None, int] = (None, -1),
        *,
        is_first: bool = False,
    ) -> None:
        """Keep the estimate after frame ``seq`` and the frame's line for the batch; publish the estimate where due.

        Args:
            commands: span of the set points since the last estimate, rad/s, and the number of the newest drive.
            is_first: of a session; it is always due, because the danger loop may wait for it.
        """
        self.seq, self.t_s = seq, t_s
        self._localizer, self._newest_line = localizer, msgspec.Raw(raw)
        pose, sigma_m = localizer.pose, localizer.position_sigma_m
        if is_first or is_estimate_due(seq):
            deck = localizer.deck_pose
            estimate = EstimateMessage(
                seq=seq,
                t_s=t_s,
                x_m=deck.x_m,
                y_m=deck.y_m,
                heading_rad=deck.heading_rad,
                sigma_m=sigma_m,
                state=state,
                commanded=commands[0],
                drive_seq=commands[1],
            )
            self._publisher.send("estimate", estimate)
        number = seq + self._frames_before
        self._track.append((number, t_s, *pose.panel, pose.x_m, pose.y_m, pose.heading_rad, sigma_m))
        self._add_line(self._newest_line)

    def take_estimates(self) -> tuple[str, Message] | None:
        """See ``TelemetryPublisher``."""
        rows, self._track = self._track, []
        return ("track", TrackMessage(seq=self.seq, t_s=self.t_s, rows=rows)) if rows else None

    def display_state(self) -> DisplayState | None:
        """See ``TelemetryPublisher``; pose on the deck, and the filter's last update."""
        if self._localizer is None:
            return None
        localizer = self._localizer
        pose, covariance, innovation = localizer.deck_pose, localizer.pose_covariance, localizer.innovation
        return DisplayState(
            seq=self.seq,
            t_s=self.t_s,
            x_m=pose.x_m,
            y_m=pose.y_m,
            heading_rad=pose.heading_rad,
            covariance_m2=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
            heading_sigma_rad=localizer.heading_sigma_rad,
            nis=innovation.nis if innovation is not None else 0.0,
            size=innovation.size if innovation is not None else 0,
            line=self._newest_line,
        )

    def publish_arrival(self, seq: int, t_s: float, point: PointId, error_m: float) -> None:
        """The robot came to rest in frame ``seq``, at a point for the first time."""
        number = seq + self._frames_before
        self._publisher.send("arrival", ArrivalMessage(seq=number, t_s=t_s, point=(*point,), error_mm=1e3 * error_m))

    def publish_rest(self, seq: int, t_s: float) -> None:
        """The mission takes the robot to be at rest from frame ``seq`` on."""
        self._publisher.send("rest", Rest(seq=seq, t_s=t_s))

    def publish_treatment(self, seq: int, t_s: float, kind: TreatmentKind, values: tuple[float, ...] = ()) -> None:
        """The localizer is treated in frame ``seq``; see ``Treatment``."""
        self._publisher.send("treatment", Treatment(seq=seq, t_s=t_s, kind=kind, values=values))

    def publish_fix(
        self, point: PointId | None, fix: Fix, jump_m: float, *, is_fused: bool, is_set_aside: bool = False
    ) -> None:
        """A fix was measured after the last frame; without a point it only localizes the robot.

        One that ``is_set_aside`` was not given to the localizer.
        """
        message = FixMessage(
            seq=self.seq,
            point=None if point is None else (*point,),
            is_fused=is_fused,
            jump_mm=1e3 * jump_m,
            is_set_aside=is_set_aside,
            **asdict(fix),
        )
        self._publisher.send("fix", message)
