"""Benchmarks: every case of one table against its peers by turns on one clock, missions, and the result as text."""

import gc
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.config.models import Config
from ccatp.config.package import child_environment
from ccatp.core import FloatArray
from ccatp.errors import CcatpError
from ccatp.studies.bench_cases import STEPS, Contender, races
from ccatp.studies.engine import settle
from ccatp.studies.results import markdown_table
from ccatp.studies.sil_run import rehearse

EQUAL_WITHIN = 1e-10  # every entry of mean and covariance, SI units
ROUNDS, QUICK_ROUNDS = 40, 4
MOST_DENSE_ROUNDS = 10
PANELS, QUICK_PANELS = 4, 1
TIMEOUT_S = 900.0
PACKAGES = ("ccatp", "numpy", "scipy", "filterpy", "stonesoup")
CPU_INFO = Path("/proc/cpuinfo")


class BenchError(CcatpError):
    """A benchmark that gives no figure: results differ, or a mission failed."""


def run_bench(cfg: Config, *, quick: bool, run_args: Sequence[str] = (), missions: bool = True) -> dict[str, Any]:
    """Run every benchmark, ``quick`` with a tenth of the repeats and a mission of one panel.

    ``run_args`` is what else ``ccatp run`` needs to work on the same configuration. A case holds name, us_p50, us_p99,
    peer, peer_us_p50 and ratio = ours / peer, None without a peer; and how far the results differ, or how to install
    the peer. BenchError: a peer's result differs, or a mission failed.
    """
    rounds, panels = (QUICK_ROUNDS, QUICK_PANELS) if quick else (ROUNDS, PANELS)
    # Missions first: they start in a process that has allocated little.
    last = [rehearsal_case(cfg, panels), lockstep_case(cfg, panels, run_args)] if missions else []
    return {"machine": machine(), "equal_within": EQUAL_WITHIN, "cases": [*step_cases(cfg, rounds), *last]}


def step_cases(cfg: Config, rounds: int) -> Iterator[dict[str, Any]]:
    """Every race, against each of its peers."""
    for name, ours, peers, is_dense, note in races(cfg):
        most = min(rounds, MOST_DENSE_ROUNDS) if is_dense else rounds
        for peer_name, peer in peers.items():
            try:
                yield step_case(name, ours, peer_name, peer, most)
            except ImportError:
                why = f"{peer_name} is not installed: pip install 'ccatp[peers]'"
                yield {**step_case(name, ours, "", None, rounds), "note": why}
        if not peers:
            yield {**step_case(name, ours, "", None, rounds), "note": note}


def step_case(name: str, ours: Contender, peer_name: str, peer: Contender | None, rounds: int) -> dict[str, Any]:
    """The figures of one race (raises BenchError: the results differ, so that times cannot be compared)."""
    found: dict[str, Any] = {"name": name}
    if peer is not None:
        difference = largest_difference(ours, peer)
        if not difference <= EQUAL_WITHIN:
            raise BenchError(
                f"{name}: results differ from those of {peer_name} by {difference:.2g}, more than {EQUAL_WITHIN:g}: "
                "times of different computations cannot be compared"
            )
        found["largest_difference"] = difference
    times_us = [np.percentile(taken, (50, 99)).tolist() for taken in race(ours, peer, rounds)]
    p50, p99 = times_us[0]
    found |= {"us_p50": p50, "us_p99": p99, "peer": None, "peer_us_p50": None, "peer_us_p99": None, "ratio": None}
    if peer is not None:
        peer_p50, peer_p99 = times_us[1]
        found |= {"peer": peer_name, "peer_us_p50": peer_p50, "peer_us_p99": peer_p99, "ratio": p50 / peer_p50}
    return found


def race(ours: Contender, peer: Contender | None, rounds: int, steps: int = STEPS) -> FloatArray:
    """Time every step of both, a round of steps each by turns, who begins by turns as well.

    So a machine that slows down for a while slows both, and neither runs on caches that the other one has filled. A
    round begins anew; one round before them warms up.

    The result has the wall times of single steps of ours and of the peer, if any, us, shape (1 or 2, rounds, steps).
    """
    both = [ours] if peer is None else [ours, peer]
    taken = np.zeros((len(both), rounds, steps))
    collecting = gc.isenabled()
    gc.disable()
    try:
        for turn in range(-1, rounds):
            for which in range(len(both)) if turn % 2 else reversed(range(len(both))):
                solution = both[which]()
                next(solution)
                for i in range(steps):
                    start_ns = time.perf_counter_ns()
                    next(solution)
                    spent_ns = time.perf_counter_ns() - start_ns
                    if turn >= 0:
                        taken[which, turn, i] = 1e-3 * spent_ns
            gc.collect(1)
    finally:
        if collecting:
            gc.enable()
    return taken


def largest_difference(ours: Contender, peer: Contender, steps: int = STEPS) -> float:
    """Largest difference between any entries of the results of two contenders, after any of the steps; SI units."""
    solutions = ours(), peer()
    for solution in solutions:
        next(solution)
    largest = 0.0
    for _ in range(steps):
        results = [next(solution)() for solution in solutions]
        for one, other in zip(*results, strict=True):
            found, expected = (np.asarray(result, dtype=np.float64).ravel() for result in (one, other))
            largest = max(largest, float(np.abs(found - expected).max()))
            if not np.isfinite(expected).all():
                return float("nan")
    return largest


def rehearsal_case(cfg: Config, panels: int) -> dict[str, Any]:
    """The first panels in one process, without sockets and files (raises BenchError: it was not completed)."""
    part = cfg.model_copy(update={"run": cfg.run.model_copy(update={"panels": panels})})
    settle()
    started_s = time.perf_counter()
    done = rehearse(part)
    wall_s = time.perf_counter() - started_s
    points = done.summary["points"]
    if points["measured"] != points["total"]:
        raise BenchError(f"the mission in process measured {points['measured']} of {points['total']} points")
    return _mission_case("in process", cfg, panels, done.mission_time_s, wall_s)


def lockstep_case(cfg: Config, panels: int, run_args: Sequence[str] = ()) -> dict[str, Any]:
    """The same by ``ccatp run --sim``: five processes, start and end included in the time.

    BenchError: the mission failed, or took longer than ``TIMEOUT_S``.
    """
    with tempfile.TemporaryDirectory(prefix="ccatp-bench-") as folder:
        command = [sys.executable, "-m", "ccatp", "run", "--sim", "--json", "--panels", str(panels), *run_args]
        command += ["--run-dir", f"{folder}/run", "--runtime-dir", f"{folder}/rt"]
        environment = child_environment(os.environ)
        started_s = time.perf_counter()
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, check=False, timeout=TIMEOUT_S, env=environment
            )
        except subprocess.TimeoutExpired as error:
            raise BenchError(f"the mission in lockstep was not over after {TIMEOUT_S:g} s") from error
        wall_s = time.perf_counter() - started_s
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise BenchError(f"the mission in lockstep ended with status {done.returncode}: {last}")
    summary = json.loads(done.stdout)
    found = _mission_case("in lockstep", cfg, panels, summary["mission_time_s"], wall_s)
    return found | {name: summary["wall"][name] for name in ("tick_us_p50", "tick_us_p99", "realtime_factor")}


def _mission_case(how: str, cfg: Config, panels: int, mission_time_s: float, wall_s: float) -> dict[str, Any]:
    """One mission is one sample: its mean time for a frame of simulated time, and no p99."""
    frame_us = 1e6 / cfg.sim.robot.frame_hz
    us = frame_us * wall_s / mission_time_s
    return {
        "name": f"mission {how}, {cfg.mirror.name}, {cfg.run.filter}, {panels} panel{'s' if panels > 1 else ''}",
        "us_p50": us, "us_p99": None, "peer": "the wall clock", "peer_us_p50": frame_us, "peer_us_p99": None,
        "ratio": us / frame_us, "times_real_time": mission_time_s / wall_s, "mission_time_s": mission_time_s,
        "wall_s": wall_s,
    }  # fmt: skip


def machine(cpu_info: Path = CPU_INFO) -> dict[str, object]:
    """Processor, usable cores, Python, build and versions of what takes part, threads of the linear algebra."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        cores = os.cpu_count() or 1
    return {
        "cpu": cpu_model(cpu_info),
        "cores": cores,
        "python": platform.python_version(),
        **{name: _version(name) for name in PACKAGES},
        "blas_threads": os.environ.get("OPENBLAS_NUM_THREADS"),
    }


def cpu_model(cpu_info: Path) -> str:
    """The model as the kernel names it, or what the platform knows."""
    try:
        lines = cpu_info.read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


_PAGE = """# Benchmarks

Written by

```
OPENBLAS_NUM_THREADS=1 ccatp bench --markdown
```

on a machine that does nothing else. A filter step is a prediction and an update, called from Python. Ours and the peer
take turns in rounds of fifty steps, and who begins by turns as well.
Ratio = ours / peer: below 1 ours is faster.

All compute the same: *difference* is the largest one between any entry of the two means and covariances after any of
the steps, in its own SI unit, and more than {equal_within:g} ends the run. n = 4 is the thesis's filter, its readings a
hundred times less exact than they are: as they are, forms with an inverse and (I - W H) P lose up to half their digits.
n = 19 is the full state, its models as matrices; the unscented filters evaluate the models themselves.

Machine: {machine}

"""


def markdown(result: Mapping[str, Any]) -> str:
    """The page ``docs/bench.md``."""
    steps, missions = [], []
    notes: dict[str, None] = {}
    for case in result["cases"]:
        if "times_real_time" in case:
            missions.append([case["name"], *(f"{case[key]:.1f}" for key in _MISSION_KEYS)])
        else:
            steps.append([case["name"], *(_cell(case.get(key), spec) for key, spec in _STEP_KEYS)])
        if "note" in case:
            notes[f"* {case['note']}\n"] = None
    text = _PAGE.format(equal_within=result["equal_within"], machine=machine_line(result["machine"]))
    head = ("case", "ours p50, µs", "ours p99, µs", "peer", "peer p50, µs", "ratio", "difference")
    text += markdown_table(head, steps)
    if missions:
        text += "\n" + markdown_table(("case", "times real time", "simulated, s", "wall, s"), missions)
    return text + ("\n" + "".join(notes) if notes else "")


_MISSION_KEYS = ("times_real_time", "mission_time_s", "wall_s")
_STEP_KEYS = (
    ("us_p50", ".1f"), ("us_p99", ".1f"), ("peer", ""), ("peer_us_p50", ".1f"), ("ratio", ".3f"),
    ("largest_difference", ".0e"),
)  # fmt: skip


def _cell(value: Any, spec: str) -> str:
    return "-" if value is None else format(value, spec)


def terminal_lines(result: Mapping[str, Any]) -> list[str]:
    """One line for the machine and one for each case."""
    lines = [machine_line(result["machine"])]
    for case in result["cases"]:
        if "times_real_time" in case:
            figures = f"{case['times_real_time']:8.1f} times real time"
        elif case["peer"] is None:
            figures = f"{case['us_p50']:8.1f} us   {case['note']}"
        else:
            figures = (
                f"{case['us_p50']:8.1f} us {case['peer']:>28} {case['peer_us_p50']:8.1f} us"
                f"   ratio {case['ratio']:.3f}   difference {case['largest_difference']:.0e}"
            )
        lines.append(f"{case['name']:<52} {figures}")
    return lines


def machine_line(machine: Mapping[str, Any]) -> str:
    """The machine in one line."""
    packages = [f"{name} {machine[name]}" for name in PACKAGES[1:] if machine[name]]
    return ", ".join([machine["cpu"], f"{machine['cores']} cores", f"Python {machine['python']}", *packages])
