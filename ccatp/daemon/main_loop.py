"""The main-loop process: hosts a mission behind the robot link, the bus and the operator channel."""

import asyncio
import os
from contextlib import AbstractContextManager

import zmq
import zmq.asyncio

from ccatp.daemon import realtime
from ccatp.daemon import realtime as spinning
from ccatp.daemon.command_handlers import OperatorCommandHandler
from ccatp.daemon.frame_service import FrameService
from ccatp.daemon.mission_runner import MakeWork, MissionClock, RunnerConfig, RunnerContext
from ccatp.daemon.process import (
    BeaconArgs,
    EitherArgs,
    ProcessArgs,
    die_with_parent,
    open_log,
    parse_either,
    report,
    stop_on_signals,
    unless_stopped,
)
from ccatp.daemon.robot_session import ControllerSession, ReconnectingRobotLink
from ccatp.daemon.subscribers import PERIOD_S, HeartbeatPublisher, VerdictSubscriber
from ccatp.errors import CcatpError, ConfigError, ExitStatus
from ccatp.links.bus import Publisher
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.rpc import Router
from ccatp.links.topics import MissionStatus

WAIT_PERIOD_S = 0.02
# After the end the last messages must reach the supervisor, which then ends this process.
FAREWELL_S = 5.0


class MainLoop:
    """The process around its mission: links, clock, commands, beginning and end."""

    def __init__(
        self,
        args: ProcessArgs | BeaconArgs,
        context: zmq.Context[zmq.Socket[bytes]],
        hosting: RunnerConfig,
        make_work: MakeWork,
    ) -> None:
        self._hosting, self._endpoints, self._context = hosting, args.endpoints, context
        self._is_taking_over = args.is_taking_over
        self._publisher = Publisher(context, args.endpoints.of("main"))
        self._pulse = HeartbeatPublisher(self._publisher, "main")
        danger = args.endpoints.of("danger")
        self._ear = VerdictSubscriber(context, danger, hosting.verdict_timeout_s, self._pulse.tell_if_due)
        self._link = ReconnectingRobotLink(
            hosting.link,
            role="controller",
            client="main",
            on_sensors=self._on_sensors,
            on_lost=self._on_lost,
            on_joined=self._on_joined,
        )
        self._seat = ControllerSession(self._link, is_taking_over=self._is_taking_over, frame_hz=hosting.frame_hz)
        self._clock = MissionClock(hosting.clock_jump_s)
        self._work = make_work(
            RunnerContext(
                args.run_dir,
                self._publisher,
                open_log(args.run_dir / "log.jsonl", "main"),
                self._seat,
                self._clock,
                is_patient=not args.is_realtime,
                finish=self._finish,
                answer=self._answer_held_frame,
            )
        )
        self._teller = self._work.teller
        self._frames = FrameService(
            hosting.link, self._work, self._seat, self._clock, self._ear, self._pulse, on_surprise=self._fail
        )
        self._failure: Exception | None = None
        self.over = self._frames.over
        self.exit_status = ExitStatus.INTERRUPTED

    async def run(self, stop: asyncio.Event) -> None:
        """Join the robot when the danger loop has, then serve frames until the mission is over or ``stop`` is set."""
        desk = OperatorCommandHandler(self._work, self._teller.say, self.status, self.settled, self._answer_held_frame)
        shadow = zmq.asyncio.Context.shadow(self._context)
        async with Router(self._endpoints.of("control"), desk.handle, shadow) as router, asyncio.TaskGroup() as tasks:
            work = router.serve(), self._beat(), self._work.run(), self._link.serve(), self._watch()
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
                await self._work.close()

    # -- beginning and end ----------------------------------------------------------------------------------------

    async def _join(self, stop: asyncio.Event) -> None:
        if not await unless_stopped(stop, self._work.connect()):
            return
        self._pulse.phase = "ready"
        publisher = self._publisher
        while not (
            publisher.has_subscriber("track") and publisher.has_subscriber("estimate") and self._ear.is_danger_joined()
        ):
            if stop.is_set():
                return
            await asyncio.sleep(WAIT_PERIOD_S)
        is_joined = await unless_stopped(stop, self._link.join(is_patient=self._is_taking_over))
        if is_joined and not self._seat.is_lockstep:
            realtime.enter(self._hosting.realtime_priority, self._teller.log)

    def _on_joined(self, hello: Hello) -> None:
        """A session begins; its first frame comes next."""
        try:
            self._work.check_robot(hello)
        except ConfigError as error:
            self._fail(error)
            return
        link = self._hosting.link
        has_booted = self._seat.has_booted(hello)
        text = self._seat.begin(hello, f"{link.host}:{link.port}")
        self._work.begin_session(hello)
        self._frames.begin_session()
        self._teller.say("info", text)
        if has_booted:
            self._teller.say("warning", "the robot has started anew: it is found again before it moves")
            self._ear.forget()
            self._teller.count_on()
            self._clock.boot()
            self._work.lose_sight()

    def _on_sensors(self, sensors: Sensors, raw: bytes) -> None:
        self._frames.on_sensors(sensors, raw)

    def _on_lost(self, reason: str) -> None:
        if self.over.is_set():
            return
        self._frames.lose()
        self._work.interrupt(f"robot link lost: {reason}")
        self._teller.say("warning", f"robot link lost: {reason}; joining again")

    def _fail(self, error: Exception) -> None:
        """End this process, held; who starts it anew is the supervisor's business."""
        self._failure = self._failure or error
        self.over.set()

    def _finish(self, status: ExitStatus) -> None:
        self.exit_status = status
        self._pulse.phase = "done"
        self.over.set()

    async def _farewell(self, stop: asyncio.Event) -> None:
        """Keep telling the end until the supervisor has heard it and stops us."""
        self._pulse.phase = "done"
        try:
            async with asyncio.timeout(FAREWELL_S):
                await stop.wait()
        except TimeoutError:
            self._teller.log.warning("shutdown_not_acknowledged")

    def _hold_wheels(self) -> None:
        self._seat.drive(self._clock.seq, 0.0, 0.0)
        self._work.note_end()
        self._keep()
        self._teller.flush()
        self._teller.status(self.status())

    def _keep(self) -> None:
        if self._clock.has_begun:  # before its first frame the mission knows no more than its predecessor
            self._work.keep()

    def close(self) -> None:
        """Close the sockets."""
        self._ear.close()
        self._publisher.close()

    # -- beside the frames ----------------------------------------------------------------------------------------

    async def _beat(self) -> None:
        while True:
            self._pulse.tell()
            self._teller.flush_if_due()
            if self._pulse.phase != "starting":
                self._teller.status(self.status())
            if self._work.is_paused and not self._work.is_busy:
                self._frames.release()  # a frame now and then, so that an emergency is heard in a pause too
            await asyncio.sleep(PERIOD_S)

    async def _watch(self) -> None:
        """Hold where frames stop coming; make a connection anew that is open and silent."""
        robot, pulse = self._hosting.link, self._pulse
        while True:
            await asyncio.sleep(WAIT_PERIOD_S)
            self._ear.tend()
            age_s = pulse.frame_age_s
            if pulse.phase != "joined" or self._seat.is_lockstep or age_s is None or age_s <= robot.sensors_timeout_s:
                continue
            if self._work.interrupt(f"no sensors frame for {age_s:.2f} s"):
                self._teller.say("warning", self._work.cause)
                self._seat.drive(self._clock.seq, 0.0, 0.0)
            if age_s > robot.silence_timeout_s:
                self._link.give_up(f"no sensors frame for {age_s:.2f} s")

    def _answer_held_frame(self) -> None:
        """Let lockstep time go on after a measurement or a pause."""
        self._frames.answer_held()
        self._keep()
        self._work.settle()

    async def settled(self) -> None:
        """Wait until the robot is held at rest, or the mission is over."""
        while not (self.over.is_set() or self._work.is_quiet):  # noqa: ASYNC110 - frames are worth no event each
            await asyncio.sleep(WAIT_PERIOD_S)

    def status(self) -> MissionStatus:
        """Where the mission stands."""
        at, lag = self._work.progress(), self._frames.lag
        return MissionStatus(
            seq=self._clock.seq,
            t_s=self._clock.t_s,
            elapsed_s=round(self._clock.elapsed_s, 6),
            code=0 if self._ear.verdict is None else int(self._ear.verdict.code),
            exit_status=int(self.exit_status) if self.over.is_set() else -1,
            missed_deadlines=lag.missed_deadlines,
            worst_lateness_ms=round(1e3 * lag.worst_s, 3),
            state=at.state,
            cause=at.cause,
            done=at.done,
            skipped=at.skipped,
            total=at.total,
            point=at.point,
            eta_s=round(at.eta_s, 3),
            error_mm=at.error_mm,
            outcome=at.outcome,
            lower_bound_s=at.lower_bound_s,
            left_out=dict(at.left_out),
        )


def open_work(args: EitherArgs) -> tuple[RunnerConfig, AbstractContextManager[MakeWork]]:
    """THE table of missions: which one the configuration is of, and what the process needs to host it.

    Only that one is imported: a main loop that was killed is back half a second sooner.
    """
    if args.survey is not None:
        from ccatp.daemon.survey_runner import hosting_of, open_survey  # noqa: PLC0415

        return hosting_of(args.survey.config), open_survey(args.survey)
    from ccatp.daemon.beacon_runner import hosting_of_beacons, open_beacons  # noqa: PLC0415

    return hosting_of_beacons(args.one_of_beacons.config), open_beacons(args.one_of_beacons)


async def run(args: EitherArgs, core: int | None) -> int:
    """The process, from its arguments to its exit status; ``core`` is for the main thread alone."""
    stop = asyncio.Event()
    stop_on_signals(stop)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    status = 0
    loop: MainLoop | None = None
    try:
        hosting, opening = open_work(args)
        with opening as make_work:
            loop = MainLoop(args.one, context, hosting, make_work)
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
    """Entry of ``python -m ccatp.daemon.main_loop``."""
    die_with_parent()
    args = parse_either()
    core = None if args.is_realtime else spinning.leave_a_core(os.getppid())
    return spinning.run(run(args, core), is_spinning=not args.is_realtime)


if __name__ == "__main__":
    raise SystemExit(main())
