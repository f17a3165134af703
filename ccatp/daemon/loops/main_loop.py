"""The main-loop process: serves a mission's frames between robot link, bus and operator channel."""

import asyncio
import time
from collections.abc import Callable, Coroutine
from contextlib import AbstractContextManager
from typing import Any

import zmq
import zmq.asyncio

from ccatp.clocks import MissionClock
from ccatp.conditions import text_of
from ccatp.conditions.mission import LINK_LOST, NO_FRAME_FOR
from ccatp.daemon.loops.alarm_watch import AlarmWatch
from ccatp.daemon.loops.frame_time import DriveSender, FrameTime, LockstepTime, RealTime
from ccatp.daemon.loops.mission_runner import STILL, LoopLimits, MissionHost, MissionRunner, TimedFrame
from ccatp.daemon.loops.pauses import PauseWatch
from ccatp.daemon.loops.robot_loop import RobotLoop
from ccatp.daemon.loops.standstill import StandstillWatch
from ccatp.daemon.operator.alarms import AlarmList
from ccatp.daemon.operator.operator_channel import OperatorServer
from ccatp.daemon.supervision.process import ProcessArgs, run_process, start_process
from ccatp.errors import CcatpError, ConfigError, ExitStatus
from ccatp.links.bus import BATCH_WALL_S, VerdictSubscriber
from ccatp.links.channels import OperatorCommand, OperatorRequest
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.topics import ESTIMATE_FRAMES, MissionStatus
from ccatp.missions import kind_of
from ccatp.survey.events import Interrupted
from ccatp.survey.turn import REQUESTS, offers_of, turn_of

# The supervisor ends this process after it has received the last messages; a longer wait is reported.
SHUTDOWN_REPORT_S = 30.0
# Without an open page, one display state in so many levels is published, for recordings.
SAMPLED_LEVELS = 10
# Without samples for longer than this, the place of a moving robot is not known.
UNSEEN_S = 0.1


class UnhandledError(CcatpError):
    """An unexpected error, with details in the log. The process is restarted."""

    exit_status = ExitStatus.HELD


class MainLoop:
    """Serves the frames of a mission, from its first session to its end: the work of the main process.

    ``loop`` has the session with the robot. Pauses, alarms and standstill are watched, and commands answered, by
    objects of their own; ``FrameTime`` decides when a frame is answered. ``frame_period_s``: of the present session.
    """

    def __init__(
        self,
        args: ProcessArgs,
        context: zmq.Context[zmq.Socket[bytes]],
        make_runner: Callable[[MissionHost], MissionRunner],
    ) -> None:
        cfg = args.config
        self.loop = RobotLoop("main", "controller", args, context, work=self)
        self.session = self.loop.session
        self.log = self.loop.log
        self.publisher = self.loop.publisher
        self.heartbeat = self.loop.heartbeat
        self._context = context
        self._is_restarted = args.is_restarted
        danger = args.endpoints.of("danger")
        self.peer = VerdictSubscriber(context, danger, cfg.mission.verdict_timeout_s, self.heartbeat.publish_if_due)
        kind = kind_of(cfg)
        self._resumes = kind.no_resume is None
        limits: LoopLimits = kind.limits.get()(cfg)
        self.clock = MissionClock(limits.clock_jump_s)
        self.frame_period_s = 0.0
        self.exit_status = ExitStatus.INTERRUPTED
        self._failure: Exception | None = None
        self._is_new_session = False
        self._was_at_rest = False
        self._levels_sent = 0
        self._stopped_by = ""
        self._alarms = AlarmWatch(context, danger, AlarmList(args.run_dir, self.log))
        self._runner = runner = make_runner(self)
        self._telemetry = runner.telemetry
        self._pauses = PauseWatch(runner, limits, cfg)
        self._standstill = StandstillWatch(runner, self.heartbeat, self._alarms.alarms, cfg.robot)
        self._drives = DriveSender(self.session, runner.on_drive)
        self._lockstep = LockstepTime(runner, self._drives)
        self._real_time = RealTime(runner, self._drives, self._pauses, self.loop.lateness, limits=cfg.robot)
        self._time: FrameTime = self._real_time
        self._operator = OperatorServer(args.endpoints.of("control"), self)

    def services(self) -> tuple[Coroutine[Any, Any, None], ...]:
        return self._operator.serve(zmq.asyncio.Context.shadow(self._context)), self._runner.run()

    # -- start and end --------------------------------------------------------------------------------------------

    async def connect(self) -> None:
        await self._runner.connect()
        self.heartbeat.phase = "ready"

    def is_peer_ready(self) -> bool:
        has_subscriber = self.publisher.has_subscriber
        return has_subscriber("track") and has_subscriber("estimate") and self.peer.is_danger_joined()

    def on_joined(self, hello: Hello) -> None:
        robot, sessions = self.session.cfg, self.session.count
        self._time = self._lockstep if hello.lockstep else self._real_time
        try:
            self._runner.check_robot(hello)
        except ConfigError as error:
            if sessions == 1 and not self._is_restarted:
                self._fail(error)
            else:  # in the middle of a mission: the run has begun, and its robot may be anywhere
                what = f"another robot answers at {robot.host}:{robot.port} in the middle of the mission: {error}"
                self._telemetry.notify_operator("error", f"{what}; connect the right one, then 'ccatp run --resume'")
                self.finish(ExitStatus.HELD)
            return
        self.frame_period_s = self._real_time.frame_period_s = 1.0 / hello.frame_hz
        self._is_new_session = True
        self._drives.begin_session()
        self._runner.begin_session(hello)
        self.loop.begin_session()
        again = " again" if sessions > 1 else ""
        self._telemetry.notify_operator("info", f"joined the robot at {robot.host}:{robot.port}{again}")

    def on_restarted(self) -> None:
        self._telemetry.notify_operator("warning", "the robot restarted: relocalizing before it moves")
        self.peer.reset()
        self._telemetry.continue_numbering()
        self.clock.reset()
        self._runner.on_tracking_gap()

    def on_lost(self, reason: str) -> None:
        if self.loop.over.is_set():
            return
        # If the next frame arrives soon, its samples show the motion since the last one.
        self._was_at_rest = self._runner.is_at_rest
        self.heartbeat.phase = "rejoining"
        self._time.withheld = None
        cause = LINK_LOST.cause(reason=reason)
        self._runner.mission.handle(Interrupted(cause))
        self._telemetry.notify_operator("warning", f"{text_of(cause)}; reconnecting")

    def _fail(self, error: Exception) -> None:
        """End this process with wheels held; the supervisor restarts it."""
        self._failure = self._failure or error
        self.loop.over.set()

    def finish(self, status: ExitStatus) -> None:
        """End the process with a status, after the last messages are sent."""
        self.exit_status = status
        self.heartbeat.phase = "done"
        self.loop.over.set()

    async def end(self, stop: asyncio.Event) -> None:
        self._time.hold(self.clock.seq)
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
        self._alarms.close()
        await self._runner.close()

    def _save_checkpoint(self) -> None:
        if self.clock.has_begun:  # before the first frame, the checkpoint of the earlier process is better
            self._runner.save_checkpoint()

    # -- beside the frames ----------------------------------------------------------------------------------------

    def on_heartbeat(self) -> None:
        self._telemetry.flush(BATCH_WALL_S)
        self._update_alarms()
        if self.heartbeat.phase != "starting":
            self._publish_status()
        if self._runner.mission.state.is_paused and not self._runner.is_busy:
            # Answer a frame from time to time, so that an emergency acts in a pause, too.
            self._time.answer_withheld()
        now_s = time.monotonic()
        self._pauses.escalate(now_s, counts=not self.is_lockstep)
        self._standstill.update(now_s, is_withheld=self._time.withheld is not None)

    def _update_alarms(self) -> None:
        self._alarms.update(self._runner.causes, self.peer.verdict, self.clock.t_s)

    def is_frame_due(self) -> bool:
        return self._time.withheld is None

    def answer_again(self) -> None:
        self._drives.send_again()

    def report_overdue(self, text: str) -> None:
        self._telemetry.notify_operator("warning", text)

    def report_bad_line(self, text: str) -> None:
        self._telemetry.notify_operator("warning", text)

    def on_bad_line(self) -> None:
        """Nothing but the report."""

    def on_silence(self, age_s: float) -> None:
        limit_s = self.session.cfg.sensors_timeout_s
        if age_s <= limit_s:
            return
        if self._pauses.interrupt(NO_FRAME_FOR, limit_s=limit_s):
            self._telemetry.notify_operator("warning", text_of(self._runner.mission.state.cause))
            self._time.hold(self.clock.seq)

    def _publish_status(self) -> None:
        self._telemetry.send("mission", self.status())
        self._levels_sent += 1
        is_sample = self._levels_sent % SAMPLED_LEVELS == 0
        if self._telemetry.seq >= 0 and (is_sample or self.publisher.has_subscriber("display_state")):
            self._telemetry.send("display_state", self._runner.display_state())

    def status(self) -> MissionStatus:
        """Progress of the mission."""
        status, verdict = self._runner.status(), self.peer.verdict
        lateness, link = self.loop.lateness, self.session.link
        status.elapsed_s = round(self.clock.elapsed_s, 6)
        status.since_s = self._runner.since_s - self._unseen_s
        if verdict is not None:
            status.code = int(verdict.code)
            status.severity = int(verdict.severity)
        # The end of a process that failed is no end of the mission: another takes over, or its own status says why.
        is_over = self.loop.over.is_set() and self._failure is None
        status.exit_status = int(self.exit_status) if is_over else -1
        status.missed_deadlines = lateness.missed_deadlines
        status.worst_lateness_ms = round(1e3 * lateness.worst_s, 3)
        status.bad_lines = link.counts["bad_lines"]
        status.bad_line = link.first_bad_line
        status.alarms = self._alarms.alarms.alarms
        status.stopped_by = self._stopped_by
        mission = self._runner.mission
        offers = offers_of(mission, verdict)
        status.turn = turn_of(mission.state, verdict, offers, self._runner.wait_cause, resumes=self._resumes)
        status.summary_state = str(mission.state.summary_state)
        return status

    @property
    def _unseen_s(self) -> float:
        """How long no frame has shown the robot's clock, s; in lockstep it waits for the answers of this loop."""
        age_s = self.heartbeat.frame_age_s
        is_missing = age_s is not None and age_s > self.session.cfg.sensors_timeout_s and not self.is_lockstep
        return age_s if age_s is not None and is_missing else 0.0

    # -- what the mission and the operators need of this loop --------------------------------------------------------

    @property
    def is_lockstep(self) -> bool:
        return self.session.is_lockstep

    @property
    def is_settled(self) -> bool:
        return self.loop.over.is_set() or self._runner.is_at_rest

    def send_fans(self, seq: int, duty: tuple[float, float]) -> None:
        self.session.link.send_fans(seq, duty)

    def apply(self, request: OperatorRequest) -> str | None:
        by = request.by or "operator"
        if request.cmd is OperatorCommand.ACKNOWLEDGE:
            self._update_alarms()
            refusal = self._alarms.alarms.acknowledge(request.name, by, self.clock.t_s)
        else:
            refusal = self._runner.mission.handle(REQUESTS[request.cmd](by))
        if refusal is None:
            self._telemetry.notify_operator("info", f"{by}: {f'{request.cmd} {request.name}'.strip()}")
            if request.cmd in REQUESTS:
                self._stopped_by = by if request.cmd is OperatorCommand.STOP else ""
                self.release_time()
        return refusal

    def release_time(self) -> None:
        """After a change between two frames, such as the end of a measurement or a pause: continue lockstep time."""
        self._time.release()
        self._save_checkpoint()
        self._runner.publish_state()

    # -- the frame ------------------------------------------------------------------------------------------------

    def on_sensors(self, sensors: Sensors, raw: bytes) -> None:
        """Serve one frame: estimate, plan, drive; then telemetry. An unexpected error ends the process, wheels held."""
        if self.loop.over.is_set():
            return
        runner, clock, seq, begun_s = self._runner, self.clock, sensors.seq, time.perf_counter()
        self._drives.take(seq)
        try:
            is_first = self._is_new_session
            is_going_on = is_first and clock.has_begun
            t_s, dt_s = clock.take(seq, sensors.t, self.frame_period_s)
            is_due = is_first or seq % ESTIMATE_FRAMES == 0
            frame = TimedFrame(sensors, raw, t_s, dt_s, is_first=is_first, is_estimate_due=is_due)
            if is_first:
                self._begin_drives(dt_s if is_going_on else 0.0)
            self.heartbeat.frame_s = time.monotonic()

            runner.estimate(frame)
            if dt_s <= 0.0:  # the localizer counts it; a controller cannot go back in time
                self._telemetry.add_line(seq, raw)
                self._time.answer(seq, STILL)
                return

            asked_s = time.perf_counter()
            verdict = None
            if not is_first:  # the first frame of a session has no earlier frame with a verdict
                verdict = self.peer.latest(seq, self.frame_period_s, is_lockstep=self.session.is_lockstep)
            decided_s = time.perf_counter()
            self._time.answer(seq, self._time.decide(frame, verdict))

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
        if self.session.hello is not None:  # with the first frame, because only then a restart is known
            self._telemetry.begin_session(self.session.hello.boot, self.session.link.session)
        self._runner.begin_drives()
        if unseen_s > UNSEEN_S and not self._was_at_rest:
            text = f"the robot moved and sent no frame for {unseen_s:.2f} s: relocalizing"
            self._telemetry.notify_operator("warning", text)
            self._runner.on_tracking_gap()


def open_runner(args: ProcessArgs) -> AbstractContextManager[Callable[[MissionHost], MissionRunner]]:
    """Open the database of the configured mission; yields a factory of its runner."""
    open_mission: Callable[[Any, ProcessArgs], AbstractContextManager[Callable[[MissionHost], MissionRunner]]]
    open_mission = kind_of(args.config).runner.get()
    return open_mission(args.config, args)


def main() -> int:
    """Entry of ``python -m ccatp.daemon.loops.main_loop``."""
    args = start_process()

    async def serve(context: zmq.Context[zmq.Socket[bytes]], stop: asyncio.Event) -> int:
        with open_runner(args) as make_runner:
            main_loop = MainLoop(args, context, make_runner)
            await main_loop.loop.run(stop)
        return int(main_loop.exit_status)

    return run_process("main", serve)


if __name__ == "__main__":
    raise SystemExit(main())
