"""PWM of the kernel, motors, fans and external timer, over files and lines that behave as the kernel's."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from ccatp.config.load import load_onboard_config
from ccatp.config.onboard_models import MotorsConfig
from ccatp.onboard.devices.outputs import ExternalTimer, FanOutputs, Motors
from ccatp.onboard.hardware import HardwareError
from tests.support.onboard_fakes import FakeBridge, FakePwm, FakeTime

CONFIG = load_onboard_config().devices
FORWARDS, BACKWARDS, BRAKE = (True, False), (False, True), (True, True)


class Rig:
    """Motors, fans and timer on the outputs of one computer: chip 0 for the motors, 1 for the fans."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.pwm = FakePwm(root, monkeypatch, {0: 2, 1: 2})
        self.bridge = FakeBridge()
        self.time = FakeTime()
        self.motors = Motors(CONFIG.motors, root, self.bridge.open, self.time.sleep)
        self.fans = FanOutputs(CONFIG.fans, root, self.time.sleep)
        self.timer = ExternalTimer(CONFIG.timer, self.bridge.open)

    def right(self) -> tuple[tuple[bool, bool], float]:
        """Lines and duty of the right motor."""
        levels, right = self.bridge.levels, CONFIG.motors.right
        return (levels[right.forward_line], levels[right.reverse_line]), self.pwm.duty(0, 0)


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    return Rig(tmp_path, monkeypatch)


@pytest.fixture
def motors(rig: Rig) -> Motors:
    rig.motors.open()
    return rig.motors


# -- motors -----------------------------------------------------------------------------------------------------------


def test_motors_brake_before_their_pwm_is_touched(rig: Rig) -> None:
    rig.bridge.error = HardwareError("in use")
    with pytest.raises(HardwareError, match="in use"):
        rig.motors.open()
    assert not rig.pwm.writes
    rig.bridge.error = None
    rig.motors.open()
    assert rig.right() == (BRAKE, 1.0)
    assert all(rig.bridge.levels.values())
    assert [name for name, _ in rig.pwm.writes if "pwm0" in name] == [
        f"pwmchip0/pwm0/{name}" for name in ("period", "duty_cycle", "enable", "duty_cycle")
    ]


@pytest.mark.parametrize("period", [20_000, 50_000, 100_000_000])
def test_motors_take_over_a_channel_that_runs(rig: Rig, period: int) -> None:
    rig.pwm.export(0, 0, period, duty=period, enable=1)
    rig.motors.open()
    assert rig.pwm.value("pwmchip0/pwm0/period") == 50_000
    assert rig.right() == (BRAKE, 1.0)


@pytest.mark.parametrize(
    ("voltage_v", "expected"),
    [
        (6.0, (FORWARDS, 0.5)), (-3.0, (BACKWARDS, 0.25)), (0.0, (BRAKE, 1.0)), (99.0, (FORWARDS, 1.0)),
        (-99.0, (BACKWARDS, 1.0)), (1e-9, (FORWARDS, 0.0)),
    ],
)  # fmt: skip
def test_a_voltage_is_direction_and_duty(
    rig: Rig, motors: Motors, voltage_v: float, expected: tuple[tuple[bool, bool], float]
) -> None:
    motors.drive(voltage_v, 0.0)
    assert rig.right() == expected
    assert rig.pwm.duty(0, 1) == 1.0
    motors.drive(0.0, voltage_v)
    assert rig.right() == (BRAKE, 1.0)


def test_a_motor_reverses_through_the_brake_and_its_duty_changes_while_it_brakes(
    rig: Rig, motors: Motors, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[tuple[bool, bool], float]] = []
    set_lines, pwrite = rig.bridge.set, os.pwrite

    def set_and_note(values: dict[int, bool]) -> None:
        set_lines(values)
        seen.append(rig.right())

    def pwrite_and_note(fd: int, data: bytes, offset: int) -> int:
        count = pwrite(fd, data, offset)
        seen.append(rig.right())
        return count

    motors.drive(6.0, 6.0)
    rig.bridge.set = set_and_note  # type: ignore[method-assign, assignment]
    monkeypatch.setattr(os, "pwrite", pwrite_and_note)
    motors.drive(-3.0, 6.0)
    states = [state for n, state in enumerate(seen) if n == 0 or state != seen[n - 1]]
    assert states == [(BRAKE, 0.5), (BRAKE, 0.25), (BACKWARDS, 0.25)]
    assert rig.bridge.levels[CONFIG.motors.left.reverse_line] is False  # the other one drives on
    seen.clear()
    motors.brake()
    assert seen[0] == (BRAKE, 0.25)
    assert seen[-1] == (BRAKE, 1.0)


def test_each_voltage_of_a_direction_is_one_write(rig: Rig, motors: Motors) -> None:
    motors.drive(1.0, 1.0)
    rig.pwm.writes.clear()
    rig.bridge.changes.clear()
    motors.drive(2.0, 3.0)
    assert [name for name, _ in rig.pwm.writes] == ["pwmchip0/pwm0/duty_cycle", "pwmchip0/pwm1/duty_cycle"]
    assert not rig.bridge.changes


def test_a_motor_that_cannot_be_set_leaves_both_braking(rig: Rig, motors: Motors) -> None:
    motors.drive(6.0, 6.0)
    rig.pwm.refusals["pwmchip0/pwm1/duty_cycle"] = errno.EIO
    with pytest.raises(HardwareError, match=r"left motor, pwmchip0/pwm1/duty_cycle: .*Input/output error"):
        motors.drive(5.0, 5.0)
    assert all(rig.bridge.levels.values())
    rig.pwm.refusals.clear()
    motors.drive(6.0, 6.0)
    assert rig.right() == (FORWARDS, 0.5)


def test_lines_that_fail_are_named_and_tried_again(rig: Rig, motors: Motors) -> None:
    rig.bridge.error = HardwareError("/dev/gpiochip0: gone")
    for call in (motors.brake, lambda: motors.drive(6.0, 6.0)):
        with pytest.raises(HardwareError, match="gpiochip0: gone"):
            call()
    rig.bridge.error = None
    motors.drive(6.0, 6.0)
    assert rig.right() == (FORWARDS, 0.5)


def test_closed_motors_brake(rig: Rig, motors: Motors) -> None:
    motors.drive(6.0, -6.0)
    motors.close()
    assert rig.right() == (BRAKE, 1.0)
    assert rig.bridge.closed == 1
    for call in (motors.brake, lambda: motors.drive(1.0, 1.0)):
        with pytest.raises(HardwareError, match="not open"):
            call()


def test_one_line_for_two_purposes_is_refused(tmp_path: Path) -> None:
    left = CONFIG.motors.left.model_copy(update={"forward_line": CONFIG.motors.right.reverse_line})
    config: MotorsConfig = CONFIG.motors.model_copy(update={"left": left})
    with pytest.raises(HardwareError, match="a GPIO line is named twice"):
        Motors(config, tmp_path, FakeBridge().open, FakeTime().sleep).open()


# -- what the kernel refuses ------------------------------------------------------------------------------------------

REFUSED: dict[str, tuple[Callable[[FakePwm], object], str]] = {
    "no chip": (
        lambda p: (p.root / "pwmchip1").rename(p.root / "pwmchip7"),
        "left fan, pwmchip1/pwm0: is not there; check the wiring, the device tree and devices.fans.left",
    ),
    "no such channel": (
        lambda p: p.refusals.update({"pwmchip1/export": errno.ENODEV}), "has no such channel; check devices.fans.left",
    ),
    "channel of a driver": (
        lambda p: p.refusals.update({"pwmchip1/export": errno.EBUSY}), "in use by another program or driver",
    ),
    "no permission to export": (
        lambda p: p.denials.update({"pwmchip1/export": 1}),
        "permission denied; add the user of this program to the group of /sys/class/pwm",
    ),
    "no permission for the channel": (
        lambda p: p.denials.update({"pwmchip1/pwm0/period": 99}), "left fan, pwmchip1/pwm0: permission denied",
    ),
    "period refused": (
        lambda p: p.refusals.update({"pwmchip1/pwm1/period": errno.EINVAL}),
        "right fan, pwmchip1/pwm1/period: refuses the value; check devices.fans.right",
    ),
    "enabling refused": (
        lambda p: p.refusals.update({"pwmchip1/pwm1/enable": errno.EIO}), "pwmchip1/pwm1/enable: .*Input/output error",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("broken", "message"), REFUSED.values(), ids=REFUSED)
def test_a_pwm_that_is_not_right_is_refused(rig: Rig, broken: Callable[[FakePwm], object], message: str) -> None:
    broken(rig.pwm)
    with pytest.raises(HardwareError, match=message):
        rig.fans.open()


def test_a_channel_may_get_its_permissions_a_moment_after_the_export(rig: Rig) -> None:
    rig.pwm.denials["pwmchip1/pwm0/duty_cycle"] = 3
    rig.fans.open()
    assert rig.fans.duties() == (0.0, 0.0)


# -- fans -------------------------------------------------------------------------------------------------------------


def test_a_restarted_program_finds_the_fans_running_and_changes_nothing(rig: Rig) -> None:
    rig.pwm.export(1, 0, period=40_000, duty=24_000, enable=1)
    rig.pwm.export(1, 1, period=50_000, duty=10_000, enable=1)  # another period than the configured one
    rig.fans.open()
    assert rig.fans.duties() == (0.6, 0.2)
    rig.fans.check()
    rig.fans.close()
    assert not rig.pwm.writes
    rig.fans.open()
    rig.fans.command(0.7, 0.3)
    assert rig.pwm.value("pwmchip1/pwm1/duty_cycle") == 15_000
    assert rig.pwm.value("pwmchip1/pwm1/period") == 50_000
    rig.fans.close()
    assert (rig.pwm.duty(1, 0), rig.pwm.duty(1, 1)) == (0.7, 0.3)


def test_fans_that_are_off_begin_at_zero(rig: Rig) -> None:
    rig.pwm.export(1, 1, period=30_000, duty=30_000, enable=0)
    rig.fans.open()
    assert rig.fans.duties() == (0.0, 0.0)
    assert [value for name, value in rig.pwm.writes if name == "pwmchip1/pwm1/enable"] == [1]
    assert rig.pwm.value("pwmchip1/pwm0/period") == rig.pwm.value("pwmchip1/pwm1/period") == 40_000
    rig.fans.command(2.0, -1.0)
    assert rig.fans.duties() == (1.0, 0.0)
    rig.fans.command(-1.0, 2.0)
    assert rig.fans.duties() == (0.0, 1.0)


def test_a_fan_that_fails_is_named_and_the_other_one_is_set(rig: Rig) -> None:
    rig.fans.open()
    rig.pwm.refusals["pwmchip1/pwm0/duty_cycle"] = errno.EIO
    with pytest.raises(HardwareError, match=r"left fan, pwmchip1/pwm0/duty_cycle: .*Input/output error"):
        rig.fans.command(0.5, 0.4)
    assert rig.fans.duties() == (0.0, 0.4)
    rig.fans.check()
    assert list(rig.fans.faults) == ["fan_left"]
    rig.pwm.refusals.clear()
    rig.fans.check()  # sets what was commanded
    assert (rig.fans.duties(), rig.fans.faults) == ((0.5, 0.4), {})


@pytest.mark.parametrize(
    ("name", "value"),
    [("duty_cycle", 0), ("duty_cycle", 40_000), ("enable", 0), ("period", 80_000), ("period", 20_000)],
)
def test_a_fan_that_something_else_changed_is_set_again(rig: Rig, name: str, value: int) -> None:
    rig.fans.open()
    rig.fans.command(0.5, 0.4)
    (rig.pwm.root / "pwmchip1" / "pwm1" / name).write_text(f"{value}\n")
    rig.fans.check()
    assert rig.fans.duties() == (0.5, 0.4)


def test_a_fan_that_does_not_take_its_duty_is_a_fault(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.fans.open()
    monkeypatch.setattr(os, "pwrite", lambda _fd, data, _offset: len(data))
    with pytest.raises(HardwareError, match=r"left fan, pwmchip1/pwm0: duty 0.00 instead of 0.50; .*; right fan"):
        rig.fans.command(0.5, 0.5)
    assert list(rig.fans.faults) == ["fan_left", "fan_right"]


@pytest.mark.parametrize("content", ["", "many\n"])
def test_a_duty_that_cannot_be_read(rig: Rig, content: str) -> None:
    rig.fans.open()
    (rig.pwm.root / "pwmchip1" / "pwm1" / "duty_cycle").write_text(content)
    with pytest.raises(HardwareError, match="right fan, pwmchip1/pwm1/duty_cycle: cannot be read"):
        rig.fans.duties()
    rig.fans.check()
    assert list(rig.fans.faults) == ["fan_right"]


# -- external timer ---------------------------------------------------------------------------------------------------


def test_each_restart_of_the_timer_changes_its_line(rig: Rig) -> None:
    line = CONFIG.timer.line
    with pytest.raises(HardwareError, match="external timer: is not open"):
        rig.timer.restart()
    rig.timer.open()
    levels = [rig.bridge.levels[line]]
    for _ in range(3):
        rig.timer.restart()
        levels.append(rig.bridge.levels[line])
    assert levels == [False, True, False, True]
    rig.bridge.error = HardwareError("/dev/gpiochip0: gone")
    with pytest.raises(HardwareError, match="gpiochip0: gone"):
        rig.timer.restart()
    rig.timer.close()
    assert rig.bridge.closed == 1
