"""Linear Kalman filter, thesis eqs 2.5 to 2.13."""

from collections.abc import Callable

import numpy as np
from numpy import vdot
from scipy.linalg.blas import dgemm

from ccatp.core import FloatArray
from ccatp.filters.base import (
    HUGE,
    FilterDiverged,
    FilterModelError,
    FilterShapeError,
    Innovation,
    Learned,
    Observation,
    Transition,
    check_rows,
    checked_gaussian,
)
from ccatp.filters.block_kernel import advance
from ccatp.filters.conditioning import Conditioner, Posterior


class KalmanFilter:
    """The Kalman filter of thesis eq. 2.13, for any number of states.

    predict:  x = F x,  P = F P F^T + Q                                      (2.5, 2.6; no input u)
    update:   nu = z - H x                                                   (2.7)
              W = P H^T (H P H^T + R)^-1,  x = x + W nu,  P = (I - W H) P    (2.8 to 2.10)

    The printed form of 2.10 loses symmetry and then definiteness by rounding; ``Conditioner`` computes the same
    posterior from Cholesky and QR factors.

    Attributes:
        mean: x, shape (n,).
        covariance: P, shape (n, n), symmetric to the last bit.
    """

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        self._shape: tuple[int, ...] = np.shape(covariance)
        self._transition: FloatArray | Callable[[], FloatArray]
        self.reset(mean, covariance)
        self._conditioner = Conditioner(self.mean.size)

    @property
    def transition(self) -> FloatArray:
        """F of the last prediction, shape (n, n); see ``Filter.transition``."""
        found = self._transition
        if not isinstance(found, np.ndarray):
            found = self._transition = found()
        return found

    def reset(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Re-initialise with copies of ``mean`` (n,) and ``covariance`` (n, n); see ``Filter.reset``."""
        self.mean, self.covariance = checked_gaussian(mean, covariance, self._shape)
        self._transition = np.eye(self.mean.size)

    def predict(self, F: FloatArray | Transition, Q: FloatArray) -> None:
        """Advance by F (n, n) and Q (n, n), thesis eqs 2.5 and 2.6; see ``Filter.predict``."""
        if not isinstance(F, np.ndarray):
            raise FilterModelError("KalmanFilter", F)
        if F.shape != self._shape:
            raise FilterShapeError("F", F.shape, str(self._shape))
        self._advance(None, F, Q)

    def update(self, z: FloatArray, H: FloatArray | Observation, R: FloatArray) -> Innovation:
        """Condition on z (m,) with H (m, n) and R (m,) or (m, m), thesis eqs 2.7 to 2.10; see ``Filter.update``."""
        if not isinstance(H, np.ndarray):
            raise FilterModelError("KalmanFilter", H)
        check_rows(z, H, R, self._shape[0])
        return self._condition(z - H.dot(self.mean), H, R)

    def _advance(self, x: FloatArray | None, F: FloatArray, Q: FloatArray) -> None:
        """Predict: x <- the array given, which is kept, or F x; P <- F P F^T + Q."""
        if Q.shape != self._shape:
            raise FilterShapeError("Q", Q.shape, str(self._shape))
        P = advance(self.covariance, F, Q)
        if P is None:
            # One call of BLAS for F (P F^T) + Q, halved, and its transpose: symmetric to the last bit. Transposed views
            # are what it takes without a copy. Unlike numpy it does not warn where something is not finite.
            half = dgemm(1.0, F.T, dgemm(0.5, self.covariance.T, F.T), 0.5, Q.T, trans_a=1)
            P = half + half.T
        self._take_prediction(F.dot(self.mean) if x is None else x, P)
        self._transition = F.copy()

    def _take_prediction(self, x: FloatArray, P: FloatArray) -> None:
        """Put x and P in place; both arrays are the filter's from now on."""
        # vdot, because it does not warn where it overflows.
        if not vdot(x, x) + vdot(P, P) < HUGE:
            raise FilterDiverged(f"prediction is not finite: mean {x.tolist()}")
        self.mean, self.covariance = x, P

    def _condition(self, residual: FloatArray, H: FloatArray, R: FloatArray) -> Innovation:
        if residual.size == 0:
            return Learned(residual, 0.0, 0)
        return self._take(residual, self._conditioner.on_rows(self.covariance, residual, H, R))

    def _take(self, residual: FloatArray, posterior: Posterior) -> Innovation:
        change, P, nis = posterior
        self.mean, self.covariance = self.mean + change, P
        return Learned(residual, nis, residual.size)
