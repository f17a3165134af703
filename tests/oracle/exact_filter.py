"""The oracle of every filter: thesis eqs 2.5 to 2.10, and sigma points, in decimal arithmetic of fifty digits."""

from decimal import Decimal, localcontext
from typing import Any

import numpy as np

from ccatp.core import FloatArray
from ccatp.filters.base import FilterModel
from ccatp.filters.unscented import ALPHA, BETA, KURTOSIS

DIGITS = 50
Exact = np.ndarray[Any, np.dtype[np.object_]]


class ExactFilter:
    """Mean and covariance in decimals.

    Nonlinear models are evaluated in floats at the nearest float of a state, and from there on are straight lines; with
    ``unscented`` they are taken by the points and weights of ``UnscentedKalmanFilter``.
    """

    def __init__(self, mean: FloatArray, covariance: FloatArray, *, unscented: bool = False) -> None:
        self.x, self.P = decimals(mean), decimals(covariance)
        self._unscented = unscented

    @property
    def mean(self) -> FloatArray:
        return self.x.astype(np.float64)

    @property
    def covariance(self) -> FloatArray:
        return self.P.astype(np.float64)

    def predict(self, F: FloatArray | FilterModel, Q: FloatArray) -> None:
        """Eqs 2.5 and 2.6."""
        with localcontext() as context:
            context.prec = DIGITS
            if self._unscented and not isinstance(F, np.ndarray):
                self.x, _, deviations, weights = self._images(F)
                self.P = (deviations.T * weights).dot(deviations) + decimals(Q)
                return
            self.x, slope = line(F, self.x)
            self.P = slope.dot(self.P).dot(slope.T) + decimals(Q)

    def update(self, z: FloatArray, H: FloatArray | FilterModel, R: FloatArray) -> float:
        """Eqs 2.7 to 2.10; returns the normalised innovation squared.

        S is factored; no row is compared with another.
        """
        with localcontext() as context:
            context.prec = DIGITS
            noise = decimals(np.diag(R) if R.ndim == 1 else R)
            if self._unscented and not isinstance(H, np.ndarray):
                expected, offsets, deviations, weights = self._images(H)
                S = (deviations.T * weights).dot(deviations) + noise
                cross = (offsets.T * weights).dot(deviations)
            else:
                expected, slope = line(H, self.x)
                cross = self.P.dot(slope.T)
                S = slope.dot(cross) + noise
            root = cholesky(S)
            V = forward(root, cross.T).T
            y = forward(root, (decimals(z) - expected)[:, None])[:, 0]
            self.x, self.P = self.x + V.dot(y), self.P - V.dot(V.T)
            return float(y.dot(y)) if len(z) else 0.0

    def _images(self, model: Any) -> tuple[Exact, Exact, Exact, Exact]:
        """Mean of the images, offsets of the points, deviations of the images, weights of the covariance."""
        n = self.x.size
        alpha = Decimal(ALPHA)
        scale = alpha * alpha * Decimal(max(float(n), KURTOSIS))
        L = cholesky(self.P) * scale.sqrt()
        offsets = np.vstack([0 * L[:1], L.T, -L.T])
        images = np.array([line(model, self.x + offset)[0] for offset in offsets])
        weights = np.full(2 * n + 1, 1 / (2 * scale))
        weights[0] = (scale - n) / scale
        mean = weights.dot(images)
        weights[0] += 1 - alpha * alpha + Decimal(BETA)
        return mean, offsets, images - mean, weights


def line(model: FloatArray | FilterModel, x: Exact) -> tuple[Exact, Exact]:
    """Value at x and slope of a model."""
    if isinstance(model, np.ndarray):
        slope = decimals(model)
        return slope.dot(x), slope
    near = x.astype(np.float64)
    value, jacobian = model.at(near)
    slope = decimals(jacobian)
    return decimals(value) + slope.dot(x - decimals(near)), slope


def cholesky(P: Exact) -> Exact:
    """The lower factor."""
    L: Exact = P * 0
    for j in range(len(P)):
        L[j, j] = (P[j, j] - L[j, :j].dot(L[j, :j])).sqrt() if j else P[0, 0].sqrt()
        for i in range(j + 1, len(P)):
            L[i, j] = (P[i, j] - (L[i, :j].dot(L[j, :j]) if j else 0)) / L[j, j]
    return L


def forward(L: Exact, B: Exact) -> Exact:
    """L^-1 B, L lower triangular."""
    found = B.copy()
    for i in range(len(L)):
        for k in range(i):
            found[i] = found[i] - L[i, k] * found[k]
        found[i] = found[i] / L[i, i]
    return found


def decimals(a: FloatArray) -> Exact:
    found = np.empty(a.shape, dtype=object)
    found.ravel()[:] = [Decimal(v) for v in a.ravel().tolist()]
    return found
