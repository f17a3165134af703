"""Pure. Rest-to-rest set points of bounded speed and acceleration; time is an argument."""

from dataclasses import dataclass
from math import copysign, exp, sqrt


@dataclass(frozen=True, slots=True)
class Profile:
    """Trapezoidal profile from rest to rest over a signed distance (m or rad).

    It is the time-optimal motion under the two limits: accelerate, cruise where there is room, decelerate.

    Attributes:
        distance: signed distance.
        peak: largest speed reached, >= 0.
        acceleration: magnitude of the acceleration.
        ramp_s: duration of each ramp.
        cruise_s: duration at ``peak``.
    """

    distance: float
    peak: float
    acceleration: float
    ramp_s: float
    cruise_s: float

    @classmethod
    def rest_to_rest(cls, distance: float, v_max: float, a_max: float) -> "Profile":
        """Build the profile for ``distance`` under ``v_max`` and ``a_max`` (both > 0)."""
        if v_max <= 0.0 or a_max <= 0.0:
            raise ValueError(f"limits of a profile must be positive, got v_max={v_max}, a_max={a_max}")
        length = abs(distance)
        peak = min(v_max, sqrt(length * a_max))
        ramp_s = peak / a_max
        cruise_s = (length - peak * ramp_s) / peak if peak > 0.0 else 0.0
        return cls(distance, peak, a_max, ramp_s, max(cruise_s, 0.0))

    @property
    def duration_s(self) -> float:
        """Time from rest to rest."""
        return 2.0 * self.ramp_s + self.cruise_s

    def at(self, t_s: float) -> tuple[float, float]:
        """Position and velocity ``t_s`` seconds after the start, clamped to the start and the end."""
        sign = copysign(1.0, self.distance)
        if t_s <= 0.0:
            return 0.0, 0.0
        if t_s < self.ramp_s:
            return sign * 0.5 * self.acceleration * t_s * t_s, sign * self.acceleration * t_s
        if t_s < self.ramp_s + self.cruise_s:
            return sign * self.peak * (t_s - 0.5 * self.ramp_s), sign * self.peak
        left = self.duration_s - t_s
        if left <= 0.0:
            return self.distance, 0.0
        return self.distance - sign * 0.5 * self.acceleration * left * left, sign * self.acceleration * left


def lag_feed_forward(now: float, after: float, dt_s: float, lag_s: float) -> float:
    """Set point that takes a first-order servo of time constant ``lag_s`` from ``now`` to ``after`` within ``dt_s``.

    The servo obeys w(t + dt) = u + (w(t) - u) exp(-dt/T); solved for u.
    """
    if lag_s <= 0.0:
        return after
    return now + (after - now) / (1.0 - exp(-dt_s / lag_s))
