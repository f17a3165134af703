"""The on-board program in a process of its own, and a robot and a laser system that share no code with us."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support import foreign_robot
from tests.support.runs import NO_REPORT
from tools.onboard_reactions import TRIALS, Program, driving, measure


@pytest.mark.parametrize(
    "names", [[*TRIALS][::2], pytest.param([*TRIALS], marks=pytest.mark.slow)], ids=["some", "all"]
)
def test_whatever_must_stop_the_wheels_does(names: list[str]) -> None:
    # How fast it is depends on the load of the machine: the page of the program has the figures of an idle one.
    assert [*measure(names, 1)] == names


def test_the_line_of_the_external_timer_stands_still_once_the_program_is_stopped() -> None:
    program = Program()
    try:
        with driving(program):
            program.process.send_signal(signal.SIGSTOP)
            program.stopped()
            before_s = program.changed_s
            assert not program.changes_within(0.3)
            assert program.changed_s == before_s
            program.process.send_signal(signal.SIGCONT)
            assert program.changes_within(5.0)
    finally:
        program.close()
    assert program.process.returncode == 0


# -- a robot from the interface contracts alone ------------------------------------------------------------------------

OTHER_CLOCK = "--clock-error 0.005 --clock-wander 0.003 --age-s 0.03 --age-jitter-s 0.01"
RESTARTS = "--restart-at-s 40"
SLOW_SENSORS = "--lockstep --encoder-hz 250 --edge-hz 500 --lose-samples 0.01"
CONFIG = """
robot = {{ port = {robot}, wheel_radius_m = 0.0305, wheel_base_m = 0.147 }}
etalon.port = {laser}
dashboard.enabled = false
"""


def survey_of(options: str, tmp_path: Path, runtime_dir: Path) -> tuple[subprocess.CompletedProcess[str], Any]:
    """The run of a panel with a foreign robot, and what the robot reports at its end."""
    command = [sys.executable, foreign_robot.__file__, "--port", "0", "--laser-port", "0", *options.split()]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as robot:
        try:
            assert robot.stdout is not None
            config = tmp_path / "foreign.toml"
            config.write_text(CONFIG.format(**json.loads(robot.stdout.readline())))
            survey = [sys.executable, "-m", "ccatp", "run", "--config", str(config), "--panels", "1", "--json"]
            survey += ["--run-dir", str(tmp_path / "run"), "--runtime-dir", str(runtime_dir)]
            env = os.environ | NO_REPORT
            run = subprocess.run(survey, env=env, capture_output=True, text=True, timeout=600.0, check=False)
        finally:
            robot.terminate()
        return run, json.loads(robot.stdout.read())


def test_another_robot_in_the_middle_of_a_mission_ends_it_with_status_4(tmp_path: Path, runtime_dir: Path) -> None:
    run, truth = survey_of("--restart-at-s 6 --other-base-m 0.3", tmp_path, runtime_dir)
    assert truth["counts"]["restarts"] == 1
    assert run.returncode == 4, run.stderr
    assert "in the middle of the mission: robot: the configuration is not of this robot: wheel_base_m" in run.stderr
    assert (tmp_path / "run" / "summary.json").exists()


@pytest.mark.slow
@pytest.mark.fault("L15")
@pytest.mark.parametrize("options", [OTHER_CLOCK, SLOW_SENSORS, RESTARTS], ids=["real time", "lockstep", "restart"])
def test_a_panel_of_a_foreign_robot_is_surveyed(tmp_path: Path, runtime_dir: Path, options: str) -> None:
    run, truth = survey_of(options, tmp_path, runtime_dir)
    assert run.returncode == 0, run.stderr
    assert run.stderr.count("the robot restarted: relocalizing before it moves") == truth["counts"]["restarts"]
    assert truth["counts"]["restarts"] == ("restart" in options)
    summary = json.loads(run.stdout)
    assert (summary["reference"], summary["points"]["measured"]) == ("laser", 9)
    assert (truth["points"], truth["falls"], truth["outside_s"], truth["measured_moving"]) == (9, 0, 0.0, 0), truth
    assert truth["best_max_mm"] < 10.0  # a point counts within 1 cm
