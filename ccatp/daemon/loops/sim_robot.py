"""The process of the simulated robot."""

import asyncio
import os
import socket
import sys
from pathlib import Path

import structlog

from ccatp.config.mission import CommonConfig
from ccatp.daemon.supervision.child_processes import listen
from ccatp.daemon.supervision.process import FAULTS_FILE, Endpoints, open_log, run_until_stopped, start_process
from ccatp.dataloop import SimOutlets, StandInOptions, serve
from ccatp.errors import ExitStatus
from ccatp.links.runtime_dir import TRUTH_LOCK_FILE, locked, make_runtime_dir, remove_sockets
from ccatp.missions import kind_of
from ccatp.sim.fault_plan import FaultPlan, read_plan
from ccatp.sim.ground_truth import ROBOT_FILE


def main() -> int:
    """Entry of ``python -m ccatp.daemon.loops.sim_robot``."""
    args = start_process()
    cfg, lockstep = args.config, not args.is_realtime
    plan = read_plan(args.run_dir / FAULTS_FILE, lockstep=lockstep) if args.has_faults else None
    options = StandInOptions(plan, args.run_dir / ROBOT_FILE, args.is_resuming)

    async def run(stop: asyncio.Event) -> int:
        listener = socket.socket(fileno=args.listen_fd)
        log = open_log(args.run_dir / "log.jsonl", "dataloop")
        outlets = SimOutlets(args.endpoints.of("puck"), args.endpoints.of("truth"), log)
        await serve(cfg, options, lockstep=lockstep, stop=stop, listener=listener, outlets=outlets)
        return 0

    return run_until_stopped(run)


def run_alone(
    cfg: CommonConfig, lockstep: bool, faults: FaultPlan | None = None, runtime_dir: Path | None = None
) -> int:
    """Run only the simulated robot of any mission, for other controllers, until SIGINT or SIGTERM.

    It listens at the address in ``sim.robot``. The link does not report a fall: standard error has its time and place
    (``robot_fell``), and the status is that of a fault. The true state is available at ``puck`` in the runtime
    directory (by default the configured one), for ``ccatp sim etalon --truth``. ConfigError: it cannot listen there;
    RefusedError: another simulated robot uses that directory.
    """
    folder = make_runtime_dir(str(runtime_dir or cfg.processes.runtime_dir), os.environ)
    truth, what = Endpoints(folder).of("puck"), kind_of(cfg).text.get()(cfg).subject
    at, log = cfg.sim.robot, structlog.wrap_logger(structlog.PrintLogger(sys.stderr))
    refusal = f"another simulated robot uses {folder}; end it, or give this one its own --runtime-dir"
    with locked(folder / TRUTH_LOCK_FILE, refusal), listen("sim.robot", at.host, at.port) as listener:

        async def run(stop: asyncio.Event) -> int:
            options, outlets = StandInOptions(faults), SimOutlets(truth_rep=truth, log=log)
            has_fallen = await serve(cfg, options, lockstep=lockstep, stop=stop, listener=listener, outlets=outlets)
            if has_fallen:
                print("ccatp: the simulated robot fell; robot_fell above says why, when and where", file=sys.stderr)
            return ExitStatus.HELD if has_fallen else ExitStatus.COMPLETE

        host, port = listener.getsockname()[:2]
        print(f"ccatp: simulated robot ({what}) on {host}:{port}, truth at {truth}", file=sys.stderr, flush=True)
        try:
            return run_until_stopped(run)
        finally:
            remove_sockets(folder, ("puck",))


if __name__ == "__main__":
    sys.exit(main())
