"""Removal of run directories: what is removed, and what is refused."""

import json
import os
from pathlib import Path

import pytest

from ccatp.cli import main
from ccatp.daemon.supervision.run_removal import DAY_S, chosen_by_age, refusal, remove
from ccatp.errors import RefusedError
from ccatp.links.runtime_dir import RUN_LOCK, locked

NOW_S = 1.8e9


def make_run(folder: Path, *, measured: int = 9, days_old: float = 0.0, system: str = "") -> Path:
    folder.mkdir(parents=True)
    (folder / "config.toml").write_text(f'system = "{system}"\n' if system else "")
    (folder / "mission.sqlite").write_bytes(b"x" * 2_000_000)
    (folder / "summary.json").write_text(json.dumps({"points": {"total": 9, "measured": measured}}))
    (folder / RUN_LOCK).touch()
    for path in (*folder.iterdir(), folder):
        os.utime(path, (NOW_S - days_old * DAY_S,) * 2)
    return folder


def test_a_complete_run_is_removed_with_everything_in_it(tmp_path: Path) -> None:
    run_dir, beside = make_run(tmp_path / "a"), make_run(tmp_path / "b")
    (run_dir / "figures").mkdir()
    (run_dir / "figures" / "link").symlink_to(beside)
    remove(run_dir, force=False)
    assert [path.name for path in tmp_path.iterdir()] == ["b"]
    assert (beside / "mission.sqlite").exists()  # the link was removed, not what it names


def test_a_run_that_could_be_resumed_needs_force_and_one_among_beacons_cannot_be(tmp_path: Path) -> None:
    aborted, beacons = make_run(tmp_path / "a", measured=3), make_run(tmp_path / "b", measured=3, system="zigbee")
    assert refusal(beacons, force=False) is None
    assert refusal(aborted, force=False) == "can be resumed; name it with --force to remove it all the same"
    with pytest.raises(RefusedError, match="can be resumed"):
        remove(aborted, force=False)
    remove(aborted, force=True)
    assert not aborted.exists()


@pytest.mark.parametrize("name", [RUN_LOCK, ".children"])
def test_a_run_in_use_is_not_removed_even_by_force(tmp_path: Path, name: str) -> None:
    run_dir = make_run(tmp_path / "a")
    with locked(run_dir / name, "in use"), pytest.raises(RefusedError, match="is in use"):
        remove(run_dir, force=True)
    assert (run_dir / "mission.sqlite").exists()


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(make_run(tmp_path / "a"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "config.toml").touch()  # of another program
    assert refusal(tmp_path / "link", force=True) == "is a link; name the folder itself"
    assert str(refusal(tmp_path / "other", force=True)).startswith("is no run directory")
    assert refusal(tmp_path / "none", force=True) == "no such folder"


@pytest.mark.parametrize(
    ("older_than_days", "keep", "names"),
    [(None, 2, "abc"), (15.0, None, "abc"), (15.0, 4, "a"), (0.0, None, "abcde"), (None, 9, "")],
)
def test_old_runs_are_chosen_by_age_and_number(
    tmp_path: Path, older_than_days: float | None, keep: int | None, names: str
) -> None:
    for k, name in enumerate("abcde"):
        make_run(tmp_path / name, days_old=50.0 - 12.0 * k)
    make_run(tmp_path / "resumable", measured=1, days_old=99.0)
    chosen = chosen_by_age(tmp_path, older_than_days=older_than_days, keep=keep, now_s=NOW_S)
    assert "".join(path.name for path in chosen) == names


def test_the_command_asks_refuses_all_or_nothing_and_says_what_it_removed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = make_run(tmp_path / "a"), make_run(tmp_path / "b", measured=1)
    assert main(["runs", "rm", str(good)]) == 2
    asked = capsys.readouterr()
    assert f"2.0 MB  {good}" in asked.out
    assert asked.err == "ccatp: nothing is removed: there is no terminal to ask; give --yes\n"
    assert main(["runs", "rm", str(good), str(bad), "--yes"]) == 2
    assert capsys.readouterr().err.startswith(f"ccatp: {bad}: can be resumed")
    assert good.exists()
    assert main(["runs", "rm", "--keep", "0", "--folder", str(tmp_path), "--yes", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"removed": [str(good)], "mb": 2.0}
    assert [path.name for path in tmp_path.iterdir()] == ["b"]
    for arguments in ([], [str(bad), "--keep", "1"], ["--keep", "1", "--force"]):
        assert main(["runs", "rm", *arguments]) == 2
    assert bad.exists()
