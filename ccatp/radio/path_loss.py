"""Pure. The log-distance model of signal strength: levels from distances, distances from levels, with their spread."""

from dataclasses import dataclass
from math import exp, expm1, log, log10, sqrt
from typing import NamedTuple

_NEPER_PER_DB = log(10.0) / 10.0


class RangeEstimate(NamedTuple):
    """A distance with its standard deviation, both m."""

    range_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True)
class PathLoss:
    """z = P_ref - 10 eta log10(r / 1 m) + n, n ~ N(0, sigma^2): Hevrdejs and Knoll 2017, eq. 4; Auth and Hovey, 2.9.

    Attributes:
        reference_dbm: P_ref, at 1 m.
        exponent: eta.
        sigma_db: sigma.
    """

    reference_dbm: float
    exponent: float
    sigma_db: float

    def level_dbm(self, range_m: float) -> float:
        """Expected level at a distance.

        Raises:
            ValueError: the distance is not positive.
        """
        if range_m <= 0.0:
            raise ValueError(f"range of {range_m} m has no level; it must be positive")
        return self.reference_dbm - 10.0 * self.exponent * log10(range_m)

    def median_range_m(self, level_dbm: float) -> float:
        """The inverse of the model, 2017: r = 10^((|z| - |P_ref|) / (10 eta)). Half of such ranges are too long."""
        return float(10.0 ** ((self.reference_dbm - level_dbm) / (10.0 * self.exponent)))

    @property
    def log_sigma(self) -> float:
        """Standard deviation s of ln r from one level: sigma ln(10) / (10 eta)."""
        return self.sigma_db * _NEPER_PER_DB / self.exponent

    def range_from(self, level_dbm: float, count: int = 1) -> RangeEstimate:
        """Distance from a level, without bias.

        Noise that is normal in dB is log-normal in m: the inverse of the model is too long by exp(s^2 / 2) on the
        average. That factor is taken off; what is left has the variance r^2 (exp(s^2) - 1).

        Args:
            level_dbm: the level, or the mean of several with independent noise.
            count: of the levels in the mean.

        Raises:
            ValueError: no level at all.
        """
        if count < 1:
            raise ValueError(f"mean of {count} levels has no range; give at least one")
        s2 = self.log_sigma**2 / count
        range_m = self.median_range_m(level_dbm) * exp(-0.5 * s2)
        return RangeEstimate(range_m, range_m * sqrt(expm1(s2)))
