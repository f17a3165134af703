"""Pure. What a panel can do: displacements along its normal as polynomials of the place on it, and their least squares.

The displacement is ``D(x, y) = sum c_i m_i(x, y)`` with the modes

* ``RIGID``: 1, y, x: piston, tip, tilt, as in ``ccatp.mirror.alignment``;
* ``QUADRATIC``: these and x^2/2, x y, y^2/2: the coefficients are the curvatures D_xx, D_xy, D_yy;
* ``ADJUSTABLE``: the rigid ones and what five adjusters in the corners and the centre can bend besides: x y, a twist,
  and (x^2 + y^2)/2, a bowl. How a panel bends between its adjusters is taken to be this.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ccatp.samples import FloatArray

Modes = Callable[[FloatArray], FloatArray]

MAX_CONDITION = 1e4  # of columns of unit length; nine points of a panel give less than 10, points on a line infinity
_NODES, _NODE_WEIGHTS = np.polynomial.legendre.leggauss(4)  # exact for the products of quadratics


def rigid(places_m: FloatArray) -> FloatArray:
    """The three modes of a rigid panel at (k, 2) places: shape (k, 3)."""
    x, y = places_m.T
    return np.column_stack([np.ones_like(x), y, x])


def quadratic(places_m: FloatArray) -> FloatArray:
    """The rigid modes and three curvatures at (k, 2) places: shape (k, 6)."""
    x, y = places_m.T
    return np.column_stack([rigid(places_m), x * x / 2.0, x * y, y * y / 2.0])


def adjustable(places_m: FloatArray) -> FloatArray:
    """The rigid modes, twist and bowl at (k, 2) places: shape (k, 5)."""
    x, y = places_m.T
    return np.column_stack([rigid(places_m), x * y, (x * x + y * y) / 2.0])


class ModeFit(NamedTuple):
    """Coefficients by weighted least squares.

    Attributes:
        values: coefficients, shape (m,), m and rad and 1/m.
        covariance: theirs, shape (m, m).
        residuals_m: what is left of the deviations, shape (k,).
        residual_variance_m2: mean square of the residuals that the points' own uncertainty makes one expect.
        chi2: weighted sum of squared residuals.
        dof: points minus coefficients.
    """

    values: FloatArray
    covariance: FloatArray
    residuals_m: FloatArray
    residual_variance_m2: float
    chi2: float
    dof: int

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the coefficients."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def unexplained_m2(self) -> float:
        """Mean square of the residuals beyond what the points' uncertainty explains; by chance < 0."""
        return float(np.mean(self.residuals_m**2)) - self.residual_variance_m2


def fit_modes(design: FloatArray, values_m: FloatArray, sigmas_m: FloatArray) -> ModeFit | None:
    """Weighted least squares by QR; None where the points do not determine the coefficients.

    Args:
        design: modes at the points, each row times the point's lever, shape (k, m).
        values_m: deviations, shape (k,).
        sigmas_m: their standard deviations, shape (k,), > 0.
    """
    count, modes = design.shape
    if count < modes:
        return None
    whitened = design / sigmas_m[:, None]
    scales = np.linalg.norm(whitened, axis=0)
    if not (scales > 0.0).all() or not np.linalg.cond(whitened / scales) < MAX_CONDITION:
        return None
    q, r = np.linalg.qr(whitened)
    target = values_m / sigmas_m
    solution = np.linalg.solve(r, q.T @ target)
    spread = np.linalg.solve(r, np.eye(modes))
    left = target - whitened @ solution
    # The whitened residuals are (1 - Q Q^T) times unit noise; the trace of its square is that of itself.
    expected = float(np.mean(sigmas_m**2 * (1.0 - np.sum(q * q, axis=1))))
    return ModeFit(solution, spread @ spread.T, left * sigmas_m, expected, float(left @ left), count - modes)


def gram(modes: Modes, half_m: tuple[float, float]) -> FloatArray:
    """Mean of the products of the modes over a panel: ``c^T G c`` is the mean square of a displacement.

    Args:
        modes: the modes.
        half_m: half the panel's size along x and y.
    """
    x, y = np.meshgrid(_NODES * half_m[0], _NODES * half_m[1])
    weights = np.outer(_NODE_WEIGHTS, _NODE_WEIGHTS).ravel() / 4.0
    at = modes(np.column_stack([x.ravel(), y.ravel()]))
    return np.asarray(at.T @ (weights[:, None] * at))
