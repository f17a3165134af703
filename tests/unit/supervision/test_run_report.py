"""The report at the end of a run: written, named, and never in the way."""

import json
from pathlib import Path

import pytest

from ccatp.daemon.process import open_log
from ccatp.daemon.terminal import RunView, survey_title, write_run_report
from ccatp.errors import ExitStatus
from tests.unit.aligning.conftest import load
from tests.unit.reporting.beacon_recorded import record_beacons
from tests.unit.run_folder import make_run

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
