"""State shared between the processes: single frames of the topic table, over ZeroMQ and between the loops directly."""

import socket
import struct
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from select import POLLHUP, poll

import zmq
from zmq.utils.monitor import parse_monitor_message

from ccatp.core import Verdict
from ccatp.links.topics import BY_NAME, BadMessage, Message, pack, unpack

MAX_MESSAGE_BYTES = 1 << 20
# A lockstep run publishes some thousand frames a second; this is several seconds of them, about 100 MB at the worst.
HIGH_WATER_MARK = 50_000
# A subscriber comes up before its publisher; it should not miss the first messages for long.
RECONNECT_MS = 10
# What main and danger need of each other in every frame.
DIRECT_TOPICS = frozenset(("estimate", "verdict"))
MAX_PACKET_BYTES = 8192


class PeerSocket:
    """Packets between main and danger, both ways: a call each, while a frame on the bus wakes a thread at either end.

    Danger listens, main connects; ``maintain`` does so again after a restart of either. What the other loop does not
    take is dropped, the newest first.

    Attributes:
        is_new: the other loop has connected since this was last set to False.
        dropped, bad_messages: packets that were not sent, and that were no messages.
    """

    def __init__(self, path: Path, *, is_listening: bool = False) -> None:
        self._path, self._listener, self._socket = str(path), None, None
        self._timeout_s = -1.0
        self.is_new, self.dropped, self.bad_messages = False, 0, 0
        if is_listening:
            path.unlink(missing_ok=True)  # of a process that died
            self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            self._listener.setblocking(False)
            self._listener.bind(self._path)
            self._listener.listen(1)

    _listener: socket.socket | None
    _socket: socket.socket | None

    @property
    def is_connected(self) -> bool:
        """The other loop is there, as far as ``receive`` and ``maintain`` have noticed."""
        return self._socket is not None

    def maintain(self) -> None:
        """Connect, where the other loop is there and not connected; to be called all the time."""
        if self._listener is not None:
            with suppress(BlockingIOError):
                self._begin(self._listener.accept()[0])
            return
        if self._socket is not None:
            hung_up = poll()
            hung_up.register(self._socket, POLLHUP)
            if not hung_up.poll(0):
                return
            self.disconnect()
        peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            peer.setblocking(False)
            peer.connect(self._path)
        except OSError:
            peer.close()
        else:
            self._begin(peer)

    def _begin(self, peer: socket.socket) -> None:
        self.disconnect()
        peer.setblocking(True)
        self._socket, self._timeout_s, self.is_new = peer, -1.0, True

    def send(self, name: str, message: Message | Verdict) -> None:
        """Send one message."""
        self.send_frame(pack(name, message))

    def send_frame(self, frame: bytes) -> None:
        """Send what ``pack`` made of a message."""
        if self._socket is not None:
            try:
                self._socket.send(frame, socket.MSG_DONTWAIT)
            except OSError:  # it does not read, or is gone, which ``receive`` and ``maintain`` notice
                self.dropped += 1

    def receive(self, timeout_s: float = 0.0) -> Message | Verdict | None:
        """The next message; ``None`` where none came within ``timeout_s``, or the other loop is gone."""
        while (peer := self._socket) is not None:
            try:
                if timeout_s:
                    if timeout_s != self._timeout_s:
                        self._timeout_s = timeout_s
                        option = struct.pack("@ll", int(timeout_s), int(1e6 * (timeout_s % 1.0)))
                        peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, option)
                    frame = peer.recv(MAX_PACKET_BYTES)
                else:
                    frame = peer.recv(MAX_PACKET_BYTES, socket.MSG_DONTWAIT)
                if frame:
                    return unpack(frame)[2]
                self.disconnect()
            except BlockingIOError:
                return None
            except OSError:
                self.disconnect()
            except BadMessage:
                self.bad_messages += 1
        return None

    def disconnect(self) -> None:
        """Drop the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def close(self) -> None:
        """Close the sockets."""
        self.disconnect()
        if self._listener is not None:
            self._listener.close()


class Publisher:
    """Publishes topics on one endpoint; never blocks, drops the newest when a subscriber is too slow.

    ``peer``: gets ``DIRECT_TOPICS``. They are published, too, while ``has_subscriber``, to be called now and then, has
    found a subscriber.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, peer: PeerSocket | None = None) -> None:
        self._peer = peer
        self._socket = context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, HIGH_WATER_MARK)
        self._socket.bind(endpoint)
        self._subscribed: set[str] = set()

    def send(self, name: str, message: Message | Verdict) -> None:
        """Publish one message."""
        frame = pack(name, message)
        if self._peer is not None and name in DIRECT_TOPICS:
            self._peer.send_frame(frame)
            if name not in self._subscribed:
                return
        self._socket.send(frame, zmq.DONTWAIT)

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

    def receive(self, timeout_s: float = 0.0) -> tuple[str, Message | Verdict] | None:
        """The next message, or ``None`` when none came within ``timeout_s``. Bad ones are counted and dropped."""
        received = self.receive_raw(timeout_s)
        return None if received is None else (received[0], received[2])

    def receive_raw(self, timeout_s: float = 0.0) -> tuple[str, bytes, Message | Verdict] | None:
        """As ``receive``, with the JSON text in the middle."""
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
