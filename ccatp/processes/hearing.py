"""Glue. What the main loop hears of the danger loop: that it is there, and the verdict in force."""

import time

import zmq

from ccatp.bus import Subscriber
from ccatp.samples import Verdict
from ccatp.wire.topics import Presence

# In lockstep simulated time stands still while we wait; longer than this the danger loop is gone.
LOCKSTEP_WAIT_S = 10.0


class VerdictEar:
    """Listens to the danger loop.

    Args:
        context: ZeroMQ context of the process.
        endpoint: where the danger loop publishes.
        timeout_s: a verdict older than this is none.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, timeout_s: float) -> None:
        """Subscribe; the publisher may come up later."""
        self._subscriber = Subscriber(context, [endpoint], ["verdict", "presence.danger"])
        self._timeout_s = timeout_s
        self._wall_s = 0.0
        self.verdict: Verdict | None = None

    def is_danger_joined(self) -> bool:
        """Whether it says that it has joined the robot; it repeats that."""
        while (received := self._subscriber.receive()) is not None:
            message = received[1]
            if isinstance(message, Presence) and message.phase == "joined":
                return True
        return False

    def hear(self, seq: int, frame_s: float, *, is_lockstep: bool) -> Verdict | None:
        """The verdict in force: in lockstep that of this very frame, else the newest that is fresh.

        Args:
            seq: the present frame.
            frame_s: time between frames.
            is_lockstep: wait for the verdict on ``seq``.
        """
        self._take(seq, is_lockstep)
        verdict = self.verdict
        if verdict is None or (is_lockstep and verdict.seq < seq):
            return None
        age_s = max((seq - verdict.seq) * frame_s, 0.0)
        if not is_lockstep:
            age_s = max(age_s, time.monotonic() - self._wall_s)
        return verdict if age_s <= self._timeout_s else None

    def _take(self, seq: int, is_lockstep: bool) -> None:
        deadline = time.monotonic() + LOCKSTEP_WAIT_S
        while True:
            must_wait = is_lockstep and (self.verdict is None or self.verdict.seq < seq)
            if is_lockstep and not must_wait:
                return
            received = self._subscriber.receive(deadline - time.monotonic() if must_wait else 0.0)
            if received is None:
                return
            if isinstance(received[1], Verdict):
                self.verdict, self._wall_s = received[1], time.monotonic()

    def close(self) -> None:
        """Close the socket."""
        self._subscriber.close()
