"""Tests of ``ccatp status``: table, JSON, and watching until the run is over."""

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from ccatp.cli import main
from ccatp.daemon.terminal import clock, share_done, status_line, status_rows
from ccatp.links.topics import MissionStatus
from tests.unit.serving import serving

NO_STATUS = MissionStatus(seq=-1, t_s=0.0, state="")

STATUS = {
    **msgspec.to_builtins(NO_STATUS),
    "state": "driving", "point": "3-4-5", "done": 120, "skipped": 3, "total": 693, "elapsed_s": 754.0, "eta_s": 3700.0,
    "lower_bound_s": 3000.0, "error_mm": 0.052,
}  # fmt: skip


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="ccatp-") as path:  # short: unix sockets take no long one
        yield Path(path)


def test_the_table() -> None:
    assert status_rows(STATUS) == [
        ("state", "driving 3-4-5"),
        ("points", f"120 of 693 measured, 3 skipped  [{'#' * 5}{'.' * 25}]"),
        ("time", "12:34 elapsed, 1:01:40 to go, no path takes less than 50:00"),
        ("arrival", "0.05 mm from the last point, as estimated"),
        ("danger", "0 normal"),
    ]
    assert dict(status_rows({**STATUS, "error_mm": 0.0}))["arrival"] == "none yet"
    held = {
        **STATUS,
        "state": "held",
        "point": "",
        "cause": "operator",
        "code": 2,
        "missed_deadlines": 4,
        "worst_lateness_ms": 31.0,
    }
    held |= {"left_out": {"out of time": ["1-2-3", "1-2-4"]}, "exit_status": 4, "outcome": "stopped"}
    found = dict(status_rows(held))
    assert found["cause"] == "operator"
    assert found["danger"] == "2 operation aborted"
    assert found["late frames"] == "4, the latest by 31 ms"
    assert found["left out: out of time"] == "1-2-3, 1-2-4"
    assert found["over"] == "with exit status 4"
    many = dict(status_rows({**STATUS, "left_out": {"operator": [f"1-2-{k}" for k in range(1, 94)]}}))
    assert many["left out: operator"] == (
        "93 points: 1-2-1, 1-2-2, 1-2-3, 1-2-4, 1-2-5, 1-2-6, 1-2-7, 1-2-8, 1-2-9, 1-2-10, ..."
    )
    assert found["outcome"] == "stopped"


def test_one_line() -> None:
    assert status_line(STATUS) == "18 %: 120 of 693 points, driving 3-4-5, 12:34 elapsed, 1:01:40 to go"
    assert "held (operator)" in status_line({**STATUS, "state": "held", "point": "", "cause": "operator"})
    assert share_done({}) == 0.0
    assert [clock(s) for s in (-1.0, 0.4, 59.6, 3600.0)] == ["0:00", "0:00", "1:00", "1:00:00"]


def test_the_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(folder, "control", lambda _: {"ok": True, "status": STATUS}):
        assert main(["status", "--runtime-dir", str(folder)]) == 0
        assert capsys.readouterr().out.splitlines()[0] == "state    driving 3-4-5"
        assert main(["status", "--runtime-dir", str(folder), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["status"] == STATUS


@pytest.mark.parametrize("command", ["pause", "resume", "abort", "stop"])
def test_commands_answer_with_the_same_table(folder: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(folder, "control", lambda _: {"ok": True, "status": STATUS}):
        assert main(["status", "--runtime-dir", str(folder)]) == 0
        table = capsys.readouterr().out
        assert main([command, "--runtime-dir", str(folder)]) == 0
    assert capsys.readouterr().out == table


def answers(*found: dict[str, Any]) -> Any:
    left = list(found)
    return lambda _: {"ok": True, "status": {**STATUS, **(left.pop(0) if len(left) > 1 else left[0])}}


def test_watching_tells_changes_until_the_end(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    course = answers({}, {}, {"done": 121}, {"done": 693, "state": "done", "exit_status": 0})
    command = ["status", "--watch", "--every", "0.1", "--runtime-dir", str(folder)]
    with serving(folder, "control", course) as asked:
        assert main(command) == 0
    assert len(asked) == 4
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3  # what did not change is not told again
    assert lines[-1].startswith("100 %: 693 of 693 points, done")
    with serving(folder, "control", answers({}, {"exit_status": 3})):
        assert main([*command, "--json"]) == 0
    assert [json.loads(line)["status"]["exit_status"] for line in capsys.readouterr().out.splitlines()] == [-1, 3]


def test_watching_a_daemon_that_goes_ends_well(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["status", "--watch", "--runtime-dir", str(folder)]
    assert main(command) == 5  # nobody was there
    with serving(folder, "control", answers({})):
        # The daemon goes between two looks.
        monkeypatch.setattr("ccatp.cli.operate.time.sleep", lambda _: (folder / "control").unlink())
        assert main(command) == 0
    assert "driving" in capsys.readouterr().out


def test_a_terminal_gets_a_table(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with serving(folder, "control", answers({}, {"exit_status": 0})):
        assert main(["status", "--watch", "--every", "0.1", "--runtime-dir", str(folder)]) == 0
    assert "120 of 693 measured" in capsys.readouterr().out
