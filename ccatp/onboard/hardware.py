"""The hardware of the robot as its on-board program sees it: motors, sensors, fans, battery, external timer.

One implementation drives the devices of Linux (``ccatp.onboard.devices``), others are simulated. Times are those of the
robot's clock, s since the start of the program; wheel angles count up when the wheel drives the robot forwards.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol


class DeviceCheck(NamedTuple):
    """What one device said of itself.

    ``found``: it answered; ``passed``: it is what it should be, and its rate and noise are in their limits.
    """

    device: str
    found: bool
    identity: str
    rate_hz: float
    noise: str
    passed: bool
    advice: str


class Readings(NamedTuple):
    """Samples that came since the last call, each list oldest first.

    imu: (t, acceleration along robot x, rate about robot z, acceleration along robot y), m/s^2 without gravity, rad/s.
    counts: (t, right, left) encoder counts since the start, unwrapped; ``None`` is a wheel that was not read.
    edges: (t, front left, front right, rear left, rear right) of the analogue edge sensors, V.
    gravity: (t, gx, gy, gz), unit vector along which things fall, robot frame; the newest one, or none.
    soc: state of charge of the battery, 0 to 1.
    faults: what does not work now, by its name on the robot link, with the reason.
    """

    imu: Sequence[tuple[float, float, float, float]]
    counts: Sequence[tuple[float, int | None, int | None]]
    edges: Sequence[tuple[float, float, float, float, float]]
    gravity: tuple[float, float, float, float] | None
    soc: float
    faults: dict[str, str]


class HardwareError(Exception):
    """A device is missing, refuses, or is another one; says which, why, and what to do."""


class Hardware(Protocol):
    """The devices. No call waits longer than the fraction of a millisecond that a register takes."""

    def start(self) -> None:
        """Open and set up every device; the motors brake, the fans stay as they are. Raises ``HardwareError``."""

    def read(self, now_s: float) -> Readings:
        """What came since the last call, at ``now_s``."""

    def drive(self, right_v: float, left_v: float) -> None:
        """Motor voltages, V, positive drives forwards; each call also restarts the external timer.

        The external timer short-brakes both motors by itself when no call comes for its time. ``HardwareError``: a
        motor could not be set.
        """

    def brake(self) -> None:
        """Short-brake both motors, and let the external timer run."""

    def fans(self) -> tuple[float, float]:
        """Duties (left, right), 0 to 1, as read back from the devices. Raises ``HardwareError``."""

    def command_fans(self, left: float, right: float) -> None:
        """Set the duties, 0 to 1. Raises ``HardwareError``."""

    def close(self) -> None:
        """Brake and release the devices; the fans stay as they are."""
