"""The simulated robots behind the robot link: sockets, the wall clock or lockstep, and the true state beside the link.

The sockets of the robot link carry what a real robot would send and nothing else. The true state leaves by ZeroMQ: a
REP socket with the requests of ``GroundTruthPublisher`` and of the robot, and a PUB socket with rows.

Known limitations: the battery stays full, and nothing fails without a fault plan (``ccatp.sim.fault_injector``).
"""

import asyncio
import socket
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.models import Config
from ccatp.core import DeckPose
from ccatp.links.auth import read_key
from ccatp.links.robot_link import LineWriter
from ccatp.mirror.mirror import build_mirror
from ccatp.sim.beacon_robot import build_beacon_robot
from ccatp.sim.fault_injector import Injector
from ccatp.sim.fault_plan import FaultPlan, Injected
from ccatp.sim.fault_proxy import FaultProxy, LinkFaults
from ccatp.sim.ground_truth import GroundTruthPublisher, SimPoseFile
from ccatp.sim.robot import Robot
from ccatp.sim.rules import SimulatedRobot
from ccatp.sim.sessions import RobotServer, RobotSession, ServerLog

HOUSEKEEPING_S = 0.25
# A client that does not read gets no more frames once this much waits for it; it finds the newest when it reads on.
MAX_UNSENT_BYTES = 1 << 18


class DataLoop(RobotServer):
    """The server of one simulated robot.

    In lockstep simulated time waits for the clients; otherwise the wall clock paces it. Each of the ``faults`` is
    logged when it begins and ends, and with what it did; a fall of the robot is logged when it falls.
    """

    def __init__(
        self,
        robot: SimulatedRobot,
        *,
        lockstep: bool,
        key: bytes | None = None,
        log: ServerLog | None = None,
        faults: Sequence[Injector | LinkFaults] = (),
    ) -> None:
        super().__init__(robot, lockstep=lockstep, key=key, log=log)
        self._faults = faults
        self._listener: asyncio.Server | None = None
        self._timer: asyncio.TimerHandle | None = None
        self.connections: set[Connection] = set()
        self._failure: asyncio.Future[None]
        self._is_fall_logged = False
        self.each_frame += [self._log_faults, self._log_fall]

    async def start(self, listener: socket.socket) -> int:
        """Boot and serve who connects to a listening socket; return its port."""
        loop = asyncio.get_running_loop()
        self._failure = loop.create_future()
        self.begin(loop.time())
        self._listener = await loop.create_server(self.connect, sock=listener)
        if not self._is_lockstep:
            self._timer = loop.call_at(self.next_frame_s, self._on_timer)
        return int(listener.getsockname()[1])

    def connect(self) -> "Connection":
        """The protocol of a new connection."""
        return Connection(self)

    async def run(self, stop: asyncio.Event) -> None:
        """Serve until ``stop`` is set; ``start`` first. An unforeseen error is raised here."""
        failure = self._failure
        stopped = asyncio.ensure_future(stop.wait())
        try:
            while not (stopped.done() or failure.done()):
                self.check_time(asyncio.get_running_loop().time())
                await asyncio.wait((stopped, failure), timeout=HOUSEKEEPING_S, return_when="FIRST_COMPLETED")
            if failure.done():
                failure.result()
        finally:
            stopped.cancel()
            await self.close()

    async def close(self) -> None:
        """Stop: no timer, no listener, no session."""
        if self._timer is not None:
            self._timer.cancel()
        if self._listener is None:
            return
        self._listener.close()
        for connection in tuple(self.connections):
            connection.close()
        self._log_faults()  # what happened since the last frame
        for faults in self._faults:
            for injected in faults.injected:
                self._log_fault("injected", injected)
        if self._log is not None:
            counts = {"fan_changes": self.fan_changes, "oldest_ack_frames": self.oldest_ack_frames}
            self._log.info("robot_statistics", **counts, **self.counts)
        await self._listener.wait_closed()
        self._listener = None

    def _log_faults(self) -> None:
        for faults in self._faults:
            for what, injected in faults.changes(self.robot.t_s):
                self._log_fault(what, injected)

    def _log_fall(self) -> None:
        if self.robot.is_fallen and not self._is_fall_logged and self._log is not None:
            self._is_fall_logged = True
            self._log.info("robot_fell", **self.robot.describe_fall())

    def _log_fault(self, what: str, injected: Injected) -> None:
        if self._log is not None:
            self._log.info(f"fault_{what}", **injected.as_fields())

    def fail(self, error: Exception) -> None:
        """End ``run`` with an unforeseen error."""
        if not self._failure.done():
            self._failure.set_exception(error)

    def _on_timer(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            self.tick(loop.time())
        except Exception as error:
            self.fail(error)
            return
        self._timer = loop.call_at(self.next_frame_s, self._on_timer)


class Connection(RobotSession, asyncio.Protocol):
    """One client of a ``DataLoop``."""

    _transport: asyncio.Transport

    def __init__(self, owner: "DataLoop") -> None:
        super().__init__(owner)
        self._owner = owner
        self._is_paused = False
        self._clock = asyncio.get_running_loop().time

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)  # a TCP connection has no other
        self._transport.set_write_buffer_limits(high=MAX_UNSENT_BYTES)
        self._writer = LineWriter(self._transport)
        peer = self._transport.get_extra_info("socket")
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._owner.connections.add(self)
        self._owner.accept(self, self._clock())

    def data_received(self, data: bytes) -> None:
        try:
            self.receive(data, self._clock())
        except Exception as error:
            self._owner.fail(error)

    def eof_received(self) -> None:
        # The transport closes only when the client has taken what waits for it; the session ends here and now.
        self._owner.lost(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self._owner.connections.discard(self)
        self._owner.lost(self)

    def pause_writing(self) -> None:
        self._is_paused = True

    def resume_writing(self) -> None:
        self._is_paused = False

    def write(self, data: bytes) -> None:
        """Send, unless the client does not read."""
        if not self._is_paused:
            self._writer.write(data)

    def close(self) -> None:
        self._transport.close()


def survey_robot(cfg: Config, faults: FaultPlan | None = None, start: DeckPose | None = None) -> Robot:
    """The survey robot of a configuration, just booted; at base where no ``start`` is given."""
    return Robot(cfg, build_mirror(cfg.mirror), np.random.default_rng(cfg.run.seed), faults, start)


async def serve(
    cfg: Config | RadioConfig,
    *,
    lockstep: bool,
    stop: asyncio.Event,
    listener: socket.socket,
    truth_rep: str | None = None,
    truth_pub: str | None = None,
    log: ServerLog | None = None,
    faults: FaultPlan | None = None,
    body_file: Path | None = None,
    is_resuming: bool = False,
) -> bool:
    """Run the simulated robot of a configuration until ``stop`` is set; whether it fell.

    ``faults`` of a survey may be those of the robot and of its link; for the link a proxy listens in the robot's place.
    ``body_file`` keeps the true pose of the survey robot between runs. ``zmq.ZMQError``: an endpoint cannot be had.
    """
    robot: SimulatedRobot
    at_work: list[Injector | LinkFaults] = []
    each_frame: list[Callable[[], object]] = []
    async with AsyncExitStack() as stack:
        if isinstance(cfg, RadioConfig):
            robot = build_beacon_robot(cfg)
        else:
            body = None if body_file is None else SimPoseFile(body_file)
            robot = survey_robot(cfg, faults, body.read() if body is not None and is_resuming else None)
            if body is not None:
                stack.callback(body.close)
                each_frame.append(partial(body.keep, robot))
            if robot.injector is not None:
                at_work.append(robot.injector)
        if faults is not None and faults.link:
            behind = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
            proxy = FaultProxy(*behind.getsockname()[:2], seed=cfg.run.seed, listener=listener)
            at_work.append(LinkFaults(faults.link, await stack.enter_async_context(proxy)))
            listener = behind
        server = DataLoop(robot, lockstep=lockstep, key=read_key(cfg.robot.key_file), log=log, faults=at_work)
        truth = GroundTruthPublisher(robot, truth_rep, truth_pub)
        stack.callback(truth.close)
        server.each_frame += [truth.add, *each_frame]
        await server.start(listener)
        async with asyncio.TaskGroup() as tasks:
            answering = tasks.create_task(truth.serve())
            try:
                await server.run(stop)
            finally:
                truth.flush()
                answering.cancel()
        return robot.is_fallen
