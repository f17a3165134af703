"""Missions against the wall clock: in one process, and the daemon's processes in lockstep over their sockets."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Any

from ccatp.config.models import Config
from ccatp.config.package import child_environment
from ccatp.errors import CcatpError
from ccatp.studies.engine import settle
from ccatp.studies.sil_run import rehearse

PEER = "the wall clock"  # one frame takes it the frame's period
TIMEOUT_S = 900.0


class BenchError(CcatpError):
    """A benchmark that gives no figure: results differ, or a mission failed."""


def rehearsal_case(cfg: Config, panels: int) -> dict[str, Any]:
    """The first ``panels`` panels in one process, without sockets and files.

    Raises:
        BenchError: the mission was not completed.
    """
    part = cfg.model_copy(update={"run": cfg.run.model_copy(update={"panels": panels})})
    settle()
    started_s = time.perf_counter()
    done = rehearse(part)
    wall_s = time.perf_counter() - started_s
    points = done.summary["points"]
    if points["measured"] != points["total"]:
        raise BenchError(f"the mission in process measured {points['measured']} of {points['total']} points")
    return _case(f"mission in process, {_what(cfg, panels)}", cfg, done.mission_time_s, wall_s)


def lockstep_case(cfg: Config, panels: int, run_args: Sequence[str] = ()) -> dict[str, Any]:
    """The same by ``ccatp run --sim``: five processes, start and end included in the time.

    Raises:
        BenchError: the mission failed, or took longer than ``TIMEOUT_S``.
    """
    with tempfile.TemporaryDirectory(prefix="ccatp-bench-") as folder:
        command = [sys.executable, "-m", "ccatp", "run", "--sim", "--json", "--panels", str(panels), *run_args]
        command += ["--run-dir", f"{folder}/run", "--runtime-dir", f"{folder}/rt"]
        started_s = time.perf_counter()
        try:
            done = subprocess.run(
                command,
                capture_output=True,
                text=True,
                check=False,
                timeout=TIMEOUT_S,
                env=child_environment(os.environ),
            )
        except subprocess.TimeoutExpired as error:
            raise BenchError(f"the mission in lockstep was not over after {TIMEOUT_S:g} s") from error
        wall_s = time.perf_counter() - started_s
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["nothing said"])[-1]
        raise BenchError(f"the mission in lockstep ended with status {done.returncode}: {last}")
    summary = json.loads(done.stdout)
    found = _case(f"mission in lockstep, {_what(cfg, panels)}", cfg, summary["mission_time_s"], wall_s)
    ticks = {name: summary["wall"][name] for name in ("tick_us_p50", "tick_us_p99", "realtime_factor")}
    return {**found, **ticks}


def _what(cfg: Config, panels: int) -> str:
    return f"{cfg.mirror.name}, {cfg.run.filter}, {panels} panel{'s' if panels > 1 else ''}"


def _case(name: str, cfg: Config, mission_time_s: float, wall_s: float) -> dict[str, Any]:
    """One mission is one sample: its mean time for a frame of simulated time, and no p99."""
    frame_us = 1e6 / cfg.sim.robot.frame_hz
    us = frame_us * wall_s / mission_time_s
    return {
        "name": name,
        "us_p50": us,
        "us_p99": None,
        "peer": PEER,
        "peer_us_p50": frame_us,
        "peer_us_p99": None,
        "ratio": us / frame_us,
        "times_real_time": mission_time_s / wall_s,
        "mission_time_s": mission_time_s,
        "wall_s": wall_s,
    }
