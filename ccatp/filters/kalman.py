"""Pure. Linear Kalman filter, thesis eqs 2.5 to 2.13, as a square-root update."""

from math import isfinite

import numpy as np
from scipy.linalg.lapack import dgeqrf, dpotrf, dtrtrs

from ccatp.filters.base import (
    NEGATIVITY,
    FilterDiverged,
    FilterShapeError,
    FloatArray,
    Innovation,
    check_gaussian,
)


class KalmanFilter:
    """The Kalman filter of thesis eq. 2.13.

    predict:  x = F x,  P = F P F^T + Q                                      (2.5, 2.6; no input u)
    update:   nu = z - H x                                                   (2.7)
              W = P H^T (H P H^T + R)^-1,  x = x + W nu,  P = (I - W H) P    (2.8 to 2.10)

    The printed form of 2.10 loses symmetry and then definiteness by rounding, and 2.8 solves an m x m system. The same
    posterior is the least-squares solution of ``y = 0, A y = b`` with P = L L^T, x = x + L y and A = H L, b = nu, both
    whitened by R. One QR factorisation of the stacked rows ``[I 0; A b]`` holds all of it: the triangle C with
    C^T C = I + A^T A gives P = (C^-T L^T)^T (C^-T L^T), symmetric positive semidefinite by construction, its last
    column gives y, and the corner squared is the normalised innovation. Nothing is squared before it is factored, so a
    prior far wider than the measurement costs no digits.

    Attributes:
        mean: x, shape (n,).
        covariance: P, shape (n, n).
    """

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        self.mean: FloatArray = np.empty(0)
        self.covariance: FloatArray = np.empty((0, 0))
        self.reset(mean, covariance)

    def reset(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Re-initialise with copies of ``mean`` (n,) and ``covariance`` (n, n); see ``Filter.reset``."""
        x = np.array(mean, dtype=np.float64)
        P = np.array(covariance, dtype=np.float64)
        check_gaussian(x, P)
        if self.mean.size and x.size != self.mean.size:
            raise FilterShapeError("mean", x.shape, f"({self.mean.size},)")
        self.mean = x
        self.covariance = 0.5 * (P + P.T)
        self._identity = np.eye(x.size)

    def predict(self, F: FloatArray, Q: FloatArray) -> None:
        """Advance by F (n, n) and Q (n, n), thesis eqs 2.5 and 2.6; see ``Filter.predict``."""
        shape = self.covariance.shape
        if F.shape != shape:
            raise FilterShapeError("F", F.shape, str(shape))
        if Q.shape != shape:
            raise FilterShapeError("Q", Q.shape, str(shape))
        with np.errstate(over="ignore", invalid="ignore"):
            # The method, not the operator: on matrices this small it costs half.
            x = F.dot(self.mean)
            P = F.dot(self.covariance).dot(F.T)
            P += Q
            P += P.T
            P *= 0.5
            size = _size(x, P)
        if not isfinite(size):
            raise FilterDiverged(f"prediction is not finite: mean {x.tolist()}")
        self.mean, self.covariance = x, P

    def update(self, z: FloatArray, H: FloatArray, R: FloatArray) -> Innovation:
        """Condition on z (m,) with H (m, n) and R (m,) or (m, m), thesis eqs 2.7 to 2.10; see ``Filter.update``."""
        n = self.mean.size
        m = z.size
        if z.ndim != 1:
            raise FilterShapeError("z", z.shape, "(m,)")
        if H.shape != (m, n):
            raise FilterShapeError("H", H.shape, f"({m}, {n})")
        if R.shape not in ((m,), (m, m)):
            raise FilterShapeError("R", R.shape, f"({m},) or ({m}, {m})")
        if m == 0:
            return Innovation(np.empty(0), 0.0, 0)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            residual = z - H.dot(self.mean)
            L = _square_root(self.covariance)
            rows = np.zeros((n + 1, n + m)).T  # column-major, so that LAPACK works in place
            rows[:n, :n] = self._identity
            rows[n:, :n] = H.dot(L)
            rows[n:, n] = residual
            _whiten(rows[n:], R)
            triangle = dgeqrf(rows, overwrite_a=1)[0]
            root = dtrtrs(triangle[:n, :n], L.T, lower=0, trans=1)[0]
            x = self.mean + triangle[:n, n].dot(root)
            P = root.T.dot(root)
            nis = float(triangle[n, n] * triangle[n, n])
            size = _size(x, P)
        if not isfinite(nis + size):
            raise FilterDiverged(f"update is not finite: NIS {nis}, {m} rows, least variance {_least_variance(R):.3g}")
        self.mean, self.covariance = x, P
        return Innovation(residual, nis, m)


def _size(x: FloatArray, P: FloatArray) -> float:
    """A sum of squares: not finite if anything is not."""
    return float(x.dot(x) + np.vdot(P, P))


def _square_root(P: FloatArray) -> FloatArray:
    """L with L L^T = P, shape (n, n): Cholesky, or the eigenvectors where P is only semidefinite."""
    L: FloatArray
    L, info = dpotrf(P, lower=1, clean=1)
    if info == 0:
        return L
    if not np.isfinite(P).all():
        raise FilterDiverged("covariance is not finite")
    values, vectors = np.linalg.eigh(P)
    if values[0] < -NEGATIVITY * abs(values[-1]):
        raise FilterDiverged(f"covariance is not positive semidefinite: least eigenvalue {values[0]:.3g}")
    root: FloatArray = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _whiten(rows: FloatArray, R: FloatArray) -> None:
    """Scale ``rows`` (m, n + 1) in place so that their noise has unit covariance."""
    if R.ndim == 1:
        rows *= (1.0 / np.sqrt(R))[:, None]  # a variance that is not positive leaves something that is not finite
        return
    factor, info = dpotrf(R, lower=1, clean=1)
    if info != 0:
        raise FilterDiverged("R is not positive definite")
    rows[:] = dtrtrs(factor, rows, lower=1)[0]


def _least_variance(R: FloatArray) -> float:
    return float((R if R.ndim == 1 else R.diagonal()).min())
