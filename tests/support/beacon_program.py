"""``python -m tests.support.beacon_program SYSTEM``: the on-board program's robot over fake devices, behind its link.

In lockstep, so that a mission takes no longer than its computations. Standard output gets the port, and at SIGTERM the
true poses of all frames as JSON.
"""

import argparse
import asyncio
import json
import signal
import socket
import sys
from typing import Any

from ccatp.dataloop import DataLoop
from tests.support.beacon_rig import BeaconRig, DrivenRobot, pioneer_config


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


def main() -> int:
    """Serve until SIGTERM."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("system")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=JSON")
    options = parser.parse_args()
    pairs = (text.partition("=") for text in options.settings)
    settings = {key.replace(".", "__"): json.loads(value) for key, _, value in pairs}
    rig = BeaconRig(pioneer_config(options.system, **settings))
    truth = asyncio.run(run_lockstep(rig, socket.create_server(("127.0.0.1", 0))))
    print(json.dumps(truth), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
