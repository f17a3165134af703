"""Pure. The map that fits all ranges best: sparse damped least squares with a robust loss, and its covariance."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import splu

from ccatp.motes.map_model import MapModel, MapState
from ccatp.motes.range_network import FloatArray
from ccatp.radio.rigid_alignment import rigid_modes

_FIRST_DAMPING = 1e-4  # of the largest diagonal of the normal matrix
_DENSE = 240  # unknowns up to which dense Cholesky is quicker than sparse LU
_NULL = 1e-9  # eigenvalues below this share of the largest are directions that no range sees


class BatchSettings(NamedTuple):
    """How to fit.

    Attributes:
        robust_scale: Cauchy loss: residuals beyond this many sigmas weigh less and less; infinite for least squares.
        max_iterations: steps at most.
        tolerance_m: a step whose largest part is shorter ends the iteration.
    """

    robust_scale: float = float("inf")
    max_iterations: int = 200
    tolerance_m: float = 1e-8


class BatchFit(NamedTuple):
    """A fitted map.

    Attributes:
        state: the map.
        cost: sum of the loss, c^2 log(1 + (r / (c sigma))^2), or (r / sigma)^2.
        weights: what the loss left of each range, 0 to 1, shape (m,).
        residuals_m: shape (m,).
        iterations: steps tried.
        is_at_rest: whether the steps had ended before ``max_iterations``.
    """

    state: MapState
    cost: float
    weights: FloatArray
    residuals_m: FloatArray
    iterations: int
    is_at_rest: bool


def fit_map(model: MapModel, start: MapState, settings: BatchSettings) -> BatchFit:
    """Minimise the loss of all ranges from a start.

    Steps (J^T W J + lambda D) dq = J^T W r (Levenberg 1944, Marquardt 1963) with W = w / sigma^2 and the weights
    w = 1 / (1 + (r / (c sigma))^2) of the Cauchy loss. A network without known coordinates may shift and turn: the
    damping keeps it where it started.

    Args:
        model: network and unknowns.
        start: where to begin; decides which of several folded maps is found.
        settings: loss and end.
    """
    sigmas = model.network.sigmas_m
    state, damping = start, _FIRST_DAMPING
    residuals = model.residuals(state)
    cost, weights = _loss(residuals / sigmas, settings.robust_scale)
    for iteration in range(1, settings.max_iterations + 1):
        normal, gradient = _normal(model, state, residuals, weights)
        step = _solved(normal, gradient, damping)
        trial = model.moved(state, step)
        trial_residuals = model.residuals(trial)
        trial_cost, trial_weights = _loss(trial_residuals / sigmas, settings.robust_scale)
        if trial_cost <= cost:
            gain = cost - trial_cost
            state, residuals, cost, weights = trial, trial_residuals, trial_cost, trial_weights
            damping = max(damping * 0.2, 1e-12)
            if float(np.abs(step).max()) <= settings.tolerance_m or gain <= 1e-12 * cost:
                return BatchFit(state, cost, weights, residuals, iteration, True)
        else:
            damping *= 6.0
            if damping > 1e9:
                return BatchFit(state, cost, weights, residuals, iteration, True)
    return BatchFit(state, cost, weights, residuals, settings.max_iterations, False)


def fit_from_afar(model: MapModel, start: MapState, settings: BatchSettings) -> BatchFit:
    """The same from a start that may be metres off: by least squares first.

    To a robust loss all ranges of a mote that is far from its place are outliers, and nothing pulls it there.
    """
    if not np.isfinite(settings.robust_scale):
        return fit_map(model, start, settings)
    near = fit_map(model, start, settings._replace(robust_scale=float("inf")))
    fit = fit_map(model, near.state, settings)
    return fit._replace(iterations=near.iterations + fit.iterations)


def position_covariance(model: MapModel, fit: BatchFit, *, variance_factor: float = 1.0) -> tuple[FloatArray, int]:
    """Covariance of all positions and how many directions of the unknowns no range sees.

    Where nothing pins the frame, the covariance is that of the map after the rigid motion that brings it nearest to the
    truth (inner constraints of a free network): C = S B N^+ B^T S^T with B = dp/dq, N the normal matrix and S the
    projection across all rigid motions. Directions without information count as known: look at the second value.

    Args:
        model: network and unknowns.
        fit: where.
        variance_factor: multiplies the covariance, where residuals tell that the sigmas were too small.

    Returns:
        Covariance (n d, n d), and the number of directions without information, the frame's included.
    """
    normal, _ = _normal(model, fit.state, fit.residuals_m, np.where(fit.weights > 0.5, 1.0, 0.0))
    dense = normal if isinstance(normal, np.ndarray) else normal.toarray()
    scale = 1.0 / np.sqrt(np.maximum(dense.diagonal(), 1e-300))
    values, vectors = np.linalg.eigh(dense * np.outer(scale, scale))
    is_seen = values > _NULL * values[-1]
    half = (vectors[:, is_seen] / np.sqrt(values[is_seen])) * scale[:, None]
    at_positions = np.asarray(model.position_jacobian(fit.state) @ half[: model.coordinates])
    if np.isnan(model.network.known_m).all():
        modes = rigid_modes(fit.state.positions_m)
        at_positions = at_positions - modes @ (modes.T @ at_positions)
    return variance_factor * (at_positions @ at_positions.T), int((~is_seen).sum())


def _loss(scaled: FloatArray, robust_scale: float) -> tuple[float, FloatArray]:
    squares = scaled**2
    if not np.isfinite(robust_scale):
        return float(squares.sum()), np.ones(len(scaled))
    ratio = squares / robust_scale**2
    return float(robust_scale**2 * np.log1p(ratio).sum()), 1.0 / (1.0 + ratio)


def _normal(
    model: MapModel, state: MapState, residuals: FloatArray, weights: FloatArray
) -> tuple[csr_array | FloatArray, FloatArray]:
    """J^T W J, a full array where the map is small, and J^T W r."""
    W = weights / model.network.sigmas_m**2
    if model.size <= _DENSE:
        J = model.dense_jacobian(state)
        weighted = J * W[:, None]
        return J.T @ weighted, residuals @ weighted
    sparse = model.jacobian(state)
    heavy = diags_array(W) @ sparse
    return csr_array(sparse.T @ heavy), np.asarray(heavy.T @ residuals)


def _solved(normal: csr_array | FloatArray, gradient: FloatArray, damping: float) -> FloatArray:
    diagonal = normal.diagonal()
    # Unknowns that no range sees still get a damping, so that they stay where they are.
    floor = np.maximum(diagonal, 1e-6 * float(diagonal.max()))
    if isinstance(normal, np.ndarray):
        damped = normal.copy()
        damped[np.diag_indices_from(damped)] += damping * floor
        return np.asarray(cho_solve(cho_factor(damped, check_finite=False), gradient, check_finite=False))
    sparse = (normal + diags_array(damping * floor)).tocsc()
    return np.asarray(splu(sparse, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(gradient))
