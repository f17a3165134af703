"""A server on loopback for what asks over HTTP, and one that keeps what is posted to it."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

# Status and body for a method, a path and the text of a request.
Answer = Callable[[str, str, bytes], tuple[int, bytes]]


@contextmanager
def answering(answer: Answer) -> Iterator[str]:
    """A server on a free port; yields its URL."""

    class Handler(BaseHTTPRequestHandler):
        def _serve(self) -> None:
            text = self.rfile.read(int(self.headers.get("content-length", 0)))
            code, body = answer(self.command, self.path, text)
            self.send_response(code)
            self.send_header("content-length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        do_GET = do_POST = _serve

        def log_message(self, *_: object) -> None:
            """Not to standard error."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        finally:
            server.shutdown()
            thread.join()


class Posts:
    """What is posted to a server; it answers with the next of ``answers``, then with 200."""

    def __init__(self) -> None:
        self.url, self.answers, self.bodies = "", list[int](), list[dict[str, Any]]()

    def answer(self, _method: str, _path: str, text: bytes) -> tuple[int, bytes]:
        code = self.answers.pop(0) if self.answers else 200
        self.bodies.append(json.loads(text) | {"answered": code})  # first: the next may come once this one is answered
        return code, b""


@contextmanager
def taking_posts() -> Iterator[Posts]:
    """Posts to a server on loopback."""
    posts = Posts()
    with answering(posts.answer) as posts.url:
        yield posts
