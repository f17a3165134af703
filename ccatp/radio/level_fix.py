"""Pure. A position from one level of each beacon: the posterior over a room, its mean and its 90 % region."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.radio.path_loss_fit import PathLossFit

_NEAREST_M = 0.1  # nearer than this the log-distance model is not believed
_MOST_PERMUTED = 5  # names: 120 permutations


@dataclass(frozen=True, slots=True)
class Room:
    """A rectangle in which the receiver is, searched on a grid.

    Attributes:
        low_m: its lower left corner.
        high_m: its upper right corner.
        spacing_m: of the grid.
    """

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

    Args:
        beacons_m: places by name.
        fits: path losses by name.
        room: where the receiver is.
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

    Args:
        locator: beacons and path losses.
        heard: place and levels of each point.

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
    """Of Student's t, up to a constant."""
    square = ((level_dbm - mean) / scale) ** 2
    return np.asarray(-0.5 * (freedom + 1) * np.log1p(square / freedom) - np.log(scale))
