"""Live streams of a run for general viewers: PlotJuggler's framing over ZeroMQ, Foxglove's WebSocket.

Both keep the last message of each latched topic, and tell it again to whoever subscribes later.
"""

import ipaddress
import json
import queue
from collections.abc import Iterable, Mapping
from typing import Any, Protocol

import zmq

from ccatp.errors import CcatpError, ExitStatus
from ccatp.report.views import ViewMessage

_NS = 1e9
# Some seconds of a run at its quickest; a viewer that is slower loses the newest.
HIGH_WATER_MARK = 5000
LINGER_MS = 200


class StreamError(CcatpError):
    """A stream that cannot be served."""

    exit_status = ExitStatus.USAGE


class LiveStream(Protocol):
    """Where a run is streamed to."""

    where: str

    def send(self, shown: ViewMessage, *, is_latched: bool = False) -> None:
        """Pass on one message; never blocks."""

    def tend(self) -> None:
        """To be called several times a second: tell newcomers what is latched."""

    def close(self) -> None:
        """Stop serving."""


def check_host(host: str, *, is_open: bool) -> None:
    """Refuse to serve a network without being told to: whoever connects may watch, and nobody asks who it is.

    Raises:
        StreamError: the host is not this machine, and ``is_open`` is not given.
    """
    try:
        is_local = ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_local = host == "localhost"
    if not is_local and not is_open:
        raise StreamError(
            f"--host {host}: anybody there could watch; say so with --open-to-network, or use ssh -L and 127.0.0.1"
        )


class PlotJugglerStream:
    """Messages of three frames: topic, JSON, time as ASCII seconds.

    Args:
        port: 0 takes any free one.

    Raises:
        StreamError: the port is taken.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], host: str, port: int) -> None:
        self._latched: dict[str, ViewMessage] = {}
        self._socket = context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.SNDHWM, HIGH_WATER_MARK)
        self._socket.setsockopt(zmq.LINGER, LINGER_MS)
        # Each subscription is told, also to what somebody else has subscribed already.
        self._socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        try:
            self._socket.bind(f"tcp://{host}:{port or '*'}")
        except zmq.ZMQError as error:
            self._socket.close()
            where = f"{host}:{port}"
            raise StreamError(
                f"PlotJuggler: cannot listen on {where}: {error.strerror}; choose another port"
            ) from error
        self.where = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def send(self, shown: ViewMessage, *, is_latched: bool = False) -> None:
        """As ``LiveStream.send``."""
        if is_latched:
            self._latched[shown.topic] = shown
        self._socket.send_multipart((shown.topic.encode(), shown.payload, f"{shown.t_s:.6f}".encode()))

    def tend(self) -> None:
        """As ``LiveStream.tend``; all subscribers get it again, which does no harm."""
        wanted: set[str] = set()
        while self._socket.poll(0, zmq.POLLIN):
            change = self._socket.recv()
            if change[:1] == b"\x01":
                prefix = change[1:].decode("utf-8", "replace")
                wanted |= {topic for topic in self._latched if topic.startswith(prefix)}
        for topic in sorted(wanted):
            self.send(self._latched[topic])

    def close(self) -> None:
        """As ``LiveStream.close``."""
        self._socket.close()


class FoxgloveStream:
    """A WebSocket server for Foxglove and Lichtblick; needs the extra ``foxglove``.

    Args:
        port: 0 takes any free one.

    Raises:
        StreamError: the extra is not installed, or the port is taken.
    """

    def __init__(self, name: str, host: str, port: int, schemas: Iterable[tuple[str, Mapping[str, Any]]]) -> None:
        try:
            import foxglove  # noqa: PLC0415 - belongs to an extra
            from foxglove.websocket import ServerListener  # noqa: PLC0415
        except ImportError as error:
            raise StreamError("Foxglove needs its SDK: install ccatp with its extra, ccatp[foxglove]") from error
        self._latched: dict[str, ViewMessage] = {}
        # The server calls from a thread of its own.
        newcomers: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._newcomers = newcomers

        class Listener(ServerListener):
            def on_subscribe(self, client: Any, channel: Any) -> None:
                newcomers.put(channel.topic)

        # Kept, because channels close with it.
        self._context = context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name=name, host=host, port=port, server_listener=Listener(), context=context
            )
        except (RuntimeError, OSError) as error:
            raise StreamError(f"Foxglove: cannot listen on {host}:{port}: {error}; choose another port") from error
        self._channels = {
            topic: foxglove.Channel(topic, schema=_schema(foxglove, schema), message_encoding="json", context=context)
            for topic, schema in schemas
        }
        self.where = f"ws://{host}:{self._server.port}"

    def send(self, shown: ViewMessage, *, is_latched: bool = False) -> None:
        """As ``LiveStream.send``."""
        if is_latched:
            self._latched[shown.topic] = shown
        channel = self._channels.get(shown.topic)
        if channel is not None:
            channel.log(shown.payload, log_time=round(shown.t_s * _NS))

    def tend(self) -> None:
        """As ``LiveStream.tend``."""
        wanted: set[str] = set()
        while not self._newcomers.empty():
            wanted.add(self._newcomers.get())
        for topic in sorted(wanted & self._latched.keys()):
            self.send(self._latched[topic])

    def close(self) -> None:
        """As ``LiveStream.close``."""
        self._server.stop()
        for channel in self._channels.values():
            channel.close()


def _schema(foxglove: Any, schema: Mapping[str, Any]) -> Any:
    return foxglove.Schema(name=schema["title"], encoding="jsonschema", data=json.dumps(schema).encode())
