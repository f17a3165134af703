"""Glue. What a loop hears of the other one: that it is there, and in lockstep what it has to wait for."""

import time
from collections.abc import Callable

import zmq

from ccatp.bus import Subscriber
from ccatp.samples import Verdict
from ccatp.wire.topics import Message, Presence

# In lockstep simulated time stands still while we wait; longer than this the other loop hangs.
LOCKSTEP_WAIT_S = 10.0
# How long to wait at a time: in between we are seen alive, and see whether the other one is gone.
SLICE_S = 0.02
# Danger is at most a few frames ahead of main: a number far beyond ours is of the robot's last boot.
MOST_AHEAD = 100


def await_message(
    subscriber: Subscriber, is_it: Callable[[Message | Verdict], bool], on_wait: Callable[[], None]
) -> None:
    """Receive messages until the one that lockstep waits for; not for ever, and not for a process that is gone.

    Args:
        subscriber: watches its publisher.
        is_it: takes each message; whether it was the one.
        on_wait: called now and then meanwhile.
    """
    deadline = time.monotonic() + LOCKSTEP_WAIT_S
    while True:
        received = subscriber.receive(SLICE_S)
        if received is not None:
            if is_it(received[1]):
                return
        elif subscriber.is_cut or time.monotonic() > deadline:
            return
        else:
            on_wait()


class VerdictEar:
    """Listens to the danger loop.

    Args:
        context: ZeroMQ context of the process.
        endpoint: where the danger loop publishes.
        timeout_s: a verdict older than this is none.
        on_wait: called now and then while lockstep waits for a verdict.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint: str,
        timeout_s: float,
        on_wait: Callable[[], None] = lambda: None,
    ) -> None:
        """Subscribe; the publisher may come up later."""
        self._subscriber = Subscriber(context, [endpoint], ["verdict", "presence.danger"], is_watching=True)
        self._timeout_s, self._on_wait = timeout_s, on_wait
        self._wall_s = 0.0
        self.verdict: Verdict | None = None

    def is_danger_joined(self) -> bool:
        """Whether it says that it has joined the robot; it repeats that."""
        while (received := self._subscriber.receive()) is not None:
            message = received[1]
            if isinstance(message, Presence) and message.phase == "joined":
                return True
        return False

    def tend(self) -> None:
        """Keep the connection up where nothing is heard for long."""
        self._subscriber.tend()

    def forget(self) -> None:
        """The robot's frames count anew: the verdict in force is of another time."""
        self.verdict = None

    def hear(self, seq: int, frame_s: float, *, is_lockstep: bool) -> Verdict | None:
        """The verdict in force: in lockstep that of this very frame, else the newest that is fresh.

        Args:
            seq: the present frame.
            frame_s: time between frames.
            is_lockstep: wait for the verdict on ``seq``.
        """
        newest = seq + MOST_AHEAD

        def take(message: Message | Verdict) -> bool:
            if isinstance(message, Verdict) and message.seq <= newest:
                self.verdict, self._wall_s = message, time.monotonic()
                return message.seq >= seq
            return False

        if not is_lockstep:
            while (received := self._subscriber.receive()) is not None:
                take(received[1])
        elif self.verdict is None or self.verdict.seq < seq:
            await_message(self._subscriber, take, self._on_wait)
        verdict = self.verdict
        if verdict is None or (is_lockstep and verdict.seq < seq):
            return None
        age_s = max((seq - verdict.seq) * frame_s, 0.0)
        if not is_lockstep:
            age_s = max(age_s, time.monotonic() - self._wall_s)
        return verdict if age_s <= self._timeout_s else None

    def close(self) -> None:
        """Close the socket."""
        self._subscriber.close()
