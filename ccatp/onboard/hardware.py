"""The hardware of the robot as its on-board program sees it: motors, sensors, fans, battery, external timer.

One implementation drives the devices of Linux (``ccatp.onboard.devices``), others are simulated. Times are those of the
robot's clock, s since the start of the program; wheel angles count up when the wheel drives the robot forwards.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import NamedTuple, Protocol


class DeviceCheck(NamedTuple):
    """Result of the check of one device.

    ``found``: it could be opened; ``passed``: besides, it has no fault, and its rate and noise are within their limits.
    """

    device: str
    found: bool
    identity: str
    rate_hz: float
    noise: str
    passed: bool
    advice: str


class Readings(NamedTuple):
    """Samples since the last call, each list oldest first.

    imu: (t, acceleration along robot x, rate about robot z, acceleration along robot y), m/s^2 without gravity, rad/s.
    counts: (t, right, left) encoder counts since the start, unwrapped; ``None`` is a wheel that was not read.
    edges: (t, front left, front right, rear left, rear right) of the analogue edge sensors, V.
    gravity: (t, gx, gy, gz), unit vector of gravity (down), robot frame; the newest one, or none.
    soc: state of charge of the battery, 0 to 1.
    faults: reason of each present fault, by the fault's name on the robot link.
    """

    imu: Sequence[tuple[float, float, float, float]]
    counts: Sequence[tuple[float, int | None, int | None]]
    edges: Sequence[tuple[float, float, float, float, float]]
    gravity: tuple[float, float, float, float] | None
    soc: float
    faults: dict[str, str]


class HardwareError(Exception):
    """A device is missing, fails, or is not the expected one; the text says which, why, and what to do."""


class Device(Protocol):
    """One device."""

    @property
    def identity(self) -> str:
        """What it says of itself, or where it is."""

    def open(self) -> None:
        """Open it and wait until it works. Raises HardwareError."""

    def close(self) -> None:
        """Stop and release it."""


def open_devices(devices: Mapping[str, Device], opened: ExitStack) -> None:
    """Open one after the other; ``opened`` closes them. Raises HardwareError, with all closed again."""
    try:
        for device in devices.values():
            opened.callback(device.close)
            device.open()
    except HardwareError:
        opened.close()
        raise


def open_each(devices: Mapping[str, Device], opened: ExitStack) -> dict[str, str]:
    """Open all that can be opened; the reason of each that cannot."""
    failures: dict[str, str] = {}
    for name, device in devices.items():
        opened.callback(device.close)
        try:
            device.open()
        except HardwareError as error:
            failures[name] = str(error)
    return failures


LOW_SOC = 0.15  # below which a battery is reported as low


def state_of_charge(battery_v: float, empty_v: float, full_v: float) -> float:
    """State of charge, 0 to 1, linear in the voltage of the battery."""
    return min(1.0, max(0.0, (battery_v - empty_v) / (full_v - empty_v)))


def wrapped_change(now: int, before: int) -> int:
    """Change of a counter of 32 bits, which wraps."""
    return ((now - before + 0x80000000) & 0xFFFFFFFF) - 0x80000000


class Hardware(Protocol):
    """The devices. Only ``start`` and ``close`` may wait; the other calls take a fraction of a millisecond."""

    def start(self) -> None:
        """Open and set up every device; the motors brake, the fans stay as they are. Raises ``HardwareError``."""

    def read(self, now_s: float) -> Readings:
        """The samples since the last call; ``now_s`` is the time of this call."""

    def drive(self, right_v: float, left_v: float) -> None:
        """Set the motor voltages, V, positive drives forwards; each call also restarts the external timer.

        The external timer short-brakes both motors when it expires. Raises ``HardwareError`` if a motor could not be
        set.
        """

    def brake(self) -> None:
        """Short-brake both motors without a restart of the external timer."""

    def fans(self) -> tuple[float, float]:
        """Duties (left, right), 0 to 1, as read back from the devices. Raises ``HardwareError``."""

    def command_fans(self, left: float, right: float) -> None:
        """Set the duties, 0 to 1. Raises ``HardwareError``."""

    def close(self) -> None:
        """Brake and release the devices; the fans stay as they are."""
