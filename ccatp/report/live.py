"""Live streams of a run for general viewers: PlotJuggler's framing over ZeroMQ, Foxglove's WebSocket."""

import ipaddress
import json
import queue
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any

import zmq

from ccatp.errors import CcatpError, ExitStatus
from ccatp.report.foxglove import ViewMessage

_NS = 1e9
# Some seconds of a run at full speed; a slower viewer loses the newest messages.
HIGH_WATER_MARK = 5000
LINGER_MS = 200


class StreamError(CcatpError):
    """A stream cannot be served."""

    exit_status = ExitStatus.USAGE


class LiveStream(ABC):
    """A stream that repeats the last message of each latched topic to late subscribers."""

    where: str

    def __init__(self) -> None:
        self._latched: dict[str, ViewMessage] = {}

    def send(self, shown: ViewMessage, *, is_latched: bool = False) -> None:
        """Publish a message; never blocks."""
        if is_latched:
            self._latched[shown.topic] = shown
        self._publish(shown)

    def tend(self) -> None:
        """Repeat latched messages after new subscriptions; to be called several times a second."""
        for topic in sorted(self._latched.keys() & self._new_subscriptions()):
            self._publish(self._latched[topic])

    @abstractmethod
    def close(self) -> None:
        """Stop serving."""

    @abstractmethod
    def _publish(self, shown: ViewMessage) -> None:
        """Send to all subscribers."""

    @abstractmethod
    def _new_subscriptions(self) -> set[str]:
        """Topics that have a new subscriber."""


def check_host(host: str, *, is_open: bool) -> None:
    """StreamError: the host is not this machine, and ``is_open`` is not given; every client may watch."""
    try:
        is_local = ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_local = host == "localhost"
    if not is_local and not is_open:
        raise StreamError(
            f"--host {host}: any host there could watch; permit it with --open-to-network, or use ssh -L and 127.0.0.1"
        )


class PlotJugglerStream(LiveStream):
    """Messages of three frames: topic, JSON, time as ASCII seconds. A latched message is repeated to all subscribers.

    Port 0 takes any free one; ``StreamError`` if the port is in use.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], host: str, port: int) -> None:
        super().__init__()
        self._socket = context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.SNDHWM, HIGH_WATER_MARK)
        self._socket.setsockopt(zmq.LINGER, LINGER_MS)
        # Report also subscriptions to a topic that another peer has subscribed already.
        self._socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        try:
            self._socket.bind(f"tcp://{host}:{port or '*'}")
        except zmq.ZMQError as error:
            self._socket.close()
            why = f"cannot listen on {host}:{port}: {error.strerror}; choose another port"
            raise StreamError(f"PlotJuggler: {why}") from error
        self.where = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def _publish(self, shown: ViewMessage) -> None:
        self._socket.send_multipart((shown.topic.encode(), shown.payload, f"{shown.t_s:.6f}".encode()))

    def _new_subscriptions(self) -> set[str]:
        found: set[str] = set()
        while self._socket.poll(0, zmq.POLLIN):
            change = self._socket.recv()
            if change[:1] == b"\x01":
                prefix = change[1:].decode("utf-8", "replace")
                found |= {topic for topic in self._latched if topic.startswith(prefix)}
        return found

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class FoxgloveStream(LiveStream):
    """A WebSocket server for Foxglove and Lichtblick; needs the extra ``foxglove``.

    Port 0 takes any free one; ``StreamError`` if the port is in use or the extra is not installed.
    """

    def __init__(self, name: str, host: str, port: int, schemas: Iterable[tuple[str, Mapping[str, Any]]]) -> None:
        super().__init__()
        try:
            import foxglove  # noqa: PLC0415 - belongs to an extra
            from foxglove.websocket import ServerListener  # noqa: PLC0415
        except ImportError as error:
            raise StreamError("Foxglove needs its SDK: install ccatp with its extra, ccatp[foxglove]") from error
        # The server calls from a thread of its own.
        subscribed: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._subscribed = subscribed

        class Listener(ServerListener):
            def on_subscribe(self, client: Any, channel: Any) -> None:
                subscribed.put(channel.topic)

        # Kept, because channels close with it.
        self._context = context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name=name, host=host, port=port, server_listener=Listener(), context=context
            )
        except (RuntimeError, OSError) as error:
            raise StreamError(f"Foxglove: cannot listen on {host}:{port}: {error}; choose another port") from error
        self._channels = {}
        for topic, schema in schemas:
            data = foxglove.Schema(name=schema["title"], encoding="jsonschema", data=json.dumps(schema).encode())
            self._channels[topic] = foxglove.Channel(topic, schema=data, message_encoding="json", context=context)
        self.where = f"ws://{host}:{self._server.port}"

    def _publish(self, shown: ViewMessage) -> None:
        channel = self._channels.get(shown.topic)
        if channel is not None:
            channel.log(shown.payload, log_time=round(shown.t_s * _NS))

    def _new_subscriptions(self) -> set[str]:
        found: set[str] = set()
        while not self._subscribed.empty():
            found.add(self._subscribed.get())
        return found

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
        for channel in self._channels.values():
            channel.close()
