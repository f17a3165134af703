"""Square roots of covariances, and the update that keeps every digit: one QR factorisation, nothing squared."""

import numpy as np
from scipy.linalg.lapack import dgeqrf, dpotrf, dtrtrs

from ccatp.core import FloatArray
from ccatp.filters.base import NEGATIVITY, FilterDiverged


def condition_by_rows(
    P: FloatArray, nu: FloatArray, H: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Condition N(., P) on m rows, thesis eqs 2.8 to 2.10, as the least-squares problem that they solve.

    With P = L L^T and x = x + L y the posterior is the solution of ``y = 0, A y = b`` with A = H L, b = nu, both
    whitened by R. A QR factorisation of the stacked rows ``[A b; I 0]`` holds all of it: the triangle C with
    C^T C = I + A^T A gives P = (C^-T L^T)^T (C^-T L^T), its last column gives y, and the corner squared is the
    normalised innovation. A prior far wider than the measurement costs no digits.

    Args:
        P: covariance, shape (n, n).
        nu: residual, shape (m,).
        H: measurement matrix, shape (m, n).
        R: variances (m,) or covariance (m, m) of the noise.

    Returns:
        Change of the mean (n,), covariance (n, n), normalised innovation squared. Not finite if anything given is not.

    Raises:
        FilterDiverged: P is not finite or not positive semidefinite, or R is not positive definite.
    """
    n, m = P.shape[0], nu.size
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        L = square_root(P)
        rows = np.zeros((n + 1, n + m)).T  # column-major, so that LAPACK works in place
        # The measurement, which may be far more exact than the prior, stands first: a reflection that took its rows
        # into those of the prior would leave their rounding there.
        rows[:m, :n] = H.dot(L)
        rows[:m, n] = nu
        whiten(rows[:m], R)
        rows[m:, :n] = np.eye(n)
        triangle = dgeqrf(rows, overwrite_a=1)[0]
        root = dtrtrs(triangle[:n, :n], L.T, lower=0, trans=1)[0]
        return triangle[:n, n].dot(root), root.T.dot(root), float(triangle[n, n] * triangle[n, n])


def square_root(P: FloatArray) -> FloatArray:
    """L with L L^T = P, shape (n, n): Cholesky, or the eigenvectors where P is only semidefinite.

    Raises:
        FilterDiverged: P is not finite or not positive semidefinite.
    """
    L: FloatArray
    L, info = dpotrf(P, lower=1, clean=1)
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
    root: FloatArray = sigma[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def is_semidefinite(P: FloatArray) -> bool:
    """Whether no eigenvalue of P (n, n) is below rounding: P with that much on its diagonal has a Cholesky factor."""
    lifted = P.copy(order="F")
    lifted.ravel(order="K")[:: P.shape[0] + 1] += NEGATIVITY * float(np.abs(P).max())
    return bool(dpotrf(lifted, lower=1, overwrite_a=1)[1] == 0)


def whiten(rows: FloatArray, R: FloatArray) -> None:
    """Scale ``rows`` (m, k) in place so that noise of variances (m,) or covariance (m, m) becomes independent units.

    Raises:
        FilterDiverged: R (m, m) is not positive definite. A variance (m,) that is not positive leaves rows that are
            not finite.
    """
    if R.ndim == 1:
        rows *= (1.0 / np.sqrt(R))[:, None]
        return
    rows[:] = dtrtrs(noise_root(R), rows, lower=1)[0]


def noise_root(R: FloatArray) -> FloatArray:
    """Lower Cholesky factor of the noise R (m, m).

    Raises:
        FilterDiverged: R is not positive definite.
    """
    factor: FloatArray
    factor, info = dpotrf(R, lower=1, clean=1)
    if info != 0:
        raise FilterDiverged("R is not positive definite")
    return factor
