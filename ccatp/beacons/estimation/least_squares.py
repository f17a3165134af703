"""Least squares of a ``BatchProblem``: Levenberg-Marquardt with Student's t, Cholesky of the arrow-shaped system."""

from copy import copy

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded, solve_triangular

from ccatp.beacons.estimation.batch_problem import ArrowSystem, BatchProblem
from ccatp.beacons.estimation.batch_unknowns import BatchState
from ccatp.beacons.estimation.motion import POSE
from ccatp.core import FloatArray

LEAST_DAMPING = 1e-9
MOST_DAMPING = 1e9
SLOW = 0.5  # ratio of consecutive steps above which they are extrapolated as a geometric series
FURTHEST = 10.0  # longest extrapolation, in steps
CONVERGED = 1e-5  # relative decrease of the cost below which it has converged
WELL_CONVERGED = 1e-6  # the same before the noise is increased: residuals that have not converged look like noise


class Factored:
    """Cholesky factors of an arrow system: banded A, then the Schur complement S = C - B^T A^-1 B.

    ``damping``: the diagonal is multiplied by 1 + damping (Levenberg-Marquardt). Raises LinAlgError: the matrix is not
    positive definite.
    """

    def __init__(self, system: ArrowSystem, damping: float = 0.0) -> None:
        self.system = system
        m, band = len(system.corner), system.band.copy()
        band[0] *= 1.0 + damping
        self._factor = cholesky_banded(band, lower=True, check_finite=False)
        right = np.column_stack([system.border, system.pose_side])
        solved = np.asarray(cho_solve_banded((self._factor, True), right, check_finite=False))
        self._border_solved, self._pose_solved = solved[:, :m], solved[:, m]
        corner = system.corner + damping * np.diag(np.diag(system.corner))
        S = corner - system.border.T @ self._border_solved
        self._schur = cho_factor(0.5 * (S + S.T), lower=True, check_finite=False)
        self._extra = np.zeros((m, 0))

    def spread_by(self, assumed: FloatArray, actual: FloatArray) -> "Factored":
        """The same factors, with covariances of errors under other priors of the shared unknowns than were assumed.

        ``assumed``, ``actual``: their variances, both (m,); infinite without a prior. The estimate moves by P / assumed
        with the mean of a prior, so a prior that is too narrow by d adds (P / assumed) d (P / assumed)^T (Schmidt
        1966). This is much where the readings do not determine the unknown, and next to nothing where they do.
        """
        other = copy(self)
        known = np.isfinite(assumed) & (actual > assumed)
        weights = np.sqrt(actual[known] - assumed[known]) / assumed[known]
        other._extra = np.asarray(cho_solve(self._schur, np.eye(len(assumed))[:, known], check_finite=False)) * weights
        return other

    def solution(self) -> tuple[FloatArray, FloatArray]:
        """Step of the poses, shape (n, 3), and of the shared unknowns, shape (m,)."""
        side = self.system.shared_side - self.system.border.T @ self._pose_solved
        shared = cho_solve(self._schur, side, check_finite=False)
        return (self._pose_solved - self._border_solved @ shared).reshape(-1, POSE), shared

    def shared_covariance(self) -> FloatArray:
        """Block of the inverse for the shared unknowns, shape (m, m)."""
        own = np.asarray(cho_solve(self._schur, np.eye(len(self.system.corner)), check_finite=False))
        return np.asarray(own + self._extra @ self._extra.T)

    def covariance_at(self, pose: int) -> FloatArray:
        """Block of the inverse for a pose, counted as in an array, and the shared unknowns, shape (3 + m, 3 + m)."""
        rows = range(self.system.pose_side.size)[POSE * pose :][:POSE]
        unit = np.zeros((self.system.pose_side.size, POSE))
        unit[rows, range(POSE)] = 1.0
        own = np.asarray(cho_solve_banded((self._factor, True), unit, check_finite=False))[rows]
        W, shared = self._border_solved[rows], self.shared_covariance()
        across = -W @ shared
        return np.block([[own - across @ W.T, across], [across.T, shared]])

    def pose_covariances(self) -> FloatArray:
        """Diagonal block of the inverse for each pose, (n, 3, 3): (A^-1)_kk + W_k W_k^T, W = A^-1 B R."""
        W = self._shaped(self._border_solved.reshape(-1, POSE, len(self.system.corner)))
        return np.asarray(self._chain_inverse()[0] + W @ W.transpose(0, 2, 1))

    def step_covariances(self, by_poses: FloatArray, by_shared: FloatArray) -> FloatArray:
        """J P J^T of linear functions of successive poses and the shared unknowns, shape (n - 1, r, r).

        ``by_poses``: derivatives by poses k and k + 1, (n - 1, r, 6). ``by_shared``: by the shared unknowns, (n - 1, r,
        m). With P_pp = A^-1 + G S^-1 G^T, P_ps = -G S^-1 and G = A^-1 B it is J A^-1 J^T + M S^-1 M^T, M = J_p G - J_s.
        """
        inverse, across = self._chain_inverse()
        first, second = by_poses[:, :, :POSE], by_poses[:, :, POSE:]
        mixed = first @ across @ second.transpose(0, 2, 1)
        chain = first @ inverse[:-1] @ first.transpose(0, 2, 1) + second @ inverse[1:] @ second.transpose(0, 2, 1)
        G = self._border_solved.reshape(-1, POSE, len(self.system.corner))
        M = self._shaped(first @ G[:-1] + second @ G[1:] - by_shared)
        return np.asarray(chain + mixed + mixed.transpose(0, 2, 1) + M @ M.transpose(0, 2, 1))

    def _shaped(self, rows: FloatArray) -> FloatArray:
        """M R of blocks of rows M, (n, r, m), with R R^T the covariance of the shared unknowns."""
        flat = rows.reshape(-1, rows.shape[2])
        solved = solve_triangular(np.tril(self._schur[0]), flat.T, lower=True, check_finite=False).T
        return np.asarray(np.column_stack([solved, flat @ self._extra]).reshape(*rows.shape[:2], -1))

    def _chain_inverse(self) -> tuple[FloatArray, FloatArray]:
        """Blocks (k, k), (n, 3, 3), and (k, k + 1), (n - 1, 3, 3), of A^-1, from its Cholesky factor L.

        With G_k = -(L_k+1,k L_kk^-1)^T: (A^-1)_k,k+1 = G_k (A^-1)_k+1,k+1 and (A^-1)_kk = (L_kk L_kk^T)^-1 + G_k
        (A^-1)_k+1,k+1 G_k^T (Takahashi, Fagan and Chin 1973).
        """
        row, column = np.indices((POSE, POSE))
        start = np.arange(0, self._factor.shape[1], POSE)[:, None, None]
        lower = np.tril(self._factor[np.abs(row - column), start + column])
        back = np.linalg.inv(lower)
        inverse = back.transpose(0, 2, 1) @ back
        G = -(self._factor[POSE + row - column, start + column][:-1] @ back[:-1]).transpose(0, 2, 1)
        across = np.empty_like(G)
        for k in range(len(G) - 1, -1, -1):
            across[k] = G[k] @ inverse[k + 1]
            inverse[k] += across[k] @ G[k].T
        return inverse, across


def eliminated(system: ArrowSystem) -> tuple[FloatArray, FloatArray]:
    """Normal equations of the last pose and the shared unknowns after the elimination of all other poses.

    Matrix (3 + m, 3 + m) and right-hand side (3 + m,). Raises LinAlgError: the others are not determined.
    """
    split = system.pose_side.size - POSE
    row, column = np.indices((POSE, POSE))
    corner = np.block([[_last_block(system.band), system.border[split:]], [system.border[split:].T, system.corner]])
    side = np.concatenate([system.pose_side[split:], system.shared_side])
    if split == 0:
        return corner, side
    before = np.zeros((split, POSE))
    before[-POSE:] = system.band[POSE + row - column, split - POSE + column].T
    right = np.column_stack([before, system.border[:split], system.pose_side[:split]])
    factor = cholesky_banded(system.band[:, :split], lower=True, check_finite=False)
    solved = np.asarray(cho_solve_banded((factor, True), right, check_finite=False))
    coupled = right[:, :-1]
    return corner - coupled.T @ solved[:, :-1], side - coupled.T @ solved[:, -1]


def _last_block(band: FloatArray) -> FloatArray:
    row, column = np.indices((POSE, POSE))
    return np.asarray(band[np.abs(row - column), band.shape[1] - POSE + np.minimum(row, column)])


def t_weights(chi2: FloatArray, sizes: FloatArray, freedom: float, softness: float = 1.0) -> FloatArray:
    """Weight of each reading: (nu + p) / (nu + chi2 / softness), the M-estimator of Student's t with p components.

    A softness above one gives large residuals more weight, so that a bad initial value does not look like outliers.
    """
    weights: FloatArray = (freedom + sizes) / (freedom + chi2 / softness)
    return weights


def t_cost(
    chi2: FloatArray, sizes: FloatArray, freedom: float, softness: float = 1.0, power: FloatArray | float = 1.0
) -> float:
    """Negative log likelihood of Student's t without its constants; its gradient has the weights of ``t_weights``.

    ``power``: of each reading's likelihood, below one if its error is shared with others.
    """
    return float((0.5 * power * (freedom + sizes) * softness * np.log1p(chi2 / (freedom * softness))).sum())


def descend(
    problem: BatchProblem, state: BatchState, most: int, softness: float = 1.0, enough: float = CONVERGED
) -> tuple[BatchState, bool]:
    """Minimise the negative log posterior in at most ``most`` iterations; returns the state and whether it converged.

    ``softness``: that of ``t_weights``. ``enough``: relative decrease of the cost at which it has converged.
    """
    damping = 1e-6

    def cost_of(tried: BatchState) -> float:
        r = problem.residuals(tried)
        readings = t_cost(r.chi2, problem.sizes, problem.radio.freedom, softness, problem.power)
        steps = np.einsum("ki,kij,kj->k", r.odometry, r.odometry_information, r.odometry)
        return problem.prior_cost(tried) + 0.5 * float(steps.sum()) + readings

    cost, before = cost_of(state), None
    for _ in range(most):
        weights = t_weights(problem.residuals(state).chi2, problem.sizes, problem.radio.freedom, softness)
        system = problem.normal_equations(state, weights * problem.power)
        while (step := _step(problem, system, damping)) is None or cost_of(tried := state.moved(*step)) > cost:
            damping = max(damping, LEAST_DAMPING) * 10.0
            if damping > MOST_DAMPING:
                return state, True
        damping = max(damping * 0.1, LEAST_DAMPING)
        gain, state = cost - cost_of(tried), tried
        cost -= gain
        if gain <= enough * max(abs(cost), 1.0):
            return state, True
        rate = 0.0 if before is None else float(np.vdot(before[0], step[0]) / np.vdot(before[0], before[0]))
        before = step
        if SLOW < rate < 1.0:  # reweighting converges linearly: add the sum of the steps that would follow
            further = min(rate / (1.0 - rate), FURTHEST)
            tried = state.moved(further * step[0], further * step[1])
            if (shorter := cost_of(tried)) < cost:
                state, cost, before = tried, shorter, None
    return state, False


def _step(problem: BatchProblem, system: ArrowSystem, damping: float) -> tuple[FloatArray, FloatArray] | None:
    try:
        poses, shared = Factored(system, damping).solution()
    except LinAlgError:
        return None  # not positive definite
    return poses, problem.spread(shared)
