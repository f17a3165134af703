"""Position from one signal level of each beacon: the posterior over a room, its mean and its regions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from math import hypot
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ccatp.beacons.estimation.path_loss import LevelPair, PathLossFit, fit_path_loss
from ccatp.core import FloatArray

_NEAREST_M = 0.1  # smallest distance for which the log-distance model is used
_MOST_PERMUTED = 5  # names: 120 permutations


class MeasuredPlace(NamedTuple):
    """A known place, and the level of each beacon received there."""

    place_m: tuple[float, float]
    levels_dbm: dict[str, float]

    def renamed(self, names: Mapping[str, str]) -> "MeasuredPlace":
        """A copy with renamed beacons; ``names``: from old to new."""
        return MeasuredPlace(self.place_m, {names.get(name, name): level for name, level in self.levels_dbm.items()})


def grid_points(low_m: tuple[float, float], high_m: tuple[float, float], spacing_m: float) -> FloatArray:
    """Points of a grid over a rectangle, the outermost ones on its sides, shape (n, 2)."""
    axes = [
        np.linspace(low, high, max(2, round((high - low) / spacing_m) + 1))
        for low, high in zip(low_m, high_m, strict=True)
    ]
    return np.column_stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")])


@dataclass(frozen=True, slots=True)
class LevelFix:
    """A position with its posterior on a grid."""

    position_m: FloatArray  # mean of the posterior, shape (2,)
    covariance_m2: FloatArray  # of the posterior, shape (2, 2)
    points_m: FloatArray  # the grid, shape (n, 2)
    weights: FloatArray  # posterior of the grid points, shape (n,)

    def region(self, probability: float) -> npt.NDArray[np.bool_]:
        """Grid points of the smallest region that contains a probability, as a mask of shape (n,)."""
        order = np.argsort(-self.weights)
        before = np.cumsum(self.weights[order]) - self.weights[order]
        mask = np.zeros(self.weights.size, dtype=np.bool_)
        mask[order[before < probability]] = True
        return mask

    def holds(self, place_m: Sequence[float], probability: float) -> bool:
        """Whether the smallest region of a probability contains the grid point nearest to a place."""
        nearest = int(np.argmin(np.hypot(*(self.points_m - np.asarray(place_m)).T)))
        return bool(self.region(probability)[nearest])


class LevelLocator:
    """Positions from levels of beacons with known places and path losses.

    The level of a beacon at a place has Student's t about its path loss, with the spread of the calibration and the
    uncertainty of its two parameters. The prior is uniform over the room. The posterior is computed on the points of a
    grid, shape (n, 2), without linearisation. Its mean has the least expected squared error.
    """

    def __init__(
        self, beacons_m: Mapping[str, tuple[float, float]], fits: Mapping[str, PathLossFit], points_m: FloatArray
    ) -> None:
        self.names = tuple(beacons_m)
        self.points_m = points_m
        self._beacons_m = np.array(list(beacons_m.values()))
        self._fits = [fits[name] for name in self.names]
        self._predicted = [self._predict(self.points_m, i) for i in range(len(self.names))]

    def fix(self, levels_dbm: Mapping[str, float]) -> LevelFix:
        """Position of the receiver of these levels; beacons without a level are ignored.

        Raises ValueError: there is no level.
        """
        if not any(name in levels_dbm for name in self.names):
            raise ValueError(f"none of the beacons {', '.join(self.names)} was received; a fix needs one at least")
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
        """Log-likelihood of levels at a known place, up to a constant."""
        at = np.asarray(place_m, dtype=np.float64)[None, :]
        return sum(
            float(_log_density(levels_dbm[name], *self._predict(at, i), self._fits[i].freedom)[0])
            for i, name in enumerate(self.names)
            if name in levels_dbm
        )

    def _predict(self, points_m: FloatArray, beacon: int) -> tuple[FloatArray, FloatArray]:
        distances = np.hypot(*(points_m - self._beacons_m[beacon]).T)
        return self._fits[beacon].predicted(np.maximum(distances, _NEAREST_M))


def likeliest_names(locator: LevelLocator, places: Sequence[MeasuredPlace]) -> tuple[dict[str, str], float]:
    """The likeliest names of the beacons in a data set with known places.

    Returns the likeliest permutation, from the name in the data to the beacon's, and how much its log-likelihood
    exceeds that of the unchanged names. With more than five beacons the names are not changed.
    """
    names = locator.names
    if len(names) > _MOST_PERMUTED:
        return {name: name for name in names}, 0.0

    def score(order: Sequence[str]) -> float:
        new = dict(zip(names, order, strict=True))
        return sum(locator.log_likelihood(one.place_m, one.renamed(new).levels_dbm) for one in places)

    best = max(permutations(names), key=score)
    return dict(zip(names, best, strict=True)), score(best) - score(names)


def fingerprint_fits(
    places: Sequence[MeasuredPlace], beacons_m: Mapping[str, tuple[float, float]], left_out: int | None = None
) -> dict[str, PathLossFit]:
    """Path loss of each beacon from its levels at known places; ``left_out``: index of a place that is not used.

    Raises PathLossError: no path loss can be fitted.
    """
    used = [place for index, place in enumerate(places) if index != left_out]
    found = {}
    for name, beacon_m in beacons_m.items():
        pairs = []
        for place in used:
            if name in place.levels_dbm:
                distance_m = hypot(place.place_m[0] - beacon_m[0], place.place_m[1] - beacon_m[1])
                pairs.append(LevelPair(max(distance_m, _NEAREST_M), place.levels_dbm[name], place.place_m))
        found[name] = fit_path_loss(pairs)
    return found


def judged(fixes: Sequence[LevelFix], places: Sequence[MeasuredPlace], probability: float) -> dict[str, Any]:
    """Errors of fixes, and how many regions of a probability contain the true place, for JSON."""
    points: list[dict[str, Any]] = []
    for found, place in zip(fixes, places, strict=True):
        error_m, sigmas_m = float(np.hypot(*(found.position_m - place.place_m))), np.sqrt(np.diag(found.covariance_m2))
        fix_m, sigma_m = ([round(value, 4) for value in values.tolist()] for values in (found.position_m, sigmas_m))
        point = {"true_m": list(place.place_m), "fix_m": fix_m, "sigma_m": sigma_m, "error_m": round(error_m, 4)}
        points.append(point | {"in_region": found.holds(place.place_m, probability)})
    errors = [point["error_m"] for point in points]
    return {
        "points": points,
        "mean_error_m": round(float(np.mean(errors)), 4),
        "median_error_m": round(float(np.median(errors)), 4),
        "largest_error_m": max(errors),
        "region": probability,
        "in_region": sum(bool(point["in_region"]) for point in points),
        "coverage": round(float(np.mean([point["in_region"] for point in points])), 4),
    }


def _log_density(level_dbm: float, mean: FloatArray, scale: FloatArray, freedom: int) -> FloatArray:
    square = ((level_dbm - mean) / scale) ** 2
    return np.asarray(-0.5 * (freedom + 1) * np.log1p(square / freedom) - np.log(scale))
