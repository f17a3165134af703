"""Unscented Kalman filter: nonlinear models by sigma points, matrices as in ``KalmanFilter``."""

import numpy as np
from scipy.linalg.blas import ddot, dgemm, dsyrk
from scipy.linalg.lapack import dpotrf

from ccatp.core import FloatArray
from ccatp.filters.base import HUGE, FilterDiverged, FilterModel, FilterShapeError, Innovation
from ccatp.filters.kalman import KalmanFilter, noise_root, square_root

ALPHA = 1.0
"""Spread of the points. With 1 all weights are >= 0. A small value gives the mean a weight near -1/alpha^2, which loses
as many digits and may give a matrix that is not a covariance."""
BETA = 2.0
"""Weight of the fourth moment; 2 is the best value for a Gaussian."""
KURTOSIS = 3.0
"""n + kappa of a Gaussian in one dimension: kappa = max(3 - n, 0)."""


class UnscentedKalmanFilter(KalmanFilter):
    """The Kalman filter with the scaled unscented transform instead of Jacobians (Julier 2002).

    With lambda = alpha^2 (n + kappa) - n and L L^T = P the 2 n + 1 points are x and x +- sqrt(n + lambda) L_i, with the
    weights W_0 = lambda / (n + lambda) in the mean, W_0 + 1 - alpha^2 + beta in the covariance, and
    1 / (2 (n + lambda)) for the others in both. With the images Y of the points:

    predict:  x = sum W_i Y_i,  P = sum W_i (Y_i - x)(Y_i - x)^T + Q
    update:   nu = z - sum W_i Y_i,  S = sum W_i dY_i dY_i^T + R,  C = sum W_i dX_i dY_i^T,
              W = C S^-1,  x = x + W nu,  P = P - W S W^T

    The update draws new points. With a matrix instead of a model, the linear filter is used, because the transform is
    exact there. ``transition`` of a nonlinear prediction is C^T P^-1 of its points, the statistical linearisation; it
    is zero along a direction without variance.
    """

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        super().__init__(mean, covariance)
        n = self._n
        scale = ALPHA**2 * (n + max(KURTOSIS - n, 0.0))
        self._spread = float(np.sqrt(scale))
        self._weights = np.full(2 * n + 1, 0.5 / scale)
        self._weights[0] = (scale - n) / scale
        covariance_weights = self._weights.copy()
        covariance_weights[0] += 1.0 - ALPHA**2 + BETA
        self._roots = np.sqrt(covariance_weights)[:, None]
        self._offsets = np.zeros((2 * n + 1, n))
        self._predicted: tuple[FloatArray, FloatArray] | None = None

    @property
    def transition(self) -> FloatArray:
        """F, or the regression of the points, of the last prediction, shape (n, n); see ``Filter.transition``."""
        if self._predicted is not None:
            cross, L = self._predicted
            # A with A P = cross^T by least squares, because P = L L^T may be singular.
            half = np.linalg.lstsq(L, cross, rcond=None)[0]
            self._F_rows[:] = np.linalg.lstsq(L.T, half, rcond=None)[0].T
            self._predicted = None
        return super().transition

    def reset(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Re-initialise with copies of ``mean`` (n,) and ``covariance`` (n, n); see ``Filter.reset``."""
        super().reset(mean, covariance)
        self._predicted = None

    def predict(self, F: FloatArray | FilterModel, Q: FloatArray) -> None:
        """Advance by F, a matrix (n, n) or a model, and Q (n, n); see ``Filter.predict``."""
        self._predicted = None
        if isinstance(F, np.ndarray):
            super().predict(F, Q)
            return
        n = self._n
        L = self._draw()
        images = F.through(self.mean + self._offsets)
        if images.shape != (2 * n + 1, n):
            raise FilterShapeError("f(X)", images.shape, f"({2 * n + 1}, {n})")
        if Q.shape != (n, n):
            raise FilterShapeError("Q", Q.shape, str((n, n)))
        if not np.vdot(images, images) + np.vdot(Q, Q) < HUGE:
            raise FilterDiverged(f"prediction is not finite: images of the points {images.tolist()}, or Q")
        mean = self._weights.dot(images)
        deviations = (images - mean) * self._roots
        self._P_rows[:] = dgemm(1.0, deviations.T, deviations.T, 1.0, Q.T, 0, 1).T  # both halves are read
        self._minus_x[:] = self._minus_x_row[:] = -mean
        self._mean = self._covariance = None
        self._predicted = dgemm(1.0, (self._offsets * self._roots).T, deviations.T, 0.0, None, 0, 1), L

    def update(self, z: FloatArray, H: FloatArray | FilterModel, R: FloatArray) -> Innovation:
        """Condition on z (m,) by H, a matrix (m, n) or a model; see ``Filter.update``."""
        if isinstance(H, np.ndarray):
            return super().update(z, H, R)
        m = z.size
        self._draw()
        images = H.through(self.mean + self._offsets)
        if z.ndim != 1 or images.shape != (len(self._offsets), m):
            raise FilterShapeError("h(X)", images.shape, f"({len(self._offsets)}, m) with z of shape {z.shape}")
        if R.shape not in ((m,), (m, m)):
            raise FilterShapeError("R", R.shape, f"({m},) or ({m}, {m})")
        if m == 0:
            return Innovation([], 0.0)
        if not np.vdot(images, images) + ddot(z, z) + np.vdot(R, R) < HUGE:
            raise FilterDiverged(f"update is not finite: readings {z.tolist()}, or their expectation or noise")
        if R.ndim == 2:
            noise_root(R)  # raises if R is not a covariance
        elif not min(R.tolist()) > 0.0:
            raise FilterDiverged(f"R is not positive definite: least variance {min(R.tolist()):.3g}")
        expected = self._weights.dot(images)
        deviations = (images - expected) * self._roots
        rows = self._rows.get(z.shape) or self._new_rows(m)
        rows.V[: self._n, :m] = (self._offsets * self._roots).T.dot(deviations)
        np.subtract(z, expected, rows.residual)
        noise = R if R.ndim == 2 else np.diag(R)
        rows.S[:m, :m] = dsyrk(1.0, deviations.T, 1.0, noise.T, 0, 1)
        rows.empty.fill(1.0)
        if dpotrf(*rows.factor)[1]:
            raise FilterDiverged("update is not finite, or the covariance of the measurement is not positive definite")
        residual = rows.residual.tolist()
        return Innovation(residual, self._reduce(rows, residual))

    def _draw(self) -> FloatArray:
        n = self._n
        L = square_root(self.covariance)
        np.multiply(L.T, self._spread, self._offsets[1 : n + 1])
        np.negative(self._offsets[1 : n + 1], self._offsets[n + 1 :])
        return L
