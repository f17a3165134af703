"""What the page holds of a long mission: `python -m tools.page_load [HOURS [SECONDS]]`.

A dashboard in a process of its own before a played daemon, and a page in Chromium, get the messages of so many hours
within so many seconds. Prints at ten moments the memory of the page (JavaScript heap after a collection) and of the
dashboard (resident).
"""

import asyncio
import json
import math
import multiprocessing
import random
import socket
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import psutil
import structlog
import zmq
from playwright.sync_api import CDPSession, Page, sync_playwright

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.daemon.operator.dashboard import serve_page
from ccatp.daemon.supervision.process import Endpoints, RunContext
from ccatp.links.bus import Publisher
from ccatp.links.topics import FixMessage, Heartbeat, TrackMessage, TruthMessage
from ccatp.report.dashboard.access import make_token
from tests.support.browser import CHROMIUM, FLAGS
from tests.support.page_rig import mission, picture

CFG = load_config(None, {"dashboard.max_connections": 256})
FRAMES, SPEED_M_S, RADIUS_M = 100, 0.1, 0.15  # frames a second; the robot drives in circles on a panel
MESSAGE_EVERY_S, FIX_EVERY_S, MOMENTS = 2, 4, 10


class Held(NamedTuple):
    """Memory, MB: of the page's heap, and of the dashboard's process."""

    page_mb: float
    server_mb: float


def _serve(cfg: Config, folder: Path, listener: socket.socket) -> None:
    run = RunContext(cfg, folder, Endpoints(folder), is_sim=True)
    page = serve_page(run, listener, asyncio.Event(), structlog.get_logger(), has_heartbeat=False)
    asyncio.run(page)


class PlayedDaemon:
    """Publishes what a mission would, a second of it at a time."""

    def __init__(self, context: "zmq.Context[zmq.Socket[bytes]]", folder: Path) -> None:
        endpoints = Endpoints(folder)
        self._main, self._danger, self._truth = (
            Publisher(context, endpoints.of(name)) for name in ("main", "danger", "truth")
        )
        self._log = (folder / "log.jsonl").open("a", buffering=1)
        self._draw = random.Random(1)
        self.second = 0

    def live(self) -> None:
        """Heartbeats and the state of the mission."""
        for publisher, name in ((self._main, "main"), (self._danger, "danger")):
            beat = Heartbeat(
                seq=self.second, t_s=time.monotonic(), process=name, pid=1, phase="joined", frame_age_s=0.0
            )
            publisher.send(f"heartbeat.{name}", beat)
        t_s = float(self.second)
        self._main.send("mission", mission(seq=self.second, t_s=t_s, elapsed_s=t_s, eta_s=3600.0, total=693))

    def play_second(self) -> None:
        """All topics of one second, and now and then a fix and a message."""
        begun, draw = FRAMES * self.second, self._draw
        rows, truth = [], []
        for seq in range(begun, begun + FRAMES):
            angle, t_s = SPEED_M_S / RADIUS_M * seq / FRAMES, seq / FRAMES
            x_m, y_m = RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle)
            rows.append((seq, t_s, 5, 5, x_m, y_m, 0.0, 1e-4))
            truth.append((seq, t_s, x_m, y_m, 0.0, 0.0, 0.0, 0.0, 1.0, 0, 0))
        end = begun + FRAMES - 1
        self._main.send("track", TrackMessage(seq=end, t_s=end / FRAMES, rows=rows))
        self._truth.send("truth", TruthMessage(seq=end, t_s=end / FRAMES, rows=truth))
        sample = picture(end)
        sample.t_s, sample.nis = float(self.second), draw.uniform(0.1, 4.0)
        self._main.send("display_state", sample)
        if self.second % FIX_EVERY_S == 0:
            self._main.send("fix", FixMessage(
                seq=end, t_s=float(self.second), point=None, is_fused=True, position_m=(0.0, 0.0, 0.0),
                covariance_m2=[0.0] * 9, dop=1.5, residual_rms_m=2e-6, channels=[1, 2, 3, 4],
                jump_mm=draw.expovariate(10.0),
            ))  # fmt: skip
        if self.second % MESSAGE_EVERY_S == 0:
            text = f"{self.word()}: a message unlike all before it"
            line = {"event": "operator_message", "level": "info", "timestamp": "2026-11-26T03:00:00Z", "text": text}
            self._log.write(json.dumps(line) + "\n")
        self.second += 1

    def word(self) -> str:
        """Of letters alone: lines that differ only in numbers are one line with a count."""
        return "".join(chr(ord("a") + int(digit)) for digit in str(self.second))

    def close(self) -> None:
        """Close sockets and log."""
        for publisher in (self._main, self._danger, self._truth):
            publisher.close()
        self._log.close()


class Load(NamedTuple):
    """The played daemon, the page before it, and what serves it."""

    daemon: PlayedDaemon
    page: Page
    heap: CDPSession
    port: int
    server: psutil.Process

    def held(self) -> Held:
        """Memory now."""
        self.heap.send("HeapProfiler.collectGarbage")
        used = self.heap.send("Runtime.getHeapUsage")["usedSize"]
        return Held(used / 1e6, self.server.memory_info().rss / 1e6)

    def play(self, seconds: int, per_s: float) -> None:
        """So many seconds of a mission, so many of them in a second."""
        due_s = time.monotonic()
        for k in range(seconds):
            self.daemon.play_second()
            if k % max(round(per_s / 10.0), 1) == 0:
                self.daemon.live()
                self.page.wait_for_timeout(1e3 * max(due_s - time.monotonic(), 0.0) + 1.0)
                self.until_received()
            due_s += 1.0 / per_s
        self.until_shown()

    def until_received(self) -> None:
        """Wait until the dashboard has what was published: truth that is late against its estimate is not shown."""
        for _ in range(6000):
            with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/status") as answer:
                state = json.load(answer)["mission"]
            if state is not None and state["elapsed_s"] >= self.daemon.second:
                return
            self.daemon.live()
            self.page.wait_for_timeout(10)
        raise AssertionError("the dashboard does not receive the state of the mission")

    def until_shown(self) -> None:
        """Wait until the page shows the last message."""
        first = self.page.locator("#log li span").first
        for _ in range(600):
            self.daemon.live()
            if self.page.locator("#log li").count() and self.last() in first.inner_text():
                return
            self.page.wait_for_timeout(100)
        raise AssertionError(f"the page shows {first.inner_text()!r}, not {self.last()!r}")

    def last(self) -> str:
        """The newest message, as far as it is unlike all others."""
        newest = (self.daemon.second - 1) // MESSAGE_EVERY_S * MESSAGE_EVERY_S
        return "".join(chr(ord("a") + int(digit)) for digit in str(newest)) + ": a message"


@contextmanager
def load() -> Iterator[Load]:
    """A dashboard, a played daemon and a page."""
    with (
        tempfile.TemporaryDirectory(prefix="ccatp-") as name,
        zmq.Context() as context,
        sync_playwright() as playwright,
    ):
        folder = Path(name)
        token = make_token(folder)
        daemon = PlayedDaemon(context, folder)
        with socket.create_server(("127.0.0.1", 0)) as listener:
            port = listener.getsockname()[1]
            process = multiprocessing.get_context("spawn").Process(target=_serve, args=(CFG, folder, listener))
            process.start()
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        try:
            page = browser.new_page(viewport={"width": 1440, "height": 900})
            page.goto(f"http://127.0.0.1:{port}/?token={token}")
            assert process.pid is not None
            heap = page.context.new_cdp_session(page)
            page.wait_for_timeout(500)
            for _ in range(50):  # the subscriptions arrive
                daemon.live()
                page.wait_for_timeout(20)
            yield Load(daemon, page, heap, port, psutil.Process(process.pid))
        finally:
            browser.close()
            process.kill()
            process.join()
            daemon.close()


def main(hours: float, seconds: float) -> None:
    """Play, and print memory ten times."""
    with load() as loaded:
        print(f"hours played: page, dashboard (MB)\n 0.0: {loaded.held().page_mb:.1f}, {loaded.held().server_mb:.1f}")
        for k in range(MOMENTS):
            loaded.play(round(3600.0 * hours / MOMENTS), 3600.0 * hours / seconds)
            held = loaded.held()
            print(f"{hours * (k + 1) / MOMENTS:4.1f}: {held.page_mb:.1f}, {held.server_mb:.1f}", flush=True)
        print(loaded.page.locator(".left-out").inner_text())


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 24.0, float(sys.argv[2]) if len(sys.argv) > 2 else 240.0)
