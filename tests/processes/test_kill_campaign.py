"""Random kills over missions: nothing lost, nothing counted twice, the robot never left to itself.

``CCATP_KILLS`` says how many, ``CCATP_KILLS_SEED`` which; the figures are printed and noted.
"""

import os
import random
import signal
import time
from collections import Counter
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.faults.linking import Measured
from tests.support.runs import NO_CALIBRATION, Run

KILLS = int(os.environ.get("CCATP_KILLS", "40"))
SEED = int(os.environ.get("CCATP_KILLS_SEED", "20"))
KILLS_PER_MISSION = 15
VICTIMS = (("main",), ("danger",), ("main", "danger"), ("etalon",))
# Three of one process within a minute end a run; here they come closer.
LIMIT = ("--set", "run.restart_limit=100")


def campaign(rng: random.Random, run: Run, kills: int, figures: dict[str, Any]) -> None:
    """Kill at random instants until the mission is over or there have been enough."""
    acknowledged = 0
    for _ in range(kills):
        time.sleep(rng.uniform(0.2, 3.0))
        try:
            status = run.until(lambda status: status["seq"] >= 0, timeout_s=60.0)
        except AssertionError:
            break
        if run.process.poll() is not None or status["exit_status"] >= 0:
            break
        acknowledged = max(acknowledged, status["done"])
        names = rng.choice(VICTIMS)
        is_hung = rng.random() < 0.2 and names == ("main",)
        try:
            sent = {name: run.send(name, signal.SIGSTOP if is_hung else signal.SIGKILL) for name in names}
        except (AssertionError, psutil.Error, ProcessLookupError):
            break
        for name, (pid, at_s) in sent.items():
            run.child(name, not_pid=pid)
            figures["kills"] += 1
            if name == "main" and not is_hung:
                figures["mains"].append(at_s)
        figures["acknowledged"] = acknowledged


def note_times(run: Run, figures: dict[str, Any]) -> None:
    """From each kill of main to the robot holding its wheels, and to the successor having joined."""
    for at_s in figures.pop("mains"):
        figures["held_ms"].append(1e3 * run.first_after(at_s, "dataloop", "controller lost"))
        figures["ready_s"].append(run.first_after(at_s, "main", "joined the robot"))


@pytest.mark.slow
@pytest.mark.fault("P1", "P2", "P3", "P17", "F4")
def test_random_kills(tmp_path: Path, runtime_dir: Path, measured: Measured) -> None:
    rng = random.Random(SEED)
    figures: dict[str, Any] = {"kills": 0, "held_ms": [], "ready_s": [], "lost": 0, "twice": 0, "remeasured": 0}
    figures |= {"fan_changes": 0, "missions": 0, "falls": 0, "oldest_ack_frames": 0}
    while figures["kills"] < KILLS:
        mission = figures["missions"]
        paced = ("--realtime",) if mission % 2 else ()
        figures["mains"], figures["acknowledged"] = [], 0
        args = ("--panels", "1", "--seed", str(mission), "--world", "hard", *NO_CALIBRATION, *LIMIT, *paced)
        with Run(tmp_path / f"run{mission}", runtime_dir, *args) as run:
            campaign(rng, run, KILLS_PER_MISSION, figures)
            assert run.wait(300.0) == 0, run.stderr
        note_times(run, figures)
        points = Counter(run.fixes)
        record = run.robot_record
        figures["missions"] += 1
        figures["lost"] += max(figures["acknowledged"] - len(points), 0) + 9 - len(points)
        figures["twice"] += run.summary["points"]["measured"] - len(points)
        figures["remeasured"] += sum(points.values()) - len(points)
        figures["fan_changes"] += max(record["fan_changes"] - 1, 0)
        figures["falls"] += run.summary["danger"]["falls"]
        figures["oldest_ack_frames"] = max(figures["oldest_ack_frames"], record["oldest_ack_frames"])
        assert not [entry for entry in run.log if "never retrieved" in entry.get("text", "")]
    told = {key: (max(value) if isinstance(value, list) else value) for key, value in figures.items() if value != []}
    print(told)
    assert (figures["lost"], figures["twice"], figures["falls"], figures["fan_changes"]) == (0, 0, 0, 0), told
    assert figures["remeasured"] <= figures["kills"], told
    measured("P1", max(figures["held_ms"]))
    measured("P17", max(figures["ready_s"]))
    measured("F4", figures["fan_changes"])
