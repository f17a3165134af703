"""What the filters share: the ``Filter`` protocol, the innovation of an update, errors, checks and square roots."""

from typing import Protocol

import msgspec
import numpy as np
from scipy.linalg.blas import ddot
from scipy.linalg.lapack import dpotrf, dpstrf

from ccatp.core import FloatArray

ASYMMETRY = 1e-9
"""Largest relative asymmetry that counts as rounding of the caller's arithmetic."""
HUGE = 1e200
"""Sums of squares beyond it count as not finite, so that no product of smaller numbers overflows."""
NEGATIVITY = 1e-9
"""Largest negative part of a covariance, relative to its largest entry, that counts as rounding."""


class FilterError(Exception):
    """Base of the errors of a filter. The state remains that before the failed call."""


class FilterShapeError(FilterError):
    """An array does not fit the state; has its name and shape. The message has the required shape."""

    def __init__(self, name: str, shape: tuple[int, ...], wanted: str) -> None:
        super().__init__(f"{name} has shape {shape}, wanted {wanted}")
        self.name = name
        self.shape = shape


class FilterDiverged(FilterError):
    """A mean, covariance or noise is not that of a finite Gaussian; the message says which."""


class Innovation(msgspec.Struct, frozen=True, gc=False):
    """Residual and consistency of an update.

    ``residual``: nu = z - H x with the predicted state, shape (m,). ``nis``: nu^T (H P H^T + R)^-1 nu; chi-squared with
    m degrees of freedom if the filter is consistent.
    """

    residual: FloatArray
    nis: float

    @property
    def size(self) -> int:
        """m, the number of measurement rows."""
        return self.residual.size


class FilterModel(Protocol):
    """A nonlinear process model x <- f(x) or measurement model z = f(x) + noise; angles are not wrapped.

    The returned arrays belong to the model: they are valid until its next call, and a filter does not change them.
    """

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """f(x), shape (m,), and its Jacobian at x, shape (m, n)."""

    def through(self, X: FloatArray) -> FloatArray:
        """Image f of each row of X (k, n), shape (k, m)."""


class Filter(Protocol):
    """A Gaussian filter of n states, thesis fig. 2.8.

    ``mean`` and ``covariance`` return arrays that later calls do not change, so a caller may keep them. Without a
    change of the state they return the same arrays.
    """

    @property
    def mean(self) -> FloatArray:
        """State estimate, shape (n,)."""

    @property
    def covariance(self) -> FloatArray:
        """Its covariance, shape (n, n), positive semidefinite, symmetric to the last bit."""

    @property
    def transition(self) -> FloatArray:
        """F of the last prediction, shape (n, n): matrix, Jacobian, or regression by sigma points; first identity."""

    def predict(self, F: FloatArray | FilterModel, Q: FloatArray) -> None:
        """Advance the state: x <- F x, P <- F P F^T + Q (thesis eqs 2.5, 2.6), or the same with a nonlinear f.

        F and Q have shape (n, n). Raises ``FilterShapeError``, and ``FilterDiverged``: not finite, or P not positive
        semidefinite, because Q is not.
        """

    def update(self, z: FloatArray, H: FloatArray | FilterModel, R: FloatArray) -> Innovation:
        """Condition the state on z = H x + noise (thesis eqs 2.7 to 2.10), or on z = h(x) + noise.

        z (m,), m = 0 has no effect; H (m, n) or a model; R variances (m,) or covariance (m, m). Raises
        ``FilterShapeError``, and ``FilterDiverged``: posterior not finite, or R not positive definite.
        """

    def reset(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Re-initialise with copies of a mean (n,) and a covariance (n, n), the thesis's resetFilter(mu, Sigma).

        Raises ``FilterShapeError``, and ``FilterDiverged``: not finite, not symmetric or not positive semidefinite.
        """


def check_transition(x: FloatArray | None, F: FloatArray, Q: FloatArray, states: int) -> None:
    """Raises ``FilterShapeError`` where f(x) (n,) of a model, F (n, n) or Q (n, n) do not fit n ``states``."""
    wanted = (states, states)
    if x is not None and x.shape != (states,):
        raise FilterShapeError("f(x)", x.shape, f"({states},)")
    if F.shape != wanted:
        raise FilterShapeError("F" if x is None else "df/dx", F.shape, str(wanted))
    if Q.shape != wanted:
        raise FilterShapeError("Q", Q.shape, str(wanted))


def check_rows(z: FloatArray, expected: FloatArray | None, H: FloatArray, R: FloatArray, states: int) -> None:
    """Raises ``FilterShapeError`` where z (m,), h(x) (m,) of a model, H (m, n), R (m,) or (m, m) do not fit."""
    m = z.size
    if z.ndim != 1:
        raise FilterShapeError("z", z.shape, "(m,)")
    if expected is not None and expected.shape != (m,):
        raise FilterShapeError("z", z.shape, f"{expected.shape} of h(x)")
    if H.shape != (m, states):
        raise FilterShapeError("H", H.shape, f"({m}, {states})")
    if R.shape not in ((m,), (m, m)):
        raise FilterShapeError("R", R.shape, f"({m},) or ({m}, {m})")


def is_finite(a: FloatArray) -> bool:
    """Whether the sum of squares is below ``HUGE``."""
    entries = a.ravel("K")
    return bool(ddot(entries, entries) < HUGE)


def checked_gaussian(mean: FloatArray, covariance: FloatArray, shape: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    """Copies of mean (n,) and covariance of ``shape`` (n, n), symmetric to the last bit. Raises as ``Filter.reset``."""
    mean, covariance = np.array(mean, dtype=np.float64), np.array(covariance, dtype=np.float64)
    if mean.ndim != 1 or mean.size == 0:
        raise FilterShapeError("mean", mean.shape, "(n,), n >= 1")
    if covariance.shape != (mean.size, mean.size):
        raise FilterShapeError("covariance", covariance.shape, f"({mean.size}, {mean.size})")
    if covariance.shape != shape:
        raise FilterShapeError("mean", mean.shape, f"({shape[0]},)")
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise FilterDiverged(f"mean or covariance is not finite: mean {mean.tolist()}")
    scale = float(np.abs(covariance).max())
    if float(np.abs(covariance - covariance.T).max()) > ASYMMETRY * scale:
        raise FilterDiverged("covariance is not symmetric")
    least = float(np.linalg.eigvalsh(covariance)[0])
    if least < -NEGATIVITY * scale:
        raise FilterDiverged(f"covariance is not positive semidefinite: least eigenvalue {least:.3g}")
    return mean, 0.5 * (covariance + covariance.T)


def square_root(P: FloatArray) -> FloatArray:
    """L (n, n) with L L^T = P; raises ``FilterDiverged`` if P (n, n) is not positive semidefinite.

    L is the lower Cholesky factor. If P is singular it is that of P with permuted rows and columns: the factorisation
    takes the largest remaining variance first, and ends when none is left.
    """
    L: FloatArray
    L, info = dpotrf(P, 1)
    if info == 0:
        return L
    if not np.isfinite(P).all():
        raise FilterDiverged("covariance is not finite")
    factor, pivots, rank, _ = dpstrf(np.tril(P), 0.0, 1)
    factor[:, rank:] = 0.0
    L[pivots - 1] = np.tril(factor)
    if np.abs(P - L.dot(L.T)).max() > NEGATIVITY * np.abs(P).max():
        least = float(np.linalg.eigvalsh(P)[0])
        raise FilterDiverged(f"covariance is not positive semidefinite: least eigenvalue {least:.3g}")
    return L


def beside_noise_root(HL: FloatArray, R: FloatArray) -> FloatArray:
    """[H L, N], shape (m, k + m), of H L (m, k) and R = N N^T, variances (m,) or (m, m); N is lower triangular.

    Raises ``FilterDiverged`` if R is not positive definite.
    """
    m, k = HL.shape
    rows = np.zeros((m, k + m))
    rows[:, :k] = HL
    if R.ndim == 1:
        if not min(R.tolist()) > 0.0:
            raise FilterDiverged(f"R is not positive definite: least variance {min(R.tolist()):.3g}")
        rows.flat[k :: k + m + 1] = np.sqrt(R)
        return rows
    rows[:, k:], info = dpotrf(R, 1)
    if info != 0:
        raise FilterDiverged("R is not positive definite")
    return rows
