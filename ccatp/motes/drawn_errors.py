"""Pure. The errors of a trilateration, drawn: its steps made again on ranges with errors, all draws at once."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ccatp.motes.pair_means import PairMeans
from ccatp.motes.range_network import FloatArray
from ccatp.motes.trilateration import Step

_STEPS = 15  # of each trilateration; references that are decimetres off make it go slowly
_REST_M = 1e-5
_DAMPING = 1e-6  # of the trace of the normal matrix: references of a draw may come to lie in line


class DrawnErrors(NamedTuple):
    """What a trilateration is worth.

    Attributes:
        bias_m: mean error of each place, shape (n, d).
        covariance_m2: of all coordinates, shape (n d, n d).
    """

    bias_m: FloatArray
    covariance_m2: FloatArray


def draw_errors(
    places_m: FloatArray,
    steps: Sequence[Step],
    means: PairMeans,
    seed_covariance_m2: FloatArray,
    rng: np.random.Generator,
    draws: int,
) -> DrawnErrors:
    """Mean and covariance of the errors of a trilateration, by the parametric bootstrap (Efron 1979).

    At places close to those that were found, ranges with errors as they are expected are drawn, and the same steps made
    of them. Derivatives tell the size of the errors as well, but not how they hang together: from a small stand errors
    grow to decimetres, and along so wide an arc no line is a tangent everywhere. What a line takes to be known within a
    millimetre is known within centimetres.

    Args:
        places_m: where the motes might be, nan for those without a place, shape (n, d); A at the origin, B on the
            second axis, where the steps begin with these two.
        steps: as they were made.
        means: the ranges, of which the sigmas alone are used.
        seed_covariance_m2: of the motes that began the map together, shape (n d, n d); those of axes need none.
        rng: draws the errors.
        draws: how many times, far more often than there are coordinates.
    """
    count, d = places_m.shape
    drawn = np.broadcast_to(places_m, (draws, count, d)).copy()
    ranges = _Ranges(places_m, means, rng, draws)
    seeds = [step.mote for step in steps if step.how == "seed"]
    if seeds:
        at = (np.array(seeds)[:, None] * d + np.arange(d)).ravel()
        errors = rng.multivariate_normal(np.zeros(at.size), seed_covariance_m2[np.ix_(at, at)], draws, method="eigh")
        drawn[:, seeds] += errors.reshape(draws, len(seeds), d)
    for step in steps:
        if step.how == "axes":
            drawn[:, step.mote] = 0.0
            if step.references:
                drawn[:, step.mote, 1] = ranges.of(step.references[0], step.mote)
        elif step.how == "cosines":
            origin, axis = step.references
            a, b, c = (ranges.of(*pair) for pair in ((origin, step.mote), (axis, step.mote), (origin, axis)))
            y = (a * a + c * c - b * b) / (2.0 * c)
            drawn[:, step.mote] = np.column_stack([np.sqrt(np.maximum(a * a - y * y, 0.0)), y])
        elif step.how == "trilateration":
            lengths = np.column_stack([ranges.of(reference, step.mote) for reference in step.references])
            sigmas = np.array([ranges.sigma(reference, step.mote) for reference in step.references])
            drawn[:, step.mote] = _trilaterated(drawn[:, list(step.references)], lengths, sigmas, places_m[step.mote])
    errors = np.nan_to_num(drawn - places_m)
    bias = errors.mean(axis=0)
    flat = (errors - bias).reshape(draws, -1)
    return DrawnErrors(bias, flat.T @ flat / (draws - 1))


class _Ranges:
    """True ranges with drawn errors, each pair's drawn once."""

    def __init__(self, places_m: FloatArray, means: PairMeans, rng: np.random.Generator, draws: int) -> None:
        self._places_m, self._means = places_m, means
        self._errors = rng.normal(0.0, 1.0, (len(means.pairs), draws))
        self._row_of = {(int(i), int(j)): row for row, (i, j) in enumerate(means.pairs)}

    def sigma(self, first: int, second: int) -> float:
        return float(self._means.sigmas_m[self._row(first, second)])

    def of(self, first: int, second: int) -> FloatArray:
        true = float(np.linalg.norm(self._places_m[first] - self._places_m[second]))
        return np.asarray(true + self.sigma(first, second) * self._errors[self._row(first, second)])

    def _row(self, first: int, second: int) -> int:
        return self._row_of[(min(first, second), max(first, second))]


def _trilaterated(anchors: FloatArray, lengths: FloatArray, sigmas: FloatArray, start: FloatArray) -> FloatArray:
    """Least squares on the lengths, damped Gauss-Newton of all draws at once.

    Args:
        anchors: places of the references, shape (draws, k, d).
        lengths: to them, shape (draws, k).
        sigmas: shape (k,).
        start: shape (d,).

    Returns:
        Shape (draws, d).
    """
    d = anchors.shape[2]
    points = np.broadcast_to(start, (len(anchors), d)).copy()
    damping = np.full(len(anchors), _DAMPING)
    cost, gradient, normal = _look(points, anchors, lengths, sigmas)
    for _ in range(_STEPS):
        ridge = (damping * np.trace(normal, axis1=1, axis2=2))[:, None, None] * np.eye(d)
        step = np.linalg.solve(normal + ridge, gradient[:, :, None])[:, :, 0]
        seen = _look(points + step, anchors, lengths, sigmas)
        better = seen[0] <= cost
        points[better] += step[better]
        cost, gradient[better], normal[better] = np.where(better, seen[0], cost), seen[1][better], seen[2][better]
        damping = np.where(better, np.maximum(0.2 * damping, _DAMPING), 10.0 * damping)
        if float(np.abs(step).max()) < _REST_M:
            break
    return points


def _look(
    points: FloatArray, anchors: FloatArray, lengths: FloatArray, sigmas: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cost (draws,), negative half gradient (draws, d) and normal matrix (draws, d, d)."""
    ways = points[:, None] - anchors
    distances = np.maximum(np.sqrt((ways**2).sum(axis=2)), 1e-9)
    J = ways / (distances * sigmas)[:, :, None]
    residuals = (lengths - distances) / sigmas
    return (
        (residuals**2).sum(axis=1),
        np.einsum("nk,nkd->nd", residuals, J),
        np.einsum("nki,nkj->nij", J, J),
    )
