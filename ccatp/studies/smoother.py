"""Fixed-interval smoother of Rauch, Tung and Striebel: estimates of every step from the whole record."""

from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dgetrf, dgetrs

from ccatp.core import FloatArray
from ccatp.filters.base import Filter, FilterDiverged, FilterError, FilterModel, FilterShapeError

BLOCK = 4096
"""Number of steps in a block of memory."""
SINGULAR = 1e-10
"""Least reciprocal of max|F^-1| max|F| with which F counts as invertible."""
CUT = 1e-13
"""Directions with a smaller relative variance, in units of the states' sigmas, are left out of the pseudo-inverse."""


ROUNDING = 1e-9
"""Part of P', in units of the states' sigmas, up to which a difference from F P F^T + Q counts as rounding."""


class SmootherEmpty(FilterError):
    """The requested step is not recorded."""


class Smoothed(NamedTuple):
    """Means (k, n) and covariances (k, n, n) of the k states, given everything recorded."""

    means: FloatArray
    covariances: FloatArray


class Smoother:
    """Records a filter's predictions and smooths them backward.

    Each prediction is stored with the filtered mean x and covariance P before it, F, the predicted mean x' and the
    added noise Q = P' - F P F^T. Backward from the last filtered state (Rauch, Tung, Striebel 1965),

        G = P F^T P'^-1,   x_s = x + G (x_s' - x'),   P_s = P + G (P_s' - P') G^T

    in a form without a difference of covariances:

        P_s = (I - G F) P (I - G F)^T + G (Q + P_s') G^T

    and, if F is invertible, G = F^-1 (I - Q P'^-1), which maps a state without noise back by F^-1 even if P' is
    singular. P'^-1 is the pseudo-inverse in units of the states' own sigmas.

    A nonlinear prediction is recorded with ``Filter.transition``; Q then includes the error of this linearisation. Any
    other change of the state (a reset, another frame of reference) has to be recorded as a prediction, with its F and
    the variance that it added. Otherwise the smoother treats it as information.

    Memory: 8 (3 n^2 + 2 n) bytes per step, 3.6 kB at n = 12; half of that with ``dtype`` np.float32, which leaves about
    6 digits of the covariances. ``smooth`` adds 8 (n^2 + n) bytes per requested step.
    """

    def __init__(self, n: int, dtype: type[np.float64] | type[np.float32] = np.float64) -> None:
        self._n = n
        self._row = np.dtype(
            [("x", dtype, n), ("P", dtype, (n, n)), ("F", dtype, (n, n)), ("x1", dtype, n), ("Q", dtype, (n, n))]
        )
        self._blocks: list[np.ndarray[tuple[int], np.dtype[np.void]]] = []
        self._count = 0

    def __len__(self) -> int:
        """Predictions recorded."""
        return self._count

    def predict(self, filter_: Filter, F: FloatArray | FilterModel, Q: FloatArray) -> None:
        """Predict with the filter by F and Q, and record the step. Raises as ``Filter.predict``."""
        mean, covariance = filter_.mean, filter_.covariance
        filter_.predict(F, Q)
        A = filter_.transition
        excess = filter_.covariance - A.dot(covariance).dot(A.T) - Q
        sigma = np.sqrt(np.maximum(filter_.covariance.diagonal(), 0.0))
        # Rounding is ignored, so that a state without noise keeps Q = 0.
        is_rounding = bool((np.abs(excess) <= ROUNDING * np.outer(sigma, sigma)).all())
        self.record(mean, covariance, A, filter_.mean, Q if is_rounding else Q + excess)

    def record(
        self, mean: FloatArray, covariance: FloatArray, F: FloatArray, predicted: FloatArray, Q: FloatArray
    ) -> None:
        """Record a prediction: x (n,), P and F (n, n) before, x' (n,) after, Q (n, n); ``FilterShapeError``."""
        n = self._n
        given = (("mean", mean), ("covariance", covariance), ("F", F), ("predicted", predicted), ("Q", Q))
        for name, array in given:
            wanted = (n,) if name in {"mean", "predicted"} else (n, n)
            if array.shape != wanted:
                raise FilterShapeError(name, array.shape, str(wanted))
        block, row = divmod(self._count, BLOCK)
        if block == len(self._blocks):
            self._blocks.append(np.empty(BLOCK, self._row))
        self._blocks[block][row] = mean, covariance, F, predicted, Q
        self._count += 1

    def smooth(self, filter_: Filter, first: int = 0) -> Smoothed:
        """The len(self) - first + 1 states from step ``first`` on, oldest first; the last is the filter's own.

        Raises ``SmootherEmpty`` if step ``first`` is not recorded, ``FilterDiverged`` if a state is not finite.
        """
        if not 0 <= first < self._count:
            raise SmootherEmpty(f"step {first} of {self._count} recorded: record predictions before smoothing")
        k = self._count - first
        means, covariances = np.empty((k + 1, self._n)), np.empty((k + 1, self._n, self._n))
        means[k], covariances[k] = x, P = filter_.mean, filter_.covariance
        for i in range(k - 1, -1, -1):
            block, row = divmod(first + i, BLOCK)
            step = self._blocks[block][row]
            kept = [np.asarray(step[name], dtype=np.float64) for name in ("x", "P", "F", "x1", "Q")]
            x, P = means[i], covariances[i] = _backward(x, P, *kept)
        if not np.isfinite(np.vdot(means, means) + np.vdot(covariances, covariances)):
            raise FilterDiverged(f"smoothed states are not finite among {k} steps")
        return Smoothed(means, covariances)


def _backward(
    xs: FloatArray, Ps: FloatArray, x: FloatArray, P: FloatArray, F: FloatArray, x1: FloatArray, Q: FloatArray
) -> tuple[FloatArray, FloatArray]:
    predicted = F.dot(P).dot(F.T) + Q
    G = _gain(P, F, Q, 0.5 * (predicted + predicted.T))
    left = np.eye(x.size) - G.dot(F)
    covariance = left.dot(P).dot(left.T) + G.dot(Q + Ps).dot(G.T)
    return x + G.dot(xs - x1), 0.5 * (covariance + covariance.T)


def _gain(P: FloatArray, F: FloatArray, Q: FloatArray, predicted: FloatArray) -> FloatArray:
    inverse = _pseudo_inverse(predicted)
    lu, pivots, info = dgetrf(F)
    if info == 0:
        solved: FloatArray = dgetrs(lu, pivots, np.eye(len(F)))[0]
        if float(np.abs(solved).max() * np.abs(F).max()) < 1.0 / SINGULAR:
            gain: FloatArray = solved - solved.dot(Q).dot(inverse)
            return gain
    by_cross: FloatArray = P.dot(F.T).dot(inverse)
    return by_cross


def _pseudo_inverse(P: FloatArray) -> FloatArray:
    sigma = np.sqrt(np.maximum(P.diagonal(), 0.0))
    per_sigma = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
    values, vectors = np.linalg.eigh(P * per_sigma[:, None] * per_sigma)
    known = values > CUT * max(float(values[-1]), 0.0)
    scaled = vectors[:, known] * per_sigma[:, None]
    inverse: FloatArray = (scaled / values[known]).dot(scaled.T)
    return inverse
