"""The child processes of a run: start, supervision by heartbeat, restart policy, stop, listening sockets."""

import errno
import os
import socket
import subprocess
import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

from ccatp.config.load import load_mission
from ccatp.config.mission import CommonConfig
from ccatp.config.models import DashboardConfig, ProcessesConfig
from ccatp.daemon.supervision.fork_server import ChildProcess, start_module
from ccatp.daemon.supervision.process import listen_at, run_dir_in
from ccatp.errors import ConfigError, ExitStatus
from ccatp.links.topics import Heartbeat
from ccatp.missions import kind_of
from ccatp.report.dashboard.access import TOKEN_FILE

# Exit statuses after which a restart would end in the same way; the process has reported the reason.
FINAL = (ExitStatus.USAGE, ExitStatus.UNREACHABLE)
# Signals that kill processes, with their numbers in POSIX and Linux.
_SIGNALS = {2: "SIGINT", 3: "SIGQUIT", 6: "SIGABRT", 7: "SIGBUS", 9: "SIGKILL", 11: "SIGSEGV", 15: "SIGTERM"}
# In a longer time between two polls the supervisor itself was blocked and received nothing.
MAX_POLL_GAP_S = 0.2
STOP_TIMEOUT_S = 4.0
# Each process has at least this time to stop, even if others have used up the deadline.
LEAST_STOP_S = 1.0
# A restarted loop joins the robot within this time.
RECOVERY_S = 5.0


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """One row of the process table."""

    name: str
    module: str  # run with ``python -m``
    is_simulator: bool = False  # runs only with ``--sim``
    listens: str = ""  # section with host and port of its listening socket, which the supervisor binds
    is_replaceable: bool = True  # can be restarted when it dies; the simulated robot cannot
    is_loop: bool = False  # publishes a heartbeat; without it, the process hangs
    is_needed: bool = True  # the survey cannot continue without it
    niceness: int = 0
    hang_timeout_s: float | None = None  # None: ``run.hang_timeout_s``


class ProcessEnd(Enum):
    """Consequence of a process's death for the run."""

    RESTART = "restart"
    END = "end"  # with the status of the process
    HELD = "held"  # with status 4
    WITHOUT = "without"  # the run continues without the process


class ChildDeath(NamedTuple):
    """A dead process: exit status, or minus the signal; the consequence for the run; a line for the operator."""

    name: str
    code: int
    end: ProcessEnd
    text: str


class RestartPolicy:
    """Decides on restarts in one run; each process may be restarted ``limit`` times within ``window_s``."""

    def __init__(self, limit: int, window_s: float) -> None:
        self._limit, self._window_s = limit, window_s
        self._restarts_s: defaultdict[str, deque[float]] = defaultdict(deque)

    def died(self, spec: ProcessSpec, code: int, now_s: float, why: str = "") -> ChildDeath:
        """Decide after the death of a process; ``code``: exit status, or minus the number of the killing signal."""
        return ChildDeath(spec.name, code, *self._consequence(spec, code, now_s, why))

    def _consequence(self, spec: ProcessSpec, code: int, now_s: float, why: str) -> tuple[ProcessEnd, str]:
        how = f"was killed by {_SIGNALS.get(-code, f'signal {-code}')}" if code < 0 else f"ended with status {code}"
        what = f"process {spec.name} {why or how}"
        is_final = code in FINAL
        if not is_final and spec.is_replaceable:
            restarts_s = self._restarts_s[spec.name]
            while restarts_s and now_s - restarts_s[0] > self._window_s:
                restarts_s.popleft()
            if len(restarts_s) < self._limit:
                restarts_s.append(now_s)
                held = "wheels held meanwhile" if spec.is_loop else "measurements wait for it"
                meanwhile = held if spec.is_needed else "the survey continues"
                return ProcessEnd.RESTART, f"{what}: restarting it, {meanwhile}"
            what += f", more than {self._limit} times within {self._window_s:g} s"
        if not spec.is_needed:
            return ProcessEnd.WITHOUT, f"{what}: the survey continues without it"
        return (ProcessEnd.END, what) if is_final else (ProcessEnd.HELD, f"{what}: run ended, wheels held")


class SilenceWatch:
    """Time since the last heartbeat of a process, without the time in which the supervisor was blocked."""

    def __init__(self, start_timeout_s: float, hang_timeout_s: float) -> None:
        self._limit_s, self._hang_timeout_s = start_timeout_s, hang_timeout_s
        self._silent_s = 0.0
        self._polled_s: float | None = None

    def reset(self) -> None:
        """A heartbeat was received."""
        self._limit_s, self._silent_s = self._hang_timeout_s, 0.0

    def is_hung(self, now_s: float) -> bool:
        """Poll: whether the process has been silent for too long."""
        if self._polled_s is not None:
            self._silent_s += min(max(now_s - self._polled_s, 0.0), MAX_POLL_GAP_S)
        self._polled_s = now_s
        return self._silent_s > self._limit_s

    @property
    def text(self) -> str:
        """Message for a process that hangs."""
        return f"sent no heartbeat for {self._limit_s:g} s and was killed"


@dataclass(slots=True)
class _Child:
    spec: ProcessSpec
    process: ChildProcess
    watch: SilenceWatch | None
    why_killed: str = ""


class ProcessManager:
    """The processes of one run.

    ``cfg``: time-outs and restart limits. ``command_of``: command line of a process (restarted or not), and the file
    descriptors that it inherits. ``notify_operator``: called with level and text. ``start``: starts a module with
    arguments and descriptors.
    """

    def __init__(
        self,
        cfg: ProcessesConfig,
        command_of: Callable[[ProcessSpec, bool], tuple[list[str], tuple[int, ...]]],
        notify_operator: Callable[[str, str], None],
        start: Callable[[str, Sequence[str], Sequence[int]], ChildProcess] = start_module,
    ) -> None:
        self._cfg = cfg
        self._start = start
        self._command_of = command_of
        self._notify_operator = notify_operator
        self._policy = RestartPolicy(cfg.restart_limit, cfg.restart_window_s)
        self._children: dict[str, _Child] = {}
        self._niceness = os.getpriority(os.PRIO_PROCESS, 0)
        self._is_recovering_until_s = 0.0
        self.restarts = 0

    def is_recovering(self, now_s: float) -> bool:
        """Whether a process was restarted a short time ago."""
        return now_s < self._is_recovering_until_s

    def start(self, spec: ProcessSpec, *, is_restarted: bool = False) -> None:
        """Start a process."""
        arguments, fds = self._command_of(spec, is_restarted)
        process = self._start(spec.module, arguments, fds)
        # Set from here, so that it applies before the process loads its first module, and not relative to the present
        # niceness of the supervisor, which may have changed.
        with suppress(OSError):  # it has ended already, or we may not raise its priority
            os.setpriority(os.PRIO_PROCESS, process.pid, self._niceness + spec.niceness)
        hang_timeout_s = spec.hang_timeout_s or self._cfg.hang_timeout_s
        watch = SilenceWatch(max(self._cfg.start_timeout_s, hang_timeout_s), hang_timeout_s) if spec.is_loop else None
        self._children[spec.name] = _Child(spec, process, watch)

    def on_heartbeat(self, heartbeat: Heartbeat) -> None:
        """Take a heartbeat; that of a dead process has no effect."""
        child = self._children.get(heartbeat.process)
        if child is not None and child.watch is not None and child.process.pid == heartbeat.pid:
            child.watch.reset()

    def poll(self, now_s: float) -> ChildDeath | None:
        """Collect dead processes, kill hung ones, and restart; returns the death that ends the run, or ``None``."""
        for name, child in tuple(self._children.items()):
            spec, code = child.spec, child.process.poll()
            if code is None:
                if child.watch is not None and not child.why_killed and child.watch.is_hung(now_s):
                    child.why_killed = child.watch.text
                    child.process.kill()  # also ends a stopped process; the next poll finds it dead
                continue
            death = self._policy.died(spec, code, now_s, child.why_killed)
            if death.end in (ProcessEnd.END, ProcessEnd.HELD):
                return death
            self._notify_operator("warning", death.text)
            if death.end is ProcessEnd.WITHOUT:
                del self._children[name]
                continue
            self.restarts += 1
            if spec.is_needed:
                self._is_recovering_until_s = now_s + self._cfg.hang_timeout_s + RECOVERY_S
            self.start(spec, is_restarted=True)
        return None

    def stop_all(self) -> None:
        """Terminate all, with a common deadline: the loops one by one, main first, then the servers together.

        A process that the survey does not need has nothing to save. It is terminated after the first loop has ended,
        and killed if it still runs at the end.
        """
        deadline_s = time.monotonic() + STOP_TIMEOUT_S
        running = [child for child in reversed(self._children.values()) if child.process.poll() is None]
        needed = [child for child in running if child.spec.is_needed]
        loops, servers = ([child for child in needed if child.spec.is_loop is is_loop] for is_loop in (True, False))
        others = [child.process for child in running if not child.spec.is_needed]
        for group in (*([loop] for loop in loops), servers):
            for child in group:
                child.process.terminate()
            for child in group:
                self._await_end(child, deadline_s)
            for process in others:
                process.terminate()
        for process in others:
            try:
                process.wait(LEAST_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _await_end(self, child: _Child, deadline_s: float) -> None:
        try:
            child.process.wait(max(deadline_s - time.monotonic(), LEAST_STOP_S))
        except subprocess.TimeoutExpired:
            text = f"process {child.spec.name} did not stop within {STOP_TIMEOUT_S:g} s and was killed"
            self._notify_operator("error", text)
            child.process.kill()
            child.process.wait()

    def kill_all(self) -> None:
        """Kill every process that still runs."""
        for child in self._children.values():
            if child.process.poll() is None:
                child.process.kill()
                child.process.wait()


def listen(section: str, host: str, port: int) -> socket.socket:
    """A listening socket for a process that inherits it; port 0 takes any free one. ConfigError: it is in use."""
    try:
        return listen_at(host, port)
    except OSError as error:
        raise ConfigError(
            f"{section}.port: cannot listen on {host}:{port}: {error.strerror}; "
            f"stop who uses it, or choose another with --set {section}.port=0 (0 = any free port)"
        ) from error


class PageSocket(NamedTuple):
    """The listening socket (``None`` without a dashboard) and the message for the operator, which may be empty."""

    socket: socket.socket | None
    config: DashboardConfig
    level: str
    text: str


def open_page_socket(cfg: DashboardConfig) -> PageSocket:
    """Listen at the configured address, or at another port if that is in use. A failure does not stop the survey."""
    if not cfg.enabled:
        return PageSocket(None, cfg, "info", "")
    level, before = "info", "dashboard: "
    try:
        try:
            listener = listen_at(cfg.host, cfg.port)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            level, before = "warning", f"dashboard: port {cfg.port} is in use, so it is at "
            listener = listen_at(cfg.host, 0)
    except OSError as error:
        where = f"{cfg.host}:{cfg.port}"
        text = f"no dashboard: cannot listen on {where}: {error.strerror}; choose another dashboard.host"
        return PageSocket(None, cfg, "warning", text)
    port = listener.getsockname()[1]
    return PageSocket(listener, cfg.model_copy(update={"port": port}), level, before + page_url(cfg.host, port))


def page_url(host: str, port: int) -> str:
    """The page's address."""
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


def token_query(cfg: DashboardConfig, runtime_dir: Path) -> str:
    """The query with the token of this start, which permits commands from the page; it must not be logged.

    Empty if tokens are configured, because each operator has one.
    """
    if cfg.token_file:
        return ""
    with suppress(OSError):
        return f"?token={(runtime_dir / TOKEN_FILE).read_text(encoding='ascii').strip()}"
    return ""


def page_address(runtime_dir: Path) -> str:
    """Address of a daemon's page with its token; empty if there is no page in the runtime directory."""
    run_dir = run_dir_in(runtime_dir)
    if run_dir is None or not (runtime_dir / "dashboard").exists():
        return ""
    with suppress(ConfigError):  # the run directory was removed
        cfg = load_mission(run_dir / "config.toml").dashboard
        return page_url(cfg.host, cfg.port) + token_query(cfg, runtime_dir)
    return ""


class ServerAddress(Protocol):
    """Where a simulated server listens."""

    @property
    def host(self) -> str:
        """Address."""

    @property
    def port(self) -> int:
        """Port; 0 takes any free one."""


def process_table(cfg: CommonConfig) -> tuple[ProcessSpec, ...]:
    """The processes of a run of a configuration, in the order of starting."""
    table: tuple[ProcessSpec, ...] = kind_of(cfg).processes.get()
    return table


class SimulatedServer(NamedTuple):
    """Process, section of the configuration and address of a simulated server."""

    process: str
    section: str
    at: ServerAddress


def simulated_servers(cfg: CommonConfig) -> list[SimulatedServer]:
    """The simulated servers of a run of a configuration."""
    servers = [one for one in process_table(cfg) if one.is_simulator]
    return [
        SimulatedServer(one.name, one.listens, getattr(cfg.sim, one.listens.removeprefix("sim."))) for one in servers
    ]


C = TypeVar("C", bound=CommonConfig)


def with_addresses(cfg: C, sockets: Mapping[str, socket.socket]) -> C:
    """The configuration with the addresses of the simulated servers for their clients.

    The section ``sim`` stays as it is, so that a resumed run with port 0 takes any free port again.
    """
    changes: dict[str, object] = {}
    for server in simulated_servers(cfg):
        host, port = sockets[server.process].getsockname()[:2]
        name = server.section.removeprefix("sim.")
        changes[name] = getattr(cfg, name).model_copy(update={"host": host, "port": port})
    return cfg.model_copy(update=changes)
