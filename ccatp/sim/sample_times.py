"""Pure. When a sensor is read: instants at its own rate, sorted into frames."""

from collections.abc import Sequence
from itertools import pairwise
from math import exp

import numpy as np
from numpy.typing import NDArray

_SAME_RATIO = 1e-9  # rates this near to a whole ratio are meant to be one
_BLOCK_FRAMES = 512  # instants are computed ahead for so many frames

Instants = tuple[list[float], list[float], list[float]]
_BOOT: Instants = ([0.0], [1.0], [1.0])
_NONE: Instants = ([], [], [])


class SampleTimes:
    """Instants ``n / hz`` that fall into the frames ``((k-1)/frame_hz, k/frame_hz]``.

    Args:
        hz: rate of the sensor.
        frame_hz: rate of the frames.
        lag_s: time constant of the wheel servo, for ``decays``.

    Attributes:
        times_s: the instants of the frame entered last.
        fractions: the same, as fractions of the frame, in (0, 1].
        decays: ``exp(-tau/lag)`` at the same instants, tau counted from the start of the frame.
    """

    __slots__ = ("_ahead", "_ahead_from", "_count", "_frame_hz", "_hz", "_lag_s", "decays", "fractions", "times_s")

    def __init__(self, hz: float, frame_hz: float, lag_s: float) -> None:
        self._hz, self._frame_hz, self._lag_s = hz, frame_hz, lag_s
        ratio = hz / frame_hz
        self._count = round(ratio) if abs(ratio - round(ratio)) < _SAME_RATIO * ratio else 0
        self._ahead: list[Instants] = []
        self._ahead_from = 0
        self.times_s: list[float] = []
        self.fractions: list[float] = []
        self.decays: list[float] = []

    def enter(self, frame: int) -> None:
        """Go on to a frame; frame 0 is the single instant of boot."""
        at = frame - self._ahead_from
        if not 0 <= at < len(self._ahead):
            self._look_ahead(frame)
            at = 0
        self.times_s, self.fractions, self.decays = self._ahead[at]

    def _look_ahead(self, frame: int) -> None:
        self._ahead_from = frame
        if frame == 0:
            self._ahead = [_BOOT]
            return
        frames = np.arange(frame - 1, frame + _BLOCK_FRAMES)
        lasts = np.floor(frames * (self._hz / self._frame_hz) + _SAME_RATIO).astype(np.int64)
        times_s = np.arange(lasts[0] + 1, lasts[-1] + 1) / self._hz
        self._ahead = self._even(times_s) if self._count else self._uneven(times_s, lasts - lasts[0], frame)

    def _even(self, times_s: NDArray[np.float64]) -> list[Instants]:
        """The same number of instants in every frame, always at the same fractions of it."""
        fractions = [(j + 1) / self._count for j in range(self._count)]
        decays = self._decays(fractions)
        return [(row, fractions, decays) for row in times_s.reshape(-1, self._count).tolist()]

    def _uneven(self, times_s: NDArray[np.float64], starts: NDArray[np.int64], frame: int) -> list[Instants]:
        found: list[Instants] = []
        times = times_s.tolist()
        for before, (start, end) in enumerate(pairwise(starts.tolist()), frame - 1):
            if start == end:
                found.append(_NONE)
                continue
            row = times[start:end]
            fractions = [t * self._frame_hz - before for t in row]
            found.append((row, fractions, self._decays(fractions)))
        return found

    def _decays(self, fractions: Sequence[float]) -> list[float]:
        return [exp(-f / (self._frame_hz * self._lag_s)) for f in fractions]
