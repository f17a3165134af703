"""Starts the processes of a run as forks of one that has imported what all of them need.

``ForkServer`` is the supervisor's end. The server is ``python -m ccatp.daemon.supervision.fork_server``: one thread, no
ZeroMQ context, event loop, database or lock. A process that it forks imports the rest by itself, so it has the modules
that it would have alone, and becomes a child of the supervisor, which outlives the server.
"""

import ctypes
import gc
import importlib
import json
import os
import runpy
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import NamedTuple, Protocol, Self

from ccatp.config.package import child_environment
from ccatp.links.service_manager import VARIABLES

MODULE = "ccatp.daemon.supervision.fork_server"
# What every process of every mission imports; nothing of a mission, nothing that the danger rules must not import.
# SciPy is for the main loop alone, and its longest import: here it takes place beside the imports of the supervisor.
PRELOADED = (
    "ccatp.daemon.supervision.process", "ccatp.links.topics", "numpy", "uvloop", "zmq.asyncio",
    "scipy.linalg", "scipy.special",
)  # fmt: skip
# Environment variable with the supervisor's process number, for its children.
SUPERVISOR_PID = "CCATP_SUPERVISOR_PID"
# The matrices are 4 x 4: threads of the linear algebra would only compete with the processes for the cores. And nothing
# is searched in all installed packages for plugins of the configuration's models.
ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYDANTIC_DISABLE_PLUGINS": "__all__"}
# Until the first process is forked the server imports; a fork takes milliseconds.
FIRST_TIMEOUT_S, TIMEOUT_S = 20.0, 2.0
# Longest pause between two looks for the end of a process.
LONGEST_PAUSE_S = 0.01
PR_SET_CHILD_SUBREAPER = 36
STDERR = 2  # file descriptor
REQUEST_BYTES = 65_536
MOST_DESCRIPTORS = 16
# Room for the command line of a forked process, which takes the place of the server's own.
COMMAND_LINE_BYTES = 512
# Fields of /proc/self/stat, counted behind the name: addresses of the command line (proc(5), fields 48 and 49).
_BEGINS, _ENDS = 45, 46
_GO = b"go"


class ChildProcess(Protocol):
    """A child of the supervisor; ``subprocess.Popen`` is one."""

    @property
    def pid(self) -> int:
        """Process number."""

    def poll(self) -> int | None:
        """Exit status, or minus the number of the signal that killed it; ``None``: it runs."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end. Raises subprocess.TimeoutExpired."""

    def terminate(self) -> None:
        """Send SIGTERM."""

    def kill(self) -> None:
        """Send SIGKILL."""


def environment_of_children(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment of the processes of this supervisor."""
    changed = {**child_environment(environment), **ENVIRONMENT, SUPERVISOR_PID: str(os.getpid())}
    return {name: value for name, value in changed.items() if name not in VARIABLES}


def start_module(module: str, arguments: Sequence[str], fds: Sequence[int] = ()) -> "subprocess.Popen[bytes]":
    """Start ``python -m module`` with these arguments, and descriptors that it inherits."""
    # In its own session, so that Ctrl-C in the terminal reaches only the supervisor, which stops all in order.
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        stdin=subprocess.DEVNULL,
        stdout=STDERR,
        pass_fds=fds,
        start_new_session=True,
        env=environment_of_children(os.environ),
    )


class ForkedProcess:
    """A child that was not started by ``subprocess``."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._code: int | None = None

    def poll(self) -> int | None:
        """As ``ChildProcess.poll``."""
        if self._code is None:
            try:
                pid, status = os.waitpid(self.pid, os.WNOHANG)
            except ChildProcessError:  # SIGCHLD is ignored, so the kernel keeps no status; as in subprocess
                self._code = 0
            else:
                self._code = os.waitstatus_to_exitcode(status) if pid else None
        return self._code

    def wait(self, timeout: float | None = None) -> int:
        """As ``ChildProcess.wait``."""
        deadline_s = float("inf") if timeout is None else time.monotonic() + timeout
        pause_s = 0.0005
        while (code := self.poll()) is None:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
            time.sleep(min(pause_s, left_s))
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
        return code

    def terminate(self) -> None:
        """As ``ChildProcess.terminate``."""
        self._send(15)

    def kill(self) -> None:
        """As ``ChildProcess.kill``."""
        self._send(9)

    def _send(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)


class ForkServer:
    """The server of one supervisor, from construction to ``close``; it imports while the supervisor does."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs, ExitStack() as unless_started:
            unless_started.callback(ours.close)
            arguments = (str(theirs.fileno()), " " * COMMAND_LINE_BYTES)
            self._server = start_module(MODULE, arguments, (theirs.fileno(),))
            unless_started.pop_all()
        self._control, self._timeout_s = ours, FIRST_TIMEOUT_S
        _adopt_orphans(True)

    @property
    def pid(self) -> int:
        """Process number of the server."""
        return self._server.pid

    def start(self, module: str, arguments: Sequence[str], fds: Sequence[int] = ()) -> ForkedProcess | None:
        """As ``start_module``; ``None``: the server has died or does not answer, and is closed."""
        if self._server.returncode is not None:
            return None
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with ours:
            request = json.dumps({"module": module, "arguments": list(arguments), "fds": list(fds)}).encode()
            ours.settimeout(self._timeout_s)
            self._control.settimeout(self._timeout_s)
            try:
                with theirs:
                    socket.send_fds(self._control, [request], [theirs.fileno(), *fds])
                # Without the last message the process ends, so one that comes too late does nothing.
                if (pid := ours.recv(64)) and ours.send(_GO):
                    self._timeout_s = TIMEOUT_S
                    return ForkedProcess(int(pid))
            except OSError:
                pass
        self.close()
        return None

    def close(self) -> None:
        """End the server; its processes go on."""
        self._control.close()
        self._server.kill()
        self._server.wait()
        _adopt_orphans(False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _adopt_orphans(is_adopting: bool) -> None:
    """Become the parent of descendants whose parent ends, or no longer."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, int(is_adopting), 0, 0, 0)


# -- the server --------------------------------------------------------------------------------------------------------


class Request(NamedTuple):
    """A process to be forked: its handshake with the supervisor, received descriptors, and their numbers there."""

    module: str
    arguments: list[str]
    handshake: socket.socket
    received: list[int]
    wanted: list[int]


def main() -> None:
    """Serve until the supervisor closes the control socket; in a forked process run its module."""
    from ccatp.daemon.supervision.process import die_with_parent  # noqa: PLC0415 - the supervisor's end needs none of it

    die_with_parent()
    control = socket.socket(fileno=int(sys.argv[1]))
    for name in PRELOADED:
        importlib.import_module(name)
    gc.freeze()  # the pages of what is there stay shared, and no collection visits it
    with control:
        request = _serve(control)
    if request is not None:
        _become(request)
        runpy.run_module(request.module, run_name="__main__", alter_sys=True)


def _serve(control: socket.socket) -> Request | None:
    """Fork what is requested. Returns the request in a forked process, and ``None`` at the end of the server."""
    while True:
        data, fds, _, _ = socket.recv_fds(control, REQUEST_BYTES, MOST_DESCRIPTORS)
        if not data:
            return None
        message = json.loads(data)
        handshake = socket.socket(fileno=fds[0])
        request = Request(message["module"], message["arguments"], handshake, fds[1:], message["fds"])
        # Twice, because only a process whose parent has ended gets the supervisor as its parent.
        if (pid := os.fork()) == 0:
            between = os.getpid()
            if os.fork():
                os._exit(0)
            while os.getppid() == between:
                time.sleep(0.0005)
            return request
        os.waitpid(pid, 0)
        handshake.close()
        for fd in request.received:
            os.close(fd)


def _become(request: Request) -> None:
    """Make the forked process what ``start_module`` would have started; end it if the supervisor has given up."""
    answer = b""
    with request.handshake as handshake, suppress(OSError):
        if os.getppid() == int(os.environ[SUPERVISOR_PID]):
            handshake.send(b"%d" % os.getpid())
            answer = handshake.recv(64)
    if answer != _GO:
        os._exit(1)
    if (random := sys.modules.get("numpy.random")) is not None:
        random.seed()  # Python seeds only its own generator again
    os.setsid()
    _place(request.received, request.wanted)
    sys.argv = ["", *request.arguments]
    show_command_line([sys.executable, "-m", request.module, *request.arguments])


def _place(received: Sequence[int], wanted: Sequence[int]) -> None:
    """Give received descriptors the numbers that they have in the supervisor, as the arguments name them."""
    import fcntl  # noqa: PLC0415 - for a forked process alone

    apart = [fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, 1 + max(wanted)) for fd in received]
    for fd in received:
        os.close(fd)
    for source, target in zip(apart, wanted, strict=True):
        with suppress(OSError):
            os.fstat(target)
            os.write(2, b"ccatp: descriptor %d of a forked process is in use\n" % target)
            os._exit(1)
        os.dup2(source, target, inheritable=False)
        os.close(source)


def show_command_line(words: Sequence[str]) -> None:
    """Let ``ps`` show these words, as far as the command line of the process has room."""
    if sys.platform != "linux":
        return
    with open("/proc/self/stat", encoding="utf-8", errors="replace") as stat:  # noqa: PTH123 - without pathlib's import
        fields = stat.read().rpartition(")")[2].split()
    begins, room = int(fields[_BEGINS]), int(fields[_ENDS]) - int(fields[_BEGINS])
    text = b"\0".join(map(os.fsencode, words))
    if begins:
        ctypes.memmove(begins, text[: room - 1].ljust(room, b"\0"), room)


if __name__ == "__main__":
    main()
