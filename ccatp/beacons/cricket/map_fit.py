"""The map that fits all ranges best: model, sparse damped least squares with robust loss, covariance, error bound."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csr_array, diags_array, hstack
from scipy.sparse.linalg import splu

from ccatp.beacons.cricket.range_network import IndexArray, RangeNetwork, coordinates_of
from ccatp.beacons.rigid_motion import rigid_modes
from ccatp.core import FloatArray


class MapState(NamedTuple):
    """A map."""

    positions_m: FloatArray  # of all motes, shape (n, d)
    offset_m: float = 0.0
    scale: float = 0.0


class MapModel:
    """Ranges z = (1 + s) |p_i - p_j| + o and their derivatives.

    The unknowns are the unknown coordinates of motes outside bodies, then a shift of each body and a small rotation
    about its first mote, then o and s if requested.
    """

    def __init__(self, network: RangeNetwork, *, with_offset: bool = False, with_scale: bool = False) -> None:
        self.network = network
        self.with_offset, self.with_scale = with_offset, with_scale
        d = network.dimension
        sizes = [len(body.motes) for body in network.bodies]
        # All motes of bodies, the body of each, and the first mote of that body.
        self._bound = np.array([mote for body in network.bodies for mote in body.motes], dtype=np.intp)
        self._body_of = np.repeat(np.arange(len(sizes)), sizes)
        self._origin_of = np.repeat(np.array([body.motes[0] for body in network.bodies], dtype=np.intp), sizes)
        is_free = np.isnan(network.known_m)
        is_free[self._bound] = False
        self._free_at: IndexArray = np.flatnonzero(is_free)  # flat coordinate of each unknown of a loose mote
        self._turns = np.zeros((d * (d - 1) // 2, d, d))  # the rotations in each plane, to first order
        for number, (a, b) in enumerate(combinations(range(d), 2)):
            self._turns[number, b, a], self._turns[number, a, b] = 1.0, -1.0
        self._body_size = d + len(self._turns)
        self.coordinates = len(self._free_at) + self._body_size * len(network.bodies)
        self.size = self.coordinates + int(with_offset) + int(with_scale)
        self._loose_jacobian = self._jacobian_of_positions(network.known_m) if not network.bodies else None

    def with_sigmas(self, factor: float) -> "MapModel":
        """The same with all sigmas multiplied by a factor."""
        network = replace(self.network, sigmas_m=self.network.sigmas_m * factor)
        return MapModel(network, with_offset=self.with_offset, with_scale=self.with_scale)

    def state(self, positions_m: FloatArray, offset_m: float = 0.0, scale: float = 0.0) -> MapState:
        """The state nearest to given positions, shape (n, d), with the known coordinates and rigid bodies."""
        known = self.network.known_m
        positions = np.where(np.isnan(known), positions_m, known)
        for body in self.network.bodies:
            positions[list(body.motes)] = body.placed(positions_m)
        return MapState(positions, offset_m, scale)

    def residuals(self, state: MapState) -> FloatArray:
        """Measured minus computed ranges, shape (m,)."""
        distances = directions(state.positions_m, self.network.first, self.network.second)[0]
        return self.network.ranges_m - (1.0 + state.scale) * distances - state.offset_m

    def jacobian(self, state: MapState) -> csr_array:
        """dz/dq, shape (m, size)."""
        first, second = self.network.first, self.network.second
        rows = (1.0 + state.scale) * rigidity_matrix(state.positions_m, first, second)
        parts = [rows @ self.position_jacobian(state)]
        if self.with_offset:
            parts.append(csr_array(np.ones((len(first), 1))))
        if self.with_scale:
            parts.append(csr_array(directions(state.positions_m, first, second)[0][:, None]))
        return csr_array(hstack(parts)) if len(parts) > 1 else parts[0]

    def position_jacobian(self, state: MapState) -> csr_array:
        """dp/dq without offset and scale, shape (n d, coordinates)."""
        if self._loose_jacobian is not None:
            return self._loose_jacobian
        return self._jacobian_of_positions(state.positions_m)

    def _jacobian_of_positions(self, positions_m: FloatArray) -> csr_array:
        d, start, size = self.network.dimension, len(self._free_at), self._body_size
        arms = positions_m[self._bound] - positions_m[self._origin_of]
        blocks = np.concatenate([np.tile(np.eye(d), (len(arms), 1, 1)), (self._turns @ arms.T).transpose(2, 1, 0)], 2)
        rows = np.concatenate([self._free_at, np.repeat(coordinates_of(self._bound, d), size)])
        of_body = start + self._body_of[:, None] * size + np.arange(size)
        columns = np.concatenate([np.arange(start), np.repeat(of_body, d, axis=0).ravel()])
        values = np.concatenate([np.ones(start), blocks.ravel()])
        return coo_array((values, (rows, columns)), shape=(positions_m.size, self.coordinates)).tocsr()

    def moved(self, state: MapState, step: FloatArray) -> MapState:
        """The state after a step of the unknowns, shape (size,)."""
        d, start = self.network.dimension, len(self._free_at)
        positions = state.positions_m.copy()
        positions.reshape(-1)[self._free_at] += step[:start]
        if self._bound.size:
            shifts, angles = np.split(step[start : self.coordinates].reshape(-1, self._body_size), [d], axis=1)
            half = 0.5 * np.tensordot(angles, self._turns, 1)
            # Cayley transform: orthogonal, and exact to first order
            rotations = np.linalg.solve(np.eye(d) - half, np.eye(d) + half)
            origins = state.positions_m[self._origin_of]
            arms = state.positions_m[self._bound] - origins
            turned = np.einsum("kij,kj->ki", rotations[self._body_of], arms)
            positions[self._bound] = turned + origins + shifts[self._body_of]
        offset_m = state.offset_m + float(step[self.coordinates]) if self.with_offset else state.offset_m
        scale = state.scale + float(step[-1]) if self.with_scale else state.scale
        return MapState(positions, offset_m, scale)


def directions(positions_m: FloatArray, first: IndexArray, second: IndexArray) -> tuple[FloatArray, FloatArray]:
    """Distances of pairs (m,) and unit vectors from the second mote to the first, shape (m, d)."""
    ways = positions_m[first] - positions_m[second]
    distances = np.sqrt(np.einsum("ij,ij->i", ways, ways))
    # Motes at the same point have no direction: a zero row excludes the range from this step.
    return distances, ways / np.maximum(distances, 1e-12)[:, None]


def rigidity_matrix(positions_m: FloatArray, first: IndexArray, second: IndexArray) -> csr_array:
    """Derivatives of the distances of pairs with respect to all coordinates, shape (m, n d)."""
    d, u = positions_m.shape[1], directions(positions_m, first, second)[1]
    columns = coordinates_of(np.column_stack([first, second]).ravel(), d)
    values = np.concatenate([u, -u], axis=1).ravel()
    return csr_array((values, columns, np.arange(len(u) + 1) * 2 * d), shape=(len(u), positions_m.size))


_DENSE = 240  # number of unknowns up to which dense Cholesky is faster than sparse LU
_NULL = 1e-9  # of the largest eigenvalue; below it no range determines the direction
_NO_GAIN = 1e-12  # relative decrease of the cost that ends the iteration
_REST_M = 1e-8  # a step whose largest component is smaller also ends it


class MapFitSettings(NamedTuple):
    """Settings of a fit.

    ``robust_scale``: of the Cauchy loss, in sigmas: larger residuals get less weight; infinite for least squares.
    """

    robust_scale: float = float("inf")
    max_iterations: int = 200
    damping: float = 1e-4  # of the first step


class MapFit(NamedTuple):
    """A fitted map."""

    state: MapState
    cost: float  # sum of the loss, c^2 log(1 + (r / (c sigma))^2), or (r / sigma)^2
    weights: FloatArray  # of each range by the loss, 0 to 1, shape (m,)
    residuals_m: FloatArray  # shape (m,)
    iterations: int
    is_at_rest: bool  # whether it converged within ``max_iterations``


def fit_map(model: MapModel, start: MapState, settings: MapFitSettings, penalty: FloatArray | None = None) -> MapFit:
    """Minimise the loss of all ranges from a start.

    Steps (J^T W J + lambda D) dq = J^T W r (Levenberg 1944, Marquardt 1963) with W = w / sigma^2 and the weights
    w = 1 / (1 + (r / (c sigma))^2) of the Cauchy loss. A network without known coordinates is free to shift and turn;
    the damping keeps it near its start. ``penalty``: weights of the squares of all coordinates, shape (n d,); only for
    a model without bodies and known coordinates.
    """

    def judge(state: MapState) -> tuple[float, FloatArray, FloatArray]:
        residuals = model.residuals(state)
        cost, weights = robust_loss(residuals / model.network.sigmas_m, settings.robust_scale)
        if penalty is not None:
            cost += penalty @ state.positions_m.ravel() ** 2
        return float(cost), weights, residuals

    state, damping = start, settings.damping
    cost, weights, residuals = judge(state)
    for iteration in range(1, settings.max_iterations + 1):
        normal, gradient = _normal(model, state, residuals, weights)
        if penalty is not None:
            gradient = gradient - penalty * state.positions_m.ravel()
        step = _solved(normal, gradient, damping, penalty)
        trial = model.moved(state, step)
        seen = judge(trial)
        if seen[0] <= cost:
            gain = cost - seen[0]
            state, (cost, weights, residuals), damping = trial, seen, max(damping * 0.2, 1e-12)
            if float(np.abs(step).max()) <= _REST_M or gain <= _NO_GAIN * cost:
                return MapFit(state, cost, weights, residuals, iteration, True)
        else:
            damping *= 6.0
            if damping > 1e9:
                return MapFit(state, cost, weights, residuals, iteration, True)
    return MapFit(state, cost, weights, residuals, settings.max_iterations, False)


def fit_from_afar(model: MapModel, start: MapState, settings: MapFitSettings) -> MapFit:
    """``fit_map`` from a start that may be metres off: first by least squares.

    For a robust loss all ranges of a mote far from its true position are outliers, so they do not pull it there.
    """
    if not np.isfinite(settings.robust_scale):
        return fit_map(model, start, settings)
    near = fit_map(model, start, settings._replace(robust_scale=float("inf")))
    fit = fit_map(model, near.state, settings)
    return fit._replace(iterations=near.iterations + fit.iterations)


def robust_loss(scaled: FloatArray, robust_scale: float) -> tuple[FloatArray, FloatArray]:
    """Sum of the loss of residuals in sigmas, over the last axis, and the weight of each, 0 to 1."""
    squares = scaled**2
    if not np.isfinite(robust_scale):
        return squares.sum(axis=-1), np.ones_like(scaled)
    ratio = squares / robust_scale**2
    return robust_scale**2 * np.log1p(ratio).sum(axis=-1), 1.0 / (1.0 + ratio)


def _normal(
    model: MapModel, state: MapState, residuals: FloatArray, weights: FloatArray
) -> tuple[csr_array | FloatArray, FloatArray]:
    W = weights / model.network.sigmas_m**2
    sparse = model.jacobian(state)
    if model.size <= _DENSE:
        J = sparse.toarray()
        weighted = J * W[:, None]
        return J.T @ weighted, residuals @ weighted
    heavy = diags_array(W) @ sparse
    return csr_array(sparse.T @ heavy), np.asarray(heavy.T @ residuals)


def _solved(
    normal: csr_array | FloatArray, gradient: FloatArray, damping: float, penalty: FloatArray | None
) -> FloatArray:
    diagonal = normal.diagonal()
    # Unknowns that no range determines are damped too, so that they do not move.
    more = damping * np.maximum(diagonal, 1e-6 * float(diagonal.max()))
    if penalty is not None:
        # Equal damping for all: scaled by the diagonal, it would keep motes with heavy ranges from turning over.
        more = damping + penalty
    if isinstance(normal, np.ndarray):
        damped = normal.copy()
        damped[np.diag_indices_from(damped)] += more
        return np.asarray(cho_solve(cho_factor(damped, check_finite=False), gradient, check_finite=False))
    sparse = (normal + diags_array(more)).tocsc()
    return np.asarray(splu(sparse, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(gradient))


def position_covariance(model: MapModel, fit: MapFit) -> tuple[FloatArray, int]:
    """Covariance of all positions, and the number of directions of the unknowns that no range determines.

    Without known coordinates, the covariance is that of the map after the rigid motion that brings it nearest to the
    truth (inner constraints of a free network): C = S B N^+ B^T S^T with B = dp/dq, N the normal matrix and S the
    projection that removes all rigid motions. Undetermined directions count as known, so check the second value.
    Returns covariance (n d, n d), and the number of undetermined directions, including those of the frame.
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
    return at_positions @ at_positions.T, int((~is_seen).sum())


def bound_rms_m(model: MapModel, true_m: FloatArray, motes: Sequence[int], *, aligned: bool) -> float | None:
    """Bound sqrt(tr C / n), m, for some motes, with C = (J^T Sigma^-1 J)^-1 at the true positions.

    ``true_m``: positions of all motes, shape (n, d). Returns None if the ranges leave the map free to move.
    """
    state = model.state(true_m)
    count = len(model.network.ranges_m)
    covariance, free = position_covariance(model, MapFit(state, 0.0, np.ones(count), np.zeros(count), 0, True))
    d = model.network.dimension
    if free > (d * (d + 1) // 2 if np.isnan(model.network.known_m).all() else 0):
        return None
    return map_rms_m(covariance, state.positions_m, motes, aligned=aligned)


def map_rms_m(covariance_m2: FloatArray, positions_m: FloatArray, motes: Sequence[int], *, aligned: bool) -> float:
    """Expected root mean square error of some motes, by the covariance of all coordinates (n d, n d).

    ``positions_m``: shape (n, d).
    """
    at = coordinates_of(motes, positions_m.shape[1])
    part = covariance_m2[np.ix_(at, at)]
    if aligned:
        modes = rigid_modes(positions_m[list(motes)])
        part = part - modes @ (modes.T @ part)
        part = part - (part @ modes) @ modes.T
    return float(np.sqrt(max(float(np.trace(part)), 0.0) / len(motes)))


_DENIED = 3.0  # chi-squared for each degree of freedom


class Agreement(NamedTuple):
    """How the ranges fit a map."""

    outlying: tuple[int, ...]  # ranges with a weight below one half
    factor: float  # chi-squared per degree of freedom of the others: 1 if the sigmas are right
    is_denied: bool  # the others do not fit, or the outliers exceed half the redundant ranges


def agreement_of(fit: MapFit, sigmas_m: FloatArray, dof: int) -> Agreement:
    """How the ranges fit a map. ``sigmas_m``: of the ranges, shape (m,).

    If half the redundant ranges are outliers, they can agree on another map (breakdown point: Rousseeuw 1984).
    """
    is_out = fit.weights < 0.5
    outliers = int(is_out.sum())
    cost = float(((fit.residuals_m / sigmas_m)[~is_out] ** 2).sum())
    factor = cost / (dof - outliers) if dof > outliers else 1.0
    is_denied = factor > _DENIED or 2 * outliers > dof > 0
    return Agreement(tuple(np.flatnonzero(is_out).tolist()), factor, is_denied)
