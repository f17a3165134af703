"""Log-distance model of signal strength, and its calibration from pairs of distance and level."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf, isnan, log, log10, nan, sqrt
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri, stdtrit

from ccatp.core import FloatArray

_NEPER_PER_DB = log(10.0) / 10.0


class PathLoss(NamedTuple):
    """z = P_ref - 10 eta log10(r / 1 m) + n, n ~ N(0, sigma^2): Hevrdejs and Knoll 2017, eq. 4; Auth and Hovey, 2.9."""

    reference_dbm: float  # P_ref, at 1 m
    exponent: float
    sigma_db: float  # sigma

    def level_dbm(self, range_m: float) -> float:
        """Expected level at a distance. Raises ValueError: the distance is not positive."""
        if range_m <= 0.0:
            raise ValueError(f"range of {range_m} m has no level; it must be positive")
        return self.reference_dbm - 10.0 * self.exponent * log10(range_m)

    def median_range_m(self, level_dbm: float) -> float:
        """Inverse of the model (2017): r = 10^((|z| - |P_ref|) / (10 eta)). Half of such ranges are too long."""
        return float(10.0 ** ((self.reference_dbm - level_dbm) / (10.0 * self.exponent)))

    @property
    def log_sigma(self) -> float:
        """Standard deviation s of ln r from one level: sigma ln(10) / (10 eta)."""
        return self.sigma_db * _NEPER_PER_DB / self.exponent


LEAST_EXPONENT = 0.1  # free space has 2; levels that hardly fall give no distance
LEAST_PLACES = 3  # two unknowns and one degree of freedom for the spread
_PLAUSIBLE_EXPONENT = (1.0, 6.0)  # a corridor acts as a waveguide and has 1.2; a building with walls has up to 6
_LOUDEST_DBM = -10.0  # 20 dBm transmitted are -20 dBm at 1 m in free space, at 2.4 GHz
_EXACT_DB = 1e-6
_FAR_OFF = 3.5  # studentised residual above which a place is reported


class PathLossError(ValueError):
    """Pairs to which no path loss can be fitted; the message contains the numbers."""


class LevelPair(NamedTuple):
    """One reading of a level."""

    distance_m: float
    level_dbm: float
    place: tuple[float, float] | None = None  # readings without a place and with the same distance count as one place


@dataclass(frozen=True, slots=True)
class PathLossFit:
    """Path loss z = P_ref - 10 eta log10(r) with the covariance of its two parameters."""

    reference_dbm: float
    exponent: float
    covariance: FloatArray  # of both, shape (2, 2)
    sigma_db: float  # standard deviation of the places' mean levels about the line
    white_sigma_db: float  # of repeated readings at one place; NaN if there are none
    shadowing_sigma_db: float  # of the constant error of a place: sigma without the white part; NaN likewise
    places: int
    readings: int
    residuals_db: FloatArray  # mean level minus line of each place, shape (places,)
    distances_m: FloatArray  # of the places, shape (places,)

    @property
    def path_loss(self) -> PathLoss:
        """The model, with ``sigma_db`` as noise."""
        return PathLoss(self.reference_dbm, self.exponent, self.sigma_db)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of sigma."""
        return self.places - 2

    def half_widths(self, confidence: float) -> tuple[float, float]:
        """Half widths of the two-sided confidence intervals of P_ref, dB, and eta (Student's t)."""
        quantile = float(stdtrit(self.freedom, 0.5 + 0.5 * confidence))
        return quantile * sqrt(self.covariance[0, 0]), quantile * sqrt(self.covariance[1, 1])

    def sigma_interval_db(self, confidence: float) -> tuple[float, float]:
        """Confidence interval of sigma (chi-squared)."""
        tail = 0.5 * (1.0 - confidence)
        low, high = (float(chdtri(self.freedom, share)) for share in (tail, 1.0 - tail))
        square = self.freedom * self.sigma_db**2
        return sqrt(square / low), sqrt(square / high)

    def data(self, confidence: float) -> dict[str, Any]:
        """The calibration for JSON, with confidence intervals; parts of sigma are None if no reading was repeated."""
        reference, exponent = self.half_widths(confidence)
        low, high = self.sigma_interval_db(confidence)
        is_repeated = not isnan(self.white_sigma_db)
        return {
            "reference_dbm": round(self.reference_dbm, 4),
            "reference_half_width_db": round(reference, 4),
            "exponent": round(self.exponent, 5),
            "exponent_half_width": round(exponent, 5),
            "sigma_db": round(self.sigma_db, 4),
            "sigma_low_db": round(low, 4),
            "sigma_high_db": round(high, 4),
            "white_sigma_db": round(self.white_sigma_db, 4) if is_repeated else None,
            "shadowing_sigma_db": round(self.shadowing_sigma_db, 4) if is_repeated else None,
            "range_log_sigma": round(self.path_loss.log_sigma, 5),
            "confidence": confidence,
            "places": self.places,
            "readings": self.readings,
        }

    def predicted(self, distances_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and scale, both (n,), of Student's t with ``freedom`` for the level of a new place at distances (n,)."""
        rows = np.column_stack([np.ones(distances_m.size), -10.0 * np.log10(distances_m)])
        mean = rows @ (self.reference_dbm, self.exponent)
        scale = np.sqrt(self.sigma_db**2 + np.einsum("ij,jk,ik->i", rows, self.covariance, rows))
        return mean, scale

    def doubts(self) -> list[str]:
        """A warning for each implausible parameter, and for each outlier."""
        found = []
        low, high = _PLAUSIBLE_EXPONENT
        if not low <= self.exponent <= high:
            found.append(
                f"exponent {self.exponent:.2f} is outside {low:g} to {high:g}: are the distances in metres, "
                "and do the levels belong to them?"
            )
        if self.reference_dbm > _LOUDEST_DBM:
            found.append(
                f"reference level {self.reference_dbm:.1f} dBm is above {_LOUDEST_DBM:g} dBm, more than "
                "a radio of 20 dBm is received with: are the distances in metres?"
            )
        if self.sigma_db < _EXACT_DB:
            found.append("levels lie on a line exactly: they were computed, not measured, and the widths mean nothing")
        for distance_m, residual_db, size in zip(self.distances_m, self.residuals_db, self._studentised(), strict=True):
            if abs(size) > _FAR_OFF:
                found.append(f"level at {distance_m:g} m is {residual_db:+.1f} dB off the line; look at it again")
        return found

    def _studentised(self) -> FloatArray:
        rows = np.column_stack([np.ones(self.places), -10.0 * np.log10(self.distances_m)])
        leverage = np.einsum("ij,ji->i", rows, np.linalg.pinv(rows))
        square = self.residuals_db**2 / np.maximum(1.0 - leverage, 1e-9)
        rest = (self.freedom * self.sigma_db**2 - square) / max(self.freedom - 1, 1)
        return np.asarray(np.sign(self.residuals_db) * np.sqrt(square / np.maximum(rest, 1e-9)))


def fit_path_loss(pairs: Iterable[LevelPair]) -> PathLossFit:
    """Least squares line of level over -10 log10(distance).

    Every place counts once, with the mean of its readings, because readings at one place have the same shadowing error.
    Raises PathLossError: fewer than three different distances, a distance that is not positive, a value that is not
    finite, or levels that do not fall with distance.
    """
    by_place: dict[tuple[float, tuple[float, float] | None], list[float]] = {}
    for pair in pairs:
        if not (0.0 < pair.distance_m < inf and abs(pair.level_dbm) < inf):
            raise PathLossError(f"pair of {pair.distance_m:g} m and {pair.level_dbm:g} dBm cannot be used")
        by_place.setdefault((pair.distance_m, pair.place), []).append(pair.level_dbm)
    distances = np.array([distance_m for distance_m, _ in by_place])
    if (different := np.unique(distances).size) < LEAST_PLACES:
        raise PathLossError(f"{different} different distances, at least {LEAST_PLACES} needed; measure at more")
    levels = np.array([np.mean(group) for group in by_place.values()])
    rows = np.column_stack([np.ones(distances.size), -10.0 * np.log10(distances)])
    normal = np.linalg.inv(rows.T @ rows)
    found = normal @ rows.T @ levels
    if not found[1] >= LEAST_EXPONENT:
        raise PathLossError(
            f"levels do not fall with distance (exponent {found[1]:.2f}): are they distances in m, then levels in dBm?"
        )
    residuals = levels - rows @ found
    variance = float(residuals @ residuals) / (distances.size - 2)
    white, shadowing = _parts(list(by_place.values()), variance)
    return PathLossFit(
        reference_dbm=float(found[0]), exponent=float(found[1]), covariance=variance * normal, sigma_db=sqrt(variance),
        white_sigma_db=white, shadowing_sigma_db=shadowing, places=distances.size,
        readings=sum(map(len, by_place.values())), residuals_db=residuals, distances_m=distances,
    )  # fmt: skip


def _parts(groups: list[list[float]], variance_db2: float) -> tuple[float, float]:
    """White and static standard deviations, dB; NaN if no place has two readings."""
    freedom = sum(len(group) - 1 for group in groups)
    if freedom == 0:
        return nan, nan
    within = sum(float(np.var(group)) * len(group) for group in groups) / freedom
    in_means = within * float(np.mean([1.0 / len(group) for group in groups]))
    return sqrt(within), sqrt(max(variance_db2 - in_means, 0.0))
