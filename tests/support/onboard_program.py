"""``python -m tests.support.onboard_program``: the on-board program on the wall clock, over simulated hardware.

Standard output gets the port, and a line each time that the wheels are held or let go: the word and the time of
``monotonic``. With ``--fakes`` SIGUSR1 makes the bus of the inertial unit hang, and work again, SIGUSR2 unplugs the
data acquisition device, and plugs it in again.
"""

import argparse
import asyncio
import atexit
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import structlog

from ccatp.config.load import load_config, load_onboard_config
from ccatp.links import realtime
from ccatp.mirror.mirror import build_mirror
from ccatp.onboard.hardware import Hardware
from ccatp.onboard.program import serve
from ccatp.onboard.robot import OnboardRobot
from ccatp.sim.ground_truth import GroundTruthPublisher, SurveyTruth
from ccatp.sim.hardware import SimulatedHardware
from ccatp.sim.world import World
from tests.support.onboard_bench import RobotBench


class Truth(SurveyTruth):
    """What the laser asks for."""

    seq = 0

    def __init__(self, world: World, start_s: float) -> None:
        self.world, self._start_s = world, start_s

    @property
    def t_s(self) -> float:  # type: ignore[override]
        return time.monotonic() - self._start_s


def tell_held() -> Callable[[OnboardRobot, float], None]:
    """Writes when the wheels are held, and when not."""
    was_held: list[bool] = []

    def tell(robot: OnboardRobot, now_s: float) -> None:
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
    simulated = SimulatedHardware(
        cfg, mirror, np.random.default_rng(cfg.run.seed), counts_per_rev=onboard.servo.counts_per_rev,
        loop_hz=onboard.devices.daq.sample_hz if options.fakes else onboard.servo.loop_hz,
    )  # fmt: skip
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
        await serve(onboard, hardware, listener, stop, None, log, boot_s, tell_held())
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
