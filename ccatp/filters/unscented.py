"""Unscented Kalman filter: nonlinear models by sigma points, matrices as in ``KalmanFilter``."""

import numpy as np

from ccatp.core import FloatArray
from ccatp.filters.base import FilterDiverged, FilterModel, FilterShapeError, Innovation, is_finite, square_root
from ccatp.filters.kalman import KalmanFilter

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
    1 / (2 (n + lambda)) for the others in both. With the images Y of the points::

        predict:  x = sum W_i Y_i,  P = sum W_i (Y_i - x)(Y_i - x)^T + Q
        update:   nu = z - sum W_i Y_i,  S = sum W_i dY_i dY_i^T + R,  W = (sum W_i dX_i dY_i^T) S^-1,
                  x = x + W nu,  P = P - W S W^T

    An update draws new points. It is that of ``KalmanFilter`` with the deviations dX and dY, times the roots of their
    weights, in place of L and H L. With a matrix instead of a model, the linear filter is used, because the transform
    is exact there. ``transition`` of a nonlinear prediction is (sum W_i dY_i dX_i^T) P^-1 of its points, the
    statistical linearisation; it is zero along a direction without variance.
    """

    _regression: tuple[FloatArray, FloatArray] | None  # of the last prediction: sum W_i dX_i dY_i^T, and L

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        super().__init__(mean, covariance)
        n = self._states
        scale = ALPHA**2 * (n + max(KURTOSIS - n, 0.0))
        self._spread = float(np.sqrt(scale))
        self._weights = np.full(2 * n + 1, 0.5 / scale)
        self._weights[0] = (scale - n) / scale
        covariance_weights = self._weights.copy()
        covariance_weights[0] += 1.0 - ALPHA**2 + BETA
        self._roots = np.sqrt(covariance_weights)[:, None]

    @property
    def transition(self) -> FloatArray:
        """F, or the regression of the points, of the last prediction, shape (n, n); see ``Filter.transition``."""
        if self._regression is not None:
            cross, L = self._regression
            # A with A P = cross^T by least squares, because P = L L^T may be singular.
            half = np.linalg.lstsq(L, cross, rcond=None)[0]
            self._F = np.linalg.lstsq(L.T, half, rcond=None)[0].T
            self._regression = None
        return self._F

    def reset(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Re-initialise with copies of ``mean`` (n,) and ``covariance`` (n, n); see ``Filter.reset``."""
        super().reset(mean, covariance)
        self._regression = None

    def predict(self, F: FloatArray | FilterModel, Q: FloatArray) -> None:
        """Advance by F, a matrix (n, n) or a model, and Q (n, n); see ``Filter.predict``."""
        if isinstance(F, np.ndarray):
            super().predict(F, Q)
            self._regression = None
            return
        n, (L, offsets) = self._states, self._draw()
        images = F.through(self._x + offsets)
        if images.shape != (2 * n + 1, n):
            raise FilterShapeError("f(X)", images.shape, f"({2 * n + 1}, {n})")
        if Q.shape != (n, n):
            raise FilterShapeError("Q", Q.shape, str((n, n)))
        if not is_finite(images):
            raise FilterDiverged(f"prediction is not finite: images of the points {images.tolist()}")
        x = self._weights.dot(images)
        deviations = (images - x) * self._roots
        self._accept_prediction(x, deviations.T.dot(deviations) + Q, self._F)
        self._regression = (offsets * self._roots).T.dot(deviations), L

    def update(self, z: FloatArray, H: FloatArray | FilterModel, R: FloatArray) -> Innovation:
        """Condition on z (m,) by H, a matrix (m, n) or a model; see ``Filter.update``."""
        if isinstance(H, np.ndarray):
            return super().update(z, H, R)
        m, (_, offsets) = z.size, self._draw()
        images = H.through(self._x + offsets)
        if z.ndim != 1 or images.shape != (len(offsets), m):
            raise FilterShapeError("h(X)", images.shape, f"({len(offsets)}, m) with z of shape {z.shape}")
        if R.shape not in ((m,), (m, m)):
            raise FilterShapeError("R", R.shape, f"({m},) or ({m}, {m})")
        if m == 0:
            return Innovation(z, 0.0)
        if not is_finite(images):
            raise FilterDiverged(f"update is not finite: images of the points {images.tolist()}")
        expected = self._weights.dot(images)
        deviations = (images - expected) * self._roots
        return self._condition(z - expected, deviations.T, (offsets * self._roots).T, R)

    def _draw(self) -> tuple[FloatArray, FloatArray]:
        """L (n, n) with L L^T = P, and the points (2 n + 1, n) relative to the mean."""
        n, L = self._states, square_root(self.covariance)
        offsets = np.zeros((2 * n + 1, n))
        offsets[1 : n + 1] = self._spread * L.T
        offsets[n + 1 :] = -offsets[1 : n + 1]
        return L, offsets
