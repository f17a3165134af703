"""A robot at rest: detection, noise of the sensors, means of the inertial unit, heading from gravity."""

from collections.abc import Sequence
from math import atan2, sqrt
from typing import NamedTuple

from ccatp.core import GravitySample, ImuSample
from ccatp.estimation.odometry import Slope

_BLOCK = 15
_MEMORY = 0.03  # weight of a new block; the mean covers about thirty blocks


class NoiseFloor:
    """White-noise variance of a single sample, from means over blocks of samples at rest.

    Within a block a vibration averages out faster than white noise. So the variance of block means, times the block's
    length, is the part of the noise that affects the integral of the signal.
    """

    def __init__(self, variance: float) -> None:
        self.variance = variance
        self._sum = 0.0
        self._count = 0
        self._before: float | None = None

    def restart(self) -> None:
        """Begin another rest with a new block. The last mean is kept, because the bias hardly changes between rests."""
        self._sum = 0.0
        self._count = 0

    def add(self, value: float) -> None:
        """Take one sample at rest."""
        self._sum += value
        self._count += 1
        if self._count < _BLOCK:
            return
        mean = self._sum / _BLOCK
        if self._before is not None:
            # The variance of a difference is twice that of a mean.
            found = 0.5 * _BLOCK * (mean - self._before) ** 2
            self.variance += _MEMORY * (found - self.variance)
        self._sum = 0.0
        self._count = 0
        self._before = mean


class ZeroVelocityReading(NamedTuple):
    """Means over a rest; ``bearing_rad``: downhill direction relative to the robot's x axis."""

    samples: int
    rate_rad_s: float
    acceleration_m_s2: float
    gravity_count: int
    bearing_rad: float


class ZeroVelocityDetector:
    """Measures the time without wheel motion, and collects the inertial samples at rest.

    A wheel that runs down is below every threshold long before it stands. So the robot counts as resting only after
    ``rest_after_s`` without motion, several time constants of the servo. ``count``: samples collected; ``still_s``:
    time without motion.
    """

    def __init__(self, rest_after_s: float, gyro: NoiseFloor, accelerometer: NoiseFloor) -> None:
        self._rest_after_s = rest_after_s
        self._gyro = gyro
        self._accelerometer = accelerometer
        self.still_s = 0.0
        self.is_resting = False
        self._clear()

    def _clear(self) -> None:
        self.count = self._gravity_count = 0
        self._rate = self._acceleration = self._gx = self._gy = 0.0

    def moved(self) -> None:
        """Take a frame in which the wheels turned."""
        self.still_s = 0.0
        self.is_resting = False
        self._clear()

    def stood(self, dt_s: float) -> bool:
        """Take a frame in which the wheels stood; returns whether rest begins with it."""
        self.still_s += dt_s
        if self.is_resting or self.still_s < self._rest_after_s:
            return False
        self.is_resting = True
        self._gyro.restart()
        self._accelerometer.restart()
        return True

    def add(self, imu: Sequence[ImuSample], gravity: GravitySample | None) -> None:
        """Take a frame's samples at rest."""
        for _, ax, wz in imu:
            self.count += 1
            self._rate += wz
            self._acceleration += ax
            self._gyro.add(wz)
            self._accelerometer.add(ax)
        if gravity is not None:
            self._gravity_count += 1
            self._gx += gravity[1]
            self._gy += gravity[2]

    def take(self) -> ZeroVelocityReading:
        """The means so far; the next collection begins."""
        n = max(self.count, 1)
        found = ZeroVelocityReading(
            self.count, self._rate / n, self._acceleration / n, self._gravity_count, atan2(self._gy, self._gx)
        )
        self._clear()
        return found


def heading_from_gravity(bearing_rad: float, slope: Slope) -> float:
    """Deck heading of a robot with the downhill direction (not zero) at ``bearing_rad`` from its x axis."""
    fx, fy = slope[0], slope[1]
    s2 = 1.0 + fx * fx
    s, norm = sqrt(s2), sqrt(s2 + fy * fy)
    # Components along e1 = (1/s, 0) and e2 = (-fx fy/(W s), s/W) of the deck plane.
    along_2 = slope.gy * norm / s
    along_1 = (slope.gx + along_2 * fx * fy / (norm * s)) * s
    return atan2(along_2, along_1) - bearing_rad
