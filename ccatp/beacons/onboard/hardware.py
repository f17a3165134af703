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
from ccatp.beacons.links.messages import MoteBurst
from ccatp.beacons.onboard.dish import Dish, OpenInput
from ccatp.beacons.onboard.listener import CricketListener
from ccatp.beacons.onboard.pioneer import PioneerBase, WheelSpeeds
from ccatp.beacons.onboard.scanner import Scanner
from ccatp.beacons.onboard.xbee import Coordinator
from ccatp.onboard.devices.linux import GpioInput, GpioLines, open_serial
from ccatp.onboard.devices.outputs import OpenLines
from ccatp.onboard.devices.serial_line import SerialPort
from ccatp.onboard.hardware import DeviceCheck, HardwareError

PATIENCE_S = 8.0  # for the answer of a device, beside the discovery of radios
LOW_SOC = 0.15
WRITE_S = 0.05  # for the transmission of a few bytes on a slow line, also when this computer is busy
REOPEN_S = 2.0  # between two attempts to open the lines of the dish
_LINES_KEY = "the lines in devices.dish"
Sleep = Callable[[float], object]


def _open_port(device: str, baud: int, key: str) -> SerialPort:
    return open_serial(device, baud, key, WRITE_S)


def _open_lines(chip: str, values: Mapping[int, bool]) -> GpioLines:
    return GpioLines(chip, values, _LINES_KEY)


def _open_input(chip: str, line: int) -> GpioInput:
    return GpioInput(chip, line, _LINES_KEY)


@dataclass(frozen=True, slots=True)
class BeaconAccess:
    """How the devices are reached, and what waits for them; tests replace it."""

    open_port: Callable[[str, int, str], SerialPort] = _open_port
    open_lines: OpenLines = _open_lines
    open_input: OpenInput = _open_input
    sleep: Sleep = time.sleep


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
        devices, body = config.devices, config.robot
        self._config, self._clock, self._access = devices, clock, access

        def port(key: str) -> Callable[[str, int], SerialPort]:
            return lambda device, baud: access.open_port(device, baud, key)

        self.base = self.radio = self.dish = self.scanner = None
        if devices.base.is_used:
            self.base = PioneerBase(devices.base, (body.wheel_radius_m, body.track_m), port("devices.base"))
        if devices.radio.is_used:
            self.radio = Coordinator(devices.radio, port("devices.radio"))
            if devices.dish.is_used:
                self.dish = Dish(devices.dish, access.open_lines, access.open_input)
            self.scanner = Scanner(devices.dish, self.radio, self.dish)
        names = devices.listeners.devices if devices.listeners.is_used else ()
        self.listeners = [CricketListener(name, devices.listeners, port("devices.listeners")) for name in names]
        self._opened = ExitStack()
        self._reopen_s = 0.0

    def _opening(self) -> dict[str, tuple[Callable[[], None], Callable[[], None]]]:
        """How each device is opened and closed, by its name, in order."""
        clock, sleep = self._clock, self._wait
        found: dict[str, tuple[Callable[[], None], Callable[[], None]]] = {}
        if self.base is not None:
            found["base"] = partial(self.base.open, clock, sleep, PATIENCE_S), self.base.close
        if self.radio is not None:
            patience_s = PATIENCE_S + self._config.radio.discovery_s
            found["radio"] = partial(self.radio.open, clock, sleep, patience_s), self.radio.close
        if self.dish is not None:
            found["dish"] = self._open_dish, self.dish.close
        for one in self.listeners:
            found[one.title] = partial(one.open, clock, sleep, PATIENCE_S), one.close
        return found

    def _open_dish(self) -> None:
        """Open the lines and turn straight ahead. Raises HardwareError."""
        if self.dish is None or self.scanner is None:
            return
        self.dish.open()
        self.scanner.begin_homing()
        while not self.dish.is_homed:
            self.scanner.poll(self._clock())
            if self.scanner.fault:
                raise HardwareError(self.scanner.fault)
            self._wait(self._config.dish.step_s)

    def _wait(self, duration_s: float) -> None:
        self._access.sleep(duration_s)
        self._keep()

    def _keep(self) -> None:
        """The base holds its wheels while other devices are opened."""
        if self.base is not None and self.base.is_ready:
            self.base.poll(self._clock())
            self.base.drive(0.0, 0.0, self._clock())

    def start(self) -> None:
        """Open every device. Raises HardwareError."""
        try:
            for opens, closes in self._opening().values():
                self._opened.callback(closes)
                opens()
        except HardwareError:
            self.close()
            raise

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
            self._keep_dish_open(now_s)
            self.scanner.poll(now_s)
            if not self.radio.is_ready:
                faults["radio"] = self.radio.why()
            elif missing := self.radio.missing:
                faults["radio"] = f"does not hear {', '.join(missing)}"
            if self.scanner.fault:
                faults["dish"] = self.scanner.fault
        motes: list[MoteBurst] = []
        for one in self.listeners:
            one.poll(now_s)
            motes += one.take()
            if reason := one.fault(now_s):
                faults[one.title] = reason
        return BeaconReadings(wheels, distances_m, motes, soc, stall, faults)

    def _keep_dish_open(self, now_s: float) -> None:
        """After a fault the lines are opened again, and the dish is homed."""
        if self.dish is None or self.scanner is None or not self.scanner.fault or now_s < self._reopen_s:
            return
        self._reopen_s = now_s + REOPEN_S
        self.dish.close()
        try:
            self.dish.open()
            self.scanner.begin_homing()
        except HardwareError as error:
            self.scanner.fault = str(error)

    def drive(self, right_rad_s: float, left_rad_s: float, now_s: float) -> None:
        """Set the speeds of the wheels. Raises HardwareError."""
        if self.base is not None:
            self.base.drive(right_rad_s, left_rad_s, now_s)

    def close(self) -> None:
        """Stop and release the devices."""
        self._opened.close()

    def check(self, duration_s: float) -> list[DeviceCheck]:
        """Open each device, read for ``duration_s`` while the robot stands still, close."""
        failures: dict[str, str] = {}
        with self._opened:
            for name, (opens, closes) in self._opening().items():
                self._opened.callback(closes)
                try:
                    opens()
                except HardwareError as error:
                    failures[name] = str(error)
            end_s, counted = self._clock() + duration_s, 0
            faults: dict[str, str] = {}
            while (now_s := self._clock()) < end_s:
                readings = self.read(now_s)
                faults, counted = readings.faults, counted + len(readings.wheels)
                self._keep()
                self._access.sleep(0.005)
        names = {"base": ("encoder_right", "edge", "battery_low"), "radio": ("radio",), "dish": ("dish",)}
        checks = []
        for name in self._opening():
            present = [faults[fault] for fault in names.get(name, (name,)) if fault in faults]
            problems = [failures[name]] if name in failures else present
            found, advice = name not in failures, problems[0] if problems else ""
            rate_hz = counted / duration_s if name == "base" else 0.0
            checks.append(DeviceCheck(name, found, self._identity(name), rate_hz, "", not problems, advice))
        return checks

    def _identity(self, name: str) -> str:
        if name == "base" and self.base is not None:
            watchdog = "" if self.base.watchdog_s is None else f", watchdog {self.base.watchdog_s:g} s"
            return f"{self.base.identity}{watchdog}"
        if name == "radio" and self.radio is not None:
            return f"{self.radio.identity}; hears {', '.join(sorted(self.radio.radios)) or 'nobody'}"
        if name == "dish" and self.dish is not None:
            return self.dish.identity
        return next((one.identity for one in self.listeners if one.title == name), "")
