"""Pure. Linear Kalman filter, thesis eqs 2.5 to 2.13."""

import numpy as np
from numpy import vdot

from ccatp.filters.base import (
    HUGE,
    FilterDiverged,
    FilterModelError,
    FilterShapeError,
    FloatArray,
    Innovation,
    Observation,
    Transition,
    check_gaussian,
)
from ccatp.filters.conditioning import Conditioner, Posterior


class KalmanFilter:
    """The Kalman filter of thesis eq. 2.13.

    predict:  x = F x,  P = F P F^T + Q                                      (2.5, 2.6; no input u)
    update:   nu = z - H x                                                   (2.7)
              W = P H^T (H P H^T + R)^-1,  x = x + W nu,  P = (I - W H) P    (2.8 to 2.10)

    The printed form of 2.10 loses symmetry and then definiteness by rounding; ``Conditioner`` computes the same
    posterior from Cholesky and QR factors.

    Attributes:
        mean: x, shape (n,).
        covariance: P, shape (n, n).
        transition: F of the last prediction, shape (n, n).
    """

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        self.mean: FloatArray = np.empty(0)
        self._P: FloatArray = np.empty((0, 0))
        self._is_symmetric = True
        self.reset(mean, covariance)

    @property
    def covariance(self) -> FloatArray:
        """P, shape (n, n), symmetric to the last bit."""
        if not self._is_symmetric:
            P = self._P
            self._P = 0.5 * (P + P.T)
            self._is_symmetric = True
        return self._P

    @covariance.setter
    def covariance(self, P: FloatArray) -> None:
        self._P, self._is_symmetric = P, True

    def reset(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Re-initialise with copies of ``mean`` (n,) and ``covariance`` (n, n); see ``Filter.reset``."""
        x = np.array(mean, dtype=np.float64)
        P = np.array(covariance, dtype=np.float64)
        check_gaussian(x, P)
        if self.mean.size and x.size != self.mean.size:
            raise FilterShapeError("mean", x.shape, f"({self.mean.size},)")
        if not self.mean.size:
            self._conditioner = Conditioner(x.size)
        self.mean = x
        self.covariance = 0.5 * (P + P.T)
        self.transition: FloatArray = np.eye(x.size)

    def predict(self, F: FloatArray | Transition, Q: FloatArray) -> None:
        """Advance by F (n, n) and Q (n, n), thesis eqs 2.5 and 2.6; see ``Filter.predict``."""
        if not isinstance(F, np.ndarray):
            raise FilterModelError("KalmanFilter", F)
        if F.shape != self._P.shape:
            raise FilterShapeError("F", F.shape, str(self._P.shape))
        if not vdot(F, F) < HUGE:
            raise FilterDiverged(f"prediction is not finite: transition {F.tolist()}")
        # The method, not the operator: on matrices this small it costs half.
        self._advance(F.dot(self.mean), F.copy(), Q)

    def update(self, z: FloatArray, H: FloatArray | Observation, R: FloatArray) -> Innovation:
        """Condition on z (m,) with H (m, n) and R (m,) or (m, m), thesis eqs 2.7 to 2.10; see ``Filter.update``."""
        if not isinstance(H, np.ndarray):
            raise FilterModelError("KalmanFilter", H)
        if z.ndim != 1:
            raise FilterShapeError("z", z.shape, "(m,)")
        if H.shape != (z.size, self.mean.size):
            raise FilterShapeError("H", H.shape, f"({z.size}, {self.mean.size})")
        return self._condition(z - H.dot(self.mean), H, R)

    def _advance(self, x: FloatArray, F: FloatArray, Q: FloatArray) -> None:
        """Put x (n,) and F P F^T + Q in place; both arrays are the filter's from now on."""
        P = F.dot(self._P).dot(F.T)
        if Q.shape != P.shape:
            raise FilterShapeError("Q", Q.shape, str(P.shape))
        P += Q
        self._take_prediction(x, P, F)

    def _take_prediction(self, x: FloatArray, P: FloatArray, F: FloatArray) -> None:
        if not (vdot(x, x) < HUGE and vdot(P, P) < HUGE):
            raise FilterDiverged(f"prediction is not finite: mean {x.tolist()}")
        self.mean, self._P, self._is_symmetric, self.transition = x, P, False, F

    def _condition(self, residual: FloatArray, H: FloatArray, R: FloatArray) -> Innovation:
        if residual.size == 0:
            return Innovation(residual, 0.0, 0)
        return self._take(residual, self._conditioner.on_rows(self._P, residual, H, R))

    def _take(self, residual: FloatArray, posterior: Posterior) -> Innovation:
        change, P, nis = posterior
        self.mean = self.mean + change
        self._P, self._is_symmetric = P, True
        return Innovation(residual, nis, residual.size)
