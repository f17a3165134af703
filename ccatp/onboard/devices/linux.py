"""The hardware of a robot whose computer runs Linux: device files, their packages, and all devices together.

smbus2, pyserial and gpiod are in the extra ``ccatp[onboard]`` and are imported when a device is opened.
"""

import fcntl
import importlib
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import pstdev
from typing import Any

from ccatp.config.onboard_models import DevicesConfig
from ccatp.onboard.devices.bno055 import Bno055, Bus
from ccatp.onboard.devices.daq import Daq
from ccatp.onboard.devices.outputs import PWM_ROOT, ExternalTimer, FanOutputs, Motors, OpenLines, explain
from ccatp.onboard.devices.serial_line import OpenPort, SerialPort
from ccatp.onboard.hardware import (
    LOW_SOC,
    Device,
    DeviceCheck,
    HardwareError,
    Readings,
    open_devices,
    open_each,
)

I2C_TIMEOUT = 0x0702  # ioctl of linux/i2c-dev.h, in 10 ms
BUS_TIMEOUT_10MS = 5
FAN_CHECK_S = 0.1
RATE_TOLERANCE = 0.1
_LINES_KEY = "the lines in devices.motors and devices.timer"
ENCODERS_AND_EDGES = ("encoder_left", "encoder_right", "edge")
FAULTS_OF = {
    "motors": (),
    "timer": (),
    "fans": ("fan_left", "fan_right"),
    "bno055": ("imu",),
    "daq": ("edge", "battery_low"),
}

_Sampled = tuple[Sequence[Sequence[float]], float, dict[str, tuple[float, tuple[int, ...]]]]


def import_package(name: str) -> Any:
    """A package of the extra ``ccatp[onboard]``. Raises HardwareError if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        package = {"serial": "pyserial"}.get(name, name)
        raise HardwareError(f"{package} is not installed; pip install ccatp[onboard]") from None


class I2cBus:
    """A bus of the kernel, ``/dev/i2c-<number>``; a Bus."""

    def __init__(self, number: int) -> None:
        self._smbus2 = import_package("smbus2")
        try:
            self._bus = self._smbus2.SMBus(number)
        except OSError as error:
            raise explain(error, f"/dev/i2c-{number}", "i2c", "devices.bno055.bus") from None
        with suppress(OSError):  # not every controller has a time-out
            fcntl.ioctl(self._bus.fd, I2C_TIMEOUT, BUS_TIMEOUT_10MS)

    def write(self, address: int, data: bytes) -> None:
        self._bus.i2c_rdwr(self._smbus2.i2c_msg.write(address, data))

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        answer = self._smbus2.i2c_msg.read(address, count)
        self._bus.i2c_rdwr(self._smbus2.i2c_msg.write(address, data), answer)
        return bytes(answer)

    def close(self) -> None:
        self._bus.close()


def open_serial(device: str, baud: int, key: str, write_s: float = 0.002) -> SerialPort:
    """Open a serial port for exclusive use, with reads that do not wait. Raises HardwareError.

    ``key``: section of the configuration. ``write_s``: longest time of a write.
    """
    serial = import_package("serial")
    try:
        port: SerialPort = serial.Serial(device, baud, timeout=0, write_timeout=write_s, exclusive=True)
    except (OSError, ValueError) as error:
        raise explain(error, device, "dialout", key) from None
    return port


class GpioLines:
    """Output lines of a GPIO chip; OutputLines."""

    def __init__(self, chip: str, values: Mapping[int, bool], key: str = _LINES_KEY) -> None:
        gpiod = import_package("gpiod")
        self._chip, self._key = chip, key
        self._levels = gpiod.line.Value.INACTIVE, gpiod.line.Value.ACTIVE
        output = gpiod.line.Direction.OUTPUT
        settings = {
            line: gpiod.LineSettings(direction=output, output_value=self._levels[is_high])
            for line, is_high in values.items()
        }
        try:
            self._request = gpiod.request_lines(chip, consumer="ccatp", config=settings)
        except (OSError, ValueError) as error:
            raise explain(error, chip, "gpio", key) from None

    def set(self, values: Mapping[int, bool]) -> None:
        try:
            self._request.set_values({line: self._levels[is_high] for line, is_high in values.items()})
        except OSError as error:
            raise explain(error, self._chip, "gpio", self._key) from None

    def close(self) -> None:
        self._request.release()


class GpioInput:
    """An input line of a GPIO chip. ``key``: the part of the configuration."""

    def __init__(self, chip: str, line: int, key: str) -> None:
        gpiod = import_package("gpiod")
        self._chip, self._line, self._key, self._active = chip, line, key, gpiod.line.Value.ACTIVE
        settings = gpiod.LineSettings(direction=gpiod.line.Direction.INPUT)
        try:
            self._request = gpiod.request_lines(chip, consumer="ccatp", config={line: settings})
        except (OSError, ValueError) as error:
            raise explain(error, chip, "gpio", key) from None

    def get(self) -> bool:
        try:
            return bool(self._request.get_value(self._line) == self._active)
        except OSError as error:
            raise explain(error, self._chip, "gpio", self._key) from None

    def close(self) -> None:
        self._request.release()


@dataclass(frozen=True, slots=True)
class DeviceAccess:
    """How the devices are reached, and what waits for them; tests replace it."""

    open_bus: Callable[[int], Bus] = I2cBus
    open_port: OpenPort = open_serial
    open_lines: OpenLines = GpioLines
    pwm_root: Path = PWM_ROOT
    imu: type[Bno055] = Bno055
    sleep: Callable[[float], object] = time.sleep


class LinuxHardware:
    """The devices of the configuration; a ``Hardware``. ``clock`` is the robot's clock, as ``now_s`` of ``read``."""

    def __init__(self, config: DevicesConfig, clock: Callable[[], float], access: DeviceAccess | None = None) -> None:
        access = access or DeviceAccess()
        self._config = config
        self._clock = clock
        self._sleep = sleep = access.sleep
        self._motors = Motors(config.motors, access.pwm_root, access.open_lines, sleep)
        self._timer = ExternalTimer(config.timer, access.open_lines)
        self._fans = FanOutputs(config.fans, access.pwm_root, sleep)
        self._imu = access.imu(config.bno055, partial(access.open_bus, config.bno055.bus), clock, sleep)
        self._daq = Daq(config.daq, access.open_port, clock, sleep)
        # Keys: sections of the configuration. Order of opening: the motors brake first; the devices that then send
        # samples, which are not read before all are open, come last.
        self._devices: dict[str, Device] = {
            "motors": self._motors,
            "timer": self._timer,
            "fans": self._fans,
            "bno055": self._imu,
            "daq": self._daq,
        }
        self._opened = ExitStack()
        self._fan_check_s = clock()

    def start(self) -> None:
        open_devices(self._devices, self._opened)

    def read(self, now_s: float) -> Readings:
        self._daq.poll(now_s)
        samples = self._daq.take()
        inertial = self._imu.take(now_s)
        if now_s - self._fan_check_s >= FAN_CHECK_S:
            self._fan_check_s = now_s
            self._fans.check()
        faults = dict(self._fans.faults)
        if reason := self._imu.fault(now_s):
            faults["imu"] = reason
        if reason := self._daq.fault(now_s):
            faults |= dict.fromkeys(ENCODERS_AND_EDGES, reason)
        soc = self._daq.soc()
        if soc < LOW_SOC:
            faults["battery_low"] = f"battery at {self._daq.battery_v:.2f} V; charge it, or check devices.daq.battery_*"
        return Readings(
            [(s.t_s, s.ax_m_s2, s.wz_rad_s, s.ay_m_s2) for s in inertial],
            [(s.t_s, s.right, s.left) for s in samples],
            [(s.t_s, *s.edges_v) for s in samples],
            (inertial[-1].t_s, *inertial[-1].gravity) if inertial else None,
            soc,
            faults,
        )

    def drive(self, right_v: float, left_v: float) -> None:
        self._motors.drive(right_v, left_v)
        self._timer.restart()

    def brake(self) -> None:
        self._motors.brake()  # the external timer is not restarted: it brakes if this call fails

    def fans(self) -> tuple[float, float]:
        return self._fans.duties()

    def command_fans(self, left: float, right: float) -> None:
        self._fans.command(left, right)

    def close(self) -> None:
        self._opened.close()

    def check(self, duration_s: float) -> list[DeviceCheck]:
        """Open each device, read for ``duration_s`` while the robot stands still, close; the motors brake."""
        readings: list[Readings] = []
        with self._opened:
            failures = open_each(self._devices, self._opened)
            end_s = self._clock() + duration_s
            while (now_s := self._clock()) < end_s:
                readings.append(self.read(now_s))
                self._sleep(0.005)
        faults = readings[-1].faults if readings else {}
        bno055, daq = self._config.bno055, self._config.daq
        # Samples, their rate, {unit of a noise: (limit, columns of the samples)}.
        sampled: dict[str, _Sampled] = {
            "bno055": (
                [row for reading in readings for row in reading.imu], bno055.rate_hz,
                {"rad/s": (bno055.noise_rad_s, (2,)), "m/s^2": (bno055.noise_m_s2, (1, 3))},
            ),
            "daq": (
                [row for reading in readings for row in reading.edges], daq.sample_hz,
                {"V": (daq.noise_v, (1, 2, 3, 4))},
            ),
        }  # fmt: skip
        checks = []
        for name, device in self._devices.items():
            problems = [failures[name]] if name in failures else [faults[k] for k in FAULTS_OF[name] if k in faults]
            rows, wanted_hz, limits = sampled.get(name, ([], 0.0, {}))
            rate_hz, noises = 0.0, []
            if len(rows) > 1:
                rate_hz = (len(rows) - 1) / (rows[-1][0] - rows[0][0])
                if abs(rate_hz - wanted_hz) > RATE_TOLERANCE * wanted_hz:
                    problems.append(
                        f"{rate_hz:.0f} samples/s instead of {wanted_hz:.0f}; check the load of this computer"
                    )
                for unit, (limit, columns) in limits.items():
                    noise = max(pstdev(row[column] for row in rows) for column in columns)
                    noises.append(f"{noise:.2g} {unit}")
                    if noise > limit:
                        problems.append(f"noise {noises[-1]}, limit {limit:g}; let the robot stand, check its wiring")
            advice = problems[0] if problems else ""
            found = name not in failures
            checks.append(DeviceCheck(name, found, device.identity, rate_hz, ", ".join(noises), not problems, advice))
        return checks
