"""Frames of a mission in the main loop: the clock of the frames, the base class of missions, and the frame service.

The process keeps links, clock, order and end; the mission keeps everything that depends on its kind. A new kind of
mission is a subclass of ``MissionRunner`` and a row in ``main_loop.open_runner``.
"""

# ruff: noqa: B027 - empty methods are for missions without such a peer, file or command

import asyncio
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import NamedTuple, Protocol

import structlog

from ccatp.config.models import LinkConfig
from ccatp.core import Verdict
from ccatp.daemon.robot_session import ControllerSession, LatenessStatistics
from ccatp.daemon.subscribers import HeartbeatPublisher, VerdictSubscriber
from ccatp.daemon.telemetry import TelemetryPublisher
from ccatp.errors import CcatpError, ExitStatus
from ccatp.links.bus import Publisher
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.topics import MissionStatus
from ccatp.safety.robot_clock import SteadyTime
from ccatp.survey.state import SurveyOutcome

# The place of a robot that moved is not known when the samples of more frames than this are missing.
UNSEEN_S = 0.1
# The frames that come while a path is planned for a robot that stands are late for a reason, and served within this.
CATCH_UP_S = 0.5
EXIT_STATUS = {
    SurveyOutcome.COMPLETE: ExitStatus.COMPLETE,
    SurveyOutcome.AT_BASE: ExitStatus.ABORTED,
    SurveyOutcome.STOPPED: ExitStatus.HELD,
    SurveyOutcome.NONE: ExitStatus.INTERRUPTED,
}


class MissionClock:
    """Numbers and times of the frames.

    Args:
        jump_s: the robot's clock has jumped if a frame is further off.

    Attributes:
        seq: the newest frame.
        t_s: its time, without jumps.
    """

    def __init__(self, jump_s: float) -> None:
        self._jump_s, self._before_s = jump_s, 0.0
        self._steady = SteadyTime(jump_s)
        self._first_s: float | None = None
        self.seq, self.t_s = -1, 0.0

    @property
    def has_begun(self) -> bool:
        """A frame was served, in this boot of the robot."""
        return self._first_s is not None

    @property
    def elapsed_s(self) -> float:
        """Robot time of the mission, s."""
        return self._before_s + (0.0 if self._first_s is None else self.t_s - self._first_s)

    @property
    def offset_s(self) -> float:
        """``t_s`` less the robot's time."""
        return self._steady.offset_s

    def resume_at(self, elapsed_s: float) -> None:
        """Set the time of the mission before the first frame that is served here."""
        self._before_s = elapsed_s

    def time_of(self, seq: int, t_s: float, period_s: float) -> tuple[float, float]:
        """Time of a frame and time since the last one (``period_s`` without one), s; ``advance`` takes them over."""
        # Durations are counted by a time that does not jump; everything else by the robot's own.
        steady_s = self._steady.at(seq, t_s) if seq > self.seq else self.t_s
        return steady_s, steady_s - self.t_s if self._first_s is not None else period_s

    def advance(self, seq: int, steady_s: float) -> None:
        """The frame is served now."""
        if self._first_s is None:
            self._first_s = steady_s
        self.t_s, self.seq = steady_s, max(seq, self.seq)

    def reset(self) -> None:
        """The robot's frames and clock restarted."""
        self._before_s, self._first_s, self.seq = self.elapsed_s, None, -1
        self._steady = SteadyTime(self._jump_s)


class RunnerConfig(NamedTuple):
    """Configuration that the process itself needs.

    Attributes:
        realtime_priority: of the process; 0 = ordinary scheduling.
        clock_jump_s: the robot's clock has jumped if a frame is further off.
    """

    link: LinkConfig
    realtime_priority: int
    verdict_timeout_s: float
    clock_jump_s: float
    frame_hz: float


class TimedFrame(NamedTuple):
    """A frame as it is served.

    Attributes:
        t_s: its time, without jumps; that of the robot stands in ``sensors``.
        dt_s: since the frame before; not positive where the robot's clock or frames went back.
    """

    sensors: Sensors
    raw: bytes
    t_s: float
    dt_s: float
    is_first: bool


class DriveCommand(NamedTuple):
    """Set points of the wheels, rad/s, and of the steering, rad, where the robot has one."""

    right_rad_s: float
    left_rad_s: float
    steer_rad: float | None = None


STILL = DriveCommand(0.0, 0.0)


@dataclass(frozen=True, slots=True)
class RunnerContext:
    """Parts of the process for its mission.

    Attributes:
        finish: ends the process with a status, once the last messages are out.
        answer: something changed between two frames: lockstep time may go on.
    """

    run_dir: Path
    publisher: Publisher
    log: structlog.typing.FilteringBoundLogger
    session: ControllerSession
    clock: MissionClock
    is_patient: bool
    finish: Callable[[ExitStatus], None]
    answer: Callable[[], None]


class OperableMission(Protocol):
    """Part of a mission that the process uses; each command returns why it was refused, or ``None``."""

    @property
    def cause(self) -> str:
        """Why it is held."""

    @property
    def is_paused(self) -> bool:
        """Held until an operator resumes: in lockstep time all but stands still."""

    def pause(self, cause: str) -> str | None:
        """Hold until ``resume``."""

    def resume(self) -> str | None:
        """Go on after a hold."""

    def abort(self, cause: str) -> str | None:
        """Return to base and end there."""

    def stop(self) -> str | None:
        """Hold the wheels and end here."""

    def interrupt(self, cause: str) -> bool:
        """Hold until frames and verdicts are fresh again; returns whether it was not held before."""


class MissionRunner(ABC):
    """A mission in the main-loop process."""

    def __init__(self, mission: OperableMission, telemetry: TelemetryPublisher) -> None:
        self.mission, self.telemetry = mission, telemetry

    @property
    def is_busy(self) -> bool:
        """Waits for a peer: in lockstep time stands still."""
        return False

    @property
    @abstractmethod
    def is_at_rest(self) -> bool:
        """The robot is at rest."""

    @abstractmethod
    def status(self) -> MissionStatus:
        """Progress of the mission; the process adds times, verdict code, lateness and exit status."""

    async def connect(self) -> None:
        """Connect to peers other than the robot; raises ``UnreachableError`` where one does not answer."""

    async def run(self) -> None:
        """Work beside the frames, until cancelled."""
        await asyncio.Event().wait()

    async def close(self) -> None:
        """Close the resources of ``connect`` and ``run``."""

    @abstractmethod
    def check_robot(self, hello: Hello) -> None:
        """Raise ``ConfigError`` for a robot whose own geometry contradicts the configuration."""

    def begin_session(self, hello: Hello) -> None:
        """A session begins; its first frame comes next."""

    def begin_drives(self) -> None:
        """The first frame of a session is here, and is answered next: send commands that are due once."""

    @abstractmethod
    def on_tracking_gap(self) -> None:
        """The robot booted, or moved without frames."""

    def save_checkpoint(self) -> None:
        """Save the state for a main loop that takes over."""

    @abstractmethod
    def publish_state(self) -> None:
        """Publish a new state, and end where that is the end."""

    @abstractmethod
    def log_statistics(self) -> None:
        """The process ends: log statistics."""

    # -- the frame, in this order -----------------------------------------------------------------------------------

    @abstractmethod
    def estimate(self, frame: TimedFrame) -> None:
        """Process the samples; the danger loop judges the same frame meanwhile."""

    @abstractmethod
    def plan(self, frame: TimedFrame, verdict: Verdict | None, lag_s: float) -> DriveCommand:
        """The drive that answers the frame, which is served ``lag_s`` late; no verdict where none is in force."""

    @abstractmethod
    def hold(self, frame: TimedFrame) -> DriveCommand:
        """In place of ``plan``: the robot stands, and nothing is decided in this frame."""

    @abstractmethod
    def publish(self, frame: TimedFrame) -> None:
        """The drive is sent: publish the estimate, keep records."""


RunnerFactory = Callable[[RunnerContext], MissionRunner]


class UnhandledError(CcatpError):
    """An unexpected error, with details in the log. The process is restarted."""

    exit_status = ExitStatus.HELD


class FrameService:
    """Serves one sensors frame after the other: estimate, verdict, plan, drive.

    Attributes:
        over: set when the mission is over, and no frame is served any more.
    """

    def __init__(
        self,
        cfg: LinkConfig,
        runner: MissionRunner,
        session: ControllerSession,
        clock: MissionClock,
        verdicts: VerdictSubscriber,
        heartbeat: HeartbeatPublisher,
        on_error: Callable[[Exception], None],
    ) -> None:
        self._lag_limit_s, self._runner, self._session, self._clock = cfg.lag_limit_s, runner, session, clock
        self._verdicts, self._heartbeat, self._on_error = verdicts, heartbeat, on_error
        self._telemetry = runner.telemetry
        self.lateness = LatenessStatistics(cfg.slip_after_s)
        self.over = asyncio.Event()
        self._catches_up_until_s = -inf
        self._was_at_rest = False
        self._unanswered: int | None = None

    def begin_session(self) -> None:
        """A session begins; its first frame comes next."""
        self.lateness.reset()
        self._heartbeat.phase, self._heartbeat.frame_s = "joined", time.monotonic()

    def end_session(self) -> None:
        """The session is lost; the robot holds itself."""
        # Its motion since the last frame shows in the next one, if that comes soon.
        self._was_at_rest = self._runner.is_at_rest
        self._heartbeat.phase, self._unanswered = "rejoining", None

    def on_sensors(self, sensors: Sensors, raw: bytes) -> None:
        """Serve one sensors frame. An unexpected error ends the process, held, and not just the connection."""
        if self.over.is_set():
            return
        try:
            self._serve(sensors, raw)
        except Exception as error:
            self._telemetry.log.exception("unhandled_exception", seq=self._clock.seq)
            self._telemetry.notify_operator(
                "error", f"internal error, wheels held: {type(error).__name__}: {error}; see log.jsonl"
            )
            self._on_error(UnhandledError(f"internal error: {type(error).__name__}: {error}"))

    def _serve(self, sensors: Sensors, raw: bytes) -> None:
        start = time.perf_counter()
        session, runner, seq = self._session, self._runner, sensors.seq
        period_s = session.frame_period_s
        steady_s, dt_s = self._clock.time_of(seq, sensors.t, period_s)
        frame = TimedFrame(sensors, raw, steady_s, dt_s, session.is_new_session)
        is_unjudged = session.may_lack_verdict
        if frame.is_first:
            self._begin_drives(dt_s)
        self._clock.advance(seq, steady_s)
        self._heartbeat.frame_s = time.monotonic()
        runner.estimate(frame)
        if dt_s <= 0.0:  # counted by the localizer; a controller cannot go back in time
            self._telemetry.stale_frame(seq, raw)
            self._answer(seq, STILL)
            return
        waiting = time.perf_counter()
        verdict = None if is_unjudged else self._verdicts.latest(seq, period_s, is_lockstep=session.is_lockstep)
        decided = time.perf_counter()
        self._answer(seq, self._decide(frame, verdict))
        runner.publish(frame)
        self._telemetry.add_tick(1e6 * (time.perf_counter() - decided + waiting - start))

    def _begin_drives(self, dt_s: float) -> None:
        """Before the first drive and not on joining, so that in lockstep the robot gets it in a certain frame."""
        self._session.is_new_session = False
        self._runner.begin_drives()
        if self._clock.has_begun and dt_s > UNSEEN_S and not self._was_at_rest:
            self._telemetry.notify_operator(
                "warning", f"the robot moved and sent no frame for {dt_s:.2f} s: relocalizing"
            )
            self._runner.on_tracking_gap()

    def _decide(self, frame: TimedFrame, verdict: Verdict | None) -> DriveCommand:
        """The drive that answers a frame. One that is too late moves nothing."""
        runner, limit_s, begun_s = self._runner, self._lag_limit_s, time.monotonic()
        lag_s = 0.0 if self._session.is_lockstep else self.lateness.add(frame.sensors.t, begun_s)
        if lag_s > limit_s:
            if begun_s < self._catches_up_until_s:
                return runner.hold(frame)
            verdict = None
            # Paused until frames are prompt again.
            if runner.mission.interrupt(f"a frame was served {1e3 * lag_s:.0f} ms late"):
                self._telemetry.log.warning(
                    "frame_late", seq=self._clock.seq, lateness_ms=1e3 * lag_s, limit_ms=1e3 * limit_s
                )
        drive = runner.plan(frame, verdict, lag_s)
        now_s = time.monotonic()
        is_slow, is_still = now_s - begun_s > self._session.frame_period_s, drive == STILL
        # A hold for the cost of planning would have to be planned away again, and so on for ever on a slow machine.
        self._catches_up_until_s = now_s + CATCH_UP_S if is_slow and is_still else -inf
        return drive

    def _may_answer(self) -> bool:
        """In lockstep simulated time stands still while a peer is awaited, and all but still in a pause."""
        if not self._session.is_lockstep:
            return True
        runner = self._runner
        return not runner.is_busy and not (runner.mission.is_paused and runner.is_at_rest)

    def _answer(self, seq: int, drive: DriveCommand) -> None:
        if self._may_answer():
            self._session.send_drive(seq, *drive)
        else:
            self._unanswered = seq

    def answer_if_allowed(self) -> None:
        """Answer the frame that waits, if nothing holds the answer back any more."""
        if self._may_answer():
            self.answer_held_frame()

    def answer_held_frame(self) -> None:
        """Answer the frame that waits, standing."""
        seq, self._unanswered = self._unanswered, None
        if seq is not None:
            self._session.send_drive(seq, *STILL)
