"""What a filter's answer is without its rounding: the same steps in decimal arithmetic of fifty digits."""

from decimal import Decimal, localcontext
from typing import Any

import numpy as np

from ccatp.bench.contenders import Contender, Result
from ccatp.bench.problems import FilterProblem, models
from ccatp.core import FloatArray
from ccatp.filters.unscented import ALPHA, BETA, KURTOSIS

DIGITS = 50
Exact = np.ndarray[Any, np.dtype[np.object_]]


class _Exact:
    """A filter's mean and covariance in decimals.

    Nonlinear models are evaluated in floats at the nearest float of a state, and from there on are straight lines.
    """

    def __init__(self, problem: FilterProblem) -> None:
        self._problem = problem
        self.reset()

    def reset(self) -> None:
        self.x, self.P = _decimals(self._problem.mean), _decimals(self._problem.covariance)

    def result(self) -> Result:
        return self.x.astype(np.float64), self.P.astype(np.float64)

    def step(self, i: int) -> None:
        with localcontext() as context:
            context.prec = DIGITS
            self.predict()
            self.update(_decimals(self._problem.readings[i]))

    def predict(self) -> None:
        """Thesis eqs 2.5 and 2.6."""
        self.x, F = self._line(0, self.x)
        self.P = F.dot(self.P).dot(F.T) + _decimals(self._problem.Q)

    def update(self, z: Exact) -> None:
        """Thesis eqs 2.7 to 2.10, rows one after the other, which divides by numbers only."""
        expected, H = self._line(1, self.x)
        change, P = self.x - self.x, self.P
        for h, e, r in zip(H, z - expected, _decimals(self._problem.variances), strict=True):
            cross = P.dot(h)
            gain = cross / (h.dot(cross) + r)
            change = change + gain * (e - h.dot(change))
            P = P - gain[:, None] * cross
        self.x, self.P = self.x + change, P

    def _line(self, which: int, x: Exact) -> tuple[Exact, Exact]:
        """Value at x and slope of the motion (0) or of the sight (1)."""
        matrix = (self._problem.F, self._problem.H)[which]
        if matrix is not None:
            slope = _decimals(matrix)
            return slope.dot(x), slope
        near = x.astype(np.float64)
        value, jacobian = models(self._problem)[which].at(near)
        slope = _decimals(jacobian)
        return _decimals(value) + slope.dot(x - _decimals(near)), slope


class _ExactUnscented(_Exact):
    """The same with the points and weights of ``UnscentedKalmanFilter``."""

    def predict(self) -> None:
        self.x, _, deviations, weights = self._images(0)
        self.P = (deviations.T * weights).dot(deviations) + _decimals(self._problem.Q)

    def update(self, z: Exact) -> None:
        expected, offsets, deviations, weights = self._images(1)
        S = (deviations.T * weights).dot(deviations) + np.diag(_decimals(self._problem.variances))
        cross = (offsets.T * weights).dot(deviations)
        root = _root(S)
        V = _forward(root, cross.T).T
        self.x = self.x + V.dot(_forward(root, (z - expected)[:, None])[:, 0])
        self.P = self.P - V.dot(V.T)

    def _images(self, which: int) -> tuple[Exact, Exact, Exact, Exact]:
        """Mean of the images, offsets of the points, deviations of the images, weights of the covariance."""
        n = self.x.size
        alpha = Decimal(ALPHA)
        scale = alpha * alpha * Decimal(max(float(n), KURTOSIS))
        L = _root(self.P) * scale.sqrt()
        offsets = np.vstack([0 * L[:1], L.T, -L.T])
        images = np.array([self._line(which, self.x + offset)[0] for offset in offsets])
        weights = np.full(2 * n + 1, 1 / (2 * scale))
        weights[0] = (scale - n) / scale
        mean = weights.dot(images)
        weights[0] += 1 - alpha * alpha + Decimal(BETA)
        return mean, offsets, images - mean, weights


def exact_filter(problem: FilterProblem, *, unscented: bool = False) -> Contender:
    """The answer to a problem, linear or linearised, or by sigma points."""
    exact = (_ExactUnscented if unscented else _Exact)(problem)
    return Contender(exact.reset, exact.step, exact.result)


def _root(P: Exact) -> Exact:
    """The lower Cholesky factor."""
    L: Exact = P * 0
    for j in range(len(P)):
        L[j, j] = (P[j, j] - L[j, :j].dot(L[j, :j])).sqrt() if j else P[0, 0].sqrt()
        for i in range(j + 1, len(P)):
            L[i, j] = (P[i, j] - (L[i, :j].dot(L[j, :j]) if j else 0)) / L[j, j]
    return L


def _forward(L: Exact, B: Exact) -> Exact:
    """L^-1 B, L lower triangular."""
    found = B.copy()
    for i in range(len(L)):
        for k in range(i):
            found[i] = found[i] - L[i, k] * found[k]
        found[i] = found[i] / L[i, i]
    return found


def _decimals(a: FloatArray) -> Exact:
    found = np.empty(a.shape, dtype=object)
    found.ravel()[:] = [Decimal(v) for v in a.ravel().tolist()]
    return found
