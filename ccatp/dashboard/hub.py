"""Edge. Tells all open pages the same state, ten times a second, and one that begins all of it: server-sent events."""

import asyncio
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from typing import Any

import msgspec

from ccatp.dashboard.feed import Feed
from ccatp.dashboard.view import View

# Nobody looks: what has come is put away now and then.
IDLE_PERIOD_S = 0.5
# Whoever asked for the levels will ask again within this, or is gone.
GLANCE_S = 35.0
# Main tells a picture ten times a second, once it has been asked for one.
PICTURE_WAIT_S, PICTURE_LOOK_S = 0.3, 0.02
_encoder = msgspec.json.Encoder()


class Stream:
    """What one page is told; one that cannot follow is told everything anew when it can."""

    def __init__(self) -> None:
        """Just opened."""
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


class Hub:
    """Ticks while pages are open, and rests while none is.

    Args:
        feed: what comes in.
        view: what it amounts to.
        rate_hz: of the state.
    """

    def __init__(self, feed: Feed, view: View, rate_hz: float) -> None:
        """No page yet."""
        self._feed, self._view, self._period_s = feed, view, 1.0 / rate_hz
        self._streams: set[Stream] = set()
        self._wake = asyncio.Event()
        self._glanced_s = float("-inf")
        self._is_over = False

    @property
    def pages(self) -> int:
        """Open ones."""
        return len(self._streams)

    @contextmanager
    def open(self) -> Iterator[Stream]:
        """A page looks."""
        stream = Stream()
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
