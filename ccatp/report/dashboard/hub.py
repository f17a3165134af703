"""Reads the bus and sends the same state to all open pages as server-sent events."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from typing import Any, NamedTuple

import msgspec
import zmq

from ccatp.links.bus import Subscriber
from ccatp.report.dashboard.view import RunStateView


class Wants(NamedTuple):
    """The topics of one kind of mission."""

    main: tuple[str, ...]  # low-rate topics in addition to those of every mission
    track: str  # published in batches, at least once a second
    truth: str  # published in the same way
    once: tuple[str, ...]


SURVEY = Wants(("arrival", "fix", "scene"), "track", "truth", ())


class Page(NamedTuple):
    """The page of one run: its state, a second view for the recorded past, constant data, topics."""

    view: RunStateView
    past: RunStateView
    ground: dict[str, Any]
    wants: Wants


_OF_MAIN = ("heartbeat.main", "mission")
_OF_DANGER = ("heartbeat.danger", "danger_event")
# From one subscriber at a time: a publisher that never pauses must not delay the pages.
MAX_MESSAGES = 2_000


class BusReader:
    """Subscriptions of the dashboard: low-rate topics always, the others on request."""

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], endpoint_of: Callable[[str], str], view: RunStateView,
        *, is_sim: bool, wants: Wants = SURVEY,
    ) -> None:  # fmt: skip
        self._context, self._endpoint_of, self._view = context, endpoint_of, view
        # Counted subscribers have an effect: the main loop publishes every display state if it has one, and a daemon
        # waits for a subscriber of the verdict. Only the subscription to every display state may count.
        uncounted, watched = {"is_uncounted": True}, {"is_uncounted": True, "is_watching": True}
        newest = {"keeps_newest": True}
        # For each group of subscriptions: publisher, topics, options.
        self._rows: dict[str, list[tuple[str, tuple[str, ...], dict[str, bool]]]] = {
            "always": [("main", (*_OF_MAIN, *wants.main, wants.track), watched), ("danger", _OF_DANGER, watched)],
            "levels": [("main", ("display_state",), newest), ("danger", ("verdict",), newest | uncounted)],
            "samples": [("main", ("display_state",), uncounted)],
        }
        if is_sim:
            self._rows["always"].append(("truth", (wants.truth, *wants.once), uncounted))
        self._open: dict[str, dict[str, Subscriber]] = {name: {} for name in self._rows}
        self._read("always", True)

    def read(self, *, levels: bool) -> None:
        """With ``levels``, read display state and verdict ten times a second, else only samples of the former."""
        if self._open["levels"] and not levels:
            self._view.discard_picture()
        self._view.is_watched = levels
        self._read("levels", levels)
        self._read("samples", not levels)

    def drain(self, now_s: float) -> None:
        """Pass received messages and new data of the run directory to the view."""
        self._view.read_files()
        for name, subscriber in self._open["always"].items():
            if subscriber.is_cut:
                self._view.links.cut(name, now_s)
        for subscriber in (one for group in self._open.values() for one in group.values()):
            for _ in range(MAX_MESSAGES):
                received = subscriber.receive()
                if received is None:
                    break
                self._view.receive(received[2], now_s)

    def close(self) -> None:
        """Close sockets and files; they are not opened again when a page closes later."""
        self._view.close()
        for name in self._rows:
            self._read(name, False)
        self._rows = {name: [] for name in self._rows}

    def _read(self, name: str, wanted: bool) -> None:
        opened = self._open[name]
        if wanted and not opened:
            for publisher, topics, how in self._rows[name]:
                opened[publisher] = Subscriber(self._context, [self._endpoint_of(publisher)], topics, **how)
        elif not wanted:
            for subscriber in opened.values():
                subscriber.close()
            opened.clear()


# After a request for the state the levels stay subscribed for this time.
LEVELS_S = 35.0
# The main loop publishes display states ten times a second while it has a subscriber.
PICTURE_WAIT_S, PICTURE_POLL_S = 0.3, 0.02
_encoder = msgspec.json.Encoder()


class StateBroadcaster:
    """Sends the state to the open pages at a fixed rate."""

    def __init__(self, reader: BusReader, view: RunStateView, rate_hz: float) -> None:
        self._reader, self._view, self._period_s = reader, view, 1.0 / rate_hz
        # Next payload of each open page, and whether it must be the whole state, as for a new page or a slow one.
        self._pages: dict[asyncio.Queue[bytes], bool] = {}
        self._requested_s = float("-inf")
        self._is_over = False

    @property
    def pages(self) -> int:
        """Number of open pages."""
        return len(self._pages)

    def send_everything(self) -> None:
        """Send the whole state next, because earlier rows have changed."""
        self._pages = dict.fromkeys(self._pages, True)

    async def events(self) -> AsyncIterator[bytes]:
        """The events for one page, until the broadcaster stops."""
        page: asyncio.Queue[bytes] = asyncio.Queue(maxsize=1)
        self._pages[page] = True
        self._subscribe()
        try:
            while not (self._is_over and page.empty()):
                yield await page.get()
        finally:
            del self._pages[page]
            self._subscribe()

    def state(self) -> dict[str, Any]:
        """The levels; the first request has no pose and no sensors, see ``whole_state``."""
        self._requested_s = now_s = time.monotonic()
        self._subscribe()
        self._reader.drain(now_s)
        return self._view.status_data(now_s)

    async def whole_state(self) -> dict[str, Any]:
        """The levels with the pose; waits up to ``PICTURE_WAIT_S`` for the main loop to publish the pose."""
        state, patience_s = self.state(), time.monotonic() + PICTURE_WAIT_S
        while state["pose"] is None and state["mission"] and not (state["is_over"] or state["losses"]):
            if time.monotonic() > patience_s:
                break
            await asyncio.sleep(PICTURE_POLL_S)
            state = self.state()
        return state

    async def run(self, stop: asyncio.Event) -> None:
        """Send until ``stop`` is set; then end all streams."""
        due_s = time.monotonic()
        while not stop.is_set():
            self._subscribe()
            self.tick()
            # Missed ticks are dropped: a page shows the current state.
            due_s = max(due_s + self._period_s, time.monotonic())
            with suppress(TimeoutError):
                async with asyncio.timeout(max(due_s - time.monotonic(), 0.0)):
                    await stop.wait()
        self._is_over = True
        self.tick(is_last=True)

    def tick(self, *, is_last: bool = False) -> None:
        """Read the bus and send the state."""
        now_s = time.monotonic()
        self._reader.drain(now_s)
        news = self._view.news(now_s)
        pages = [page for page in self._pages if is_last or page.empty()]
        if not pages:
            return
        self._pages |= dict.fromkeys(self._pages.keys() - pages, True)
        everything = b""
        if is_last or any(self._pages[page] for page in pages):
            everything = _event("end" if is_last else "all", self._view.everything(now_s))
        payload = _event("news", news)
        for page in pages:
            if not page.empty():
                page.get_nowait()  # the end replaces an unread payload
            page.put_nowait(everything if is_last or self._pages[page] else payload)
            self._pages[page] = False

    def _subscribe(self) -> None:
        has_pages = bool(self._pages)
        is_asked = time.monotonic() - self._requested_s < LEVELS_S
        self._reader.read(levels=has_pages or is_asked)


def _event(name: str, data: dict[str, Any]) -> bytes:
    return b"event: " + name.encode() + b"\ndata: " + _encoder.encode(data) + b"\n\n"
