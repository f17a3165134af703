"""Changes of travel and turn over a period."""

from collections import deque

MotionSum = tuple[float, float, float, float]
"""Time, s; sums since the start: travel of right and left wheel, m, turn by the gyroscope where plausible, rad."""


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
        kept, since_s = self._kept, now[0] - self._span_s
        kept.append(now)
        while len(kept) > 1 and kept[1][0] <= since_s:
            kept.popleft()
        t_s, right_m, left_m, turned_rad = kept[0]
        if t_s > since_s:
            return None
        return now[0] - t_s, now[1] - right_m, now[2] - left_m, now[3] - turned_rad
