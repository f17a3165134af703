"""Motion sums of wheels and gyroscope over frames, and which readings of the inertial unit are plausible."""

from collections import deque
from collections.abc import Sequence
from math import inf
from typing import NamedTuple

from ccatp.config.models import HealthConfig, RobotConfig
from ccatp.core import ImuSample, WheelSample


class MotionSum(NamedTuple):
    """Running sums since the start; ``turned_rad`` is the turn by the gyroscope, where it was plausible."""

    t_s: float
    right_m: float
    left_m: float
    turned_rad: float


class SlidingWindow:
    """The change of running sums over a time."""

    __slots__ = ("_kept", "_span_s")

    def __init__(self, span_s: float) -> None:
        self._span_s = span_s - 1e-6
        self._kept: deque[MotionSum] = deque()

    def reset(self) -> None:
        """Empty again."""
        self._kept.clear()

    def push(self, now: MotionSum) -> MotionSum | None:
        """Take the newest sums; the change over the span (``t_s`` is its length), ``None`` while it is shorter."""
        kept, since_s = self._kept, now[0] - self._span_s
        kept.append(now)
        while len(kept) > 1 and kept[1][0] <= since_s:
            kept.popleft()
        t_s, right_m, left_m, turned_rad = kept[0]
        if t_s > since_s:
            return None
        return MotionSum(now[0] - t_s, now[1] - right_m, now[2] - left_m, now[3] - turned_rad)


class WheelMeans:
    """Mean wheel rates over a frame (``None`` without samples), and the yaw rate, smoothed over some frames."""

    _SMOOTH_S = 0.05

    __slots__ = ("_limit_rad_s", "_per_base", "left_rad_s", "right_rad_s", "yaw_rad_s")

    def __init__(self, robot: RobotConfig) -> None:
        self._per_base = robot.wheel_radius_m / robot.wheel_base_m
        self._limit_rad_s = largest_rate_rad_s(robot)
        self.right_rad_s: float | None = 0.0
        self.left_rad_s: float | None = 0.0
        self.yaw_rad_s = 0.0

    def take(self, samples: Sequence[WheelSample], dt_s: float) -> None:
        """Take a frame's samples; ``dt_s`` after the last frame."""
        if not samples:
            self.right_rad_s = self.left_rad_s = None
            return
        _, right, left = zip(*samples)  # noqa: B905 - of one length; checking that takes longer
        count = len(right)
        try:
            right_rad_s, left_rad_s = sum(right) / count, sum(left) / count
        except TypeError:  # a wheel gave no sample
            self._take_some(right, left)
            return
        limit = self._limit_rad_s
        if not (-limit <= right_rad_s <= limit and -limit <= left_rad_s <= limit):
            self._take_some(right, left)
            return
        self.right_rad_s, self.left_rad_s = right_rad_s, left_rad_s
        share = dt_s / (self._SMOOTH_S + dt_s)
        self.yaw_rad_s += share * (self._per_base * (right_rad_s - left_rad_s) - self.yaw_rad_s)

    def _take_some(self, right: Sequence[float | None], left: Sequence[float | None]) -> None:
        self.right_rad_s, self.left_rad_s = self._mean(right), self._mean(left)

    def _mean(self, rates: Sequence[float | None]) -> float | None:
        limit = self._limit_rad_s
        usable = [rate for rate in rates if rate is not None and -limit <= rate <= limit]
        return sum(usable) / len(usable) if usable else None


def as_standing(samples: Sequence[WheelSample]) -> list[WheelSample]:
    """What the encoders would say of wheels that stand: for a robot that is held and whose encoders are in doubt."""
    return [WheelSample(sample.t_s, 0.0, 0.0) for sample in samples]


def largest_rate_rad_s(robot: RobotConfig) -> float:
    """No wheel turns faster, rad/s: an encoder that says so is wrong. A count more per sample is no contradiction."""
    return 3.0 * robot.max_wheel_rad_s


_STILL_RAD_S = 0.02  # yaw rate of wheels that stand


class ImuGate:
    """Leaves out the inertial unit while its readings are impossible, and for a quarantine afterwards.

    Impossible: an acceleration or a rate beyond what the robot can do; a rate that jumps away from the wheels' (of one
    that drifts away ``ccatp.safety.wheel_monitors`` decides); exact repetition by a unit that has shown noise at rest.
    ``cause`` is empty and ``out_since_s`` infinite while the unit is used.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        self._rate, self._share = cfg.imu_rate_rad_s, cfg.imu_rate_share
        self._largest, self._jump = cfg.imu_largest_rad_s, cfg.imu_jump_rad_s
        self._acceleration, self._identical = cfg.imu_acceleration_m_s2, cfg.identical_samples
        self._quarantine_s = cfg.imu_quarantine_s
        self.reset()

    def reset(self) -> None:
        """The clock was reset."""
        self._ax = self._wz = inf
        self._same_ax = self._same_wz = self._different = 0
        self._is_noisy = False
        self._bad_s = -inf
        self.cause, self.value, self.limit = "", 0.0, 0.0
        self.out_since_s = inf

    def admit(self, samples: Sequence[ImuSample], yaw_rad_s: float) -> Sequence[ImuSample]:
        """The usable ones of a frame's samples, oldest first: all or none."""
        limit = self._rate + self._share * (yaw_rad_s if yaw_rad_s >= 0.0 else -yaw_rad_s)
        is_good = True
        for t_s, ax, wz in samples:
            if ax == self._ax or wz == self._wz or not self._is_noisy:
                self._compare(ax, wz, yaw_rad_s)
            off, jump, largest = wz - yaw_rad_s, wz - self._wz, self._largest
            # The first reading is not a repetition.
            self._same_ax = self._same_ax + 1 if ax == self._ax else 0
            self._same_wz = self._same_wz + 1 if wz == self._wz else 0
            self._ax, self._wz = ax, wz
            if not -largest <= wz <= largest or (not -limit <= off <= limit and not -self._jump <= jump <= self._jump):
                self._blame(t_s, "the gyroscope's rate is impossible", off, limit)
            elif not -self._acceleration <= ax <= self._acceleration:
                self._blame(t_s, "the acceleration is impossible", ax, self._acceleration)
            elif self._is_noisy and max(self._same_ax, self._same_wz) >= self._identical - 1:
                repeats = max(self._same_ax, self._same_wz) + 1
                self._blame(t_s, "the inertial unit repeats itself", repeats, self._identical)
            if -self._quarantine_s < t_s - self._bad_s < self._quarantine_s:
                is_good = False
            elif self.cause:
                self.cause, self.out_since_s = "", inf
        return samples if is_good else ()

    def _compare(self, ax: float, wz: float, yaw_rad_s: float) -> None:
        if -_STILL_RAD_S < yaw_rad_s < _STILL_RAD_S and ax != self._ax and wz != self._wz:
            self._different += 1
            self._is_noisy = self._is_noisy or self._different >= self._identical
        else:
            self._different = 0

    def _blame(self, t_s: float, cause: str, value: float, limit: float) -> None:
        self._bad_s = t_s
        if not self.cause:
            self.cause, self.value, self.limit, self.out_since_s = cause, float(value), float(limit), t_s
