"""Killing the processes of a run, and what their logs say of it."""

import json
import os
import signal
import time
from datetime import datetime
from typing import Any

import psutil

from tests.processes.conftest import Run

MODULES = {"main": "main_loop", "danger": "danger_loop", "etalon": "sim_etalon", "dataloop": "sim_robot"}


def child(run: Run, name: str) -> psutil.Process:
    """The process of that name in the process table."""
    module = f"ccatp.daemon.{MODULES[name]}"
    return next(c for c in psutil.Process(run.process.pid).children() if module in _command_line(c))


def _command_line(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:  # dead, and not yet buried
        return []


def send(run: Run, name: str, number: signal.Signals = signal.SIGKILL) -> tuple[int, float]:
    """Send a signal to a child; its process number, and when (wall clock)."""
    pid = child(run, name).pid
    at_s = time.time()
    os.kill(pid, number)
    return pid, at_s


def log_of(run: Run) -> list[dict[str, Any]]:
    """All whole lines of the log; the last one may be half written."""
    lines = (run.run_dir / "log.jsonl").read_text().split("\n")[:-1]
    return [json.loads(line) for line in lines]


def wall_s(entry: dict[str, Any]) -> float:
    """Wall time of a line."""
    return datetime.fromisoformat(entry["timestamp"]).timestamp()


def first_after(run: Run, at_s: float, process: str, event: str) -> float:
    """Seconds from a wall time to the first line of a process that begins so."""
    for entry in log_of(run):
        if entry["logger"] == process and (entry["event"] == event or entry.get("text", "").startswith(event)):
            after_s = wall_s(entry) - at_s
            if after_s >= 0.0:
                return after_s
    raise AssertionError(f"{process} has not said {event!r}")


def robot_record(run: Run) -> dict[str, Any]:
    """What the simulated robot counted."""
    return next(
        entry for entry in log_of(run) if entry["logger"] == "dataloop" and entry["event"] == "robot_statistics"
    )
