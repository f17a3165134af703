"""``python -m tools.onboard_reactions``: how fast the on-board program holds the wheels, and what starts it.

The program runs over devices at register and byte level. Each trial drives, lets something happen, and takes the time
until the set points are zero. The death of the program is seen by an external timer in this process: it gets a byte for
each change of the timer's line, and brakes ``devices.timer.timeout_s`` after the last one.
"""

import argparse
import itertools
import os
import select
import signal
import socket
import statistics
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from ccatp.config.load import load_onboard_config
from ccatp.links.robot_codec import encode, format_drive
from ccatp.links.robot_messages import Join

ROOT = Path(__file__).parents[1]
PATIENCE_S = 60.0


def _state(task: Path) -> str:
    return (task / "stat").read_text().rpartition(")")[2].split()[0]


class Disturbed(Exception):
    """The load of this machine held the wheels before the trial did."""


class Program:
    """The program in a process of its own."""

    def __init__(self) -> None:
        self.timer, timer_end = os.pipe()
        command = [sys.executable, "-m", "tests.support.onboard_program", "--fakes", "--timer-fd", str(timer_end)]
        self.started_s = time.monotonic()
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, pass_fds=(timer_end,)
        )
        os.close(timer_end)
        self.changed_s = 0.0
        self._rates_rad_s = itertools.cycle((1.0, -1.0))
        self.events: list[tuple[str, float]] = []
        self.is_said = threading.Condition()
        assert self.process.stdout is not None
        self.port = int(self.process.stdout.readline())
        self._threads = [threading.Thread(target=target) for target in (self._read_events, self._read_timer)]
        for thread in self._threads:
            thread.start()

    def _read_events(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            word, _, time_s = line.partition(" ")
            with self.is_said:
                self.events.append((word, float(time_s)))
                self.is_said.notify_all()

    def _read_timer(self) -> None:
        while os.read(self.timer, 1 << 16):
            self.changed_s = time.monotonic()

    def next_rate_rad_s(self) -> float:
        """Forwards and backwards by turns, so that it stays where it is."""
        return next(self._rates_rad_s)

    def free_after(self, since_s: float) -> float:
        """When the wheels were let go for the first time after a time."""
        deadline_s = time.monotonic() + PATIENCE_S
        with self.is_said:
            while True:
                found = next((t_s for name, t_s in self.events if name == "free" and t_s >= since_s), None)
                if found is not None:
                    return found
                if not self.is_said.wait(deadline_s - time.monotonic()):
                    raise TimeoutError(f"not free within {PATIENCE_S:g} s")

    def held_after(self, since_s: float) -> float:
        """When what happened at a time held the wheels. ``Disturbed``: they were held already, also if told late."""
        deadline_s = time.monotonic() + PATIENCE_S
        with self.is_said:
            while True:
                if [name for name, t_s in self.events if t_s < since_s][-1:] != ["free"]:
                    raise Disturbed
                found = next((t_s for name, t_s in self.events if name == "held" and t_s >= since_s), None)
                if found is not None:
                    return found
                if not self.is_said.wait(deadline_s - time.monotonic()):
                    raise TimeoutError(f"not held within {PATIENCE_S:g} s")

    def stopped(self) -> None:
        """Wait until every thread of the process is stopped, and what it sent before has been read."""
        deadline_s = time.monotonic() + PATIENCE_S
        tasks = Path(f"/proc/{self.process.pid}/task")
        while any(_state(task) != "T" for task in tasks.iterdir()):
            if time.monotonic() > deadline_s:
                raise TimeoutError("the process does not stop")
            time.sleep(0.001)
        while self.changes_within(0.05):
            pass

    def changes_within(self, duration_s: float) -> bool:
        """Whether the timer's line changes in a time."""
        before_s, end_s = self.changed_s, time.monotonic() + duration_s
        while self.changed_s == before_s and time.monotonic() < end_s:
            time.sleep(0.005)
        return self.changed_s != before_s

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(PATIENCE_S)
        for thread in self._threads:
            thread.join(PATIENCE_S)
        os.close(self.timer)
        assert self.process.stdout is not None
        self.process.stdout.close()


class Driver:
    """A controller that sends the same drive each 10 ms until it is told to stop."""

    def __init__(self, port: int, rate_rad_s: float) -> None:
        self._rate_rad_s = rate_rad_s
        self.socket = socket.create_connection(("127.0.0.1", port))
        self.socket.sendall(encode(Join(role="controller", client="driver")))
        self._is_stopped = threading.Event()
        self._thread = threading.Thread(target=self._drive)
        self._thread.start()

    def _drive(self) -> None:
        seq = 0
        while not self._is_stopped.wait(0.01):
            seq += 1
            with suppress(ConnectionError):  # the program is dead
                self.socket.sendall(format_drive(seq, 0, self._rate_rad_s, self._rate_rad_s))
                while select.select((self.socket,), (), (), 0.0)[0] and self.socket.recv(1 << 16):
                    pass

    def stop(self) -> None:
        self._is_stopped.set()
        self._thread.join()


@contextmanager
def driving(program: Program) -> Iterator[Driver]:
    """A controller that drives, and whose robot turns its wheels."""
    start_s = time.monotonic()
    driver = Driver(program.port, program.next_rate_rad_s())
    try:
        program.free_after(start_s)
        time.sleep(0.2)
        yield driver
    finally:
        driver.stop()
        driver.socket.close()


def fin(program: Program, driver: Driver) -> float:
    driver.stop()
    now_s = time.monotonic()
    driver.socket.shutdown(socket.SHUT_WR)
    return program.held_after(now_s) - now_s


def rst(program: Program, driver: Driver) -> float:
    driver.stop()
    driver.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    now_s = time.monotonic()
    driver.socket.close()
    return program.held_after(now_s) - now_s


def silence(program: Program, driver: Driver) -> float:
    """Beyond the time-to-live."""
    driver.stop()
    now_s = time.monotonic()
    return program.held_after(now_s) - now_s - load_onboard_config().link.ttl_s


def _signalled(number: int) -> Callable[[Program, Driver], float]:
    def trial(program: Program, driver: Driver) -> float:
        now_s = time.monotonic()
        program.process.send_signal(number)
        try:
            held_s = program.held_after(now_s)
        finally:
            program.process.send_signal(number)
        program.free_after(held_s)
        return held_s - now_s

    return trial


def death(program: Program, driver: Driver) -> float:
    """SIGKILL, until the external timer brakes."""
    now_s = time.monotonic()
    program.process.kill()
    program.process.wait()
    return program.changed_s + load_onboard_config().devices.timer.timeout_s - now_s


TRIALS: dict[str, Callable[[Program, Driver], float]] = {
    "FIN of the controller": fin,
    "RST of the controller": rst,
    "no drive, beyond the time-to-live": silence,
    "bus of the inertial unit hangs": _signalled(signal.SIGUSR1),
    "data acquisition device unplugged": _signalled(signal.SIGUSR2),
    "SIGKILL of the program, until the external timer brakes": death,
}
DEATH = list(TRIALS)[-1]


def measure(names: Sequence[str], trials: int) -> dict[str, list[float]]:
    """Times of some trials of each, s; ``death`` may only be the last, and with one trial."""
    found: dict[str, list[float]] = {}
    program = Program()
    try:
        for name in names:
            times_s = found.setdefault(name, [])
            for _ in range(2 * trials):
                with suppress(Disturbed), driving(program) as driver:
                    times_s.append(TRIALS[name](program, driver))
                if len(times_s) == trials:
                    break
            else:
                raise TimeoutError(f"{name}: {trials - len(times_s)} trials were disturbed each time")
    finally:
        program.close()
    return found


def first_frame() -> float:
    """Time from the start of the process to the first frame of a client that waits for it, s."""
    program = Program()
    try:
        with socket.create_connection(("127.0.0.1", program.port)) as client:
            client.sendall(encode(Join(role="controller", client="first")))
            received = b""
            while b'"sensors"' not in received:
                received += client.recv(1 << 16)
        return time.monotonic() - program.started_s
    finally:
        program.close()


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=20)
    options = parser.parse_args()
    print("| what happens | set points zero after, ms: least | median | most |")
    print("|---|---|---|---|")
    found = measure(list(TRIALS)[:-1], options.trials)
    found[DEATH] = [measure([DEATH], 1)[DEATH][0] for _ in range(options.trials)]
    for name, times_s in found.items():
        low, middle, high = (1e3 * of(times_s) for of in (min, statistics.median, max))
        print(f"| {name} | {low:.1f} | {middle:.1f} | {high:.1f} |", flush=True)
    print(f"\nfirst frame {first_frame():.2f} s after the start of the process")
    return 0


if __name__ == "__main__":
    sys.exit(main())
