"""Glue. The main-loop process: localizer, mission and gate behind the robot link, the bus and the laser system."""

import asyncio
import os
import time

import zmq
import zmq.asyncio

from ccatp.assembly import Parts
from ccatp.bus import Publisher
from ccatp.control.gate import DriveGate
from ccatp.control.kinematics import twist_of
from ccatp.control.prediction import CommandPredictor
from ccatp.errors import CcatpError, ExitStatus, UnreachableError
from ccatp.etalon_client import EtalonClient, EtalonError
from ccatp.health.commanded import CommandSpan
from ccatp.health.fan_gate import FanGate
from ccatp.health.look import as_standing
from ccatp.health.steady_time import SteadyTime
from ccatp.localizer import Localizer
from ccatp.mirror.mirror import Mirror
from ccatp.mission import Mission
from ccatp.processes import realtime, spinning
from ccatp.processes.building import build_parts
from ccatp.processes.common import ProcessArgs, die_with_parent, open_log, parse_args, report, stop_on_signals
from ccatp.processes.hearing import VerdictEar
from ccatp.processes.measuring import MeasuringDesk, Request
from ccatp.processes.operating import OperatorDesk
from ccatp.processes.telling import Teller
from ccatp.robot_link import RobotLink, read_key
from ccatp.router import Router
from ccatp.store import MissionStore
from ccatp.surveying.journey import Motion
from ccatp.surveying.orders import Order
from ccatp.surveying.states import Outcome, State
from ccatp.wire.robot import Hello, Sensors
from ccatp.wire.topics import MissionStatus, Presence, is_estimate_due

EXIT_STATUS = {
    Outcome.COMPLETE: ExitStatus.COMPLETE,
    Outcome.AT_BASE: ExitStatus.ABORTED,
    Outcome.STOPPED: ExitStatus.HELD,
    Outcome.NONE: ExitStatus.INTERRUPTED,
}
BEAT_PERIOD_S = 0.1
WAIT_PERIOD_S = 0.02
# After the end the last messages must reach the supervisor, which then ends this process.
FAREWELL_S = 5.0
FULL_FANS = (1.0, 1.0)


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
        self._ear = VerdictEar(context, args.endpoints.of("danger"), cfg.mission.verdict_timeout_s)
        self._teller = Teller(self._publisher, open_log(args.run_dir / "log.jsonl", "main"))
        self._etalon = EtalonClient(cfg.etalon, parts.mirror.channels, parts.mirror.collimators_m)
        self._predictor = CommandPredictor(cfg.robot.wheel_lag_s, 1.0 / cfg.sim.robot.frame_hz)
        self._measuring = MeasuringDesk(
            cfg.mission, self._etalon, parts.localizer, parts.mission, store, self._teller, self._answer_held_frame
        )
        self._link = RobotLink(
            host=cfg.robot.host,
            port=cfg.robot.port,
            role="controller",
            client="main",
            key=read_key(cfg.robot.key_file),
            on_sensors=self.on_sensors,
            on_lost=self._on_lost,
        )
        self._hello: Hello | None = None
        self._fan_gate = FanGate(0.0)
        self._is_lockstep = False
        self._phase = "starting"
        self._time = SteadyTime(cfg.health.clock_jump_s)
        self._span = CommandSpan()
        self._driven = (0.0, 0.0)
        self._has_full_fans = False
        self._t_first_s: float | None = None
        self._t_last_s = 0.0
        self._frame_wall_s = time.monotonic()
        self._seq = -1
        self._drive_seq = 0
        self._unanswered: int | None = None
        self._state = State.IDLE
        self.over = asyncio.Event()
        self.exit_status = EXIT_STATUS[Outcome.NONE]

    # -- the process ----------------------------------------------------------------------------------------------

    async def run(self, stop: asyncio.Event) -> None:
        """Join the robot when the danger loop has, then serve frames until the mission is over or ``stop`` is set."""
        desk = OperatorDesk(self._mission, self._teller.say, self.status, self.settled, self._answer_held_frame)
        shadow = zmq.asyncio.Context.shadow(self._context)
        async with Router(self._endpoints.of("control"), desk.handle, shadow) as router, asyncio.TaskGroup() as tasks:
            served = [tasks.create_task(work) for work in (router.serve(), self._beat(), self._measuring.run())]
            try:
                await self._join(stop)
                waits = [tasks.create_task(stop.wait()), tasks.create_task(self.over.wait())]
                await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
                self._hold_wheels()
                if not stop.is_set():
                    await self._farewell(stop)
                for wait in waits:
                    wait.cancel()
            finally:
                for task in served:
                    task.cancel()
                self._link.close()
                await self._etalon.close()

    async def _join(self, stop: asyncio.Event) -> None:
        try:
            await self._etalon.connect()
        except EtalonError as error:
            raise UnreachableError(str(error)) from error
        self._phase = "ready"
        while not (self._publisher.has_subscriber("track") and self._ear.is_danger_joined()):
            if stop.is_set():
                return
            await asyncio.sleep(WAIT_PERIOD_S)
        hello = await self._link.connect(self._cfg.robot.connect_timeout_s)
        self._parts.check_robot(hello)
        self._hello, self._is_lockstep = hello, hello.lockstep
        self._fan_gate = FanGate(hello.robot.fan_floor)
        self._predictor = CommandPredictor(self._cfg.robot.wheel_lag_s, 1.0 / hello.frame_hz)
        self._phase = "joined"
        if not hello.lockstep:
            realtime.enter(self._cfg.run.realtime_priority, self._teller.log)
        self._teller.say("info", f"joined the robot at {self._cfg.robot.host}:{self._cfg.robot.port}")

    async def _farewell(self, stop: asyncio.Event) -> None:
        """Keep telling the end until the supervisor has heard it and stops us."""
        self._phase = "done"
        try:
            async with asyncio.timeout(FAREWELL_S):
                await stop.wait()
        except TimeoutError:
            self._teller.log.warning("nobody acknowledged the end")

    def _drive(self, ack: int, right: float, left: float) -> None:
        self._drive_seq += 1
        self._driven = right, left
        self._span.add(right, left)
        twist = twist_of(right, left, self._cfg.robot.wheel_radius_m, self._cfg.robot.wheel_base_m)
        self._predictor.sent(self._drive_seq, twist.v_m_s, twist.omega_rad_s)
        self._link.send_drive(self._drive_seq, max(ack, 0), right, left)

    def _hold_wheels(self) -> None:
        self._drive(self._seq, 0.0, 0.0)
        self._teller.flush()
        self._teller.status(self.status())

    async def _beat(self) -> None:
        """Be seen alive, flush batches, and hold where frames stop coming."""
        count = 0
        while True:
            self._publisher.send(
                "presence.main",
                Presence(
                    seq=count,
                    t_s=time.monotonic(),
                    process="main",
                    pid=os.getpid(),
                    phase=self._phase,
                    frame_age_s=None if self._t_first_s is None else time.monotonic() - self._frame_wall_s,
                ),
            )
            count += 1
            self._teller.flush_if_due()
            if self._phase != "starting":
                self._teller.status(self.status())
            self._check_age()
            if self._mission.is_paused and not self._measuring.is_busy:
                self._release_frame()  # a frame now and then, so that an emergency is heard in a pause too
            await asyncio.sleep(BEAT_PERIOD_S)

    def _check_age(self) -> None:
        age_s = time.monotonic() - self._frame_wall_s
        if self._phase != "joined" or self._is_lockstep or age_s <= self._cfg.robot.sensors_timeout_s:
            return
        if self._mission.interrupt(f"no sensors frame for {age_s:.2f} s"):
            self._teller.say("warning", self._mission.cause)
            self._drive(self._seq, 0.0, 0.0)

    def _on_lost(self, reason: str) -> None:
        if not self.over.is_set():
            self._teller.say("error", f"robot link lost: {reason}")
            self._finish(ExitStatus.UNREACHABLE)

    def _finish(self, status: ExitStatus) -> None:
        self.exit_status = status
        self._phase = "done"
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
            self._finish(ExitStatus.HELD)

    def _serve(self, sensors: Sensors, raw: bytes) -> None:
        start = time.perf_counter()
        t_s, seq = sensors.t, sensors.seq
        # What counts durations goes by a time that does not jump; everything else by the robot's own.
        steady_s = self._time.at(seq, t_s) if seq > self._seq else self._t_last_s
        dt_s = steady_s - self._t_last_s if self._t_first_s is not None else self._frame_period_s()
        if self._t_first_s is None:
            self._t_first_s = t_s
            # Before the first drive and not on joining, so that in lockstep they start in a certain frame.
            self._send_fans(1, self._cfg.robot.fan_duty)
        self._t_last_s, self._frame_wall_s = steady_s, time.monotonic()
        self._seq = max(seq, self._seq)
        localizer = self._localizer
        is_deaf = self._mission.ignores_motion
        imu, enc = ((), as_standing(sensors.enc)) if is_deaf else (sensors.imu, sensors.enc)
        localizer.step(t_s, imu, enc, sensors.edge, sensors.gravity)
        if localizer.hold_requested:
            # A filter that diverged is frozen until it has a fix.
            self._mission.recover(localizer.hold_cause, steady_s)
            localizer.clear_hold()
        if dt_s <= 0.0:  # counted by the localizer; a controller cannot go back in time
            self._teller.stale_frame(seq, raw)
            self._drive(seq, 0.0, 0.0)
            return
        motion = self._motion(sensors, dt_s)
        waiting = time.perf_counter()
        verdict = self._ear.hear(seq, self._frame_period_s(), is_lockstep=self._is_lockstep)
        heard = time.perf_counter()
        order = self._mission.step(motion, verdict)
        if self._mission.doubts_pose:
            self._mission.doubts_pose = False
            localizer.doubt(self._cfg.health.doubt_position_m, self._cfg.health.doubt_heading_rad)
        if self._mission.wants_full_fans and not self._has_full_fans:
            self._has_full_fans = True
            self._send_fans(2, FULL_FANS)
        right, left = self._gate.pass_through(order.twist, verdict, dt_s)
        if order.at_rest or order.measure:
            self._execute(order, motion)
        told = (self._span.take(*self._driven), self._drive_seq) if is_estimate_due(seq) else None
        if self._may_answer():
            self._drive(seq, right, left)
        else:
            self._unanswered = seq
        self._teller.frame(seq, t_s, localizer, self._mission.state, raw, told)
        if self._mission.state is not self._state:
            self._on_state()
        self._teller.tick(1e6 * (time.perf_counter() - heard + waiting - start))

    def _send_fans(self, number: int, duty: tuple[float, float]) -> None:
        """Send what the gate lets through; what it does not is a fault, and the fans keep what they have."""
        if self._fan_gate.pass_through(duty) is None:
            self._mission.fault(f"fan duties {duty} are below the robot's floor: raise robot.fan_duty")
        else:
            self._link.send_fans(number, duty)

    def _motion(self, sensors: Sensors, dt_s: float) -> Motion:
        localizer, echo = self._localizer, sensors.cmd
        pose, v, omega, creep = localizer.pose, localizer.speed_m_s, localizer.rate_rad_s, localizer.creep
        ahead = self._predictor.ahead(
            (pose.x_m, pose.y_m, pose.heading_rad), v, omega, echo.seq, echo.age, echo.held, creep
        )
        return Motion(self._t_last_s, dt_s, pose, self._mirror.deck_pose, v, omega, creep, ahead, self._sigma_of)

    def _frame_period_s(self) -> float:
        return 1.0 / self._hello.frame_hz if self._hello is not None else 0.01

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
        if not self._is_lockstep:
            return True
        return not self._measuring.is_busy and not (self._mission.is_paused and self._is_quiet())

    def _answer_held_frame(self) -> None:
        """Let lockstep time go on after a measurement or a pause."""
        if self._may_answer():
            self._release_frame()
        if self._mission.state is not self._state:
            self._on_state()

    def _release_frame(self) -> None:
        seq, self._unanswered = self._unanswered, None
        if seq is not None:
            self._drive(seq, 0.0, 0.0)

    def _on_state(self) -> None:
        mission = self._mission
        before, self._state = self._state, mission.state
        self._teller.log.debug("state", seq=self._seq, before=before, after=mission.state, cause=mission.cause)
        if mission.state in (State.HELD, State.BACKING_OFF) or before is State.HELD:
            self._teller.say("warning", f"{mission.state}: {mission.cause}" if mission.cause else f"{mission.state}")
        if mission.state is State.RETURNING and before is not State.BACKING_OFF:
            self._teller.say("warning", f"returning to base: {mission.cause}")
        if mission.state is State.DONE:
            self._finish(EXIT_STATUS[mission.outcome])
        elif mission.is_faulted and self._is_lockstep:
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
        return MissionStatus(
            seq=self._seq,
            t_s=self._t_last_s,
            state=str(mission.state),
            cause=mission.cause,
            done=len(mission.done) + self._parts.already_done,
            skipped=len(mission.skipped),
            total=self._parts.total_points,
            point=f"{point.row}-{point.col}-{point.point}" if point is not None else "",
            elapsed_s=self._t_last_s - (self._t_first_s if self._t_first_s is not None else self._t_last_s),
            eta_s=mission.eta_s,
            error_mm=1e3 * self._measuring.arrival_error_m,
            code=0 if self._ear.verdict is None else int(self._ear.verdict.code),
            outcome=str(mission.outcome),
            lower_bound_s=self._parts.lower_bound_s,
            exit_status=int(self.exit_status) if self.over.is_set() else -1,
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
