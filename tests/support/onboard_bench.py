"""A simulated robot behind devices at register and byte level, on the wall clock.

The program's drivers write files of a PWM tree and lines of GPIO chips, read an inertial unit by its registers and a
data acquisition device by its bytes. Each sample of the device moves the simulated robot on, with the voltages that the
files and lines mean then, or braked where the external timer has run out.
"""

import os
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path

import pytest

from ccatp.config.onboard_models import DevicesConfig, MotorConfig
from ccatp.onboard.devices.daq import SAMPLE, SAMPLES
from ccatp.onboard.devices.linux import LinuxHardware
from ccatp.sim.hardware import SimulatedHardware
from tests.support.onboard_fakes import FakeBno055, FakeBridge, FakeDaq, FakePwm, FakeTime


class WallClock(FakeTime):
    """The robot's clock, s since ``start_s`` of ``monotonic``, for devices that go by themselves."""

    def __init__(self, start_s: float) -> None:
        self._start_s = start_s

    @property
    def now_s(self) -> float:  # type: ignore[override]
        return time.monotonic() - self._start_s

    def sleep(self, wait_s: float) -> None:
        time.sleep(wait_s)


class _Bridge(FakeBridge):
    """Lines whose changes are not kept, and when the line of the external timer changed last.

    With ``timer_fd`` each change of that line is a byte there, for an external timer in another process.
    """

    def __init__(self, clock: WallClock, timer_line: int, timer_fd: int | None) -> None:
        super().__init__()
        self._clock, self._timer_line, self.restarted_s = clock, timer_line, -1.0
        self._timer_fd = timer_fd

    def set(self, values: Mapping[int, bool]) -> None:
        self.levels |= values
        if self._timer_line in values:
            self.restarted_s = self._clock.now_s
            if self._timer_fd is not None:
                os.write(self._timer_fd, b"x")


class _Bno055(FakeBno055):
    """Its bus may hang: a transfer ends after ``hang_s``."""

    hang_s = 0.0

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        if self.hang_s:
            time.sleep(self.hang_s)
        return super().write_read(address, data, count)


class _Daq(FakeDaq):
    """Samples of the simulated robot, in packets of ten."""

    bench: "RobotBench"

    def _sample(self) -> None:
        now_s, bench = self._time.now_s, self.bench
        while self._next_s <= now_s:
            self.device_us += 1e6 / self._sample_hz
            right, left, edges = bench.step()
            adc = [round(65535.0 * voltage_v / bench.full_scale_v) for voltage_v in edges]
            self._waiting += SAMPLE.pack(round(self.device_us) & 0xFFFFFFFF, right, left, *adc, self.adc[4])
            self._next_s += 1.0 / self._sample_hz
            if len(self._waiting) == 10 * SAMPLE.size:
                payload, self._waiting = self._waiting, b""
                self.send(SAMPLES, payload)


class RobotBench:
    """Everything around ``hardware``, which drives it.

    ``simulated`` has the sample rate of the data acquisition device as its loop.
    """

    def __init__(
        self, devices: DevicesConfig, simulated: SimulatedHardware, folder: Path, start_s: float,
        monkeypatch: pytest.MonkeyPatch,
        timer_fd: int | None = None,
    ) -> None:  # fmt: skip
        self._devices, self.simulated = devices, simulated
        self.full_scale_v = devices.daq.full_scale_v
        self.clock = WallClock(start_s)
        self.bno055 = _Bno055(self.clock)
        self.daq = _Daq(self.clock)
        self.daq.bench = self
        self.bridge = _Bridge(self.clock, devices.timer.line, timer_fd)
        self.pwm = FakePwm(folder, monkeypatch, {0: 2, 1: 2})
        self._steps, self._radius_m = 0, simulated.wheel_radius_m
        self._speeds: deque[float] = deque(maxlen=1 + round(devices.daq.sample_hz / devices.bno055.rate_hz))
        self.hardware = LinuxHardware(
            devices,
            self.clock,
            open_bus=lambda _: self.bno055.open(),
            open_port=self.daq.open,
            open_lines=self.bridge.open,
            pwm_root=folder,
        )

    def step(self) -> tuple[int, int, list[float]]:
        """Move the robot on by one sample: counts, and voltages of the edge sensors."""
        simulated, motors = self.simulated, self._devices.motors
        is_running = self.clock.now_s - self.bridge.restarted_s <= self._devices.timer.timeout_s
        simulated.drive(*(self._voltage(motor) if is_running else 0.0 for motor in (motors.right, motors.left)))
        simulated.command_fans(
            *(self._duty(f"pwmchip1/pwm{fan.channel}") for fan in (self._devices.fans.left, self._devices.fans.right))
        )
        readings = simulated.read(self._steps / self._devices.daq.sample_hz)
        self._steps += 1
        plant = simulated.world.plant
        speeds = self._speeds
        speeds.append(0.5 * self._radius_m * (plant.right_rad_s + plant.left_rad_s))
        # The unit's filter takes the mean of what the motors do at 1 kHz between two of its readings.
        self.bno055.ax_m_s2 = (speeds[-1] - speeds[0]) / (max(len(speeds) - 1, 1) / self._devices.daq.sample_hz)
        for _, _, wz in readings.imu:
            self.bno055.wz_rad_s = wz
        if readings.gravity is not None:
            _, gx, gy, gz = readings.gravity
            self.bno055.gravity_m_s2 = (-9.81 * gx, -9.81 * gy, -9.81 * gz)
        _, right, left = readings.counts[-1]
        return right or 0, left or 0, list(readings.edges[-1][1:])

    def _voltage(self, motor: MotorConfig) -> float:
        forward, reverse = self.bridge.levels[motor.forward_line], self.bridge.levels[motor.reverse_line]
        if forward == reverse:
            return 0.0
        volts = self._devices.motors.supply_v * self._duty(f"pwmchip{motor.chip}/pwm{motor.channel}")
        return volts if forward else -volts

    def _duty(self, channel: str) -> float:
        if not self.pwm.value(f"{channel}/enable"):
            return 0.0
        return self.pwm.value(f"{channel}/duty_cycle") / self.pwm.value(f"{channel}/period")
