"""Clients of a daemon in Python: over its sockets and its page."""

import asyncio
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq.asyncio

from ccatp.errors import ConfigError, DaemonUnreachableError, RefusedError
from ccatp.links.client import HttpClient, Latched, OperatorClient, Pong, StillWaiting
from ccatp.links.rpc import Router
from ccatp.links.topics import MissionStatus


@contextmanager
def serving(
    runtime_dir: Path, channel: str, answer: Callable[[dict[str, Any]], dict[str, Any]]
) -> Iterator[list[dict[str, Any]]]:
    """A real ROUTER in a thread of its own; yields what it was asked."""
    asked: list[dict[str, Any]] = []
    ready, loop = threading.Event(), asyncio.new_event_loop()

    def handle(frame: bytes) -> bytes:
        asked.append(json.loads(frame))
        return json.dumps(answer(asked[-1])).encode()

    async def serve() -> None:
        context = zmq.asyncio.Context()
        try:
            async with Router(f"ipc://{runtime_dir / channel}", handle, context) as router:
                ready.set()
                await router.serve()
        finally:
            context.destroy(linger=0)

    task = loop.create_task(serve())

    def run() -> None:
        try:
            loop.run_until_complete(task)
        except asyncio.CancelledError:
            pass
        finally:
            loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    assert ready.wait(10.0)
    try:
        yield asked
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()


NO_STATUS = MissionStatus(seq=-1, t_s=0.0, state="")


def status(**fields: object) -> dict[str, Any]:
    return {"ok": True, "status": {**msgspec.to_builtins(NO_STATUS), **fields}}


def test_commands_and_typed_answers(runtime_dir: Path) -> None:
    with serving(runtime_dir, "control", lambda request: status(state=request["cmd"], done=3)) as asked:
        daemon = OperatorClient(runtime_dir)
        for order in (daemon.status, daemon.pause, daemon.resume, daemon.abort, daemon.stop):
            found = order()
            assert (found.state, found.done) == (order.__name__, 3)
    assert [request["cmd"] for request in asked] == ["status", "pause", "resume", "abort", "stop"]


def test_an_answer_of_another_shape_is_told(runtime_dir: Path) -> None:
    with (
        serving(runtime_dir, "control", lambda _: {"ok": True, "status": {"state": 7}}),
        pytest.raises(DaemonUnreachableError, match="not what was asked for"),
    ):
        OperatorClient(runtime_dir).status()


def test_waiting(runtime_dir: Path) -> None:
    done = iter(range(100))
    with serving(runtime_dir, "control", lambda _: status(done=next(done), total=9, state="driving")):
        daemon = OperatorClient(runtime_dir)
        assert daemon.wait(lambda found: found.done >= 3, timeout_s=20.0, period_s=0.001).done == 3
        begin = time.monotonic()
        with pytest.raises(StillWaiting, match=r"not within 0\.05 s: the mission is driving, \d+ points done"):
            daemon.wait(lambda _: False, timeout_s=0.05, period_s=0.01)
        assert time.monotonic() - begin >= 0.05


def test_observatory(runtime_dir: Path) -> None:
    def answer(request: dict[str, Any]) -> dict[str, Any]:
        if request["cmd"] == "ping":
            return {"ok": True, "code": 1, "age_s": None}
        if request["cmd"] == "clear":
            return {"ok": False, "id": request["id"], "error": "the robot moves"}
        return {"ok": True, "id": request["id"], "latched": True, "code": 2}

    with serving(runtime_dir, "emergency", answer) as asked:
        observatory = OperatorClient(runtime_dir).observatory
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
