"""Pure. How well the position is known: one standard deviation for every direction on the surface."""

from math import sqrt


class PositionSigma:
    """Standard deviation of the position along any one direction.

    Slip and a heading error last from one fix to the next, so their contributions grow with the travel, not with its
    root: sigma^2 = fix^2 + (slip_fraction s)^2 + (integral of sigma_theta ds)^2.

    Args:
        sigma_m: at the start, m.
        slip_fraction: part of the travel by which the wheels may err.
    """

    def __init__(self, sigma_m: float, slip_fraction: float) -> None:
        self._slip_fraction = slip_fraction
        self._known_m2 = sigma_m**2
        self._along_m = 0.0
        self._across_m = 0.0

    @property
    def sigma_m(self) -> float:
        """The standard deviation, m."""
        return sqrt(self._variance_m2)

    def travel(self, distance_m: float, heading_sigma_rad: float) -> None:
        """The robot moved on by ``distance_m`` >= 0 at a heading known to ``heading_sigma_rad``."""
        self._along_m += self._slip_fraction * distance_m
        self._across_m += heading_sigma_rad * distance_m

    def growth_m2(self, distance_m: float, heading_sigma_rad: float) -> float:
        """Variance that a displacement of ``distance_m`` alone brings in, m^2."""
        return distance_m**2 * (self._slip_fraction**2 + heading_sigma_rad**2)

    def widen(self, sigma_m: float) -> None:
        """Add an independent error of ``sigma_m``."""
        self._known_m2 += sigma_m**2

    def fuse(self, variance_m2: float) -> float:
        """Fuse a measured position of ``variance_m2`` > 0; returns its weight, 0 to 1."""
        prior = self._variance_m2
        gain = prior / (prior + variance_m2)
        self._known_m2 = gain * variance_m2
        self._along_m = self._across_m = 0.0
        return gain

    @property
    def _variance_m2(self) -> float:
        return self._known_m2 + self._along_m**2 + self._across_m**2
