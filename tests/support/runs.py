"""Real runs in processes of their own, on real sockets: each has its own runtime directory and free ports."""

import fcntl
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Self

import psutil
import pytest

from ccatp.config.load import load_config
from ccatp.daemon.supervision.supervisor import PROCESSES
from ccatp.links.channels import format_request
from ccatp.links.rpc import RequestFailed, request

# The calibration drive takes as long as a panel: it is done only where it matters.
NO_CALIBRATION = ("--set", "mission.calibration_length_m=0")
FREE_PORTS = ("--set", "sim.robot.port=0", "--set", "sim.etalon.port=0", "--set", "dashboard.enabled=false")
MODULES = {process.name: process.module for process in PROCESSES}
DEADLINE_S = 60.0
# Of a run whose report nobody reads: to draw it takes seconds.
NO_REPORT = {"MPLBACKEND": "none"}
# Two panels in the world with slip and delays.
RECORDED = ("--panels", "2", "--world", "hard", "--filter", "ekf", "--json", *NO_CALIBRATION)


class Run:
    """One `ccatp run --sim`; at the end of a `with` it is ended, if it has not ended by itself.

    Args:
        has_report: it draws its report at its end, which takes seconds; otherwise it says that there is none.
    """

    free_ports: tuple[str, ...] = FREE_PORTS

    def __init__(self, run_dir: Path, runtime_dir: Path, *args: str, has_report: bool = False) -> None:
        self.run_dir, self.runtime_dir = run_dir, runtime_dir
        command = [sys.executable, "-m", "ccatp", "run", "--sim", "--run-dir", str(run_dir)]
        command += ["--runtime-dir", str(runtime_dir), *self.free_ports, *args]
        env = os.environ | ({} if has_report else NO_REPORT)
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)
        self.stdout = self.stderr = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def ask(self, cmd: str, channel: str = "control", **fields: object) -> dict[str, Any]:
        """Send one command and return the reply."""
        return request(f"ipc://{self.runtime_dir / channel}", format_request(cmd, **fields), timeout_s=10.0)

    def until(self, is_there: Callable[[dict[str, Any]], bool], timeout_s: float = DEADLINE_S) -> dict[str, Any]:
        """Poll the status until the condition holds."""
        deadline = time.monotonic() + timeout_s
        status: dict[str, Any] = {}
        while time.monotonic() < deadline:
            assert self.process.poll() is None, f"the run ended early:\n{self.wait()}\n{self.stderr}"
            if (self.runtime_dir / "control").exists():
                try:
                    status = self.ask("status")["status"]
                except RequestFailed:
                    continue
                if is_there(status):
                    return status
            time.sleep(0.01)
        raise AssertionError(f"not within {timeout_s} s; last status {status}")

    def until_state(self, *states: str, done: int = 0) -> dict[str, Any]:
        """Wait for one of these states with so many points measured."""
        return self.until(lambda status: status["done"] >= done and status["state"] in states)

    def wait(self, timeout_s: float = 90.0) -> int:
        """The exit status, when the run ends by itself."""
        self.stdout, self.stderr = self.process.communicate(timeout=timeout_s)
        return self.process.returncode

    def end(self) -> None:
        """End it, if it has not ended."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.communicate(timeout=15.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.communicate()

    # -- its processes ------------------------------------------------------------------------------------------------

    def child(self, name: str, *, not_pid: int = 0) -> psutil.Process:
        """The process of that name in the process table, once it is there."""
        module = MODULES[name]
        deadline_s = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline_s:
            assert self.process.poll() is None, "the run has ended"
            for process in psutil.Process(self.process.pid).children():
                try:
                    if process.pid != not_pid and module in process.cmdline():
                        return process
                except psutil.Error:  # dead, and not yet buried
                    continue
            time.sleep(0.01)
        raise AssertionError(f"no {'other ' if not_pid else ''}{name} has come")

    def send(self, name: str, number: signal.Signals = signal.SIGKILL) -> tuple[int, float]:
        """Send a signal to a child; its process number, and when (wall clock)."""
        pid = self.child(name).pid
        at_s = time.time()
        os.kill(pid, number)
        return pid, at_s

    # -- what it wrote ------------------------------------------------------------------------------------------------

    @property
    def summary(self) -> dict[str, Any]:
        """The summary."""
        summary: dict[str, Any] = json.loads((self.run_dir / "summary.json").read_text())
        return summary

    @property
    def log(self) -> list[dict[str, Any]]:
        """All whole lines of the log; the last one may be half written."""
        lines = (self.run_dir / "log.jsonl").read_text().split("\n")[:-1]
        return [json.loads(line) for line in lines]

    @property
    def robot_record(self) -> dict[str, Any]:
        """What the simulated robot counted."""
        return next(e for e in self.log if e["logger"] == "dataloop" and e["event"] == "robot_statistics")

    @property
    def config_port(self) -> int:
        """The port on which the simulated robot listens."""
        return load_config(self.run_dir / "config.toml").robot.port

    @property
    def etalon_port(self) -> int:
        """The port on which the simulated laser system listens."""
        return load_config(self.run_dir / "config.toml").etalon.port

    @property
    def fixes(self) -> list[tuple[int, int, int]]:
        """Points of all fixes that were ever committed, replaced ones, too."""
        return self.query("SELECT row, col, point FROM fixes ORDER BY id")

    @property
    def measured(self) -> int:
        """Points measured, as the mission database has it."""
        return int(self.query("SELECT count(*) FROM points WHERE status = 'measured'")[0][0])

    def query(self, sql: str) -> list[Any]:
        """Rows of the mission database."""
        db = sqlite3.connect(f"file:{self.run_dir / 'mission.sqlite'}?mode=ro", uri=True)
        try:
            return db.execute(sql).fetchall()
        finally:
            db.close()

    def first_after(self, at_s: float, process: str, event: str) -> float:
        """Seconds from a wall time to the first line of a process that begins so."""
        for entry in self.log:
            if entry["logger"] == process and (entry["event"] == event or entry.get("text", "").startswith(event)):
                after_s = wall_s(entry) - at_s
                if after_s >= 0.0:
                    return after_s
        raise AssertionError(f"{process} has not logged {event!r}")


def until(look: Callable[[], Any], timeout_s: float = 120.0) -> Any:
    """What a look finds, once that is something."""
    deadline_s = time.monotonic() + timeout_s
    while not (found := look()):
        assert time.monotonic() < deadline_s, f"not within {timeout_s} s"
        time.sleep(0.01)
    return found


def wall_s(entry: dict[str, Any]) -> float:
    """Wall time of a line of the log."""
    return datetime.fromisoformat(entry["timestamp"]).timestamp()


class RecordedRun(Run):
    """A run that has ended: what it wrote and printed. Copy `run_dir` before changing anything in it."""

    def __init__(self, folder: Path) -> None:
        self.run_dir = folder / "run"
        self.stdout, self.stderr = ((folder / name).read_text() for name in ("stdout", "stderr"))


def record_once(factory: pytest.TempPathFactory) -> RecordedRun:
    """The run with the options `RECORDED`: made by the first worker that wants it, read by all others."""

    def make(folder: Path) -> None:
        with (
            tempfile.TemporaryDirectory(prefix="ccatp-") as sockets,
            Run(folder / "run", Path(sockets), *RECORDED, has_report=True) as run,
        ):
            assert run.wait(300.0) == 0, run.stderr
        (folder / "stdout").write_text(run.stdout)
        (folder / "stderr").write_text(run.stderr)

    return RecordedRun(made_once(factory, "recorded", make))


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder of the session, filled by the first worker that wants it; the others wait, and read from it."""
    root = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    folder = root / name
    with (root / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "is_whole").exists():
            shutil.rmtree(folder, ignore_errors=True)  # of an attempt that failed
            folder.mkdir()
            make(folder)
            (folder / "is_whole").touch()
    return folder


def figures_of(summary: Mapping[str, Any]) -> dict[str, Any]:
    """What a run and its rehearsal in one process have in common of ``summary.json``.

    ``wall`` is of the machine; ``ended`` (alarms, operators, exit status) is of the supervisor, whom no rehearsal has.
    """
    return {name: value for name, value in summary.items() if name not in ("wall", "ended")}
