"""Linear and extended Kalman filter, thesis eqs 2.5 to 2.13, for any number of states and measurements.

The matrices are small. A step is a dozen calls of BLAS and LAPACK into reused buffers. Arguments are positional, in the
order of ``scipy.linalg.blas``, because keywords cost three times as much as a product of 4 x 4.
"""

import numpy as np
from numpy import ndarray
from scipy.linalg.blas import daxpy, dcopy, ddot, dgemm, dsymm, dtrmm, dtrsm
from scipy.linalg.lapack import dgeqrf, dpotrf

from ccatp.core import FloatArray
from ccatp.filters.base import (
    HUGE,
    NEGATIVITY,
    FilterDiverged,
    FilterModel,
    FilterShapeError,
    Innovation,
    check_rows,
    checked_gaussian,
)

STRONGEST = 3e3
"""Largest ratio of a row's variance to its noise for one subtraction, which loses digits by this factor; so do rows
that nearly repeat each other. Up to the square of it an update has two subtractions, beyond it a QR factorisation."""
MANY = 32
"""Number of rows beyond which a QR factorisation costs less than one of S."""


class _Rows:
    """Buffers for m measurement rows: H^T above zeros (n + 1, m), V (n + 1, m), S (m, m), and the arguments of BLAS.

    V is P H^T above the residual nu^T, and later P H^T C^-T above (C^-1 nu)^T, with S = H P H^T + R = C C^T. More than
    four rows are padded with zero rows to a multiple of four, which BLAS computes faster.
    """

    def __init__(self, n: int, m: int, M: FloatArray, U: FloatArray) -> None:
        size = m if m <= 4 else m + -m % 4
        H, V, S = (np.zeros((rows, size), order="F") for rows in (n + 1, n + 1, size))
        self.V, self.S, self.S_flat = V, S, S.ravel(order="K")
        self.H_rows, self.S_rows, self.V_rows = H.T[:m, :n], S.T[:m, :m], V.T[:m]
        self.V_flat, self.residual = V.ravel(order="K"), V[n, :m]
        self.step, self.is_many, self.is_filled_up = size + 1, m > MANY, size > m
        self.S_diagonal, self.empty = self.S_flat[: m * size : size + 1], self.S_flat[m * size + m :: size + 1]
        self.project = 1.0, M, H, 0.0, V, 0, 0, 1  # V = M H^T
        self.spread = 1.0, H, V, 0.0, S, 1, 0, 1  # S = H V, still without R
        self.factor = S, 1, 0, 1  # S -> C
        self.solve = 1.0, S, V, 1, 1, 1, 0, 1  # V -> V C^-T
        self.reduce = -1.0, V, V, 1.0, M, 0, 1, 1  # M -> M - V V^T
        self.squares = self.V_flat, self.V_flat, m, n, n + 1, n, n + 1  # y^T y
        self.load = H.ravel(order="K"), self.V_flat
        self.rotate = 1.0, U, V, 0, 0, 0, 0, 1  # V -> U V
        self.stack, self.sigma = np.empty((n + m, n + 1), order="F"), np.empty(m)
        self.checked_H = self.checked_R = np.empty(0)


class KalmanFilter:
    """The Kalman filter of thesis eq. 2.13.

    predict:  x = F x,  P = F P F^T + Q                                      (2.5, 2.6; no input u)
    update:   nu = z - H x                                                   (2.7)
              W = P H^T (H P H^T + R)^-1,  x = x + W nu,  P = (I - W H) P    (2.8 to 2.10)

    The printed form of 2.10 loses symmetry and then definiteness by rounding. With S = H P H^T + R = C C^T,
    V = P H^T C^-T and y = C^-1 nu the same posterior is x + V y, P - V V^T, and y^T y is the normalised innovation
    squared. Mean and covariance are stored as one matrix M = [P -x; -x^T c]. So a product with M includes those with P
    and with x, and one product of V above y^T gives all three results. The corner c is multiplied only by zeros.

    A prediction reads only the upper triangle of M, so that the two halves differ at most by the rounding of one
    prediction and the updates after it. Elsewhere general products are used, because BLAS is slower for small symmetric
    ones. The subtraction has an error of 1e-16 of the prior. If the posterior is much smaller, an update has two of
    them (``_subtract_twice``); if it is smaller still, or rows are many, a QR factorisation (``_rotate``).

    A nonlinear model is used with its Jacobian at the mean, F = df/dx and H = dh/dx: the extended filter.
    """

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        self._shape: tuple[int, ...] = np.shape(covariance)
        checked = checked_gaussian(mean, covariance, self._shape)
        self._n = n = checked[0].size
        self._M, predicted, noise, product, self._U, self._C = (np.zeros((n + 1, n + 1), order="F") for _ in range(6))
        self._F = np.eye(n + 1)  # with the row and the column of the mean
        M, self._flat = self._M, self._M.ravel(order="K")
        self._P_rows, self._minus_x, self._minus_x_row = M.T[:n, :n], M[:n, n], M[n, :n]
        self._F_rows, self._Q_rows, self._predicted_minus_x = self._F[:n, :n], noise.T[:n, :n], predicted[:, n]
        self._multiply = 1.0, M, self._F.T, 0.0, product, 0, 0, 1  # product = M F^T
        self._propagate = 1.0, self._F.T, product, 1.0, predicted, 1, 0, 1  # predicted = F product + Q
        self._load = noise.ravel(order="K"), predicted.ravel(order="K")
        self._accept = predicted.ravel(order="K"), self._flat
        self._squares = self._accept[0], self._accept[0], (n + 1) ** 2 - 1  # without the corner
        self._U_column, self._U_row, self._unit = self._U[:, n], self._U[n, :n], np.eye(n + 1)[n]
        self._rows: dict[tuple[int, ...], _Rows] = {}
        self._checked_F = self._checked_Q = np.empty(0)
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

    def predict(self, F: FloatArray | FilterModel, Q: FloatArray) -> None:
        """Advance by F (n, n) and Q (n, n), thesis eqs 2.5 and 2.6; see ``Filter.predict``."""
        x = None
        if F is not self._checked_F or Q is not self._checked_Q:
            F, x = self._check_transition(F, Q)
        self._F_rows[...] = F
        self._Q_rows[...] = Q
        dcopy(*self._load)
        dsymm(*self._multiply)
        dgemm(*self._propagate)
        # BLAS does not report an overflow.
        if not ddot(*self._squares) < HUGE:
            self._F_rows[...] = np.eye(self._n)
            raise FilterDiverged(f"prediction is not finite: mean {(-self._predicted_minus_x[:-1]).tolist()}")
        dcopy(*self._accept)
        if x is not None:
            np.negative(x, self._minus_x)
            np.negative(x, self._minus_x_row)
        self._mean = self._covariance = None

    def _check_transition(self, F: FloatArray | FilterModel, Q: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """F, and f(x) for a model, else None. Raises as ``Filter.predict``."""
        name, x = "F", None
        if not isinstance(F, ndarray):
            x, F = F.at(self.mean)
            name = "df/dx"
            if x.shape != self._shape[:1]:
                raise FilterShapeError("f(x)", x.shape, str(self._shape[:1]))
            if not ddot(x, x) < HUGE:
                raise FilterDiverged(f"prediction is not finite: mean {x.tolist()}")
        if F.shape != self._shape:
            raise FilterShapeError(name, F.shape, str(self._shape))
        if Q.shape != self._shape:
            raise FilterShapeError("Q", Q.shape, str(self._shape))
        self._checked_F, self._checked_Q = F, Q
        return F, x

    def update(self, z: FloatArray, H: FloatArray | FilterModel, R: FloatArray) -> Innovation:
        """Condition on z (m,) = H x + noise, thesis eqs 2.7 to 2.10; see ``Filter.update``."""
        expected = None
        rows = self._rows.get(z.shape)
        if rows is None or H is not rows.checked_H or R is not rows.checked_R:
            rows, H, expected = self._check_measurement(z, H, R)
            if rows is None:
                return Innovation([], 0.0)
        rows.H_rows[...] = H
        dgemm(*rows.project)
        n = self._n
        if expected is None:
            daxpy(z, rows.V_flat, z.size, 1.0, 0, 1, n, n + 1)
        else:
            nu = z - expected
            z = nu - rows.residual  # the reading of the linear model H x with the same residual
            rows.residual[...] = nu
        residual = rows.residual.tolist()
        if rows.is_many:
            return self._rotate(rows, residual, R)
        noise = R.tolist() if R.ndim == 1 else (noise_root(R).diagonal() ** 2).tolist()
        dgemm(*rows.spread)
        ratio = 0.0
        for s, r in zip(rows.S_diagonal.tolist(), noise):  # noqa: B905 - of one length; checking that takes longer
            # The first comparison fails if P is not a covariance, both fail if a number is not finite.
            if not 0.0 <= s < STRONGEST * STRONGEST * r:
                return self._rotate(rows, residual, R)
            if s > ratio * r:
                ratio = s / r
        if ratio <= STRONGEST:
            nis = self._subtract(rows, residual, R, 1.0)
            return self._rotate(rows, residual, R) if nis is None else Innovation(residual, nis)
        return self._subtract_twice(rows, z, R, STRONGEST / ratio)

    def _check_measurement(
        self, z: FloatArray, H: FloatArray | FilterModel, R: FloatArray
    ) -> tuple[_Rows | None, FloatArray, FloatArray | None]:
        """Buffers (None for no rows), H, and h(x) for a model, else None. Raises ``FilterShapeError``."""
        expected = None
        if not isinstance(H, ndarray):
            expected, H = H.at(self.mean)
            if expected.shape != z.shape:
                raise FilterShapeError("z", z.shape, f"{expected.shape} of h(x)")
        check_rows(z, H, R, self._n)
        if not z.size:
            return None, H, expected
        rows = self._rows.get(z.shape) or self._new_rows(z.size)
        rows.checked_H, rows.checked_R = H, R
        return rows, H, expected

    def _start(self, mean: FloatArray, covariance: FloatArray) -> None:
        self._minus_x[:], self._minus_x_row[:], self._P_rows[:] = -mean, -mean, covariance
        self._F_rows[:] = np.eye(self._n)
        self._mean = self._covariance = None

    def _new_rows(self, m: int) -> _Rows:
        rows = self._rows[(m,)] = _Rows(self._n, m, self._M, self._U)
        return rows

    def _subtract(self, rows: _Rows, residual: list[float], R: FloatArray, share: float) -> float | None:
        """Update M to x + V y and P - V V^T with R / ``share``, from P H^T above the residual and H P H^T in ``rows``.

        Returns the NIS; None, without a change, if P is not a covariance.
        """
        if R.ndim == 1:
            daxpy(R, rows.S_flat, R.size, 1.0 / share, 0, 1, 0, rows.step)
        else:
            np.add(rows.S_rows, R / share, rows.S_rows)
        if rows.is_filled_up:
            rows.empty.fill(1.0)
        return None if dpotrf(*rows.factor)[1] else self._reduce(rows, residual, share)

    def _reduce(self, rows: _Rows, residual: list[float], share: float = 1.0) -> float:
        """``_subtract`` with S = C C^T in ``rows``; returns the NIS."""
        dtrsm(*rows.solve)
        nis: float = ddot(*rows.squares)
        if not nis < HUGE * share:  # with R instead of R / share it is at most nis / share
            raise FilterDiverged(f"update is not finite: NIS {nis:.3g}, residuals {residual}")
        dgemm(*rows.reduce)
        self._mean = self._covariance = None
        return nis

    def _subtract_twice(self, rows: _Rows, z: FloatArray, R: FloatArray, share: float) -> Innovation:
        """Update with a ``share`` of the information of z, then with the rest; buffers as for ``_subtract``.

        A reading with the noise R is as good as two independent ones of the same value with the noises R / share and
        R / (1 - share); their NIS add up. Each subtraction loses only as many digits as it reduces the covariance, and
        the second one reduces the error of the first one with it.
        """
        residual, n, before = rows.residual.tolist(), self._n, self._U
        before[...] = self._M
        nis = self._subtract(rows, residual, R, share)
        if nis is not None:
            dgemm(*rows.project)
            daxpy(z, rows.V_flat, z.size, 1.0, 0, 1, n, n + 1)
            dgemm(*rows.spread)
            rest = self._subtract(rows, residual, R, 1.0 - share)
            if rest is not None:
                return Innovation(residual, nis + rest)
            self._M[...], rows.residual[...] = before, residual
        return self._rotate(rows, residual, R)

    def _rotate(self, rows: _Rows, residual: list[float], R: FloatArray) -> Innovation:
        """Update by least squares, which solve eqs 2.8 to 2.10 without a difference of covariances.

        With P = L L^T and x = x + L u the posterior is the solution of ``u = 0, A u = b`` with A = H L, b = nu, both
        whitened by R. It follows from a QR factorisation of the stacked rows ``[A b; I 0]``: the triangle C with
        C^T C = I + A^T A gives P = (L C^-1) (L C^-1)^T, its last column gives u, and the corner squared is the NIS.
        A prior far wider than the measurement loses no digits, and many rows cost little.
        """
        m, n, U, C, stack = len(residual), self._n, self._U, self._C, rows.stack
        U[...] = self._M
        self._U_column[...] = self._unit
        if dpotrf(U, 0, 1, 1)[1]:
            U[:-1, :-1] = np.triu(dgeqrf(square_root(self.covariance).T)[0])
        nu = rows.residual.copy()
        dcopy(*rows.load)
        rows.residual[...] = nu
        dtrmm(*rows.rotate)  # [A b]^T, with L = U^T
        # The rows of the measurement, which may be far more exact than the prior, come first. In the other order the
        # reflections would leave their rounding errors in the rows of the prior.
        if R.ndim == 1:
            least = min(R.tolist())
            if not (least > 0.0 and ddot(R, R) + ddot(rows.V_flat, rows.V_flat) < HUGE):
                raise FilterDiverged(f"update is not finite: residuals {residual}, least variance {least:.3g}")
            np.sqrt(R, rows.sigma)
            np.divide(rows.V_rows, rows.sigma[:, None], stack[:m])
        else:
            stack[:m] = dtrsm(1.0, noise_root(R), rows.V_rows, 0, 1)
        stack[m:] = self._identity
        dgeqrf(stack, n + 1, 1)  # R of QR in the upper triangle
        C[...] = stack[: n + 1]
        corner = C.item(-1)
        C[n, n] = 1.0
        dtrsm(1.0, C, U, 0, 0, 1, 0, 1)  # (L C^-1)^T above the negative change of x
        minus_x, nis = self._minus_x + self._U_row, corner * corner
        if not nis + ddot(minus_x, minus_x) < HUGE:
            raise FilterDiverged(f"update is not finite: NIS {nis:.3g}, residuals {residual}")
        self._U_row[...] = 0.0
        dgemm(1.0, U, U, 0.0, self._M, 1, 0, 1)
        self._minus_x[...] = self._minus_x_row[...] = minus_x
        self._mean = self._covariance = None
        return Innovation(residual, nis)


def square_root(P: FloatArray) -> FloatArray:
    """L (n, n) with L L^T = P: Cholesky factor, or by eigenvectors; ``FilterDiverged`` if P is not semidefinite."""
    L: FloatArray
    L, info = dpotrf(P, 1, 1)
    if info == 0:
        return L
    if not np.isfinite(P).all():
        raise FilterDiverged("covariance is not finite")
    values = np.linalg.eigvalsh(P)
    if values[0] < -NEGATIVITY * abs(values[-1]):
        raise FilterDiverged(f"covariance is not positive semidefinite: least eigenvalue {values[0]:.3g}")
    # In units of the states' own sigmas, so that an exact state keeps its zeros and a small one its digits.
    sigma = np.sqrt(np.maximum(P.diagonal(), 0.0))
    per_sigma = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
    values, vectors = np.linalg.eigh(P * per_sigma[:, None] * per_sigma)
    return np.asfortranarray(sigma[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def noise_root(R: FloatArray) -> FloatArray:
    """Lower Cholesky factor of R (m, m); raises ``FilterDiverged`` if R is not positive definite."""
    factor: FloatArray
    factor, info = dpotrf(R, 1, 1)
    if info != 0:
        raise FilterDiverged("R is not positive definite")
    return factor
