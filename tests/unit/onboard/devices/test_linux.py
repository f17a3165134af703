"""All devices together, what they are opened with, and the check before the first drive."""

import errno
import fcntl
import os
import random
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ccatp.config.load import load_onboard_config
from ccatp.onboard.devices.bno055 import Bno055, Bno055Sample
from ccatp.onboard.devices.linux import DeviceAccess, GpioLines, I2cBus, LinuxHardware, open_serial
from ccatp.onboard.hardware import Hardware, HardwareError
from tests.support.onboard_fakes import FakeBno055, FakeBridge, FakeDaq, FakePwm, FakeTime, voltage_of

CONFIG = load_onboard_config().devices
DEVICES = ["motors", "timer", "fans", "bno055", "daq"]


class SteppedBno055(Bno055):
    """Reads when its samples are taken, at the times at which its thread would have."""

    due_s = 0.0

    def take(self, until_s: float) -> list[Bno055Sample]:
        now_s = self._clock()
        while self.due_s <= now_s:
            self.due_s = max(self.due_s, now_s - 0.01) + self.step()
        return super().take(until_s)


class Rig:
    """A whole robot of fakes."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch, reader: type[Bno055] = SteppedBno055) -> None:
        start = threading.Thread.start
        # The thread of the inertial unit does not run: its readings are taken in the time of the test.
        monkeypatch.setattr(threading.Thread, "start", lambda one: None if one.name == "bno055" else start(one))
        self.time = FakeTime()
        self.unit, self.daq = FakeBno055(self.time), FakeDaq(self.time)
        self.pwm, self.bridge = FakePwm(root, monkeypatch, {0: 2, 1: 2}), FakeBridge()
        self.bus_error: HardwareError | None = None
        access = DeviceAccess(self.open_bus, self.daq.open, self.bridge.open, root, reader, self.time.sleep)
        self.linux = LinuxHardware(CONFIG, self.time, access)
        self.hardware: Hardware = self.linux

    def open_bus(self, number: int) -> FakeBno055:
        assert number == CONFIG.bno055.bus
        if self.bus_error is not None:
            raise self.bus_error
        return self.unit.open()

    def voltages(self) -> list[float]:
        """Of the right and the left motor, from lines and duties; 0 where it brakes."""
        motors = CONFIG.motors
        return [voltage_of(m, motors.supply_v, self.bridge, self.pwm) for m in (motors.right, motors.left)]

    def run(self, duration_s: float) -> set[str]:
        """Read each 2 ms; the faults after the last one."""
        end_s = self.time.now_s + duration_s
        faults: set[str] = set()
        while self.time.now_s < end_s:
            self.time.sleep(0.002)
            faults = set(self.hardware.read(self.time.now_s).faults)
        return faults


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    return Rig(tmp_path, monkeypatch)


# -- all together -----------------------------------------------------------------------------------------------------


def test_start_read_drive_close(rig: Rig) -> None:
    rig.daq.step, rig.unit.wz_rad_s, rig.unit.ax_m_s2, rig.unit.ay_m_s2 = [2, -3], 0.5, 0.25, -0.5
    rig.hardware.start()
    assert all(rig.bridge.levels[line] for line in (5, 6, 13, 19))
    assert rig.run(0.3) == set()
    rig.time.sleep(0.02)
    readings = rig.hardware.read(rig.time.now_s)
    assert readings.imu[-1][1:] == (0.25, 0.5, -0.5)
    assert readings.gravity is not None
    assert readings.gravity[1:] == pytest.approx((0.0, 0.0, -1.0))
    (t_s, right, left), edge = readings.counts[-1], readings.edges[-1]
    assert right is not None
    assert left is not None
    assert (t_s, 3 * right) == (edge[0], -2 * left)
    assert edge[1:] == pytest.approx([60000 / 65535 * 3.3] * 4)
    assert 0.0 < readings.soc < 1.0
    assert all(row[0] <= rig.time.now_s for rows in (readings.imu, readings.counts) for row in rows)

    level = rig.bridge.levels[CONFIG.timer.line]
    rig.hardware.drive(6.0, -6.0)
    assert rig.bridge.levels[CONFIG.timer.line] is not level
    assert rig.bridge.levels[5] is rig.bridge.levels[19] is True
    rig.hardware.brake()
    assert rig.bridge.levels[CONFIG.timer.line] is not level  # the timer runs out by itself
    rig.hardware.command_fans(0.5, 0.25)
    rig.hardware.drive(6.0, 6.0)
    rig.hardware.close()
    assert all(rig.bridge.levels[line] for line in (5, 6, 13, 19))
    assert rig.pwm.value("pwmchip1/pwm0/duty_cycle") == 20_000
    rig.hardware.close()


Break = Callable[[Rig], object]


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda r: setattr(r.bridge, "error", HardwareError("/dev/gpiochip0: no")), "gpiochip0: no"),
        (lambda r: r.pwm.denials.update({"pwmchip1/export": 1}), "left fan, pwmchip1/pwm0: permission denied"),
        (lambda r: setattr(r.daq, "open_error", HardwareError("no port")), "data acquisition device: no port"),
        (lambda r: setattr(r, "bus_error", HardwareError("no bus")), "no bus"),
        (lambda r: setattr(r.unit, "chip_id", 0), "chip id 0x00"),
    ],
)
def test_a_start_that_fails_releases_what_was_opened(rig: Rig, broken: Break, message: str) -> None:
    broken(rig)
    files = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(HardwareError, match=message):
        rig.hardware.start()
    assert len(list(Path("/proc/self/fd").iterdir())) == files


# -- check ------------------------------------------------------------------------------------------------------------


def test_check_of_a_robot_that_is_whole(rig: Rig) -> None:
    checks = rig.linux.check(1.0)
    assert [check.device for check in checks] == DEVICES
    assert all(check.found and check.passed and not check.advice for check in checks)
    outputs, (imu, daq) = checks[:3], checks[3:]
    assert [check.identity for check in outputs] == [
        "pwmchip0/pwm0 pwmchip0/pwm1", "/dev/gpiochip0 line 26", "pwmchip1/pwm0 40 us pwmchip1/pwm1 40 us",
    ]  # fmt: skip
    assert (daq.identity, daq.noise) == ("ccatp-daq 1.2 SN7", "0 V")
    assert daq.rate_hz == pytest.approx(1000.0)
    assert imu.identity.startswith("BNO055 software 3.11")
    assert imu.rate_hz == pytest.approx(100.0, rel=0.01)
    assert imu.noise == "0 rad/s, 0 m/s^2"
    assert all(rig.bridge.levels[line] for line in (5, 6, 13, 19))


def _shake(rig: Rig) -> None:
    rng, fuse = random.Random(4), rig.unit.tamper

    def shaken(burst: bytes) -> bytes:
        rig.unit.wz_rad_s = rng.gauss(0.0, 0.05)
        return fuse(burst)

    rig.unit.tamper = shaken


def _flicker(rig: Rig) -> None:
    rng = random.Random(5)

    def changed(frame: bytes) -> bytes:
        rig.daq.adc[2] = rng.randrange(30000, 60000)
        return frame

    rig.daq.corrupt = changed


# What is wrong, the device, whether it was found, advice.
CHECKS: dict[str, tuple[Break, str, bool, str]] = {
    "no lines": (
        lambda r: setattr(r.bridge, "error", HardwareError("/dev/gpiochip0: is not there")), "motors", False,
        "/dev/gpiochip0: is not there",
    ),
    "no port": (
        lambda r: setattr(r.daq, "open_error", HardwareError("is not there")), "daq", False,
        "data acquisition device: is not there",
    ),
    "no unit": (
        lambda r: setattr(r.unit, "error", OSError(errno.EREMOTEIO, "Remote I/O error")), "bno055", False,
        "BNO055: [Errno 121] Remote I/O error; check the wiring of the I2C bus",
    ),
    "too few samples": (
        lambda r: setattr(r.daq, "corrupt", _Sometimes(5)), "daq", True, "800 samples/s instead of 1000; ",
    ),
    "an empty battery": (
        lambda r: r.daq.adc.__setitem__(4, 45000), "daq", True,
        "battery at 9.06 V; charge it, or check devices.daq.battery_*",
    ),
    "a unit that fails while it is read": (
        lambda r: setattr(r.unit, "tamper", lambda burst: b"\xff" * len(burst)), "bno055", True,
        "the bus reads ones only; check its wiring",
    ),
    "a robot that is moved": (_shake, "bno055", True, "rad/s, limit 0.01; let the robot stand"),
    "a loose edge sensor": (_flicker, "daq", True, "V, limit 0.05; let the robot stand"),
}  # fmt: skip


class _Sometimes:
    """Loses every n-th frame."""

    def __init__(self, each: int) -> None:
        self._each, self._count = each, 0

    def __call__(self, frame: bytes) -> bytes:
        self._count += 1
        return b"" if self._count % self._each == 0 else frame


@pytest.mark.parametrize(("broken", "device", "is_found", "advice"), CHECKS.values(), ids=CHECKS)
def test_check_names_what_is_wrong(rig: Rig, broken: Break, device: str, is_found: bool, advice: str) -> None:
    broken(rig)
    checks = {check.device: check for check in rig.linux.check(1.0)}
    assert list(checks) == DEVICES
    found = checks.pop(device)
    assert found.noise or not found.rate_hz
    assert (found.found, found.passed) == (is_found, False)
    assert advice in found.advice
    others = set(checks) - {"timer"} if "gpiochip" in advice else set(checks)
    assert all(checks[name].passed for name in others)


# -- packages and device files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("package", "install", "open_device"),
    [
        ("smbus2", "smbus2", lambda: I2cBus(1)),
        ("serial", "pyserial", lambda: open_serial("/dev/ttyACM0", 921600, "devices.daq")),
        ("gpiod", "gpiod", lambda: GpioLines("/dev/gpiochip0", {5: True})),
    ],
)
def test_a_package_that_is_not_installed(
    package: str, install: str, open_device: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(HardwareError, match=rf"^{install} is not installed; pip install ccatp\[onboard\]$"):
        open_device()


def test_device_files_that_are_not_there() -> None:
    with pytest.raises(HardwareError, match=r"/dev/i2c-255: is not there; .* devices.bno055.bus"):
        I2cBus(255)
    with pytest.raises(HardwareError, match=r"/dev/nothing: is not there; .* the lines in devices.motors"):
        GpioLines("/dev/nothing", {5: True})


def test_a_bus_transfers_by_one_call_of_the_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[list[tuple[int, int, bytes]]] = []

    class SMBus:
        fd = -1

        def __init__(self, number: int) -> None:
            assert number == 3

        def i2c_rdwr(self, *messages: Any) -> None:
            calls.append([(m.addr, m.flags, bytes(m)) for m in messages])
            if messages[-1].flags:
                messages[-1].buf[0] = b"\xa0"

        def close(self) -> None:
            calls.append([])

    monkeypatch.setattr("smbus2.SMBus", SMBus)
    monkeypatch.setattr(fcntl, "ioctl", lambda *_: 0)
    bus = I2cBus(3)
    bus.write(0x28, b"\x3d\x08")
    assert bus.write_read(0x28, b"\x00", 2) == b"\xa0\x00"
    bus.close()
    assert calls == [[(0x28, 0, b"\x3d\x08")], [(0x28, 0, b"\x00"), (0x28, 1, b"\x00\x00")], []]


def test_lines_are_outputs_with_their_first_levels_and_set_in_one_call(monkeypatch: pytest.MonkeyPatch) -> None:
    import gpiod

    seen: list[Any] = []
    request = SimpleNamespace(set_values=seen.append, release=lambda: seen.append("released"))

    def request_lines(chip: str, consumer: str, config: dict[int, Any]) -> Any:
        assert (chip, consumer) == ("/dev/gpiochip0", "ccatp")
        assert {settings.direction for settings in config.values()} == {gpiod.line.Direction.OUTPUT}
        seen.append({line: settings.output_value for line, settings in config.items()})
        return request

    monkeypatch.setattr(gpiod, "request_lines", request_lines)
    low, high = gpiod.line.Value.INACTIVE, gpiod.line.Value.ACTIVE
    lines = GpioLines("/dev/gpiochip0", {5: True, 6: False})
    lines.set({5: False, 6: True})
    lines.close()
    request.set_values = _refuse
    with pytest.raises(
        HardwareError, match=r"/dev/gpiochip0: \[Errno 5\] Input/output error; check the lines in devices"
    ):
        lines.set({5: True})
    assert seen == [{5: high, 6: low}, {5: low, 6: high}, "released"]


def _refuse(_values: object) -> None:
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def test_the_drivers_import_nothing_heavy() -> None:
    heavy = {"numpy", "scipy", "matplotlib", "zmq", "starlette", "uvicorn", "smbus2", "serial", "gpiod"}
    program = "import sys, ccatp.onboard.devices.linux; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert heavy.isdisjoint(modules.split())
