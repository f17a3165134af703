"""Levenberg-Marquardt over a batch problem whose noise follows Student's t; Cholesky of its arrow-shaped system."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded, solve_triangular

from ccatp.beacons.slam.batch_problem import ArrowSystem, BatchProblem, BatchState
from ccatp.core import FloatArray

BLOCK = 3  # x_m, y_m, heading_rad
BAND = 2 * BLOCK - 1
LEAST_DAMPING = 1e-9
MOST_DAMPING = 1e9
CONVERGED = 1e-5  # relative gain below which a cost has converged


class Factored:
    """Cholesky factors of an arrow system: A by bands, then the Schur complement S = C - B^T A^-1 B.

    Args:
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
        solved = np.asarray(cho_solve_banded((self._factor, True), right, check_finite=False))
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

    def shared_covariance(self) -> FloatArray:
        """Inverse's block of the shared unknowns, shape (m, m)."""
        return np.asarray(cho_solve(self._schur, np.eye(len(self.system.corner)), check_finite=False))

    def pose_covariances(self) -> FloatArray:
        """Inverse's diagonal block of each pose, shape (n, 3, 3): (A^-1)_kk + W_k W_k^T, W = A^-1 B chol(S)^-T."""
        n, m = len(self.system.diagonal), len(self.system.corner)
        root = np.tril(self._schur[0])
        W = solve_triangular(root, self._border_solved.T, lower=True, check_finite=False).T.reshape(n, BLOCK, m)
        return np.asarray(_diagonal_of_inverse(self.system) + W @ W.transpose(0, 2, 1))


def _banded(system: ArrowSystem, damping: float) -> FloatArray:
    n = len(system.diagonal)
    band = np.zeros((BAND + 1, n, BLOCK))
    for column in range(BLOCK):
        for row in range(column, BLOCK):
            band[row - column, :, column] = system.diagonal[:, row, column]
        band[0, :, column] *= 1.0 + damping
        for row in range(BLOCK):
            band[BLOCK + row - column, :-1, column] = system.below[:, row, column]
    return band.reshape(BAND + 1, n * BLOCK)


def _diagonal_of_inverse(system: ArrowSystem) -> FloatArray:
    A, below = system.diagonal, system.below
    n = len(A)
    left, right = A.copy(), A.copy()
    for k in range(1, n):
        left[k] -= below[k - 1] @ np.linalg.solve(left[k - 1], below[k - 1].T)
    for k in range(n - 2, -1, -1):
        right[k] -= below[k].T @ np.linalg.solve(right[k + 1], below[k])
    return np.asarray(np.linalg.inv(left + right - A))


class Descent(NamedTuple):
    """Where a descent ended."""

    state: BatchState
    cost: float
    iterations: int
    converged: bool


def t_weights(chi2: FloatArray, sizes: FloatArray, freedom: float, softness: FloatArray | float = 1.0) -> FloatArray:
    """Weight of each reading: (nu + p) / (nu + chi2 / softness), the M-estimator of Student's t with p components.

    A softness above one forgives large residuals: it is how a start far off is not mistaken for outliers.
    """
    weights: FloatArray = (freedom + sizes) / (freedom + chi2 / softness)
    return weights


def t_cost(chi2: FloatArray, sizes: FloatArray, freedom: float, softness: FloatArray | float = 1.0) -> float:
    """Negative log likelihood of Student's t without its constants, with the weights above as its gradient's."""
    return float((0.5 * (freedom + sizes) * softness * np.log1p(chi2 / (freedom * softness))).sum())


def descend(
    problem: BatchProblem,
    state: BatchState,
    most: int,
    softness: FloatArray | float = 1.0,
    enough: float = CONVERGED,
) -> Descent:
    """Minimise the negative log posterior.

    Args:
        softness: of each reading's law, shape (m,) or one for all.
    """
    damping = 1e-6

    def cost_of(tried: BatchState) -> float:
        residuals = problem.residuals(tried)
        readings = t_cost(residuals.chi2, problem.sizes, problem.radio.freedom, softness)
        return problem.prior_cost(tried) + 0.5 * float(residuals.odometry_chi2.sum()) + readings

    residuals, cost = problem.residuals(state), cost_of(state)
    for iteration in range(1, most + 1):
        weights = t_weights(residuals.chi2, problem.sizes, problem.radio.freedom, softness)
        system = problem.normal_equations(state, weights)
        while (tried := _step(problem, state, system, damping)) is None or cost_of(tried) > cost:
            damping = max(damping, LEAST_DAMPING) * 10.0
            if damping > MOST_DAMPING:
                return Descent(state, cost, iteration, True)
        gain, state = cost - cost_of(tried), tried
        residuals, cost = problem.residuals(state), cost - gain
        damping = max(damping * 0.1, LEAST_DAMPING)
        if gain <= enough * max(abs(cost), 1.0):
            return Descent(state, cost, iteration, True)
    return Descent(state, cost, most, False)


def _step(problem: BatchProblem, state: BatchState, system: ArrowSystem, damping: float) -> BatchState | None:
    try:
        poses, shared = Factored(system, damping).solution()
    except LinAlgError:
        return None  # not positive definite
    return state.moved(poses, problem.spread(shared))
