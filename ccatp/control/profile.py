"""Pure. Rest-to-rest set points of bounded speed and acceleration; time is an argument."""

from math import copysign, exp, sqrt
from typing import NamedTuple


class Profile(NamedTuple):
    """Trapezoidal profile from rest to rest over a signed distance (m or rad).

    It is the time-optimal motion under the two limits: accelerate, cruise where there is room, decelerate.

    Attributes:
        distance: signed distance.
        peak: largest speed reached, with the sign of the distance.
        acceleration: of the first ramp, with the sign of the distance.
        ramp_s: duration of each ramp.
        cruise_s: duration at ``peak``.
        duration_s: time from rest to rest.
    """

    distance: float
    peak: float
    acceleration: float
    ramp_s: float
    cruise_s: float
    duration_s: float

    @classmethod
    def rest_to_rest(cls, distance: float, v_max: float, a_max: float) -> "Profile":
        """Build the profile for ``distance`` under ``v_max`` and ``a_max`` (both > 0)."""
        if v_max <= 0.0 or a_max <= 0.0:
            raise ValueError(f"limits of a profile must be positive, got v_max={v_max}, a_max={a_max}")
        length = abs(distance)
        peak = min(v_max, sqrt(length * a_max))
        ramp_s = peak / a_max
        cruise_s = max((length - peak * ramp_s) / peak, 0.0) if peak > 0.0 else 0.0
        duration_s = 2.0 * ramp_s + cruise_s
        return cls(distance, copysign(peak, distance), copysign(a_max, distance), ramp_s, cruise_s, duration_s)

    def at(self, t_s: float) -> tuple[float, float]:
        """Position and velocity ``t_s`` seconds after the start, clamped to the start and the end."""
        distance, peak, acceleration, ramp_s, cruise_s, duration_s = self
        if t_s <= 0.0:
            return 0.0, 0.0
        if t_s < ramp_s:
            return 0.5 * acceleration * t_s * t_s, acceleration * t_s
        if t_s < ramp_s + cruise_s:
            return peak * (t_s - 0.5 * ramp_s), peak
        left = duration_s - t_s
        if left <= 0.0:
            return distance, 0.0
        return distance - 0.5 * acceleration * left * left, acceleration * left


def lag_feed_forward(now: float, after: float, dt_s: float, lag_s: float) -> float:
    """Set point that takes a first-order servo of time constant ``lag_s`` from ``now`` to ``after`` within ``dt_s``.

    The servo obeys w(t + dt) = u + (w(t) - u) exp(-dt/T); solved for u.
    """
    if lag_s <= 0.0:
        return after
    return now + (after - now) / (1.0 - exp(-dt_s / lag_s))


def clamped(value: float, limit: float) -> float:
    """``value`` within [-limit, limit]; what is not a number stays so."""
    if value > limit:
        return limit
    if value < -limit:
        return -limit
    return value
