"""A run that is resumed although what it left is damaged, or its laser is gone: one line, and nothing that is lost."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.processes.conftest import NO_CALIBRATION, Run

Again = Callable[..., Run]
ONE_PANEL = ("--panels", "1", *NO_CALIBRATION)


@pytest.fixture
def interrupted(start: Callable[..., Run]) -> Run:
    """A run that was ended after its second point."""
    run = start("--panels", "1")
    run.until(lambda status: status["done"] >= 2)
    run.ask("stop")
    run.wait()
    assert run.summary["points"]["measured"] >= 2
    return run


@pytest.fixture
def resume(interrupted: Run) -> Iterator[Again]:
    """Resumes it."""
    runs: list[Run] = []

    def begin(*args: str) -> Run:
        runs.append(Run(interrupted.run_dir, interrupted.runtime_dir, "--resume", *ONE_PANEL, *args))
        return runs[-1]

    yield begin
    for run in runs:
        run.end()


def flipped(path: Path) -> None:
    """Flip a bit in every hundred bytes."""
    data = bytearray(path.read_bytes())
    data[::100] = bytes(byte ^ 0x10 for byte in data[::100])
    path.write_bytes(data)


@pytest.mark.fault("P16", "P17")
def test_what_is_damaged_is_refused_and_what_was_measured_stays(interrupted: Run, resume: Again) -> None:
    before = interrupted.summary["points"]
    checkpoint, database = interrupted.run_dir / "checkpoint", interrupted.run_dir / "mission.sqlite"
    for path, text in (
        (checkpoint, "damaged, so nobody knows where the robot is; set it at base, remove this file and resume"),
        (database, "damaged"),
    ):
        sound = path.with_name("sound")
        shutil.copyfile(path, sound)
        flipped(path)
        run = resume()
        assert run.wait() == 2
        assert f"{path}: {text}" in run.stderr
        assert "Traceback" not in run.stderr
        assert {key: run.summary["points"][key] for key in ("total", "measured")} == {
            key: before[key] for key in ("total", "measured")
        }
        sound.replace(path)
    run = resume()
    assert run.wait() == 0, run.stderr
    assert run.summary["points"]["measured"] == 9
    assert run.summary["danger"]["falls"] == 0


@pytest.mark.fault("P13")
def test_a_summary_that_cannot_be_written_changes_nothing_of_the_outcome(interrupted: Run, resume: Again) -> None:
    (interrupted.run_dir / "summary.json.new").mkdir()  # in its place nothing can be written
    before = json.dumps(interrupted.summary)
    run = resume()
    assert run.wait() == 0, run.stderr
    assert "summary.json: cannot be written" in run.stderr
    assert "Traceback" not in run.stderr
    assert json.dumps(run.summary) == before
