"""Serves one sensors frame after the other: estimate, verdict, plan, drive; with the gate's log and the fans."""

import asyncio
import time
from collections.abc import Callable
from math import inf

from ccatp.config.models import LinkConfig
from ccatp.control.gate import Denial, DriveGate, FanGate
from ccatp.core import Verdict
from ccatp.daemon.mission_runner import STILL, DriveCommand, MissionClock, MissionRunner, TimedFrame
from ccatp.daemon.robot_session import ControllerSession, LatenessStatistics
from ccatp.daemon.subscribers import HeartbeatPublisher, VerdictSubscriber
from ccatp.daemon.telemetry import TelemetryPublisher
from ccatp.errors import CcatpError, ExitStatus
from ccatp.links.robot_messages import Sensors
from ccatp.survey.mission import Mission

# Of a robot that moved nobody knows where it is when the samples of more frames than this are missing.
UNSEEN_S = 0.1
# The frames that come while a way is planned for a robot that stands are late for a reason, and served within this.
CATCH_UP_S = 0.5


class UnhandledError(CcatpError):
    """An error that nobody foresaw; the log has it all. The process is restarted."""

    exit_status = ExitStatus.HELD


class FrameService:
    """Serves the frames of the robot with the decisions of a mission.

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
        *,
        on_error: Callable[[Exception], None],
    ) -> None:
        """No frame yet."""
        self._cfg, self._runner, self._session, self._clock = cfg, runner, session, clock
        self._verdicts, self._heartbeat = verdicts, heartbeat
        self._telemetry, self._on_error = runner.telemetry, on_error
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
        """The session is gone; held by the robot itself."""
        # What it did since the last frame shows in the next one, if that comes soon.
        self._was_at_rest = self._runner.is_at_rest
        self._heartbeat.phase, self._unanswered = "rejoining", None

    def on_sensors(self, sensors: Sensors, raw: bytes) -> None:
        """Serve one sensors frame. A surprise ends the process, held, and not just the connection."""
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
        session, runner = self._session, self._runner
        steady_s, dt_s = self._clock.time_of(sensors.seq, sensors.t, session.frame_period_s)
        frame = TimedFrame(sensors, raw, steady_s, dt_s, session.is_new_session)
        is_unjudged = session.may_lack_verdict
        if frame.is_first:
            self._begin_drives(dt_s)
        self._clock.advance(sensors.seq, steady_s)
        self._heartbeat.frame_s = time.monotonic()
        runner.estimate(frame)
        if dt_s <= 0.0:  # counted by the localizer; a controller cannot go back in time
            self._telemetry.stale_frame(sensors.seq, raw)
            self._answer(sensors.seq, STILL)
            return
        waiting = time.perf_counter()
        verdict = None if is_unjudged else self._latest_verdict(sensors.seq)
        decided = time.perf_counter()
        drive = self._decide(frame, verdict)
        self._answer(sensors.seq, drive)
        runner.publish(frame)
        self._telemetry.add_tick(1e6 * (time.perf_counter() - decided + waiting - start))

    def _latest_verdict(self, seq: int) -> Verdict | None:
        return self._verdicts.latest(seq, self._session.frame_period_s, is_lockstep=self._session.is_lockstep)

    def _begin_drives(self, dt_s: float) -> None:
        """Before the first drive and not on joining, so that in lockstep the robot is told in a certain frame."""
        self._session.is_new_session = False
        self._runner.begin_drives()
        if self._clock.has_begun and dt_s > UNSEEN_S and not self._was_at_rest:
            self._telemetry.notify_operator(
                "warning", f"the robot moved and sent no frame for {dt_s:.2f} s: relocalizing"
            )
            self._runner.on_tracking_gap()

    def _decide(self, frame: TimedFrame, verdict: Verdict | None) -> DriveCommand:
        """The drive that answers a frame. One that is too late moves nothing."""
        runner, limit_s, begun_s = self._runner, self._cfg.lag_limit_s, time.monotonic()
        lag_s = 0.0 if self._session.is_lockstep else self.lateness.add(frame.sensors.t, begun_s)
        if lag_s > limit_s:
            if begun_s < self._catches_up_until_s:
                return runner.hold(frame)
            verdict = None
            # Paused until frames are prompt again.
            if runner.interrupt(f"a frame was served {1e3 * lag_s:.0f} ms late"):
                self._telemetry.log.warning(
                    "frame_late", seq=self._clock.seq, lateness_ms=1e3 * lag_s, limit_ms=1e3 * limit_s
                )
        drive = runner.plan(frame, verdict, lag_s)
        now_s = time.monotonic()
        is_slow, is_still = now_s - begun_s > self._session.frame_period_s, drive == STILL
        # A hold for what planning cost would have to be planned away again, and so on for ever on a slow machine.
        self._catches_up_until_s = now_s + CATCH_UP_S if is_slow and is_still else -inf
        return drive

    # -- answers --------------------------------------------------------------------------------------------------

    def _may_answer(self) -> bool:
        """In lockstep simulated time stands still while a peer is waited for, and all but still in a pause."""
        if not self._session.is_lockstep:
            return True
        return not self._runner.is_busy and not (self._runner.is_paused and self._runner.is_at_rest)

    def _answer(self, seq: int, drive: DriveCommand) -> None:
        if self._may_answer():
            self._session.send_drive(seq, *drive)
        else:
            self._unanswered = seq

    def answer_if_allowed(self) -> None:
        """Answer the frame that waits, if nothing stands against it any more."""
        if self._may_answer():
            self.answer_held_frame()

    def answer_held_frame(self) -> None:
        """Answer the frame that waits, standing."""
        seq, self._unanswered = self._unanswered, None
        if seq is not None:
            self._session.send_drive(seq, *STILL)


REPEAT_S = 1.0

Notify = Callable[[str, str], None]


class GateLog:
    """Looks at the gate after each frame."""

    def __init__(self, gate: DriveGate, notify: Notify) -> None:
        self._gate, self._notify = gate, notify
        self._logged_s: dict[Denial, float] = {}

    def update(self, t_s: float) -> None:
        """Tell of a drive denied in the frame of robot time ``t_s``."""
        denial = self._gate.denial
        if denial is None:
            return
        logged_s = self._logged_s.get(denial)
        # A clock that went back must not silence it.
        if logged_s is not None and 0.0 <= t_s - logged_s < REPEAT_S:
            return
        self._logged_s[denial] = t_s
        self._notify("warning", f"drive denied: {denial} ({self._gate.denied[denial]} so far)")

    @property
    def counts(self) -> dict[str, int]:
        """How often each reason stood in the way, those that never did left out."""
        return {denial.name.lower(): count for denial, count in self._gate.denied.items() if count}


FULL_FANS = (1.0, 1.0)


class FanController:
    """Sends fan duties through the fans' gate.

    Args:
        has_floor: the mirror overhangs, and the robot's own floor counts.
    """

    def __init__(
        self,
        duty: tuple[float, float],
        session: ControllerSession,
        mission: Mission,
        telemetry: TelemetryPublisher,
        *,
        has_floor: bool,
    ) -> None:
        self._duty, self._session, self._mission, self._telemetry = duty, session, mission, telemetry
        self._has_floor, self._is_full = has_floor, False
        self._gate = FanGate(0.0)

    @property
    def refused(self) -> int:
        """How often duties were refused in this session."""
        return self._gate.refused

    def begin(self, floor: float) -> None:
        """A session begins with a robot that has this floor."""
        self._gate = FanGate(floor if self._has_floor else 0.0)

    def set_full(self) -> None:
        """All that they can from now on; said once."""
        if not self._is_full:
            self._is_full = True
            self.send()

    def send(self) -> None:
        """Send what is in force."""
        duty = FULL_FANS if self._is_full else self._duty
        refusal = self._gate.refusal(*duty)
        if refusal is None:
            self._session.send_fans(duty)
        else:
            self._telemetry.notify_operator("error", refusal)
            self._mission.fault(refusal)
