"""Pure. Lines of the robot that are no frames: how many there may be within a while."""

from collections import deque
from math import inf


class GarbledLines:
    """Counts them on any clock that runs on.

    Args:
        limit: so many within the window are too many.
        window_s: the window, s.
    """

    __slots__ = ("_times_s", "_window_s")

    def __init__(self, limit: int, window_s: float) -> None:
        """None yet."""
        self._times_s = deque([-inf] * limit, maxlen=limit)
        self._window_s = window_s

    def add(self, at_s: float) -> bool:
        """Count one at ``at_s``; true where this and those before it are too many."""
        self._times_s.append(at_s)
        return at_s - self._times_s[0] <= self._window_s
