"""Common base of all processes: arguments, log file, end with the parent, signals, errors.

Writing a log line never fails; lines that the disk does not take are dropped and counted.
"""

import argparse
import asyncio
import ctypes
import gc
import io
import os
import signal
import socket
import sys
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO, cast

import structlog
import uvloop
import zmq

from ccatp.config.files import keep_traceback, read_input
from ccatp.config.load import load_mission
from ccatp.config.mission import CommonConfig
from ccatp.daemon.supervision.fork_server import SUPERVISOR_PID
from ccatp.errors import CcatpError

PR_SET_PDEATHSIG = 1
# Signals that end a run, or the writing of its report.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
BACKLOG = 64  # of listening sockets
# Copy of the fault plan in the run directory.
FAULTS_FILE = "faults.toml"
# In the runtime directory: path of the run directory of the present or the last run.
RUN_DIR_FILE = "run_dir"
# In the runtime directory: host and port of robot, laser system and page of this run, as JSON.
ADDRESSES_FILE = "addresses.json"

# Flags of the command line of a process, and their fields in ``ProcessArgs``.
FLAGS = {
    "--realtime": "is_realtime",
    "--resume": "is_resuming",
    "--faults": "has_faults",
    "--restarted": "is_restarted",
    "--held": "is_held",
    "--sim": "is_sim",
}


@dataclass(frozen=True, slots=True)
class Endpoints:
    """ZeroMQ endpoints of one run, all unix sockets in its runtime directory."""

    runtime_dir: Path

    def of(self, name: str) -> str:
        """``ipc://`` endpoint of a name: main, danger, truth, puck, control, emergency."""
        return f"ipc://{self.runtime_dir / name}"


def run_dir_in(runtime_dir: Path) -> Path | None:
    """The run directory of the present or the last run in a runtime directory; ``None``: not known."""
    try:
        name = read_input(runtime_dir / RUN_DIR_FILE)
    except OSError:
        return None
    # The name is whole with its line end; an empty one would be the present directory.
    return Path(os.fsdecode(name.strip())) if name.strip() and name.endswith(b"\n") else None


@dataclass(frozen=True, slots=True)
class RunContext:
    """What belongs to one run, for everything that works on it."""

    config: CommonConfig
    run_dir: Path
    endpoints: Endpoints
    is_sim: bool  # robot and laser system are simulated
    locks: tuple[int, ...] = ()  # descriptors that every child inherits


@dataclass(frozen=True, slots=True)
class ProcessArgs:
    """Arguments of a process."""

    config: CommonConfig  # from the run directory
    run_dir: Path
    endpoints: Endpoints
    listen_fd: int | None  # an inherited listening socket
    is_realtime: bool
    is_resuming: bool  # continue the mission in the run directory
    has_faults: bool = False  # a fault plan is in the run directory; only for simulators
    is_restarted: bool = False  # replaces a process of this run that died; in a resumed run, after its first frame
    is_held: bool = False
    is_sim: bool = False  # robot and laser system are simulated

    @property
    def run(self) -> RunContext:
        """The run of the process."""
        return RunContext(self.config, self.run_dir, self.endpoints, self.is_sim)

    @property
    def is_taking_over(self) -> bool:
        """Continues the work of another process."""
        return self.is_resuming or self.is_restarted


def start_process(argv: list[str] | None = None) -> ProcessArgs:
    """Arguments of this process. It will end with the supervisor, and only its own user can use its sockets."""
    die_with_parent()
    try:
        args = parse_args(argv)
    except CcatpError as error:
        print(f"ccatp: {error}", file=sys.stderr, flush=True)
        raise SystemExit(int(error.exit_status)) from None

    def report(_kind: type[BaseException], error: BaseException, _trace: TracebackType | None) -> None:
        print(f"ccatp {Path(sys.argv[0]).stem}: {keep_traceback(error, args.run_dir)}", file=sys.stderr, flush=True)

    sys.excepthook = report
    return args


def parse_args(argv: list[str] | None = None) -> ProcessArgs:
    """Read the command line of a process, and its configuration."""
    os.umask(os.umask(0o077) | 0o022)  # connecting to a socket requires the permission to write to it
    parser = argparse.ArgumentParser()
    parser.add_argument("--run-dir", type=Path, required=True)
    parser.add_argument("--runtime-dir", dest="endpoints", type=lambda text: Endpoints(Path(text)), required=True)
    parser.add_argument("--listen-fd", type=int)
    for flag, name in FLAGS.items():
        parser.add_argument(flag, dest=name, action="store_true")
    args = parser.parse_args(argv)
    return ProcessArgs(config=load_mission(args.run_dir / "config.toml"), **vars(args))


def die_with_parent() -> None:
    """Let the kernel send SIGTERM when the parent dies; otherwise a child survives the ``kill -9`` of its parent."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.environ.get(SUPERVISOR_PID, str(os.getppid())) != str(os.getppid()):
            raise SystemExit("ccatp: the supervisor is gone")  # it died before the call


def open_log(path: Path, process: str) -> structlog.typing.FilteringBoundLogger:
    """A logger that appends one JSON object per line to ``path``; several processes may share the file."""
    stream = cast(TextIO, LogStream(path, process))
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True, key="timestamp"),
            # Without values of variables, which may include keys and tokens.
            structlog.processors.ExceptionRenderer(structlog.tracebacks.ExceptionDictTransformer(show_locals=False)),
            structlog.processors.JSONRenderer(),
        ],
        logger_factory=structlog.WriteLoggerFactory(file=stream),
    )
    logger: structlog.typing.FilteringBoundLogger = structlog.get_logger().bind(logger=process)
    return logger


class LogStream(io.TextIOBase):
    """Appends whole lines; several processes may share the file.

    The first dropped line is reported on standard error, with the name ``process``. Raises ``OSError`` if the file
    cannot be created. ``dropped``: number of lines that are not completely in the file.
    """

    def __init__(self, path: Path, process: str) -> None:
        self._path, self._process = path, process
        self._file = path.open("ab", buffering=0)
        self._is_torn = False
        self.dropped = 0

    def write(self, text: str) -> int:
        """Append; never fails."""
        data = text.encode("utf-8", "backslashreplace")
        if self._is_torn:
            data = b"\n" + data
        try:
            written = self._file.write(data)
            why = "" if written == len(data) else "the disk took a part of a line"
            # After a partial line the next one begins with a line feed, also if writes in between failed.
            self._is_torn = written != len(data) and (self._is_torn or bool(written))
        except OSError as error:
            why = error.strerror or str(error)
        if why:
            self.dropped += 1
            if self.dropped == 1:
                with suppress(OSError):  # standard error may lie on the same disk
                    text_of_loss = f"ccatp {self._process}: {self._path}: lines are dropped: {why}"
                    print(text_of_loss, file=sys.stderr, flush=True)
        return len(text)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


async def unless_stopped(stop: asyncio.Event, work: Coroutine[Any, Any, object]) -> bool:
    """Run ``work`` until it ends or ``stop`` is set; returns whether it ended. Its errors are raised."""
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


def listen_at(host: str, port: int) -> socket.socket:
    """A listening socket; raises ``OSError`` whose ``strerror`` says why, without the address."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=BACKLOG)
    except OSError as error:
        error.strerror = str(error.strerror).partition(" (while")[0]  # Python appends the address
        raise


def run_until_stopped(serve: Callable[[asyncio.Event], Coroutine[Any, Any, int]]) -> int:
    """Run ``serve(stop)`` in an event loop to its end; ``stop`` is set by SIGTERM and SIGINT."""

    async def run() -> int:
        stop = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        return await serve(stop)

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        status = runner.run(run())
    gc.freeze()  # otherwise the interpreter visits all objects of the libraries again, which doubles the shutdown time
    return status


def run_process(name: str, serve: Callable[["zmq.Context[zmq.Socket[bytes]]", asyncio.Event], Awaitable[int]]) -> int:
    """As ``run_until_stopped``, with a ZeroMQ context that is closed at the end.

    Expected errors are printed. Returns the exit status, or the highest one of the errors.
    """

    async def run(stop: asyncio.Event) -> int:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        status = 0
        try:
            status = await serve(context, stop)
        except* CcatpError as group:
            for error in _leaves(group):
                print(f"ccatp {name}: {error}", file=sys.stderr, flush=True)
                status = max(status, int(error.exit_status))
        finally:
            context.destroy(linger=0)
        return status

    return run_until_stopped(run)


def _leaves(group: BaseExceptionGroup[CcatpError]) -> list[CcatpError]:
    found: list[CcatpError] = []
    for error in group.exceptions:
        found += _leaves(error) if isinstance(error, BaseExceptionGroup) else [error]
    return found
