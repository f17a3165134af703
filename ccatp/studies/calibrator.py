"""Calibrator: two plain asyncio processes exchange the lines of the robot link over loopback TCP and do nothing else.

    python -m ccatp.studies.calibrator [--json]

A figure of a benchmark divided by the calibrator's, taken beside it under the same load, compares machines: both
processes only read, write and wake each other, with the standard library's json.
"""

import argparse
import asyncio
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from statistics import median
from typing import Any

from ccatp.config.package import child_environment

FRAMES, ROUNDS, WARM_UP_FRAMES = 4000, 5, 200
TIMEOUT_S = 120.0
IDLE, ONE_CORE, BUSY = "idle", "all on one core", "one busy process per core"
LOADS = (IDLE, ONE_CORE, BUSY)
# A frame of a robot that drives: ten samples of wheels and edge sensors, as in the configuration that is shipped.
SENSORS: dict[str, Any] = {
    "type": "sensors", "seq": 300, "t": 3.0,
    "imu": [[3.0, 0.0005933, -0.0152406]],
    "enc": [[round(2.991 + 0.001 * k, 3), 1.0022239, 1.0999966] for k in range(10)],
    "edge": [[round(2.991 + 0.001 * k, 3), 1, 1, 1, 1] for k in range(10)],
    "gravity": [3.0, -0.2938572, 0.2872964, -0.9116517], "fans": [0.0, 0.0], "soc": 1.0,
    "cmd": {"seq": 299, "age": 0.01, "permit_age": 0.01, "held": False}, "faults": [],
}  # fmt: skip
DRIVE: dict[str, Any] = {"type": "drive", "seq": 300, "ack": 300, "wr": 1.00027359, "wl": 1.09990312}


def calibrate(frames: int = FRAMES) -> tuple[float, float]:
    """Wall time of a frame there and back, and CPU time of both processes for it, us, in the present load."""
    with _started("--robot", str(frames)) as robot, _started("--controller", _line(robot), str(frames)) as controller:
        robot_out, _ = robot.communicate(timeout=TIMEOUT_S)
        controller_out, _ = controller.communicate(timeout=TIMEOUT_S)
    (wall_us, robot_us), (_, controller_us) = json.loads(robot_out), json.loads(controller_out)
    return wall_us, robot_us + controller_us


@contextmanager
def load(name: str) -> Iterator[None]:
    """One of ``LOADS`` for the processes that are started meanwhile."""
    if not hasattr(os, "sched_setaffinity"):  # not on every system
        yield
        return
    cores = os.sched_getaffinity(0)
    if name == ONE_CORE:
        os.sched_setaffinity(0, {min(cores)})
        try:
            yield
        finally:
            os.sched_setaffinity(0, cores)
        return
    busy: list[subprocess.Popen[str]] = []
    try:
        if name == BUSY:
            for core in sorted(cores):
                busy.append(_start("--busy", str(core)))
                _line(busy[-1])
        yield
    finally:
        for process in busy:
            process.kill()
            process.communicate()


async def _drive_robot(frames: int) -> tuple[float, float]:
    """Serve one client: send a frame, await its drive."""
    done: asyncio.Future[tuple[float, float]] = asyncio.get_running_loop().create_future()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        wall_s = cpu_s = 0.0
        for seq in range(frames + WARM_UP_FRAMES):
            if seq == WARM_UP_FRAMES:
                wall_s, cpu_s = time.perf_counter(), time.process_time()
            SENSORS["seq"], SENSORS["t"] = seq, 0.01 * seq
            writer.write(json.dumps(SENSORS, separators=(",", ":")).encode() + b"\n")
            json.loads(await reader.readline())
        done.set_result((time.perf_counter() - wall_s, time.process_time() - cpu_s))
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    _print(str(server.sockets[0].getsockname()[1]))
    return await done


async def _control(port: int) -> tuple[float, float]:
    """Answer each frame by a drive, until the robot closes."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)  # asyncio sets TCP_NODELAY
    wall_s = cpu_s = 0.0
    while line := await reader.readline():
        sensors = json.loads(line)
        if sensors["seq"] == WARM_UP_FRAMES:
            wall_s, cpu_s = time.perf_counter(), time.process_time()
        DRIVE["seq"] = DRIVE["ack"] = sensors["seq"]
        writer.write(json.dumps(DRIVE, separators=(",", ":")).encode() + b"\n")
    return time.perf_counter() - wall_s, time.process_time() - cpu_s


def _be_busy(core: int) -> None:
    """Load a core as long as whoever started this lives."""
    os.sched_setaffinity(0, {core})
    parent = os.getppid()
    _print("busy")
    while os.getppid() == parent:
        for _ in range(100_000):
            pass


def _print(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "ccatp.studies.calibrator", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=child_environment(os.environ))


def _line(process: subprocess.Popen[str]) -> str:
    return "" if process.stdout is None else process.stdout.readline().strip()


@contextmanager
def _started(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    process = _start(*arguments)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def main(argv: Sequence[str] | None = None) -> int:
    """Print wall and CPU time of a frame in each load."""
    parser = argparse.ArgumentParser(prog="python -m ccatp.studies.calibrator", description="A frame of two processes.")
    parser.add_argument("--frames", type=int, default=FRAMES, help="Frames of a round.")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--json", action="store_true", help="Result as JSON.")
    for role, words in (("--robot", 1), ("--controller", 2), ("--busy", 1)):
        parser.add_argument(role, type=int, nargs=words, help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.busy is not None:
        _be_busy(*options.busy)
    elif options.robot is not None or options.controller is not None:
        frames = (options.robot or options.controller)[-1]
        times_s = asyncio.run(_control(options.controller[0]) if options.controller else _drive_robot(frames))
        _print(json.dumps([1e6 * time_s / frames for time_s in times_s]))
    else:
        _report(options.rounds, options.frames, is_json=options.json)
    return 0


def _report(rounds: int, frames: int, *, is_json: bool) -> None:
    """The loads by turns, so that a machine that slows down for a while slows all."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in LOADS}
    for _ in range(rounds):
        for name in LOADS:
            with load(name):
                found[name].append(calibrate(frames))
    rows = {name: [sorted(column) for column in zip(*times, strict=True)] for name, times in found.items()}
    if is_json:
        _print(json.dumps({name: {"us": wall_us, "cpu_us": cpu_us} for name, (wall_us, cpu_us) in rows.items()}))
        return
    for name, (wall_us, cpu_us) in rows.items():
        spread = f"{wall_us[0]:.1f} to {wall_us[-1]:.1f}"
        _print(f"{name:<28} {median(wall_us):8.1f} us a frame ({spread})   CPU {median(cpu_us):8.1f} us")


if __name__ == "__main__":
    raise SystemExit(main())
