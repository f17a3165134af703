"""Pure. How good an estimate is: root mean squares, consistency with its own covariance."""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.filters.base import FloatArray


def rms(errors: FloatArray) -> float | None:
    """Root mean square of what is finite; None of nothing."""
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else None


def wrapped(angles_rad: FloatArray) -> FloatArray:
    """Angles in [-pi, pi)."""
    result: FloatArray = (angles_rad + np.pi) % (2.0 * np.pi) - np.pi
    return result


class Consistency(NamedTuple):
    """Mean normalised square of errors or innovations, per degree of freedom: 1 if the covariance is honest.

    Attributes:
        mean: sum of the squares over sum of the degrees of freedom.
        low: of the 95 % band that independent Gaussian errors would leave it in.
        high: its upper end.
    """

    mean: float
    low: float
    high: float


def consistency(squares: FloatArray, sizes: FloatArray) -> Consistency | None:
    """Mean of normalised squares against the chi-squared law (Bar-Shalom, Li, Kirubarajan 2001, section 5.4).

    Args:
        squares: normalised innovations (NIS) or errors (NEES) squared, shape (n,).
        sizes: degrees of freedom of each, shape (n,).
    """
    finite = np.isfinite(squares)
    freedom = float(sizes[finite].sum())
    if freedom == 0.0:
        return None
    low, high = (float(chdtri(freedom, q)) / freedom for q in (0.975, 0.025))
    return Consistency(float(squares[finite].sum()) / freedom, low, high)


def nees(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Normalised estimation error squared e^T P^-1 e of each row; errors (n, d), covariances (n, d, d)."""
    solved = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    squares: FloatArray = np.einsum("ni,ni->n", errors, solved)
    return squares
