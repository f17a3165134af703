"""Pure. What ranges can determine at all: rank of their derivatives, and the directions that stay free, by name."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from ccatp.motes.map_model import MapModel, MapState
from ccatp.motes.range_network import FloatArray, RangeNetwork, graph_pairs, list_names
from ccatp.radio.rigid_alignment import rigid_modes

_NULL = 1e-10  # of the largest eigenvalue: no range sees the direction
_STILL = 1e-6  # of the fastest mote: a mote that does not move
_AXES = ("x", "y", "z")


class Freedom(NamedTuple):
    """Directions of the unknowns that no range sees, to first order.

    Attributes:
        unknowns: their number.
        rank: of the derivatives of the ranges by them.
        frame: names of rigid motions of the whole map that are free.
        flexes: which motes move against the others, one line for each free direction.
        untold: what of offset and scale cannot be told from the map.
        parts: motes that hold together, largest first; a mote in two parts is a hinge.
    """

    unknowns: int
    rank: int
    frame: tuple[str, ...]
    flexes: tuple[str, ...]
    untold: tuple[str, ...]
    parts: tuple[tuple[int, ...], ...]

    @property
    def deficiency(self) -> int:
        """Free directions beyond the frame's."""
        return self.unknowns - self.rank - len(self.frame)

    @property
    def calibration(self) -> tuple[str, ...]:
        """A line for each that cannot be told."""
        return tuple(f"range {name}: the map takes it up" for name in self.untold)


def generic_state(model: MapModel, rng: np.random.Generator) -> MapState:
    """Motes anywhere: what holds there holds for almost all places, so it can be said before any is known."""
    network = model.network
    places = rng.standard_normal((network.count, network.dimension))
    for body in network.bodies:
        size = float(np.abs(body.local_m).max()) or 1.0
        turn = np.linalg.qr(rng.standard_normal((network.dimension, network.dimension)))[0]
        if np.linalg.det(turn) < 0.0:
            turn[:, 0] = -turn[:, 0]
        # Bodies as large as the rest, so that rounding does not hide what they determine.
        places[list(body.motes)] = places[body.motes[0]] * 3.0 * size + body.local_m @ turn.T
    if network.bodies:
        size = max(float(np.abs(body.local_m).max()) for body in network.bodies)
        loose = list(network.loose)
        places[loose] *= 3.0 * size
    return model.state(places)


def find_freedom(model: MapModel, state: MapState) -> Freedom:
    """Rank and free directions at a state.

    Args:
        model: network and unknowns, offset and scale among them where they are estimated.
        state: where; ``generic_state`` before anything is known, an estimate to see what its geometry adds.
    """
    network = model.network
    null = _null_space(model, state)
    moves = np.asarray(model.position_jacobian(state) @ null[: model.coordinates])
    names = [name for name, on in (("offset", model.with_offset), ("scale", model.with_scale)) if on]
    untold = tuple(
        name
        for row, name in enumerate(names)
        if null.shape[1] and float(np.abs(null[model.coordinates + row]).max()) > 1e-7
    )
    frame = _frame(moves, state.positions_m)
    extra = null.shape[1] - len(frame)
    parts = rigid_parts(moves, state.positions_m, extra)
    flexes = _flexes(moves, state.positions_m, parts, network) if extra > len(untold) else ()
    return Freedom(model.size, model.size - null.shape[1], frame, flexes, untold, parts)


def rigid_parts(moves: FloatArray, points: FloatArray, extra: int) -> tuple[tuple[int, ...], ...]:
    """Sets of motes whose distances stay in every free direction, largest first.

    Args:
        moves: free directions, shape (n d, k).
        points: shape (n, d).
        extra: how many of the directions are no rigid motions; with none, everything is one part.
    """
    count, d = points.shape
    if extra <= 0:
        return (tuple(range(count)),)
    # One combination of all directions, with weights that no accident makes cancel.
    mixed = (moves @ np.sin(1.0 + np.arange(moves.shape[1]))).reshape(count, d)
    scale = float(np.abs(mixed).max() * np.abs(points).max())
    offsets, rates = points[:, None] - points[None], mixed[:, None] - mixed[None]
    holds = np.abs(np.einsum("ijk,ijk->ij", offsets, rates)) < 1e-7 * scale
    parts: list[tuple[int, ...]] = []
    covered = np.eye(count, dtype=bool)
    for i in range(count):
        for j in np.flatnonzero(holds[i] & ~covered[i]):
            if covered[i, j]:
                continue
            members = _clique(holds, i, int(j))
            covered[np.ix_(members, members)] = True
            parts.append(tuple(members))
    alone = [(mote,) for mote in range(count) if not any(mote in part for part in parts)]
    return tuple(sorted({*parts, *alone}, key=lambda part: (-len(part), part)))


def _clique(holds: NDArray[np.bool_], first: int, second: int) -> list[int]:
    """Motes that keep all their distances, two given ones among them: in space two alone do not tell the others."""
    left, chosen = holds[first] & holds[second], [first, second]
    while (rest := np.setdiff1d(np.flatnonzero(left), chosen)).size:
        chosen.append(int(rest[0]))
        left = left & holds[rest[0]]
        left[chosen] = True
    return sorted(chosen)


def _null_space(model: MapModel, state: MapState) -> FloatArray:
    """Orthonormal basis of the unknowns' directions without any effect, shape (size, k)."""
    J = model.jacobian(state).toarray()
    columns = np.sqrt((J**2).sum(axis=0))
    columns[columns == 0.0] = 1.0
    values, vectors = np.linalg.eigh((J / columns).T @ (J / columns))
    null = vectors[:, values <= _NULL * max(float(values[-1]), 1e-300)] / columns[:, None]
    return np.asarray(np.linalg.qr(null)[0]) if null.shape[1] else null


def _frame(moves: FloatArray, points: FloatArray) -> tuple[str, ...]:
    """Which rigid motions of all motes are among some directions."""
    if moves.shape[1] == 0:
        return ()
    basis = np.linalg.qr(moves)[0]
    modes = rigid_modes(points)
    # Cosines of the angles between both spaces: 1 for what they share.
    shared = int((np.linalg.svd(basis.T @ modes, compute_uv=False) > 1.0 - 1e-7).sum())
    d = points.shape[1]
    names = []
    for axis in range(d):
        mode = np.zeros_like(points)
        mode[:, axis] = 1.0 / np.sqrt(len(points))
        if float(np.linalg.norm(basis.T @ mode.ravel())) > 1.0 - 1e-7:
            names.append(f"translation along {_AXES[axis]}")
    turns = shared - len(names)
    if turns > 0:
        names += ["rotation"] if d == 2 else [f"rotation {number + 1}" for number in range(turns)]
    return tuple(names[:shared])


def _flexes(
    moves: FloatArray, points: FloatArray, parts: Sequence[tuple[int, ...]], network: RangeNetwork
) -> tuple[str, ...]:
    """The motes that move in each direction when the largest part is held."""
    count, d = points.shape
    base = list(parts[0])
    at = (np.array(base)[:, None] * d + np.arange(d)).ravel()
    # Take from each direction the rigid motion that its base makes.
    rigid = rigid_modes(points)
    moves = moves - rigid @ np.linalg.lstsq(rigid[at], moves[at], rcond=1e-9)[0]
    U, singular, _ = np.linalg.svd(moves, full_matrices=False)
    rows = U[:, singular > 1e-7].T
    names, lines = network.names, Counter[str]()
    for row in _echelon(rows, _steps_from(base, network), d):
        speeds = np.linalg.norm(row.reshape(count, d), axis=1)
        moving = [names[mote] for mote in np.flatnonzero(speeds > _STILL * speeds.max())]
        lines[f"{list_names(moving)} against {list_names([names[mote] for mote in base])}"] += 1
    return tuple(line if times == 1 else f"{line} ({times} ways)" for line, times in lines.items())


def _steps_from(base: Sequence[int], network: RangeNetwork) -> FloatArray:
    """How many ranges lead from a set of motes to each."""
    pairs = graph_pairs(network)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(network.count, network.count)).tocsr()
    return np.asarray(dijkstra(graph, directed=False, unweighted=True, indices=list(base), min_only=True))


def _echelon(rows: FloatArray, steps: FloatArray, d: int) -> list[FloatArray]:
    """Directions by elimination, motes near the base first: each row moves fewer motes than the one before."""
    order = (np.argsort(steps, kind="stable")[:, None] * d + np.arange(d)).ravel()
    left = [row.copy() for row in rows]
    found = []
    for at in order:
        if not left:
            break
        pivot = max(range(len(left)), key=lambda k: abs(left[k][at]))
        if abs(left[pivot][at]) < 1e-8:
            continue
        row = left.pop(pivot)
        found.append(row)
        left = [other - row * (other[at] / row[at]) for other in left]
    return found
