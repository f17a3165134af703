"""Two missions of the kill campaign: nothing lost, nothing counted twice, the robot never left to itself."""

from pathlib import Path

import pytest

from tests.faults.linking import Measured
from tests.processes.kill_campaign import run_mission


@pytest.mark.slow
@pytest.mark.fault("P1", "P2", "P3", "P17", "F4")
@pytest.mark.parametrize("number", [1, 5])  # in lockstep and on the wall clock
def test_random_kills(tmp_path: Path, measured: Measured, number: int) -> None:
    row = run_mission(1, tmp_path, number)
    assert row["problems"] == [], row
    measured("P1", max(row["held_ms"], default=0.0))
    measured("P17", max(row["ready_s"], default=0.0))
    measured("F4", row["fan_changes"])
