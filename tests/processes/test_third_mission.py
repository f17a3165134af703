"""A kind of mission that another package brings: installed beside this one, it is run like any other."""

import json
import os
import subprocess
import sys
from math import dist
from pathlib import Path

import pytest

from ccatp.records.recorder import iter_messages
from tests.support import square
from tests.support.square import SIDES

ROOT = Path(__file__).parents[2]
PACKAGE = "square-1.dist-info"
LONGEST = 150


def ccatp(tmp_path: Path, *args: str) -> subprocess.CompletedProcess[str]:
    """A command where the package with the third kind is installed."""
    installed = tmp_path / "site" / PACKAGE
    installed.mkdir(parents=True, exist_ok=True)
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: square\nVersion: 1\n")
    (installed / "entry_points.txt").write_text("[ccatp.missions]\nsquare = tests.support.square:SQUARE\n")
    env = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path / "site"), str(ROOT)))}
    command = [sys.executable, "-m", "ccatp", *args]
    return subprocess.run(command, capture_output=True, text=True, env=env, timeout=90.0, check=False)


def test_the_kind_is_short() -> None:
    assert len(Path(square.__file__).read_text(encoding="utf-8").splitlines()) < LONGEST


def test_a_third_kind_of_mission_runs(tmp_path: Path, runtime_dir: Path) -> None:
    config, run_dir = tmp_path / "square.toml", tmp_path / "run"
    config.write_text('system = "square"\nside_m = 0.1\n')
    checked = ccatp(tmp_path, "config", "check", str(config))
    assert (checked.returncode, checked.stdout) == (0, f"{config}: ok: system square, seed 1\n"), checked.stderr

    where = "--run-dir", str(run_dir), "--runtime-dir", str(runtime_dir)
    run = ccatp(tmp_path, "run", "--sim", "--json", "--config", str(config), "--set", "sim.robot.port=0", *where)
    assert run.returncode == 0, run.stderr
    summary = json.loads(run.stdout)
    assert (summary["system"], summary["outcome"]) == ("square", "complete")
    assert summary["goals"] == {"total": SIDES, "reached": SIDES}
    assert "its result is in summary.json" in run.stderr

    rows: dict[str, list[list[float]]] = {"truth": [], "square_track": []}
    for one in iter_messages(run_dir / "telemetry.mcap"):
        if one.topic in rows:
            rows[one.topic] += json.loads(one.payload)["rows"]
    assert rows["square_track"]  # its own topic is recorded as well
    places = [tuple(row[2:4]) for row in rows["truth"]]
    # Four sides of 0.1 m, and back to where it began; 5 mm: the wheels lag in eight changes of speed, and slip.
    assert sum(map(dist, places, places[1:])) == pytest.approx(4 * 0.1, abs=0.005)
    assert dist(places[0], places[-1]) < 0.005
    assert max(dist(places[0], place) for place in places) == pytest.approx(0.1 * 2**0.5, abs=0.005)

    report = ccatp(tmp_path, "report", str(run_dir))
    assert report.returncode == 2
    assert "a drive around a square has no report" in report.stderr


def test_an_unknown_kind_of_mission_is_one_clear_line(tmp_path: Path) -> None:
    config = tmp_path / "other.toml"
    config.write_text('# of whom?\nsystem = "sqare"\n')
    for command in (("run", "--sim", "--config"), ("config", "check")):
        refused = ccatp(tmp_path, *command, str(config))
        assert (refused.returncode, refused.stdout) == (2, "")
        (line,) = refused.stderr.splitlines()
        assert f'{config}:2: system = "sqare" is no system; did you mean square?' in line


def test_a_fault_plan_for_a_robot_that_takes_none_is_refused(tmp_path: Path) -> None:
    config, plan = tmp_path / "square.toml", tmp_path / "plan.toml"
    config.write_text('system = "square"\n')
    plan.write_text('[[fault]]\nsignal = "frames"\ntype = "drop"\nevery = 2\nat_s = 0.1\nfor_s = 0.1\n')
    for command in (("run", "--sim"), ("sim", "robot")):
        refused = ccatp(tmp_path, *command, "--config", str(config), "--faults", str(plan))
        assert (refused.returncode, refused.stdout) == (2, "")
        (line,) = refused.stderr.splitlines()
        assert "--faults: plans are for surveys" in line
