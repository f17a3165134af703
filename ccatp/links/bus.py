"""Messages of the processes over ZeroMQ PUB and SUB: publishers and subscribers of the topics.

In lockstep a loop waits for the message of its frame. The main loop publishes lines, tracks and times in batches.
"""

import os
import time
from collections.abc import Callable, Iterable
from typing import Any

import msgspec
import structlog
import zmq
from zmq.utils.monitor import parse_monitor_message

from ccatp.core import Verdict
from ccatp.links.bus_codec import BadMessage, pack, prefix_of, unpack
from ccatp.links.topics import (
    LEVELS,
    OPERATOR_MESSAGE,
    EstimateMessage,
    Heartbeat,
    LogMessage,
    Message,
    SensorLines,
    SessionMessage,
    Timing,
    last_estimate_before,
)

MAX_MESSAGE_BYTES = 1 << 20
# A lockstep run publishes some thousand frames a second; this is several seconds of them, about 100 MB at the worst.
HIGH_WATER_MARK = 50_000
# A subscriber may start before its publisher, and should then connect soon.
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
        """Publish one message: topic, space, JSON."""
        self._socket.send(pack(name, message), zmq.DONTWAIT)

    def has_subscriber(self, name: str) -> bool:
        """Whether a subscriber of a topic is connected; what was published before, it does not receive."""
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
    """Receives topics from one or more publishers, which may start later.

    ``is_watching``: watch the connection, for ``is_cut``; with one publisher only. ``is_uncounted``: ``has_subscriber``
    of the publisher does not count this one. ``keeps_newest``: of the waiting messages only the newest one is kept,
    whatever its topic.
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
            # Every message is an object, so a prefix with a brace matches, too, but is not the one of `has_subscriber`.
            self.socket.setsockopt(zmq.SUBSCRIBE, prefix_of(name) + (b"{" if is_uncounted else b""))
        for endpoint in endpoints:
            self.socket.connect(endpoint)
        self._timeout_s = -1.0
        self.bad_messages = 0

    def receive(self, timeout_s: float = 0.0) -> tuple[str, bytes, Message | Verdict] | None:
        """Topic, JSON text and message of the next frame, or ``None`` when none came within ``timeout_s``.

        Bad ones are counted and dropped.
        """
        if timeout_s != self._timeout_s:
            self.socket.setsockopt(zmq.RCVTIMEO, round(1000 * timeout_s))
            self._timeout_s = timeout_s
        while True:
            try:
                return unpack(self.socket.recv())
            except zmq.Again:
                return None
            except BadMessage:
                self.bad_messages += 1

    def maintain(self) -> None:
        """Send the subscriptions to a new publisher; to be called now and then if nothing is received for long.

        libzmq sends them only while the thread that owns the socket calls one of its functions.
        """
        self.socket.getsockopt(zmq.EVENTS)

    @property
    def is_cut(self) -> bool:
        """The publisher was connected and is no longer, as after the end of its process."""
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


# In lockstep simulated time stops while a loop waits. After this time the other loop counts as hanging.
LOCKSTEP_WAIT_S = 10.0
# Between slices the heartbeat is sent, and the connection to the other loop is checked.
WAIT_SLICE_S = 0.02
# Danger is at most a few frames ahead of main: a much larger frame number belongs to the last boot of the robot.
MAX_FRAMES_AHEAD = 100


class PeerSubscriber:
    """Receives what the other loop publishes for each frame, and its heartbeats.

    Args:
        topics: of the messages.
        on_wait: called now and then while lockstep waits.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint: str,
        topics: tuple[str, ...],
        on_wait: Callable[[], None],
    ) -> None:
        self._subscriber = Subscriber(context, [endpoint], topics, is_watching=True)
        self._on_wait = on_wait
        # Sends subscriptions to a publisher that was restarted.
        self.maintain = self._subscriber.maintain
        self.close = self._subscriber.close

    def goes_on_waiting(self, deadline_s: float) -> bool:
        """Whether to wait for another slice: the other process is connected, and ``deadline_s`` is not over."""
        if self._subscriber.is_cut or time.monotonic() > deadline_s:
            return False
        self._on_wait()
        return True


class VerdictSubscriber(PeerSubscriber):
    """Receives the verdicts of danger; one that is older than ``timeout_s`` is not in force."""

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint: str,
        timeout_s: float,
        on_wait: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(context, endpoint, ("verdict", "heartbeat.danger"), on_wait)
        self._timeout_s, self._wall_s = timeout_s, 0.0
        self.verdict: Verdict | None = None
        self._early: Verdict | None = None

    def is_danger_joined(self) -> bool:
        """Whether danger has reported that it joined the robot; it repeats that."""
        while (received := self._subscriber.receive()) is not None:
            message = received[2]
            if isinstance(message, Heartbeat) and message.phase == "joined":
                return True
        return False

    def reset(self) -> None:
        """The robot's frames restarted: forget the verdict."""
        self.verdict = self._early = None

    def latest(self, seq: int, frame_s: float, *, is_lockstep: bool) -> Verdict | None:
        """The verdict in force for frame ``seq``: in lockstep that on the frame before, else the newest.

        ``None`` if it is older than ``timeout_s``. In lockstep danger judges a frame while main serves it. If danger
        did not judge the frame before, the verdict on an earlier one counts.
        """
        if self._early is not None and self._early.seq < seq:
            self.verdict, self._early = self._early, None
        wait_s, deadline_s = (WAIT_SLICE_S if is_lockstep else 0.0), time.monotonic() + LOCKSTEP_WAIT_S
        while not is_lockstep or (self._early is None and (self.verdict is None or self.verdict.seq < seq - 1)):
            received = self._subscriber.receive(wait_s)
            if received is None:
                if is_lockstep and self.goes_on_waiting(deadline_s):
                    continue
                break
            message = received[2]
            if not isinstance(message, Verdict) or message.seq > seq + MAX_FRAMES_AHEAD:
                continue
            if is_lockstep and message.seq >= seq:
                self._early = message
            else:
                self.verdict, self._wall_s = message, time.monotonic()
        verdict = self.verdict
        if verdict is None or (is_lockstep and verdict.seq < seq - 1 and self._early is None):
            return None
        age_s = max((seq - verdict.seq) * frame_s, 0.0)
        if not is_lockstep:
            age_s = max(age_s, time.monotonic() - self._wall_s)
        return verdict if age_s <= self._timeout_s else None


class EstimateSubscriber(PeerSubscriber):
    """Receives main's estimates; ``is_taking_over``: that before the first frame may have been missed."""

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint: str,
        on_wait: Callable[[], None] = lambda: None,
        *,
        is_taking_over: bool = False,
    ) -> None:
        super().__init__(context, endpoint, ("estimate", "heartbeat.main"), on_wait)
        self._is_taking_over = is_taking_over
        self.reset()

    def has_received(self) -> bool:
        """Whether a message was received."""
        return self._subscriber.receive() is not None

    def reset(self) -> None:
        """The robot's frames restarted: forget the estimate."""
        self._newest: EstimateMessage | None = None
        self._newest_seq = self._judged_frame = self._judged = self._first_seq = -1

    def latest(self, seq: int, *, is_lockstep: bool) -> EstimateMessage | None:
        """The estimate for the verdict on frame ``seq``: in lockstep always the same one, else the newest.

        If several waited, after a stall, the newest one counts. Its ``commanded`` includes the set points of all
        estimates that were not used for a verdict, because their drives have moved the wheels, too.
        """
        if self._first_seq < 0:
            self._first_seq = seq + self._is_taking_over
        wanted = last_estimate_before(seq)
        is_waiting = is_lockstep and wanted >= self._first_seq
        wait_s, deadline_s = (WAIT_SLICE_S if is_waiting else 0.0), time.monotonic() + LOCKSTEP_WAIT_S
        while not is_lockstep or (is_waiting and self._newest_seq < wanted):
            received = self._subscriber.receive(wait_s)
            if received is None:
                if is_waiting and self.goes_on_waiting(deadline_s):
                    continue
                break
            message = received[2]
            # An estimate for a much later frame belongs to the last boot of the robot.
            if isinstance(message, EstimateMessage) and message.seq <= seq + MAX_FRAMES_AHEAD:
                missed = self._newest if self._newest_seq > self._judged else None
                self._newest = message if missed is None else message.following(missed)
                self._newest_seq = message.seq
        if seq > self._judged_frame:  # an older one is not judged
            self._judged_frame, self._judged = seq, self._newest_seq
        return self._newest


PERIOD_S = 0.1


class HeartbeatPublisher:
    """Publishes the heartbeat of one process.

    Attributes:
        phase: starting, ready, joined, rejoining (the robot is away), done.
        frame_s: time of the monotonic clock at which the newest frame was served, ``None`` before the first.
    """

    def __init__(self, publisher: Publisher, process: str) -> None:
        self._publisher, self._process = publisher, process
        self.phase = "starting"
        self.frame_s: float | None = None
        self._count, self._published_s = 0, 0.0

    @property
    def frame_age_s(self) -> float | None:
        """Time since the newest frame was served."""
        return None if self.frame_s is None else time.monotonic() - self.frame_s

    def publish(self) -> None:
        """Publish now."""
        self._published_s = now_s = time.monotonic()
        age_s, pid = self.frame_age_s, os.getpid()
        heartbeat = Heartbeat(
            seq=self._count, t_s=now_s, process=self._process, pid=pid, phase=self.phase, frame_age_s=age_s
        )
        self._publisher.send(f"heartbeat.{self._process}", heartbeat)
        self._count += 1

    def publish_if_due(self) -> None:
        """Publish if it is due."""
        if time.monotonic() - self._published_s >= PERIOD_S:
            self.publish()


# Frames per batch, one second: small enough for the bus, large enough for a small cost per frame.
BATCH_FRAMES = 100
# After this wall time a batch is sent even if it is not full, so that displays are up to date in real time.
BATCH_WALL_S = 0.25


class Telemetry:
    """Publishes for the main loop.

    Args:
        topic, track: topic and message of a batch of estimates.

    Attributes:
        send: publishes one message of a topic.
        seq, t_s: the newest frame.
        frames_before: the recorded number of a frame is its ``seq`` plus this.
        newest_line: of the newest frame with an estimate.
        tick_us: wall times of frames for the next batch.
    """

    def __init__(
        self,
        publisher: Publisher,
        log: structlog.typing.FilteringBoundLogger,
        topic: str,
        track: Callable[..., Message],
    ) -> None:
        self.send, self.log, self._topic, self._track = publisher.send, log, topic, track
        self._lines: list[msgspec.Raw] = []
        self._rows: list[tuple[Any, ...]] = []
        self.tick_us: list[float] = []
        self._flushed_wall_s = time.monotonic()
        self.frames_before = 0
        self.newest_line = msgspec.Raw(b"null")
        self.seq = -1
        self.t_s = 0.0

    def continue_numbering(self) -> None:
        """The robot's frames restarted: the recorded numbers continue after the newest known frame."""
        self.flush()
        self.frames_before += max(self.seq, 0)
        self.seq = -1  # it may restart again before its first frame

    def begin_session(self, boot: int, session: int) -> None:
        """Record which frames come from now on; batches do not go over it."""
        self.flush()
        self.send(
            "session",
            SessionMessage(seq=self.seq, t_s=self.t_s, boot=boot, session=session, frames_before=self.frames_before),
        )

    def add_frame(self, seq: int, t_s: float, raw: bytes, row: tuple[Any, ...]) -> None:
        """Keep the line of frame ``seq`` and its row of the track, which has the recorded number."""
        self.t_s, self.newest_line = t_s, msgspec.Raw(raw)
        self._rows.append(row)
        self.seq = seq
        self._lines.append(self.newest_line)
        if len(self._lines) >= BATCH_FRAMES:
            self.flush()

    def add_line(self, seq: int, raw: bytes) -> None:
        """Keep only the line of a frame that is not newer than the last one."""
        self.seq = seq
        self._lines.append(msgspec.Raw(raw))
        if len(self._lines) >= BATCH_FRAMES:
            self.flush()

    def flush(self, least_age_s: float = 0.0) -> None:
        """Publish the batches if they were published at least ``least_age_s`` ago."""
        now_s = time.monotonic()
        if now_s - self._flushed_wall_s < least_age_s:
            return
        self._flushed_wall_s = now_s
        if not self._lines:
            return
        seq, t_s = self.seq, self.t_s
        if self._rows:
            self.send(self._topic, self._track(seq=seq, t_s=t_s, rows=self._rows))
            self.send("timing", Timing(seq=seq, t_s=t_s, tick_us=self.tick_us))
        self.send("sensors", SensorLines(seq=seq, t_s=t_s, lines=self._lines))
        self._lines, self._rows, self.tick_us = [], [], []

    def notify_operator(self, level: str, text: str) -> None:
        """One line for the log file and for the operator's terminal."""
        self.log.log(LEVELS[level], OPERATOR_MESSAGE, text=text, seq=self.seq, t_s=self.t_s)
        self.send("log", LogMessage(seq=self.seq, t_s=self.t_s, level=level, process="main", text=text))
