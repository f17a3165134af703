"""The dashboard beside a real run: it comes and goes, and the survey goes on."""

import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from ccatp.config.load import load_config
from ccatp.studies.sil_run import rehearse
from tests.processes.conftest import Run

Start = Callable[..., Run]
WITH_PAGE = ("--set", "dashboard.enabled=true", "--set", "dashboard.port=0")
URL = re.compile(r"http://127\.0\.0\.1:(\d+)/")
DEADLINE_S = 30.0


def page_port(run: Run) -> int:
    """Of a run that has begun."""
    return load_config(run.run_dir / "config.toml").dashboard.port


def ask(port: int, method: str, path: str) -> tuple[int, Any]:
    """One request, and its answer as JSON."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=DEADLINE_S)
    try:
        connection.request(method, path)
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())
    finally:
        connection.close()


def mission_of(port: int) -> dict[str, Any]:
    """Where the mission stands, once the dashboard has heard of it."""
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        mission: dict[str, Any] | None = ask(port, "GET", "/status")[1]["mission"]
        if mission is not None:
            return mission
    raise AssertionError("the dashboard hears nothing")


@contextmanager
def open_page(port: int) -> Iterator[socket.socket]:
    """A page that has been told something."""
    with socket.create_connection(("127.0.0.1", port), timeout=DEADLINE_S) as page:
        page.sendall(f"GET /events HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\n\r\n".encode())
        told = b""
        while b"event: news" not in told:
            told += page.recv(65_536)
        yield page


def dashboard_of(run: Run, not_pid: int = 0) -> psutil.Process:
    """Its process, once it is there."""
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        for child in psutil.Process(run.process.pid).children():
            if child.pid != not_pid and "ccatp.daemon.dashboard" in child.cmdline():
                return child
        time.sleep(0.01)
    raise AssertionError("no dashboard")


def test_it_dies_and_is_restarted_while_the_survey_goes_on(start: Start) -> None:
    run = start("--panels", "1", "--realtime", *WITH_PAGE)
    run.until(lambda status: status["state"] == "driving")
    port = page_port(run)
    assert mission_of(port)["total"] == 9
    first = dashboard_of(run)
    # It gets what time the others leave.
    assert first.nice() > psutil.Process(run.process.pid).nice()
    first.kill()
    second = dashboard_of(run, not_pid=first.pid)
    # The port is held by the supervisor: who comes meanwhile is served by the next one.
    code, status = ask(port, "GET", "/status")
    assert code == 200
    assert status["restarts"] == {"main": 0, "danger": 0}
    assert second.is_running()
    code, _ = ask(port, "POST", "/stop")
    assert code == 200
    assert run.wait() == 4
    assert "process dashboard was killed by SIGKILL: restarting it, the survey goes on" in run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.slow
def test_a_port_in_use_stops_no_survey_and_the_summary_is_the_same(start: Start) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        run = start("--panels", "1", "--set", "dashboard.enabled=true", "--set", f"dashboard.port={taken}")
        run.until(lambda status: status["state"] == "driving")
        with open_page(page_port(run)):
            assert run.wait() == 0, run.stderr
    assert f"warning: dashboard: port {taken} is in use, so it is at http://127.0.0.1:{page_port(run)}/" in run.stderr
    # Looking on changes nothing: as in process, without any display.
    rehearsed = rehearse(load_config(run.run_dir / "config.toml"), with_track=False).summary
    assert {**run.summary, "wall": None} == {**rehearsed, "wall": None}


def test_attached_to_a_running_daemon_it_ends_soon_with_a_page_open(start: Start) -> None:
    run = start("--panels", "1", "--realtime")
    run.until(lambda status: status["done"] >= 1)
    for attempt in range(3):
        with attached(run) as (process, port):
            assert ask(port, "GET", "/ground")[1]["is_sim"] is True
            assert mission_of(port)["done"] >= 1
            with open_page(port) as page:
                begun_s = time.monotonic()
                process.send_signal(signal.SIGTERM)
                assert process.wait(DEADLINE_S) == 0
                took_s = time.monotonic() - begun_s
                told = b""
                while received := page.recv(65_536):
                    told += received
                assert b"event: end" in told
                assert told.endswith(b"0\r\n\r\n")
        if took_s < 2.0:
            break
        assert attempt < 2, f"it took {took_s:.1f} s, three times"  # once may be somebody else's load
    assert run.ask("status")["ok"]  # the daemon does not mind


@contextmanager
def attached(run: Run) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """``ccatp dashboard`` beside a run."""
    command = [sys.executable, "-m", "ccatp", "dashboard", "--port", "0", "--runtime-dir", str(run.runtime_dir)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            found = URL.search(process.stdout.readline())
            assert found is not None
            yield process, int(found[1])
        finally:
            if process.poll() is None:
                process.kill()


def test_a_token_that_cannot_be_read_is_told_before_anything_begins(start: Start, tmp_path: Path) -> None:
    run = start("--panels", "1", *WITH_PAGE, "--set", f"dashboard.token_file={tmp_path / 'none'}")
    assert run.wait() == 2
    assert "dashboard.token_file: cannot read" in run.stderr
    assert not run.run_dir.exists()


@pytest.mark.slow
def test_it_dies_over_and_over_and_the_survey_goes_on_without_it(start: Start) -> None:
    run = start("--panels", "1", "--realtime", *WITH_PAGE)
    run.until(lambda status: status["state"] == "driving")
    pid = 0
    for _ in range(4):
        victim = dashboard_of(run, not_pid=pid)
        pid = victim.pid
        victim.kill()
    assert run.wait(120.0) == 0, run.stderr
    assert "more than 3 times within 60 s: the survey goes on without it" in run.stderr
