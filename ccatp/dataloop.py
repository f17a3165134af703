"""Edge. The DataLoop: the virtual robot behind the robot link, and the outlets of its truth.

The sockets of the robot link carry what a real robot would say and nothing else. The truth leaves by ZeroMQ: a REP
socket with the requests of ``ccatp.sim.truth``, and a PUB socket with batches of the topic ``truth``.

Known limitations: the battery stays full, and nothing fails by itself; a fault plan lets it (``ccatp.sim.faults``).
"""

import asyncio
import socket
from contextlib import AsyncExitStack
from pathlib import Path

import numpy as np

from ccatp.config.models import Config
from ccatp.fault_proxy.proxy import FaultProxy
from ccatp.mirror.mirror import build_mirror
from ccatp.samples import DeckPose
from ccatp.sim.faults.plan import FaultPlan
from ccatp.sim.faults.record import Injected
from ccatp.sim.robot import Robot
from ccatp.sim.truth import TruthLog
from ccatp.stand_ins.body_file import BodyFile
from ccatp.stand_ins.link_faults import LinkFaults
from ccatp.stand_ins.link_server import LinkServer, Log
from ccatp.stand_ins.truth_outlet import TruthOutlet


class DataLoop(LinkServer):
    """The server.

    Args:
        cfg: the configuration.
        lockstep: simulated time waits for the clients; otherwise the wall clock paces it.
        seed: of every random draw.
        key: key of the robot link, ``None`` for no authentication.
        log: takes its lines.
        faults: what shall go wrong with the robot; each is logged when it begins and with what it did.
        start: where the robot stands, if not at base.

    Attributes:
        robot: the robot.
        server: its link.
        truth: who gives the truth away.
        link_faults: who rules the proxy before the link by the robot's clock.
    """

    def __init__(
        self,
        cfg: Config,
        lockstep: bool,
        seed: int,
        key: bytes | None = None,
        log: Log | None = None,
        faults: FaultPlan | None = None,
        start: DeckPose | None = None,
    ) -> None:
        self.robot = Robot(cfg, build_mirror(cfg.mirror), np.random.default_rng(seed), faults, start)
        super().__init__(self.robot, (cfg.sim.robot.host, cfg.sim.robot.port), lockstep=lockstep, key=key, log=log)
        self.body: BodyFile | None = None
        self.truth: TruthOutlet | None = None
        self.link_faults: LinkFaults | None = None

    def on_close(self) -> None:
        """The last truth published, and what became of the faults."""
        if self.truth is not None:
            self.truth.flush()
        if self.robot.injector is not None:
            for injected in self.robot.injector.injected:
                self._log_fault("injected", injected)
        if self.link_faults is not None:
            self.link_faults.tick(self.robot.t_s)  # what happened since the last frame
            for injected in self.link_faults.injected:
                self._log_fault("injected", injected)

    def on_frame(self) -> None:
        """Keep the pose and the truth; faults begin and end."""
        if self.body is not None:
            self.body.keep(self.robot)
        if self.truth is not None:
            self.truth.add()
        if self.robot.injector is not None:
            for what, injected in self.robot.injector.news(self.robot.t_s):
                self._log_fault(what, injected)
        if self.link_faults is not None:
            for what, injected in self.link_faults.tick(self.robot.t_s):
                self._log_fault(what, injected)

    def _log_fault(self, what: str, injected: Injected) -> None:
        if self._log is not None:
            self._log.info(f"fault {what}: {injected.signal} {injected.type}", **injected._asdict())


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
    log: Log | None = None,
    faults: FaultPlan | None = None,
    body_file: Path | None = None,
    is_resuming: bool = False,
) -> None:
    """Run a DataLoop until ``stop`` is set.

    Args:
        cfg: the configuration.
        lockstep: simulated time waits for the clients.
        seed: of every random draw.
        stop: ends it.
        listen_sock: a bound socket instead of the configured address.
        truth_rep: endpoint of the truth's REP socket.
        truth_pub: endpoint of the truth's PUB socket.
        key: key of the robot link, ``None`` for no authentication.
        log: takes its lines.
        faults: what shall go wrong with the robot and its link; for the link a proxy listens in the robot's place.
        body_file: keeps where the robot stands while nobody simulates it.
        is_resuming: the robot stands where the file says.

    Raises:
        OSError: the address cannot be had.
        zmq.ZMQError: an endpoint cannot be had.
    """
    body = None if body_file is None else BodyFile(body_file)
    start = body.read() if body is not None and is_resuming else None
    data_loop = DataLoop(cfg, lockstep, seed, key, log, faults, start)
    data_loop.body = body
    data_loop.truth = outlet = TruthOutlet(TruthLog(data_loop.robot), truth_rep, truth_pub)
    try:
        async with AsyncExitStack() as stack:
            if faults is not None and faults.link:
                listen_sock = await _put_proxy_before(data_loop, faults, cfg, listen_sock, stack)
            await data_loop.start(listen_sock)
            async with asyncio.TaskGroup() as tasks:
                answering = tasks.create_task(outlet.serve())
                await data_loop.run(stop)
                answering.cancel()
    finally:
        outlet.close()
        if body is not None:
            body.close()


async def _put_proxy_before(
    data_loop: DataLoop, faults: FaultPlan, cfg: Config, listen_sock: socket.socket | None, stack: AsyncExitStack
) -> socket.socket:
    """Let a proxy listen where the robot was to; the socket on which the robot listens instead."""
    behind = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
    at = cfg.sim.robot
    before = listen_sock or stack.enter_context(socket.create_server((at.host, at.port)))
    proxy = FaultProxy(*behind.getsockname()[:2], seed=cfg.run.seed, listener=before)
    await stack.enter_async_context(proxy)
    data_loop.link_faults = LinkFaults(faults.link, proxy)
    return behind
