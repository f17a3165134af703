"""Linear and extended Kalman filter, thesis eqs 2.5 to 2.13, for any number of states and measurements.

The matrices of the thesis's four states (v, a, theta, omega) are, with the wheel radius r and the wheel base L,

    F = [1 dt 0  0]  (2.11)      a_x     = [ 0   1  0    0  ]      (2.12)
        [0  1 0  0]              omega_R = [1/r  0  0  L/2r ] x
        [0  0 1 dt]              omega_L = [1/r  0  0 -L/2r ]
        [0  0 0  1]              omega_z = [ 0   0  0    1  ]

(``ccatp.estimation.thesis_localizer``). Eqs 2.3 and 2.4 print theta_z in the last row; a gyroscope measures omega_z.
"""

import numpy as np
from numpy import ndarray
from scipy.linalg.blas import ddot, dgemm, dgemv, dtrsv
from scipy.linalg.lapack import dgeqrf, dormqr

from ccatp.core import FloatArray
from ccatp.filters.base import (
    HUGE,
    FilterDiverged,
    FilterModel,
    Innovation,
    beside_noise_root,
    check_rows,
    check_transition,
    checked_gaussian,
    is_finite,
    square_root,
)


class KalmanFilter:
    """The Kalman filter of thesis eq. 2.13, which lists eqs 2.5 to 2.10 again.

    ::

        predict:  x  = F x                              (2.5; there is no input u)
                  P  = F P F^T + Q                      (2.6)
        update:   nu = z - H x                          (2.7)
                  W  = P H^T S^-1,  S = H P H^T + R     (2.8)
                  x  = x + W nu                         (2.9)
                  P  = (I - W H) P                      (2.10)

    Eq. 2.10 as printed subtracts. By rounding P loses its symmetry, then its definiteness, and a posterior that is much
    smaller than the prior loses all its digits. Here P is kept as a square root, P = L L^T, and an orthogonal matrix
    Theta (Householder reflections, one for each row of H) makes the upper right block zero::

        [ H L  N ]          [ C  0  ]
        [  L   0 ]  Theta = [ V  L+ ],      R = N N^T

    The products of the rows are those of before, because Theta Theta^T = I: S = C C^T, P H^T = V C^T, and
    P = V V^T + L+ L+^T. So W = V C^-1 (2.8), W nu = V y with y = C^-1 nu (2.9), and L+ L+^T = P - W S W^T = (I - W H) P
    (2.10). y^T y is the normalised innovation squared. No covariance is subtracted from another one, at any ratio of
    prior to noise (Kaminski, Bryson, Schmidt 1971; docs/mathematics.md has the other forms that were measured).

    A nonlinear model is used with its Jacobian at the mean, F = df/dx and H = dh/dx: the extended filter.
    """

    _P: FloatArray | None  # L L^T, once it was read

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        self._states = int(np.size(mean))
        self.reset(mean, covariance)

    @property
    def mean(self) -> FloatArray:
        """x, shape (n,)."""
        return self._x

    @property
    def covariance(self) -> FloatArray:
        """P, shape (n, n), symmetric to the last bit."""
        if self._P is None:
            self._P = self._L.dot(self._L.T)
        return self._P

    @property
    def transition(self) -> FloatArray:
        """F of the last prediction, shape (n, n); see ``Filter.transition``."""
        return self._F

    def reset(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Re-initialise with copies of ``mean`` (n,) and ``covariance`` (n, n); see ``Filter.reset``."""
        x, P = checked_gaussian(mean, covariance, (self._states, self._states))
        self._L = square_root(P)
        self._x = x
        self._F = np.eye(self._states)
        self._P = P

    def predict(self, F: FloatArray | FilterModel, Q: FloatArray) -> None:
        """Advance by F (n, n) and Q (n, n), thesis eqs 2.5 and 2.6; see ``Filter.predict``."""
        ahead, F = (None, F) if isinstance(F, ndarray) else F.at(self._x)
        check_transition(ahead, F, Q, self._states)
        x = dgemv(1.0, F, self._x) if ahead is None else ahead.copy()  # 2.5
        FL = dgemm(1.0, F, self._L)
        self._accept_prediction(x, dgemm(1.0, FL, FL, beta=1.0, c=Q, trans_b=True), F.copy())  # 2.6: F L (F L)^T + Q

    def update(self, z: FloatArray, H: FloatArray | FilterModel, R: FloatArray) -> Innovation:
        """Condition on z (m,) = H x + noise, thesis eqs 2.7 to 2.10; see ``Filter.update``."""
        expected, H = (None, H) if isinstance(H, ndarray) else H.at(self._x)
        check_rows(z, expected, H, R, self._states)
        if z.size == 0:
            return Innovation(z, 0.0)
        nu = dgemv(-1.0, H, self._x, beta=1.0, y=z) if expected is None else z - expected  # 2.7
        return self._condition(nu, dgemm(1.0, H, self._L), self._L, R)

    def _accept_prediction(self, x: FloatArray, P: FloatArray, F: FloatArray) -> None:
        if not (ddot(x, x) < HUGE and is_finite(P)):
            raise FilterDiverged(f"prediction is not finite: mean {x.tolist()}")
        self._L = square_root(P)
        self._x = x
        self._F = F
        self._P = None

    def _condition(self, nu: FloatArray, HL: FloatArray, L: FloatArray, R: FloatArray) -> Innovation:
        """Eqs 2.8 to 2.10 with P = L L^T, L (n, k), and H L (m, k)."""
        m, (n, k) = nu.size, L.shape
        # In the other order, N before H L, the errors are larger (docs/mathematics.md).
        reflections, tau, _, _ = dgeqrf(beside_noise_root(HL, R).T, lwork=3 * m, overwrite_a=True)
        wide = np.zeros((n, k + m), order="F")
        wide[:, :k] = L
        wide, _, _ = dormqr("R", "N", reflections, tau, wide, lwork=n, overwrite_c=True)  # times Theta
        V, L = wide[:, :m], wide[:, m:]  # 2.8, 2.10
        y = dtrsv(reflections[:m], nu, trans=True)  # C^-1 nu; C^T is the upper triangle
        x = dgemv(1.0, V, y, beta=1.0, y=self._x)  # 2.9
        nis = ddot(y, y)
        if not ddot(x, x) + nis < HUGE:
            raise FilterDiverged(f"update is not finite: NIS {nis:.3g}, residuals {nu.tolist()}")
        self._x = x
        self._L = L
        self._P = None
        return Innovation(nu, nis)
