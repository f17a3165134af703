"""The inertial unit Bosch BNO055 on an I2C bus: set-up, readings, and the thread that takes them.

In its mode IMU the unit fuses gyroscope and accelerometer at 100 Hz. The register UNIT_SEL is set to 0x02: 1/100 m/s^2
and 1/900 rad/s per LSB. The axis registers of the unit map its axes to those of the robot (x forward, y left, z away
from the surface). Its gravity vector is what an accelerometer at rest shows: it points up, so it is negated here.
Source: data sheet BST-BNO055-DS000-14.

The unit stretches the clock of the bus. A bus controller that does not support this reads wrong bits, mostly the
highest bit of a byte; on a Raspberry Pi, use the overlay i2c-gpio.
"""

import struct
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from math import hypot
from typing import NamedTuple, Protocol

from ccatp.config.onboard_models import Bno055Config
from ccatp.onboard.hardware import HardwareError

Clock = Callable[[], float]
Sleep = Callable[[float], object]

# Registers of page 0 and their values.
CHIP_ID, SOFTWARE, PAGE_ID, SELF_TEST = 0x00, 0x04, 0x07, 0x36
UNIT_SEL, OPR_MODE, PWR_MODE, SYS_TRIGGER, AXIS_MAP, AXIS_SIGN = 0x3B, 0x3D, 0x3E, 0x3F, 0x41, 0x42
BNO055_ID = 0xA0
UNITS_M_S2_RAD_S = 0x02
MODE_CONFIG, MODE_IMU = 0x00, 0x08
RESET = 0x20
SELF_TEST_NEEDED = {0: "accelerometer", 2: "gyroscope", 3: "controller"}  # bits; the magnetometer is not used

POWER_ON_S = 0.65
TO_CONFIG_S, FROM_CONFIG_S = 0.019, 0.007

# One burst from the gyroscope to OPR_MODE: rate, Euler angles, quaternion, linear acceleration, gravity (all int16),
# temperature, calibration, self test, interrupts, clock, status, error, units, reserved, mode.
BURST_START = 0x14
BURST = struct.Struct("<16h10B")
_G_M_S2 = 9.80665  # of the unit's fusion
_MISFIT = 0.05  # largest relative error of the lengths of quaternion and gravity; mixed bytes of two readings exceed it
_MOST_RAD_S, _MOST_M_S2 = 35.0, 80.0  # ranges of the sensors: 2,000 deg/s; 4 g, and as much for gravity

REOPEN_AFTER, RESET_AFTER = 3, 10  # failures in sequence
LONGEST_WAIT_S = 1.0
_QUEUED = 64  # samples in the queue to the reader: more than half a second
_JOIN_S = 0.2  # a thread that hangs longer in the kernel ends with the process


class Bus(Protocol):
    """An I2C bus. Both transfers raise OSError."""

    def write(self, address: int, data: bytes) -> None:
        """Write a register number and values."""

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        """Write a register number, then after a repeated start read ``count`` bytes from this register on."""

    def close(self) -> None:
        """Release it."""


class _DoubtfulReading(Exception):
    """A transfer succeeded, but its bytes are not a valid new reading."""


class Bno055Sample(NamedTuple):
    """One reading, robot frame: acceleration along x and y without gravity, m/s^2, rate about z, rad/s."""

    t_s: float
    ax_m_s2: float
    wz_rad_s: float
    gravity: tuple[float, float, float]  # unit vector, down
    ay_m_s2: float = 0.0


def axis_registers(axes: Sequence[str]) -> tuple[int, int]:
    """AXIS_MAP_CONFIG and AXIS_MAP_SIGN for the unit's axes along robot x, y, z.

    Raises HardwareError if an axis occurs twice or the axes are left-handed.
    """
    order = tuple("xyz".index(axis[-1]) for axis in axes)
    signs = sum((axis[0] == "-") << (2 - place) for place, axis in enumerate(axes))
    is_cyclic = order in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    if len(set(order)) < 3 or is_cyclic == bool(signs.bit_count() % 2):
        raise HardwareError(
            f"BNO055: axes {', '.join(axes)} are not those of a turned unit; each axis once, and right-handed: "
            "correct devices.bno055.axes"
        )
    return order[0] | order[1] << 2 | order[2] << 4, signs


class Bno055:
    """The unit, read in a thread of its own, since a transfer takes a millisecond and may hang in the kernel.

    After ``REOPEN_AFTER`` failures in sequence the bus is opened again before each attempt, after every ``RESET_AFTER``
    the unit is reset; the interval between the attempts grows.

    Attributes:
        errors: attempts that gave no sample.
        identity: software version, and calibration level of the gyroscope, which calibrates itself at rest.
    """

    def __init__(self, config: Bno055Config, open_bus: Callable[[], Bus], clock: Clock, sleep: Sleep) -> None:
        self._config, self._open_bus, self._clock, self._sleep = config, open_bus, clock, sleep
        self._period_s = 1.0 / config.rate_hz
        self._bus: Bus | None = None
        self._last_burst = b""
        self._samples: deque[Bno055Sample] = deque(maxlen=_QUEUED)
        self._newest_s = clock()
        self._failures = 0
        self._is_lost = False
        self._reason = self._software = ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bno055", daemon=True)
        self.errors = 0
        self.identity = ""

    def open(self) -> None:
        """Set up the unit and start the thread. Raises HardwareError."""
        try:
            self._reopen_bus()
            self._set_up()
        except (OSError, HardwareError) as error:
            self._close_bus()
            raise HardwareError(f"BNO055: {_bus_error(error)}" if isinstance(error, OSError) else str(error)) from None
        self._newest_s = self._clock()
        self._thread.start()

    def take(self, until_s: float) -> list[Bno055Sample]:
        """Samples up to ``until_s`` that were not taken yet; never waits."""
        taken = []
        while self._samples and self._samples[0].t_s <= until_s:
            taken.append(self._samples.popleft())
        return taken

    def fault(self, now_s: float) -> str:
        """The reason if the newest reading is older than ``timeout_s``, otherwise empty."""
        age_s = now_s - self._newest_s
        if age_s <= self._config.timeout_s:
            return ""
        return f"no reading for {age_s:.2f} s: {self._reason or 'a transfer hangs; check the wiring of the I2C bus'}"

    def close(self) -> None:
        """End the thread, which releases the bus; a thread that hangs in the kernel is not waited for."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(_JOIN_S)

    def step(self) -> float:
        """Take one reading or try to recover the unit; return the time until the next call, s."""
        try:
            if self._failures >= REOPEN_AFTER:
                self._reopen_bus()
            if self._is_lost:
                self._set_up()
                self._is_lost = False
            sample = self._read()
        except OSError as error:
            self._reason = _bus_error(error)
        except _DoubtfulReading as error:
            self._reason = str(error)
        except HardwareError as error:
            self._reason, self._is_lost = str(error), True
        else:
            self._samples.append(sample)
            self._newest_s = sample.t_s
            self._failures, self._reason = 0, ""
            return self._period_s
        self.errors += 1
        self._failures += 1
        self._is_lost |= self._failures % RESET_AFTER == 0
        return float(min(self._period_s * 2.0 ** max(0, self._failures - REOPEN_AFTER), LONGEST_WAIT_S))

    def _run(self) -> None:
        due_s = self._clock()
        try:
            while not self._stop.wait(max(0.0, due_s - self._clock())):
                wait_s = self.step()
                due_s = max(due_s + wait_s, self._clock())
        except Exception as error:
            self._reason = f"its thread ended: {error!r}"
            raise
        finally:
            self._close_bus()

    def _read(self) -> Bno055Sample:
        """Read one burst. Raises OSError, _DoubtfulReading, and HardwareError if the unit must be set up again."""
        t_s = self._clock()
        burst = self._read_registers(BURST_START, BURST.size)
        values = BURST.unpack(burst)
        wz, quaternion, (ax, ay), gravity = values[2], values[6:10], values[10:12], values[13:16]
        calibration, status, error, units, mode = (values[k] for k in (17, 21, 22, 23, 25))
        size = hypot(*gravity) / 100.0
        misfit = max(abs(hypot(*quaternion) / 16384.0 - 1.0), abs(size / _G_M_S2 - 1.0))
        is_possible = abs(wz) <= 900.0 * _MOST_RAD_S and max(abs(ax), abs(ay)) <= 100.0 * _MOST_M_S2
        is_new, self._last_burst = burst != self._last_burst, burst
        if burst == b"\xff" * len(burst):
            raise _DoubtfulReading("the bus reads ones only; check its wiring")
        if mode & 0x0F != MODE_IMU or units & 0x7F != UNITS_M_S2_RAD_S:
            raise self._error(f"was reset (mode 0x{mode:02x}, units 0x{units:02x}); check its supply")
        if status == 1:
            raise self._error(f"reports system error {error}; check its supply")
        if misfit > _MISFIT or not is_possible:
            raise _DoubtfulReading(f"wrong bits (gravity {size:.2f} m/s^2); check the speed of the I2C bus")
        if not is_new:
            raise _DoubtfulReading("the readings do not change")
        gx, gy, gz = (-g / (100.0 * size) for g in gravity)
        self.identity = f"{self._software}, gyroscope calibrated {calibration >> 4 & 3} of 3"
        return Bno055Sample(t_s, ax / 100.0, wz / 900.0, (gx, gy, gz), ay / 100.0)

    def _set_up(self) -> None:
        """Reset the unit and write the settings that ``_read`` needs, each read back; takes about 0.7 s."""
        axis_map, axis_sign = axis_registers(self._config.axes)
        self._check_id()
        with suppress(OSError):  # it may reset before it acknowledges
            self._write(SYS_TRIGGER, RESET)
        self._sleep(POWER_ON_S)
        self._check_id()
        for name, register, value, wait_s in (
            ("operation mode", OPR_MODE, MODE_CONFIG, TO_CONFIG_S),
            ("power mode", PWR_MODE, 0x00, 0.0),
            ("unit selection", UNIT_SEL, UNITS_M_S2_RAD_S, 0.0),
            ("axis map", AXIS_MAP, axis_map, 0.0),
            ("axis signs", AXIS_SIGN, axis_sign, 0.0),
            ("operation mode", OPR_MODE, MODE_IMU, FROM_CONFIG_S),
        ):
            self._write(register, value)
            self._sleep(wait_s)
            if (found := self._read_registers(register, 1)[0]) != value:
                raise self._error(f"{name} reads back 0x{found:02x} after 0x{value:02x}; check wiring and supply")
        passed = self._read_registers(SELF_TEST, 1)[0]
        if failed := [name for bit, name in SELF_TEST_NEEDED.items() if not passed >> bit & 1]:
            raise self._error(f"self test failed: {', '.join(failed)}; replace the unit")
        low, high, loader = self._read_registers(SOFTWARE, 3)
        self._software = f"BNO055 software {high:x}.{low:02x} boot loader {loader:x}"

    def _check_id(self) -> None:
        try:
            self._write(PAGE_ID, 0)
        except OSError:  # it may just have been powered on
            self._sleep(POWER_ON_S)
            self._write(PAGE_ID, 0)
        if (found := self._read_registers(CHIP_ID, 1)[0]) != BNO055_ID:
            raise self._error(f"chip id 0x{found:02x} instead of 0xa0: another device; check devices.bno055.address")

    def _reopen_bus(self) -> None:
        self._close_bus()
        self._bus = self._open_bus()

    def _close_bus(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.close()

    def _opened(self) -> Bus:
        if self._bus is None:
            raise OSError("the I2C bus is closed")
        return self._bus

    def _write(self, register: int, value: int) -> None:
        self._opened().write(self._config.address, bytes((register, value)))

    def _read_registers(self, register: int, count: int) -> bytes:
        return self._opened().write_read(self._config.address, bytes((register,)), count)

    def _error(self, what: str) -> HardwareError:
        return HardwareError(f"BNO055 at 0x{self._config.address:02x}: {what}")


def _bus_error(error: OSError) -> str:
    return f"{error}; check the wiring of the I2C bus"
