"""The map that fits all ranges best: model, sparse damped least squares with a robust loss, covariance, least error."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csr_array, diags_array, hstack
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from ccatp.beacons.cricket.range_network import IndexArray, RangeNetwork, coordinates_of
from ccatp.core import FloatArray
from ccatp.filters.metrics import best_motion, rigid_modes


@dataclass(frozen=True, slots=True)
class MapState:
    """A map."""

    positions_m: FloatArray  # of all motes, shape (n, d)
    rotations: FloatArray  # of the bodies, world from body, shape (b, d, d)
    offset_m: float = 0.0
    scale: float = 0.0


class MapModel:
    """Ranges z = (1 + s) |p_i - p_j| + o and their derivatives.

    The unknowns are the coordinates of loose motes that are not known, a place and a small rotation of each body, then
    o and s where they are asked for.
    """

    def __init__(self, network: RangeNetwork, *, with_offset: bool = False, with_scale: bool = False) -> None:
        self.network = network
        self.with_offset, self.with_scale = with_offset, with_scale
        d = network.dimension
        loose = np.array(network.loose, dtype=np.intp)
        is_free = np.isnan(network.known_m[loose]) if loose.size else np.zeros((0, d), dtype=bool)
        rows, axes = np.nonzero(is_free)
        self._loose_at: IndexArray = loose[rows] * d + axes  # flat coordinate of each unknown of a loose mote
        self.body_size = d + d * (d - 1) // 2
        self._body_at = [coordinates_of(body.motes, d) for body in network.bodies]
        self._bodies_from = len(self._loose_at)
        self.coordinates = self._bodies_from + self.body_size * len(network.bodies)
        self.size = self.coordinates + int(with_offset) + int(with_scale)
        m = len(network.ranges_m)
        axis = np.arange(d)
        self._indices = np.concatenate(
            [network.first[:, None] * d + axis, network.second[:, None] * d + axis], axis=1
        ).ravel()
        self._indptr = np.arange(m + 1) * 2 * d

    def state(self, positions_m: FloatArray, offset_m: float = 0.0, scale: float = 0.0) -> MapState:
        """The state nearest to positions of the motes, shape (n, d): known coordinates in place, bodies made rigid."""
        known = self.network.known_m
        positions = np.where(np.isnan(known), positions_m, known)
        rotations = []
        for body in self.network.bodies:
            motes = list(body.motes)
            motion = best_motion(body.local_m, positions_m[motes])
            positions[motes] = motion.moved(body.local_m)
            rotations.append(motion.rotation)
        d = self.network.dimension
        return MapState(positions, np.array(rotations).reshape(-1, d, d), offset_m, scale)

    def residuals(self, state: MapState) -> FloatArray:
        """Measured less computed ranges, shape (m,)."""
        return self.network.ranges_m - (1.0 + state.scale) * self._distances(state)[0] - state.offset_m

    def jacobian(self, state: MapState) -> csr_array:
        """dz/dq, shape (m, size)."""
        distances, directions = self._distances(state)
        parts = [self.range_rows(state, directions) @ self.position_jacobian(state)]
        if self.with_offset:
            parts.append(csr_array(np.ones((len(distances), 1))))
        if self.with_scale:
            parts.append(csr_array(distances[:, None]))
        return csr_array(hstack(parts)) if len(parts) > 1 else csr_array(parts[0])

    def dense_jacobian(self, state: MapState) -> FloatArray:
        """The same as a full array: for small maps, where sparse arrays cost more than their zeros."""
        distances, u = self._distances(state)
        m, coordinates = len(u), self.network.count * self.network.dimension
        rows = np.zeros((m, coordinates))
        rows[np.arange(m)[:, None], self._indices.reshape(m, -1)] = (1.0 + state.scale) * np.concatenate(
            [u, -u], axis=1
        )
        B = np.zeros((coordinates, self.coordinates))
        for (at, cols), values in self._position_blocks(state):
            B[at, cols] = values
        J = np.empty((m, self.size))
        J[:, : self.coordinates] = rows @ B
        if self.with_offset:
            J[:, self.coordinates] = 1.0
        if self.with_scale:
            J[:, -1] = distances
        return J

    def range_rows(self, state: MapState, directions: FloatArray | None = None) -> csr_array:
        """dz/dp, the rigidity matrix with rows of unit length times 1 + s, shape (m, n d)."""
        u = self._distances(state)[1] if directions is None else directions
        values = (1.0 + state.scale) * np.concatenate([u, -u], axis=1).ravel()
        shape = (len(u), self.network.count * self.network.dimension)
        return csr_array((values, self._indices, self._indptr), shape=shape)

    def position_jacobian(self, state: MapState) -> csr_array:
        """dp/dq without offset and scale, shape (n d, coordinates)."""
        blocks = list(self._position_blocks(state))
        rows = np.concatenate([at for (at, _), _ in blocks])
        cols = np.concatenate([cols for (_, cols), _ in blocks])
        values = np.concatenate([values for _, values in blocks])
        shape = (self.network.count * self.network.dimension, self.coordinates)
        return coo_array((values, (rows, cols)), shape=shape).tocsr()

    def _position_blocks(self, state: MapState) -> Iterator[tuple[tuple[IndexArray, IndexArray], FloatArray]]:
        yield (self._loose_at, np.arange(self._bodies_from)), np.ones(self._bodies_from)
        for number, (body, at) in enumerate(zip(self.network.bodies, self._body_at, strict=True)):
            block = _body_block(body.local_m @ state.rotations[number].T)
            start = self._bodies_from + number * self.body_size
            cols = np.tile(start + np.arange(self.body_size), len(at))
            yield (np.repeat(at, self.body_size), cols), block.ravel()

    def moved(self, state: MapState, step: FloatArray) -> MapState:
        """The state after a step of the unknowns, shape (size,)."""
        d = self.network.dimension
        flat = state.positions_m.ravel().copy()
        flat[self._loose_at] += step[: self._bodies_from]
        positions = flat.reshape(-1, d)
        rotations = state.rotations.copy()
        for number, body in enumerate(self.network.bodies):
            start = self._bodies_from + number * self.body_size
            shift, turn = step[start : start + d], step[start + d : start + self.body_size]
            motes = list(body.motes)
            origin = state.positions_m[motes[0]] - rotations[number] @ body.local_m[0]
            rotations[number] = _turn(turn) @ rotations[number]
            positions[motes] = body.local_m @ rotations[number].T + origin + shift
        offset_m, scale = state.offset_m, state.scale
        if self.with_offset:
            offset_m += float(step[self.coordinates])
        if self.with_scale:
            scale += float(step[-1])
        return replace(state, positions_m=positions, rotations=rotations, offset_m=offset_m, scale=scale)

    def _distances(self, state: MapState) -> tuple[FloatArray, FloatArray]:
        """Distances (m,) and unit vectors from the second mote to the first, shape (m, d)."""
        offsets = state.positions_m[self.network.first] - state.positions_m[self.network.second]
        distances = np.sqrt(np.einsum("ij,ij->i", offsets, offsets))
        # Motes in one place have no direction: a zero row leaves the range out of this step.
        return distances, offsets / np.maximum(distances, 1e-12)[:, None]


def _body_block(arms: FloatArray) -> FloatArray:
    """Derivatives of the motes of a body by its place and its rotation about its frame's origin.

    ``arms``: R times local places, shape (k, d).
    """
    count, d = arms.shape
    block = np.zeros((count, d, d + d * (d - 1) // 2))
    block[:, :, :d] = np.eye(d)
    if d == 2:
        block[:, 0, 2], block[:, 1, 2] = -arms[:, 1], arms[:, 0]
    else:
        x, y, z = arms.T
        block[:, 1, 3], block[:, 2, 3] = -z, y  # about x
        block[:, 0, 4], block[:, 2, 4] = z, -x  # about y
        block[:, 0, 5], block[:, 1, 5] = -y, x  # about z
    return block


def _turn(angles_rad: FloatArray) -> FloatArray:
    """Rotation matrix of a rotation vector, shape (1,) in the plane, (3,) in space."""
    if angles_rad.size == 1:
        c, s = np.cos(angles_rad[0]), np.sin(angles_rad[0])
        return np.array([[c, -s], [s, c]])
    return np.asarray(Rotation.from_rotvec(angles_rad).as_matrix())


_FIRST_DAMPING = 1e-4  # of the largest diagonal of the normal matrix
_DENSE = 240  # unknowns up to which dense Cholesky is quicker than sparse LU
_NULL = 1e-9  # eigenvalues below this share of the largest are directions that no range sees


class MapFitSettings(NamedTuple):
    """How to fit.

    ``robust_scale``: Cauchy loss: residuals beyond this many sigmas weigh less and less; infinite for least squares.
    """

    robust_scale: float = float("inf")
    max_iterations: int = 200
    tolerance_m: float = 1e-8  # a step whose largest part is shorter ends the iteration


class MapFit(NamedTuple):
    """A fitted map."""

    state: MapState
    cost: float  # sum of the loss, c^2 log(1 + (r / (c sigma))^2), or (r / sigma)^2
    weights: FloatArray  # what the loss left of each range, 0 to 1, shape (m,)
    residuals_m: FloatArray  # shape (m,)
    iterations: int
    is_at_rest: bool  # whether the steps had ended before ``max_iterations``


def fit_map(model: MapModel, start: MapState, settings: MapFitSettings) -> MapFit:
    """Minimise the loss of all ranges from a start.

    Steps (J^T W J + lambda D) dq = J^T W r (Levenberg 1944, Marquardt 1963) with W = w / sigma^2 and the weights
    w = 1 / (1 + (r / (c sigma))^2) of the Cauchy loss. A network without known coordinates may shift and turn: the
    damping keeps it where it started.
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
                return MapFit(state, cost, weights, residuals, iteration, True)
        else:
            damping *= 6.0
            if damping > 1e9:
                return MapFit(state, cost, weights, residuals, iteration, True)
    return MapFit(state, cost, weights, residuals, settings.max_iterations, False)


def fit_from_afar(model: MapModel, start: MapState, settings: MapFitSettings) -> MapFit:
    """The same from a start that may be metres off: by least squares first.

    To a robust loss all ranges of a mote that is far from its place are outliers, and nothing pulls it there.
    """
    if not np.isfinite(settings.robust_scale):
        return fit_map(model, start, settings)
    near = fit_map(model, start, settings._replace(robust_scale=float("inf")))
    fit = fit_map(model, near.state, settings)
    return fit._replace(iterations=near.iterations + fit.iterations)


def position_covariance(model: MapModel, fit: MapFit) -> tuple[FloatArray, int]:
    """Covariance of all positions and how many directions of the unknowns no range sees.

    Where nothing pins the frame, the covariance is that of the map after the rigid motion that brings it nearest to the
    truth (inner constraints of a free network): C = S B N^+ B^T S^T with B = dp/dq, N the normal matrix and S the
    projection across all rigid motions. Directions without information count as known: look at the second value.
    Returns covariance (n d, n d), and the number of directions without information, the frame's included.
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


def _loss(scaled: FloatArray, robust_scale: float) -> tuple[float, FloatArray]:
    squares = scaled**2
    if not np.isfinite(robust_scale):
        return float(squares.sum()), np.ones(len(scaled))
    ratio = squares / robust_scale**2
    return float(robust_scale**2 * np.log1p(ratio).sum()), 1.0 / (1.0 + ratio)


def _normal(
    model: MapModel, state: MapState, residuals: FloatArray, weights: FloatArray
) -> tuple[csr_array | FloatArray, FloatArray]:
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


def bound_rms_m(model: MapModel, true_m: FloatArray, motes: Sequence[int], *, aligned: bool) -> float | None:
    """sqrt(tr C / n) of some motes, C = (J^T Sigma^-1 J)^-1 at the true places.

    ``true_m``: places of all motes, shape (n, d). Returns the bound in metres; None where the ranges leave the map free
    to move.
    """
    state = model.state(true_m)
    count = len(model.network.ranges_m)
    fit = MapFit(state, 0.0, np.ones(count), np.zeros(count), 0, True)
    covariance, free = position_covariance(model, fit)
    d = model.network.dimension
    if free > (d * (d + 1) // 2 if np.isnan(model.network.known_m).all() else 0):
        return None
    return map_rms_m(covariance, state.positions_m, motes, aligned=aligned)


def map_rms_m(covariance_m2: FloatArray, positions_m: FloatArray, motes: Sequence[int], *, aligned: bool) -> float:
    """Root mean square error that a covariance of all coordinates (n d, n d) expects of some motes.

    ``positions_m``: shape (n, d).
    """
    d = positions_m.shape[1]
    at = coordinates_of(motes, d)
    part = covariance_m2[np.ix_(at, at)]
    if aligned:
        modes = rigid_modes(positions_m[list(motes)])
        part = part - modes @ (modes.T @ part)
        part = part - (part @ modes) @ modes.T
    return float(np.sqrt(max(float(np.trace(part)), 0.0) / len(motes)))
