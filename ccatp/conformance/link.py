"""Edge. One raw connection to the server under test."""

import select
import socket
from collections import deque
from collections.abc import Iterable
from contextlib import suppress

from ccatp.wire.lines import LineBuffer

# Far over the page's 8192: a line of the server that is too long is for the judges, not for the buffer.
_LIMIT_BYTES = 1 << 20
_CHUNK_BYTES = 1 << 16
_RESET = b"\x01\0\0\0\0\0\0\0"  # linger on, for 0 s: close sends RST


class Link:
    """A connection.

    Args:
        address: host and port.
        timeout_s: longest wait for the connection, and for the server to take what is sent.

    Attributes:
        lines: received and not yet taken, without their LF.
        is_ended: the server closed, or the connection broke.

    Raises:
        OSError: no connection.
    """

    def __init__(self, address: tuple[str, int], timeout_s: float) -> None:
        self._socket = socket.create_connection(address, timeout_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffer = LineBuffer(_LIMIT_BYTES)
        self.lines: deque[bytes] = deque()
        self.is_ended = False

    @property
    def is_open(self) -> bool:
        """Whether this side has not closed."""
        return self._socket.fileno() >= 0

    def send(self, data: bytes) -> None:
        """Send; what the server no longer takes is lost, and the link ended."""
        try:
            self._socket.sendall(data)
        except OSError:
            self.is_ended = True

    def receive(self) -> None:
        """Take what is there; to be called when there is something."""
        try:
            data = self._socket.recv(_CHUNK_BYTES)
        except OSError:
            data = b""
        if not data:
            self.is_ended = True
            return
        self.lines.extend(self._buffer.feed(data))

    def finish(self) -> None:
        """Send FIN and go on reading. Closing instead would send RST while something is unread."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)

    def reset(self) -> None:
        """Close with RST."""
        with suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        self._socket.close()

    def close(self) -> None:
        """Close."""
        self._socket.close()

    def fileno(self) -> int:
        """For ``select``."""
        return self._socket.fileno()


def receive_any(links: Iterable[Link], wait_s: float) -> None:
    """Receive on all links that have something, waiting for the first at most so long."""
    reading = [link for link in links if link.is_open and not link.is_ended]
    if not reading:
        select.select([], [], [], wait_s)
        return
    for link in select.select(reading, [], [], wait_s)[0]:
        link.receive()
