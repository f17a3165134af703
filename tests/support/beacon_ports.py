"""``python -m tests.support.beacon_ports SYSTEM FOLDER``: fake devices of a robot among beacons in their own process.

Each serial device is a pseudo terminal, ``FOLDER/base``, ``radio`` or ``mote-NAME``; the lines of the dish are the
socket ``FOLDER/gpio``; ``FOLDER/robot.toml`` is the configuration of ``ccatp onboard`` for them. Standard output gets a
line ``ready``, then ``moves`` and ``stands`` with the time of ``monotonic`` whenever the wheels begin and end to turn,
and at SIGTERM the truth of each step of the world: UTC, x, y and heading. A line on standard input changes a device:
``unplug base``, ``plug base``, ``set base is_mute true``.
"""

import argparse
import json
import os
import select
import signal
import socket
import sys
import time
import tty
from contextlib import suppress
from pathlib import Path
from typing import Any

import tomlkit

from ccatp.beacons.config.onboard_models import BeaconOnboardConfig
from tests.support.beacon_fakes import FakeDish, FakePort
from tests.support.beacon_rig import BeaconBench, onboard_config, pioneer_config
from tests.support.onboard_fakes import FakeTime

_CHUNK = 4096
_WAIT_S = 0.005  # without bytes, until devices act by themselves


class WallTime(FakeTime):
    """Time of ``monotonic``, for devices that go by themselves."""

    def __init__(self) -> None: ...

    @property
    def now_s(self) -> float:  # type: ignore[override]
        return time.monotonic()


class Terminal:
    """A fake device on a pseudo terminal."""

    def __init__(self, device: FakePort, path: Path) -> None:
        self._device, self._path = device, path
        self._fds: tuple[int, ...] = ()
        self.plug()

    @property
    def fds(self) -> tuple[int, ...]:
        """File descriptors to wait for."""
        return self._fds[:1]

    def plug(self) -> None:
        self._fds = os.openpty()
        master, slave = self._fds
        tty.setraw(slave)
        os.set_blocking(master, False)
        self._path.symlink_to(os.ttyname(slave))

    def unplug(self) -> None:
        self._path.unlink()
        for fd in self._fds:
            os.close(fd)
        self._fds = ()

    def exchange(self) -> None:
        """Bytes to the device, and its own."""
        for fd in self.fds:
            with suppress(BlockingIOError):  # nothing there
                self._device.write(os.read(fd, _CHUNK))
            with suppress(BlockingIOError):  # nobody reads
                os.write(fd, self._device.read(_CHUNK))


class Lines:
    """The GPIO lines of the dish at a socket."""

    def __init__(self, dish: FakeDish, path: Path) -> None:
        self._dish = dish
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        self._clients: list[socket.socket] = []

    @property
    def fds(self) -> list[int]:
        """File descriptors to wait for."""
        return [one.fileno() for one in (self._listener, *self._clients)]

    def answer(self, ready: set[int]) -> None:
        """Answer the clients with these descriptors."""
        if self._listener.fileno() in ready:
            self._clients.append(self._listener.accept()[0])
        for client in tuple(self._clients):
            if client.fileno() not in ready:
                continue
            if not (line := client.recv(_CHUNK)):
                self._clients.remove(client)
                client.close()
                continue
            message = json.loads(line)  # a client waits for each answer
            if isinstance(message, dict):
                self._dish.set({int(number): level for number, level in message.items()})
            client.sendall(json.dumps(None if isinstance(message, dict) else int(self._dish.get())).encode() + b"\n")


class FakeDevices:
    """All devices, until SIGTERM."""

    def __init__(self, bench: BeaconBench, folder: Path) -> None:
        self._bench = bench
        self._terminals = {
            Path(device).name: Terminal(port, folder / Path(device).name) for device, port in bench.ports.items()
        }
        self._lines = Lines(bench.dish, folder / "gpio")
        self._is_over = self._moves = False
        self._stepped_s = 0.0
        self.truth: list[tuple[float, ...]] = []
        signal.signal(signal.SIGTERM, lambda *_: setattr(self, "_is_over", True))

    def run(self) -> None:
        """Serve."""
        while not self._is_over:
            waiting = [fd for one in self._terminals.values() for fd in one.fds]
            ready, _, _ = select.select([*waiting, *self._lines.fds, 0], [], [], _WAIT_S)
            if 0 in ready:
                lines = os.read(0, _CHUNK).decode().splitlines()
                self._is_over |= not lines  # the other end is gone
                for line in lines:
                    self._change(line.split(maxsplit=3))
            for one in self._terminals.values():
                one.exchange()
            self._lines.answer(set(ready))
            self._watch()

    def _change(self, words: list[str]) -> None:
        if words[0] == "set":
            device = dict(zip(self._terminals, self._bench.ports.values(), strict=True))[words[1]]
            setattr(device, words[2], json.loads(words[3]))
        else:
            getattr(self._terminals[words[1]], words[0])()

    def _watch(self) -> None:
        base = self._bench.base
        if (moves := bool(base.velocity or base.turn)) != self._moves:
            self._moves = moves
            print("moves" if moves else "stands", time.monotonic(), flush=True)
        world = self._bench.world
        if world.time_s > self._stepped_s:
            self._stepped_s = world.time_s
            self.truth.append((time.time(), *world.pose))


def config_at(folder: Path, cfg: BeaconOnboardConfig) -> str:
    """The configuration of the program for devices in a folder, as TOML."""
    tree: dict[str, Any] = cfg.model_dump(mode="json")
    devices = tree["devices"]
    for section in (devices["base"], devices["radio"]):
        section["device"] = str(folder / Path(section["device"]).name)
    devices["dish"]["gpio_chip"] = str(folder / "gpio")
    motes = devices["listeners"]["devices"]
    devices["listeners"]["devices"] = {name: str(folder / Path(path).name) for name, path in motes.items()}
    return tomlkit.dumps(tree)


def main() -> int:
    """Run until SIGTERM, or until standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("system")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=JSON", help="of the world")
    parser.add_argument("--robot", action="append", default=[], metavar="KEY=JSON", help="of the on-board program")
    options = parser.parse_args()

    def settings(texts: list[str]) -> dict[str, Any]:
        pairs = (text.partition("=") for text in texts)
        return {key.replace(".", "__"): json.loads(value) for key, _, value in pairs}

    cfg = pioneer_config(options.system, **settings(options.settings))
    names = {"devices__base__device": "/dev/base", "devices__radio__device": "/dev/radio", "robot__loop_hz": 100.0}
    onboard = onboard_config(cfg, **(names | settings(options.robot)))
    devices = FakeDevices(BeaconBench(cfg, onboard, WallTime()), options.folder)
    (options.folder / "robot.toml").write_text(config_at(options.folder, onboard))
    print("ready", flush=True)
    devices.run()
    print(json.dumps(devices.truth), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
