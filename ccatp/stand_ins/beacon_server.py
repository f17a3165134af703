"""Edge. The simulated robot among beacons behind the robot link, and the outlet of its truth."""

import asyncio
import socket

from ccatp.config.radio_models import RadioConfig
from ccatp.sim.beacon_truth import BeaconTruthLog
from ccatp.sim.beacon_world import build_beacon_robot, motes_of
from ccatp.stand_ins.link_server import LinkServer, Log
from ccatp.stand_ins.truth_outlet import TruthOutlet


class BeaconLoop(LinkServer):
    """The server.

    Args:
        cfg: the configuration.
        lockstep: simulated time waits for the clients; otherwise the wall clock paces it.
        key: key of the robot link, ``None`` for no authentication.
        log: takes its lines.

    Attributes:
        robot: the robot.
        truth: who gives the truth away.
    """

    def __init__(self, cfg: RadioConfig, *, lockstep: bool, key: bytes | None, log: Log | None) -> None:
        self.robot = build_beacon_robot(cfg)
        super().__init__(self.robot, (cfg.sim.robot.host, cfg.sim.robot.port), lockstep=lockstep, key=key, log=log)
        self.truth: TruthOutlet | None = None

    def on_frame(self) -> None:
        """Keep the truth."""
        if self.truth is not None:
            self.truth.add()

    def on_close(self) -> None:
        """The last truth published."""
        if self.truth is not None:
            self.truth.flush()


async def serve_beacons(
    cfg: RadioConfig,
    *,
    lockstep: bool,
    stop: asyncio.Event,
    listen_sock: socket.socket | None = None,
    truth_rep: str | None = None,
    truth_pub: str | None = None,
    key: bytes | None = None,
    log: Log | None = None,
) -> None:
    """Run a robot among beacons until ``stop`` is set.

    Args:
        cfg: the configuration.
        lockstep: simulated time waits for the clients.
        stop: ends it.
        listen_sock: a bound socket instead of the configured address.
        truth_rep: endpoint of the truth's REP socket.
        truth_pub: endpoint of the truth's PUB socket.
        key: key of the robot link, ``None`` for no authentication.
        log: takes its lines.

    Raises:
        OSError: the address cannot be had.
        zmq.ZMQError: an endpoint cannot be had.
    """
    loop = BeaconLoop(cfg, lockstep=lockstep, key=key, log=log)
    loop.truth = outlet = TruthOutlet(BeaconTruthLog(loop.robot, motes_of(cfg)), truth_rep, truth_pub)
    try:
        await loop.start(listen_sock)
        async with asyncio.TaskGroup() as tasks:
            answering = tasks.create_task(outlet.serve())
            await loop.run(stop)
            answering.cancel()
    finally:
        outlet.close()
