"""Calibration of the log-distance model from pairs of distance and level, with confidence.

The log-distance model of signal strength: levels from distances, distances from levels, with their spread.

A position from one level of each beacon: the posterior over a room, its mean and its 90 % region.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from math import exp, expm1, inf, log, log10, nan, sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, stdtrit

from ccatp.core import FloatArray

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

        Raises:
            ValueError: no level at all.
        """
        if count < 1:
            raise ValueError(f"mean of {count} levels has no range; give at least one")
        s2 = self.log_sigma**2 / count
        range_m = self.median_range_m(level_dbm) * exp(-0.5 * s2)
        return RangeEstimate(range_m, range_m * sqrt(expm1(s2)))


LEAST_EXPONENT = 0.1  # free space has 2; levels that hardly fall tell no distance
LEAST_PLACES = 3  # two unknowns and one to tell the spread
_PLAUSIBLE_EXPONENT = (1.0, 6.0)  # a corridor that guides waves has 1.2, a building with walls in the way up to 6
_LOUDEST_DBM = -10.0  # 20 dBm sent are -20 dBm at 1 m in free space, at 2.4 GHz
_EXACT_DB = 1e-6
_FAR_OFF = 3.5  # studentised residual of a place that wants a second look


class PathLossError(ValueError):
    """Pairs from which no path loss follows; the message carries the numbers."""


class LevelPair(NamedTuple):
    """One reading.

    Attributes:
        place: where; readings without a place belong to the place of their distance.
    """

    distance_m: float
    level_dbm: float
    place: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class PathLossFit:
    """Path loss z = P_ref - 10 eta log10(r) with the confidence of its two parameters.

    Attributes:
        covariance: of both, shape (2, 2).
        sigma_db: spread of the levels of places about the line, whatever makes it.
        white_sigma_db: of repeated readings at one place; NaN where nothing was repeated.
        shadowing_sigma_db: of what stays with a place, sigma without the white part; NaN likewise.
        residuals_db: mean level minus line of each place, shape (places,).
        distances_m: of the places, shape (places,).
    """

    reference_dbm: float
    exponent: float
    covariance: FloatArray
    sigma_db: float
    white_sigma_db: float
    shadowing_sigma_db: float
    places: int
    readings: int
    residuals_db: FloatArray
    distances_m: FloatArray

    @property
    def path_loss(self) -> PathLoss:
        """The model, its noise that of a reading at a new place."""
        return PathLoss(self.reference_dbm, self.exponent, self.sigma_db)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of sigma."""
        return self.places - 2

    def half_widths(self, confidence: float) -> tuple[float, float]:
        """Of the two-sided confidence intervals of P_ref, dB, and eta (Student's t)."""
        quantile = float(stdtrit(self.freedom, 0.5 + 0.5 * confidence))
        return quantile * sqrt(self.covariance[0, 0]), quantile * sqrt(self.covariance[1, 1])

    def sigma_interval_db(self, confidence: float) -> tuple[float, float]:
        """Confidence interval of sigma (chi-squared)."""
        tail = 0.5 * (1.0 - confidence)
        low, high = (float(chdtri(self.freedom, share)) for share in (tail, 1.0 - tail))
        square = self.freedom * self.sigma_db**2
        return sqrt(square / low), sqrt(square / high)

    def predicted(self, distances_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and scale of the level of a new place at distances (n,): Student's t with ``freedom``, both (n,)."""
        rows = np.column_stack([np.ones(distances_m.size), -10.0 * np.log10(distances_m)])
        mean = rows @ (self.reference_dbm, self.exponent)
        scale = np.sqrt(self.sigma_db**2 + np.einsum("ij,jk,ik->i", rows, self.covariance, rows))
        return mean, scale

    def doubts(self) -> list[str]:
        """What does not look like a path loss, a line each."""
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
                "a radio of 20 dBm is heard with: are the distances in metres?"
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

    Every place counts once, with the mean of its readings: what is off at a place is off for all of them, so a hundred
    readings at one place are no hundred witnesses.

    Raises:
        CalibrationError: fewer than three distances, one that is not positive, one that is not finite, or levels that
            do not fall with distance.
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
        reference_dbm=float(found[0]),
        exponent=float(found[1]),
        covariance=variance * normal,
        sigma_db=sqrt(variance),
        white_sigma_db=white,
        shadowing_sigma_db=shadowing,
        places=distances.size,
        readings=sum(map(len, by_place.values())),
        residuals_db=residuals,
        distances_m=distances,
    )


def _parts(groups: list[list[float]], variance_db2: float) -> tuple[float, float]:
    """White and static standard deviations; NaN where no place has two readings."""
    freedom = sum(len(group) - 1 for group in groups)
    if freedom == 0:
        return nan, nan
    within = sum(float(np.var(group)) * len(group) for group in groups) / freedom
    in_means = within * float(np.mean([1.0 / len(group) for group in groups]))
    return sqrt(within), sqrt(max(variance_db2 - in_means, 0.0))


_NEAREST_M = 0.1  # nearer than this the log-distance model is not believed
_MOST_PERMUTED = 5  # names: 120 permutations


@dataclass(frozen=True, slots=True)
class Room:
    """A rectangle in which the receiver is, searched on a grid."""

    low_m: tuple[float, float]
    high_m: tuple[float, float]
    spacing_m: float

    def points(self) -> FloatArray:
        """Grid points, shape (n, 2)."""
        axes = [
            np.linspace(low, high, max(2, round((high - low) / self.spacing_m) + 1))
            for low, high in zip(self.low_m, self.high_m, strict=True)
        ]
        return np.column_stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")])


@dataclass(frozen=True, slots=True)
class LevelFix:
    """A position.

    Attributes:
        position_m: mean of the posterior, shape (2,).
        covariance_m2: of the posterior, shape (2, 2).
        points_m: the grid, shape (n, 2).
        weights: posterior of the grid points, shape (n,).
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    points_m: FloatArray
    weights: FloatArray

    def region(self, probability: float) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
        """The grid points of the smallest region that holds a probability, as a mask of shape (n,)."""
        order = np.argsort(-self.weights)
        before = np.cumsum(self.weights[order]) - self.weights[order]
        mask = np.zeros(self.weights.size, dtype=np.bool_)
        mask[order[before < probability]] = True
        return mask

    def holds(self, place_m: Sequence[float], probability: float) -> bool:
        """Whether the smallest region of a probability holds a place."""
        nearest = int(np.argmin(np.hypot(*(self.points_m - np.asarray(place_m)).T)))
        return bool(self.region(probability)[nearest])


class LevelLocator:
    """Positions from levels, with beacons whose places and path losses are known.

    The level of a beacon at a place has Student's t about its path loss: the spread of its calibration, and the
    uncertainty of the two parameters. Over the room all places are as likely; the posterior is summed on a grid, so
    that nothing is linearised. Its mean is the position of least expected squared error.
    """

    def __init__(
        self, beacons_m: Mapping[str, tuple[float, float]], fits: Mapping[str, PathLossFit], room: Room
    ) -> None:
        self.names = tuple(beacons_m)
        self.points_m = room.points()
        self._beacons_m = np.array(list(beacons_m.values()))
        self._fits = [fits[name] for name in self.names]
        self._predicted = [self._predict(self.points_m, i) for i in range(len(self.names))]

    def fix(self, levels_dbm: Mapping[str, float]) -> LevelFix:
        """The position of a receiver that hears these levels; beacons that it does not hear are left out.

        Raises:
            ValueError: it hears none.
        """
        if not any(name in levels_dbm for name in self.names):
            raise ValueError(f"none of the beacons {', '.join(self.names)} was heard; a fix needs one at least")
        log_weights = np.zeros(len(self.points_m))
        for i, name in enumerate(self.names):
            if name in levels_dbm:
                log_weights += _log_density(levels_dbm[name], *self._predicted[i], self._fits[i].freedom)
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        mean = weights @ self.points_m
        off = self.points_m - mean
        return LevelFix(mean, (off * weights[:, None]).T @ off, self.points_m, weights)

    def log_likelihood(self, place_m: Sequence[float], levels_dbm: Mapping[str, float]) -> float:
        """Of levels heard at a known place."""
        at = np.asarray(place_m, dtype=np.float64)[None, :]
        return sum(
            float(_log_density(levels_dbm[name], *self._predict(at, i), self._fits[i].freedom)[0])
            for i, name in enumerate(self.names)
            if name in levels_dbm
        )

    def _predict(self, points_m: FloatArray, beacon: int) -> tuple[FloatArray, FloatArray]:
        distances = np.hypot(*(points_m - self._beacons_m[beacon]).T)
        return self._fits[beacon].predicted(np.maximum(distances, _NEAREST_M))


def likeliest_names(
    locator: LevelLocator, heard: Sequence[tuple[Sequence[float], Mapping[str, float]]]
) -> tuple[dict[str, str], float]:
    """Which names the beacons of a data set with known places should have.

    Returns:
        The likeliest permutation, from the name in the data to the beacon's, and how much its log-likelihood exceeds
        that of the names as they are.
    """
    names = locator.names
    if len(names) > _MOST_PERMUTED:
        return {name: name for name in names}, 0.0

    def score(order: Sequence[str]) -> float:
        new = dict(zip(names, order, strict=True))
        return sum(
            locator.log_likelihood(place, {new.get(n, n): level for n, level in levels.items()})
            for place, levels in heard
        )

    best = max(permutations(names), key=score)
    return dict(zip(names, best, strict=True)), score(best) - score(names)


def _log_density(level_dbm: float, mean: FloatArray, scale: FloatArray, freedom: int) -> FloatArray:
    square = ((level_dbm - mean) / scale) ** 2
    return np.asarray(-0.5 * (freedom + 1) * np.log1p(square / freedom) - np.log(scale))
