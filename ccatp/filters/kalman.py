"""Linear and extended Kalman filter, thesis eqs 2.5 to 2.13, for any number of states and measurements.

Matrices are small: a step is a dozen calls of BLAS and LAPACK into buffers that are kept, with positional arguments in
the order of ``scipy.linalg.blas``: keywords cost three times what a product of 4 x 4 costs.
"""

import numpy as np
from numpy import ndarray
from scipy.linalg.blas import daxpy, dcopy, ddot, dgemm, dsymm, dsyrk, dtrmm, dtrsm
from scipy.linalg.lapack import dgeqrf, dpotrf

from ccatp.core import FloatArray
from ccatp.filters.base import (
    HUGE,
    NEGATIVITY,
    FilterDiverged,
    FilterShapeError,
    Innovation,
    Observation,
    Transition,
    check_rows,
    checked_gaussian,
)

STRONGEST = 3e3
"""Largest variance of a row over its noise at which the prior is simply subtracted: it costs that many digits, and the
same number bounds what rows that nearly repeat each other cost. Beyond it a QR factorisation does the update."""
MANY = 32
"""Rows beyond which a QR factorisation costs less than one of S."""


class _Rows:
    """Buffers for m measurement rows: H^T above zeros (n + 1, m), V (n + 1, m), S (m, m), and arguments of their calls.

    V is P H^T above the residual nu^T, in the end P H^T C^-T above (C^-1 nu)^T, with S = H P H^T + R = C C^T.
    """

    def __init__(self, n: int, m: int, M: FloatArray, U: FloatArray) -> None:
        self.H, self.V = np.zeros((n + 1, m), order="F"), np.empty((n + 1, m), order="F")
        self.S, stack = np.empty((m, m), order="F"), np.empty((n + m, n + 1), order="F")
        self.H_rows, self.S_rows, self.V_rows = self.H.T[:, :n], self.S.T, self.V.T
        self.V_flat, self.S_flat, self.residual = self.V.ravel(order="K"), self.S.ravel(order="K"), self.V[n]
        self.S_diagonal, self.sigma = self.S_flat[:: m + 1], np.empty(m)
        self.sigmas, self.top, self.bottom, self.triangle = self.sigma[:, None], stack[:m], stack[m:], stack[: n + 1]
        self.H_shape, self.S_shape = (m, n), (m, m)
        self.project = 1.0, M, self.H, 0.0, self.V, 0, 0, 1  # V = M H^T
        self.spread = 1.0, self.H, self.V, 0.0, self.S, 1, 0, 1  # S = H V
        self.factor = self.S, 1, 0, 1  # S -> C
        self.solve = 1.0, self.S, self.V, 1, 1, 1, 0, 1  # V -> V C^-T
        self.reduce = -1.0, self.V, 1.0, M, 0, 0, 1  # M -> M - V V^T
        self.squares = self.V_flat, self.V_flat, m, n, n + 1, n, n + 1  # y^T y
        self.load = self.H.ravel(order="K"), self.V_flat
        self.rotate = 1.0, U, self.V, 0, 0, 0, 0, 1  # V -> U V
        self.triangulate = stack, n + 1, 1  # R of QR in the upper triangle


class KalmanFilter:
    """The Kalman filter of thesis eq. 2.13.

    predict:  x = F x,  P = F P F^T + Q                                      (2.5, 2.6; no input u)
    update:   nu = z - H x                                                   (2.7)
              W = P H^T (H P H^T + R)^-1,  x = x + W nu,  P = (I - W H) P    (2.8 to 2.10)

    The printed form of 2.10 loses symmetry and then definiteness by rounding. With S = H P H^T + R = C C^T,
    V = P H^T C^-T and y = C^-1 nu the same posterior is x + V y, P - V V^T, and y^T y is the normalised innovation
    squared. Mean and covariance are kept as one matrix M = [P -x; -x^T 0], of which only the upper triangle is used:
    a product with M is one with P and one with x, and one symmetric product, of V above y^T, gives all three results.

    The subtraction errs by 1e-16 of the prior. Where the posterior is much smaller, or rows nearly repeat each other, a
    QR factorisation takes its place (``_rotate``).

    A nonlinear model is taken with its Jacobian at the mean, F = df/dx and H = dh/dx: the extended filter.
    """

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        self._shape: tuple[int, ...] = np.shape(covariance)
        checked = checked_gaussian(mean, covariance, self._shape)
        self._n = n = checked[0].size
        self._M, kept, product, self._U, self._C = (np.zeros((n + 1, n + 1), order="F") for _ in range(5))
        self._F, Q = np.eye(n + 1), np.zeros((n + 1, n + 1))  # with the row and the column of the mean
        M, self._flat = self._M, self._M.ravel(order="K")
        self._P_rows, self._minus_x, self._diagonal = M.T[:n, :n], M[:n, n], self._flat[: -1 : n + 2]
        self._F_rows, self._Q_rows = self._F[:n, :n], Q[:n, :n]
        self._keep = self._flat, kept.ravel(order="K")
        self._restore = self._keep[::-1]
        self._multiply = 1.0, M, self._F.T, 0.0, product, 0, 0, 1  # product = M F^T
        self._load = Q.ravel(), self._flat
        self._propagate = 1.0, self._F.T, product, 1.0, M, 1, 0, 1  # M -> F product + M
        self._squares = self._flat, self._flat
        self._load_root = self._flat, self._U.ravel(order="K")
        self._U_column, self._U_row, self._unit = self._U[:, n], self._U[n, :n], np.eye(n + 1)[n]
        self._C_flat = self._C.ravel(order="K")
        self._rows: dict[tuple[int, ...], _Rows] = {}
        self._identity = np.eye(n, n + 1)
        row, column = np.indices((n, n))
        self._mirror = np.minimum(row, column) + (n + 1) * np.maximum(row, column)  # of the upper triangle in M
        self._mean: FloatArray | None
        self._covariance: FloatArray | None
        self._start(*checked)

    @property
    def mean(self) -> FloatArray:
        """x, shape (n,)."""
        if self._mean is None:
            self._mean = -self._minus_x
        return self._mean

    @property
    def covariance(self) -> FloatArray:
        """P, shape (n, n), symmetric to the last bit."""
        if self._covariance is None:
            self._covariance = self._flat.take(self._mirror)
        return self._covariance

    @property
    def transition(self) -> FloatArray:
        """F of the last prediction, shape (n, n); see ``Filter.transition``."""
        return self._F_rows.copy()

    def reset(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Re-initialise with copies of ``mean`` (n,) and ``covariance`` (n, n); see ``Filter.reset``."""
        self._start(*checked_gaussian(mean, covariance, self._shape))

    def predict(self, F: FloatArray | Transition, Q: FloatArray) -> None:
        """Advance by F (n, n) and Q (n, n), thesis eqs 2.5 and 2.6; see ``Filter.predict``."""
        x = None
        if not isinstance(F, ndarray):
            x, F = F.at(self.mean)
            if x.shape != self._shape[:1]:
                raise FilterShapeError("f(x)", x.shape, str(self._shape[:1]))
            if not ddot(x, x) < HUGE:
                raise FilterDiverged(f"prediction is not finite: mean {x.tolist()}")
        if F.shape != self._shape:
            raise FilterShapeError("F" if x is None else "df/dx", F.shape, str(self._shape))
        if Q.shape != self._shape:
            raise FilterShapeError("Q", Q.shape, str(self._shape))
        self._F_rows[...] = F
        self._Q_rows[...] = Q
        dcopy(*self._keep)
        dsymm(*self._multiply)
        dcopy(*self._load)
        dgemm(*self._propagate)
        # BLAS does not warn where it overflows.
        if not ddot(*self._squares) < HUGE:
            predicted = -self._minus_x
            dcopy(*self._restore)
            self._F_rows[...] = np.eye(self._n)
            raise FilterDiverged(f"prediction is not finite: mean {predicted.tolist()}")
        if x is not None:
            np.negative(x, self._minus_x)
        self._mean = self._covariance = None

    def update(self, z: FloatArray, H: FloatArray | Observation, R: FloatArray) -> Innovation:
        """Condition on z (m,) = H x + noise, thesis eqs 2.7 to 2.10; see ``Filter.update``."""
        expected = None
        if not isinstance(H, ndarray):
            expected, H = H.at(self.mean)
            if expected.shape != z.shape:
                raise FilterShapeError("z", z.shape, f"{expected.shape} of h(x)")
        shape = z.shape
        rows = self._rows.get(shape)
        if rows is None or H.shape != rows.H_shape or not (R.shape == shape or R.shape == rows.S_shape):  # noqa: PLR1714
            check_rows(z, H, R, self._n)
            if not z.size:
                return Innovation(np.empty(0), 0.0)
            rows = self._new_rows(z.size)
        rows.H_rows[...] = H
        dsymm(*rows.project)
        m, n = shape[0], self._n
        daxpy(z, rows.V_flat, m, 1.0, 0, 1, n, n + 1)
        if expected is not None:
            np.subtract(z, expected, rows.residual)
        residual = rows.residual.tolist()
        if m <= MANY:
            dgemm(*rows.spread)
            if R.ndim == 1:
                noise = R.tolist()
                daxpy(R, rows.S_flat, m, 1.0, 0, 1, 0, m + 1)
            else:
                noise = (noise_root(R).diagonal() ** 2).tolist()
                np.add(rows.S_rows, R, rows.S_rows)
            for s, r in zip(rows.S_diagonal.tolist(), noise):  # noqa: B905 - of one length; checking that takes longer
                # The first comparison fails where P is no covariance, each where a number is not finite.
                if not r <= s < STRONGEST * r:
                    break
            else:
                if not dpotrf(*rows.factor)[1]:
                    return self._subtract(rows, residual)
        return self._rotate(rows, residual, R)

    def _start(self, mean: FloatArray, covariance: FloatArray) -> None:
        self._minus_x[:], self._P_rows[:] = -mean, covariance
        self._F_rows[:] = np.eye(self._n)
        self._mean = self._covariance = None

    def _new_rows(self, m: int) -> _Rows:
        rows = self._rows[(m,)] = _Rows(self._n, m, self._M, self._U)
        return rows

    def _subtract(self, rows: _Rows, residual: list[float]) -> Innovation:
        """Update M to x + V y and P - V V^T, from P H^T above the residual and C in ``rows``."""
        dtrsm(*rows.solve)
        nis: float = ddot(*rows.squares)
        if not nis < HUGE:
            raise FilterDiverged(f"update is not finite: NIS {nis:.3g}, residuals {residual}")
        dsyrk(*rows.reduce)
        self._flat[-1] = 0.0
        self._mean = self._covariance = None
        return Innovation(residual, nis)

    def _rotate(self, rows: _Rows, residual: list[float], R: FloatArray) -> Innovation:
        """As the least-squares problem that eqs 2.8 to 2.10 solve, without a difference of covariances.

        With P = L L^T and x = x + L u the posterior is the solution of ``u = 0, A u = b`` with A = H L, b = nu, both
        whitened by R. A QR factorisation of the stacked rows ``[A b; I 0]`` holds all of it: the triangle C with
        C^T C = I + A^T A gives P = (L C^-1) (L C^-1)^T, its last column gives u, and the corner squared is the NIS.
        A prior far wider than the measurement costs no digits, and many rows cost little.
        """
        U, C = self._U, self._C
        dcopy(*self._load_root)
        self._U_column[...] = self._unit
        if dpotrf(U, 0, 1, 1)[1]:
            U[:-1, :-1] = np.triu(dgeqrf(square_root(self.covariance).T)[0])
        nu = rows.residual.copy()
        dcopy(*rows.load)
        rows.residual[...] = nu
        dtrmm(*rows.rotate)  # [A b]^T, with L = U^T
        # The measurement, which may be far more exact than the prior, stands first: a reflection that took its rows
        # into those of the prior would leave their rounding there.
        if R.ndim == 1:
            least = min(R.tolist())
            if not (least > 0.0 and ddot(R, R) + ddot(rows.V_flat, rows.V_flat) < HUGE):
                raise FilterDiverged(f"update is not finite: residuals {residual}, least variance {least:.3g}")
            np.sqrt(R, rows.sigma)
            np.divide(rows.V_rows, rows.sigmas, rows.top)
        else:
            rows.top[...] = dtrsm(1.0, noise_root(R), rows.V_rows, 0, 1)
        rows.bottom[...] = self._identity
        dgeqrf(*rows.triangulate)
        C[...] = rows.triangle
        corner = C.item(-1)
        self._C_flat[-1] = 1.0
        dtrsm(1.0, C, U, 0, 0, 1, 0, 1)  # (L C^-1)^T above the negative change of x
        minus_x, nis = self._minus_x + self._U_row, corner * corner
        if not nis + ddot(minus_x, minus_x) < HUGE:
            raise FilterDiverged(f"update is not finite: NIS {nis:.3g}, residuals {residual}")
        self._U_row[...] = 0.0
        dsyrk(1.0, U, 0.0, self._M, 1, 0, 1)
        self._minus_x[...], self._flat[-1] = minus_x, 0.0
        self._mean = self._covariance = None
        return Innovation(residual, nis)


def square_root(P: FloatArray) -> FloatArray:
    """L (n, n) with L L^T = P: lower Cholesky factor, or by eigenvectors.

    Raises ``FilterDiverged`` where P is not semidefinite.
    """
    L: FloatArray
    L, info = dpotrf(P, 1, 1)
    if info == 0:
        return L
    if not np.isfinite(P).all():
        raise FilterDiverged("covariance is not finite")
    values = np.linalg.eigvalsh(P)
    if values[0] < -NEGATIVITY * abs(values[-1]):
        raise FilterDiverged(f"covariance is not positive semidefinite: least eigenvalue {values[0]:.3g}")
    # In units of the states' own sigmas: a state known exactly keeps its zeros, a small one is not lost beside a large.
    sigma = np.sqrt(np.maximum(P.diagonal(), 0.0))
    per_sigma = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
    values, vectors = np.linalg.eigh(P * per_sigma[:, None] * per_sigma)
    return np.asfortranarray(sigma[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def noise_root(R: FloatArray) -> FloatArray:
    """Lower Cholesky factor of R (m, m); raises ``FilterDiverged`` where R is not positive definite."""
    factor: FloatArray
    factor, info = dpotrf(R, 1, 1)
    if info != 0:
        raise FilterDiverged("R is not positive definite")
    return factor
