"""Pure. When a sensor is read: instants at its own rate, sorted into frames."""

from collections.abc import Sequence
from math import exp

import numpy as np

_SAME_RATIO = 1e-9  # rates this near to a whole ratio are meant to be one
_BLOCK_FRAMES = 512  # instants are computed ahead for so many frames


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

    __slots__ = (
        "_ahead",
        "_ahead_from",
        "_every",
        "_frame_hz",
        "_hz",
        "_lag_s",
        "_starts",
        "decays",
        "fractions",
        "times_s",
    )

    def __init__(self, hz: float, frame_hz: float, lag_s: float) -> None:
        self._hz, self._frame_hz, self._lag_s = hz, frame_hz, lag_s
        ratio = hz / frame_hz
        count = round(ratio) if abs(ratio - round(ratio)) < _SAME_RATIO * ratio else 0
        fractions = [(j + 1) / count for j in range(count)]
        self._every = (count, fractions, self._decays(fractions))
        self._ahead: list[float] = []
        self._starts: list[int] = []
        self._ahead_from = -_BLOCK_FRAMES
        self.times_s: list[float] = []
        self.fractions: list[float] = []
        self.decays: list[float] = []

    def enter(self, frame: int) -> None:
        """Go on to a frame; frame 0 is the single instant of boot."""
        count, self.fractions, self.decays = self._every
        if frame == 0:
            self.times_s, self.fractions, self.decays = [0.0], [1.0], [1.0]
            return
        at = frame - self._ahead_from
        if not 0 <= at < _BLOCK_FRAMES:
            self._look_ahead(frame)
            at = 0
        if count:
            self.times_s = self._ahead[at * count : (at + 1) * count]
            return
        self.times_s = times_s = self._ahead[self._starts[at] : self._starts[at + 1]]
        if times_s:
            self.fractions = [t * self._frame_hz - (frame - 1) for t in times_s]
            self.decays = self._decays(self.fractions)

    def _look_ahead(self, frame: int) -> None:
        frames = np.arange(frame - 1, frame + _BLOCK_FRAMES)
        lasts = np.floor(frames * (self._hz / self._frame_hz) + _SAME_RATIO).astype(np.int64)
        self._ahead = (np.arange(lasts[0] + 1, lasts[-1] + 1) / self._hz).tolist()
        self._starts = (lasts - lasts[0]).tolist()
        self._ahead_from = frame

    def _decays(self, fractions: Sequence[float]) -> list[float]:
        return [exp(-f / (self._frame_hz * self._lag_s)) for f in fractions]
