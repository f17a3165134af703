"""``ccatp run --sim --faults``: what goes wrong really does, the log names it, the run ends as defined."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.processes.conftest import Run

Start = Callable[..., Run]

STUCK_GYROSCOPE = """
[[fault]]
signal = "imu_wz"
type = "stuck"
at_s = 20.0
for_s = 0.5
"""


def log_of(run: Run) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run.run_dir / "log.jsonl").read_text().splitlines()]


def test_a_stuck_gyroscope_is_in_the_log_and_the_run_ends_as_defined(start: Start, tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(STUCK_GYROSCOPE)
    run = start("--panels", "1", "--faults", str(plan))
    assert run.wait() in {0, 4}, run.stderr
    assert "Traceback" not in run.stderr
    told = [entry for entry in log_of(run) if entry["event"].startswith("fault ")]
    events = [f"fault {what}: imu_wz stuck" for what in ("begins", "ended", "injected")]
    assert [entry["event"] for entry in told] == events
    assert {entry["process"] for entry in told} == {"dataloop"}
    last = told[-1]
    assert (last["at_s"], last["from_s"], last["until_s"], last["samples"]) == (20.0, 20.0, 20.49, 50)
    assert last["changed"] > 0
    assert (run.run_dir / "faults.toml").read_text() == STUCK_GYROSCOPE
    assert run.summary["danger"]["falls"] == 0
