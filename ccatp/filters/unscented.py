"""Unscented Kalman filter: nonlinear models by sigma points, matrices as in ``KalmanFilter``."""

import numpy as np
from numpy import vdot

from ccatp.core import FloatArray
from ccatp.filters.base import HUGE, FilterDiverged, FilterShapeError, Innovation, Learned, Observation, Transition
from ccatp.filters.kalman import KalmanFilter
from ccatp.filters.square_root import square_root

ALPHA = 1.0
"""Spread of the points. 1 keeps every weight at or above zero: small values put a mean of weight -1/alpha^2 against the
others, which costs as many digits and may leave a covariance that is none."""
BETA = 2.0
"""What is known of the fourth moment: 2 is best for a Gaussian."""
KURTOSIS = 3.0
"""n + kappa of a Gaussian in one dimension: kappa = max(3 - n, 0)."""


class UnscentedKalmanFilter(KalmanFilter):
    """The Kalman filter with the scaled unscented transform in place of Jacobians (Julier 2002).

    With lambda = alpha^2 (n + kappa) - n and L L^T = P the 2 n + 1 points are x and x +- sqrt(n + lambda) L_i, with the
    weights W_0 = lambda / (n + lambda) in the mean, W_0 + 1 - alpha^2 + beta in the covariance, and
    1 / (2 (n + lambda)) for the others in both. Of the images Y of the points

    predict:  x = sum W_i Y_i,  P = sum W_i (Y_i - x)(Y_i - x)^T + Q
    update:   nu = z - sum W_i Y_i,  S = sum W_i dY_i dY_i^T + R,  C = sum W_i dX_i dY_i^T,
              W = C S^-1,  x = x + W nu,  P = P - W S W^T

    Points are drawn anew for the update. A matrix in place of a model is taken as the linear filter takes it: the
    transform is exact there. ``transition`` of a nonlinear prediction is C^T P^-1 of its points, the statistical
    linearisation; along a direction of no variance it is zero.
    """

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        super().__init__(mean, covariance)
        n = self._shape[0]
        scale = ALPHA**2 * (n + max(KURTOSIS - n, 0.0))
        self._spread = float(np.sqrt(scale))
        self._mean_weights = np.full(2 * n + 1, 0.5 / scale)
        self._mean_weights[0] = (scale - n) / scale
        self._weights = self._mean_weights.copy()
        self._weights[0] += 1.0 - ALPHA**2 + BETA

    def predict(self, F: FloatArray | Transition, Q: FloatArray) -> None:
        """Advance by F, a matrix (n, n) or a model, and Q (n, n); see ``Filter.predict``."""
        if isinstance(F, np.ndarray):
            super().predict(F, Q)
            return
        n = self.mean.size
        offsets, L = self._offsets()
        images = F.through(self.mean + offsets)
        if images.shape != (2 * n + 1, n):
            raise FilterShapeError("f(X)", images.shape, f"({2 * n + 1}, {n})")
        if Q.shape != (n, n):
            raise FilterShapeError("Q", Q.shape, str((n, n)))
        if not vdot(images, images) < HUGE:
            raise FilterDiverged(f"prediction is not finite: images of the points {images.tolist()}")
        x, deviations, P = self._moments(images)
        P += Q
        self._take_prediction(x, 0.5 * (P + P.T))
        cross = self._cross(offsets, deviations)
        self._transition = lambda: _regression(cross, L)

    def update(self, z: FloatArray, H: FloatArray | Observation, R: FloatArray) -> Innovation:
        """Condition on z (m,) with H, a matrix (m, n) or a model, and R (m,) or (m, m); see ``Filter.update``."""
        if isinstance(H, np.ndarray):
            return super().update(z, H, R)
        m = z.size
        offsets, _ = self._offsets()
        images = H.through(self.mean + offsets)
        if z.ndim != 1 or images.shape != (offsets.shape[0], m):
            raise FilterShapeError("h(X)", images.shape, f"({offsets.shape[0]}, m) with z of shape {z.shape}")
        if R.shape not in ((m,), (m, m)):
            raise FilterShapeError("R", R.shape, f"({m},) or ({m}, {m})")
        if m == 0:
            return Learned(np.empty(0), 0.0, 0)
        noise = R if R.ndim == 2 else np.diag(R)
        if not (vdot(images, images) < HUGE and vdot(z, z) < HUGE and vdot(R, R) < HUGE):
            raise FilterDiverged(f"update is not finite: readings {z.tolist()}, or their expectation or noise")
        _check_noise(R)
        expected, deviations, S = self._moments(images)
        S += noise
        residual, cross = z - expected, self._cross(offsets, deviations)
        return self._take(residual, self._conditioner.on_moments(self.covariance, residual, cross, S))

    def _offsets(self) -> tuple[FloatArray, FloatArray]:
        """Points less the mean, shape (2 n + 1, n), and the root L (n, n) that they are made of."""
        n = self.mean.size
        L = square_root(self.covariance)
        offsets = np.zeros((2 * n + 1, n))
        offsets[1 : n + 1] = self._spread * L.T
        offsets[n + 1 :] = -offsets[1 : n + 1]
        return offsets, L

    def _moments(self, images: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        mean = self._mean_weights.dot(images)
        deviations = images - mean
        return mean, deviations, (deviations.T * self._weights).dot(deviations)

    def _cross(self, offsets: FloatArray, deviations: FloatArray) -> FloatArray:
        cross: FloatArray = (offsets.T * self._weights).dot(deviations)
        return cross


def _regression(cross: FloatArray, L: FloatArray) -> FloatArray:
    """A (k, n) with A P = cross^T, cross (n, k) = cov(x, y), P = L L^T: least squares, so that P may be singular."""
    half = np.linalg.lstsq(L, cross, rcond=None)[0]
    return np.array(np.linalg.lstsq(L.T, half, rcond=None)[0].T, dtype=np.float64)


def _check_noise(R: FloatArray) -> None:
    least = float(R.min()) if R.ndim == 1 else float(np.linalg.eigvalsh(R)[0])
    if not least > 0.0:
        raise FilterDiverged(f"R is not positive definite: least variance {least:.3g}")
