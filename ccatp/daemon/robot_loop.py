"""What the main loop and the danger loop have in common: session at the robot, bus, and tasks that end together."""

import asyncio
import gc
import time
from abc import abstractmethod
from collections.abc import Coroutine
from typing import Any

import zmq
import zmq.asyncio

from ccatp.daemon import realtime
from ccatp.daemon.process import ProcessArgs, open_log, processes_of, unless_stopped
from ccatp.daemon.robot_session import LatenessStatistics, RobotSession
from ccatp.daemon.subscribers import PERIOD_S, HeartbeatPublisher, PeerSubscriber
from ccatp.links.bus import Publisher
from ccatp.links.robot_messages import Role

WAIT_PERIOD_S = 0.02
# In lockstep the robot sends the next frame as soon as it has its answers, or the last one again: it has lost both.
LOCKSTEP_SILENCE_S = 30.0


class RobotLoop(RobotSession):
    """A loop at the robot, and the process around it.

    Attributes:
        peer: the messages of the other loop.
        over: set when the loop ends by itself.
    """

    peer: PeerSubscriber

    def __init__(self, name: str, role: Role, args: ProcessArgs, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        super().__init__(args.config.robot, role, name)
        self._args = args
        self._shadow = zmq.asyncio.Context.shadow(context)
        self.log = open_log(args.run_dir / "log.jsonl", name)
        self.publisher = Publisher(context, args.endpoints.of(name))
        self.heartbeat = HeartbeatPublisher(self.publisher, name)
        self.lateness = LatenessStatistics(self.robot_cfg.slip_after_s)
        self.over = asyncio.Event()

    async def run(self, stop: asyncio.Event) -> None:
        """Join the robot together with the other loop, then serve frames until the end or until ``stop`` is set."""
        async with asyncio.TaskGroup() as tasks:
            served = [tasks.create_task(service) for service in self.services()]
            try:
                await self._join(stop)
                await unless_stopped(stop, self.over.wait())
                await self.end(stop)
            finally:
                for task in served:
                    task.cancel()
                self.leave()
                await self.close()

    async def _join(self, stop: asyncio.Event) -> None:
        if not await unless_stopped(stop, self.connect()):
            return
        while not self.is_peer_ready():
            if stop.is_set():
                return
            await asyncio.sleep(WAIT_PERIOD_S)
        gc.freeze()  # else a collection in the middle of the run visits every object of the libraries, some 50 ms long
        joins = self.join(is_patient=self._args.is_taking_over)
        if await unless_stopped(stop, joins) and not self.is_lockstep:
            realtime.enter(processes_of(self._args.config).realtime_priority, self.log)

    @abstractmethod
    def services(self) -> tuple[Coroutine[Any, Any, None], ...]:
        """What is served beside the frames."""

    async def connect(self) -> None:
        """Connect to peers other than the robot and the other loop."""

    @abstractmethod
    def is_peer_ready(self) -> bool:
        """Messages reach the other loop, and it has got as far as this one has to wait for."""

    @abstractmethod
    async def end(self, stop: asyncio.Event) -> None:
        """The last messages and lines of the log."""

    async def close(self) -> None:
        """Close the resources of ``connect``."""

    def publish_levels(self) -> None:
        """Publish what is repeated beside the heartbeat."""

    def is_frame_due(self) -> bool:
        """In lockstep: the last frame was answered, and it is the robot's turn."""
        return False

    @abstractmethod
    def on_silence(self, age_s: float) -> None:
        """No frame came for so long, in real time; called all the time, also while frames are prompt."""

    def begin_session(self) -> None:
        """Frames are judged and counted from here on."""
        self.lateness.reset()
        self.heartbeat.phase, self.heartbeat.frame_s = "joined", time.monotonic()

    async def publish_heartbeat(self) -> None:
        """Publish periodically, until cancelled."""
        while True:
            self.heartbeat.publish()
            self.publish_levels()
            await asyncio.sleep(PERIOD_S)

    async def watch(self) -> None:
        """Act where frames stop coming, and drop a connection that is open and silent; until cancelled."""
        while True:
            await asyncio.sleep(WAIT_PERIOD_S)
            self.peer.maintain()
            age_s = self.heartbeat.frame_age_s
            if self.heartbeat.phase != "joined" or age_s is None:
                continue
            if self.is_lockstep:
                if age_s > LOCKSTEP_SILENCE_S and self.is_frame_due():
                    self.drop(f"no sensors frame for {age_s:.0f} s in lockstep though the last one was answered")
                continue
            self.on_silence(age_s)
            if age_s > self.robot_cfg.silence_timeout_s:
                self.drop(f"no sensors frame for {age_s:.2f} s")
