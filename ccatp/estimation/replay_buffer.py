"""What was done to the filter lately, so that a late measurement can be taken at its own time."""

from collections import deque
from collections.abc import Callable

from ccatp.core import FloatArray
from ccatp.filters.base import Filter

Step = Callable[[], None]
LateStep = Callable[[float], None]
"""A step that belongs to a moment before the state's: gets by how much, s."""
_SAME_TIME_S = 1e-6


class _Entry:
    """The state before some steps, the time to which they bring it, and how long the robot may have moved in them."""

    __slots__ = ("covariance", "dt_s", "kept_s", "mean", "steps", "t_s")

    def __init__(self, t_s: float, dt_s: float, mean: FloatArray, covariance: FloatArray) -> None:
        self.t_s, self.dt_s, self.mean, self.covariance = t_s, dt_s, mean, covariance
        self.steps: list[Step] = []
        self.kept_s = t_s  # the steps are those since then

    def settle(self, t_s: float, mean: FloatArray, covariance: FloatArray) -> None:
        """The robot has stood since the entry's end: the present state is as good as the one before the steps."""
        self.kept_s, self.mean, self.covariance = t_s, mean, covariance
        self.steps.clear()


class ReplayBuffer:
    """Rewind and replay of late measurements, at most ``reach_s`` back.

    A filter replaces its arrays and never changes them, so keeping a state costs a reference.
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

    def begin(self, t_s: float, dt_s: float, filter_: Filter) -> None:
        """Steps follow that bring the state to ``t_s``; the robot may have moved during the last ``dt_s`` of it."""
        entries = self._entries
        if dt_s == 0.0 and entries and entries[-1].dt_s == 0.0:
            entries[-1].t_s = t_s  # a standstill, however long, is one entry
            if entries[-1].kept_s < t_s - self._reach_s:
                self._settle(t_s, filter_)
            return
        entries.append(_Entry(t_s, dt_s, filter_.mean, filter_.covariance))
        # Two entries at least: a standstill may outlast the reach, and its beginning is where its fix belongs.
        while len(entries) > 2 and entries[1].t_s < t_s - self._reach_s:
            entries.popleft()

    def _settle(self, t_s: float, filter_: Filter) -> None:
        """Forget how the state of a long standstill came about: nothing grows however long the robot stands."""
        entries = self._entries
        while len(entries) > 2:
            entries.popleft()
        for entry in entries:
            entry.settle(t_s, filter_.mean, filter_.covariance)

    def add(self, step: Step) -> None:
        """Keep a step of the present entry."""
        if self._entries:
            self._entries[-1].steps.append(step)

    def look(self, t_s: float, filter_: Filter) -> tuple[FloatArray, FloatArray, float]:
        """The first state not before ``t_s``: its mean, its covariance, and by how much it is later, s."""
        count, late_s = self._home(t_s)
        if count > 1:
            later = self._entries[1 - count]
            return later.mean, later.covariance, late_s
        return filter_.mean, filter_.covariance, late_s

    def _home(self, t_s: float) -> tuple[int, float]:
        """How many entries are not before ``t_s``, and how much motion lies between it and the end of the first."""
        entries, count = self._entries, 0
        while count < len(entries) and entries[-1 - count].t_s >= t_s - _SAME_TIME_S:
            count += 1
        if not count:
            return 0, 0.0
        home = entries[-count]
        return count, min(max(home.t_s - t_s, 0.0), home.dt_s)

    def take(self, t_s: float, step: LateStep, filter_: Filter) -> int:
        """Do ``step`` to the first state not before ``t_s`` and everything later again.

        Returns the number of repeated entries.
        """
        entries = self._entries
        count, late_s = self._home(t_s)
        later = [entries[k] for k in range(len(entries) - count + 1, len(entries))] if count else []
        if later:
            filter_.reset(later[0].mean, later[0].covariance)
        step(late_s)
        if entries:
            entries[-max(count, 1)].steps.append(lambda: step(late_s))
        for entry in later:
            entry.mean, entry.covariance = filter_.mean, filter_.covariance
            for again in entry.steps:
                again()
        return len(later)
