"""The process of the simulated MultiLine server."""

import asyncio
import socket
import sys
from typing import cast

import numpy as np

from ccatp.config.models import Config
from ccatp.core import Vector3
from ccatp.daemon.supervision.child_processes import listen
from ccatp.daemon.supervision.process import FAULTS_FILE, run_until_stopped, start_process
from ccatp.mirror.mirror import build_mirror
from ccatp.sim.etalon_server import EtalonSimulator, FixedPuck, ZmqPuck
from ccatp.sim.fault_plan import FaultPlan, InjectedFault, read_plan
from ccatp.sim.laser import SEED_STREAM


def _run(
    cfg: Config, puck: ZmqPuck | FixedPuck, listener: socket.socket, faults: tuple[InjectedFault, ...] = ()
) -> int:
    mirror = build_mirror(cfg.mirror)

    async def run(stop: asyncio.Event) -> int:
        rng = np.random.default_rng([cfg.run.seed, SEED_STREAM])
        server = EtalonSimulator(cfg.sim.etalon, mirror.channels, mirror.collimators_m, puck, rng=rng)
        server.model.faults = tuple(fault for fault in faults if fault.signal == "laser")
        await server.start(listener)
        try:
            async with asyncio.TaskGroup() as tasks:
                serving = tasks.create_task(server.serve())
                await stop.wait()
                serving.cancel()
        finally:
            await server.close()
            if isinstance(puck, ZmqPuck):
                puck.close()
        return 0

    return run_until_stopped(run)


def main() -> int:
    """Entry of ``python -m ccatp.daemon.loops.sim_etalon``."""
    args = start_process()
    cfg = cast(Config, args.config)  # only the process table of a survey has this process
    plan = read_plan(args.run_dir / FAULTS_FILE, lockstep=not args.is_realtime) if args.has_faults else FaultPlan()
    puck = ZmqPuck(args.endpoints.of("puck"))
    return _run(cfg, puck, socket.socket(fileno=args.listen_fd), plan.faults)


def run_alone(cfg: Config, puck_world_m: Vector3 | None, truth: str | None) -> int:
    """Run only the simulated server, for other controllers, until SIGINT or SIGTERM.

    The puck stands at ``puck_world_m`` (world frame), or follows ``truth``; without both it stands at base.
    """
    mirror, at = build_mirror(cfg.mirror), cfg.sim.etalon
    at_base = mirror.puck_world(mirror.base_pose, cfg.robot.puck_height_m)
    still = FixedPuck(puck_world_m or at_base, step_s=cfg.etalon.measuring_time_s)
    with listen("sim.etalon", at.host, at.port) as listener:
        port = listener.getsockname()[1]
        print(f"ccatp: simulated MultiLine server on {at.host}:{port}", file=sys.stderr, flush=True)
        return _run(cfg, still if truth is None else ZmqPuck(truth), listener)


if __name__ == "__main__":
    sys.exit(main())
