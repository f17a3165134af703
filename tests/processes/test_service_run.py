"""Runs under a service manager, and in a shell that limits them, loses them, or cannot show what they say."""

import json
import os
import pty
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.processes.conftest import Start
from tests.support.runs import NO_CALIBRATION, NO_REPORT, until

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


# -- a hostile shell ---------------------------------------------------------------------------------------------------

RUN = (
    sys.executable,
    "-m",
    "ccatp",
    "run",
    "--sim",
    "--panels",
    "1",
    *NO_CALIBRATION,
    "--set",
    "dashboard.enabled=false",
)
PATIENCE_S = 120.0


def command(runtime_dir: Path, run_dir: Path, *more: str) -> list[str]:
    return [*RUN, "--runtime-dir", str(runtime_dir), "--run-dir", str(run_dir), *more]


def logged_status(run_dir: Path) -> int:
    lines = [json.loads(line) for line in (run_dir / "log.jsonl").read_text().splitlines()]
    return int(next(line["status"] for line in lines if line["event"] == "run_finished"))


def limited(soft: int, hard: int) -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_too_few_open_files_are_refused(runtime_dir: Path, tmp_path: Path) -> None:
    arguments = command(runtime_dir, tmp_path / "run")
    refused = subprocess.run(
        arguments, preexec_fn=lambda: limited(24, 24), capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert refused.returncode == 2
    assert refused.stderr == ("ccatp: only 24 files may be open, a run needs 256; raise the limit with ulimit -n\n")
    assert not (tmp_path / "run").exists()


def test_a_full_device_as_output_and_few_open_files_at_first_do_not_matter(runtime_dir: Path, tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    with (
        Path("/dev/full").open("wb") as full,
        subprocess.Popen(
            ("bash", "-c", 'ulimit -Sn 24 && ulimit -Hn 4096 && exec "$@"', "bash", *command(runtime_dir, run_dir)),
            stdout=full, stderr=subprocess.PIPE, env=os.environ | NO_REPORT,
        ) as run,
    ):  # fmt: skip
        until(lambda: (run_dir / "log.jsonl").exists() and "driving" in (run_dir / "log.jsonl").read_text())
        run.send_signal(signal.SIGINT)
        _, said = run.communicate(timeout=PATIENCE_S)
    assert (run.returncode, logged_status(run_dir)) == (130, 130)
    assert b"warning: standard output cannot be written: No space left on device; see summary.json\n" in said


def test_a_run_directory_that_is_deleted_during_the_start(runtime_dir: Path, tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    with subprocess.Popen(
        command(runtime_dir, run_dir), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as run:
        until((run_dir / "log.jsonl").exists)  # the supervisor's; before it, the run is refused in one line
        shutil.rmtree(run_dir.rename(tmp_path / "deleted"), ignore_errors=True)
        _, said = run.communicate(timeout=PATIENCE_S)
    assert run.returncode in {2, 4, 5}  # by who misses it first
    assert "Traceback" not in said
    assert "mission.sqlite" not in said
    assert re.search(rf"^report  none; {re.escape(str(run_dir))}: no such", said, re.MULTILINE)


def test_a_closed_terminal_is_an_interruption(runtime_dir: Path, tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    arguments = command(runtime_dir, run_dir, "--realtime")
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(arguments[0], arguments)
    until((run_dir / "mission.sqlite").exists)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 130
    assert logged_status(run_dir) == 130
