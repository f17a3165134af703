"""What a frame costs in lockstep, in each process, in one process, and in real time, beside the calibrator's."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from ccatp.config.models import Config
from ccatp.config.package import child_environment
from ccatp.daemon.supervision.supervisor import PROCESSES
from ccatp.errors import CcatpError
from ccatp.links.client import OperatorClient
from ccatp.studies.calibrator import IDLE, LOADS, calibrate, load
from ccatp.studies.engine import settle
from ccatp.studies.sil_run import rehearse

ROUNDS, PANELS = 3, 2
CALIBRATOR = "two plain asyncio processes"
SUPERVISOR = "supervisor"
TIMEOUT_S = 900.0
PERIOD_S = 0.25  # between two looks at a run
_ANSWER_S = 5.0  # on one core with others a status takes a while
_LEAST_FRAMES = 500
_PORTS = "sim.robot", "sim.etalon", "dashboard"  # others may run on this machine
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class BenchError(CcatpError):
    """A benchmark that gives no figure: results differ, or a mission failed."""


class ProcessUse(NamedTuple):
    """What a process has used since its start: user and system time, s, and how often it slept and was woken."""

    cpu_s: float
    wake_ups: int


class Moment(NamedTuple):
    """A run between two frames: robot time and wall clock, s; use of each process by its name."""

    robot_s: float
    wall_s: float
    processes: dict[str, ProcessUse]


class LockstepRun(NamedTuple):
    """A run, from its start to its end and between two moments of driving and measuring."""

    summary: dict[str, Any]
    wall_s: float
    first: Moment
    last: Moment


def frame_cases(cfg: Config, run_args: Sequence[str], *, quick: bool) -> list[dict[str, Any]]:
    """All rows; ``quick``: one round over one panel, without real time. BenchError: a mission failed."""
    rounds, panels = (1, 1) if quick else (ROUNDS, PANELS)
    calibrated: dict[str, list[tuple[float, float]]] = {name: [] for name in LOADS}
    runs: dict[str, list[LockstepRun]] = {name: [] for name in LOADS}
    rehearsals: list[tuple[float, float]] = []
    for _ in range(rounds):
        rehearsals.append(rehearsal(cfg, panels))
        for name in LOADS:
            with load(name):
                calibrated[name].append(calibrate())
                runs[name].append(lockstep_run(panels, run_args))
    what = f"{cfg.mirror.name}, {cfg.run.filter}, {panels} panel{'s' if panels > 1 else ''}"
    frame_us = 1e6 / cfg.sim.robot.frame_hz
    wall_us = {name: [us for us, _ in found] for name, found in calibrated.items()}
    cases = [
        _mission_case(f"mission in process, {what}", rehearsals, frame_us, wall_us[IDLE]),
        *(lockstep_case(f"lockstep, {what}, {name}", runs[name], frame_us, wall_us[name]) for name in LOADS),
        *process_cases(runs[IDLE], frame_us, [cpu_us for _, cpu_us in calibrated[IDLE]]),
    ]
    if quick:
        return cases
    wall = lockstep_run(1, (*run_args, "--realtime")).summary["wall"]
    case = _case("main loop in real time, computing", [wall["tick_us_p50"]], "the time between two frames", [frame_us])
    return [*cases, case | {"us_p99": wall["tick_us_p99"]}]


def rehearsal(cfg: Config, panels: int) -> tuple[float, float]:
    """Robot time and wall time, s, of a mission in one process (raises BenchError: it was not completed)."""
    part = cfg.model_copy(update={"run": cfg.run.model_copy(update={"panels": panels})})
    settle()
    started_s = time.perf_counter()
    done = rehearse(part)
    wall_s = time.perf_counter() - started_s
    points = done.summary["points"]
    if points["measured"] != points["total"]:
        raise BenchError(f"the mission in process measured {points['measured']} of {points['total']} points")
    return done.mission_time_s, wall_s


def lockstep_run(panels: int, run_args: Sequence[str] = ()) -> LockstepRun:
    """One ``ccatp run --sim``, looked at while it goes on (raises BenchError: it failed, or took too long)."""
    moments: list[Moment] = []
    with tempfile.TemporaryDirectory(prefix="ccatp-bench-") as folder:
        command = _run_command(panels, folder, run_args)
        started_s = time.perf_counter()
        with Path(folder, "out").open("w+") as out, Path(folder, "err").open("w+") as err:
            run = subprocess.Popen(command, stdout=out, stderr=err, env=child_environment(os.environ))
            try:
                daemon = OperatorClient(Path(folder) / "rt", _ANSWER_S)
                while run.poll() is None and time.perf_counter() - started_s < TIMEOUT_S:
                    time.sleep(PERIOD_S)
                    moments += look(daemon, run.pid)
                wall_s = time.perf_counter() - started_s
            finally:
                if run.poll() is None:
                    run.terminate()
                    run.wait()
            summary = _summary_of(run.returncode, out, err, wall_s)
    if len(moments) < 2:
        raise BenchError("the mission in lockstep was over before it was looked at twice")
    return LockstepRun(summary, wall_s, moments[0], moments[-1])


def look(daemon: OperatorClient, pid: int) -> list[Moment]:
    """The present moment of a run whose supervisor is ``pid``; none before its first frame and after its end."""
    try:
        status = daemon.status()
    except CcatpError:
        return []
    if status.elapsed_s <= 0.0 or status.exit_status >= 0:
        return []
    return [Moment(status.elapsed_s, time.perf_counter(), process_uses(pid))]


def process_uses(pid: int) -> dict[str, ProcessUse]:
    """Use of a supervisor and its children, by their names in the process table."""
    names = {spec.module: spec.name for spec in PROCESSES}
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    found = {SUPERVISOR: _use_of(pid)}
    for child in children:
        try:
            words = Path(f"/proc/{child}/cmdline").read_text().split("\0")
            found[next((names[word] for word in words if word in names), "others")] = _use_of(int(child))
        except OSError:  # it has ended
            continue
    return found


def _use_of(pid: int) -> ProcessUse:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    statuses = [status.read_text() for status in Path(f"/proc/{pid}/task").glob("*/status")]
    wake_ups = sum(int(text.partition("\nvoluntary_ctxt_switches:")[2].split()[0]) for text in statuses)
    return ProcessUse((int(fields[11]) + int(fields[12])) / _TICKS_PER_S, wake_ups)


def _run_command(panels: int, folder: str, run_args: Sequence[str]) -> list[str]:
    command = [sys.executable, "-m", "ccatp", "run", "--sim", "--json", "--panels", str(panels), *run_args]
    command += ["--run-dir", f"{folder}/run", "--runtime-dir", f"{folder}/rt"]
    return [*command, *(word for place in _PORTS for word in ("--set", f"{place}.port=0"))]


def _summary_of(status: int, out: Any, err: Any, wall_s: float) -> dict[str, Any]:
    if wall_s >= TIMEOUT_S:
        raise BenchError(f"the mission in lockstep was not over after {TIMEOUT_S:g} s")
    out.seek(0)
    err.seek(0)
    if status != 0:
        last = (err.read().strip().splitlines() or ["no message"])[-1]
        raise BenchError(f"the mission in lockstep ended with status {status}: {last}")
    summary: dict[str, Any] = json.loads(out.read())
    return summary


# -- the rows ---------------------------------------------------------------------------------------------------------


def _case(name: str, us: Iterable[float], peer: str, peer_us: Iterable[float]) -> dict[str, Any]:
    """Medians over the rounds and their spread; ratio = ours / peer."""
    ours, theirs = sorted(us), sorted(peer_us)
    return {
        "name": name, "us_p50": median(ours), "us_p99": None, "us_spread": [ours[0], ours[-1]],
        "peer": peer, "peer_us_p50": median(theirs), "peer_us_p99": None, "peer_us_spread": [theirs[0], theirs[-1]],
        "ratio": median(ours) / median(theirs),
    }  # fmt: skip


def _mission_case(
    name: str, missions: Sequence[tuple[float, float]], frame_us: float, peer_us: Sequence[float]
) -> dict[str, Any]:
    """Missions of a robot time and a wall time, s."""
    mission_s, wall_s = median(robot_s for robot_s, _ in missions), median(wall_s for _, wall_s in missions)
    case = _case(name, [frame_us * wall_s / robot_s for robot_s, wall_s in missions], CALIBRATOR, peer_us)
    return case | {"times_real_time": mission_s / wall_s, "mission_time_s": mission_s, "wall_s": wall_s}


def lockstep_case(name: str, runs: Sequence[LockstepRun], frame_us: float, peer_us: Sequence[float]) -> dict[str, Any]:
    """Wall time of a frame between two moments; the time with start and end is ``whole_times_real_time``."""
    parts = [(run.last.robot_s - run.first.robot_s, run.last.wall_s - run.first.wall_s) for run in runs]
    if min(robot_s for robot_s, _ in parts) * 1e6 < _LEAST_FRAMES * frame_us:
        raise BenchError(f"{name}: fewer than {_LEAST_FRAMES} frames between the first look at the run and the last")
    whole = median(run.summary["mission_time_s"] / run.wall_s for run in runs)
    ticks = {f"tick_us_{q}": median(run.summary["wall"][f"tick_us_{q}"] for run in runs) for q in ("p50", "p99")}
    return _mission_case(name, parts, frame_us, peer_us) | {"whole_times_real_time": whole} | ticks


def process_cases(runs: Sequence[LockstepRun], frame_us: float, peer_us: Sequence[float]) -> Iterable[dict[str, Any]]:
    """CPU time and wake-ups a frame of all processes together and of each."""
    used: dict[str, list[tuple[float, float]]] = {}
    for run in runs:
        frames = 1e6 * (run.last.robot_s - run.first.robot_s) / frame_us
        own = {
            name: (1e6 * (now.cpu_s - before.cpu_s) / frames, (now.wake_ups - before.wake_ups) / frames)
            for name, now in run.last.processes.items()
            if (before := run.first.processes.get(name)) is not None
        }
        total = sum(us for us, _ in own.values()), sum(wake_ups for _, wake_ups in own.values())
        for name, use in {"all processes": total, **own}.items():
            used.setdefault(name, []).append(use)
    for name, uses in used.items():
        case = _case(
            f"CPU time of a lockstep frame, {name}", [us for us, _ in uses], f"{CALIBRATOR}, CPU time", peer_us
        )
        yield case | {"wake_ups": median(wake_ups for _, wake_ups in uses)}
