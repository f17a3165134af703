"""A rehearsal goes through the states of a lockstep run with the same configuration and seed."""

import json
import os
import sys
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.records.recorder import iter_messages
from ccatp.studies.sil_run import rehearse
from tests.faults.linking import Measured
from tests.processes.conftest import Start

# Read by every process of the run at its start: the wall clock is an hour early or an hour late, anew at each look.
RESTLESS_CLOCK = """
import datetime, itertools, time

step = itertools.cycle((3600, -3600)).__next__
time_s, time_ns = time.time, time.time_ns
time.time = lambda: time_s() + step()
time.time_ns = lambda: time_ns() + step() * 10**9


class Restless(datetime.datetime):
    @classmethod
    def now(cls, tz=None):
        return super().now(tz) + datetime.timedelta(seconds=step())


datetime.datetime = Restless
"""


@pytest.mark.fault("S13")
@pytest.mark.parametrize("calibrates", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_rehearsal_is_the_run_without_the_sockets(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, measured: Measured, calibrates: bool
) -> None:
    (tmp_path / "clock").mkdir()
    (tmp_path / "clock" / "sitecustomize.py").write_text(RESTLESS_CLOCK)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "clock"), *sys.path]))
    args = "--panels 1 --mirror thesis-m1 --filter ekf --world hard --seed 3"
    run = start(*args.split(), calibrates=calibrates)
    assert run.wait() == 0, run.stderr
    labels = [json.loads(line)["timestamp"] for line in (run.run_dir / "log.jsonl").read_text().splitlines()]
    instants = [datetime.fromisoformat(label) for label in labels]
    assert max(abs(b - a) for a, b in pairwise(instants)) > timedelta(minutes=50)  # the clock did step
    rehearsal = rehearse(load_config(run.run_dir / "config.toml"))

    # Every frame's true place, to the last bit: a difference anywhere upstream moves the robot sooner or later.
    messages = iter_messages(run.run_dir / "telemetry.mcap")
    batches = [json.loads(message.payload)["rows"] for message in messages if message.topic == "truth"]
    driven = np.array([row[1:5] for rows in batches for row in rows])
    rehearsed = rehearsal.track[:, :4]
    differs = np.flatnonzero((driven[: len(rehearsed)] != rehearsed).any(axis=1))
    measured("S13", differs.size)
    assert differs.size == 0, f"first in frame {differs[0]}: {driven[differs[0]]} is not {rehearsed[differs[0]]}"

    summary = {key: value for key, value in json.loads(json.dumps(rehearsal.summary)).items() if key != "wall"}
    assert summary == {key: value for key, value in run.summary.items() if key != "wall"}
