"""Calibrator: two plain asyncio processes exchange the lines of the robot link over loopback TCP and do nothing else.

    python -m ccatp.studies.calibrator [--json]

The time of a benchmark divided by that of the calibrator, measured under the same load, can be compared between
machines: both processes only read, write and wake each other, with the json module of the standard library.
"""

import argparse
import asyncio
import json
import multiprocessing
import os
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from statistics import median
from typing import Any

FRAMES, ROUNDS, WARM_UP_FRAMES = 4000, 5, 200
TIMEOUT_S = 120.0
IDLE, ONE_CORE, BUSY = "idle", "all on one core", "one busy process per core"
LOADS = (IDLE, ONE_CORE, BUSY)
SPAWN = multiprocessing.get_context("spawn")  # new interpreters, without the modules of this process
# A frame of a driving robot: ten samples of wheels and edge sensors, as in the shipped configuration.
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
    """Elapsed time of a frame and its answer, and CPU time of both processes for it, us, under the present load."""
    found = SPAWN.Queue()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        robot, controller = (_exchange, (found, frames, listener)), (_exchange, (found, frames, port))
        with _started(robot, controller):
            times_s = [found.get(timeout=TIMEOUT_S) for _ in (robot, controller)]
    return 1e6 * max(wall_s for wall_s, _ in times_s) / frames, 1e6 * sum(cpu_s for _, cpu_s in times_s) / frames


@contextmanager
def load(name: str) -> Iterator[None]:
    """Apply one of ``LOADS`` to the processes that are started in this context."""
    if not hasattr(os, "sched_setaffinity"):  # not on every system
        yield
        return
    cores = os.sched_getaffinity(0)
    busy = SPAWN.Semaphore(0)
    with _started(*((_be_busy, (core, busy)) for core in sorted(cores) if name == BUSY)) as processes:
        for _ in processes:
            busy.acquire(timeout=TIMEOUT_S)
        if name == ONE_CORE:
            os.sched_setaffinity(0, {min(cores)})
        try:
            yield
        finally:
            os.sched_setaffinity(0, cores)


@contextmanager
def _started(*calls: tuple[Any, tuple[Any, ...]]) -> Iterator[list[Any]]:
    """Start a process for each call of a function; kill them at the end of the context."""
    processes = [SPAWN.Process(target=function, args=arguments, daemon=True) for function, arguments in calls]
    try:
        for process in processes:
            process.start()
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.join()


def _exchange(found: Any, frames: int, end: socket.socket | int) -> None:
    found.put(asyncio.run(_control(end) if isinstance(end, int) else _drive_robot(end, frames)))


async def _drive_robot(listener: socket.socket, frames: int) -> tuple[float, float]:
    """Serve one client: send each frame and await its drive."""
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

    await asyncio.start_server(serve, sock=listener)
    return await done


async def _control(port: int) -> tuple[float, float]:
    """Answer each frame with a drive, until the robot closes the connection."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)  # asyncio sets TCP_NODELAY
    wall_s = cpu_s = 0.0
    while line := await reader.readline():
        sensors = json.loads(line)
        if sensors["seq"] == WARM_UP_FRAMES:
            wall_s, cpu_s = time.perf_counter(), time.process_time()
        DRIVE["seq"] = DRIVE["ack"] = sensors["seq"]
        writer.write(json.dumps(DRIVE, separators=(",", ":")).encode() + b"\n")
    return time.perf_counter() - wall_s, time.process_time() - cpu_s


def _be_busy(core: int, busy: Any) -> None:
    """Load a core until the parent process ends."""
    os.sched_setaffinity(0, {core})
    parent = os.getppid()
    busy.release()
    while os.getppid() == parent:
        for _ in range(100_000):
            pass


def main(argv: Sequence[str] | None = None) -> int:
    """Print elapsed and CPU time of a frame under each load.

    The loads alternate, so a machine that slows down slows all of them.
    """
    parser = argparse.ArgumentParser(prog="python -m ccatp.studies.calibrator", description="A frame of two processes.")
    parser.add_argument("--frames", type=int, default=FRAMES, help="Frames of a round.")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--json", action="store_true", help="Result as JSON.")
    options = parser.parse_args(argv)
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in LOADS}
    for _ in range(options.rounds):
        for name in LOADS:
            with load(name):
                found[name].append(calibrate(options.frames))
    rows = {name: [sorted(column) for column in zip(*times, strict=True)] for name, times in found.items()}
    lines = [
        f"{name:<28} {median(us):8.1f} us a frame ({us[0]:.1f} to {us[-1]:.1f})   CPU {median(cpu_us):8.1f} us"
        for name, (us, cpu_us) in rows.items()
    ]
    if options.json:
        lines = [json.dumps({name: {"us": us, "cpu_us": cpu_us} for name, (us, cpu_us) in rows.items()})]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
