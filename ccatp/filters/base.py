"""What every filter offers: the ``Filter`` protocol, the innovation of an update, typed refusals."""

from typing import Protocol

import msgspec
import numpy as np

from ccatp.core import FloatArray


class FilterError(Exception):
    """Base of every refusal of a filter. The state before the refused call stays in force."""


class FilterShapeError(FilterError):
    """An array does not fit the state: carries its name and its shape; the message has the shape wanted."""

    def __init__(self, name: str, shape: tuple[int, ...], wanted: str) -> None:
        super().__init__(f"{name} has shape {shape}, wanted {wanted}")
        self.name = name
        self.shape = shape


class FilterDiverged(FilterError):
    """A mean, a covariance or a noise is not a finite Gaussian: the message says which."""


class Innovation(msgspec.Struct, frozen=True, gc=False):
    """What an update found.

    ``nis`` is nu^T (H P H^T + R)^-1 nu of all rows, chi-squared with m degrees of freedom when the filter is
    consistent.
    """

    rows: list[float]  # costs a third of an array, which few ask for
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
    """A nonlinear process model x <- f(x) or measurement model z = f(x) + noise; nothing wraps, nor needs to.

    The returned arrays are the model's work space: they hold until its next call, and a filter does not change them.
    """

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """f(x), shape (m,), and its Jacobian at x, shape (m, n)."""

    def through(self, X: FloatArray) -> FloatArray:
        """Image f of each row of X (k, n), shape (k, m)."""


class Filter(Protocol):
    """A Gaussian filter of n states, thesis fig. 2.8.

    ``mean`` and ``covariance`` return arrays that later calls do not change: a caller that keeps them keeps the state.
    Between two calls they return the same arrays again.
    """

    @property
    def mean(self) -> FloatArray:
        """State estimate, shape (n,)."""

    @property
    def covariance(self) -> FloatArray:
        """Its covariance, shape (n, n), positive semidefinite, symmetric to the last bit."""

    @property
    def transition(self) -> FloatArray:
        """F of the last prediction, shape (n, n): matrix, Jacobian, or regression by sigma points.

        At first the identity.
        """

    def predict(self, F: FloatArray | FilterModel, Q: FloatArray) -> None:
        """Advance the state: x <- F x, P <- F P F^T + Q (thesis eqs 2.5, 2.6), or the same with a nonlinear f.

        F and Q have shape (n, n). Raises ``FilterShapeError`` and ``FilterDiverged`` (not finite).
        """

    def update(self, z: FloatArray, H: FloatArray | FilterModel, R: FloatArray) -> Innovation:
        """Condition the state on z = H x + noise (thesis eqs 2.7 to 2.10), or on z = h(x) + noise.

        z (m,), m = 0 leaves the prediction; H (m, n) or a model; R variances (m,) or covariance (m, m). Raises
        ``FilterShapeError``, and ``FilterDiverged``: posterior not finite, P or R not positive
        definite.
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
    """Copies of a mean (n,) and a covariance of ``shape`` (n, n), symmetric to the last bit.

    Raises as ``Filter.reset``.
    """
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
"""Largest relative asymmetry taken for rounding of the caller's arithmetic."""
HUGE = 1e200
"""Sums of squares beyond it count as not finite: no product of the numbers below overflows."""
NEGATIVITY = 1e-9
"""Largest negative eigenvalue, relative to the largest entry, taken for rounding."""
