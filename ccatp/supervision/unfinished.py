"""Edge. The run that has not finished, by name: what a service that is started again goes on with."""

import json
import os
from pathlib import Path
from typing import Any

from ccatp.errors import ConfigError, ExitStatus
from ccatp.processes.latching import FILE as EMERGENCIES

FILE = Path("runs") / "unfinished"
# What was latched when a run finished, for the next one: whoever has to clear it finds no daemon in between.
LATCHED_FILE = Path("runs") / EMERGENCIES
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
    try:
        FILE.parent.mkdir(parents=True, exist_ok=True)
        _write(FILE, f"{run_dir}\n".encode())
    except OSError as error:
        raise ConfigError(
            f"--recover: cannot write {FILE}: {error.strerror}; start where ./runs can be made"
        ) from error


def forget_finished(status: int, run_dir: Path) -> None:
    """Take the note away where the run has finished; emergencies that are in force then stay so in the next one.

    Raises:
        ConfigError: they cannot be kept.
    """
    if status not in FINISHED:
        return
    kept = _emergencies(run_dir / EMERGENCIES)
    try:
        if kept:
            _write(LATCHED_FILE, kept)
        else:
            LATCHED_FILE.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"--recover: cannot keep {LATCHED_FILE}: {error.strerror}") from error
    FILE.unlink(missing_ok=True)


def take_over_emergencies(run_dir: Path) -> bool:
    """Give a new run the emergencies that were in force when the last one finished; whether there are any.

    Raises:
        ConfigError: they cannot be read, or not be written.
    """
    try:
        kept = LATCHED_FILE.read_bytes()
        run_dir.mkdir(parents=True, exist_ok=True)
        _write(run_dir / EMERGENCIES, kept)
    except FileNotFoundError:
        return False
    except OSError as error:
        raise ConfigError(f"--recover: cannot take over {LATCHED_FILE}: {error.strerror}") from error
    return True


def _write(path: Path, data: bytes) -> None:
    """All of it or nothing, and on the disk."""
    new = path.with_name(f"{path.name}.new")
    with new.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)


def _emergencies(path: Path) -> bytes:
    """The file of a latch as it is, empty where it holds nothing; one that is damaged holds something."""
    try:
        found = path.read_bytes()
    except FileNotFoundError:
        return b""
    try:
        return found if json.loads(found)["active"] else b""
    except (ValueError, KeyError, TypeError):
        return found
