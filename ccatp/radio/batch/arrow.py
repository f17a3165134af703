"""Pure. Normal equations of a chain of poses that all see a few shared unknowns: block tridiagonal with an arrow."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky_banded, solve_triangular

from ccatp.filters.base import FloatArray

BLOCK = 3  # x_m, y_m, heading_rad
BAND = 2 * BLOCK - 1


@dataclass(slots=True)
class ArrowSystem:
    """The symmetric positive definite matrix [[A, B], [B^T, C]] and the right-hand side (a, c).

    Attributes:
        diagonal: of A, shape (n, 3, 3).
        below: blocks (k + 1, k) of A, shape (n - 1, 3, 3).
        border: B by pose, shape (n, 3, m).
        corner: C, shape (m, m).
        pose_side: a, shape (n, 3).
        shared_side: c, shape (m,).
    """

    diagonal: FloatArray
    below: FloatArray
    border: FloatArray
    corner: FloatArray
    pose_side: FloatArray
    shared_side: FloatArray


class Factored:
    """Cholesky factors of an arrow system: A by bands, then the Schur complement S = C - B^T A^-1 B.

    Args:
        system: what is factored.
        damping: the diagonal is multiplied by 1 + damping (Levenberg and Marquardt).

    Raises:
        LinAlgError: not positive definite.
    """

    def __init__(self, system: ArrowSystem, damping: float = 0.0) -> None:
        self.system = system
        n, m = len(system.diagonal), len(system.corner)
        band = _banded(system, damping)
        self._factor = cholesky_banded(band, lower=True, check_finite=False)
        right = np.concatenate([system.border.reshape(n * BLOCK, m), system.pose_side.reshape(-1, 1)], axis=1)
        solved = _band_solve(self._factor, right)
        self._border_solved, self._pose_solved = solved[:, :m], solved[:, m]
        corner = system.corner + damping * np.diag(np.diag(system.corner))
        S = corner - system.border.reshape(n * BLOCK, m).T @ self._border_solved
        self._schur = cho_factor(0.5 * (S + S.T), lower=True, check_finite=False)

    def solution(self) -> tuple[FloatArray, FloatArray]:
        """Unknowns of the poses (n, 3) and the shared ones (m,)."""
        system = self.system
        n, m = len(system.diagonal), len(system.corner)
        side = system.shared_side - system.border.reshape(n * BLOCK, m).T @ self._pose_solved
        shared = cho_solve(self._schur, side, check_finite=False)
        return (self._pose_solved - self._border_solved @ shared).reshape(n, BLOCK), shared

    def log_determinant(self) -> float:
        """Of the whole matrix."""
        return float(2.0 * (np.log(self._factor[0]).sum() + np.log(np.diag(self._schur[0])).sum()))

    def shared_covariance(self) -> FloatArray:
        """Inverse's block of the shared unknowns, shape (m, m)."""
        return np.asarray(cho_solve(self._schur, np.eye(len(self.system.corner)), check_finite=False))

    def pose_covariances(self) -> FloatArray:
        """Inverse's diagonal block of each pose, shape (n, 3, 3): (A^-1)_kk + W_k W_k^T, W = A^-1 B chol(S)^-T."""
        n, m = len(self.system.diagonal), len(self.system.corner)
        root = np.tril(self._schur[0])
        W = solve_triangular(root, self._border_solved.T, lower=True, check_finite=False).T.reshape(n, BLOCK, m)
        return _diagonal_of_inverse(self.system) + W @ W.transpose(0, 2, 1)


def _banded(system: ArrowSystem, damping: float) -> FloatArray:
    """The lower bands of A as LAPACK wants them: row i holds the i-th band below the diagonal."""
    n = len(system.diagonal)
    band = np.zeros((BAND + 1, n, BLOCK))
    for column in range(BLOCK):
        for row in range(column, BLOCK):
            band[row - column, :, column] = system.diagonal[:, row, column]
        band[0, :, column] *= 1.0 + damping
        for row in range(BLOCK):
            band[BLOCK + row - column, :-1, column] = system.below[:, row, column]
    return band.reshape(BAND + 1, n * BLOCK)


def _band_solve(factor: FloatArray, right: FloatArray) -> FloatArray:
    from scipy.linalg import cho_solve_banded  # noqa: PLC0415

    return np.asarray(cho_solve_banded((factor, True), right, check_finite=False))


def _diagonal_of_inverse(system: ArrowSystem) -> FloatArray:
    """Diagonal blocks of A^-1: (left_k + right_k - A_kk)^-1, the Schur complements of what lies on either side."""
    A, below = system.diagonal, system.below
    n = len(A)
    left, right = A.copy(), A.copy()
    for k in range(1, n):
        left[k] -= below[k - 1] @ np.linalg.solve(left[k - 1], below[k - 1].T)
    for k in range(n - 2, -1, -1):
        right[k] -= below[k].T @ np.linalg.solve(right[k + 1], below[k])
    return np.asarray(np.linalg.inv(left + right - A))


__all__ = ["ArrowSystem", "Factored", "LinAlgError"]
