"""The dashboard of a real run: its options, its port, an open page."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager

from ccatp.config.load import load_config
from tests.support.runs import Run

WITH_PAGE = ("--set", "dashboard.enabled=true", "--set", "dashboard.port=0")
DEADLINE_S = 30.0


def page_port(run: Run) -> int:
    """Of a run that has begun."""
    return load_config(run.run_dir / "config.toml").dashboard.port


@contextmanager
def open_page(port: int) -> Iterator[socket.socket]:
    """A page that has received something."""
    with socket.create_connection(("127.0.0.1", port), timeout=DEADLINE_S) as page:
        page.sendall(f"GET /events HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\n\r\n".encode())
        received = b""
        while b"event: news" not in received:
            received += page.recv(65_536)
        yield page
