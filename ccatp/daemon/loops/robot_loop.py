"""What main loop and danger loop have in common: a session with the robot, heartbeats, and tasks that end together."""

import asyncio
import gc
import time
from collections.abc import Coroutine
from typing import Any, Protocol

import zmq
import zmq.asyncio

from ccatp.daemon.loops.frame_lateness import LatenessStatistics
from ccatp.daemon.loops.lockstep import LockstepAnswers, LockstepWatch
from ccatp.daemon.loops.robot_session import RobotSession, SessionHandler
from ccatp.daemon.supervision.process import ProcessArgs, open_log, unless_stopped
from ccatp.links import realtime
from ccatp.links.bus import PERIOD_S, HeartbeatPublisher, PeerSubscriber, Publisher
from ccatp.links.robot_messages import Hello, Role, Sensors

WAIT_PERIOD_S = 0.02


class LoopWork(LockstepAnswers, Protocol):
    """The work of a loop, which ``RobotLoop`` runs: that of the main loop, or of the danger loop."""

    @property
    def peer(self) -> PeerSubscriber:
        """Messages of the other loop."""

    async def connect(self) -> None:
        """Connect to peers other than the robot and the other loop."""

    def is_peer_ready(self) -> bool:
        """Whether messages reach the other loop, and it is ready for this one to join."""

    def services(self) -> tuple[Coroutine[Any, Any, None], ...]:
        """The services that run besides the frames."""

    async def end(self, stop: asyncio.Event) -> None:
        """Send the last messages, write the last lines of the log."""

    async def close(self) -> None:
        """Close the resources of ``connect``."""

    def on_joined(self, hello: Hello) -> None:
        """Begin a session, before its first frame."""

    def on_restarted(self) -> None:
        """The robot restarted since the last session, before the first frame of this one."""

    def on_sensors(self, sensors: Sensors, raw: bytes) -> None:
        """Serve one frame; ``raw``: its line. In lockstep a session begins with a repetition of the last frame."""

    def on_bad_line(self) -> None:
        """Handle an invalid line; the first one of a session is reported already."""

    def on_silence(self, age_s: float) -> None:
        """Handle the age of the newest frame; called periodically in real time, also while frames are prompt."""

    def on_lost(self, reason: str) -> None:
        """Handle the loss of the session; the robot holds itself."""

    def on_heartbeat(self) -> None:
        """Publish what is repeated with the heartbeat."""

    def report_bad_line(self, text: str) -> None:
        """Report the first bad line of a session to the operator; for each loop it is in the log."""


class RobotLoop:
    """Runs the work of a loop with a session at the robot. ``over``: set when the loop ends by itself."""

    def __init__(
        self, name: str, role: Role, args: ProcessArgs, context: zmq.Context[zmq.Socket[bytes]], work: LoopWork
    ) -> None:
        self._args = args
        self._work = work
        self.log = open_log(args.run_dir / "log.jsonl", name)
        self.publisher = Publisher(context, args.endpoints.of(name))
        self.heartbeat = HeartbeatPublisher(self.publisher, name)
        self.lateness = LatenessStatistics(args.config.robot.late_after_s)
        self.over = asyncio.Event()
        handler = SessionHandler(
            on_sensors=work.on_sensors,
            on_joined=work.on_joined,
            on_lost=work.on_lost,
            on_restarted=work.on_restarted,
            on_bad_line=self._on_bad_line,
            on_repeated=self._on_repeated,
        )
        self.session = RobotSession(args.config.robot, role, name, handler)
        self._lockstep = LockstepWatch(self.session, work)
        self._explained = 0  # the newest session whose first bad line is reported

    async def run(self, stop: asyncio.Event) -> None:
        """Join the robot together with the other loop, then serve frames until ``over`` or ``stop`` is set."""
        async with asyncio.TaskGroup() as tasks:
            served = [tasks.create_task(service) for service in self.services()]
            try:
                await self._join(stop)
                await unless_stopped(stop, self.over.wait())
                await self._work.end(stop)
            finally:
                for task in served:
                    task.cancel()
                self.session.leave()
                await self._work.close()

    def services(self) -> tuple[Coroutine[Any, Any, None], ...]:
        """The services of every loop, and those of its work."""
        return *self._work.services(), self.publish_heartbeat(), self.session.serve(), self.watch()

    async def _join(self, stop: asyncio.Event) -> None:
        if not await unless_stopped(stop, self._work.connect()):
            return
        while not self._work.is_peer_ready():
            if stop.is_set():
                return
            await asyncio.sleep(WAIT_PERIOD_S)
        gc.freeze()  # otherwise a collection during the run visits all objects of the libraries, for about 50 ms
        joins = self.session.join(is_patient=self._args.is_taking_over)
        if await unless_stopped(stop, joins) and not self.session.is_lockstep:
            realtime.enter(self._args.config.processes.realtime_priority, self.log)

    def begin_session(self) -> None:
        """Begin a session: restart the statistics of lateness and the age of the frames."""
        self.lateness.reset()
        now_s = time.monotonic()
        self._lockstep.begin_session(now_s)
        self.heartbeat.phase = "joined"
        self.heartbeat.frame_s = now_s

    async def publish_heartbeat(self) -> None:
        """Publish periodically, until cancelled."""
        while True:
            self.heartbeat.publish()
            self._work.on_heartbeat()
            await asyncio.sleep(PERIOD_S)

    async def watch(self) -> None:
        """Handle missing frames, and drop a silent connection; until cancelled."""
        while True:
            await asyncio.sleep(WAIT_PERIOD_S)
            self._work.peer.maintain()
            frame_s = self.heartbeat.frame_s
            if self.heartbeat.phase != "joined" or frame_s is None:
                continue
            now_s = time.monotonic()
            if self.session.is_lockstep:
                self._lockstep.check(now_s, frame_s)
                continue
            age_s = now_s - frame_s
            self._work.on_silence(age_s)
            limit_s = self.session.cfg.silence_timeout_s
            if age_s > limit_s:
                self.session.drop(f"no sensors frame for more than {limit_s:g} s")

    def _on_bad_line(self) -> None:
        self._lockstep.on_bad_line(time.monotonic())
        session = self.session
        if self._explained != session.count:  # below the limit of bad lines no other line says what is wrong with them
            self._explained = session.count
            reason = session.link.first_bad_line
            self.log.warning("bad_line", session=session.count, reason=reason)
            self._work.report_bad_line(
                f"a line of the robot is not valid: {reason}; 'ccatp conformance' checks the firmware"
            )
        self._work.on_bad_line()

    def _on_repeated(self) -> None:
        if self.session.is_lockstep:
            self._lockstep.on_repeated(time.monotonic(), self.heartbeat.frame_s)
