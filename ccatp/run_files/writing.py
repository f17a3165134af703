"""Edge. Whether a recording is still being written: then that it has no end yet is no damage."""

from pathlib import Path

from ccatp.runtime_dir import is_held

RUN_LOCK = ".lock"
"""In a run directory; held by the daemon that writes there."""


def is_being_written(path: Path) -> bool:
    """Whether a run that goes on writes this recording: the newest one of its directory, which has no number."""
    return "." not in path.stem and is_held(path.parent / RUN_LOCK)


def damage_text(path: Path, damage: str) -> str:
    """Why a recording could not be read to its end, for a reader of the run.

    Args:
        path: the recording.
        damage: what the reader of its format says, with the path.
    """
    if is_being_written(path):
        return f"{path.name}: still being written; what it holds so far is in this report"
    return f"{damage.replace(str(path), path.name)}; what came before it is in this report"
