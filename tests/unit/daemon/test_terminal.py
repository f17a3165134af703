"""Progress on the terminal, its rate limit, and the report at the end of a run."""

import json
from pathlib import Path

import msgspec
import pytest

from ccatp.config.load import load_radio_config
from ccatp.daemon.process import open_log
from ccatp.daemon.survey_runner import state_text
from ccatp.daemon.terminal import BeaconRunView, RunView, survey_title, write_run_report
from ccatp.errors import ExitStatus
from ccatp.links.liveness import RateLimitedLog, kind_of
from ccatp.links.topics import MissionStatus
from ccatp.survey.state import MissionState
from tests.unit.aligning.conftest import load
from tests.unit.reporting.beacon_recorded import record_beacons
from tests.unit.run_folder import make_run


def test_progress_with_and_without_a_point(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = MissionStatus(seq=-1, t_s=0.0, state="driving", elapsed_s=61.0, eta_s=9.0, done=1, total=10)
    view = RunView("x", is_sim=True, run_dir=tmp_path)
    view.status(status)
    assert capsys.readouterr().err.splitlines()[-1] == "10 %: 1 of 10 points, driving, 1:01 elapsed, 0:09 to go"
    at_point = msgspec.structs.replace(status, point="1-2-3", error_mm=0.5)
    assert view.text_of(at_point) == "driving 1-2-3, 1:01 elapsed, 0:09 to go, arrival 0.50 mm"
    beacons = BeaconRunView(load_radio_config(None), is_sim=True, run_dir=tmp_path)
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


CFG, M1 = load("fyst-m1")


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    return make_run(tmp_path / "run", CFG, [], [], {})


def test_a_run_gets_its_report(run_dir: Path) -> None:
    log = open_log(run_dir / "log.jsonl", "supervisor")
    assert write_run_report(run_dir, ExitStatus.HELD, log) == str(run_dir / "report.html")
    assert (run_dir / "report.html").read_text().startswith("<!DOCTYPE html>")


def test_an_interrupted_run_does_not_wait_for_one(run_dir: Path) -> None:
    log = open_log(run_dir / "log.jsonl", "supervisor")
    assert write_run_report(run_dir, ExitStatus.INTERRUPTED, log) == f"none; make it with: ccatp report {run_dir}"
    assert not (run_dir / "report.html").exists()


def test_a_mission_among_beacons_gets_one(tmp_path: Path) -> None:
    run_dir = record_beacons(tmp_path / "beacons")
    log = open_log(run_dir / "log.jsonl", "supervisor")
    assert write_run_report(run_dir, ExitStatus.COMPLETE, log) == str(run_dir / "report.html")
    assert "Waypoints among ZigBee beacons" in (run_dir / "report.html").read_text()


def test_whatever_goes_wrong_is_logged_and_no_more(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(run_dir: Path) -> None:
        raise ZeroDivisionError("of nothing")

    monkeypatch.setattr("ccatp.report.run_page.report_run", fail)
    log = open_log(run_dir / "log.jsonl", "supervisor")
    assert write_run_report(run_dir, ExitStatus.COMPLETE, log) == f"none; make it with: ccatp report {run_dir}"
    (line,) = (json.loads(text) for text in (run_dir / "log.jsonl").read_text().splitlines())
    assert (line["event"], line["level"], line["error"]) == ("report_failed", "error", "ZeroDivisionError: of nothing")


def test_the_run_ends_by_naming_it_on_standard_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    view = RunView(survey_title(CFG, is_sim=True), is_sim=True, run_dir=tmp_path)
    view.show_summary({"mirror": "fyst-m1"}, as_json=True)
    view.show_report(str(tmp_path / "report.html"))
    told = capsys.readouterr()
    assert json.loads(told.out) == {"mirror": "fyst-m1"}
    assert told.err.splitlines()[-1] == f"report  {tmp_path / 'report.html'}"


@pytest.mark.parametrize(
    ("one", "other", "is_same"),
    [
        ("a frame was served 145 ms late", "a frame was served 59 ms late", True),
        ("at 1.25 s", "at 300 s", True),
        ("late by 12.5.", "late by 3.", True),
        ("measurement of 1-2-7 failed", "measurement of 1-2-8 failed", False),
        ("panel 1/2", "panel 1/3", False),
        ("robot at 127.0.0.1:7010", "robot at 127.0.0.2:7010", False),
        ("held", "going on", False),
    ],
)
def test_kinds(one: str, other: str, is_same: bool) -> None:
    assert (kind_of(one) == kind_of(other)) is is_same


def test_a_few_of_each_kind_are_told_and_errors_all() -> None:
    sparing = RateLimitedLog(2, 10.0)
    told = [sparing.take("warning", f"held: {k} ms late", 0.1 * k) for k in range(50)]
    assert told == ["held: 0 ms late", "held: 1 ms late", *[None] * 48]
    assert sparing.take("warning", "going on: turning", 5.0) == "going on: turning"
    assert sparing.take("info", "held: 9 ms late", 5.0) == "held: 9 ms late"
    assert sparing.take("warning", "held: 7 ms late", 10.5) == "held: 7 ms late (48 more times)"
    assert [sparing.take("error", "broken", 0.0) for _ in range(9)] == ["broken"] * 9
