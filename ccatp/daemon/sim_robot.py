"""The DataLoop's process: the robot's stand-in behind the robot link."""

import asyncio
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import structlog

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.models import Config
from ccatp.daemon import realtime as spinning
from ccatp.daemon.process import (
    FAULTS_FILE,
    BeaconArgs,
    Endpoints,
    die_with_parent,
    open_log,
    parse_either,
    stop_on_signals,
)
from ccatp.dataloop import serve
from ccatp.errors import ConfigError
from ccatp.links.robot_link import read_key
from ccatp.links.runtime_dir import TRUTH_LOCK_FILE, locked, make_runtime_dir, remove_sockets
from ccatp.sim.fault_plan import FaultPlan
from ccatp.sim.ground_truth import FILE, read_plan


def main() -> int:
    """Entry of ``python -m ccatp.daemon.sim_robot``."""
    die_with_parent()
    either = parse_either()
    if either.survey is None:
        return _among_beacons(either.one_of_beacons)
    args = either.survey
    cfg = args.config
    faults = read_plan(args.run_dir / FAULTS_FILE, lockstep=not args.is_realtime) if args.has_faults else None
    if not args.is_realtime:
        spinning.leave_a_core(os.getppid())

    async def run() -> int:
        stop = asyncio.Event()
        stop_on_signals(stop)
        await serve(
            cfg,
            lockstep=not args.is_realtime,
            seed=cfg.run.seed,
            stop=stop,
            listen_sock=socket.socket(fileno=args.listen_fd),
            truth_rep=args.endpoints.of("puck"),
            truth_pub=args.endpoints.of("truth"),
            key=read_key(cfg.robot.key_file),
            log=open_log(args.run_dir / "log.jsonl", "dataloop"),
            faults=faults,
            body_file=args.run_dir / FILE,
            is_resuming=args.is_resuming,
        )
        return 0

    return spinning.run(run(), is_spinning=not args.is_realtime)


def _among_beacons(args: BeaconArgs) -> int:
    from ccatp.dataloop import serve_beacons  # noqa: PLC0415 - a survey starts sooner without it

    if not args.is_realtime:
        spinning.leave_a_core(os.getppid())

    async def run() -> int:
        stop = asyncio.Event()
        stop_on_signals(stop)
        await serve_beacons(
            args.config,
            lockstep=not args.is_realtime,
            stop=stop,
            listen_sock=socket.socket(fileno=args.listen_fd),
            truth_rep=args.endpoints.of("puck"),
            truth_pub=args.endpoints.of("truth"),
            key=read_key(args.config.robot.key_file),
            log=open_log(args.run_dir / "log.jsonl", "dataloop"),
        )
        return 0

    return spinning.run(run(), is_spinning=not args.is_realtime)


def run_alone(cfg: Config, lockstep: bool, faults: FaultPlan | None = None, runtime_dir: Path | None = None) -> int:
    """The stand-in alone, for other people's controllers; ends on SIGINT or SIGTERM.

    Its truth is at ``puck`` in the runtime directory, for ``ccatp sim etalon --truth``.

    Args:
        cfg: configuration; ``sim.robot`` holds the address.
        runtime_dir: where its truth is, if not in the configured folder.

    Raises:
        RefusedError: another one has its truth there.
    """

    async def run(listener: socket.socket, truth: str) -> None:
        stop = asyncio.Event()
        stop_on_signals(stop)
        await serve(
            cfg,
            lockstep=lockstep,
            seed=cfg.run.seed,
            stop=stop,
            listen_sock=listener,
            truth_rep=truth,
            key=read_key(cfg.robot.key_file),
            log=_plain_log(),
            faults=faults,
        )

    with (
        _truth_outlet(runtime_dir, cfg.run.runtime_dir) as truth,
        _listener(cfg.sim.robot.host, cfg.sim.robot.port) as listener,
    ):
        _say_where(cfg.mirror.name, listener, truth)
        asyncio.run(run(listener, truth))
    return 0


def run_beacons_alone(cfg: RadioConfig, lockstep: bool, runtime_dir: Path | None = None) -> int:
    """The same of a robot among beacons."""
    from ccatp.dataloop import serve_beacons  # noqa: PLC0415 - a survey starts sooner without it

    async def run(listener: socket.socket, truth: str) -> None:
        stop = asyncio.Event()
        stop_on_signals(stop)
        key, log = read_key(cfg.robot.key_file), _plain_log()
        await serve_beacons(cfg, lockstep=lockstep, stop=stop, listen_sock=listener, truth_rep=truth, key=key, log=log)

    with (
        _truth_outlet(runtime_dir, cfg.processes.runtime_dir) as truth,
        _listener(cfg.sim.robot.host, cfg.sim.robot.port) as listener,
    ):
        _say_where(cfg.system, listener, truth)
        asyncio.run(run(listener, truth))
    return 0


@contextmanager
def _truth_outlet(runtime_dir: Path | None, configured: str) -> Iterator[str]:
    folder = make_runtime_dir(str(runtime_dir or configured), os.environ)
    refusal = f"another simulated robot has its truth in {folder}; end it, or give this one its own --runtime-dir"
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


def _say_where(what: str, listener: socket.socket, truth: str) -> None:
    host, port = listener.getsockname()[:2]
    print(f"ccatp: robot stand-in ({what}) on {host}:{port}, truth at {truth}", file=sys.stderr, flush=True)


def _plain_log() -> structlog.typing.FilteringBoundLogger:
    log: structlog.typing.FilteringBoundLogger = structlog.wrap_logger(structlog.PrintLogger(sys.stderr))
    return log


if __name__ == "__main__":
    sys.exit(main())
