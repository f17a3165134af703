"""Pure. What was done to the filter lately, so that a late measurement can be taken at its own time."""

from collections import deque
from collections.abc import Callable

from ccatp.filters.base import Filter, FloatArray

Step = Callable[[], None]
_SAME_TIME_S = 1e-6


class _Entry:
    """The state before one frame, and the frame's steps."""

    __slots__ = ("covariance", "mean", "steps", "t_s")

    def __init__(self, t_s: float, mean: FloatArray, covariance: FloatArray) -> None:
        self.t_s, self.mean, self.covariance = t_s, mean, covariance
        self.steps: list[Step] = []


class Journal:
    """Rewind and replay.

    A filter replaces its arrays and never changes them, so keeping a state costs a reference.

    Args:
        reach_s: how far back a measurement may be taken.
    """

    def __init__(self, reach_s: float) -> None:
        self._reach_s = reach_s
        self._entries: deque[_Entry] = deque()

    @property
    def oldest_s(self) -> float:
        """The earliest time at which a measurement can still be taken: from the end of the first entry on."""
        return self._entries[0].t_s if self._entries else float("-inf")

    def restart(self) -> None:
        """The robot's clock has jumped."""
        self._entries.clear()

    def begin(self, t_s: float, filter_: Filter) -> None:
        """A frame begins that changes the state."""
        entries = self._entries
        entries.append(_Entry(t_s, filter_.mean, filter_.covariance))
        # Two entries at least: a standstill may outlast the reach, and its beginning is where its fix belongs.
        while len(entries) > 2 and entries[1].t_s < t_s - self._reach_s:
            entries.popleft()

    def add(self, step: Step) -> None:
        """Keep a step of the present frame."""
        if self._entries:
            self._entries[-1].steps.append(step)

    def take(self, t_s: float, step: Step, filter_: Filter) -> int:
        """Do ``step`` to the state of time ``t_s`` and everything later again; returns how many frames that were."""
        entries = self._entries
        count = 0
        while count < len(entries) and entries[-1 - count].t_s > t_s + _SAME_TIME_S:
            count += 1
        if count == 0 or count == len(entries):
            step()
            self.add(step)
            return 0
        later = [entries[k] for k in range(len(entries) - count, len(entries))]
        filter_.reset(later[0].mean, later[0].covariance)
        step()
        entries[len(entries) - count - 1].steps.append(step)
        for entry in later:
            entry.mean, entry.covariance = filter_.mean, filter_.covariance
            for again in entry.steps:
                again()
        return count
