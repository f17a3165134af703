"""Edge. The run that has not finished, by name: what a service that is started again goes on with."""

import json
import os
from pathlib import Path
from typing import Any

from ccatp.errors import ConfigError, ExitStatus

FILE = Path("runs") / "unfinished"
# Complete, or at base after an abort: there is nothing to go on with.
FINISHED = (ExitStatus.COMPLETE, ExitStatus.ABORTED)


def find_unfinished() -> Path | None:
    """The directory of the run that did not finish, ``None`` where there is none with a mission in it.

    Raises:
        ConfigError: the note cannot be read.
    """
    try:
        text = FILE.read_text(encoding="utf-8").strip()
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--recover: cannot read {FILE}: {error}; remove it to begin a new run") from error
    run_dir = Path(text)
    return run_dir if text and (run_dir / "mission.sqlite").exists() else None


def finished_summary(run_dir: Path) -> dict[str, Any] | None:
    """The summary of a mission of which every point is measured, ``None`` for any other."""
    try:
        summary = json.loads((run_dir / "summary.json").read_text(encoding="utf-8"))
        points = summary["points"]
        is_finished = points["measured"] == points["total"] > 0
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return summary if is_finished else None


def note_unfinished(run_dir: Path) -> None:
    """Note that a run has begun.

    Raises:
        ConfigError: the note cannot be written.
    """
    new = FILE.with_name(f"{FILE.name}.new")
    try:
        FILE.parent.mkdir(parents=True, exist_ok=True)
        with new.open("w", encoding="utf-8") as file:
            file.write(f"{run_dir}\n")
            file.flush()
            os.fsync(file.fileno())
        new.replace(FILE)
    except OSError as error:
        raise ConfigError(
            f"--recover: cannot write {FILE}: {error.strerror}; start where ./runs can be made"
        ) from error


def forget_finished(status: int) -> None:
    """Take the note away where the run has finished."""
    if status in FINISHED:
        FILE.unlink(missing_ok=True)
