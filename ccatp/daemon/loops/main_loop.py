"""The main-loop process: serves a mission's frames between robot link, bus and operator channel."""

import asyncio
import time
from collections.abc import Callable, Coroutine
from contextlib import AbstractContextManager
from math import inf
from typing import Any

import zmq
from msgspec.structs import replace

from ccatp.clocks import MissionClock
from ccatp.conditions import (
    FRAME_LATE,
    FRAMES_OLD,
    LINK_LOST,
    NO_FRAME_FOR,
    OPERATOR,
    Condition,
    Owner,
    find_condition,
    text_of,
)
from ccatp.core import Severity, Verdict
from ccatp.daemon.loops.mission_runner import STILL, DriveCommand, LoopLimits, MissionRunner, TimedFrame
from ccatp.daemon.loops.robot_loop import WAIT_PERIOD_S, RobotLoop
from ccatp.daemon.loops.robot_session import FrameAge
from ccatp.daemon.operator.alarms import ActiveCause, AlarmList, active_cause
from ccatp.daemon.supervision.process import ProcessArgs, run_process, start_process
from ccatp.errors import CcatpError, ConfigError, ExitStatus
from ccatp.links.bus import BATCH_WALL_S, Subscriber, VerdictSubscriber
from ccatp.links.channels import (
    BadRequest,
    OperatorCommand,
    OperatorRequest,
    format_error,
    format_ok,
    parse_operator,
)
from ccatp.links.frame_answers import DriveRule
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.rpc import Router
from ccatp.links.topics import ESTIMATE_FRAMES, DangerEvent, MissionStatus
from ccatp.missions import kind_of
from ccatp.safety.escalation import Since
from ccatp.survey.events import HELD, Abort, Fault, Interrupted, Pause, Resume, StopHere, waits_for
from ccatp.survey.state import HoldState

# The supervisor ends this process after it has received the last messages; a longer wait is reported.
SHUTDOWN_REPORT_S = 30.0
# Without an open page, one display state in so many levels is published, for recordings.
SAMPLED_LEVELS = 10
# Without samples for longer than this, the place of a moving robot is not known.
UNSEEN_S = 0.1
# Frames that arrive while a path is planned for a standing robot are late; they are served within this time.
CATCH_UP_S = 0.5
# A robot at 0.1 m/s is at rest within half a second; a command without effect after this time has failed.
EFFECT_TIMEOUT_S = 5.0


# A robot that stands for longer is reported, with reason and advice, and again after each minute.
STANDS_REPORT_S, STANDS_REPEAT_S = 30.0, 60.0


COMMANDS: dict[OperatorCommand, Pause | Resume | Abort | StopHere] = {
    OperatorCommand.PAUSE: Pause(OPERATOR.because()),
    OperatorCommand.RESUME: Resume(),
    OperatorCommand.ABORT: Abort(OPERATOR.because()),
    OperatorCommand.STOP: StopHere(),
}


class StandstillReport:
    """Decides when to report a standing robot: after ``STANDS_REPORT_S``, and after each ``STANDS_REPEAT_S``."""

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._due_s = inf

    def lasts_s(self, now_s: float, *, stands: bool) -> float | None:
        """Duration of the standstill if a report is due, else ``None``."""
        if not stands:
            self._since_s = None
            return None
        if self._since_s is None:
            self._since_s, self._due_s = now_s, now_s + STANDS_REPORT_S
        if now_s < self._due_s:
            return None
        self._due_s = now_s + STANDS_REPEAT_S
        return now_s - self._since_s


class UnhandledError(CcatpError):
    """An unexpected error, with details in the log. The process is restarted."""

    exit_status = ExitStatus.HELD


class MainLoop(RobotLoop):
    """The main loop of a mission: frames, clock, commands, start and end.

    ``frame_period_s``: of the present session.
    """

    def __init__(
        self,
        args: ProcessArgs,
        context: zmq.Context[zmq.Socket[bytes]],
        make_runner: Callable[["MainLoop"], MissionRunner],
    ) -> None:
        super().__init__("main", "controller", args, context)
        cfg = args.config
        danger, timeout_s = args.endpoints.of("danger"), cfg.mission.verdict_timeout_s
        self.peer = self._verdicts = VerdictSubscriber(context, danger, timeout_s, self.heartbeat.publish_if_due)
        self._limits: LoopLimits = kind_of(cfg).limits.get()(cfg)
        self.clock = MissionClock(self._limits.clock_jump_s)
        self.frame_period_s = 0.0
        self._is_new_session, self._drives = False, DriveRule()
        self._is_restarted = args.is_restarted
        self._catches_up_until_s = -inf
        self._was_at_rest = False
        self._levels_sent = 0
        self._unanswered: int | None = None
        self._failure: Exception | None = None
        self._standstill, self._frame_age = StandstillReport(), FrameAge()
        self._paused, self._has_gap = Since(), False
        self.exit_status = ExitStatus.INTERRUPTED
        self.alarms = AlarmList(args.run_dir, self.log)
        # Separate from the verdicts, which are read with the frames, because findings are reported without frames, too.
        self._danger_events = Subscriber(context, [danger], ["danger_event"], is_uncounted=True)
        self._danger_active: list[ActiveCause] = []
        self._runner = make_runner(self)
        self._telemetry = self._runner.telemetry

    def services(self) -> tuple[Coroutine[Any, Any, None], ...]:
        return self._serve_operator(), self.publish_heartbeat(), self._runner.run(), self.serve(), self.watch()

    # -- start and end --------------------------------------------------------------------------------------------

    async def connect(self) -> None:
        await self._runner.connect()
        self.heartbeat.phase = "ready"

    def is_peer_ready(self) -> bool:
        has_subscriber = self.publisher.has_subscriber
        return has_subscriber("track") and has_subscriber("estimate") and self._verdicts.is_danger_joined()

    def on_joined(self, hello: Hello) -> None:
        try:
            self._runner.check_robot(hello)
        except ConfigError as error:
            if self.sessions == 1 and not self._is_restarted:
                self._fail(error)
            else:  # in the middle of a mission: the run has begun, and its robot may be anywhere
                where = f"{self.robot_cfg.host}:{self.robot_cfg.port}"
                what = f"another robot answers at {where} in the middle of the mission: {error}"
                self._telemetry.notify_operator("error", f"{what}; connect the right one, then 'ccatp run --resume'")
                self.finish(ExitStatus.HELD)
            return
        self.frame_period_s, self._is_new_session = 1.0 / hello.frame_hz, True
        self._drives.begin_session()
        self._runner.begin_session(hello)
        self.begin_session()
        again = " again" if self.sessions > 1 else ""
        robot = self.robot_cfg
        self._telemetry.notify_operator("info", f"joined the robot at {robot.host}:{robot.port}{again}")

    def on_restarted(self) -> None:
        self._telemetry.notify_operator("warning", "the robot restarted: relocalizing before it moves")
        self._verdicts.reset()
        self._telemetry.continue_numbering()
        self.clock.reset()
        self._runner.on_tracking_gap()

    def on_lost(self, reason: str) -> None:
        if self.over.is_set():
            return
        # If the next frame arrives soon, its samples show the motion since the last one.
        self._was_at_rest = self._runner.is_at_rest
        self.heartbeat.phase, self._unanswered = "rejoining", None
        cause = LINK_LOST.because(reason=reason)
        self._runner.mission.handle(Interrupted(cause))
        self._telemetry.notify_operator("warning", f"{text_of(cause)}; reconnecting")

    def _fail(self, error: Exception) -> None:
        """End this process with wheels held; the supervisor restarts it."""
        self._failure = self._failure or error
        self.over.set()

    def finish(self, status: ExitStatus) -> None:
        """End the process with a status, after the last messages are sent."""
        self.exit_status = status
        self.heartbeat.phase = "done"
        self.over.set()

    async def end(self, stop: asyncio.Event) -> None:
        if not self.is_lockstep:  # in lockstep the last frame has been answered; a second answer would be a race
            self.send_drive(self.clock.seq, STILL)
        self._runner.log_statistics()
        self._save_checkpoint()
        self._telemetry.flush()
        self._publish_status()
        if self._failure is not None:
            raise self._failure
        if stop.is_set():
            return
        # Repeat the end until the supervisor has received it and stops this process. If the process ended by itself,
        # the supervisor would restart it.
        self.heartbeat.phase = "done"
        while not stop.is_set():
            try:
                async with asyncio.timeout(SHUTDOWN_REPORT_S):
                    await stop.wait()
            except TimeoutError:
                self.log.warning("shutdown_not_acknowledged")

    async def close(self) -> None:
        self._danger_events.close()
        await self._runner.close()

    def _save_checkpoint(self) -> None:
        if self.clock.has_begun:  # before the first frame, the checkpoint of the earlier process is better
            self._runner.save_checkpoint()

    # -- beside the frames ----------------------------------------------------------------------------------------

    def publish_levels(self) -> None:
        self._telemetry.flush(BATCH_WALL_S)
        self.update_alarms()
        if self.heartbeat.phase != "starting":
            self._publish_status()
        if self._runner.mission.state.is_paused and not self._runner.is_busy:
            self._answer_held_frame()  # answer a frame from time to time, so that an emergency acts in a pause, too
        stands = self.heartbeat.phase != "done" and self._runner.is_at_rest
        now_s = time.monotonic()
        self._escalate_pause(now_s)
        lasts_s = self._standstill.lasts_s(now_s, stands=stands)
        if lasts_s is not None:
            self._telemetry.notify_operator("warning", f"the robot stands for {lasts_s:.0f} s: {self._why_it_stands()}")

    def update_alarms(self) -> None:
        """Raise and end alarms: findings of danger, and causes why the mission is held, goes home or waits."""
        own = [active_cause(cause) for cause in self._runner.causes]
        while (received := self._danger_events.receive()) is not None:
            event = received[2]
            if isinstance(event, DangerEvent):
                self._danger_active = [ActiveCause(name, cause, Severity(grave)) for name, cause, grave in event.active]
                self.alarms.update([*own, *self._danger_active], event.t_s)
        self.alarms.update([*own, *self._danger_active], self.clock.t_s)

    def _escalate_pause(self, now_s: float) -> None:
        """After its first limit a pause needs a fix before the robot moves; after its second one it is a fault."""
        mission = self._runner.mission
        state = mission.state
        row = self._own_pause_of(state)
        waits = row is not None and row.escalates_to is not None and not state.is_held_by_hand
        lasts_s = self._paused.lasts(now_s, waits and not self.is_lockstep)
        hold_s, fault_s = self._limits.pause_s, self._limits.hold_s
        self._has_gap = self._has_gap and lasts_s >= 0.0
        if lasts_s >= hold_s and not self._has_gap:
            self._has_gap = True
            self._runner.on_tracking_gap()
        if lasts_s >= fault_s:
            cause = replace(state.cause, lasted_s=fault_s)
            mission.handle(Fault(cause))
            self._telemetry.notify_operator("error", text_of(cause))

    def _own_pause_of(self, state: HoldState) -> Condition | None:
        """The row of a hold whose cause only this loop finds, so that it measures its duration itself."""
        row = find_condition(state.cause.condition) if state.mode is HELD else None
        return row if row is not None and row.owner is Owner.MAIN else None

    def _why_it_stands(self) -> str:
        """The reason for a standstill, with advice."""
        phase, state, age_s = self.heartbeat.phase, self._runner.mission.state, self.heartbeat.frame_age_s
        robot = f"the robot at {self.robot_cfg.host}:{self.robot_cfg.port}"
        if phase == "starting":
            return "waiting for the laser system; is its server running?"
        if phase == "ready":
            return f"waiting for the danger loop and {robot}; is it on, the network up?"
        if phase == "rejoining":
            return f"the link to {robot} is lost; is it on, the network up?"
        if self._unanswered is None and (age_s is None or age_s > STANDS_REPORT_S):
            return f"{robot} sends no frames; is it on, the network up?"
        if self._runner.is_busy:
            why = self._runner.status().cause or "is it ready, the line of sight free?"
            return f"waiting for a measurement of the laser system; {why}"
        # A mission that has not begun has no cause of its own while it waits for a finding of danger to end.
        row, why, alarms = find_condition(state.cause.condition), text_of(state.cause), self.alarms.alarms
        advice = row.advice if row is not None else ""
        if not why and alarms and not alarms[0].ended:
            why, advice = alarms[0].cause, alarms[0].advice
        if not why:
            return f"{state.mode}, and nothing is wrong: {waits_for(state.mode)}"
        otherwise = "'ccatp resume' continues" if state.is_paused else "continues by itself"
        return f"{state.mode}: {why}; {advice or otherwise}"

    def is_frame_due(self) -> bool:
        return self._unanswered is None

    def report_overdue(self, text: str) -> None:
        self._telemetry.notify_operator("warning", text)

    def report_bad_line(self, text: str) -> None:
        self._telemetry.notify_operator("warning", text)

    def on_silence(self, age_s: float) -> None:
        if age_s <= self.robot_cfg.sensors_timeout_s:
            return
        if self._interrupt(NO_FRAME_FOR, age_s=age_s):
            self._telemetry.notify_operator("warning", text_of(self._runner.mission.state.cause))
            self.send_drive(self.clock.seq, STILL)

    def _interrupt(self, row: Condition, **values: float) -> bool:
        """Hold the mission until frames are fresh; returns whether this changed its state or its cause."""
        mission, cause = self._runner.mission, row.because(**values)
        before = mission.state
        mission.handle(Interrupted(cause))
        if self._own_pause_of(before) not in (None, row):
            mission.state = replace(before, cause=cause)
        return mission.state is not before

    def _publish_status(self) -> None:
        self._telemetry.send("mission", self.status())
        self._levels_sent += 1
        is_sample = self._levels_sent % SAMPLED_LEVELS == 0
        if self._telemetry.seq >= 0 and (is_sample or self.publisher.has_subscriber("display_state")):
            self._telemetry.send("display_state", self._runner.display_state())

    def status(self) -> MissionStatus:
        """Progress of the mission."""
        status, lateness, verdict = self._runner.status(), self.lateness, self._verdicts.verdict
        status.elapsed_s = round(self.clock.elapsed_s, 6)
        status.since_s = self._runner.since_s
        if verdict is not None:
            status.code, status.severity = int(verdict.code), int(verdict.severity)
        # The end of a process that failed is no end of the mission: another takes over, or its own status says why.
        is_over = self.over.is_set() and self._failure is None
        status.exit_status = int(self.exit_status) if is_over else -1
        status.missed_deadlines = lateness.missed_deadlines
        status.worst_lateness_ms = round(1e3 * lateness.worst_s, 3)
        status.bad_lines, status.bad_line = self.link.counts["bad_lines"], self.link.first_bad_line
        status.alarms = self.alarms.alarms
        return status

    # -- commands of operators --------------------------------------------------------------------------------------

    async def _serve_operator(self) -> None:
        async with Router(self._args.endpoints.of("control"), self._answer_operator, self._shadow) as router:
            await router.serve()

    async def _answer_operator(self, frame: bytes) -> bytes:
        """Answer a command after it took effect or was refused."""
        try:
            request = parse_operator(frame)
        except BadRequest as error:
            return format_error(str(error))
        command = request.cmd
        if command is not OperatorCommand.STATUS:
            refusal = self._apply(request)
            if refusal is not None:
                return format_error(refusal)
            what = f"{command} {request.name}".strip()
            self._telemetry.notify_operator("info", f"{request.by or 'operator'}: {what}")
        if command in COMMANDS:
            self.release_time()
        if command in (OperatorCommand.PAUSE, OperatorCommand.STOP):
            try:
                async with asyncio.timeout(EFFECT_TIMEOUT_S):
                    while not (self.over.is_set() or self._runner.is_at_rest):  # noqa: ASYNC110 - no event each frame
                        await asyncio.sleep(WAIT_PERIOD_S)
            except TimeoutError:
                return format_error(f"{command}: accepted, but the robot is not at rest after {EFFECT_TIMEOUT_S:.0f} s")
        return format_ok(status=self.status())

    def _apply(self, request: OperatorRequest) -> str | None:
        if request.cmd is OperatorCommand.ACKNOWLEDGE:
            self.update_alarms()
            return self.alarms.acknowledge(request.name, request.by or "operator", self.clock.t_s)
        return self._runner.mission.handle(COMMANDS[request.cmd])

    # -- the frame ------------------------------------------------------------------------------------------------

    def on_sensors(self, sensors: Sensors, raw: bytes) -> None:
        """Serve one frame: estimate, plan, drive; then telemetry. An unexpected error ends the process, wheels held."""
        if self.over.is_set():
            return
        runner, clock, seq, begun_s = self._runner, self.clock, sensors.seq, time.perf_counter()
        self._drives.take(seq)
        try:
            is_first = self._is_new_session
            is_going_on = is_first and clock.has_begun
            t_s, dt_s = clock.take(seq, sensors.t, self.frame_period_s)
            frame = TimedFrame(sensors, raw, t_s, dt_s, is_first, is_first or seq % ESTIMATE_FRAMES == 0)
            if is_first:
                self._begin_drives(dt_s if is_going_on else 0.0)
            self.heartbeat.frame_s = time.monotonic()

            runner.estimate(frame)
            if dt_s <= 0.0:  # the localizer counts it; a controller cannot go back in time
                self._telemetry.add_line(seq, raw)
                self._answer(seq, STILL)
                return

            asked_s = time.perf_counter()
            verdict = None
            if not is_first:  # the first frame of a session has no earlier frame with a verdict
                verdict = self._verdicts.latest(seq, self.frame_period_s, is_lockstep=self.is_lockstep)
            decided_s = time.perf_counter()
            drive = runner.plan(frame, verdict, 0.0) if self.is_lockstep else self._plan_in_time(frame, verdict)
            self._answer(seq, drive)

            runner.publish(frame)
            self._telemetry.tick_us.append(1e6 * (time.perf_counter() - decided_s + asked_s - begun_s))
        except Exception as error:
            self.log.exception("unhandled_exception", seq=seq)
            what = f"{type(error).__name__}: {error}"
            self._telemetry.notify_operator("error", f"internal error, wheels held: {what}; see log.jsonl")
            self._fail(UnhandledError(f"internal error: {what}"))

    def _begin_drives(self, unseen_s: float) -> None:
        """Begin the drives of a session: here and not on joining, so that in lockstep the frame is always the same."""
        self._is_new_session = False
        if self.hello is not None:  # with the first frame, because only then a restart is known
            self._telemetry.begin_session(self.hello.boot, self.link.session)
        self._runner.begin_drives()
        if unseen_s > UNSEEN_S and not self._was_at_rest:
            text = f"the robot moved and sent no frame for {unseen_s:.2f} s: relocalizing"
            self._telemetry.notify_operator("warning", text)
            self._runner.on_tracking_gap()

    def _plan_in_time(self, frame: TimedFrame, verdict: Verdict | None) -> DriveCommand:
        """The drive that answers a frame in real time; zero if the frame is too late."""
        runner, robot, begun_s = self._runner, self.robot_cfg, time.monotonic()
        lag_s = self.lateness.add(frame.sensors.t, begun_s)
        age_s = self._frame_age.largest_s(frame.sensors.cmd, begun_s)
        is_old = age_s > robot.sensors_timeout_s
        if is_old or lag_s > robot.lag_limit_s:
            if begun_s < self._catches_up_until_s:
                return runner.hold(frame)
            verdict = None
            # Paused until frames are prompt again.
            row, late_ms, limit_ms = FRAME_LATE, 1e3 * lag_s, 1e3 * robot.lag_limit_s
            if is_old:
                row, late_ms, limit_ms = FRAMES_OLD, 1e3 * age_s, 1e3 * robot.sensors_timeout_s
            if self._interrupt(row, late_ms=late_ms, limit_ms=limit_ms):
                self.log.warning("frame_late", seq=self.clock.seq, lateness_ms=late_ms, limit_ms=limit_ms)
                if is_old:
                    self._telemetry.notify_operator("warning", text_of(runner.mission.state.cause))
        drive = runner.plan(frame, verdict, lag_s)
        now_s = time.monotonic()
        is_slow, is_still = now_s - begun_s > self.frame_period_s, drive == STILL
        # No hold for the delay of planning: it would cause new planning, and so on without end on a slow machine.
        self._catches_up_until_s = now_s + CATCH_UP_S if is_slow and is_still else -inf
        return drive

    def send_drive(self, ack: int, drive: DriveCommand) -> None:
        """Send the drive that was computed from frame ``ack``."""
        sent = self._drives.drive(ack, drive.right_rad_s, drive.left_rad_s, drive.steer_rad)
        self.link.send_drive(sent.seq, sent.ack, sent.wr, sent.wl, sent.steer)
        self._runner.on_drive(sent.seq, sent.wr, sent.wl)
        if not self.is_lockstep:
            self._frame_age.add_drive(sent.seq, time.monotonic())

    def answer_again(self) -> None:
        sent = self._drives.repeat()
        if sent is not None:
            self.link.send_drive(sent.seq, sent.ack, sent.wr, sent.wl, sent.steer)

    def _answer(self, seq: int, drive: DriveCommand) -> None:
        # Only a standing robot waits for its answer.
        is_still = not (drive.right_rad_s or drive.left_rad_s)
        if is_still and self.is_lockstep and self._stops_time():
            self._unanswered = seq
        else:
            self.send_drive(seq, drive)

    def _stops_time(self) -> bool:
        """In lockstep simulated time stops while a peer is awaited, and almost stops in a pause."""
        runner = self._runner
        return runner.is_busy or (runner.mission.state.is_paused and runner.is_at_rest)

    def _answer_held_frame(self) -> None:
        """Answer the waiting frame with a zero drive."""
        seq, self._unanswered = self._unanswered, None
        if seq is not None:
            self.send_drive(seq, STILL)

    def release_time(self) -> None:
        """After a change between two frames, such as the end of a measurement or a pause: continue lockstep time."""
        if not (self.is_lockstep and self._stops_time()):
            self._answer_held_frame()
        self._save_checkpoint()
        self._runner.publish_state()


def open_runner(args: ProcessArgs) -> AbstractContextManager[Callable[[MainLoop], MissionRunner]]:
    """Open the database of the configured mission; yields a factory of its runner."""
    open_mission: Callable[[Any, ProcessArgs], AbstractContextManager[Callable[[MainLoop], MissionRunner]]]
    open_mission = kind_of(args.config).runner.get()
    return open_mission(args.config, args)


def main() -> int:
    """Entry of ``python -m ccatp.daemon.loops.main_loop``."""
    args = start_process()

    async def serve(context: zmq.Context[zmq.Socket[bytes]], stop: asyncio.Event) -> int:
        with open_runner(args) as make_runner:
            loop = MainLoop(args, context, make_runner)
            await loop.run(stop)
        return int(loop.exit_status)

    return run_process("main", serve)


if __name__ == "__main__":
    raise SystemExit(main())
