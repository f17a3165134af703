"""The interface of the filters: the ``Filter`` protocol, the innovation of an update, the errors."""

from typing import Protocol

import msgspec
import numpy as np

from ccatp.core import FloatArray


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

    ``nis`` is nu^T (H P H^T + R)^-1 nu of all rows; chi-squared with m degrees of freedom if the filter is consistent.
    """

    rows: list[float]  # a third of the cost of an array, which is seldom needed
    nis: float

    @property
    def residual(self) -> FloatArray:
        """Nu = z - H x with the predicted state, shape (m,)."""
        return np.array(self.rows, dtype=np.float64)

    @property
    def size(self) -> int:
        """m, the number of measurement rows."""
        return len(self.rows)


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

        F and Q have shape (n, n). Raises ``FilterShapeError`` and ``FilterDiverged`` (not finite).
        """

    def update(self, z: FloatArray, H: FloatArray | FilterModel, R: FloatArray) -> Innovation:
        """Condition the state on z = H x + noise (thesis eqs 2.7 to 2.10), or on z = h(x) + noise.

        z (m,), m = 0 has no effect; H (m, n) or a model; R variances (m,) or covariance (m, m). Raises
        ``FilterShapeError``, and ``FilterDiverged``: posterior not finite, P or R not positive definite.
        """

    def reset(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Re-initialise with copies of a mean (n,) and a covariance (n, n), the thesis's resetFilter(mu, Sigma).

        Raises ``FilterShapeError``, and ``FilterDiverged``: not finite, not symmetric or not positive semidefinite.
        """


def check_rows(z: FloatArray, H: FloatArray, R: FloatArray, states: int) -> None:
    """Raises ``FilterShapeError`` where z (m,), H (m, n), R (m,) or (m, m) do not fit each other or n ``states``."""
    m = z.size
    if z.ndim != 1:
        raise FilterShapeError("z", z.shape, "(m,)")
    if H.shape != (m, states):
        raise FilterShapeError("H", H.shape, f"({m}, {states})")
    if R.shape not in ((m,), (m, m)):
        raise FilterShapeError("R", R.shape, f"({m},) or ({m}, {m})")


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


ASYMMETRY = 1e-9
"""Largest relative asymmetry that counts as rounding of the caller's arithmetic."""
HUGE = 1e200
"""Sums of squares beyond it count as not finite, so that no product of smaller numbers overflows."""
NEGATIVITY = 1e-9
"""Largest negative eigenvalue, relative to the largest entry, that counts as rounding."""
