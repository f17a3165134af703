"""Pure. Levenberg-Marquardt over a batch problem whose noise follows Student's t: reweighted least squares."""

from typing import NamedTuple

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.radio.batch.arrow import ArrowSystem, Factored, LinAlgError
from ccatp.radio.batch.problem import BatchProblem, Residuals, State

LEAST_DAMPING = 1e-9
MOST_DAMPING = 1e9
CONVERGED = 1e-5
"""Relative gain below which a cost has converged."""


class Descent(NamedTuple):
    """Where a descent ended.

    Attributes:
        state: the minimum.
        cost: there, negative log posterior up to a constant.
        iterations: steps taken.
        converged: False where the steps ran out first.
    """

    state: State
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
    state: State,
    most: int,
    softness: FloatArray | float = 1.0,
    odometry_freedom: float = np.inf,
    enough: float = CONVERGED,
) -> Descent:
    """Minimise the negative log posterior.

    Args:
        problem: odometry, readings, priors.
        state: where to begin.
        most: iterations at most.
        softness: of each reading's law, shape (m,) or one for all.
        odometry_freedom: degrees of freedom of the odometry's law.
        enough: relative gain below which the cost counts as converged.
    """
    damping = 1e-6

    def tried_cost(tried: State) -> float:
        return _cost(problem, tried, problem.residuals(tried), softness, odometry_freedom)

    residuals, cost = problem.residuals(state), tried_cost(state)
    for iteration in range(1, most + 1):
        weights = t_weights(residuals.chi2, problem.sizes, problem.radio.freedom, softness)
        system = problem.normal_equations(state, weights, _odometry_weights(residuals, odometry_freedom))
        while (tried := _step(problem, state, system, damping)) is None or tried_cost(tried) > cost:
            damping = max(damping, LEAST_DAMPING) * 10.0
            if damping > MOST_DAMPING:
                return Descent(state, cost, iteration, True)
        gain, state = cost - tried_cost(tried), tried
        residuals, cost = problem.residuals(state), cost - gain
        damping = max(damping * 0.1, LEAST_DAMPING)
        if gain <= enough * max(abs(cost), 1.0):
            return Descent(state, cost, iteration, True)
    return Descent(state, cost, most, False)


def _step(problem: BatchProblem, state: State, system: ArrowSystem, damping: float) -> State | None:
    """The state a damped step further; None where the system is not positive definite."""
    try:
        poses, shared = Factored(system, damping).solution()
    except LinAlgError:
        return None
    return state.moved(poses, problem.spread(shared))


def _odometry_chi2(residuals: Residuals) -> FloatArray:
    chi2: FloatArray = np.einsum("ki,kij,kj->k", residuals.odometry, residuals.odometry_information, residuals.odometry)
    return chi2


def _odometry_weights(residuals: Residuals, freedom: float) -> FloatArray:
    chi2 = _odometry_chi2(residuals)
    if np.isinf(freedom):
        return np.ones_like(chi2)
    return t_weights(chi2, np.full(chi2.size, 3.0), freedom)


def _cost(
    problem: BatchProblem, state: State, residuals: Residuals, softness: FloatArray | float, odometry_freedom: float
) -> float:
    chi2 = _odometry_chi2(residuals)
    odometry = (
        0.5 * float(chi2.sum())
        if np.isinf(odometry_freedom)
        else t_cost(chi2, np.full(chi2.size, 3.0), odometry_freedom)
    )
    readings = t_cost(residuals.chi2, problem.sizes, problem.radio.freedom, softness)
    return problem.prior_cost(state) + odometry + readings
