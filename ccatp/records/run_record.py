"""What the recorder of a run asks of a kind of mission: its summary, and the views that it records."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from ccatp.config.mission import CommonConfig
from ccatp.links.topics import Message, MissionStatus
from ccatp.records.recorder import RecordedMessage, RobotClock


class RunRecord(ABC):
    """Takes the messages of a run from start to end, for its summary."""

    @property
    def remarks(self) -> Sequence[str]:
        """Warnings for the operator at the end."""
        return ()

    def prepare(self) -> None:  # noqa: B027 - most need nothing
        """Import what only ``build`` needs, while the robot drives."""

    @abstractmethod
    def take(self, message: Message) -> None:
        """Take one message of the run."""

    def views_of(self, _message: Message) -> Iterable[RecordedMessage]:
        """What is recorded besides a message, for displays."""
        return ()

    def ask_truth(self, _request: Callable[[bytes], dict[str, Any]]) -> None:  # noqa: B027 - it may want nothing
        """Ask the simulated truth, at the end; ``request`` gives its reply, empty if it has ended."""

    @abstractmethod
    def build(self, wall_s: float) -> dict[str, Any]:
        """The summary, after main has closed the mission's database; ``wall_s``: duration of the run."""


class StatusRecord(RunRecord):
    """A summary from the status of the mission alone."""

    def __init__(self, system: str, seed: int) -> None:
        self._run: dict[str, Any] = {"system": system, "seed": seed}

    def take(self, message: Message) -> None:
        """Take one message of the run."""
        if isinstance(message, MissionStatus):
            goals = {"total": message.total, "reached": message.done}
            self._run |= {"outcome": message.outcome, "cause": message.cause, "goals": goals}
            self._run["mission_time_s"] = message.elapsed_s

    def build(self, wall_s: float) -> dict[str, Any]:
        """The summary."""
        return {**self._run, "wall": {"time_s": round(wall_s, 3)}}


def status_record(cfg: CommonConfig, _run_dir: Path, _clock: RobotClock, _is_sim: bool) -> RunRecord:
    """The record of a kind of mission that has none of its own."""
    return StatusRecord(cfg.system, cfg.run.seed)
