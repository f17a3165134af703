"""The child processes of a run: start, supervision by pidfd and heartbeat, restart policy, stop, listening sockets."""

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from ccatp.config.models import Config, ProcessesConfig
from ccatp.config.package import child_environment
from ccatp.daemon.process import SUPERVISOR_PID
from ccatp.errors import ConfigError, ExitStatus
from ccatp.links.topics import Heartbeat

# It has said why, and would say so again.
FINAL = (ExitStatus.USAGE, ExitStatus.UNREACHABLE)
# As POSIX and Linux number them; what kills processes here.
_SIGNALS = {2: "SIGINT", 3: "SIGQUIT", 6: "SIGABRT", 7: "SIGBUS", 9: "SIGKILL", 11: "SIGSEGV", 15: "SIGTERM"}
# A supervisor that was itself held up for longer than this between two looks has not listened meanwhile.
MAX_POLL_GAP_S = 0.2


class ProcessEnd(Enum):
    """What becomes of the run."""

    RESTART = "restart"
    END = "end"  # with the status of the process
    HELD = "held"  # with status 4
    WITHOUT = "without"  # it goes on without the process


class RestartDecision(NamedTuple):
    """What becomes of the run, and a line for people."""

    end: ProcessEnd
    text: str


class RestartPolicy:
    """Decides over the processes of one run.

    Args:
        limit: each may be restarted so many times ...
    """

    def __init__(self, limit: int, window_s: float) -> None:
        self._limit, self._window_s = limit, window_s
        self._restarts_s: defaultdict[str, deque[float]] = defaultdict(deque)

    def died(
        self, name: str, code: int, now_s: float, *, is_replaceable: bool = True, is_needed: bool = True, why: str = ""
    ) -> RestartDecision:
        """A process has died.

        Args:
            code: exit status, or minus the number of the signal that killed it.
        """
        how = why or (f"was killed by {_signal(-code)}" if code < 0 else f"ended with status {code}")
        if code in FINAL:
            if not is_needed:
                return RestartDecision(ProcessEnd.WITHOUT, f"process {name} {how}: the survey goes on without it")
            return RestartDecision(ProcessEnd.END, f"process {name} {how}")
        if not is_replaceable:
            return RestartDecision(ProcessEnd.HELD, f"process {name} {how}: run ended, wheels held")
        restarts_s = self._restarts_s[name]
        while restarts_s and now_s - restarts_s[0] > self._window_s:
            restarts_s.popleft()
        if len(restarts_s) >= self._limit:
            often = f"more than {self._limit} times within {self._window_s:g} s"
            if not is_needed:
                return RestartDecision(
                    ProcessEnd.WITHOUT, f"process {name} {how}, {often}: the survey goes on without it"
                )
            return RestartDecision(ProcessEnd.HELD, f"process {name} {how}, {often}: run ended, wheels held")
        restarts_s.append(now_s)
        meanwhile = "wheels held meanwhile" if is_needed else "the survey goes on"
        return RestartDecision(ProcessEnd.RESTART, f"process {name} {how}: restarting it, {meanwhile}")


def _signal(number: int) -> str:
    return _SIGNALS.get(number, f"signal {number}")


class SilenceWatch:
    """For how long a process has said nothing while somebody listened."""

    def __init__(self, start_timeout_s: float, hang_timeout_s: float) -> None:
        self._limit_s, self._hang_timeout_s = start_timeout_s, hang_timeout_s
        self._silent_s = 0.0
        self._polled_s: float | None = None

    def reset(self) -> None:
        """It has said something."""
        self._limit_s, self._silent_s = self._hang_timeout_s, 0.0

    def is_hung(self, now_s: float) -> bool:
        """Look once more. Time in which the listener itself stood still does not count."""
        if self._polled_s is not None:
            self._silent_s += min(max(now_s - self._polled_s, 0.0), MAX_POLL_GAP_S)
        self._polled_s = now_s
        return self._silent_s > self._limit_s

    @property
    def text(self) -> str:
        """What is said of one that hangs."""
        return f"sent no heartbeat for {self._limit_s:g} s and was killed"


# The matrices are 4 x 4: threads of the linear algebra would only fight the processes for the cores.
ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
STOP_TIMEOUT_S = 4.0
# Whoever comes last has this long, even where others have used up the time.
LEAST_STOP_S = 1.0
# A loop that was restarted joins within this.
RECOVERY_S = 5.0
Notify = Callable[[str, str], None]


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """One row of the process table.

    Attributes:
        module: run with ``python -m``.
        is_simulator: runs with ``--sim`` only.
        listens: the configuration section with the host and port of its listening socket, bound by the supervisor.
        is_replaceable: another one can take its place when it dies; the simulated robot has no other.
        is_loop: it tells its heartbeat, and hangs when it does not.
        is_needed: the survey does not go on without it.
        hang_timeout_s: says nothing for this long before it hangs, where that is not ``run.hang_timeout_s``.
    """

    name: str
    module: str
    is_simulator: bool = False
    listens: str = ""
    is_replaceable: bool = True
    is_loop: bool = False
    is_needed: bool = True
    niceness: int = 0
    hang_timeout_s: float | None = None


@dataclass(slots=True)
class _Child:
    spec: ProcessSpec
    process: subprocess.Popen[bytes]
    pidfd: int
    watch: SilenceWatch | None
    why_killed: str = ""


class ProcessManager:
    """The processes of one run.

    Args:
        cfg: when one hangs, and how often they are restarted.
        command_of: command line of a process, and the file descriptors that it inherits; told whether it takes the
            place of another one.
        notify_operator: tells the operator (level, text).
    """

    def __init__(
        self,
        cfg: ProcessesConfig,
        command_of: Callable[[ProcessSpec, bool], tuple[list[str], tuple[int, ...]]],
        notify_operator: Notify,
    ) -> None:
        self._cfg, self._command_of, self._notify_operator = cfg, command_of, notify_operator
        self._policy = RestartPolicy(cfg.restart_limit, cfg.restart_window_s)
        self._children: dict[str, _Child] = {}
        self._is_recovering_until_s = 0.0
        self.restarts = 0

    @property
    def fds(self) -> list[int]:
        """Readable when a child has died."""
        return [child.pidfd for child in self._children.values() if child.pidfd >= 0]

    def is_recovering(self, now_s: float) -> bool:
        """Whether one was restarted a short while ago."""
        return now_s < self._is_recovering_until_s

    def start(self, spec: ProcessSpec, *, is_restarted: bool = False) -> None:
        """Start one."""
        arguments, fds = self._command_of(spec, is_restarted)
        # Their own session: a Ctrl-C in the terminal reaches the supervisor alone, which stops them in order.
        process = subprocess.Popen(
            [sys.executable, "-m", spec.module, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=sys.stderr,
            pass_fds=fds,
            start_new_session=True,
            env={**child_environment(os.environ), **ENVIRONMENT, SUPERVISOR_PID: str(os.getpid())},
        )
        pidfd = os.pidfd_open(process.pid) if hasattr(os, "pidfd_open") else -1
        if spec.niceness:
            _be_nice(process.pid, spec.niceness)
        hang_timeout_s = spec.hang_timeout_s or self._cfg.hang_timeout_s
        watch = SilenceWatch(max(self._cfg.start_timeout_s, hang_timeout_s), hang_timeout_s) if spec.is_loop else None
        self._children[spec.name] = _Child(spec, process, pidfd, watch)

    def on_heartbeat(self, heartbeat: Heartbeat) -> None:
        """A process has told its heartbeat; words of one that is dead do not count."""
        child = self._children.get(heartbeat.process)
        if child is not None and child.watch is not None and child.process.pid == heartbeat.pid:
            child.watch.reset()

    def poll(self, now_s: float) -> tuple[str, int, RestartDecision] | None:
        """Bury the dead, kill who hangs, and start anew.

        Returns:
            The process that ends the run, with its exit code, or ``None``.
        """
        for name, child in tuple(self._children.items()):
            if child.process.poll() is None:
                if child.watch is not None and not child.why_killed and child.watch.is_hung(now_s):
                    child.why_killed = child.watch.text
                    child.process.kill()  # also one that is stopped dies of it, and is found dead at the next look
                continue
            code = child.process.returncode
            spec = child.spec
            decision = self._policy.died(
                name,
                code,
                now_s,
                is_replaceable=spec.is_replaceable,
                is_needed=spec.is_needed,
                why=child.why_killed,
            )
            if decision.end not in (ProcessEnd.RESTART, ProcessEnd.WITHOUT):
                return name, code, decision
            self._notify_operator("warning", decision.text)
            self._forget(child)
            if decision.end is ProcessEnd.WITHOUT:
                del self._children[name]
                continue
            self.restarts += 1
            if spec.is_needed:
                self._is_recovering_until_s = now_s + self._cfg.hang_timeout_s + RECOVERY_S
            self.start(spec, is_restarted=True)
        return None

    def _forget(self, child: _Child) -> None:
        if child.pidfd >= 0:
            os.close(child.pidfd)
            child.pidfd = -1

    def stop_all(self) -> None:
        """Ask each to end, the last one started first; a deadline for all of them together."""
        deadline_s = time.monotonic() + STOP_TIMEOUT_S
        for name, child in reversed(self._children.items()):
            process = child.process
            if process.poll() is not None:
                continue
            process.terminate()
            try:
                process.wait(max(deadline_s - time.monotonic(), LEAST_STOP_S))
            except subprocess.TimeoutExpired:
                self._notify_operator(
                    "error", f"process {name} did not stop within {STOP_TIMEOUT_S:g} s and was killed"
                )
                process.kill()
                process.wait()

    def kill_all(self) -> None:
        """End whoever is left."""
        for child in self._children.values():
            if child.process.poll() is None:
                child.process.kill()
                child.process.wait()
            self._forget(child)


def _be_nice(pid: int, niceness: int) -> None:
    """From outside, so that it holds before the process has read its first module."""
    with contextlib.suppress(OSError):  # it has ended already
        os.setpriority(os.PRIO_PROCESS, pid, os.getpriority(os.PRIO_PROCESS, 0) + niceness)


@contextmanager
def listen(section: str, host: str, port: int) -> Iterator[socket.socket]:
    """A listening socket for a process that inherits it.

    Args:
        host, port: the address; port 0 takes any that is free.

    Raises:
        ConfigError: the port is taken.
    """
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
        except OSError as error:
            raise ConfigError(
                f"{section}.port: cannot listen on {host}:{port}: {error.strerror}; "
                f"stop who uses it, or choose another with --set {section}.port=0 (0 = any free port)"
            ) from error
        listener.listen(16)
        yield listener


def simulator_addresses(cfg: Config) -> dict[str, tuple[str, int]]:
    """Where the stand-ins shall listen, (host, port) by the section of the configuration."""
    robot, etalon = cfg.sim.robot, cfg.sim.etalon
    return {"sim.robot": (robot.host, robot.port), "sim.etalon": (etalon.host, etalon.port)}


def with_addresses(cfg: Config, sockets: Mapping[str, socket.socket]) -> Config:
    """The configuration with the addresses at which the stand-ins really listen."""

    def at(process: str) -> dict[str, object]:
        host, port = sockets[process].getsockname()
        return {"host": host, "port": port}

    robot, etalon = at("dataloop"), at("etalon")
    sim = {
        "robot": cfg.sim.robot.model_copy(update=robot),
        "etalon": cfg.sim.etalon.model_copy(update=etalon),
    }
    return cfg.model_copy(
        update={
            "robot": cfg.robot.model_copy(update=robot),
            "etalon": cfg.etalon.model_copy(update=etalon),
            "sim": cfg.sim.model_copy(update=sim),
        }
    )
