"""Glue. The main-loop process: localizer, mission and gate behind the robot link, the bus and the laser system."""

import asyncio
import os
import time

import zmq
import zmq.asyncio

from ccatp.assembly import Parts
from ccatp.bus import Publisher
from ccatp.control.fan_gate import FanGate
from ccatp.control.gate import DriveGate
from ccatp.errors import CcatpError, ConfigError, ExitStatus, UnreachableError
from ccatp.etalon_client import EtalonClient, EtalonError
from ccatp.frame_lag import FrameLag
from ccatp.health.look import as_standing
from ccatp.health.steady_time import SteadyTime
from ccatp.localizer import Localizer
from ccatp.metrology.scrutiny import Scrutiny
from ccatp.mirror.mirror import Mirror
from ccatp.mission import Mission
from ccatp.processes import realtime, spinning
from ccatp.processes.building import build_parts
from ccatp.processes.common import ProcessArgs, die_with_parent, open_log, parse_args, report, stop_on_signals
from ccatp.processes.gate_watch import GateWatch
from ccatp.processes.hearing import VerdictEar
from ccatp.processes.joining import LastingLink
from ccatp.processes.keeping import Keeper
from ccatp.processes.measuring import MeasuringDesk, Request
from ccatp.processes.operating import OperatorDesk
from ccatp.processes.pulse import PERIOD_S, Pulse
from ccatp.processes.seat import Seat
from ccatp.processes.telling import Teller
from ccatp.router import Router
from ccatp.samples import Verdict
from ccatp.store import MissionStore
from ccatp.surveying.budget import home_time_s
from ccatp.surveying.journey import Motion
from ccatp.surveying.leftovers import by_reason
from ccatp.surveying.mirror_check import MirrorCheck
from ccatp.surveying.orders import STAND, Order
from ccatp.surveying.states import PURPOSES, Outcome, State
from ccatp.surveying.vigil import Call, Vigil
from ccatp.wire.robot import Hello, Sensors
from ccatp.wire.topics import MissionStatus, is_estimate_due

EXIT_STATUS = {
    Outcome.COMPLETE: ExitStatus.COMPLETE,
    Outcome.AT_BASE: ExitStatus.ABORTED,
    Outcome.STOPPED: ExitStatus.HELD,
    Outcome.NONE: ExitStatus.INTERRUPTED,
}
WAIT_PERIOD_S = 0.02
# Of a robot that moved nobody knows where it is when the samples of more frames than this are missing.
UNSEEN_S = 0.1
FULL_FANS = (1.0, 1.0)
# After the end the last messages must reach the supervisor, which then ends this process.
FAREWELL_S = 5.0


class Surprise(CcatpError):
    """An error that nobody foresaw; the log has it all. The process is started anew."""

    exit_status = ExitStatus.HELD


class MainLoop:
    """One sensors frame after the other: localize, hear the verdict, decide, drive.

    Args:
        args: configuration and endpoints.
        context: ZeroMQ context of the process.
        parts: the pure parts, built from the configuration.
        store: the mission's database.
    """

    def __init__(
        self, args: ProcessArgs, context: zmq.Context[zmq.Socket[bytes]], parts: Parts, store: MissionStore
    ) -> None:
        """Bind the sockets and wire the parts."""
        cfg = args.config
        self._cfg, self._endpoints, self._store, self._context = cfg, args.endpoints, store, context
        self._mirror: Mirror = parts.mirror
        self._localizer: Localizer = parts.localizer
        self._sigma_of = lambda: self._localizer.position_sigma_m
        self._mission: Mission = parts.mission
        self._gate: DriveGate = parts.gate
        self._parts = parts
        self._publisher = Publisher(context, args.endpoints.of("main"))
        self._pulse = Pulse(self._publisher, "main")
        self._ear = VerdictEar(
            context, args.endpoints.of("danger"), cfg.mission.verdict_timeout_s, self._pulse.tell_if_due
        )
        self._teller = Teller(self._publisher, open_log(args.run_dir / "log.jsonl", "main"))
        self._gate_watch = GateWatch(self._gate, self._teller.say)
        self._fan_gate = FanGate(0.0)
        self._lag_s = 0.0
        self._etalon = EtalonClient(cfg.etalon, parts.mirror.channels, parts.mirror.collimators_m)
        self._measuring = MeasuringDesk(
            cfg.mission,
            self._etalon,
            Scrutiny(parts.mirror, cfg),
            parts.localizer,
            parts.mission,
            store,
            self._teller,
            self._answer_held_frame,
            lambda: (
                0.0 if self._seat.is_lockstep else cfg.etalon.measuring_time_s
            ),  # lockstep time stands still meanwhile
        )
        self._link = LastingLink(
            cfg.robot,
            role="controller",
            client="main",
            on_sensors=self.on_sensors,
            on_lost=self._on_lost,
            on_joined=self._on_joined,
        )
        self._is_taking_over = args.is_taking_over
        self._seat = Seat(cfg.robot, self._link, is_taking_over=self._is_taking_over, frame_hz=cfg.sim.robot.frame_hz)
        self._keeper = Keeper(args.run_dir, parts.localizer, parts.mission, is_patient=not args.is_realtime)
        self._was_quiet = self._is_deaf = False
        self._recovery = parts.recovery
        self._time = SteadyTime(cfg.health.clock_jump_s)
        self._t_first_s: float | None = None
        self._t_last_s = 0.0
        self._elapsed_s = parts.elapsed_s  # before ``_t_first_s``
        self._failure: Exception | None = None
        self._seq = -1
        self._lag = FrameLag(cfg.robot.slip_after_s)
        self._mirror_check: MirrorCheck | None = MirrorCheck(parts.mirror)
        self._unanswered: int | None = None
        self._state = State.IDLE
        self._vigil = Vigil(cfg, falls=parts.mirror.overhang)
        self._has_full_fans = False
        self.over = asyncio.Event()
        self.exit_status = EXIT_STATUS[Outcome.NONE]

    # -- the process ----------------------------------------------------------------------------------------------

    async def run(self, stop: asyncio.Event) -> None:
        """Join the robot when the danger loop has, then serve frames until the mission is over or ``stop`` is set."""
        desk = OperatorDesk(self._mission, self._teller.say, self.status, self.settled, self._answer_held_frame)
        shadow = zmq.asyncio.Context.shadow(self._context)
        async with Router(self._endpoints.of("control"), desk.handle, shadow) as router, asyncio.TaskGroup() as tasks:
            work = router.serve(), self._beat(), self._measuring.run(), self._link.serve(), self._watch()
            served = [tasks.create_task(one) for one in work]
            try:
                await self._join(stop)
                waits = [tasks.create_task(stop.wait()), tasks.create_task(self.over.wait())]
                await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
                self._hold_wheels()
                if self._failure is not None:
                    raise self._failure
                if not stop.is_set():
                    await self._farewell(stop)
                for wait in waits:
                    wait.cancel()
            finally:
                for task in served:
                    task.cancel()
                self._link.close()
                self._keeper.close()
                await self._etalon.close()

    async def _join(self, stop: asyncio.Event) -> None:
        try:
            await self._etalon.connect()
        except EtalonError as error:
            raise UnreachableError(str(error)) from error
        self._pulse.phase = "ready"
        publisher = self._publisher
        while not (
            publisher.has_subscriber("track") and publisher.has_subscriber("estimate") and self._ear.is_danger_joined()
        ):
            if stop.is_set():
                return
            await asyncio.sleep(WAIT_PERIOD_S)
        await self._link.join(is_patient=self._is_taking_over)
        if not self._seat.is_lockstep:
            realtime.enter(self._cfg.run.realtime_priority, self._teller.log)

    def _on_joined(self, hello: Hello) -> None:
        """A session begins; its first frame comes next."""
        try:
            self._parts.check_robot(hello)
        except ConfigError as error:
            self._fail(error)
            return
        has_booted = self._seat.has_booted(hello)
        text = self._seat.begin(hello)
        self._keeper.boot = hello.boot
        self._fan_gate = FanGate(hello.robot.fan_floor if self._mirror.overhang else 0.0)
        self._lag.forget()
        self._pulse.phase, self._pulse.frame_s = "joined", time.monotonic()
        self._teller.say("info", text)
        if has_booted:
            self._teller.say("warning", "the robot has started anew: it is found again before it moves")
            self._ear.forget()
            self._teller.count_on()
            self._elapsed_s, self._t_first_s, self._seq = self._elapsed_total_s(), None, -1
            self._time = SteadyTime(self._cfg.health.clock_jump_s)
            self._mission.lose_sight()

    def _fail(self, error: Exception) -> None:
        """End this process, held; who starts it anew is the supervisor's business."""
        self._failure = self._failure or error
        self.over.set()

    def _elapsed_total_s(self) -> float:
        return self._elapsed_s + (0.0 if self._t_first_s is None else self._t_last_s - self._t_first_s)

    async def _farewell(self, stop: asyncio.Event) -> None:
        """Keep telling the end until the supervisor has heard it and stops us."""
        self._pulse.phase = "done"
        try:
            async with asyncio.timeout(FAREWELL_S):
                await stop.wait()
        except TimeoutError:
            self._teller.log.warning("nobody acknowledged the end")

    def _hold_wheels(self) -> None:
        self._seat.drive(self._seq, 0.0, 0.0)
        self._teller.log.info("gate", denied=self._gate_watch.counts, fans_refused=self._fan_gate.refused)
        self._keep()
        self._teller.flush()
        self._teller.status(self.status())

    def _keep(self) -> None:
        if self._t_first_s is not None:  # before its first frame the localizer knows no more than its predecessor
            self._keeper.keep(self._seq, self._t_last_s, self._elapsed_total_s())

    async def _beat(self) -> None:
        """Be seen alive, and flush batches."""
        while True:
            self._pulse.tell()
            self._teller.flush_if_due()
            if self._pulse.phase != "starting":
                self._teller.status(self.status())
            if self._mission.is_paused and not self._measuring.is_busy:
                self._release_frame()  # a frame now and then, so that an emergency is heard in a pause too
            await asyncio.sleep(PERIOD_S)

    async def _watch(self) -> None:
        """Hold where frames stop coming; make a connection anew that is open and silent."""
        robot, pulse = self._cfg.robot, self._pulse
        while True:
            await asyncio.sleep(WAIT_PERIOD_S)
            self._ear.tend()
            age_s = pulse.frame_age_s
            if pulse.phase != "joined" or self._seat.is_lockstep or age_s is None or age_s <= robot.sensors_timeout_s:
                continue
            if self._mission.interrupt(f"no sensors frame for {age_s:.2f} s"):
                self._teller.say("warning", self._mission.cause)
                self._seat.drive(self._seq, 0.0, 0.0)
            if age_s > robot.silence_timeout_s:
                self._link.give_up(f"no sensors frame for {age_s:.2f} s")

    def _on_lost(self, reason: str) -> None:
        if self.over.is_set():
            return
        # Held by the robot itself; what it did since the last frame shows in the next one, if that comes soon.
        self._was_quiet = self._is_quiet()
        self._pulse.phase, self._unanswered = "rejoining", None
        self._mission.interrupt(f"robot link lost: {reason}")
        self._teller.say("warning", f"robot link lost: {reason}; joining again")

    def _finish(self, status: ExitStatus) -> None:
        self.exit_status = status
        self._pulse.phase = "done"
        self.over.set()

    # -- the frame ------------------------------------------------------------------------------------------------

    def on_sensors(self, sensors: Sensors, raw: bytes) -> None:
        """Serve one sensors frame. A surprise ends the process, held, and not just the connection."""
        if self.over.is_set():
            return
        try:
            self._serve(sensors, raw)
        except Exception as error:
            self._teller.log.exception("surprise in a frame", seq=self._seq)
            self._teller.say("error", f"internal error, wheels held: {type(error).__name__}: {error}; see log.jsonl")
            self._fail(Surprise(f"internal error: {type(error).__name__}: {error}"))

    def _serve(self, sensors: Sensors, raw: bytes) -> None:
        start = time.perf_counter()
        t_s, seq = sensors.t, sensors.seq
        # What counts durations goes by a time that does not jump; everything else by the robot's own.
        steady_s = self._time.at(seq, t_s) if seq > self._seq else self._t_last_s
        dt_s = steady_s - self._t_last_s if self._t_first_s is not None else self._seat.frame_period_s
        is_first, is_unjudged = self._seat.is_new_session, self._seat.is_unjudged
        if is_first:
            self._begin_session(dt_s)
        if self._t_first_s is None:
            self._t_first_s = steady_s
            self._tell_beginning(seq, t_s)
        self._t_last_s, self._seq, self._pulse.frame_s = steady_s, max(seq, self._seq), time.monotonic()
        localizer = self._localizer
        self._listen(sensors)
        if localizer.hold_requested:
            # A filter that diverged is frozen until it has a fix.
            self._mission.recover(localizer.hold_cause, steady_s)
            localizer.clear_hold()
        if dt_s <= 0.0:  # counted by the localizer; a controller cannot go back in time
            self._teller.stale_frame(seq, raw)
            if self._may_answer():
                self._seat.drive(seq, 0.0, 0.0)
            else:
                self._unanswered = seq
            return
        motion = self._motion(sensors, dt_s)
        waiting = time.perf_counter()
        verdict = None
        if not is_unjudged:
            verdict = self._ear.hear(seq, self._seat.frame_period_s, is_lockstep=self._seat.is_lockstep)
        heard = time.perf_counter()
        order, right, left = self._decide(sensors, motion, None if self._is_late(t_s) else verdict)
        if order.at_rest or order.measure:
            self._execute(order, motion)
        told = self._seat.told() if is_first or is_estimate_due(seq) else None
        if self._may_answer():
            self._seat.drive(seq, right, left)
        else:
            self._unanswered = seq
        self._teller.frame(seq, t_s, localizer, self._mission.state, raw, told, is_first=is_first)
        self._keeper.frame(seq, t_s, self._elapsed_total_s())
        if self._mission.state is not self._state:
            self._on_state()
        self._teller.tick(1e6 * (time.perf_counter() - heard + waiting - start))

    def _decide(self, sensors: Sensors, motion: Motion, verdict: Verdict | None) -> tuple[Order, float, float]:
        """What the mission wants, and the wheel rates (right, left), rad/s, that the gate lets through."""
        mission = self._mission
        order = mission.step(motion, verdict) if self._is_on_mirror(sensors) else STAND
        self._heed(sensors)
        right, left = self._gate.pass_through(
            order.twist, verdict, motion.dt_s, motion.t_s, self._lag_s, PURPOSES[mission.state]
        )
        self._gate_watch.look(motion.t_s)
        return order, right, left

    def _tell_beginning(self, seq: int, t_s: float) -> None:
        """Where the localizer of a loop that takes over begins: who replays the run has to know."""
        recovery, self._recovery = self._recovery, None
        if recovery is not None:
            pose, sigmas = recovery.pose, (recovery.position_sigma_m, recovery.heading_sigma_rad)
            self._teller.treatment(seq, t_s, "begun", (pose.x_m, pose.y_m, pose.heading_rad, *sigmas))

    def _listen(self, sensors: Sensors) -> None:
        """The frame's samples go to the localizer, or as much of them as is to be believed."""
        is_deaf = self._mission.ignores_motion
        if is_deaf is not self._is_deaf:
            self._is_deaf = is_deaf
            self._teller.treatment(sensors.seq, sensors.t, "deaf" if is_deaf else "hearing")
        imu, enc = ((), as_standing(sensors.enc)) if is_deaf else (sensors.imu, sensors.enc)
        self._localizer.step(sensors.t, imu, enc, sensors.edge, sensors.gravity)

    def _heed(self, sensors: Sensors) -> None:
        """What the mission wants besides the drive, before that is sent."""
        mission, health = self._mission, self._cfg.health
        if mission.doubts_pose:
            mission.doubts_pose = False
            doubt = health.doubt_position_m, health.doubt_heading_rad
            self._localizer.doubt(*doubt)
            self._teller.treatment(sensors.seq, sensors.t, "doubted", doubt)
        if mission.wants_full_fans and not self._has_full_fans:
            self._has_full_fans = True
            self._send_fans()  # pressed on first, held then
        if mission.is_faulted:
            self._keep_vigil(sensors)

    def _begin_session(self, dt_s: float) -> None:
        """Before the first drive and not on joining, so that in lockstep the fans start in a certain frame."""
        self._seat.is_new_session = False
        self._send_fans()
        if self._t_first_s is not None and dt_s > UNSEEN_S and not self._was_quiet:
            self._teller.say("warning", f"the robot moved and was out of sight for {dt_s:.2f} s: it is found again")
            self._mission.lose_sight()

    def _send_fans(self) -> None:
        duty = FULL_FANS if self._has_full_fans else self._cfg.robot.fan_duty
        refusal = self._fan_gate.refusal(*duty)
        if refusal is None:
            self._seat.send_fans(duty)
        else:
            self._teller.say("error", refusal)
            self._mission.fault(refusal)

    def _is_late(self, t_s: float) -> bool:
        """Whether the frame is too late to move on: then the mission pauses until frames are prompt again."""
        self._lag_s = lag_s = 0.0 if self._seat.is_lockstep else self._lag.served(t_s, time.monotonic())
        if lag_s <= self._cfg.robot.lag_limit_s:
            return False
        if self._mission.interrupt(f"a frame was served {1e3 * lag_s:.0f} ms late"):
            self._teller.log.warning("late frame", seq=self._seq, lag_s=lag_s, limit_s=self._cfg.robot.lag_limit_s)
        return True

    def _is_on_mirror(self, sensors: Sensors) -> bool:
        """Whether the robot may move, as far as gravity knows: it stands on the mirror of the configuration.

        In lockstep the mission begins at once, and ends when gravity contradicts: nothing real can be harmed, and a run
        stays the same function of its seed.
        """
        check = self._mirror_check
        if check is None:
            return True
        if check.hear(sensors.t, sensors.gravity, self._localizer.deck_pose):
            self._mirror_check = None
            if check.warning:
                self._teller.say("warning", check.warning)
        if check.contradiction:
            self._teller.say("error", check.contradiction)
            self._finish(ExitStatus.USAGE)
            return False
        return self._mirror_check is None or self._seat.is_lockstep

    def _motion(self, sensors: Sensors, dt_s: float) -> Motion:
        localizer, echo = self._localizer, sensors.cmd
        pose, v, omega, creep = localizer.pose, localizer.speed_m_s, localizer.rate_rad_s, localizer.creep
        ahead = self._seat.predictor.ahead(
            (pose.x_m, pose.y_m, pose.heading_rad), v, omega, echo.seq, echo.age, echo.held, creep
        )
        return Motion(self._t_last_s, dt_s, pose, self._mirror.deck_pose, v, omega, creep, ahead, self._sigma_of)

    def _keep_vigil(self, sensors: Sensors) -> None:
        """A fault that nobody looks after: an alarm now and then, and home before the battery is too low for it."""
        mission, vigil, pose = self._mission, self._vigil, self._localizer.deck_pose
        knows_place = not (mission.is_lost or self._localizer.is_frozen)
        home_s = home_time_s(self._mirror.base_pose, self._cfg.limits, pose.x_m, pose.y_m) if knows_place else None
        call = vigil.watch(sensors.t, sensors.soc, home_s)
        if call is Call.REMIND:
            self._teller.say(
                "error", f"held for {vigil.held_s(sensors.t):.0f} s, waiting for an operator: {mission.cause}"
            )
        elif call is Call.RETURN:
            mission.abort(f"nobody came, and the battery ({sensors.soc:.0%}) lasts for little more than the way home")

    def _execute(self, order: Order, motion: Motion) -> None:
        if order.at_rest:
            self._localizer.rest()
            self._teller.rest(self._seq, motion.t_s)
        if order.arrived is not None:
            error_m = self._mission.survey.distance_m(motion.pose)
            self._teller.arrival(self._seq, motion.t_s, order.arrived, error_m)
            self._store.record_arrival(order.arrived, motion.t_s, error_m)
        if order.measure:
            pose = self._localizer.deck_pose
            expected = self._mirror.puck_world(pose, self._cfg.robot.puck_height_m)
            # The localizer dates a fix by the robot's own clock.
            t_s = motion.t_s - self._time.offset_s
            number, point = self._mission.request, self._mission.measuring_point
            self._measuring.begin(Request(number, t_s, point, expected, pose))

    def _is_quiet(self) -> bool:
        control = self._cfg.control
        return (
            abs(self._localizer.speed_m_s) <= control.settle_speed_m_s
            and abs(self._localizer.rate_rad_s) <= control.settle_rate_rad_s
        )

    def _may_answer(self) -> bool:
        """In lockstep simulated time stands still while a measurement is under way, and all but still in a pause."""
        if not self._seat.is_lockstep:
            return True
        return not self._measuring.is_busy and not (self._mission.is_paused and self._is_quiet())

    def _answer_held_frame(self) -> None:
        """Let lockstep time go on after a measurement or a pause."""
        if self._may_answer():
            self._release_frame()
        self._keep()
        if self._mission.state is not self._state:
            self._on_state()

    def _release_frame(self) -> None:
        seq, self._unanswered = self._unanswered, None
        if seq is not None:
            self._seat.drive(seq, 0.0, 0.0)

    def _on_state(self) -> None:
        mission = self._mission
        before, self._state = self._state, mission.state
        if not mission.is_faulted:
            self._vigil.over()
        self._teller.log.debug("state", seq=self._seq, before=before, after=mission.state, cause=mission.cause)
        if mission.state in (State.HELD, State.BACKING_OFF) or before is State.HELD:
            self._teller.say("warning", f"{mission.state}: {mission.cause}" if mission.cause else f"{mission.state}")
        if mission.state is State.RETURNING and before is not State.BACKING_OFF:
            self._teller.say("warning", f"returning to base: {mission.cause}")
        if mission.state is State.DONE:
            self._finish(EXIT_STATUS[mission.outcome])
        elif mission.is_faulted and self._seat.is_lockstep:
            # Nobody can be waited for while simulated time runs at many times the wall clock.
            self._finish(EXIT_STATUS[Outcome.STOPPED])

    # -- for operators --------------------------------------------------------------------------------------------

    async def settled(self) -> None:
        """Wait until the robot is held at rest, or the mission is over."""
        while not (self.over.is_set() or self._is_quiet()):  # noqa: ASYNC110 - frames are worth no event each
            await asyncio.sleep(WAIT_PERIOD_S)

    def status(self) -> MissionStatus:
        """Where the mission stands."""
        mission = self._mission
        stop = mission.journey.current
        point = stop.point if stop is not None else None
        if mission.is_paused:
            point = mission.survey.next_point
        return MissionStatus(
            seq=self._seq,
            t_s=self._t_last_s,
            state=str(mission.state),
            cause=mission.cause,
            done=len(mission.done) + self._parts.already_done,
            skipped=len(mission.skipped),
            total=self._parts.total_points,
            point=f"{point.row}-{point.col}-{point.point}" if point is not None else "",
            elapsed_s=self._elapsed_total_s(),
            eta_s=mission.eta_s,
            error_mm=1e3 * self._measuring.arrival_error_m,
            code=0 if self._ear.verdict is None else int(self._ear.verdict.code),
            outcome=str(mission.outcome),
            lower_bound_s=self._parts.lower_bound_s,
            exit_status=int(self.exit_status) if self.over.is_set() else -1,
            slips=self._lag.slips,
            lag_ms=1e3 * self._lag.worst_s,
            left_out=by_reason(mission.left_out),
        )

    def close(self) -> None:
        """Close the sockets."""
        self._ear.close()
        self._publisher.close()


async def run(args: ProcessArgs, core: int | None) -> int:
    """The process, from its arguments to its exit status; ``core`` is for the main thread alone."""
    stop = asyncio.Event()
    stop_on_signals(stop)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    status = 0
    loop: MainLoop | None = None
    try:
        parts, store = build_parts(args)
        with store:
            loop = MainLoop(args, context, parts, store)
            spinning.take_core(core)  # now that the threads of ZeroMQ and of the store have been started elsewhere
            await loop.run(stop)
    except* CcatpError as group:
        status = report("main", group)
    finally:
        if loop is not None:
            loop.close()
        context.destroy(linger=0)
    return status or int(loop.exit_status if loop is not None else ExitStatus.HELD)


def main() -> int:
    """Entry of ``python -m ccatp.processes.main_loop``."""
    die_with_parent()
    args = parse_args()
    core = None if args.is_realtime else spinning.leave_a_core(os.getppid())
    return spinning.run(run(args, core), is_spinning=not args.is_realtime)


if __name__ == "__main__":
    raise SystemExit(main())
