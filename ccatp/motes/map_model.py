"""Pure. What the ranges of a network depend on: places of loose motes, poses of bodies, an offset and a scale."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array, csr_array, hstack
from scipy.spatial.transform import Rotation

from ccatp.motes.range_network import FloatArray, IntArray, RangeNetwork
from ccatp.radio.rigid_alignment import best_motion


@dataclass(frozen=True, slots=True)
class MapState:
    """A map.

    Attributes:
        positions_m: of all motes, shape (n, d).
        rotations: of the bodies, world from body, shape (b, d, d).
        offset_m: common offset of the ranges.
        scale: common scale of the ranges, less one.
    """

    positions_m: FloatArray
    rotations: FloatArray
    offset_m: float = 0.0
    scale: float = 0.0


class MapModel:
    """Ranges z = (1 + s) |p_i - p_j| + o and their derivatives.

    The unknowns are the coordinates of loose motes that are not known, a place and a small rotation of each body, then
    o and s where they are asked for.

    Args:
        network: motes and ranges.
        with_offset: estimate o.
        with_scale: estimate s.
    """

    def __init__(self, network: RangeNetwork, *, with_offset: bool = False, with_scale: bool = False) -> None:
        self.network = network
        self.with_offset, self.with_scale = with_offset, with_scale
        d = network.dimension
        loose = np.array(network.loose, dtype=np.intp)
        is_free = np.isnan(network.known_m[loose]) if loose.size else np.zeros((0, d), dtype=bool)
        rows, axes = np.nonzero(is_free)
        self._loose_at: IntArray = loose[rows] * d + axes  # flat coordinate of each unknown of a loose mote
        self.body_size = d + d * (d - 1) // 2
        self._body_at = [
            (np.array(body.motes, dtype=np.intp)[:, None] * d + np.arange(d)).ravel() for body in network.bodies
        ]
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

    def _position_blocks(self, state: MapState) -> Iterator[tuple[tuple[IntArray, IntArray], FloatArray]]:
        """Rows, columns and values of dp/dq: of all loose motes, then of each body."""
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

    Args:
        arms: R times local places, shape (k, d).
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
