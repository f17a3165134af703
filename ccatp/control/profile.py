"""Trapezoidal profile from rest to rest."""

from math import copysign, sqrt
from typing import NamedTuple


class Profile(NamedTuple):
    """Trapezoidal profile from rest to rest over a signed distance (m or rad), time-optimal under both limits.

    ``peak`` is the largest speed, signed as the distance; ``cruise_s`` the duration at it.
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
