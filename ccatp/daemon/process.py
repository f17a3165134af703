"""What every process does at its start: arguments, log file, end with its parent, signals.

Writing a log line never fails: what the disk does not take is dropped and counted.
"""

import argparse
import asyncio
import ctypes
import io
import os
import signal
import sys
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NamedTuple, TextIO, TypeVar, cast

import structlog
import zmq

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.load import is_radio_file, load_config, load_radio_config
from ccatp.config.models import Config
from ccatp.errors import CcatpError


class LogStream(io.TextIOBase):
    """Appends whole lines; several processes may share the file.

    Args:
        process: whose log it is, for the alarm on standard error when the first line is dropped.

    Attributes:
        dropped: lines that are not in the file, or only in part.
    """

    def __init__(self, path: Path, process: str) -> None:
        """Open the file; raises ``OSError`` where it cannot be made."""
        self._path, self._process = path, process
        self._file = path.open("ab", buffering=0)
        self._is_torn = False
        self.dropped = 0

    def write(self, text: str) -> int:
        """Append; always takes all of it."""
        data = text.encode("utf-8", "backslashreplace")
        if self._is_torn:
            data = b"\n" + data
        try:
            written = self._file.write(data)
        except OSError as error:
            self._drop(error.strerror or str(error))
            return len(text)
        if written != len(data):
            self._is_torn = self._is_torn or bool(written)
            self._drop("the disk took a part of a line")
        else:
            self._is_torn = False
        return len(text)

    def _drop(self, why: str) -> None:
        self.dropped += 1
        if self.dropped > 1:
            return
        with suppress(OSError):  # standard error may lie on the same disk
            print(f"ccatp {self._process}: {self._path}: lines are dropped: {why}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


PR_SET_PDEATHSIG = 1
LEVELS = {"info": 20, "warning": 30, "error": 40}
# The event of a line that the operator gets, too; the field ``text`` holds it.
OPERATOR_MESSAGE = "operator_message"
# The copy of the fault plan in the run directory.
FAULTS_FILE = "faults.toml"
# In the runtime directory: the run directory of the run that goes on there, or of the last one.
RUN_DIR_FILE = "run_dir"
# In this variable the supervisor tells its children who it is.
SUPERVISOR_PID = "CCATP_SUPERVISOR_PID"


@dataclass(frozen=True, slots=True)
class Endpoints:
    """ZeroMQ endpoints of one run, all unix sockets in its runtime directory."""

    runtime_dir: Path

    def of(self, name: str) -> str:
        """``ipc://`` endpoint of a name: main, danger, truth, puck, control, emergency."""
        return f"ipc://{self.runtime_dir / name}"


C = TypeVar("C", Config, RadioConfig)


@dataclass(frozen=True)  # no slots: an alias with its type filled in notes that on the instance
class ArgsOf(Generic[C]):
    """What the supervisor tells a process.

    Attributes:
        config: the run's exact configuration, from its run directory.
        listen_fd: an inherited listening socket, or ``None``.
        is_resuming: go on with a mission that stands in the run directory.
        has_faults: a fault plan stands in the run directory; stand-ins only.
        is_restarted: another process of this run has died, and this one takes its place.
        is_sim: robot and laser system are stand-ins.
    """

    config: C
    run_dir: Path
    endpoints: Endpoints
    listen_fd: int | None
    is_realtime: bool
    is_resuming: bool
    has_faults: bool = False
    is_restarted: bool = False
    is_held: bool = False
    is_sim: bool = False

    @property
    def is_taking_over(self) -> bool:
        """Somebody else has been at it before."""
        return self.is_resuming or self.is_restarted


ProcessArgs = ArgsOf[Config]
BeaconArgs = ArgsOf[RadioConfig]


class EitherArgs(NamedTuple):
    """What a process serves: the survey of a mirror or a mission among beacons; the other one is ``None``."""

    survey: ProcessArgs | None
    beacons: BeaconArgs | None

    @property
    def one_of_beacons(self) -> BeaconArgs:
        """Of a mission among beacons, where there is no survey."""
        return cast(BeaconArgs, self.beacons)

    @property
    def one(self) -> ProcessArgs | BeaconArgs:
        """Whichever it is."""
        return self.survey or self.one_of_beacons

    @property
    def is_realtime(self) -> bool:
        """Stand-ins pace on the wall clock."""
        return self.one.is_realtime


def parse_either(argv: list[str] | None = None) -> EitherArgs:
    """As ``parse_args``, for processes that serve missions among beacons, too."""
    run_dir, rest = _split(_parse(argv))
    path = run_dir / "config.toml"
    if is_radio_file(path):
        return EitherArgs(None, ArgsOf(load_radio_config(path), run_dir, **rest))
    return EitherArgs(ArgsOf(load_config(path), run_dir, **rest), None)


def parse_args(argv: list[str] | None = None) -> ProcessArgs:
    """Read the command line of a process and the configuration it names; sockets that it makes are its user's alone."""
    run_dir, rest = _split(_parse(argv))
    return ArgsOf(load_config(run_dir / "config.toml"), run_dir, **rest)


def _parse(argv: list[str] | None) -> argparse.Namespace:
    os.umask(os.umask(0o077) | 0o022)  # to connect to a socket takes the right to write to it
    parser = argparse.ArgumentParser()
    parser.add_argument("--run-dir", type=Path, required=True)
    parser.add_argument("--runtime-dir", type=Path, required=True)
    parser.add_argument("--listen-fd", type=int)
    parser.add_argument("--realtime", action="store_true")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--faults", action="store_true")
    parser.add_argument("--restarted", action="store_true")
    parser.add_argument("--held", action="store_true")
    parser.add_argument("--sim", action="store_true")
    return parser.parse_args(argv)


def _split(args: argparse.Namespace) -> tuple[Path, dict[str, Any]]:
    return args.run_dir, {
        "endpoints": Endpoints(args.runtime_dir),
        "listen_fd": args.listen_fd,
        "is_realtime": args.realtime,
        "is_resuming": args.resume,
        "has_faults": args.faults,
        "is_restarted": args.restarted,
        "is_held": args.held,
        "is_sim": args.sim,
    }


def die_with_parent() -> None:
    """Ask the kernel for SIGTERM when the parent dies: a plain child would survive its parent's ``kill -9``."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.environ.get(SUPERVISOR_PID, str(os.getppid())) != str(os.getppid()):
            raise SystemExit("ccatp: the supervisor is gone")  # it died before we asked


def open_log(path: Path, process: str) -> structlog.typing.FilteringBoundLogger:
    """A logger that appends one JSON object per line to ``path``; several processes may share the file."""
    stream = cast(TextIO, LogStream(path, process))
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True, key="timestamp"),
            structlog.processors.dict_tracebacks,
            structlog.processors.JSONRenderer(),
        ],
        logger_factory=structlog.WriteLoggerFactory(file=stream),
    )
    logger: structlog.typing.FilteringBoundLogger = structlog.get_logger().bind(logger=process)
    return logger


def stop_on_signals(stop: asyncio.Event) -> None:
    """Let SIGTERM and SIGINT set ``stop``."""
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)


async def unless_stopped(stop: asyncio.Event, work: Coroutine[Any, Any, None]) -> bool:
    """Do some work, but leave it as soon as ``stop`` is set; whether it came to its end. Its errors are raised."""
    working, stopping = asyncio.ensure_future(work), asyncio.ensure_future(stop.wait())
    try:
        await asyncio.wait((working, stopping), return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            working.result()
        return working.done()
    finally:
        working.cancel()
        stopping.cancel()
        await asyncio.gather(working, stopping, return_exceptions=True)


async def run_process(
    name: str, serve: Callable[["zmq.Context[zmq.Socket[bytes]]", asyncio.Event], Awaitable[int]]
) -> int:
    """Run ``serve(context, stop)`` to its end; ``stop`` is set by SIGTERM and SIGINT.

    Returns:
        Its exit status, or that of the gravest error that ended it, which is printed.
    """
    stop = asyncio.Event()
    stop_on_signals(stop)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    status = 0
    try:
        status = await serve(context, stop)
    except* CcatpError as group:
        status = report(name, group)
    finally:
        context.destroy(linger=0)
    return status


def report(process: str, group: BaseExceptionGroup[CcatpError]) -> int:
    """Print the expected refusals of a task group, one line each; returns the exit status of the gravest."""
    status = 0
    for error in leaves(group):
        print(f"ccatp {process}: {error}", file=sys.stderr, flush=True)
        status = max(status, int(error.exit_status))
    return status


def leaves(group: BaseExceptionGroup[CcatpError]) -> list[CcatpError]:
    """All errors of a group of groups."""
    found: list[CcatpError] = []
    for error in group.exceptions:
        found += leaves(error) if isinstance(error, BaseExceptionGroup) else [error]
    return found
