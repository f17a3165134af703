"""Writes down what passes a robot server and the bus, and acts at fixed frames. Python imports this from PYTHONPATH.

Where a process sends the first line of the robot link, its connection is written to CCATP_GOLDEN_DIR/wire.<n>, one line
per message: ``>`` from or ``<`` to the robot, and the message; a frame that goes to several clients is written once.
The processes run on asyncio's own event loop here, whose sockets can be watched, and not on that of uvloop.
What any process publishes by ZeroMQ goes to CCATP_GOLDEN_DIR/bus.<n>, but for long messages: set points have all their
digits there. Nothing here depends on names of the package: the link and the channels are documented interfaces.

CCATP_GOLDEN_ACTIONS is a JSON list of actions in their order. An action is done when the frame of that number is about
to be sent for the first time. In lockstep every client has answered the frame before by then and waits, so that the
action falls between the same two frames in each run.

* ``endpoint``, ``request``, ``wait_s``: a request to a ROUTER socket. CCATP_GOLDEN_DIR/replies takes its reply, or null
  where there was none for so long: a reply that takes frames cannot come before the wait is over.
* ``kill``: after so many seconds, in which other processes finish what they write in the background, the parent process
  and this one end at once, as by ``kill -9``.
"""

import asyncio
import json
import os
import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import zmq

_HELLO = b'"hello"', b'"ccatp-robot/'
_SENSORS = b'"sensors"'
_recv, _send, _write = socket.socket.recv, socket.socket.send, os.write
_LONG_MESSAGE = 1000  # batches, which are in the recording


class _Wire:
    """All connections of a process that is a robot server."""

    def __init__(self, folder: Path, actions: list[dict[str, Any]]) -> None:
        self._folder, self._actions = folder, actions
        self._rests: dict[int, dict[bytes, bytes]] = {}  # by the number of the connection's file
        self._last_frame = b""
        self._file = -1

    def is_known(self, connection: int, data: bytes) -> bool:
        """Whether this is a connection of the robot link, or becomes one by its first line."""
        if not all(part in data for part in _HELLO):
            return connection in self._rests
        if self._file < 0:
            self._file = _open_next(self._folder, "wire")
        self._rests[connection] = {b"<": b"", b">": b""}
        return True

    def note(self, connection: int, direction: bytes, data: bytes) -> None:
        rests = self._rests.get(connection)
        if rests is None:
            return
        *lines, rests[direction] = (rests[direction] + data).split(b"\n")
        for line in lines:
            if direction == b">" and _SENSORS in line:
                if line == self._last_frame:
                    continue
                self._last_frame = line
            _write(self._file, direction + line + b"\n")

    def act_before(self, data: bytes) -> None:
        for line in data.split(b"\n"):
            while self._actions and _SENSORS in line and json.loads(line)["seq"] >= self._actions[0]["frame"]:
                self._act(self._actions.pop(0))

    def _act(self, action: dict[str, Any]) -> None:
        if "kill" in action:
            time.sleep(action["kill"])
            os.kill(os.getppid(), signal.SIGKILL)
            os.kill(os.getpid(), signal.SIGKILL)
        reply = _ask(action["endpoint"], json.dumps(action["request"]).encode(), action["wait_s"])
        with (self._folder / "replies").open("ab") as file:
            file.write(reply + b"\n")


def _open_next(folder: Path, name: str) -> int:
    for number in range(1000):
        try:
            return os.open(folder / f"{name}.{number}", os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
        except FileExistsError:
            continue
    raise RuntimeError(f"{folder} is full of files {name}")


def _ask(endpoint: str, request: bytes, wait_s: float) -> bytes:
    with zmq.Context() as context, context.socket(zmq.REQ) as peer:
        peer.setsockopt(zmq.LINGER, 0)
        peer.connect(endpoint)
        peer.send(request)
        return bytes(peer.recv()) if peer.poll(round(1000 * wait_s)) else b"null"


def _write_down_bus(folder: Path) -> None:
    send = zmq.Socket.send
    files: list[int] = []

    def publish(self: zmq.Socket[Any], data: Any, *arguments: Any, **options: Any) -> Any:
        if self.type in (zmq.PUB, zmq.XPUB) and isinstance(data, bytes) and len(data) < _LONG_MESSAGE:
            if not files:
                files.append(_open_next(folder, "bus"))
            _write(files[0], data + b"\n")
        return send(self, data, *arguments, **options)

    zmq.Socket.send = publish  # type: ignore[method-assign]


def _write_down_link(wire: _Wire) -> None:
    def sent_by(connection: int, data: bytes, send: Callable[[], int]) -> int:
        if not wire.is_known(connection, data[:200]):
            return send()
        wire.act_before(data)
        sent = send()
        wire.note(connection, b">", data[:sent])
        return sent

    def write(file: int, data: Any) -> int:
        return sent_by(file, bytes(data), lambda: _write(file, data))

    def send(self: socket.socket, data: Any, *flags: int) -> int:
        return sent_by(self.fileno(), bytes(data), lambda: _send(self, data, *flags))

    def recv(self: socket.socket, size: int, *flags: int) -> bytes:
        data = _recv(self, size, *flags)
        wire.note(self.fileno(), b"<", data)
        return data

    os.write = write
    socket.socket.send = send  # type: ignore[assignment,method-assign]
    socket.socket.recv = recv  # type: ignore[assignment,method-assign]
    with suppress(ImportError):  # an older base is without it
        import uvloop

        uvloop.new_event_loop = asyncio.new_event_loop  # type: ignore[assignment]


if (_folder := os.environ.get("CCATP_GOLDEN_DIR")) is not None:
    _write_down_bus(Path(_folder))
    _write_down_link(_Wire(Path(_folder), json.loads(os.environ.get("CCATP_GOLDEN_ACTIONS", "[]"))))
