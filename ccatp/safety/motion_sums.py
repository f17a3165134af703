"""Changes of travel and turn over a period."""

from collections import deque
from typing import NamedTuple


class MotionSum(NamedTuple):
    """Travel of the wheels, and turn by the gyroscope where plausible: sums since the start at ``t_s``, or changes."""

    t_s: float
    right_m: float
    left_m: float
    turned_rad: float

    def of(self, side: int) -> float:
        """Travel of one wheel: 0 for the right one, 1 for the left one."""
        return self[1 + side]


class SlidingWindow:
    """The change of running sums over a period."""

    __slots__ = ("_kept", "_span_s")

    def __init__(self, span_s: float) -> None:
        self._span_s = span_s - 1e-6
        self._kept: deque[MotionSum] = deque()

    def reset(self) -> None:
        """Drop all sums."""
        self._kept.clear()

    def push(self, now: MotionSum) -> MotionSum | None:
        """Take the newest sums; returns the change over the period, with its length, ``None`` while it is too short."""
        kept, since_s = self._kept, now.t_s - self._span_s
        kept.append(now)
        while len(kept) > 1 and kept[1][0] <= since_s:
            kept.popleft()
        t_s, right_m, left_m, turned_rad = kept[0]
        if t_s > since_s:
            return None
        return MotionSum(now.t_s - t_s, now.right_m - right_m, now.left_m - left_m, now.turned_rad - turned_rad)
