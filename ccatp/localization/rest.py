"""Pure. True rest: when the wheels really stand, and what the inertial unit says meanwhile."""

from collections.abc import Sequence
from math import atan2, sqrt
from typing import NamedTuple

from ccatp.localization.noise_floor import NoiseFloor
from ccatp.localization.terrain import Slope
from ccatp.samples import GravitySample, ImuSample


class RestReading(NamedTuple):
    """Means over a rest.

    Attributes:
        samples: of the inertial unit.
        rate_rad_s, acceleration_m_s2: their means.
        gravity_count: samples of gravity.
        bearing_rad: direction of gravity's part along the surface against the robot's x axis.
    """

    samples: int
    rate_rad_s: float
    acceleration_m_s2: float
    gravity_count: int
    bearing_rad: float


class RestWatch:
    """Counts frames without wheel motion and collects the inertial unit's samples at rest.

    Slow is not still: a servo that coasts to its set point passes every threshold long before it stands. Only after
    ``rest_after_s`` without motion, several of its time constants, the robot counts as resting.

    Args:
        rest_after_s: standstill of the wheels before it counts.
        gyro, accelerometer: learn the sensors' noise.
    """

    def __init__(self, rest_after_s: float, gyro: NoiseFloor, accelerometer: NoiseFloor) -> None:
        self._rest_after_s = rest_after_s
        self._gyro, self._accelerometer = gyro, accelerometer
        self._still_s = 0.0
        self.is_resting = False
        self._clear()

    def _clear(self) -> None:
        self._count = self._gravity_count = 0
        self._rate = self._acceleration = self._gx = self._gy = 0.0

    def moved(self) -> None:
        """The wheels turned."""
        self._still_s, self.is_resting = 0.0, False
        self._clear()

    def stood(self, dt_s: float) -> bool:
        """The wheels stood for a frame; true when rest begins with it."""
        self._still_s += dt_s
        if self.is_resting or self._still_s < self._rest_after_s:
            return False
        self.is_resting = True
        self._gyro.restart()
        self._accelerometer.restart()
        return True

    def add(self, imu: Sequence[ImuSample], gravity: GravitySample | None) -> None:
        """Take a frame's samples at rest."""
        for _, ax, wz in imu:
            self._count += 1
            self._rate += wz
            self._acceleration += ax
            self._gyro.add(wz)
            self._accelerometer.add(ax)
        if gravity is not None:
            self._gravity_count += 1
            self._gx += gravity[1]
            self._gy += gravity[2]

    @property
    def count(self) -> int:
        """Samples collected."""
        return self._count

    def take(self) -> RestReading:
        """The means so far; collecting begins anew."""
        n = max(self._count, 1)
        found = RestReading(
            self._count, self._rate / n, self._acceleration / n, self._gravity_count, atan2(self._gy, self._gx)
        )
        self._clear()
        return found


def heading_from_gravity(bearing_rad: float, slope: Slope) -> float:
    """Deck heading of a robot that sees the downhill direction at ``bearing_rad`` against its x axis.

    Args:
        bearing_rad: as measured.
        slope: of the surface under it; its downhill direction must not be zero.
    """
    fx, fy = slope[0], slope[1]
    s2 = 1.0 + fx * fx
    s, norm = sqrt(s2), sqrt(s2 + fy * fy)
    # Components along e1 = (1/s, 0) and e2 = (-fx fy/(W s), s/W) of the deck plane.
    along_2 = slope.gy * norm / s
    along_1 = (slope.gx + along_2 * fx * fy / (norm * s)) * s
    return atan2(along_2, along_1) - bearing_rad
