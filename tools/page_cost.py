"""What the dashboard costs: `python -m tools.page_cost [SECONDS [ROUNDS]]`.

A simulated run on the wall clock, with none to fifty open pages in turns: processor time and memory of the dashboard,
and of main's ticks the median and the 99th percentile. Pages are plain clients, as a browser has a machine of its own.
"""

import socket
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import psutil
import zmq

from ccatp.links.bus import Subscriber
from ccatp.links.topics import Timing
from tests.support.dashboards import WITH_PAGE, open_page, page_port
from tests.support.runs import NO_CALIBRATION, Run

PAGES = (0, 1, 3, 50)
ROOM = ("--set", "dashboard.max_connections=128")  # half of them for one address
OPENING_S = 1.5


def drain(page: socket.socket) -> None:
    """Take everything until the end."""
    with suppress(OSError):
        while page.recv(65_536):
            pass


def ticks_us(subscriber: Subscriber, seconds: float) -> np.ndarray:
    """Main's ticks while this time passes."""
    end_s = time.monotonic() + seconds
    ticks: list[float] = []
    while (left_s := end_s - time.monotonic()) > 0.0:
        received = subscriber.receive(left_s)
        if received is not None and isinstance(received[2], Timing):
            ticks += received[2].tick_us
    return np.array(ticks)


def busy_s(process: psutil.Process) -> float:
    """Processor time so far."""
    times = process.cpu_times()
    return float(times.user + times.system)


def look(port: int, dashboard: psutil.Process, subscriber: Subscriber, pages: int, seconds: float) -> list[float]:
    """Share of a core (%), memory (MB), median and 99th percentile of the ticks (us), with so many pages open."""
    with ExitStack() as stack:
        for _ in range(pages):
            page = stack.enter_context(open_page(port))
            threading.Thread(target=drain, args=(page,), daemon=True).start()
            stack.callback(page.shutdown, socket.SHUT_RDWR)
        time.sleep(OPENING_S)
        begun_s, before_s = time.monotonic(), busy_s(dashboard)
        ticks = ticks_us(subscriber, seconds)
        share = 100.0 * (busy_s(dashboard) - before_s) / (time.monotonic() - begun_s)
    return [share, dashboard.memory_info().rss / 1e6, float(np.median(ticks)), float(np.percentile(ticks, 99))]


def main(seconds: float, rounds: int) -> None:
    """Measure, and print a line for each number of pages."""
    rows: dict[int, list[list[float]]] = {pages: [] for pages in PAGES}
    with tempfile.TemporaryDirectory(prefix="ccatp-") as folder, zmq.Context() as context:
        sockets = Path(folder)
        with Run(sockets / "run", sockets, "--realtime", *WITH_PAGE, *ROOM, *NO_CALIBRATION) as run:
            run.until_state("driving")
            subscriber = Subscriber(context, [f"ipc://{sockets / 'main'}"], ["timing"])
            for k in range(rounds):
                for pages in PAGES if k % 2 == 0 else reversed(PAGES):
                    rows[pages].append(look(page_port(run), run.child("dashboard"), subscriber, pages, seconds))
            subscriber.close()
    for pages, found in rows.items():
        share, memory_mb, p50, p99 = np.median(np.array(found), axis=0)
        of_dashboard = f"dashboard {share:.2f} % of a core, {memory_mb:.0f} MB"
        print(f"{pages} pages: {of_dashboard}; main's ticks p50 {p50:.0f} us, p99 {p99:.0f} us")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 15.0, int(sys.argv[2]) if len(sys.argv) > 2 else 4)
