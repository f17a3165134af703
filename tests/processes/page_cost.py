"""What the dashboard costs: `python -m tests.processes.page_cost [SECONDS [ROUNDS]]`.

A simulated run on the wall clock, with no page, one and three open ones in turns: processor time of the dashboard, and
of main's ticks the median and the 99th percentile. Pages are plain clients, as a browser has a machine of its own.
"""

import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import IO

import numpy as np
import psutil
import zmq

from ccatp.links.bus import Subscriber
from ccatp.links.topics import Timing

URL = re.compile(r"http://127\.0\.0\.1:(\d+)/")
SETTINGS = ("sim.robot.port=0", "sim.etalon.port=0", "dashboard.port=0", "mission.calibration_length_m=0")
PAGES = (0, 1, 3)
BEGINNING_S, OPENING_S = 8.0, 1.5


def open_page(port: int) -> socket.socket:
    """A page that takes what it is told."""
    page = socket.create_connection(("127.0.0.1", port))
    page.sendall(b"GET /events HTTP/1.1\r\nhost: localhost\r\n\r\n")
    threading.Thread(target=drain, args=(page,), daemon=True).start()
    return page


def drain(page: socket.socket) -> None:
    """Take everything until the end."""
    try:
        while page.recv(65_536):
            pass
    except OSError:
        return


def ticks_us(subscriber: Subscriber, seconds: float) -> np.ndarray:
    """Main's ticks while this time passes."""
    end_s = time.monotonic() + seconds
    ticks: list[float] = []
    while (left_s := end_s - time.monotonic()) > 0.0:
        received = subscriber.receive(left_s)
        if received is not None and isinstance(received[1], Timing):
            ticks += received[1].tick_us
    return np.array(ticks)


def busy_s(process: psutil.Process) -> float:
    """Processor time so far."""
    times = process.cpu_times()
    return float(times.user + times.system)


def look(port: int, dashboard: psutil.Process, subscriber: Subscriber, pages: int, seconds: float) -> list[float]:
    """Share of a core (%), median and 99th percentile of the ticks (us), with so many pages open."""
    with ExitStack() as stack:
        for _ in range(pages):
            page = stack.enter_context(open_page(port))
            stack.callback(page.shutdown, socket.SHUT_RDWR)
        time.sleep(OPENING_S)
        begun_s, before_s = time.monotonic(), busy_s(dashboard)
        ticks = ticks_us(subscriber, seconds)
        share = 100.0 * (busy_s(dashboard) - before_s) / (time.monotonic() - begun_s)
    return [share, float(np.median(ticks)), float(np.percentile(ticks, 99))]


def wait_for_page(lines: IO[str]) -> int:
    """Its port, as the run tells it; what else it tells is thrown away."""
    for line in lines:
        if found := URL.search(line):
            threading.Thread(target=lines.read, daemon=True).start()
            return int(found[1])
    raise SystemExit("the run has no dashboard")


def main(seconds: float, rounds: int) -> None:
    """Measure, and print a line for each number of pages."""
    rows: dict[int, list[list[float]]] = {pages: [] for pages in PAGES}
    with tempfile.TemporaryDirectory(prefix="ccatp-") as folder, zmq.Context() as context:
        command = [sys.executable, "-m", "ccatp", "run", "--sim", "--realtime", "--run-dir", f"{folder}/run"]
        command += ["--runtime-dir", folder, *(word for setting in SETTINGS for word in ("--set", setting))]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as run:
            assert run.stderr is not None
            port = wait_for_page(run.stderr)
            time.sleep(BEGINNING_S)
            children = psutil.Process(run.pid).children()
            dashboard = next(child for child in children if "ccatp.daemon.dashboard" in child.cmdline())
            subscriber = Subscriber(context, [f"ipc://{Path(folder) / 'main'}"], ["timing"])
            for k in range(rounds):
                for pages in PAGES if k % 2 == 0 else reversed(PAGES):
                    rows[pages].append(look(port, dashboard, subscriber, pages, seconds))
            subscriber.close()
            run.terminate()
    for pages, found in rows.items():
        share, p50, p99 = np.median(np.array(found), axis=0)
        print(f"{pages} pages: dashboard {share:.2f} % of a core, main's ticks p50 {p50:.0f} us, p99 {p99:.0f} us")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 15.0, int(sys.argv[2]) if len(sys.argv) > 2 else 4)
