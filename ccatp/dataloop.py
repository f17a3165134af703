"""The simulated robots behind the robot link: sockets, the wall clock or lockstep, and the true state beside the link.

The sockets of the robot link carry what a real robot would send and nothing else. The true state leaves by ZeroMQ: a
REP socket with the requests of ``GroundTruthPublisher`` and of the robot, and a PUB socket with rows.

Known limitations: the battery stays full, and nothing fails without a fault plan (``ccatp.sim.fault_injector``).
"""

import asyncio
import secrets
import socket
from collections.abc import Callable
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.models import Config
from ccatp.core import DeckPose
from ccatp.mirror.mirror import build_mirror
from ccatp.sim.beacon_robot import build_beacon_robot
from ccatp.sim.fault_injector import Injector
from ccatp.sim.fault_plan import FaultPlan, Injected
from ccatp.sim.fault_proxy import FaultProxy, LinkFaults
from ccatp.sim.ground_truth import GroundTruthPublisher, SimPoseFile
from ccatp.sim.robot import Robot
from ccatp.sim.rules import SimulatedRobot
from ccatp.sim.sessions import RobotServer, RobotSession

HOUSEKEEPING_S = 0.25
# A client that does not read gets no more frames once this much waits for it; it finds the newest when it reads on.
MAX_UNSENT_BYTES = 1 << 18


class ServerLog(Protocol):
    """A structlog logger, or whatever has this method."""

    def info(self, event: str, **fields: object) -> object:
        """Take one line and its fields."""


class RobotLinkServer:
    """The server of one simulated robot on ``address`` (port 0 = any free port).

    In lockstep simulated time waits for the clients; otherwise the wall clock paces it. Without a ``key`` there is no
    authentication.

    Attributes:
        each_frame: called after each frame, before ``truth`` takes it.
        faults: at work; each fault is logged when it begins and ends, and with what it did.
    """

    def __init__(
        self,
        robot: SimulatedRobot,
        address: tuple[str, int],
        *,
        lockstep: bool,
        key: bytes | None,
        log: ServerLog | None,
    ) -> None:
        self._served, self._address, self._is_lockstep = robot, address, lockstep
        self._key, self._log = key, log
        self._boot = secrets.randbits(31)
        self._listener: asyncio.Server | None = None
        self._timer: asyncio.TimerHandle | None = None
        self.connections: set[Connection] = set()
        self._failure: asyncio.Future[None]
        self.truth: GroundTruthPublisher | None = None
        self.each_frame: list[Callable[[], None]] = []
        self.faults: list[Injector | LinkFaults] = []

    async def start(self, sock: socket.socket | None = None) -> int:
        """Boot and listen on the configured address or on a bound socket; return the port.

        ``OSError``: the address cannot be had.
        """
        loop = asyncio.get_running_loop()
        self._failure = loop.create_future()
        self.server = RobotServer(
            self._served,
            lockstep=self._is_lockstep,
            boot=self._boot,
            key=self._key,
            make_nonce=lambda: secrets.token_hex(16),
            now_s=loop.time(),
            note=self._note,
            on_frame=self._on_frame,
        )
        if sock is None:
            self._listener = await loop.create_server(self.connect, *self._address)
        else:
            self._listener = await loop.create_server(self.connect, sock=sock)
        if not self._is_lockstep:
            self._timer = loop.call_at(self.server.next_frame_s, self._tick)
        return int(self._listener.sockets[0].getsockname()[1])

    def connect(self) -> "Connection":
        """The protocol of a new connection."""
        return Connection(self)

    async def run(self, stop: asyncio.Event) -> None:
        """Serve until ``stop`` is set; ``start`` first unless it was called. An unforeseen error is raised here."""
        if self._listener is None:
            await self.start()
        failure = self._failure
        stopped = asyncio.ensure_future(stop.wait())
        try:
            while not (stopped.done() or failure.done()):
                self.server.check_time(asyncio.get_running_loop().time())
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
        if self._listener is not None:
            self._listener.close()
        for connection in tuple(self.connections):
            connection.close()
        self._finish()
        if self._listener is not None:
            if self._log is not None:
                counts = {"fan_changes": self.server.fan_changes, "oldest_ack_frames": self.server.oldest_ack_frames}
                self._log.info("robot_statistics", **counts, **self.server.counts)
            await self._listener.wait_closed()
            self._listener = None

    def _on_frame(self) -> None:
        for call in self.each_frame:
            call()
        if self.truth is not None:
            self.truth.add()
        for faults in self.faults:
            for what, injected in faults.changes(self._served.t_s):
                self._log_fault(what, injected)

    def _finish(self) -> None:
        """Publish the last true states; log what each fault did."""
        if self.truth is not None:
            self.truth.flush()
        for faults in self.faults:
            if isinstance(faults, LinkFaults):
                faults.changes(self._served.t_s)  # what happened since the last frame
            for injected in faults.injected:
                self._log_fault("injected", injected)

    def _log_fault(self, what: str, injected: Injected) -> None:
        if self._log is not None:
            self._log.info(f"fault_{what}", **injected._asdict())

    def fail(self, error: Exception) -> None:
        """End ``run`` with an unforeseen error."""
        if not self._failure.done():
            self._failure.set_exception(error)

    def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            self.server.tick(loop.time())
        except Exception as error:
            self.fail(error)
            return
        self._timer = loop.call_at(self.server.next_frame_s, self._tick)

    def _note(self, text: str) -> None:
        if self._log is not None:
            self._log.info("robot_session", text=text)


class Connection(asyncio.Protocol):
    """One client of a ``RobotLinkServer``."""

    def __init__(self, owner: RobotLinkServer) -> None:
        self._owner = owner
        self._transport: asyncio.Transport | None = None
        self._session: RobotSession | None = None
        self._is_paused = False
        self._clock = asyncio.get_running_loop().time

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)  # a TCP connection has no other
        self._transport.set_write_buffer_limits(high=MAX_UNSENT_BYTES)
        peer = self._transport.get_extra_info("socket")
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._owner.connections.add(self)
        self._session = self._owner.server.accept(self, self._clock())

    def data_received(self, data: bytes) -> None:
        if self._session is None:
            return
        try:
            self._session.receive(data, self._clock())
        except Exception as error:
            self._owner.fail(error)

    def eof_received(self) -> None:
        # The transport closes only when the client has taken what waits for it; the session ends here and now.
        if self._session is not None:
            self._owner.server.lost(self._session)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._session is not None:
            self._owner.connections.discard(self)
            self._owner.server.lost(self._session)

    def pause_writing(self) -> None:
        self._is_paused = True

    def resume_writing(self) -> None:
        self._is_paused = False

    def write(self, data: bytes) -> None:
        """Send, unless the client does not read."""
        if not self._is_paused and self._transport is not None:
            self._transport.write(data)

    def close(self) -> None:
        """Close when everything is sent."""
        if self._transport is not None:
            self._transport.close()


class DataLoop(RobotLinkServer):
    """The server of the survey robot, with a fault plan; the robot is at base where no ``start`` is given."""

    def __init__(
        self,
        cfg: Config,
        lockstep: bool,
        seed: int,
        key: bytes | None = None,
        log: ServerLog | None = None,
        faults: FaultPlan | None = None,
        start: DeckPose | None = None,
    ) -> None:
        self.robot = Robot(cfg, build_mirror(cfg.mirror), np.random.default_rng(seed), faults, start)
        super().__init__(self.robot, (cfg.sim.robot.host, cfg.sim.robot.port), lockstep=lockstep, key=key, log=log)
        if self.robot.injector is not None:
            self.faults.append(self.robot.injector)


async def serve(
    cfg: Config,
    *,
    lockstep: bool,
    seed: int,
    stop: asyncio.Event,
    listen_sock: socket.socket | None = None,
    truth_rep: str | None = None,
    truth_pub: str | None = None,
    key: bytes | None = None,
    log: ServerLog | None = None,
    faults: FaultPlan | None = None,
    body_file: Path | None = None,
    is_resuming: bool = False,
) -> None:
    """Run a DataLoop until ``stop`` is set.

    ``faults`` may be those of the robot and of its link; for the link a proxy listens in the robot's place.
    ``body_file`` keeps the true pose of the robot between runs. ``OSError``: the address cannot be had;
    ``zmq.ZMQError``: an endpoint cannot be had.
    """
    body = None if body_file is None else SimPoseFile(body_file)
    start = body.read() if body is not None and is_resuming else None
    data_loop = DataLoop(cfg, lockstep, seed, key, log, faults, start)
    if body is not None:
        data_loop.each_frame.append(partial(body.keep, data_loop.robot))
    try:
        async with AsyncExitStack() as stack:
            if faults is not None and faults.link:
                behind = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
                at = cfg.sim.robot.host, cfg.sim.robot.port
                before = listen_sock or stack.enter_context(socket.create_server(at))
                proxy = FaultProxy(*behind.getsockname()[:2], seed=cfg.run.seed, listener=before)
                await stack.enter_async_context(proxy)
                data_loop.faults.append(LinkFaults(faults.link, proxy))
                listen_sock = behind
            truth = GroundTruthPublisher(data_loop.robot, truth_rep, truth_pub)
            await _serve(data_loop, truth, listen_sock, stop)
    finally:
        if body is not None:
            body.close()


async def serve_beacons(
    cfg: RadioConfig,
    *,
    lockstep: bool,
    stop: asyncio.Event,
    listen_sock: socket.socket | None = None,
    truth_rep: str | None = None,
    truth_pub: str | None = None,
    key: bytes | None = None,
    log: ServerLog | None = None,
) -> None:
    """The same with a robot among beacons."""
    robot = build_beacon_robot(cfg)
    server = RobotLinkServer(robot, (cfg.sim.robot.host, cfg.sim.robot.port), lockstep=lockstep, key=key, log=log)
    await _serve(server, GroundTruthPublisher(robot, truth_rep, truth_pub), listen_sock, stop)


async def _serve(
    server: RobotLinkServer, truth: GroundTruthPublisher, listen_sock: socket.socket | None, stop: asyncio.Event
) -> None:
    server.truth = truth
    try:
        await server.start(listen_sock)
        async with asyncio.TaskGroup() as tasks:
            answering = tasks.create_task(truth.serve())
            await server.run(stop)
            answering.cancel()
    finally:
        truth.close()
