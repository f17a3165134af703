"""Pure. The last gate before the wheels: every drive goes through it; it denies by default."""

from math import isfinite

from ccatp.config.models import LimitsConfig
from ccatp.control.kinematics import wheel_rates
from ccatp.samples import Twist, Verdict

HELD = Twist(0.0, 0.0)
# The feed-forward of the wheel lag adds T a to the speed; a tenth covers it and the feedback.
HEADROOM = 1.25


class DriveGate:
    """Turns a wanted twist into wheel rates that are finite, limited and permitted, or into zero.

    Args:
        limits: motion limits of the robot's origin.
        wheel_radius_m: r.
        wheel_base_m: L.
        max_wheel_rad_s: the robot's own limit.
        wheel_lag_s: time constant of the wheel servo; the feed-forward may step the set point by T times the
            acceleration limit.
    """

    def __init__(
        self,
        limits: LimitsConfig,
        wheel_radius_m: float,
        wheel_base_m: float,
        max_wheel_rad_s: float,
        wheel_lag_s: float,
    ) -> None:
        """Copy the limits; nothing has been driven yet."""
        self._v_max = HEADROOM * limits.v_max_m_s
        self._omega_max = HEADROOM * limits.omega_max_rad_s
        self._v_step = 2.0 * HEADROOM * limits.a_max_m_s2 * wheel_lag_s
        self._omega_step = 2.0 * HEADROOM * limits.alpha_max_rad_s2 * wheel_lag_s
        self._a, self._alpha = HEADROOM * limits.a_max_m_s2, HEADROOM * limits.alpha_max_rad_s2
        self._radius, self._base, self._max_wheel = wheel_radius_m, wheel_base_m, max_wheel_rad_s
        self._last = HELD
        self.denials = 0

    def pass_through(self, wanted: Twist, verdict: Verdict | None, dt_s: float) -> tuple[float, float]:
        """Wheel rates (right, left), rad/s, for the wanted twist, as far as it may be driven.

        Args:
            wanted: velocity asked for by the mission.
            verdict: the danger loop's verdict in force; ``None`` when there is none fresh enough.
            dt_s: time since the last drive.
        """
        v, omega = wanted.v_m_s, wanted.omega_rad_s
        if (v == 0.0 and omega == 0.0) or not self._is_permitted(v, omega, verdict):
            self._last = HELD
            return 0.0, 0.0
        last = self._last
        v = _slewed(last.v_m_s, v, self._v_step + self._a * dt_s, self._v_max)
        omega = _slewed(last.omega_rad_s, omega, self._omega_step + self._alpha * dt_s, self._omega_max)
        self._last = allowed = Twist(v, omega)
        right, left = wheel_rates(allowed, self._radius, self._base)
        if abs(right) > self._max_wheel or abs(left) > self._max_wheel:
            scale = self._max_wheel / max(abs(right), abs(left))
            right, left = right * scale, left * scale
        return right, left

    def _is_permitted(self, v: float, omega: float, verdict: Verdict | None) -> bool:
        permitted = (
            verdict is not None
            and isfinite(v)
            and isfinite(omega)
            and (v <= 0.0 or verdict.forward)
            and (v >= 0.0 or verdict.reverse)
            and (omega == 0.0 or verdict.turn)
        )
        self.denials += not permitted
        return permitted


def _slewed(last: float, wanted: float, step: float, limit: float) -> float:
    """``wanted`` clamped to the limit; away from zero it may change by ``step`` only, towards zero at once."""
    if wanted > 0.0:
        highest = last + step if last > 0.0 else step
        return min(wanted, highest, limit)
    lowest = last - step if last < 0.0 else -step
    return max(wanted, lowest, -limit)
