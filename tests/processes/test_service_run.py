"""A run under a service manager: a real notification socket, a real watchdog period, a child that hangs."""

import os
import re
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.processes.conftest import Start

WATCHDOG_S = 2.0
DEADLINE_S = 60.0


class Manager:
    """Receives the datagrams of a service."""

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
        """All that is reported up to the first that begins with ``wanted``."""
        received: list[str] = []
        while not received or not received[-1].startswith(wanted):
            text = self.next()
            assert text is not None, f"no {wanted} within {DEADLINE_S} s after {received}"
            received.append(text)
        return received


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    manager = Manager(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", str(round(1e6 * WATCHDOG_S)))
    yield manager
    manager.socket.close()


@pytest.mark.fault("P6", "P7")
def test_ready_strokes_loops_that_hang_and_the_end(start: Start, manager: Manager) -> None:
    run = start("--realtime", "--panels", "1", "--set", "run.hang_timeout_s=20")  # the manager's watchdog is first
    assert manager.until("READY=1") == ["READY=1"]
    assert run.ask("status")["status"]["total"] == 9
    for process in psutil.Process(run.process.pid).children():  # children cannot speak for the service
        assert not {"NOTIFY_SOCKET", "WATCHDOG_USEC"} & process.environ().keys()
    for _ in range(3):
        manager.until("WATCHDOG=1")
    for name in ("danger", "main"):
        pid, _ = run.send(name, signal.SIGSTOP)
        try:
            status = manager.until("STATUS=trouble: ")[-1]
            assert re.match(f"STATUS=trouble: {name} (sent|had) its last", status), (name, status)
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


def test_a_run_that_does_not_begin_is_never_ready(start: Start, manager: Manager, tmp_path: Path) -> None:
    run = start("--panels", "1", "--set", f"robot.key_file={tmp_path / 'none'}")
    assert run.wait() == 2
    assert run.stderr.startswith("ccatp: robot.key_file: cannot read")
    assert run.stderr.count("\n") == 1
    assert manager.next(timeout_s=0.01) is None
