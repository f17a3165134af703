"""What the recorder of a run asks of a kind of mission: its summary, and the views that it records."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from ccatp.links.topics import Message
from ccatp.records.recorder import RecordedMessage


class RunRecord(ABC):
    """Takes the messages of a run from start to end, for its summary."""

    @property
    def remarks(self) -> Sequence[str]:
        """Warnings for the operator at the end."""
        return ()

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
