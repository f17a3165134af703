"""``python -m tests.support.beacon_program SYSTEM``: the on-board program's robot over fake devices, behind its link.

In lockstep, so that a mission takes no longer than its computations. Standard output gets the port, and at SIGTERM the
true poses of all frames as JSON. With ``--realtime`` the fakes and the program run on the wall clock; SIGUSR1 pulls
the cable of the base, and plugs it in again.
"""

import argparse
import asyncio
import json
import signal
import socket
import sys
import time
from typing import Any

import structlog

from ccatp.beacons.onboard.robot import BeaconOnboardRobot
from ccatp.dataloop import DataLoop
from ccatp.onboard.program import serve
from tests.support.beacon_rig import BeaconRig, DrivenRobot, onboard_config, pioneer_config
from tests.support.onboard_fakes import FakeTime

# Real encoders have no noise of their own; the base is faster than its mission lets it be.
EXACT = {
    "sim__vehicle__speed_sigma_m_s": 0.0,
    "sim__vehicle__turn_rate_sigma_rad_s": 0.0,
    "vehicle__turn_rate_max_rad_s": 5.0,
    "vehicle__speed_max_m_s": 0.5,
}


class WallTime(FakeTime):
    """The robot's clock on the wall clock."""

    def __init__(self, start_s: float) -> None:
        self._start_s = start_s

    @property
    def now_s(self) -> float:  # type: ignore[override]
        return time.monotonic() - self._start_s

    def sleep(self, wait_s: float) -> None:
        time.sleep(wait_s)


async def run_lockstep(rig: BeaconRig, listener: socket.socket) -> list[Any]:
    """Until SIGTERM; the true poses."""
    robot, stop = DrivenRobot(rig), asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    server = DataLoop(robot, lockstep=True)
    truth = [robot.truth_row()]
    server.each_frame.append(lambda: truth.append(robot.truth_row()))
    await server.start(listener)
    print(listener.getsockname()[1], flush=True)
    await server.run(stop)
    return truth


async def run_realtime(rig: BeaconRig, listener: socket.socket, boot_s: float) -> None:
    """Until SIGTERM."""
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGTERM, stop.set)
    base = rig.base
    loop.add_signal_handler(signal.SIGUSR1, lambda: base.plug() if base.is_unplugged else base.unplug())
    rig.hardware.start()
    robot = BeaconOnboardRobot(rig.onboard, rig.hardware)
    print(listener.getsockname()[1], flush=True)
    log = structlog.wrap_logger(structlog.PrintLogger(sys.stderr))
    await serve(robot, rig.onboard.robot.loop_hz, listener, stop, None, log, boot_s)
    rig.hardware.close()


def main() -> int:
    """Serve until SIGTERM."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("system")
    parser.add_argument("--realtime", action="store_true")
    parser.add_argument("--frame-hz", type=float, default=10.0)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=JSON")
    options = parser.parse_args()
    pairs = (text.partition("=") for text in options.settings)
    settings = {key.replace(".", "__"): json.loads(value) for key, _, value in pairs}
    cfg = pioneer_config(options.system, **((EXACT if options.realtime else {}) | settings))
    listener = socket.create_server(("127.0.0.1", 0))
    if options.realtime:
        only_base = {"devices__radio__is_used": False, "devices__dish__is_used": False}
        onboard = onboard_config(cfg, link__frame_hz=options.frame_hz, **only_base)
        boot_s = time.monotonic()
        rig = BeaconRig(cfg, onboard, WallTime(boot_s))
        asyncio.run(run_realtime(rig, listener, boot_s))
        return 0
    truth = asyncio.run(run_lockstep(BeaconRig(cfg), listener))
    print(json.dumps(truth), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
