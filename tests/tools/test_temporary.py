"""The folder of a test session is removed with it, or by the next session when it was killed."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.support.temporary import LOCK, PREFIX, remove_abandoned, session_folder

SESSION = """
import signal, sys
from pathlib import Path
from tests.support.temporary import session_folder
with session_folder(Path(sys.argv[1])) as folder:
    (folder / "socket").touch()
    print(folder, flush=True)
    signal.pause()
"""


def test_what_a_killed_session_leaves_is_removed_and_a_living_session_keeps_its_folder(tmp_path: Path) -> None:
    command = [sys.executable, "-c", SESSION, str(tmp_path)]
    with session_folder(tmp_path) as own, subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        left = Path(other.stdout.readline().strip())
        for folder in (own, left):
            os.utime(folder, (0.0, 0.0))
        remove_abandoned(tmp_path)
        assert own.is_dir()
        assert (left / "socket").exists()
        other.send_signal(signal.SIGKILL)
        other.wait()
        assert left.is_dir()
        os.utime(left, (0.0, 0.0))
        with session_folder(tmp_path) as following:
            assert set(tmp_path.iterdir()) == {own, following}
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("is_locked", [False, True])
def test_a_session_that_begins_is_not_taken_for_one_that_is_gone(is_locked: bool, tmp_path: Path) -> None:
    folder = tmp_path / f"{PREFIX}new"
    folder.mkdir()
    if is_locked:
        (folder / LOCK).touch()
    remove_abandoned(tmp_path)
    assert folder.is_dir()
    remove_abandoned(tmp_path, new_s=-1.0)
    assert not folder.exists()


def test_temporary_files_of_tests_and_of_their_processes_lie_there() -> None:
    code = "import tempfile; print(tempfile.gettempdir())"
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    assert there == tempfile.gettempdir()
    assert Path(there).name.startswith(PREFIX)
