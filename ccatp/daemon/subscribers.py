"""Heartbeats, verdicts for main and estimates for danger; in lockstep a loop waits for the message of its frame."""

import os
import time
from collections.abc import Callable

import zmq

from ccatp.core import Verdict
from ccatp.links.bus import Publisher, Subscriber
from ccatp.links.topics import EstimateMessage, Heartbeat, last_estimate_before

# In lockstep simulated time stands still while a loop waits; longer than this the other loop hangs.
LOCKSTEP_WAIT_S = 10.0
# Between slices the heartbeat is sent, and the connection to the other loop is checked.
WAIT_SLICE_S = 0.02
# Danger is at most a few frames ahead of main: a number far beyond the present one is of the robot's last boot.
MAX_FRAMES_AHEAD = 100
PERIOD_S = 0.1


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
        # Renews a connection that is silent for long.
        self.maintain = self._subscriber.maintain
        self.close = self._subscriber.close

    def goes_on_waiting(self, deadline_s: float) -> bool:
        """Nothing came for a slice: whether the other process is there, and there is time until ``deadline_s``."""
        if self._subscriber.is_cut or time.monotonic() > deadline_s:
            return False
        self._on_wait()
        return True


class VerdictSubscriber(PeerSubscriber):
    """Receives danger's verdicts; ``timeout_s``: an older one is not in force."""

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
        """The verdict in force for frame ``seq``: in lockstep that of the frame before, else the newest that is fresh.

        In lockstep danger judges a frame while main serves it. Where danger did not judge the frame before, the
        verdict on an earlier one counts as long as it is fresh.
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
    """Receives main's estimates; ``is_taking_over``: the one for the first frame may have been missed."""

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
        self._judged_frame = self._judged = self._first_seq = -1

    def latest(self, seq: int, *, is_lockstep: bool) -> EstimateMessage | None:
        """The estimate to judge frame ``seq`` with: in lockstep always the same one, else the newest.

        Where several waited, after a stall, the newest counts, but the drives of each have moved the wheels:
        ``commanded`` spans those of all that no frame was judged with.
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
            # An estimate for a frame far ahead is of the robot's last boot.
            if isinstance(message, EstimateMessage) and message.seq <= seq + MAX_FRAMES_AHEAD:
                missed = self._newest if self._newest_seq > self._judged else None
                self._newest = message if missed is None else message.following(missed)
        if seq > self._judged_frame:  # an older one is not judged
            self._judged_frame, self._judged = seq, self._newest_seq
        return self._newest

    @property
    def _newest_seq(self) -> int:
        return -1 if self._newest is None else self._newest.seq


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
