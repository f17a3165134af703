"""Tests of the client over HTTP, against a server that answers as a dashboard does, or does not."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from ccatp.errors import ConfigError, DaemonUnreachableError, RefusedError
from ccatp.links.client import HttpClient

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
def test_a_refusal_says_why(body: bytes, told: str) -> None:
    with page(lambda *_: (409, body)) as url:
        client = HttpClient(url)
        assert not client.is_healthy()
        with pytest.raises(RefusedError, match=rf"resume refused \(409\): {told}"):
            client.resume()


def test_nobody_there(free_port: int) -> None:
    with pytest.raises(DaemonUnreachableError, match="is ccatp dashboard running there"):
        HttpClient(f"http://127.0.0.1:{free_port}").status()


@pytest.mark.parametrize(("body", "told"), [(b"<html>", "is no JSON"), (b"[]", "is no object")])
def test_another_server_is_told(body: bytes, told: str) -> None:
    with page(lambda *_: (200, body)) as url, pytest.raises(DaemonUnreachableError, match=told):
        HttpClient(url).status()


def test_what_is_no_page_is_refused() -> None:
    with pytest.raises(ConfigError, match="is no page; name it like http"):
        HttpClient("file:///etc/passwd")
