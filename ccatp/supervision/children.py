"""Glue. The child processes of a run: started, watched by file descriptors of the kernel, started anew, stopped."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

from ccatp.config.models import ProcessesConfig
from ccatp.package import child_environment
from ccatp.processes.common import SUPERVISOR_PID
from ccatp.supervision.restarts import Decision, Fate, RestartPolicy, SilenceWatch
from ccatp.wire.topics import Presence

# The matrices are 4 x 4: threads of the linear algebra would only fight the processes for the cores.
ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
STOP_TIMEOUT_S = 4.0
# Whoever comes last has this long, even where others have used up the time.
LEAST_STOP_S = 1.0
# A loop that was started anew joins within this.
RECOVERY_S = 5.0
Say = Callable[[str, str], None]


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """One row of the process table.

    Attributes:
        name: as in logs.
        module: run with ``python -m``.
        is_stand_in: runs with ``--sim`` only.
        listens: the configuration section with the host and port of its listening socket, bound by the supervisor.
        is_replaceable: another one can take its place when it dies; the simulated robot has no other.
        is_loop: it tells its presence, and hangs when it does not.
        is_needed: the survey does not go on without it.
        niceness: added to the supervisor's.
        patience_s: says nothing for this long before it hangs, where that is not ``run.hang_timeout_s``.
    """

    name: str
    module: str
    is_stand_in: bool = False
    listens: str = ""
    is_replaceable: bool = True
    is_loop: bool = False
    is_needed: bool = True
    niceness: int = 0
    patience_s: float | None = None


@dataclass(slots=True)
class _Child:
    spec: ProcessSpec
    process: subprocess.Popen[bytes]
    pidfd: int
    watch: SilenceWatch | None
    why_killed: str = ""


class Children:
    """The processes of one run.

    Args:
        cfg: when one hangs, and how often they are started anew.
        command_of: command line of a process, and the file descriptors that it inherits; told whether it takes the
            place of another one.
        say: tells the operator (level, text).
    """

    def __init__(
        self,
        cfg: ProcessesConfig,
        command_of: Callable[[ProcessSpec, bool], tuple[list[str], tuple[int, ...]]],
        say: Say,
    ) -> None:
        """None yet."""
        self._cfg, self._command_of, self._say = cfg, command_of, say
        self._policy = RestartPolicy(cfg.restart_limit, cfg.restart_window_s)
        self._children: dict[str, _Child] = {}
        self._is_recovering_until_s = 0.0
        self.restarts = 0

    @property
    def fds(self) -> list[int]:
        """Readable when a child has died."""
        return [child.pidfd for child in self._children.values() if child.pidfd >= 0]

    def is_recovering(self, now_s: float) -> bool:
        """Whether one was started anew a short while ago."""
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
        hang_timeout_s = spec.patience_s or self._cfg.hang_timeout_s
        watch = SilenceWatch(max(self._cfg.start_timeout_s, hang_timeout_s), hang_timeout_s) if spec.is_loop else None
        self._children[spec.name] = _Child(spec, process, pidfd, watch)

    def heard(self, presence: Presence) -> None:
        """A process has told its presence; words of one that is dead do not count."""
        child = self._children.get(presence.process)
        if child is not None and child.watch is not None and child.process.pid == presence.pid:
            child.watch.heard()

    def look(self, now_s: float) -> tuple[str, int, Decision] | None:
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
            if decision.fate not in (Fate.RESTART, Fate.WITHOUT):
                return name, code, decision
            self._say("warning", decision.text)
            self._forget(child)
            if decision.fate is Fate.WITHOUT:
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
                self._say("error", f"process {name} did not stop within {STOP_TIMEOUT_S:g} s and was killed")
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
