"""Pure. A map that floats freely, brought into a frame, its covariance with it."""

import numpy as np

from ccatp.motes.range_network import FloatArray
from ccatp.radio.rigid_alignment import RigidMotion, rigid_modes


def pinned_map(
    positions_m: FloatArray, covariance_m2: FloatArray, known_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The map moved so that a point and the direction to another are as known; in the plane.

    The error of a map in a frame is its shape's error less the rigid motion that keeps what is known without error:
    C' = S C S^T, S = I - G (K G)^-1 K, G the rigid motions of the map, K the rows of the known coordinates
    (S-transform, Baarda 1973).

    Args:
        positions_m: shape (n, 2).
        covariance_m2: of the free map, shape (2 n, 2 n).
        known_m: both coordinates of one mote and one of another, nan elsewhere, shape (n, 2).

    Raises:
        ValueError: other coordinates are known than these.
    """
    is_known = np.isfinite(known_m)
    whole = np.flatnonzero(is_known.all(axis=1))
    part = np.flatnonzero(is_known.sum(axis=1) == 1)
    if positions_m.shape[1] != 2 or len(whole) != 1 or len(part) != 1:
        raise ValueError(
            f"{int(is_known.sum())} known coordinates, wanted both of one mote and one of another in the plane"
        )
    first, second = int(whole[0]), int(part[0])
    axis = int(np.flatnonzero(is_known[second])[0])
    motion = _onto(positions_m, known_m, first, second, axis)
    moved = motion.moved(positions_m)
    count = len(positions_m)
    rows = [2 * first, 2 * first + 1, 2 * second + axis]
    modes = rigid_modes(moved)
    K = np.zeros((3, 2 * count))
    K[np.arange(3), rows] = 1.0
    S = np.eye(2 * count) - modes @ np.linalg.solve(K @ modes, K)
    return moved, S @ motion.turned_map(covariance_m2) @ S.T


def plain_frame(positions_m: FloatArray) -> RigidMotion:
    """The motion to a frame of the map's own: the first mote its origin, the second on +x, the third at y > 0.

    Args:
        positions_m: shape (n, d), of motes that are not all on a line.
    """
    offsets = positions_m - positions_m[0]
    d = positions_m.shape[1]
    basis: list[FloatArray] = []
    for offset in offsets[1:]:
        rest = offset - sum((offset @ axis) * axis for axis in basis)
        length = float(np.linalg.norm(rest))
        if length > 1e-6 * float(np.linalg.norm(offset)):
            basis.append(rest / length)
        if len(basis) == d:
            break
    rotation = np.array(basis) if len(basis) == d else np.eye(d)
    return RigidMotion(rotation, -rotation @ positions_m[0])


def _onto(positions_m: FloatArray, known_m: FloatArray, first: int, second: int, axis: int) -> RigidMotion:
    """Turn about the first mote until the second has its known coordinate, by the lesser of both angles."""
    way = positions_m[second] - positions_m[first]
    length, bearing = float(np.hypot(*way)), float(np.arctan2(way[1], way[0]))
    wanted = float(np.clip((known_m[second, axis] - known_m[first, axis]) / length, -1.0, 1.0))
    angle = float(np.arccos(wanted)) if axis == 0 else float(np.arcsin(wanted))
    other = -angle if axis == 0 else np.pi - angle
    # In the plane both solutions exist; the map is nearly in the frame already, or its anchors say which it is.
    turn = min((angle - bearing, other - bearing), key=lambda value: abs(np.angle(np.exp(1j * value))))
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s], [s, c]])
    return RigidMotion(rotation, known_m[first] - rotation @ positions_m[first])
