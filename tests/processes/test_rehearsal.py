"""A rehearsal goes through the states of a lockstep run with the same configuration and seed."""

import json
from collections.abc import Callable

import numpy as np

from ccatp.config.loader import load_config
from ccatp.recorder import iter_messages
from ccatp.studies.rehearsal import rehearse
from tests.processes.conftest import Run


def test_a_rehearsal_is_the_run_without_the_sockets(start: Callable[..., Run]) -> None:
    run = start("--panels", "1", "--mirror", "thesis-m1", "--filter", "ekf", "--world", "hard", "--seed", "3")
    assert run.wait() == 0, run.stderr
    rehearsal = rehearse(load_config(run.run_dir / "config.toml"), with_track=True)

    # Every frame's true place, to the last bit: a difference anywhere upstream moves the robot sooner or later.
    messages = iter_messages(run.run_dir / "telemetry.mcap")
    batches = [json.loads(message.payload)["rows"] for message in messages if message.topic == "truth"]
    driven = np.array([row[1:5] for rows in batches for row in rows])
    assert rehearsal.track is not None
    rehearsed = rehearsal.track[:, :4]
    differs = np.flatnonzero((driven[: len(rehearsed)] != rehearsed).any(axis=1))
    assert differs.size == 0, f"first in frame {differs[0]}: {driven[differs[0]]} is not {rehearsed[differs[0]]}"

    summary = {key: value for key, value in json.loads(json.dumps(rehearsal.summary)).items() if key != "wall"}
    assert summary == {key: value for key, value in run.summary.items() if key != "wall"}
