"""The check before a mission against the stand-ins, and beside a daemon that holds the robot."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.processes.conftest import Run


def check(*args: str) -> tuple[int, dict[str, dict[str, Any]]]:
    command = [sys.executable, "-m", "ccatp", "check", "--json", *args]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    assert "Traceback" not in done.stderr
    return done.returncode, {one["name"]: one for one in json.loads(done.stdout)["checks"]}


def test_the_stand_ins_are_ready(runtime_dir: Path, tmp_path: Path) -> None:
    status, found = check(
        "--sim", "--mirror", "fyst-m2", "--runtime-dir", str(runtime_dir), "--runs-dir", str(tmp_path)
    )
    wrong = {name for name, one in found.items() if one["outcome"] not in ("pass", "warn")}
    assert wrong <= {"frames", "robot clock"}  # of which a loaded machine is part
    assert status == (1 if wrong else 0)
    assert found["laser fix"]["outcome"] == "pass"
    assert "the slope is that of fyst-m2" in found["gravity"]["found"]


def test_a_robot_that_is_driven_is_not_disturbed(start: Callable[..., Run], runtime_dir: Path, tmp_path: Path) -> None:
    run = start("--realtime", "--panels", "1", "--mirror", "thesis-m1")
    run.until(lambda status: status["state"] == "driving")
    config = str(run.run_dir / "config.toml")
    status, found = check("--config", config, "--runtime-dir", str(runtime_dir), "--runs-dir", str(tmp_path))
    assert status == 1
    assert "role taken" in found["robot link"]["found"]
    assert "a daemon runs in" in found["runtime directory"]["found"]
    # A machine that starts a command may serve a frame late, and the daemon holds for that, but never for the check.
    at = run.ask("status")["status"]
    assert at["state"] != "held" or "late" in at["cause"], at["cause"]
    run.ask("stop")
    run.wait()
