"""Pure. Which readings of the inertial unit can be believed: range, agreement with the wheels, noise."""

from collections.abc import Sequence
from math import inf

from ccatp.config.models import HealthConfig
from ccatp.samples import ImuSample

_STILL_RAD_S = 0.02  # yaw rate of wheels that stand


class ImuGate:
    """Leaves out the inertial unit while its readings are impossible.

    * An acceleration or an angular rate beyond what the robot can do.
    * An angular rate that jumps away from what the wheels do. One that glides away from it, or has been elsewhere all
      along, may be right, and the wheels' encoders wrong: that is for ``ccatp.health.yaw`` to find.
    * A reading that repeats itself exactly: a unit that has shown noise at rest never does. One without noise may.

    After an impossible reading the unit stays out for the quarantine, because garbage is plausible now and then.

    Args:
        cfg: limits.

    Attributes:
        cause: why the unit is out, or empty.
        value, limit: what of it passed which limit.
        out_since_s: since when; infinite while it is believed.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        """Believed, until it says something impossible."""
        self._rate, self._share = cfg.imu_rate_rad_s, cfg.imu_rate_share
        self._largest, self._jump = cfg.imu_largest_rad_s, cfg.imu_jump_rad_s
        self._acceleration, self._identical = cfg.imu_acceleration_m_s2, cfg.identical_samples
        self._quarantine_s = cfg.imu_quarantine_s
        self.reset()

    def reset(self) -> None:
        """The clock began anew."""
        self._ax = self._wz = inf
        self._same_ax = self._same_wz = self._different = 0
        self._is_noisy = False
        self._bad_s = -inf
        self.cause, self.value, self.limit = "", 0.0, 0.0
        self.out_since_s = inf

    def admit(self, samples: Sequence[ImuSample], yaw_rad_s: float) -> Sequence[ImuSample]:
        """The samples that can be believed.

        Args:
            samples: of a frame, oldest first.
            yaw_rad_s: what the wheels say.
        """
        limit = self._rate + self._share * (yaw_rad_s if yaw_rad_s >= 0.0 else -yaw_rad_s)
        is_good = True
        for t_s, ax, wz in samples:
            if ax == self._ax or wz == self._wz or not self._is_noisy:
                self._compare(ax, wz, yaw_rad_s)
            off, jump, largest = wz - yaw_rad_s, wz - self._wz, self._largest
            self._same_ax = self._same_ax + 1 if ax == self._ax else 0
            self._same_wz = self._same_wz + 1 if wz == self._wz else 0
            self._ax, self._wz = ax, wz
            if not -largest <= wz <= largest or (not -limit <= off <= limit and not -self._jump <= jump <= self._jump):
                self._blame(t_s, "the gyroscope's rate is impossible", off, limit)
            elif not -self._acceleration <= ax <= self._acceleration:
                self._blame(t_s, "the acceleration is impossible", ax, self._acceleration)
            elif self._is_repeating():
                repeats = max(self._same_ax, self._same_wz) + 1
                self._blame(t_s, "the inertial unit repeats itself", repeats, self._identical)
            if -self._quarantine_s < t_s - self._bad_s < self._quarantine_s:
                is_good = False
            elif self.cause:
                self.cause, self.out_since_s = "", inf
        return samples if is_good else ()

    def _compare(self, ax: float, wz: float, yaw_rad_s: float) -> None:
        """Learn at rest whether the unit has noise."""
        if -_STILL_RAD_S < yaw_rad_s < _STILL_RAD_S and ax != self._ax and wz != self._wz:
            self._different += 1
            self._is_noisy = self._is_noisy or self._different >= self._identical
        else:
            self._different = 0

    def _is_repeating(self) -> bool:
        # The first reading is not a repetition.
        return self._is_noisy and max(self._same_ax, self._same_wz) >= self._identical - 1

    def _blame(self, t_s: float, cause: str, value: float, limit: float) -> None:
        self._bad_s = t_s
        if not self.cause:
            self.cause, self.value, self.limit, self.out_since_s = cause, float(value), float(limit), t_s
