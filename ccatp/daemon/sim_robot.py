"""The process of the simulated robot behind the robot link."""

import asyncio
import os
import socket
import sys
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import structlog

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.models import Config
from ccatp.daemon import realtime
from ccatp.daemon.process import FAULTS_FILE, Endpoints, open_log, start_process, stop_on_signals
from ccatp.dataloop import serve, serve_beacons
from ccatp.errors import ConfigError
from ccatp.links.robot_link import read_key
from ccatp.links.runtime_dir import TRUTH_LOCK_FILE, locked, make_runtime_dir, remove_sockets
from ccatp.sim.fault_plan import FaultPlan, read_plan
from ccatp.sim.ground_truth import FILE

Serve = Callable[..., Coroutine[Any, Any, None]]


def main() -> int:
    """Entry of ``python -m ccatp.daemon.sim_robot``."""
    args = start_process()
    cfg = args.config
    serve_robot: Serve
    if isinstance(cfg, RadioConfig):
        serve_robot = partial(serve_beacons, cfg)
    else:
        plan = args.run_dir / FAULTS_FILE
        serve_robot = partial(
            serve,
            cfg,
            seed=cfg.run.seed,
            faults=read_plan(plan, lockstep=not args.is_realtime) if args.has_faults else None,
            body_file=args.run_dir / FILE,
            is_resuming=args.is_resuming,
        )

    async def run() -> int:
        stop = asyncio.Event()
        stop_on_signals(stop)
        await serve_robot(
            lockstep=not args.is_realtime,
            stop=stop,
            listen_sock=socket.socket(fileno=args.listen_fd),
            truth_rep=args.endpoints.of("puck"),
            truth_pub=args.endpoints.of("truth"),
            key=read_key(cfg.robot.key_file),
            log=open_log(args.run_dir / "log.jsonl", "dataloop"),
        )
        return 0

    return realtime.run(run(), is_spinning=not args.is_realtime)


def run_alone(cfg: Config, lockstep: bool, faults: FaultPlan | None = None, runtime_dir: Path | None = None) -> int:
    """The simulated robot alone, for other controllers; ends on SIGINT or SIGTERM.

    It listens at the address in ``sim.robot``. Its true state is at ``puck`` in the runtime directory (the configured
    one by default), for ``ccatp sim etalon --truth``.

    Raises:
        RefusedError: another simulated robot uses that directory.
    """
    serve_robot = partial(serve, cfg, seed=cfg.run.seed, faults=faults)
    return _run_alone(serve_robot, cfg, cfg.mirror.name, lockstep, str(runtime_dir or cfg.run.runtime_dir))


def run_beacons_alone(cfg: RadioConfig, lockstep: bool, runtime_dir: Path | None = None) -> int:
    """The same of a robot among beacons."""
    folder = str(runtime_dir or cfg.processes.runtime_dir)
    return _run_alone(partial(serve_beacons, cfg), cfg, cfg.system, lockstep, folder)


def _run_alone(serve_robot: Serve, cfg: Config | RadioConfig, what: str, lockstep: bool, runtime_dir: str) -> int:
    async def run(listener: socket.socket, truth: str) -> None:
        stop = asyncio.Event()
        stop_on_signals(stop)
        key, log = read_key(cfg.robot.key_file), structlog.wrap_logger(structlog.PrintLogger(sys.stderr))
        await serve_robot(lockstep=lockstep, stop=stop, listen_sock=listener, truth_rep=truth, key=key, log=log)

    with (
        _truth_endpoint(runtime_dir) as truth,
        _listener(cfg.sim.robot.host, cfg.sim.robot.port) as listener,
    ):
        host, port = listener.getsockname()[:2]
        print(f"ccatp: simulated robot ({what}) on {host}:{port}, truth at {truth}", file=sys.stderr, flush=True)
        asyncio.run(run(listener, truth))
    return 0


@contextmanager
def _truth_endpoint(runtime_dir: str) -> Iterator[str]:
    folder = make_runtime_dir(runtime_dir, os.environ)
    refusal = f"another simulated robot uses {folder}; end it, or give this one its own --runtime-dir"
    with locked(folder / TRUTH_LOCK_FILE, refusal):
        try:
            yield Endpoints(folder).of("puck")
        finally:
            remove_sockets(folder, ("puck",))


def _listener(host: str, port: int) -> socket.socket:
    try:
        return socket.create_server((host, port), reuse_port=False)
    except OSError as error:
        raise ConfigError(
            f"sim.robot.port: cannot listen on {host}:{port}: {error.strerror}; choose another with --port"
        ) from error


if __name__ == "__main__":
    sys.exit(main())
