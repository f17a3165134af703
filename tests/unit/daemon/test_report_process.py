"""The process that draws the report at the end of a run."""

import json
import signal
import subprocess
import threading
import time
from collections.abc import Sequence
from multiprocessing import resource_tracker
from pathlib import Path

import pytest

from ccatp.daemon.operator.report_process import ReportProcess, by_hand, written
from ccatp.daemon.supervision.fork_server import ChildProcess, start_module
from ccatp.daemon.supervision.process import open_log
from ccatp.records.run_reader import RunReadError
from tests.support.leaks import child_processes
from tests.support.recorded import make_run, record_beacons
from tests.support.scenario import world_of

CFG, _ = world_of()


def empty_run(folder: Path) -> Path:
    return make_run(folder, CFG, [], [], {})


def test_a_run_gets_its_report_and_the_process_ends(tmp_path: Path) -> None:
    run_dir = empty_run(tmp_path / "run")
    log = open_log(run_dir / "log.jsonl", "supervisor")
    for one, text in ((run_dir, "<!DOCTYPE html>"), (record_beacons(tmp_path / "beacons"), "among ZigBee beacons")):
        with ReportProcess(start_module, one) as drawing:
            drawing.begin()
            (process,) = child_processes()
            assert not (one / "report.html").exists()
            assert drawing.write(log) == str(one / "report.html")
        assert text in (one / "report.html").read_text()
        assert not process.is_running()
    assert (run_dir / "log.jsonl").read_text() == ""


def test_without_a_request_there_is_no_process_and_no_report(tmp_path: Path) -> None:
    run_dir = empty_run(tmp_path / "run")
    resource_tracker.ensure_running()  # as after tests that use multiprocessing; it is nobody's report
    with ReportProcess(start_module, run_dir):
        assert child_processes() == set()
    with ReportProcess(start_module, run_dir) as drawing:
        drawing.begin()
        drawing.begin()
        assert len(child_processes()) == 1
    assert child_processes() == set()
    assert not (run_dir / "report.html").exists()


def test_the_death_of_the_process_is_logged_and_the_report_is_made_by_hand(tmp_path: Path) -> None:
    run_dir = empty_run(tmp_path / "run")
    log = open_log(run_dir / "log.jsonl", "supervisor")
    with ReportProcess(start_module, run_dir) as drawing:
        drawing.begin()
        child_processes().pop().kill()
        assert drawing.write(log) == by_hand(run_dir) == f"none; make it with: ccatp report {run_dir}"

    def refuse(_module: str, _arguments: Sequence[str], _fds: Sequence[int]) -> ChildProcess:
        raise BlockingIOError("no more processes")

    with ReportProcess(refuse, run_dir) as drawing:
        assert drawing.write(log) == by_hand(run_dir)
    lines = [json.loads(text) for text in (run_dir / "log.jsonl").read_text().splitlines()]
    assert [(line["event"], line["level"]) for line in lines] == [("report_failed", "error")] * 2


def test_a_signal_ends_only_the_writing(tmp_path: Path) -> None:
    run_dir, before = empty_run(tmp_path / "run"), signal.getsignal(signal.SIGTERM)
    log = open_log(run_dir / "log.jsonl", "supervisor")
    main = threading.main_thread().ident
    assert main is not None

    def interrupt() -> None:
        while signal.getsignal(signal.SIGTERM) is before:
            time.sleep(0.001)
        signal.pthread_kill(main, signal.SIGTERM)

    interrupter = threading.Thread(target=interrupt)
    with ReportProcess(silent, run_dir) as drawing:
        interrupter.start()
        assert drawing.write(log) == by_hand(run_dir)
        interrupter.join()
    assert signal.getsignal(signal.SIGTERM) is before
    assert child_processes() == set()
    assert (run_dir / "log.jsonl").read_text() == ""


def silent(_module: str, _arguments: Sequence[str], fds: Sequence[int]) -> ChildProcess:
    """A process that holds the socket and never answers."""
    return subprocess.Popen(["sleep", "60"], pass_fds=fds)


def test_what_cannot_be_drawn_is_an_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_run_dir: Path) -> None:
        raise RunReadError("no run")

    def fail(_run_dir: Path) -> None:
        raise ZeroDivisionError("of nothing")

    monkeypatch.setattr("ccatp.report.run_page.report_run", refuse)
    assert written(tmp_path) == {"refused": "no run"}
    monkeypatch.setattr("ccatp.report.run_page.report_run", fail)
    assert written(tmp_path) == {"failed": "ZeroDivisionError: of nothing"}


def test_a_refusal_is_shown_as_it_is(tmp_path: Path) -> None:
    folder = tmp_path / "none"
    folder.mkdir()
    log = open_log(tmp_path / "log.jsonl", "supervisor")
    with ReportProcess(start_module, folder) as drawing:
        assert drawing.write(log).startswith(f"none; {folder}")
    assert (tmp_path / "log.jsonl").read_text() == ""
