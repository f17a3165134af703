"""What a run tells where there is no terminal."""

from pathlib import Path

import msgspec
import pytest

from ccatp.daemon.survey_runner import state_text
from ccatp.daemon.terminal import BeaconRunView, RunView
from ccatp.links.topics import MissionStatus
from ccatp.survey.state import MissionState


def test_progress_with_and_without_a_point(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = MissionStatus(seq=-1, t_s=0.0, state="driving", elapsed_s=61.0, eta_s=9.0, done=1, total=10)
    view = RunView("x", is_sim=True, run_dir=tmp_path)
    view.status(status)
    assert capsys.readouterr().err.splitlines()[-1] == "10 %: 1 of 10 points, driving, 1:01 elapsed, 0:09 to go"
    at_point = msgspec.structs.replace(status, point="1-2-3", error_mm=0.5)
    assert view.text_of(at_point) == "driving 1-2-3, 1:01 elapsed, 0:09 to go, arrival 0.50 mm"
    beacons = BeaconRunView("x", is_sim=True, run_dir=tmp_path)
    held = msgspec.structs.replace(status, cause="operator", state="held", error_mm=25.0)
    assert beacons.text_of(held) == "held (operator), 1:01 elapsed, position known to 2.5 cm"


def test_the_first_line_is_one_line_however_long(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / ("a" * 100) / "[b]"
    RunView("ccatp SIMULATION of fyst-m1", is_sim=True, run_dir=folder)
    assert capsys.readouterr().err == f"ccatp SIMULATION of fyst-m1; writing {folder}\n"


def test_a_mission_that_goes_on_says_so() -> None:
    assert state_text(MissionState.HELD, "operator") == "held: operator"
    assert state_text(MissionState.TURNING, "") == "going on: turning"
    assert state_text(MissionState.RETURNING, "fire") == "returning: fire"
    assert state_text(MissionState.HELD, "") == "held"
