"""``ccatp onboard`` for a robot among beacons in a process of its own, the fake devices in another, and a client."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, Self

from ccatp.links.robot_codec import encode
from ccatp.links.robot_messages import Drive, Join

ROOT = Path(__file__).parents[2]
READY_S = 60.0
_DRIVE_S = 0.05


def options(name: str, settings: dict[str, Any]) -> list[str]:
    """Settings with ``__`` for dots as options of a command."""
    return [f"--{name}={key.replace('__', '.')}={json.dumps(value)}" for key, value in settings.items()]


class Devices:
    """The process of ``tests.support.beacon_ports``; ``config`` is that of the program for its devices.

    events: ``moves`` and ``stands``, each with the time of ``monotonic``.
    """

    def __init__(self, folder: Path, system: str, world: dict[str, Any], robot: dict[str, Any]) -> None:
        command = [sys.executable, "-m", "tests.support.beacon_ports", system, str(folder)]
        command += [*options("set", world), *options("robot", robot)]
        self.config = folder / "robot.toml"
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"
        self.events: list[tuple[str, float]] = []
        self.truth: list[list[float]] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith("["):
                self.truth = json.loads(line)
            else:
                name, at_s = line.split()
                self.events.append((name, float(at_s)))

    def command(self, line: str) -> None:
        """Change a device."""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def time_of(self, event: str, after_s: float, most_s: float) -> float:
        """When the wheels begin or end to turn."""
        end_s = time.monotonic() + most_s
        while time.monotonic() < end_s:
            found = [at_s for name, at_s in self.events if name == event and at_s >= after_s]
            if found:
                return found[0]
            time.sleep(0.005)
        raise AssertionError(f"the wheels {event.removesuffix('s')} not within {most_s} s: {self.events}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self._reader.join()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            assert stream is not None
            stream.close()


class Onboard:
    """``ccatp onboard --config FILE``; the lines of the dish are those of a socket.

    text: what it wrote on standard error.
    """

    def __init__(self, config: Path, *arguments: str) -> None:
        path = os.pathsep.join((str(ROOT / "tests" / "support" / "gpio"), str(ROOT)))
        command = [sys.executable, "-m", "ccatp", "onboard", "--config", str(config), *arguments]
        self.process = subprocess.Popen(
            command, env=os.environ | {"PYTHONPATH": path}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.text = ""
        self.port = 0
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.text += line
            if match := re.search(r"robot on 127\.0\.0\.1:(\d+)$", line):
                self.port = int(match.group(1))

    def wait_for_hello(self) -> None:
        """Wait until the devices are open and it serves its clients."""
        with self.connect() as client:
            assert client.recv(10_000).startswith(b'{"type":"hello"')

    def connect(self) -> socket.socket:
        """A connection."""
        end_s = time.monotonic() + READY_S
        while not self.port:
            assert self.process.poll() is None, self.text
            assert time.monotonic() < end_s
            time.sleep(0.01)
        return socket.create_connection(("127.0.0.1", self.port), READY_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.send_signal(signal.SIGCONT)  # a process that is stopped would not end
        self.process.wait(READY_S)
        self._reader.join()
        for stream in (self.process.stdout, self.process.stderr):
            assert stream is not None
            stream.close()


class Driver:
    """A controller that sends the same drive every 50 ms, to a robot without a monitor."""

    def __init__(self, onboard: Onboard, rate_rad_s: float) -> None:
        self._socket, self._rate = onboard.connect(), rate_rad_s
        self._is_over = False
        self._thread = threading.Thread(target=self._run)

    def _send(self, message: Join | Drive) -> None:
        self._socket.sendall(encode(message))

    def _run(self) -> None:
        self._send(Join(role="controller", client="test"))
        seq = 0
        while not self._is_over:
            seq += 1
            try:
                self._send(Drive(seq, 0, self._rate, self._rate))
            except OSError:
                return  # the program was killed
            time.sleep(_DRIVE_S)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over = True
        self._thread.join()
        self._socket.close()
