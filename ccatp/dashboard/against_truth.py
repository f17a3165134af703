"""Pure. How far the estimate is from the simulated truth, frame by frame, and the worst of each second."""

from collections import OrderedDict
from collections.abc import Iterable
from math import hypot
from typing import NamedTuple

# Of every so many frames one is compared: ten a second.
EVERY = 10
# Frames whose other half has not come: batches of a second, and some reserve.
WAITING = 500


class Second(NamedTuple):
    """The worst of one second: robot time (s), true error of the position and its three sigma (mm)."""

    t_s: float
    error_mm: float
    three_sigma_mm: float


class TruthCompare:
    """Joins what main estimated and what the stand-in knows; either may come first."""

    def __init__(self) -> None:
        """Nothing came yet."""
        self._estimates: OrderedDict[int, tuple[float, float, float]] = OrderedDict()
        self._truths: OrderedDict[int, tuple[float, float, float]] = OrderedDict()
        self._second = -1
        self._worst: Second | None = None

    @staticmethod
    def is_compared(seq: int) -> bool:
        """Whether a frame is one of those that are compared."""
        return seq % EVERY == 0

    def estimate(self, seq: int, x_m: float, y_m: float, sigma_m: float) -> list[Second]:
        """Main's estimate after frame ``seq``, deck frame; returns the seconds that are complete by it."""
        return self._join(seq, self._estimates, (x_m, y_m, sigma_m))

    def truth(self, rows: Iterable[tuple[int, float, float, float]]) -> list[Second]:
        """True places: rows of frame, time (s), x and y (m); returns the seconds that are complete by them."""
        done = []
        for seq, t_s, x_m, y_m in rows:
            if self.is_compared(seq):
                done += self._join(seq, self._truths, (t_s, x_m, y_m))
        return done

    def _join(
        self, seq: int, own: OrderedDict[int, tuple[float, float, float]], value: tuple[float, float, float]
    ) -> list[Second]:
        own[seq] = value
        if len(own) > WAITING:
            own.popitem(last=False)
        if seq not in self._estimates or seq not in self._truths:
            return []
        x_m, y_m, sigma_m = self._estimates.pop(seq)
        t_s, true_x_m, true_y_m = self._truths.pop(seq)
        here = Second(t_s, 1e3 * hypot(x_m - true_x_m, y_m - true_y_m), 3e3 * sigma_m)
        if int(t_s) == self._second and self._worst is not None:
            if here.error_mm > self._worst.error_mm:
                self._worst = here
            return []
        done, self._second, self._worst = self._worst, int(t_s), here
        return [] if done is None else [done]
