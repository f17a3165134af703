"""Extended Kalman filter: nonlinear models linearised at the mean, the rest as in ``KalmanFilter``."""

import numpy as np

from ccatp.core import FloatArray
from ccatp.filters.base import FilterShapeError, Innovation, Observation, Transition
from ccatp.filters.kalman import KalmanFilter


class ExtendedKalmanFilter(KalmanFilter):
    """The Kalman filter with F = df/dx and H = dh/dx at the mean (thesis eqs 2.5 to 2.10 with f and h in place).

    predict:  x = f(x),  P = F P F^T + Q
    update:   nu = z - h(x), the rest as in 2.8 to 2.10

    Arrays are taken as the linear filter takes them, and cost and result are the same.
    """

    def predict(self, F: FloatArray | Transition, Q: FloatArray) -> None:
        """Advance by F, a matrix (n, n) or a model, and Q (n, n); see ``Filter.predict``."""
        if isinstance(F, np.ndarray):
            super().predict(F, Q)
            return
        x, jacobian = F.at(self.mean)
        if x.shape != self._shape[:1]:
            raise FilterShapeError("f(x)", x.shape, str(self._shape[:1]))
        if jacobian.shape != self._shape:
            raise FilterShapeError("df/dx", jacobian.shape, str(self._shape))
        self._advance(x.copy(), jacobian, Q)

    def update(self, z: FloatArray, H: FloatArray | Observation, R: FloatArray) -> Innovation:
        """Condition on z (m,) with H, a matrix (m, n) or a model, and R (m,) or (m, m); see ``Filter.update``."""
        if isinstance(H, np.ndarray):
            return super().update(z, H, R)
        expected, jacobian = H.at(self.mean)
        if z.ndim != 1 or expected.shape != z.shape:
            raise FilterShapeError("z", z.shape, f"{expected.shape} of h(x)")
        m = z.size
        if jacobian.shape != (m, self._shape[0]):
            raise FilterShapeError("dh/dx", jacobian.shape, f"({m}, {self._shape[0]})")
        if R.shape not in (z.shape, (m, m)):
            raise FilterShapeError("R", R.shape, f"({m},) or ({m}, {m})")
        return self._condition(z - expected, jacobian, R)
