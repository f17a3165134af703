"""Measures of an estimate: root mean square error, and consistency with its covariance."""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.core import FloatArray


def rms(errors: FloatArray) -> float | None:
    """Root mean square of the finite values; None without any."""
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else None


def wrapped(angles_rad: FloatArray) -> FloatArray:
    """Angles in [-pi, pi)."""
    result: FloatArray = (angles_rad + np.pi) % (2.0 * np.pi) - np.pi
    return result


class Consistency(NamedTuple):
    """Mean normalised square per degree of freedom; 1 if the covariance is correct.

    ``low`` and ``high``: 95 % interval for independent Gaussian errors.
    """

    mean: float
    low: float
    high: float


def consistency(squares: FloatArray, sizes: FloatArray) -> Consistency | None:
    """Mean of NIS or NEES ``squares`` (n,) with degrees of freedom ``sizes`` (n,) against the chi-squared law.

    Bar-Shalom, Li, Kirubarajan 2001, section 5.4.
    """
    finite = np.isfinite(squares)
    freedom = float(sizes[finite].sum())
    if freedom == 0.0:
        return None
    low, high = (float(chdtri(freedom, q)) / freedom for q in (0.975, 0.025))
    return Consistency(float(squares[finite].sum()) / freedom, low, high)


def nees(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Normalised estimation error squared e^T P^-1 e of each row, expectation d; of errors (n, d)."""
    solved = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    squares: FloatArray = np.einsum("ni,ni->n", errors, solved)
    return squares
