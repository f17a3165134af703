"""PWM of the kernel and GPIO lines of the robot's computer; motors, fans and external timer that use them."""

import errno
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from ccatp.config.onboard_models import ExternalTimerConfig, FansConfig, MotorsConfig, PwmChannelConfig
from ccatp.onboard.hardware import HardwareError

PWM_ROOT = Path("/sys/class/pwm")
_PWM_FILES = ("period", "duty_cycle", "enable")
# udev gives the group access to a channel only some time after the export.
_EXPORT_TRIES, _EXPORT_WAIT_S = 20, 0.05
_DUTY_TOLERANCE = 0.01  # steps of the hardware

Sleep = Callable[[float], object]


def explain(error: OSError | ValueError, device: str, group: str, key: str) -> HardwareError:
    """The error of a device file that cannot be opened or written; ``key`` is the part of the configuration."""
    denied = f"permission denied; add the user of this program to the group {group}"
    in_use = f"in use by another program or driver; stop it, or check {key}"
    advice = {
        errno.ENOENT: f"is not there; check the wiring, the device tree and {key}",
        errno.EACCES: denied,
        errno.EPERM: denied,
        errno.EBUSY: in_use,
        errno.EAGAIN: in_use,
        errno.ENODEV: f"has no such channel; check {key}",
        errno.EINVAL: f"refuses the value; check {key}",
    }
    return HardwareError(f"{device}: {advice.get(getattr(error, 'errno', 0), f'{error}; check {key}')}")


class OutputLines(Protocol):
    """Output lines of one GPIO chip."""

    def set(self, values: Mapping[int, bool]) -> None:
        """Set lines, all at once. Raises HardwareError."""

    def close(self) -> None:
        """Release them."""


class InputLine(Protocol):
    """An input line of a GPIO chip."""

    def get(self) -> bool:
        """Its level. Raises HardwareError."""

    def close(self) -> None:
        """Release it."""


OpenInput = Callable[[str, int], InputLine]  # chip and line
# Chip and the first values of its lines, which apply from the moment in which a line becomes an output.
OpenLines = Callable[[str, Mapping[int, bool]], OutputLines]


class Pwm:
    """One channel of the kernel's PWM, its files kept open. Every method raises HardwareError.

    Attributes:
        identity: chip and channel.
        period_ns: period in force.
    """

    def __init__(self, root: Path, channel: PwmChannelConfig, name: str, key: str, sleep: Sleep) -> None:
        self.identity = f"pwmchip{channel.chip}/pwm{channel.channel}"
        self.period_ns = 0
        self._folder, self._channel = root / self.identity, channel.channel
        self._label, self._key, self._sleep = f"{name}, {self.identity}", key, sleep
        self._fds: dict[str, int] = {}

    def open(self) -> None:
        """Export the channel and open its files; the output does not change."""
        try:
            if not self._folder.is_dir():
                fd = os.open(self._folder.parent / "export", os.O_WRONLY)
                try:
                    os.pwrite(fd, b"%d\n" % self._channel, 0)
                finally:
                    os.close(fd)
            self._open_files()
        except OSError as error:
            self.close()
            raise explain(error, self._label, "of /sys/class/pwm", self._key) from None
        self.period_ns = self._read("period")

    def _open_files(self) -> None:
        for tries_left in reversed(range(_EXPORT_TRIES)):
            try:
                for name in _PWM_FILES:
                    if name not in self._fds:
                        self._fds[name] = os.open(self._folder / name, os.O_RDWR)
                return
            except PermissionError:
                if not tries_left:
                    raise
                self._sleep(_EXPORT_WAIT_S)

    def set_up(self, period_s: float) -> None:
        """No output, then the period, then enabled: the kernel refuses a duty without a period or longer than it."""
        if self.period_ns:
            self._write("duty_cycle", 0)
        self.period_ns = round(period_s * 1e9)
        self._write("period", self.period_ns)
        self._write("duty_cycle", 0)
        self._write("enable", 1)

    def is_enabled(self) -> bool:
        """Whether the output is on."""
        return self._read("enable") != 0

    def duty(self) -> float:
        """Duty, 0 to 1, as read back from the kernel; 0 while the channel is off."""
        self.period_ns = self._read("period")
        return self._read("duty_cycle") / self.period_ns if self.period_ns and self.is_enabled() else 0.0

    def set_duty(self, duty: float) -> None:
        """Set the duty, clamped to 0 to 1."""
        self._write("duty_cycle", round(min(1.0, max(0.0, duty)) * self.period_ns))

    def restore(self, duty: float) -> None:
        """If the duty is not ``duty``, set it and enable the channel; then read it back."""
        if abs(self.duty() - duty) > _DUTY_TOLERANCE:
            self.set_duty(duty)
            self._write("enable", 1)
        if abs((found := self.duty()) - duty) > _DUTY_TOLERANCE:
            raise HardwareError(f"{self._label}: duty {found:.2f} instead of {duty:.2f}; check its driver")

    def close(self) -> None:
        """Close the files; the output does not change."""
        while self._fds:
            os.close(self._fds.popitem()[1])

    def _read(self, name: str) -> int:
        try:
            return int(os.pread(self._fds[name], 32, 0).split()[0])
        except (OSError, LookupError, ValueError) as error:
            raise HardwareError(f"{self._label}/{name}: cannot be read: {error}") from None

    def _write(self, name: str, value: int) -> None:
        try:
            os.pwrite(self._fds[name], b"%d\n" % value, 0)
        except KeyError:
            raise HardwareError(f"{self._label}: is not open") from None
        except OSError as error:
            raise explain(error, f"{self._label}/{name}", "of /sys/class/pwm", self._key) from None


class Motors:
    """Both motors with their bridge: each has two lines for the direction and a PWM; both lines high short-brake.

    A motor brakes between one direction and the other; its duty for a new direction is set while it brakes.
    """

    def __init__(self, config: MotorsConfig, root: Path, open_lines: OpenLines, sleep: Sleep) -> None:
        self._config, self._open_lines = config, open_lines
        self._motors = [
            (motor, Pwm(root, motor, f"{side} motor", f"devices.motors.{side}", sleep))
            for side, motor in (("right", config.right), ("left", config.left))
        ]
        self._directions = [0, 0]
        self._lines: OutputLines | None = None

    @property
    def identity(self) -> str:
        """PWM channels."""
        return " ".join(pwm.identity for _, pwm in self._motors)

    def open(self) -> None:
        """Brake, then set up the PWM. Raises HardwareError."""
        both = {line: True for motor, _ in self._motors for line in (motor.forward_line, motor.reverse_line)}
        if len(both) < 4:
            raise HardwareError("motors: a GPIO line is named twice; correct the lines in devices.motors")
        self._lines = self._open_lines(self._config.gpio_chip, both)
        for _, pwm in self._motors:
            pwm.open()
            pwm.set_up(self._config.period_s)
        self.brake()

    def drive(self, right_v: float, left_v: float) -> None:
        """Voltages, V, positive drives forwards; 0 brakes. Raises HardwareError, after an attempt to brake."""
        voltages = right_v, left_v
        wanted = [(v > 0.0) - (v < 0.0) for v in voltages]
        try:
            self._direct([new if new == old else 0 for new, old in zip(wanted, self._directions, strict=True)])
            for (_, pwm), voltage_v, direction in zip(self._motors, voltages, wanted, strict=True):
                pwm.set_duty(abs(voltage_v) / self._config.supply_v if direction else 1.0)
            self._direct(wanted)
        except HardwareError:
            with suppress(HardwareError):
                self._direct([0, 0])
            raise

    def brake(self) -> None:
        """Set both lines of both motors high, then full duty, also if they brake already. Raises HardwareError."""
        self._direct([0, 0], is_forced=True)
        for _, pwm in self._motors:
            pwm.set_duty(1.0)

    def close(self) -> None:
        """Brake and release. The state of a released line depends on its chip; then the external timer brakes."""
        with suppress(HardwareError):
            self.brake()
        for _, pwm in self._motors:
            pwm.close()
        if self._lines is not None:
            self._lines.close()
            self._lines = None

    def _direct(self, directions: list[int], *, is_forced: bool = False) -> None:
        """Set the lines of both motors in one call; 1: forwards, -1: backwards, 0: brake."""
        if directions == self._directions and not is_forced:
            return
        if self._lines is None:
            raise HardwareError("motors: are not open")
        values: dict[int, bool] = {}
        for (motor, _), direction in zip(self._motors, directions, strict=True):
            values |= {motor.forward_line: direction >= 0, motor.reverse_line: direction <= 0}
        self._lines.set(values)
        self._directions = directions


class FanOutputs:
    """Both fans. The program's start and end do not change the duty and period of a fan that runs.

    Attributes:
        faults: reason of each fan's fault, by the fan's name on the robot link.
    """

    def __init__(self, config: FansConfig, root: Path, sleep: Sleep) -> None:
        self._period_s = config.period_s
        self._fans = {
            f"fan_{side}": Pwm(root, channel, f"{side} fan", f"devices.fans.{side}", sleep)
            for side, channel in (("left", config.left), ("right", config.right))
        }
        self._commanded: dict[str, float] = {}
        self.faults: dict[str, str] = {}

    @property
    def identity(self) -> str:
        """PWM channels and periods."""
        return " ".join(f"{fan.identity} {fan.period_ns / 1e3:g} us" for fan in self._fans.values())

    def open(self) -> None:
        """Open both; a fan that runs is not changed, one that is off is enabled at duty 0. Raises HardwareError."""
        for fan in self._fans.values():
            fan.open()
            if not fan.is_enabled():
                fan.set_up(self._period_s)

    def duties(self) -> tuple[float, float]:
        """Duties (left, right) as read back. Raises HardwareError."""
        left, right = (fan.duty() for fan in self._fans.values())
        return left, right

    def command(self, left: float, right: float) -> None:
        """Set the duties; if one fan fails, the other is set all the same. Raises HardwareError."""
        self._commanded = {"fan_left": min(1.0, max(0.0, left)), "fan_right": min(1.0, max(0.0, right))}
        self.check()
        if self.faults:
            raise HardwareError("; ".join(self.faults.values()))

    def check(self) -> None:
        """Compare the kernel's duties with the commanded ones, set those that differ, and update ``faults``."""
        self.faults = {}
        for name, fan in self._fans.items():
            try:
                fan.restore(self._commanded[name] if name in self._commanded else fan.duty())
            except HardwareError as error:
                self.faults[name] = str(error)

    def close(self) -> None:
        """Close the files; the duties do not change."""
        for fan in self._fans.values():
            fan.close()


class ExternalTimer:
    """The timer outside this computer that brakes the motors when its line has not changed for its time-out."""

    def __init__(self, config: ExternalTimerConfig, open_lines: OpenLines) -> None:
        self._config, self._open_lines = config, open_lines
        self._lines: OutputLines | None = None
        self._level = False

    @property
    def identity(self) -> str:
        """Chip and line."""
        return f"{self._config.gpio_chip} line {self._config.line}"

    def open(self) -> None:
        """Make the line an output. Raises HardwareError."""
        self._lines = self._open_lines(self._config.gpio_chip, {self._config.line: self._level})

    def restart(self) -> None:
        """Change the line. Raises HardwareError."""
        if self._lines is None:
            raise HardwareError("external timer: is not open")
        self._level = not self._level
        self._lines.set({self._config.line: self._level})

    def close(self) -> None:
        """Release the line."""
        if self._lines is not None:
            self._lines.close()
            self._lines = None
