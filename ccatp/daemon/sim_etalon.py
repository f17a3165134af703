"""The process of the simulated MultiLine server."""

import asyncio
import socket
import sys

import numpy as np

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.models import Config
from ccatp.core import Vector3
from ccatp.daemon.process import start_process, stop_on_signals
from ccatp.errors import ConfigError
from ccatp.mirror.mirror import build_mirror
from ccatp.sim.etalon_server import EtalonSimulator, FixedPuck, PuckSource, ZmqPuck
from ccatp.sim.laser import SEED_STREAM


async def _serve(cfg: Config, truth: PuckSource, listener: socket.socket | None, stop: asyncio.Event) -> None:
    mirror = build_mirror(cfg.mirror)
    server = EtalonSimulator(
        cfg.sim.etalon,
        mirror.channels,
        mirror.collimators_m,
        truth,
        np.random.default_rng([cfg.run.seed, SEED_STREAM]),
        measuring_time_s=cfg.etalon.measuring_time_s,
    )
    try:
        port = await server.start(cfg.sim.etalon.host, cfg.sim.etalon.port, listener)
    except OSError as error:
        at = f"{cfg.sim.etalon.host}:{cfg.sim.etalon.port}"
        raise ConfigError(
            f"sim.etalon.port: cannot listen on {at}: {error.strerror}; choose another with --port"
        ) from error
    if listener is None:
        print(f"ccatp: simulated MultiLine server on {cfg.sim.etalon.host}:{port}", file=sys.stderr, flush=True)
    try:
        async with asyncio.TaskGroup() as tasks:
            serving = tasks.create_task(server.serve())
            await stop.wait()
            serving.cancel()
    finally:
        await server.close()


def main() -> int:
    """Entry of ``python -m ccatp.daemon.sim_etalon``."""
    args = start_process()
    cfg = args.config
    if isinstance(cfg, RadioConfig):
        raise TypeError("a mission among beacons has no laser system")

    async def run() -> None:
        stop = asyncio.Event()
        stop_on_signals(stop)
        truth = ZmqPuck(args.endpoints.of("puck"))
        try:
            await _serve(cfg, truth, socket.socket(fileno=args.listen_fd), stop)
        finally:
            truth.close()

    asyncio.run(run())
    return 0


def run_alone(cfg: Config, puck_world_m: Vector3 | None, truth: str | None) -> int:
    """The simulated server alone, for other controllers; ends on SIGINT or SIGTERM.

    The puck stands still at ``puck_world_m`` (world frame), or follows ``truth``; at base where neither is given.
    """

    async def run() -> None:
        stop = asyncio.Event()
        stop_on_signals(stop)
        if truth is not None:
            source: ZmqPuck | FixedPuck = ZmqPuck(truth)
        else:
            mirror = build_mirror(cfg.mirror)
            at_base = mirror.puck_world(mirror.base_pose, cfg.robot.puck_height_m)
            source = FixedPuck(puck_world_m or at_base, step_s=cfg.etalon.measuring_time_s)
        try:
            await _serve(cfg, source, None, stop)
        finally:
            if isinstance(source, ZmqPuck):
                source.close()

    asyncio.run(run())
    return 0


if __name__ == "__main__":
    sys.exit(main())
