"""Pure. Frames gathered into one step of the filter."""

from collections.abc import Sequence
from typing import NamedTuple

from ccatp.samples import ImuSample


class Block(NamedTuple):
    """What some frames in a row say together.

    Attributes:
        dt_s: their length.
        turning_s: how long of it the wheels turned.
        rate_rad_s: mean of the inertial unit's angular rate over the block; None without samples.
        acceleration_m_s2: mean of its acceleration from the middle of the block before to the middle of this one.
        samples: how many went into the means.
    """

    dt_s: float
    turning_s: float
    rate_rad_s: float | None
    acceleration_m_s2: float | None
    samples: int


class BlockBuilder:
    """Gathers frames.

    Wheel angles are exact over any time, and a mean of n rates tells as much as n rates, so nothing is lost by taking
    several frames in one step as long as the path between them is an arc. V and W are means over a step: the mean rate
    is that of the samples by the trapezoid rule, the difference of two mean speeds is the mean acceleration from middle
    to middle.
    """

    def __init__(self) -> None:
        self._last: tuple[float, float] | None = None  # acceleration and rate at the end of the last frame
        self._before: float | None = None  # mean acceleration of the last block
        self._clear()

    def _clear(self) -> None:
        self.dt_s = self._turning_s = self._rates = self._accelerations = 0.0
        self._samples = 0

    def restart(self) -> None:
        """The robot's clock has jumped, or it has been at rest: nothing reaches across."""
        self._last = self._before = None
        self._clear()

    def stand(self, imu: Sequence[ImuSample]) -> None:
        """A frame at rest: its sample is where the trapezoid of the first moving frame begins."""
        self._last = (imu[-1][1], imu[-1][2]) if imu else None
        self._before = None

    def add(self, dt_s: float, *, is_turning: bool, imu: Sequence[ImuSample]) -> None:
        """Take a frame of length ``dt_s``; of the inertial unit its last sample."""
        self.dt_s += dt_s
        if is_turning:
            self._turning_s += dt_s
        if not imu:
            self._last = None
            return
        _, ax, wz = imu[-1]
        last = self._last
        if last is not None:
            self._accelerations += last[0] + ax
            self._rates += last[1] + wz
            self._samples += 1
        self._last = (ax, wz)

    def take(self) -> Block:
        """The block so far; gathering begins anew."""
        n = self._samples
        rate = acceleration = None
        if n:
            rate, acceleration = 0.5 * self._rates / n, 0.5 * self._accelerations / n
        before, self._before = self._before, acceleration
        if acceleration is not None and before is not None:
            acceleration = 0.5 * (before + acceleration)
        block = Block(self.dt_s, self._turning_s, rate, acceleration, n)
        self._clear()
        return block
