"""A folder for all temporary files of a test session: what a session that was killed leaves, the next one removes."""

import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ccatp.links.runtime_dir import is_held, locked

PREFIX = "ccatp-tests-"
LOCK = "lock"
# Within this time of its beginning a session takes its lock.
NEW_S = 60.0


@contextmanager
def session_folder(root: Path) -> Iterator[Path]:
    """A new folder in ``root`` with a short path (unix sockets do not take a long one); its process holds its lock."""
    remove_abandoned(root)
    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=root, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        with locked(folder / LOCK, f"another process holds {folder / LOCK}"):
            yield folder


def remove_abandoned(root: Path, new_s: float = NEW_S) -> None:
    """Remove the folders of this user's sessions whose processes are gone."""
    for folder in root.glob(f"{PREFIX}*"):
        try:
            info = folder.lstat()
        except FileNotFoundError:  # it has just ended
            continue
        if info.st_uid == os.getuid() and time.time() - info.st_mtime > new_s and not is_held(folder / LOCK):
            shutil.rmtree(folder, ignore_errors=True)
