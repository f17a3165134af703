"""State shared between the processes over ZeroMQ PUB and SUB: single frames of the topic table."""

from collections.abc import Iterable

import zmq
from zmq.utils.monitor import parse_monitor_message

from ccatp.core import Verdict
from ccatp.links.topics import BY_NAME, BadMessage, Message, pack, unpack

MAX_MESSAGE_BYTES = 1 << 20
# A lockstep run publishes some thousand frames a second; this is several seconds of them, about 100 MB at the worst.
HIGH_WATER_MARK = 50_000
# A subscriber comes up before its publisher; it should not miss the first messages for long.
RECONNECT_MS = 10


class Publisher:
    """Publishes topics on one endpoint; never blocks, drops the newest when a subscriber is too slow."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str) -> None:
        self._socket = context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, HIGH_WATER_MARK)
        self._socket.bind(endpoint)
        self._subscribed: set[str] = set()

    def send(self, name: str, message: Message | Verdict) -> None:
        """Publish one message."""
        self._socket.send(pack(name, message), zmq.DONTWAIT)

    def has_subscriber(self, name: str) -> bool:
        """Whether a subscription to a topic has arrived; what is published before is lost to it."""
        while True:
            try:
                change = self._socket.recv(zmq.DONTWAIT)
            except zmq.Again:
                return name in self._subscribed
            topic = change[1:].decode("ascii", "replace").strip()
            (self._subscribed.add if change[:1] == b"\x01" else self._subscribed.discard)(topic)

    def close(self) -> None:
        """Close the socket; what was not delivered is dropped."""
        self._socket.close()


class Subscriber:
    """Receives topics from one or more publishers, which may come up later.

    ``is_watching``: watch the connection, for ``is_cut``; of one publisher only. ``is_uncounted``: a publisher that
    waits for its subscribers does not count this one (``has_subscriber``). ``keeps_newest``: of messages that wait only
    the newest is kept, whatever its topic.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoints: Iterable[str],
        topics: Iterable[str],
        *,
        is_watching: bool = False,
        is_uncounted: bool = False,
        keeps_newest: bool = False,
    ) -> None:
        self.socket = context.socket(zmq.SUB)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.setsockopt(zmq.RCVHWM, HIGH_WATER_MARK)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        self.socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS)
        self._monitor = (
            self.socket.get_monitor_socket(zmq.EVENT_CONNECTED | zmq.EVENT_DISCONNECTED) if is_watching else None
        )
        self._is_cut = False
        if keeps_newest:
            self.socket.setsockopt(zmq.CONFLATE, 1)
        for name in topics:
            # Every message is an object: with its brace the prefix fits as well, and is not the one that is waited for.
            self.socket.setsockopt(zmq.SUBSCRIBE, BY_NAME[name].name.encode() + (b" {" if is_uncounted else b" "))
        for endpoint in endpoints:
            self.socket.connect(endpoint)
        self._timeout_ms = -1
        self.bad_messages = 0

    def receive(self, timeout_s: float = 0.0) -> tuple[str, bytes, Message | Verdict] | None:
        """Topic, JSON text and message of the next frame, or ``None`` when none came within ``timeout_s``.

        Bad ones are counted and dropped.
        """
        timeout_ms = round(1000 * timeout_s)
        if timeout_ms != self._timeout_ms:
            self.socket.setsockopt(zmq.RCVTIMEO, timeout_ms)
            self._timeout_ms = timeout_ms
        while True:
            try:
                return unpack(self.socket.recv())
            except zmq.Again:
                return None
            except BadMessage:
                self.bad_messages += 1

    def maintain(self) -> None:
        """Let a new publisher learn the subscriptions; to be called now and then where nothing is received for long.

        The library sends them from the thread that owns the socket, and only when that calls.
        """
        self.socket.getsockopt(zmq.EVENTS)

    @property
    def is_cut(self) -> bool:
        """The publisher was there and is gone, as when its process has died."""
        while self._monitor is not None and self._monitor.poll(0):
            event = parse_monitor_message(self._monitor.recv_multipart())["event"]
            self._is_cut = event == zmq.EVENT_DISCONNECTED
        return self._is_cut

    def close(self) -> None:
        """Close the socket."""
        if self._monitor is not None:
            self.socket.disable_monitor()
            self._monitor.close()
        self.socket.close()
