"""All devices of a robot among beacons together: opening, one reading for each step, holding, checks.

pyserial and gpiod are imported when a device is opened, as by ``ccatp.onboard.devices.linux``.
"""

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from ccatp.beacons.config.onboard_models import BeaconOnboardConfig
from ccatp.beacons.links.cricket_lines import Senders
from ccatp.beacons.links.messages import MoteBurst
from ccatp.beacons.onboard.dish import Dish
from ccatp.beacons.onboard.listener import CricketListener
from ccatp.beacons.onboard.pioneer import PioneerBase, WheelSpeeds
from ccatp.beacons.onboard.scanner import Scanner
from ccatp.beacons.onboard.xbee import Coordinator
from ccatp.onboard.devices.linux import GpioInput, GpioLines, open_serial
from ccatp.onboard.devices.outputs import OpenInput, OpenLines
from ccatp.onboard.devices.serial_line import OpenPort
from ccatp.onboard.hardware import LOW_SOC, Device, DeviceCheck, open_devices, open_each

WRITE_S = 0.05  # for the transmission of a few bytes on a slow line, also when this computer is busy
_LINES_KEY = "the lines in devices.dish"
_OPEN_PORT = partial(open_serial, write_s=WRITE_S)
_FAULTS_OF = {"base": ("encoder_right", "edge", "battery_low")}  # other devices have one, with their own name


def _open_lines(chip: str, values: Mapping[int, bool]) -> GpioLines:
    return GpioLines(chip, values, _LINES_KEY)


def _open_input(chip: str, line: int) -> GpioInput:
    return GpioInput(chip, line, _LINES_KEY)


@dataclass(frozen=True, slots=True)
class BeaconAccess:
    """How the devices are reached, and what waits for them; tests replace it."""

    open_port: OpenPort = _OPEN_PORT
    open_lines: OpenLines = _open_lines
    open_input: OpenInput = _open_input
    sleep: Callable[[float], object] = time.sleep


class BeaconReadings(NamedTuple):
    """What was measured since the last call, oldest first.

    ``wheels``: time, right and left speed. ``distances_m``: None while a sonar is missing. ``faults``: reason of each
    present fault, by its name on the link or that of a device.
    """

    wheels: list[WheelSpeeds]
    distances_m: list[float] | None
    motes: list[MoteBurst]
    soc: float
    stall: str
    faults: dict[str, str]


class BeaconHardware:
    """The devices of the configuration. ``clock`` is the robot's clock, as ``now_s`` of ``read``.

    Attributes:
        scanner: of the radios; None without the radio module.
    """

    def __init__(
        self, config: BeaconOnboardConfig, clock: Callable[[], float], access: BeaconAccess | None = None
    ) -> None:
        access = access or BeaconAccess()
        devices = config.devices
        self._clock, self._sleep = clock, access.sleep
        # By their names in checks, in the order of opening.
        self._devices: dict[str, Device] = {}
        self.base = self.radio = self.scanner = None
        if devices.base.is_used:
            self.base = PioneerBase(devices.base, config.robot, access.open_port, clock, self._wait)
            self._devices["base"] = self.base
        if devices.radio.is_used:
            self.radio = Coordinator(devices.radio, access.open_port, clock, self._wait)
            dish = Dish(devices.dish, access.open_lines, access.open_input) if devices.dish.is_used else None
            self.scanner = Scanner(devices.dish, self.radio, dish, clock, self._wait)
            self._devices["radio"] = self.radio
            if dish is not None:
                self._devices["dish"] = self.scanner
        names = devices.listeners.devices if devices.listeners.is_used else ()
        senders = Senders()
        self.listeners = [
            CricketListener(name, devices.listeners, senders, access.open_port, clock, self._wait) for name in names
        ]
        self._devices |= {one.title: one for one in self.listeners}
        self._opened = ExitStack()

    def _wait(self, duration_s: float) -> None:
        """The base holds its wheels while other devices are opened and closed."""
        self._sleep(duration_s)
        if self.base is not None and self.base.is_ready:
            self.base.poll(self._clock())
            self.base.drive(0.0, 0.0, self._clock())

    def start(self) -> None:
        """Open every device. Raises HardwareError."""
        open_devices(self._devices, self._opened)
        self.read(self._clock())  # nobody asked for what came in the meantime

    def read(self, now_s: float) -> BeaconReadings:
        """What was measured since the last call; ``now_s`` is the time of this call."""
        faults: dict[str, str] = {}
        wheels: list[WheelSpeeds] = []
        distances_m: list[float] | None = []
        soc, stall = 1.0, ""
        if (base := self.base) is not None:
            base.poll(now_s)
            wheels, distances_m, soc, stall = base.take(), base.distances_m(now_s), base.soc, base.stall
            if reason := base.fault(now_s):
                faults |= {"encoder_right": reason, "encoder_left": reason}
            if distances_m is None:
                faults["edge"] = "a sonar sends nothing; check devices.base.sonars and the cable of the sonars"
            if soc < LOW_SOC:
                faults["battery_low"] = f"battery at {100.0 * soc:.0f} %; charge it"
        if self.radio is not None and self.scanner is not None:
            self.radio.poll(now_s)
            self.scanner.poll(now_s)
            if reason := self.radio.fault() or self.scanner.silence:
                faults["radio"] = reason
            if self.scanner.fault:
                faults["dish"] = self.scanner.fault
        motes: list[MoteBurst] = []
        for one in self.listeners:
            one.poll(now_s)
            motes += one.take()
            if reason := one.fault(now_s):
                faults[one.title] = reason
        return BeaconReadings(wheels, distances_m, motes, soc, stall, faults)

    def drive(self, right_rad_s: float, left_rad_s: float, now_s: float) -> None:
        """Set the speeds of the wheels. Raises HardwareError."""
        if self.base is not None:
            self.base.drive(right_rad_s, left_rad_s, now_s)

    def close(self) -> None:
        """Stop and release the devices."""
        self._opened.close()

    def check(self, duration_s: float) -> list[DeviceCheck]:
        """Open each device, read for ``duration_s`` while the robot stands still, close."""
        with self._opened:
            failures = open_each(self._devices, self._opened)
            readings, counted = self.read(self._clock()), 0
            end_s = self._clock() + duration_s
            while (now_s := self._clock()) < end_s:
                readings = self.read(now_s)
                counted += len(readings.wheels)
                self._wait(0.005)
        checks = []
        for name, device in self._devices.items():
            faults = [readings.faults[fault] for fault in _FAULTS_OF.get(name, (name,)) if fault in readings.faults]
            problems = [failures[name]] if name in failures else faults
            rate_hz = counted / duration_s if name == "base" else 0.0
            advice = problems[0] if problems else ""
            checks.append(
                DeviceCheck(
                    name, name not in failures, device.identity, rate_hz, "", passed=not problems, advice=advice
                )
            )
        return checks
