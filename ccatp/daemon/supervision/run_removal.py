"""Removal of run directories: which may be removed, and their removal under the locks of a run."""

import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from ccatp.config.load import kind_in
from ccatp.daemon.supervision.run_dir import CHILDREN_LOCK, finished_summary
from ccatp.errors import ConfigError, RefusedError
from ccatp.links.runtime_dir import ORIGIN_FILE, RUN_LOCK, is_held, locked
from ccatp.records.recorder import TELEMETRY
from ccatp.records.run_reader import CONFIG, STORE

DAY_S = 86_400.0
_OF_A_RUN = ORIGIN_FILE, STORE, TELEMETRY  # besides its configuration, a run has one of these


def refusal(run_dir: Path, *, force: bool) -> str | None:
    """Why a directory is not removed, or ``None``; ``force``: a run that could be resumed is removed as well."""
    if run_dir.is_symlink():
        return "is a link; name the folder itself"
    if not run_dir.is_dir():
        return "no such folder"
    if not (run_dir / CONFIG).is_file() or not any((run_dir / name).is_file() for name in _OF_A_RUN):
        return f"is no run directory (it needs {CONFIG}, and {', '.join(_OF_A_RUN[:-1])} or {_OF_A_RUN[-1]})"
    if any(is_held(run_dir / name) for name in (RUN_LOCK, CHILDREN_LOCK)):
        return "is in use: the run is in progress, or its processes have not ended"
    if not force and is_resumable(run_dir):
        return "can be resumed; name it with --force to remove it all the same"
    return None


def is_resumable(run_dir: Path) -> bool:
    """Whether a mission is stored whose points are not all measured; of an unreadable configuration as well."""
    if not (run_dir / STORE).exists() or finished_summary(run_dir) is not None:
        return False
    try:
        return kind_in(run_dir / CONFIG).no_resume is None
    except ConfigError:
        return True


def remove(run_dir: Path, *, force: bool) -> None:
    """Remove a run directory. Raises ``RefusedError``: it must not be removed, or it cannot be."""
    if (why := refusal(run_dir, force=force)) is not None:
        raise RefusedError(f"{run_dir}: {why}")
    with ExitStack() as stack:
        for name in (RUN_LOCK, CHILDREN_LOCK):  # so that no run begins in it meanwhile
            stack.enter_context(locked(run_dir / name, f"{run_dir}: is in use"))
        try:
            shutil.rmtree(run_dir)
        except OSError as error:
            raise RefusedError(f"{error.filename or run_dir}: cannot be removed: {error.strerror}") from error


def chosen_by_age(folder: Path, *, older_than_days: float | None, keep: int | None, now_s: float) -> Sequence[Path]:
    """The runs in a folder that may be removed without force, the oldest first.

    ``older_than_days``: whose newest file is older; ``now_s`` is of the clock of the files. ``keep``: all but so many
    of the newest runs of the folder.
    """
    aged = sorted((_changed_s(path.parent), path.parent) for path in folder.glob(f"*/{CONFIG}"))
    if keep is not None:
        aged = aged[: max(len(aged) - keep, 0)]
    if older_than_days is not None:
        aged = [row for row in aged if now_s - row[0] > older_than_days * DAY_S]
    return [run_dir for _, run_dir in aged if refusal(run_dir, force=False) is None]


def _changed_s(run_dir: Path) -> float:
    return max((path.lstat().st_mtime for path in run_dir.iterdir()), default=0.0)


def size_bytes(run_dir: Path) -> int:
    """Bytes of all files of a run directory, those in folders included."""
    return sum(path.lstat().st_size for path in run_dir.rglob("*") if path.is_file())
