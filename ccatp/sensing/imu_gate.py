"""Plausibility of the inertial unit's readings."""

from collections.abc import Sequence
from math import inf

from ccatp.config.models import HealthConfig
from ccatp.core import ImuSample
from ccatp.rest import ROBOT_TURNS_RAD_S


class ImuGate:
    """Rejects the inertial unit while its readings are impossible, and for a quarantine time afterwards.

    Impossible are: an acceleration or rate that the robot cannot reach; a rate that jumps away from that of the wheels
    (``ccatp.safety.wheel_monitor`` judges a slow drift); exact repetition by a unit that has shown noise at rest.
    Samples that arrive late, with their own times, are not used either: they do not show the present rate.
    While the unit is used, ``cause`` is empty and ``out_since_s`` infinite.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        self._rate = cfg.imu_rate_rad_s
        self._share = cfg.imu_rate_share
        self._largest = cfg.imu_largest_rad_s
        self._jump = cfg.imu_jump_rad_s
        self._acceleration = cfg.imu_acceleration_m_s2
        self._identical = cfg.identical_samples
        self._late_s = cfg.turn_delay_s
        self._quarantine_s = cfg.imu_quarantine_s
        self.reset()

    def reset(self) -> None:
        """The clock was reset."""
        self._ax = self._wz = inf
        self._same_ax = self._same_wz = self._different = 0
        self._is_noisy = False
        self._bad_s = -inf
        self.cause = ""
        self.value = 0.0
        self.limit = 0.0
        self.out_since_s = inf

    def admit(self, samples: Sequence[ImuSample], yaw_rad_s: float, late_s: float) -> Sequence[ImuSample]:
        """The usable samples of a frame, oldest first: all or none.

        ``late_s``: time from the newest sample to the frame before this one; negative where a sample is in time.
        """
        limit = self._rate + self._share * (yaw_rad_s if yaw_rad_s >= 0.0 else -yaw_rad_s)
        is_good = True
        for t_s, ax, wz in samples:
            if ax == self._ax or wz == self._wz or not self._is_noisy:
                self._compare(ax, wz, yaw_rad_s)
            off, jump, largest = wz - yaw_rad_s, wz - self._wz, self._largest
            # The first reading is not a repetition.
            self._same_ax = self._same_ax + 1 if ax == self._ax else 0
            self._same_wz = self._same_wz + 1 if wz == self._wz else 0
            self._ax = ax
            self._wz = wz
            if not -largest <= wz <= largest or (not -limit <= off <= limit and not -self._jump <= jump <= self._jump):
                self._blame(t_s, "the gyroscope's rate is impossible", off, limit)
            elif not -self._acceleration <= ax <= self._acceleration:
                self._blame(t_s, "the acceleration is impossible", ax, self._acceleration)
            elif late_s > self._late_s:
                self._blame(t_s, "the inertial unit's samples arrive late", late_s, self._late_s)
            elif self._is_noisy and max(self._same_ax, self._same_wz) >= self._identical - 1:
                repeats = max(self._same_ax, self._same_wz) + 1
                self._blame(t_s, "the inertial unit repeats itself", repeats, self._identical)
            if -self._quarantine_s < t_s - self._bad_s < self._quarantine_s:
                is_good = False
            elif self.cause:
                self.cause = ""
                self.out_since_s = inf
        return samples if is_good else ()

    def _compare(self, ax: float, wz: float, yaw_rad_s: float) -> None:
        if -ROBOT_TURNS_RAD_S < yaw_rad_s < ROBOT_TURNS_RAD_S and ax != self._ax and wz != self._wz:
            self._different += 1
            self._is_noisy = self._is_noisy or self._different >= self._identical
        else:
            self._different = 0

    def _blame(self, t_s: float, cause: str, value: float, limit: float) -> None:
        self._bad_s = t_s
        if not self.cause:
            self.cause = cause
            self.value = float(value)
            self.limit = float(limit)
            self.out_since_s = t_s
