"""Devices of the robot's computer that break by registers and bytes: what the robot does by itself, and how fast.

The on-board program drives its wheels over fake devices, in a time of its own.
"""

import errno
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from ccatp.config.load import load_onboard_config
from ccatp.config.onboard_models import Bno055Config
from ccatp.onboard.devices.bno055 import Bno055, Bno055Sample, Bus
from ccatp.onboard.hardware import HardwareError
from ccatp.onboard.robot import OnboardRobot
from tests.faults.linking import Measured
from tests.support.onboard_fakes import FakeTime
from tests.unit.onboard.devices.test_bno055 import BREAKS as UNIT_BREAKS
from tests.unit.onboard.devices.test_daq import BREAKS as DAQ_BREAKS
from tests.unit.onboard.devices.test_linux import Rig

CFG = load_onboard_config()
STEP_S = 1.0 / CFG.servo.loop_hz
WATCHED_S, PATIENCE_S = 1.5, 20.0
RATES = 3.0, -2.0  # right, left, rad/s
SAMPLED = {"encoder_left", "encoder_right", "edge"}
# Rows of the table in their order, and what breaks: of the inertial unit, of the data acquisition device, of the rest.
UNIT = {f"D{k}": name for k, name in enumerate(UNIT_BREAKS, 1)}
DAQ = {f"D{k}": name for k, name in enumerate(DAQ_BREAKS, 1 + len(UNIT_BREAKS))}


class UnitTime(FakeTime):
    """The time of the inertial unit and of the thread that reads it: while that waits, the robot's goes on."""

    def __init__(self, robot: FakeTime) -> None:
        self._robot, self._own_s = robot, 0.0

    @property
    def now_s(self) -> float:  # type: ignore[override]
        return max(self._own_s, self._robot.now_s)

    def sleep(self, wait_s: float) -> None:
        self._own_s = self.now_s + wait_s


class ThreadedBno055(Bno055):
    """Reads as its thread does; what an attempt with waits brings about is seen when they are over."""

    def __init__(self, config: Bno055Config, open_bus: Callable[[], Bus], clock: FakeTime, sleep: object) -> None:
        self.robot, self.time = clock, UnitTime(clock)
        self._due_s = 0.0
        self._seen = clock(), ""
        super().__init__(config, open_bus, self.time, self.time.sleep)

    def take(self, until_s: float) -> list[Bno055Sample]:
        while max(self._due_s, self.time.now_s) <= self.robot.now_s:
            self._seen = self._newest_s, self._reason
            self._due_s = max(self._due_s, self.robot.now_s - 0.01) + self.step()
        return super().take(until_s)

    def fault(self, now_s: float) -> str:
        if self.time.now_s <= now_s:
            self._seen = self._newest_s, self._reason
        age_s = now_s - self._seen[0]
        return f"no reading for {age_s:.2f} s" if age_s > self._config.timeout_s else ""


class Driving:
    """A robot that drives its wheels, each at its own rate."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.rig = rig = Rig(root, monkeypatch, ThreadedBno055)
        reader = rig.linux._imu
        assert isinstance(reader, ThreadedBno055)
        rig.unit._time = reader.time
        rig.hardware.start()
        rig.time.sleep(1.0)
        self.robot = OnboardRobot(CFG, self.rig.hardware)
        self._rates = [0.0, 0.0]
        self.run(0.5)  # eight time constants of the wheels
        assert self._rates == pytest.approx(RATES, abs=0.05)  # 2 % of the set points
        assert not self.robot.rules.is_held
        assert not self.robot.faults

    def step(self) -> None:
        """One step of the control loop, and of the wheels."""
        rig, servo = self.rig, CFG.servo
        rig.time.sleep(STEP_S)
        self.robot.rules.drive(1, *RATES, rig.time.now_s)
        self.robot.control(rig.time.now_s)
        for wheel, voltage_v in enumerate(rig.voltages()):
            steady = math.copysign(max(0.0, abs(voltage_v) - servo.static_v) / servo.volt_per_rad_s, voltage_v)
            self._rates[wheel] += (steady - self._rates[wheel]) * STEP_S / 0.06
        counts_per_rad = servo.counts_per_rev / math.tau
        rig.daq.step = [rate * counts_per_rad / CFG.devices.daq.sample_hz for rate in self._rates]

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / STEP_S)):
            self.step()

    def until(self, is_there: Callable[[], bool], most_s: float = PATIENCE_S) -> float:
        """Time until then, s."""
        start_s = self.rig.time.now_s
        while not is_there():
            assert self.rig.time.now_s - start_s < most_s
            self.step()
        return self.rig.time.now_s - start_s

    def holds(self, duration_s: float) -> int:
        """How often the wheels are held in a time."""
        count, was_held = 0, self.robot.rules.is_held
        for _ in range(round(duration_s / STEP_S)):
            self.step()
            count += self.robot.rules.is_held and not was_held
            was_held = self.robot.rules.is_held
        return count


@pytest.fixture
def driving(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Driving:
    return Driving(tmp_path, monkeypatch)


def rows(names: dict[str, str]) -> list[object]:
    return [pytest.param(row, name, marks=pytest.mark.fault(row), id=name) for row, name in names.items()]


def breaks(
    driving: Driving, measured: Measured, row: str, is_silent: bool, device: object, faults: set[str],
    broken: Callable[[object], object], repair: Callable[[object], object] | None,
) -> None:  # fmt: skip
    robot = driving.robot
    broken(device)
    if is_silent:
        measured(row, driving.holds(WATCHED_S), "holds")
        return
    measured(row, 1e3 * driving.until(lambda: robot.rules.is_held), "ms")
    assert set(robot.faults) == faults
    if faults == SAMPLED:  # it does not see its wheels
        assert driving.rig.voltages() == [0.0, 0.0]
    driving.run(0.1)
    if repair is not None:
        repair(device)
    driving.until(lambda: not robot.rules.is_held and not robot.faults)


@pytest.mark.parametrize(("row", "name"), rows(UNIT))
def test_the_inertial_unit(row: str, name: str, driving: Driving, measured: Measured) -> None:
    broken, reason, repair, _ = UNIT_BREAKS[name]
    breaks(driving, measured, row, not reason, driving.rig.unit, {"imu"}, broken, repair)  # type: ignore[arg-type]


@pytest.mark.parametrize(("row", "name"), rows(DAQ))
def test_the_data_acquisition_device(row: str, name: str, driving: Driving, measured: Measured) -> None:
    broken, reason, repair, _ = DAQ_BREAKS[name]
    breaks(driving, measured, row, not reason, driving.rig.daq, SAMPLED, broken, repair)  # type: ignore[arg-type]
    driving.run(0.5)
    right_v, left_v = driving.rig.voltages()
    assert right_v > 0.0 > left_v


@pytest.mark.parametrize(
    ("row", "broken"),
    [
        pytest.param(
            "D40", lambda rig: rig.pwm.refusals.update({"pwmchip0/pwm0/duty_cycle": errno.EIO}),
            marks=pytest.mark.fault("D40"), id="PWM",
        ),
        pytest.param(
            "D41", lambda rig: setattr(rig.bridge, "error", HardwareError("/dev/gpiochip0: Input/output error")),
            marks=pytest.mark.fault("D41"), id="lines",
        ),
    ],
)  # fmt: skip
def test_motors_that_cannot_be_set(
    row: str, broken: Callable[[Rig], object], driving: Driving, measured: Measured
) -> None:
    rig, robot = driving.rig, driving.robot
    broken(rig)
    line = CFG.devices.timer.line
    level = rig.bridge.levels[line]
    measured(row, 1e3 * driving.until(lambda: "motors" in robot.faults), "ms")
    driving.run(0.1)
    assert rig.bridge.levels[line] is level  # it runs out, and brakes


@pytest.mark.parametrize(
    ("row", "broken", "fault"),
    [
        pytest.param(
            "D42", lambda rig: (rig.pwm.root / "pwmchip1/pwm0/duty_cycle").write_text("?\n"), "fan_left",
            marks=pytest.mark.fault("D42"), id="fan that cannot be read",
        ),
        pytest.param(
            "D43", lambda rig: (rig.pwm.root / "pwmchip1/pwm1/enable").write_text(""), "fan_right",
            marks=pytest.mark.fault("D43"), id="fan that is off",
        ),
        pytest.param(
            "D44", lambda rig: rig.daq.adc.__setitem__(4, 0), "battery_low",
            marks=pytest.mark.fault("D44"), id="battery",
        ),
    ],
)  # fmt: skip
def test_what_does_not_hold_the_wheels_is_on_the_link(
    row: str, broken: Callable[[Rig], object], fault: str, driving: Driving, measured: Measured
) -> None:
    broken(driving.rig)
    measured(row, 1e3 * driving.until(lambda: fault in driving.robot.faults), "ms")
    assert not driving.robot.rules.is_held
