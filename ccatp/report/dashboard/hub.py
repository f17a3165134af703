"""Tells all open pages the same state, ten times a second, and one that begins all of it: server-sent events.

What the dashboard receives: the rare messages always, the frequent ones only while somebody looks.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import msgspec
import zmq

from ccatp.links.bus import Subscriber
from ccatp.report.dashboard.view import RunStateView


class Wants(NamedTuple):
    """The topics of one kind of mission.

    Attributes:
        main: what makes the page's history, and costs nothing to speak of; besides that of every mission.
    """

    main: tuple[str, ...]
    track: str
    truth: str
    once: tuple[str, ...]


SURVEY = Wants(("arrival", "fix", "scene"), "track", "truth", ())
BEACONS = Wants(("beacon_arrival", "beacon_map", "scene"), "beacon_track", "beacon_truth", ("beacon_places",))
_OF_MAIN = ("heartbeat.main", "mission", "log")
_OF_DANGER = ("heartbeat.danger", "danger_event")
# Taken at a time: a publisher that never pauses must not keep the pages waiting.
MOST = 2_000


class BusReader:
    """Subscriptions of the dashboard.

    Nobody waits for them: a run begins when its own processes listen, whoever looks on.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint_of: Callable[[str], str],
        view: RunStateView,
        *,
        is_sim: bool,
        wants: Wants = SURVEY,
    ) -> None:
        self._context, self._endpoint_of, self._view, self._is_sim = context, endpoint_of, view, is_sim
        self._wants = wants
        always = {"main": (*_OF_MAIN, *wants.main), "danger": _OF_DANGER}
        self._always = {
            name: Subscriber(context, [endpoint_of(name)], topics, is_watching=True, is_uncounted=True)
            for name, topics in always.items()
        }
        if is_sim and wants.once:
            self._always["truth"] = self._onlooker("truth", *wants.once)
        self._glancing: list[Subscriber] = []
        self._looking: list[Subscriber] = []

    def glance(self, wanted: bool) -> None:
        """Receive the levels, of which the newest counts, or do not any more."""
        if wanted and not self._glancing:
            self._glancing = [
                # Main puts a picture together for those who ask; a verdict must not be waited for in our place.
                Subscriber(self._context, [self._endpoint_of("main")], ["display_state"], keeps_newest=True),
                Subscriber(
                    self._context, [self._endpoint_of("danger")], ["verdict"], keeps_newest=True, is_uncounted=True
                ),
            ]
        elif not wanted and self._glancing:
            _close(self._glancing)
            self._view.look_away()

    def look(self, wanted: bool) -> None:
        """Receive the path as it is driven and, in simulation, the truth, or do not any more."""
        self._view.is_tracking = wanted
        if wanted and not self._looking:
            self._looking = [self._onlooker("main", self._wants.track)]
            if self._is_sim:
                self._looking.append(self._onlooker("truth", self._wants.truth))
        elif not wanted and self._looking:
            _close(self._looking)

    def drain(self, now_s: float) -> None:
        """Hand on what has come."""
        for name, subscriber in self._always.items():
            if subscriber.is_cut:
                self._view.links.cut(name, now_s)
        for subscriber in (*self._always.values(), *self._glancing, *self._looking):
            for _ in range(MOST):
                received = subscriber.receive()
                if received is None:
                    break
                self._view.hear(received[1], now_s)

    def close(self) -> None:
        """Close the sockets."""
        for subscribers in (self._glancing, self._looking):
            _close(subscribers)
        for subscriber in self._always.values():
            subscriber.close()

    def _onlooker(self, publisher: str, *topics: str) -> Subscriber:
        return Subscriber(self._context, [self._endpoint_of(publisher)], topics, is_uncounted=True)


def _close(subscribers: list[Subscriber]) -> None:
    for subscriber in subscribers:
        subscriber.close()
    subscribers.clear()


# Nobody looks: what has come is put away now and then.
IDLE_PERIOD_S = 0.5
# Whoever asked for the levels will ask again within this, or is gone.
GLANCE_S = 35.0
# Main tells a picture ten times a second, once it has been asked for one.
PICTURE_WAIT_S, PICTURE_LOOK_S = 0.3, 0.02
_encoder = msgspec.json.Encoder()


class EventStream:
    """What one page is told; one that cannot follow is told everything anew when it can."""

    def __init__(self) -> None:
        self._payload = b""
        self._is_full = asyncio.Event()
        self._is_over = False
        self.needs_all = True

    @property
    def has_taken(self) -> bool:
        """Whether the last payload is on its way."""
        return not self._is_full.is_set()

    def offer(self, payload: bytes) -> None:
        """The next payload."""
        self._payload = payload
        self._is_full.set()

    def end(self, payload: bytes | None = None) -> None:
        """No more after this, which replaces what was not taken."""
        self._is_over = True
        self.offer(self._payload if payload is None else payload)

    async def __aiter__(self) -> AsyncIterator[bytes]:
        """Payloads, until the end."""
        while True:
            await self._is_full.wait()
            self._is_full.clear()
            if self._payload:
                yield self._payload
            self._payload = b""
            if self._is_over:
                return


class StateBroadcaster:
    """Ticks while pages are open, and rests while none is."""

    def __init__(self, feed: BusReader, view: RunStateView, rate_hz: float) -> None:
        self._feed, self._view, self._period_s = feed, view, 1.0 / rate_hz
        self._streams: set[EventStream] = set()
        self._wake = asyncio.Event()
        self._glanced_s = float("-inf")
        self._is_over = False

    @property
    def pages(self) -> int:
        """Open ones."""
        return len(self._streams)

    @contextmanager
    def open(self) -> Iterator[EventStream]:
        """A page looks."""
        stream = EventStream()
        if self._is_over:
            stream.end()
        self._streams.add(stream)
        self._look()
        self._wake.set()
        try:
            yield stream
        finally:
            self._streams.discard(stream)
            self._look()

    def state(self) -> dict[str, Any]:
        """The levels, for a program that asks; the second time it asks they are all there."""
        self._glanced_s = now_s = time.monotonic()
        self._look()
        self._feed.drain(now_s)
        return self._view.status_data(now_s)

    async def whole_state(self) -> dict[str, Any]:
        """The same with the pose, for which main is waited for a little when nobody has looked before."""
        state, patience_s = self.state(), time.monotonic() + PICTURE_WAIT_S
        while state["pose"] is None and state["mission"] and not (state["is_over"] or state["losses"]):
            if time.monotonic() > patience_s:
                break
            await asyncio.sleep(PICTURE_LOOK_S)
            state = self.state()
        return state

    async def run(self, stop: asyncio.Event) -> None:
        """Tell the pages until ``stop`` is set; then tell them that this is the end."""
        due_s = time.monotonic()
        while not stop.is_set():
            self.tick()
            if not self._streams:
                await self._rest(stop)
                due_s = time.monotonic()
                continue
            # What was missed is not made up for: a page wants the present.
            due_s = max(due_s + self._period_s, time.monotonic())
            await _sleep_until(due_s, stop)
        self._is_over = True
        self.tick(is_last=True)

    def tick(self, *, is_last: bool = False) -> None:
        """Take what came, and tell it."""
        now_s = time.monotonic()
        self._feed.drain(now_s)
        news = self._view.news(now_s)
        streams = [stream for stream in self._streams if is_last or stream.has_taken]
        if not streams:
            return
        for stream in self._streams.difference(streams):
            stream.needs_all = True
        everything = b""
        if is_last or any(stream.needs_all for stream in streams):
            everything = _event("end" if is_last else "all", self._view.everything(now_s))
        told = _event("news", news)
        for stream in streams:
            if is_last:
                stream.end(everything)
            else:
                stream.offer(everything if stream.needs_all else told)
                stream.needs_all = False

    def _look(self) -> None:
        has_pages = bool(self._streams)
        self._feed.look(has_pages)
        self._feed.glance(has_pages or time.monotonic() - self._glanced_s < GLANCE_S)

    async def _rest(self, stop: asyncio.Event) -> None:
        self._look()
        self._wake.clear()
        async with asyncio.TaskGroup() as tasks:
            waits = [tasks.create_task(self._wake.wait()), tasks.create_task(stop.wait())]
            await asyncio.wait(waits, timeout=IDLE_PERIOD_S, return_when=asyncio.FIRST_COMPLETED)
            for wait in waits:
                wait.cancel()


async def _sleep_until(due_s: float, stop: asyncio.Event) -> None:
    try:
        async with asyncio.timeout(max(due_s - time.monotonic(), 0.0)):
            await stop.wait()
    except TimeoutError:
        return


def _event(name: str, data: dict[str, Any]) -> bytes:
    return b"event: " + name.encode() + b"\ndata: " + _encoder.encode(data) + b"\n\n"
