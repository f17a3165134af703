"""Which run a service goes on with."""

from pathlib import Path

import pytest

from ccatp.daemon.danger_loop import FILE as EMERGENCIES
from ccatp.daemon.run_dir import (
    FILE,
    clear_finished,
    find_resumable,
    finished_summary,
    mark_resumable,
    take_over_emergencies,
)
from ccatp.errors import ConfigError, ExitStatus


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def begin(tmp_path: Path) -> Path:
    run_dir = tmp_path / "runs" / "one"
    run_dir.mkdir(parents=True)
    (run_dir / "mission.sqlite").touch()
    mark_resumable(run_dir)
    return run_dir


def test_a_run_is_found_until_it_has_finished(tmp_path: Path) -> None:
    assert find_resumable() is None
    run_dir = begin(tmp_path)
    for status in (ExitStatus.HELD, ExitStatus.INTERRUPTED, ExitStatus.UNREACHABLE):
        clear_finished(status, run_dir)
        assert find_resumable() == run_dir
    clear_finished(ExitStatus.COMPLETE, run_dir)
    assert find_resumable() is None


@pytest.mark.fault("O7")
@pytest.mark.parametrize("kept", ['{"active": [{"id": "a", "kind": "fire", "note": ""}], "cleared": []}', "{"])
def test_an_emergency_outlives_the_run(tmp_path: Path, kept: str) -> None:
    first, second, third = begin(tmp_path), tmp_path / "runs" / "two", tmp_path / "runs" / "three"
    assert not take_over_emergencies(second)
    (first / EMERGENCIES).write_text(kept)
    clear_finished(ExitStatus.ABORTED, first)
    assert find_resumable() is None
    assert take_over_emergencies(second)
    assert (second / EMERGENCIES).read_text() == kept
    (second / EMERGENCIES).write_text('{"active": [], "cleared": ["a"]}')
    clear_finished(ExitStatus.COMPLETE, second)
    assert not take_over_emergencies(third)


def test_a_run_that_never_began_is_none(tmp_path: Path) -> None:
    (begin(tmp_path) / "mission.sqlite").unlink()
    assert find_resumable() is None
    FILE.write_text("")
    assert find_resumable() is None


def test_a_note_that_cannot_be_read_or_written(tmp_path: Path) -> None:
    FILE.parent.mkdir()
    FILE.mkdir()
    with pytest.raises(ConfigError, match="--recover: cannot read"):
        find_resumable()
    FILE.rmdir()
    FILE.parent.rmdir()
    FILE.parent.write_text("")
    with pytest.raises(ConfigError, match="--recover: cannot write"):
        mark_resumable(tmp_path)


@pytest.mark.parametrize(
    ("text", "is_finished"),
    [
        ('{"points": {"measured": 9, "total": 9}}', True),
        ('{"points": {"measured": 8, "total": 9}}', False),
        ('{"points": {"measured": 0, "total": 0}}', False),
        ('{"points": {"measured": 9', False),
        ('{"points": 9}', False),
        ("[]", False),
    ],
)
def test_a_mission_is_finished_when_its_summary_says_so(text: str, is_finished: bool, tmp_path: Path) -> None:
    assert finished_summary(tmp_path) is None
    (tmp_path / "summary.json").write_text(text)
    assert (finished_summary(tmp_path) is not None) is is_finished
