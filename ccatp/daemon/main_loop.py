"""The main-loop process: serves a mission's frames between robot link, bus and operator channel."""

import asyncio
from contextlib import AbstractContextManager

import zmq
import zmq.asyncio

from ccatp.config.beacon_models import RadioConfig
from ccatp.daemon import realtime
from ccatp.daemon.command_handlers import OperatorCommandHandler
from ccatp.daemon.mission_runner import FrameService, MissionClock, RunnerConfig, RunnerContext, RunnerFactory
from ccatp.daemon.process import ProcessArgs, open_log, run_process, start_process, unless_stopped
from ccatp.daemon.robot_session import ControllerSession
from ccatp.daemon.subscribers import PERIOD_S, HeartbeatPublisher, VerdictSubscriber
from ccatp.errors import ConfigError, ExitStatus
from ccatp.links.bus import Publisher
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.rpc import Router
from ccatp.links.topics import MissionStatus

WAIT_PERIOD_S = 0.02
# After the end the last messages must reach the supervisor, which then ends this process.
SHUTDOWN_TIMEOUT_S = 5.0


class MainLoop:
    """The process around its mission: links, clock, commands, beginning and end."""

    def __init__(
        self,
        args: ProcessArgs,
        context: zmq.Context[zmq.Socket[bytes]],
        cfg: RunnerConfig,
        make_runner: RunnerFactory,
    ) -> None:
        self._cfg, self._endpoints, self._context = cfg, args.endpoints, context
        self._is_taking_over = args.is_taking_over
        self._publisher = Publisher(context, args.endpoints.of("main"))
        self._heartbeat = HeartbeatPublisher(self._publisher, "main")
        danger = args.endpoints.of("danger")
        self._verdicts = VerdictSubscriber(context, danger, cfg.verdict_timeout_s, self._heartbeat.publish_if_due)
        self._session = ControllerSession(
            cfg.link,
            on_sensors=self._on_sensors,
            on_lost=self._on_lost,
            on_joined=self._on_joined,
            is_taking_over=self._is_taking_over,
            frame_hz=cfg.frame_hz,
        )
        self._clock = MissionClock(cfg.clock_jump_s)
        self._runner = make_runner(
            RunnerContext(
                args.run_dir,
                self._publisher,
                open_log(args.run_dir / "log.jsonl", "main"),
                self._session,
                self._clock,
                is_patient=not args.is_realtime,
                finish=self._finish,
                answer=self._answer_held_frame,
            )
        )
        self._telemetry = self._runner.telemetry
        self._frames = FrameService(
            cfg.link, self._runner, self._session, self._clock, self._verdicts, self._heartbeat, self._fail
        )
        self._failure: Exception | None = None
        self.over = self._frames.over
        self.exit_status = ExitStatus.INTERRUPTED

    async def run(self, stop: asyncio.Event) -> None:
        """Join the robot when the danger loop has, then serve frames until the mission is over or ``stop`` is set."""
        handler = OperatorCommandHandler(
            self._runner.mission, self._telemetry.notify_operator, self.status, self.settled, self._answer_held_frame
        )
        shadow = zmq.asyncio.Context.shadow(self._context)
        async with (
            Router(self._endpoints.of("control"), handler.handle, shadow) as router,
            asyncio.TaskGroup() as tasks,
        ):
            services = router.serve(), self._publish_levels(), self._runner.run(), self._session.serve(), self._watch()
            served = [tasks.create_task(service) for service in services]
            try:
                await self._join(stop)
                waits = [tasks.create_task(stop.wait()), tasks.create_task(self.over.wait())]
                await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
                self._hold_wheels()
                if self._failure is not None:
                    raise self._failure
                if not stop.is_set():
                    await self._await_shutdown(stop)
                for wait in waits:
                    wait.cancel()
            finally:
                for task in served:
                    task.cancel()
                self._session.close()
                await self._runner.close()

    # -- beginning and end ----------------------------------------------------------------------------------------

    async def _join(self, stop: asyncio.Event) -> None:
        if not await unless_stopped(stop, self._runner.connect()):
            return
        self._heartbeat.phase = "ready"
        publisher = self._publisher
        while not (
            publisher.has_subscriber("track")
            and publisher.has_subscriber("estimate")
            and self._verdicts.is_danger_joined()
        ):
            if stop.is_set():
                return
            await asyncio.sleep(WAIT_PERIOD_S)
        is_joined = await unless_stopped(stop, self._session.join(is_patient=self._is_taking_over))
        if is_joined and not self._session.is_lockstep:
            realtime.enter(self._cfg.realtime_priority, self._telemetry.log)

    def _on_joined(self, hello: Hello) -> None:
        try:
            self._runner.check_robot(hello)
        except ConfigError as error:
            self._fail(error)
            return
        has_booted = self._session.has_rebooted(hello)
        text = self._session.begin(hello)
        self._runner.begin_session(hello)
        self._frames.begin_session()
        self._telemetry.notify_operator("info", text)
        if has_booted:
            self._telemetry.notify_operator("warning", "the robot restarted: relocalizing before it moves")
            self._verdicts.reset()
            self._telemetry.continue_numbering()
            self._clock.reset()
            self._runner.on_tracking_gap()

    def _on_sensors(self, sensors: Sensors, raw: bytes) -> None:
        self._frames.on_sensors(sensors, raw)

    def _on_lost(self, reason: str) -> None:
        if self.over.is_set():
            return
        self._frames.end_session()
        self._runner.mission.interrupt(f"robot link lost: {reason}")
        self._telemetry.notify_operator("warning", f"robot link lost: {reason}; reconnecting")

    def _fail(self, error: Exception) -> None:
        """End this process, held; the supervisor restarts it."""
        self._failure = self._failure or error
        self.over.set()

    def _finish(self, status: ExitStatus) -> None:
        self.exit_status = status
        self._heartbeat.phase = "done"
        self.over.set()

    async def _await_shutdown(self, stop: asyncio.Event) -> None:
        """Repeat the end until the supervisor has received it and stops this process."""
        self._heartbeat.phase = "done"
        try:
            async with asyncio.timeout(SHUTDOWN_TIMEOUT_S):
                await stop.wait()
        except TimeoutError:
            self._telemetry.log.warning("shutdown_not_acknowledged")

    def _hold_wheels(self) -> None:
        self._session.send_drive(self._clock.seq, 0.0, 0.0)
        self._runner.log_statistics()
        self._save_checkpoint()
        self._telemetry.flush()
        self._telemetry.publish_status(self.status())

    def _save_checkpoint(self) -> None:
        if self._clock.has_begun:  # before its first frame the predecessor's checkpoint is better
            self._runner.save_checkpoint()

    def close(self) -> None:
        """Close the sockets."""
        self._verdicts.close()
        self._publisher.close()

    # -- beside the frames ----------------------------------------------------------------------------------------

    async def _publish_levels(self) -> None:
        while True:
            self._heartbeat.publish()
            self._telemetry.flush_if_due()
            if self._heartbeat.phase != "starting":
                self._telemetry.publish_status(self.status())
            if self._runner.mission.is_paused and not self._runner.is_busy:
                self._frames.answer_held_frame()  # a frame now and then, so that an emergency acts in a pause, too
            await asyncio.sleep(PERIOD_S)

    async def _watch(self) -> None:
        """Hold where frames stop coming; drop a connection that is open and silent."""
        robot, heartbeat = self._cfg.link, self._heartbeat
        while True:
            await asyncio.sleep(WAIT_PERIOD_S)
            self._verdicts.maintain()
            age_s = heartbeat.frame_age_s
            if (
                heartbeat.phase != "joined"
                or self._session.is_lockstep
                or age_s is None
                or age_s <= robot.sensors_timeout_s
            ):
                continue
            if self._runner.mission.interrupt(f"no sensors frame for {age_s:.2f} s"):
                self._telemetry.notify_operator("warning", self._runner.mission.cause)
                self._session.send_drive(self._clock.seq, 0.0, 0.0)
            if age_s > robot.silence_timeout_s:
                self._session.drop(f"no sensors frame for {age_s:.2f} s")

    def _answer_held_frame(self) -> None:
        """Let lockstep time go on after a measurement or a pause."""
        self._frames.answer_if_allowed()
        self._save_checkpoint()
        self._runner.publish_state()

    async def settled(self) -> None:
        """Wait until the robot is held at rest, or the mission is over."""
        while not (self.over.is_set() or self._runner.is_at_rest):  # noqa: ASYNC110 - frames are worth no event each
            await asyncio.sleep(WAIT_PERIOD_S)

    def status(self) -> MissionStatus:
        """Progress of the mission."""
        status, lateness = self._runner.status(), self._frames.lateness
        status.elapsed_s = round(self._clock.elapsed_s, 6)
        status.code = 0 if self._verdicts.verdict is None else int(self._verdicts.verdict.code)
        status.exit_status = int(self.exit_status) if self.over.is_set() else -1
        status.missed_deadlines = lateness.missed_deadlines
        status.worst_lateness_ms = round(1e3 * lateness.worst_s, 3)
        return status


def open_runner(args: ProcessArgs) -> tuple[RunnerConfig, AbstractContextManager[RunnerFactory]]:
    """THE table of missions: configuration and factory. Only the configured one is imported, to start sooner."""
    cfg = args.config
    if isinstance(cfg, RadioConfig):
        from ccatp.daemon.beacon_runner import beacon_runner_config, open_beacons  # noqa: PLC0415

        return beacon_runner_config(cfg), open_beacons(cfg, args)
    from ccatp.daemon.survey_runner import open_survey, survey_runner_config  # noqa: PLC0415

    return survey_runner_config(cfg), open_survey(cfg, args)


def main() -> int:
    """Entry of ``python -m ccatp.daemon.main_loop``."""
    args = start_process()

    async def serve(context: zmq.Context[zmq.Socket[bytes]], stop: asyncio.Event) -> int:
        cfg, opening = open_runner(args)
        loop: MainLoop | None = None
        try:
            with opening as make_runner:
                loop = MainLoop(args, context, cfg, make_runner)
                realtime.take_core(args.free_core)  # the threads of ZeroMQ and the store have started elsewhere
                await loop.run(stop)
        finally:
            if loop is not None:  # last, so that the last messages leave while the store commits
                loop.close()
        return int(loop.exit_status)

    return realtime.run(run_process("main", serve), is_spinning=not args.is_realtime)


if __name__ == "__main__":
    raise SystemExit(main())
