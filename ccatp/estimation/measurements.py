"""Measurement vector and model of thesis eqs 2.4 and 2.12, process model, noise learned at rest, true rest."""

from collections.abc import Sequence
from math import atan2, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.config.models import LocalizerConfig, RobotConfig
from ccatp.core import FloatArray, GravitySample, ImuSample
from ccatp.estimation.state_model import Slope

V, A, THETA, OMEGA = range(4)
"""Order of the state q of thesis eq. 2.1: speed m/s, acceleration m/s^2, heading rad, rate rad/s.

The thesis prints m^2/s as the unit of the acceleration; m/s^2 is meant.
"""
STATES = 4
_CACHE_LIMIT = 256


class Stack(NamedTuple):
    """z = H q + noise with independent rows: z (m,), H (m, 4), variances R (m,)."""

    z: FloatArray
    H: FloatArray
    R: FloatArray


class MeasurementBuilder:
    """Builds z, H, R of a frame: rows in the order right wheel, left wheel, acceleration, rate (oldest first in each).

    The full model (thesis eq. 2.12) is::

        a_x     = a
        omega_R = (v + omega L / 2) / r
        omega_L = (v - omega L / 2) / r
        omega_z = omega

    Eq. 2.3 and 2.4 print theta_z with a row that picks theta; a gyroscope measures a rate, so omega_z of 2.12 holds.

    A sample taken at t_i belongs to the state q(t_i), not to q(t) at the frame's time t. Within a frame acceleration
    and rate are taken as constant, so q(t_i) = F(t_i - t) q(t) with F of eq. 2.11 and a row h becomes h F(t_i - t). The
    approximation: all process noise of the interval enters at its beginning. ``cfg`` has standard deviations of single
    samples (thesis eq. 2.17 calls sigma a variance; its table 2.1 lists standard deviations).
    """

    def __init__(self, robot: RobotConfig, cfg: LocalizerConfig) -> None:
        self._per_radius = 1.0 / robot.wheel_radius_m
        self._turn = 0.5 * robot.wheel_base_m / robot.wheel_radius_m
        self._var_ax = cfg.accelerometer_sigma_m_s2**2
        self._var_wz = cfg.gyroscope_sigma_rad_s**2
        self._bias_wz = cfg.gyroscope_bias_rad_s
        self._var_wheel = cfg.encoder_sigma_rad_s**2
        self._stacks: dict[tuple[int, int, int], Stack] = {}

    def stack(
        self,
        t_s: float,
        imu: Sequence[ImuSample],
        right: tuple[Sequence[float], Sequence[float]],
        left: tuple[Sequence[float], Sequence[float]],
    ) -> Stack:
        """Stack of a frame with any number of samples; of each wheel the times (s) and the rates (rad/s).

        The arrays are work space: they hold until the next call.
        """
        stack = self._of_size(len(right[0]), len(left[0]), len(imu))
        z, H, _ = stack
        wheels, n = len(right[0]) + len(left[0]), len(imu)
        for i, (t, rate) in enumerate(zip((*right[0], *left[0]), (*right[1], *left[1]), strict=True)):
            H[i, A] = (t - t_s) * self._per_radius
            z[i] = rate
        for i, (_, ax, wz) in enumerate(imu, wheels):
            z[i] = ax
            z[i + n] = wz - self._bias_wz
        return stack

    def _of_size(self, right: int, left: int, imu: int) -> Stack:
        found = self._stacks.get((right, left, imu))
        if found is not None:
            return found
        if len(self._stacks) >= _CACHE_LIMIT:
            self._stacks.clear()
        wheels = right + left
        m = wheels + 2 * imu
        H = np.zeros((m, STATES))
        H[:wheels, V] = self._per_radius
        H[:right, OMEGA] = self._turn
        H[right:wheels, OMEGA] = -self._turn
        H[wheels : wheels + imu, A] = 1.0
        H[wheels + imu :, OMEGA] = 1.0
        R = np.empty(m)
        R[:wheels] = self._var_wheel
        R[wheels : wheels + imu] = self._var_ax
        R[wheels + imu :] = self._var_wz
        found = self._stacks[right, left, imu] = Stack(np.zeros(m), H, R)
        return found


class ConstantAcceleration:
    """The process model: F of thesis eq. 2.11 and its noise, white jerk and white angular acceleration.

    The noise of an interval enters as one impulse at its beginning, so that within the interval acceleration and rate
    are constant, as ``MeasurementBuilder`` takes them: an impulse of variance q dt in the rate of change, carried by F
    to the end, gives q dt [[dt^2, dt], [dt, 1]] for (v, a) and for (theta, omega). The heading then moves by omega dt
    with the rate measured *during* the interval, the midpoint rule. Noise spread over the interval
    (q [[dt^3/3, dt^2/2], [dt^2/2, dt]]) would contradict those rows: the heading would lag by half a frame in a turn,
    and its variance would grow by q dt^3/12 per frame however well the rate is measured. The thesis gives no Q; the
    densities are in (m/s^3)^2 s and (rad/s^2)^2 s.
    """

    def __init__(self, cfg: LocalizerConfig) -> None:
        self._jerk = cfg.jerk_density_m2_s5
        self._alpha = cfg.angular_acceleration_density_rad2_s3
        self._F = np.eye(STATES)
        self._Q = np.zeros((STATES, STATES))

    def over(self, dt_s: float) -> tuple[FloatArray, FloatArray]:
        """F and Q (4, 4) over dt_s; work space that holds until the next call."""
        F, Q = self._F, self._Q
        F[V, A] = F[THETA, OMEGA] = dt_s
        for i, density in ((V, self._jerk), (THETA, self._alpha)):
            impulse = density * dt_s
            Q[i + 1, i + 1] = impulse
            Q[i, i + 1] = Q[i + 1, i] = impulse * dt_s
            Q[i, i] = impulse * dt_s * dt_s
        return F, Q


_BLOCK = 15
_MEMORY = 0.03  # weight of a new block: some thirty blocks are remembered


class NoiseFloor:
    """White-noise variance of a single sample, from means over blocks of a standing robot's samples.

    A vibration does not drift: within a block it averages out faster than white noise does. So the variance of block
    means, times the block's length, is the part that the integral of the signal will feel.
    """

    def __init__(self, variance: float) -> None:
        self.variance = variance
        self._sum = 0.0
        self._count = 0
        self._before: float | None = None

    def restart(self) -> None:
        """Another rest begins: a block does not reach across motion. A bias hardly moves from one rest to the next."""
        self._sum, self._count = 0.0, 0

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
        self._sum, self._count, self._before = 0.0, 0, mean


class ZeroVelocityReading(NamedTuple):
    """Means over a rest; ``bearing_rad``: direction of gravity's part along the surface against the robot's x axis."""

    samples: int
    rate_rad_s: float
    acceleration_m_s2: float
    gravity_count: int
    bearing_rad: float


class ZeroVelocityDetector:
    """Counts frames without wheel motion and collects the inertial unit's samples at rest.

    A servo that coasts to its set point passes every threshold long before it stands. Only after ``rest_after_s``
    without motion, several of its time constants, the robot counts as resting. ``count``: samples collected;
    ``still_s``: time without motion.
    """

    def __init__(self, rest_after_s: float, gyro: NoiseFloor, accelerometer: NoiseFloor) -> None:
        self._rest_after_s = rest_after_s
        self._gyro, self._accelerometer = gyro, accelerometer
        self.still_s = 0.0
        self.is_resting = False
        self._clear()

    def _clear(self) -> None:
        self.count = self._gravity_count = 0
        self._rate = self._acceleration = self._gx = self._gy = 0.0

    def moved(self) -> None:
        """The wheels turned."""
        self.still_s, self.is_resting = 0.0, False
        self._clear()

    def stood(self, dt_s: float) -> bool:
        """The wheels stood for a frame; true when rest begins with it."""
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
        """The means so far; collecting begins again."""
        n = max(self.count, 1)
        found = ZeroVelocityReading(
            self.count, self._rate / n, self._acceleration / n, self._gravity_count, atan2(self._gy, self._gx)
        )
        self._clear()
        return found


def heading_from_gravity(bearing_rad: float, slope: Slope) -> float:
    """Deck heading of a robot that sees the downhill direction, not zero, at ``bearing_rad`` against its x axis."""
    fx, fy = slope[0], slope[1]
    s2 = 1.0 + fx * fx
    s, norm = sqrt(s2), sqrt(s2 + fy * fy)
    # Components along e1 = (1/s, 0) and e2 = (-fx fy/(W s), s/W) of the deck plane.
    along_2 = slope.gy * norm / s
    along_1 = (slope.gx + along_2 * fx * fy / (norm * s)) * s
    return atan2(along_2, along_1) - bearing_rad
