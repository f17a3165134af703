"""A run under a service manager: a real notification socket, a real watchdog period, a child that hangs."""

import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from tests.processes.conftest import Run

WATCHDOG_S = 2.0
DEADLINE_S = 60.0


class Manager:
    """Hears the datagrams of a service."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(path))

    def next(self, timeout_s: float = DEADLINE_S) -> str | None:
        self.socket.settimeout(timeout_s)
        try:
            return self.socket.recv(4096).decode()
        except TimeoutError:
            return None

    def until(self, wanted: str) -> list[str]:
        """All that is told up to the first that begins with ``wanted``."""
        told: list[str] = []
        while not told or not told[-1].startswith(wanted):
            text = self.next()
            assert text is not None, f"no {wanted} within {DEADLINE_S} s after {told}"
            told.append(text)
        return told


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    manager = Manager(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", str(round(1e6 * WATCHDOG_S)))
    yield manager
    manager.socket.close()


def child(run: Run, module: str) -> psutil.Process:
    return next(c for c in psutil.Process(run.process.pid).children() if f"ccatp.daemon.{module}" in c.cmdline())


@pytest.mark.fault("P6", "P7")
def test_ready_strokes_loops_that_hang_and_the_end(start: Callable[..., Run], manager: Manager) -> None:
    run = start("--realtime", "--panels", "1", "--set", "run.hang_timeout_s=20")  # the manager's watchdog is first
    assert manager.until("READY=1") == ["READY=1"]
    assert run.ask("status")["status"]["total"] == 9
    for _ in range(3):
        manager.until("WATCHDOG=1")
    for module, trouble in (
        ("danger_loop", "danger (sent|had) its last"),
        ("main_loop", "main (sent|had) its last"),
    ):
        pid = child(run, module).pid
        os.kill(pid, signal.SIGSTOP)
        try:
            told = manager.until("STATUS=trouble: ")[-1]
            assert re.match(f"STATUS=trouble: {trouble}", told), (module, told)
            silent_until_s = time.monotonic() + 0.5 * WATCHDOG_S
            while (left_s := silent_until_s - time.monotonic()) > 0.0:
                assert not (manager.next(left_s) or "").startswith("WATCHDOG")
        finally:
            os.kill(pid, signal.SIGCONT)
        manager.until("WATCHDOG=1")
    run.process.send_signal(signal.SIGTERM)
    manager.until("STOPPING=1")
    assert run.wait() == 130
    assert "Traceback" not in run.stderr


def test_children_cannot_speak_for_the_service(start: Callable[..., Run], manager: Manager) -> None:
    run = start("--panels", "9")
    manager.until("READY=1")
    for process in psutil.Process(run.process.pid).children():
        assert not {"NOTIFY_SOCKET", "WATCHDOG_USEC"} & process.environ().keys()
    run.process.send_signal(signal.SIGTERM)
    manager.until("STOPPING=1")
    assert run.wait() == 130


def test_a_run_that_does_not_begin_is_never_ready(start: Callable[..., Run], manager: Manager, tmp_path: Path) -> None:
    run = start("--panels", "1", "--set", f"robot.key_file={tmp_path / 'none'}")
    assert run.wait() == 2
    assert run.stderr.startswith("ccatp: robot.key_file: cannot read")
    assert run.stderr.count("\n") == 1
    assert manager.next(timeout_s=0.01) is None
