"""Clients of a daemon: in Python over its sockets and its page, and the commands that ask for its status."""

import json
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import msgspec
import pytest

from ccatp.cli import main
from ccatp.daemon.terminal import clock, share_done, status_line, status_rows
from ccatp.errors import ConfigError, DaemonUnreachableError, RefusedError
from ccatp.links.client import HttpClient, Latched, OperatorClient, Pong, StillWaiting
from ccatp.links.topics import MissionStatus
from tests.unit.serving import serving

# -- tests of the client: what it asks over real sockets, and what it makes of the answers ----------------------------


NO_STATUS = MissionStatus(seq=-1, t_s=0.0, state="")


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="ccatp-") as path:  # short: unix sockets take no long one
        yield Path(path)


def status(**fields: object) -> dict[str, Any]:
    return {"ok": True, "status": {**msgspec.to_builtins(NO_STATUS), **fields}}


def test_commands_and_typed_answers(folder: Path) -> None:
    with serving(folder, "control", lambda request: status(state=request["cmd"], done=3)) as asked:
        daemon = OperatorClient(folder)
        for order in (daemon.status, daemon.pause, daemon.resume, daemon.abort, daemon.stop):
            found = order()
            assert (found.state, found.done) == (order.__name__, 3)
    assert [request["cmd"] for request in asked] == ["status", "pause", "resume", "abort", "stop"]


def test_a_refusal_says_why(folder: Path) -> None:
    with (
        serving(folder, "control", lambda _: {"ok": False, "error": "nothing is paused"}),
        pytest.raises(RefusedError, match="resume refused: nothing is paused"),
    ):
        OperatorClient(folder).resume()


def test_nobody_there(folder: Path) -> None:
    with pytest.raises(DaemonUnreachableError, match=r"no daemon in .*; start one with ccatp run"):
        OperatorClient(folder).status()
    (folder / "control").touch()
    with pytest.raises(DaemonUnreachableError, match=r"no answer from .* within 0\.1 s"):
        OperatorClient(folder, timeout_s=0.1).status()


def test_an_answer_of_another_shape_is_told(folder: Path) -> None:
    with (
        serving(folder, "control", lambda _: {"ok": True, "status": {"state": 7}}),
        pytest.raises(DaemonUnreachableError, match="not what was asked for"),
    ):
        OperatorClient(folder).status()


def test_waiting(folder: Path) -> None:
    done = iter(range(100))
    with serving(folder, "control", lambda _: status(done=next(done), total=9, state="driving")):
        daemon = OperatorClient(folder)
        assert daemon.wait(lambda found: found.done >= 3, timeout_s=20.0, period_s=0.001).done == 3
        begin = time.monotonic()
        with pytest.raises(StillWaiting, match=r"not within 0\.05 s: the mission is driving, \d+ points done"):
            daemon.wait(lambda _: False, timeout_s=0.05, period_s=0.01)
        assert time.monotonic() - begin >= 0.05


def test_observatory(folder: Path) -> None:
    def answer(request: dict[str, Any]) -> dict[str, Any]:
        if request["cmd"] == "ping":
            return {"ok": True, "code": 1, "age_s": None}
        if request["cmd"] == "clear":
            return {"ok": False, "id": request["id"], "error": "the robot moves"}
        return {"ok": True, "id": request["id"], "latched": True, "code": 2}

    with serving(folder, "emergency", answer) as asked:
        observatory = OperatorClient(folder).observatory
        assert observatory.ping() == Pong(1, None)
        latched = observatory.emergency("fire", "smoke")
        assert latched == Latched(latched.id, 2)
        assert observatory.emergency("fire", emergency_id=latched.id).id == latched.id
        with pytest.raises(RefusedError, match="clear refused: the robot moves"):
            observatory.clear(latched.id)
    kinds = [(request["kind"], request["note"]) for request in asked if request["cmd"] == "emergency"]
    assert kinds[0] == ("fire", "smoke")


# -- tests of the client over HTTP, against a server that answers as a dashboard does, or does not --------------------


Answer = Callable[[str, str, str | None], tuple[int, bytes]]


@contextmanager
def page(answer: Answer) -> Iterator[str]:
    """A server on a free port; yields its URL."""

    class Handler(BaseHTTPRequestHandler):
        def _serve(self) -> None:
            code, body = answer(self.command, self.path, self.headers.get("authorization"))
            self.send_response(code)
            self.send_header("content-length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        do_GET = do_POST = _serve

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        finally:
            server.shutdown()
            thread.join()


def test_orders_and_answers() -> None:
    asked = []

    def answer(method: str, path: str, token: str | None) -> tuple[int, bytes]:
        asked.append((method, path, token))
        return 200, json.dumps({"status": "ok", "path": path}).encode()

    with page(answer) as url:
        client = HttpClient(url, token="secret")
        assert client.status()["path"] == "/status"
        assert client.is_healthy()
        for order in (client.pause, client.resume, client.abort, client.stop):
            order()
    assert [(method, path) for method, path, _ in asked] == [
        ("GET", "/status"), ("GET", "/healthz"), ("POST", "/pause"), ("POST", "/resume"), ("POST", "/abort"),
        ("POST", "/stop"),
    ]  # fmt: skip
    assert {token for *_, token in asked} == {"Bearer secret"}


@pytest.mark.parametrize(
    ("body", "told"), [(b'{"status": "error", "message": "nothing is paused"}', "nothing is paused"), (b"no", "no")]
)
def test_a_refusal_of_the_page_says_why(body: bytes, told: str) -> None:
    with page(lambda *_: (409, body)) as url:
        client = HttpClient(url)
        assert not client.is_healthy()
        with pytest.raises(RefusedError, match=rf"resume refused \(409\): {told}"):
            client.resume()


def test_no_page_there(free_port: int) -> None:
    with pytest.raises(DaemonUnreachableError, match="is ccatp dashboard running there"):
        HttpClient(f"http://127.0.0.1:{free_port}").status()


@pytest.mark.parametrize(("body", "told"), [(b"<html>", "is no JSON"), (b"[]", "is no object")])
def test_another_server_is_told(body: bytes, told: str) -> None:
    with page(lambda *_: (200, body)) as url, pytest.raises(DaemonUnreachableError, match=told):
        HttpClient(url).status()


def test_what_is_no_page_is_refused() -> None:
    with pytest.raises(ConfigError, match="is no page; name it like http"):
        HttpClient("file:///etc/passwd")


# -- tests of ``ccatp status``: table, JSON, and watching until the run is over ---------------------------------------


STATUS = {
    **msgspec.to_builtins(NO_STATUS),
    "state": "driving", "point": "3-4-5", "done": 120, "skipped": 3, "total": 693, "elapsed_s": 754.0, "eta_s": 3700.0,
    "lower_bound_s": 3000.0, "error_mm": 0.052,
}  # fmt: skip


def test_the_table() -> None:
    assert status_rows(STATUS) == [
        ("state", "driving 3-4-5"),
        ("points", f"120 of 693 measured, 3 skipped  [{'#' * 5}{'.' * 25}]"),
        ("time", "12:34 elapsed, 1:01:40 to go, no path takes less than 50:00"),
        ("arrival", "0.05 mm from the last point, as estimated"),
        ("danger", "0 normal"),
    ]
    assert dict(status_rows({**STATUS, "error_mm": 0.0}))["arrival"] == "none yet"
    held = {
        **STATUS,
        "state": "held",
        "point": "",
        "cause": "operator",
        "code": 2,
        "missed_deadlines": 4,
        "worst_lateness_ms": 31.0,
    }
    held |= {"left_out": {"out of time": ["1-2-3", "1-2-4"]}, "exit_status": 4, "outcome": "stopped"}
    found = dict(status_rows(held))
    assert found["cause"] == "operator"
    assert found["danger"] == "2 operation aborted"
    assert found["late frames"] == "4, the latest by 31 ms"
    assert found["left out: out of time"] == "1-2-3, 1-2-4"
    assert found["over"] == "with exit status 4"
    many = dict(status_rows({**STATUS, "left_out": {"operator": [f"1-2-{k}" for k in range(1, 94)]}}))
    assert many["left out: operator"] == (
        "93 points: 1-2-1, 1-2-2, 1-2-3, 1-2-4, 1-2-5, 1-2-6, 1-2-7, 1-2-8, 1-2-9, 1-2-10, ..."
    )
    assert found["outcome"] == "stopped"


def test_one_line() -> None:
    assert status_line(STATUS) == "18 %: 120 of 693 points, driving 3-4-5, 12:34 elapsed, 1:01:40 to go"
    assert "held (operator)" in status_line({**STATUS, "state": "held", "point": "", "cause": "operator"})
    assert share_done({}) == 0.0
    assert [clock(s) for s in (-1.0, 0.4, 59.6, 3600.0)] == ["0:00", "0:00", "1:00", "1:00:00"]


def test_the_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(folder, "control", lambda _: {"ok": True, "status": STATUS}):
        assert main(["status", "--runtime-dir", str(folder)]) == 0
        assert capsys.readouterr().out.splitlines()[0] == "state    driving 3-4-5"
        assert main(["status", "--runtime-dir", str(folder), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["status"] == STATUS


@pytest.mark.parametrize("command", ["pause", "resume", "abort", "stop"])
def test_commands_answer_with_the_same_table(folder: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(folder, "control", lambda _: {"ok": True, "status": STATUS}):
        assert main(["status", "--runtime-dir", str(folder)]) == 0
        table = capsys.readouterr().out
        assert main([command, "--runtime-dir", str(folder)]) == 0
    assert capsys.readouterr().out == table


def answers(*found: dict[str, Any]) -> Any:
    left = list(found)
    return lambda _: {"ok": True, "status": {**STATUS, **(left.pop(0) if len(left) > 1 else left[0])}}


def test_watching_tells_changes_until_the_end(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    course = answers({}, {}, {"done": 121}, {"done": 693, "state": "done", "exit_status": 0})
    command = ["status", "--watch", "--every", "0.1", "--runtime-dir", str(folder)]
    with serving(folder, "control", course) as asked:
        assert main(command) == 0
    assert len(asked) == 4
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3  # what did not change is not told again
    assert lines[-1].startswith("100 %: 693 of 693 points, done")
    with serving(folder, "control", answers({}, {"exit_status": 3})):
        assert main([*command, "--json"]) == 0
    assert [json.loads(line)["status"]["exit_status"] for line in capsys.readouterr().out.splitlines()] == [-1, 3]


def test_watching_a_daemon_that_goes_ends_well(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["status", "--watch", "--runtime-dir", str(folder)]
    assert main(command) == 5  # nobody was there
    with serving(folder, "control", answers({})):
        # The daemon goes between two looks.
        monkeypatch.setattr("ccatp.cli.operate.time.sleep", lambda _: (folder / "control").unlink())
        assert main(command) == 0
    assert "driving" in capsys.readouterr().out


def test_a_terminal_gets_a_table(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with serving(folder, "control", answers({}, {"exit_status": 0})):
        assert main(["status", "--watch", "--every", "0.1", "--runtime-dir", str(folder)]) == 0
    assert "120 of 693 measured" in capsys.readouterr().out
