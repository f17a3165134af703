"""A WebSocket client of RFC 6455 in a few lines, blocking, for tests of servers."""

import base64
import json
import os
import socket
import struct
from types import TracebackType
from typing import Any, Self

TEXT, BINARY, CLOSE, PING = 1, 2, 8, 9


class WebSocket:
    """A connection.

    Args:
        port: of 127.0.0.1.
        protocol: the subprotocol asked for.
        timeout_s: longest wait for anything.
    """

    def __init__(self, port: int, protocol: str, timeout_s: float = 10.0) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout_s)
        self._file = self._socket.makefile("rb")
        key = base64.b64encode(os.urandom(16)).decode()
        head = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        head += f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: {protocol}\r\n\r\n"
        self._socket.sendall(head.encode())
        status = self._file.readline()
        assert b" 101 " in status, status
        while self._file.readline() not in (b"\r\n", b""):
            pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()
        self._socket.close()

    def send(self, message: dict[str, Any]) -> None:
        """One JSON message; a client masks what it sends."""
        data, mask = json.dumps(message).encode(), os.urandom(4)
        length = bytes([0x80 | len(data)]) if len(data) < 126 else bytes([0x80 | 126]) + struct.pack(">H", len(data))
        masked = bytes(byte ^ mask[i % 4] for i, byte in enumerate(data))
        self._socket.sendall(bytes([0x80 | TEXT]) + length + mask + masked)

    def receive(self) -> bytes | dict[str, Any]:
        """The next message: binary as it is, text as JSON."""
        kind, data = self._frame()
        while kind == PING:
            kind, data = self._frame()
        assert kind in (TEXT, BINARY), kind
        found: bytes | dict[str, Any] = json.loads(data) if kind == TEXT else data
        return found

    def _frame(self) -> tuple[int, bytes]:
        data, kind = b"", 0
        while True:
            first, second = self._file.read(2)
            length = second & 0x7F
            if length == 126:
                (length,) = struct.unpack(">H", self._file.read(2))
            elif length == 127:
                (length,) = struct.unpack(">Q", self._file.read(8))
            data += self._file.read(length)
            kind = kind or first & 0x0F
            if first & 0x80:
                return kind, data
