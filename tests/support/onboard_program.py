"""``python -m tests.support.onboard_program``: the on-board program on the wall clock, over simulated hardware.

Standard output gets the port, and a line each time that the wheels are held or let go: the word and the time of
``monotonic``. With ``--fakes`` SIGUSR1 makes the bus of the inertial unit hang, and work again, SIGUSR2 unplugs the
data acquisition device, and plugs it in again.

The program's drivers write files of a PWM tree and lines of GPIO chips, read an inertial unit by its registers and a
data acquisition device by its bytes. Each sample of the device moves the simulated robot on, with the voltages that the
files and lines mean then, or braked where the external timer has run out.
"""

import argparse
import asyncio
import atexit
import os
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
import structlog

from ccatp.config.load import load_config, load_onboard_config
from ccatp.config.onboard_models import DevicesConfig
from ccatp.links import realtime
from ccatp.mirror.mirror import build_mirror
from ccatp.onboard.controlled import ControlledRobot
from ccatp.onboard.devices.daq import SAMPLE, SAMPLES
from ccatp.onboard.devices.linux import DeviceAccess, LinuxHardware
from ccatp.onboard.hardware import Hardware
from ccatp.onboard.program import serve
from ccatp.onboard.robot import OnboardRobot
from ccatp.sim.ground_truth import GroundTruthPublisher, SurveyTruth
from ccatp.sim.hardware import DriveTrain, SimulatedHardware
from ccatp.sim.world import World
from tests.support.onboard_fakes import FakeBno055, FakeBridge, FakeDaq, FakePwm, FakeTime, voltage_of


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
        access = DeviceAccess(lambda _: self.bno055.open(), self.daq.open, self.bridge.open, folder)
        self.hardware = LinuxHardware(devices, self.clock, access)

    def step(self) -> tuple[int, int, list[float]]:
        """Move the robot on by one sample: counts, and voltages of the edge sensors."""
        simulated, motors, fans, pwm = self.simulated, self._devices.motors, self._devices.fans, self.pwm
        is_running = self.clock.now_s - self.bridge.restarted_s <= self._devices.timer.timeout_s
        right_v, left_v = (voltage_of(m, motors.supply_v, self.bridge, pwm) for m in (motors.right, motors.left))
        simulated.drive(*((right_v, left_v) if is_running else (0.0, 0.0)))
        simulated.command_fans(*(pwm.duty(fan.chip, fan.channel) for fan in (fans.left, fans.right)))
        readings = simulated.read(self._steps / self._devices.daq.sample_hz)
        self._steps += 1
        plant = simulated.world.plant
        speeds = self._speeds
        speeds.append(0.5 * self._radius_m * (plant.right_rad_s + plant.left_rad_s))
        # The unit's filter takes the mean of what the motors do at 1 kHz between two of its readings.
        self.bno055.ax_m_s2 = (speeds[-1] - speeds[0]) / (max(len(speeds) - 1, 1) / self._devices.daq.sample_hz)
        for _, _, wz, ay in readings.imu:
            self.bno055.wz_rad_s, self.bno055.ay_m_s2 = wz, ay
        if readings.gravity is not None:
            _, gx, gy, gz = readings.gravity
            self.bno055.gravity_m_s2 = (-9.81 * gx, -9.81 * gy, -9.81 * gz)
        _, right, left = readings.counts[-1]
        return right or 0, left or 0, list(readings.edges[-1][1:])


class Truth(SurveyTruth):
    """What the laser asks for."""

    seq = 0

    def __init__(self, world: World, start_s: float) -> None:
        self.world, self._start_s = world, start_s

    @property
    def t_s(self) -> float:  # type: ignore[override]
        return time.monotonic() - self._start_s


def tell_held() -> Callable[[ControlledRobot, float], None]:
    """Writes when the wheels are held, and when not."""
    was_held: list[bool] = []

    def tell(robot: ControlledRobot, now_s: float) -> None:
        is_held = robot.rules.is_held
        if was_held != [is_held]:
            was_held[:] = [is_held]
            print("held" if is_held else "free", f"{now_s:.6f}", flush=True)

    return tell


def main() -> int:
    """Serve until SIGTERM; the port is the first line of standard output."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--mirror", default="fyst-m1")
    parser.add_argument("--world", default="thesis")
    parser.add_argument("--truth", help="endpoint of the true puck, for ccatp sim etalon --truth")
    parser.add_argument("--fakes", action="store_true", help="devices at register and byte level in between")
    parser.add_argument("--timer-fd", type=int, help="where the line of the external timer goes")
    options = parser.parse_args()
    cfg = load_config(overrides={"run.mirror": options.mirror, "run.world": options.world})
    mirror = build_mirror(cfg.mirror)
    robot = {
        "robot.wheel_radius_m": cfg.robot.wheel_radius_m,
        "robot.wheel_base_m": cfg.robot.wheel_base_m,
        "robot.edge_sensors_m": cfg.robot.edge_sensors_m,
        "robot.puck_m": (0.0, 0.0, cfg.robot.puck_height_m),
        "robot.fan_floor": cfg.sim.robot.fan_floor if mirror.overhang else 0.0,
    }
    onboard = load_onboard_config(overrides=robot)
    boot_s = time.monotonic()
    loop_hz = onboard.devices.daq.sample_hz if options.fakes else onboard.servo.loop_hz
    train = DriveTrain(loop_hz, onboard.servo.counts_per_rev)
    simulated = SimulatedHardware(cfg, mirror, np.random.default_rng(cfg.run.seed), train)
    hardware: Hardware = simulated
    if options.fakes:
        folder = Path(tempfile.mkdtemp(prefix="ccatp-pwm-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        bench = RobotBench(onboard.devices, simulated, folder, boot_s, pytest.MonkeyPatch(), options.timer_fd)
        hardware = bench.hardware
        signal.signal(signal.SIGUSR1, lambda *_: setattr(bench.bno055, "hang_s", 1.0 - bench.bno055.hang_s))
        signal.signal(signal.SIGUSR2, lambda *_: setattr(bench.daq, "is_unplugged", not bench.daq.is_unplugged))
    log = structlog.wrap_logger(structlog.PrintLogger(sys.stderr))
    listener = socket.create_server(("127.0.0.1", options.port))

    async def run() -> None:
        stop = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        truth = GroundTruthPublisher(Truth(simulated.world, boot_s), options.truth)
        answering = asyncio.create_task(truth.serve())
        await serve(OnboardRobot(onboard, hardware), listener, stop, None, log, boot_s, tell_held())
        answering.cancel()
        truth.close()
        if simulated.world.is_fallen:
            print("fell", file=sys.stderr)

    print(listener.getsockname()[1], flush=True)
    realtime.enter(40, log)
    hardware.start()
    asyncio.run(run())
    return 0


if __name__ == "__main__":
    sys.exit(main())
