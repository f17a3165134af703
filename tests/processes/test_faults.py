"""``ccatp run --sim --faults``: what goes wrong really does, the log names it, the run ends as defined."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.processes.conftest import NO_CALIBRATION, Run

Start = Callable[..., Run]

STUCK_GYROSCOPE = """
[[fault]]
signal = "imu_wz"
type = "stuck"
at_s = 6.0
for_s = 0.5
"""


def log_of(run: Run) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run.run_dir / "log.jsonl").read_text().splitlines()]


def test_a_stuck_gyroscope_is_in_the_log_and_the_run_ends_as_defined(start: Start, tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(STUCK_GYROSCOPE)
    run = start("--panels", "1", *NO_CALIBRATION, "--faults", str(plan))
    assert run.wait() == 0, run.stderr
    assert "Traceback" not in run.stderr
    told = [entry for entry in log_of(run) if entry["event"].startswith("fault_")]
    assert [entry["event"] for entry in told] == ["fault_begins", "fault_ended", "fault_injected"]
    assert {(entry["signal"], entry["type"]) for entry in told} == {("imu_wz", "stuck")}
    assert {entry["logger"] for entry in told} == {"dataloop"}
    last = told[-1]
    assert (last["at_s"], last["from_s"], last["until_s"], last["samples"]) == (6.0, 6.0, 6.49, 50)
    assert last["changed"] > 0
    assert (run.run_dir / "faults.toml").read_text() == STUCK_GYROSCOPE
    assert run.summary["danger"]["falls"] == 0


@pytest.mark.fault("L1", "L11", "F7")
def test_a_survey_goes_on_through_resets_of_the_link_and_a_reboot_of_the_robot(start: Start, tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text('[[link]]\ntype = "fragment"\ndirection = "both"\nat_s = 0.5\nfor_s = 0.2\nwrite_bytes = 50\n'
                    '[[link]]\ntype = "reset"\nat_s = 3.0\n[[link]]\ntype = "close"\nat_s = 9.0\n'
                    '[[fault]]\nsignal = "robot"\ntype = "reboot"\nat_s = 14.0\n')  # fmt: skip
    run = start("--panels", "1", *NO_CALIBRATION, "--faults", str(plan))
    assert run.wait() == 0, run.stderr
    assert run.stderr.count("robot link lost") >= 3
    assert "the robot restarted: relocalizing before it moves" in run.stderr
    assert "Traceback" not in run.stderr
    points = {"total": 9, "measured": 9, "first_arrival_within_10mm": 9, "skipped": 0}
    assert run.summary["points"] == points
    assert run.summary["danger"]["falls"] == 0
    injected = [entry for entry in log_of(run) if entry["event"] == "fault_injected" and entry["signal"] == "link"]
    assert [(entry["signal"], entry["type"], entry["from_s"]) for entry in injected] == [
        ("link", "fragment", 0.5),
        ("link", "reset", 3.0),
        ("link", "close", 9.0),
    ]
    assert injected[0]["samples"] > 20
    assert injected[1]["samples"] == 2  # the controller's connection and the monitor's
