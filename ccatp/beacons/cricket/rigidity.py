"""What the ranges determine: the free directions, and whether several maps fit equally well (global rigidity)."""

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import depth_first_order, dijkstra

from ccatp.beacons.cricket.map_fit import MapModel, MapState, rigidity_matrix
from ccatp.beacons.cricket.range_network import (
    IndexArray,
    RangeNetwork,
    adjacency,
    coordinates_of,
    every_pair,
    graph_pairs,
    sides,
)
from ccatp.beacons.rigid_motion import rigid_modes
from ccatp.core import FloatArray
from ccatp.errors import listed

_NULL = 1e-10  # of the largest eigenvalue; below it no range determines the direction
_STILL = 1e-6  # of the fastest speed; below it a mote does not move
_AXES = ("x", "y", "z")


class Freedom(NamedTuple):
    """Directions of the unknowns that no range determines, to first order."""

    unknowns: int
    rank: int
    frame: tuple[str, ...]  # free rigid motions of the whole map
    flexes: tuple[str, ...]  # free motions of a part of the map against the rest
    undetermined: tuple[str, ...]  # "offset" or "scale", if it cannot be separated from the map

    @property
    def deficiency(self) -> int:
        """Number of free directions beyond those of the frame."""
        return self.unknowns - self.rank - len(self.frame)

    @property
    def lines(self) -> list[str]:
        """Descriptions of the free directions beyond those of the frame."""
        return [*self.flexes, *(f"range {name}: the map takes it up" for name in self.undetermined)]


def generic_state(model: MapModel, rng: np.random.Generator) -> MapState:
    """Motes at random positions: their rigidity is that of almost all positions, so none needs to be known."""
    network = model.network
    places = rng.standard_normal((network.count, network.dimension))
    sizes = [float(np.abs(body.local_m).max()) or 1.0 for body in network.bodies]
    for body, size in zip(network.bodies, sizes, strict=True):
        turn = np.linalg.qr(rng.standard_normal((network.dimension, network.dimension)))[0]
        if np.linalg.det(turn) < 0.0:
            turn[:, 0] = -turn[:, 0]
        # Distances comparable to the size of the bodies, so that rounding does not hide what the bodies determine.
        places[list(body.motes)] = places[body.motes[0]] * 3.0 * size + body.local_m @ turn.T
    places[list(network.loose)] *= 3.0 * max(sizes, default=1.0 / 3.0)
    return model.state(places)


def find_freedom(model: MapModel, state: MapState) -> Freedom:
    """Rank and free directions at a state."""
    null = _null_space(model, state)
    moves = np.asarray(model.position_jacobian(state) @ null[: model.coordinates])
    names = [name for name, on in (("offset", model.with_offset), ("scale", model.with_scale)) if on]
    shares = np.abs(null[model.coordinates :]).max(axis=1, initial=0.0)
    undetermined = tuple(name for name, share in zip(names, shares, strict=True) if share > 1e-7)
    frame = _frame(moves, state.positions_m)
    is_flexible = null.shape[1] - len(frame) > len(undetermined)
    flexes = _flexes(moves, state.positions_m, model.network) if is_flexible else ()
    return Freedom(model.size, model.size - null.shape[1], frame, flexes, undetermined)


def _largest_rigid_part(moves: FloatArray, points: FloatArray) -> list[int]:
    """Motes whose mutual distances no free direction (n d, k) changes; points of shape (n, d)."""
    count, d = points.shape
    # One combination of all directions, with weights that do not cancel by accident.
    mixed = (moves @ np.sin(1.0 + np.arange(moves.shape[1]))).reshape(count, d)
    scale = float(np.abs(mixed).max() * np.abs(points).max())
    offsets, rates = points[:, None] - points[None], mixed[:, None] - mixed[None]
    holds = np.abs(np.einsum("ijk,ijk->ij", offsets, rates)) < 1e-7 * scale
    best = [0]
    is_covered = np.eye(count, dtype=bool)
    for i, j in np.argwhere(np.triu(holds, 1)).tolist():
        if is_covered[i, j]:
            continue
        part, left = [i, j], holds[i] & holds[j]
        while (rest := np.setdiff1d(np.flatnonzero(left), part)).size:
            part.append(int(rest[0]))
            left = left & holds[rest[0]]
        is_covered[np.ix_(part, part)] = True
        best = max(best, sorted(part), key=len)
    return best


def _null_space(model: MapModel, state: MapState) -> FloatArray:
    """Orthonormal basis of the directions of the unknowns that change no range, shape (size, k)."""
    J = model.jacobian(state).toarray()
    columns = np.sqrt((J**2).sum(axis=0))
    columns[columns == 0.0] = 1.0
    values, vectors = np.linalg.eigh((J / columns).T @ (J / columns))
    null = vectors[:, values <= _NULL * max(float(values[-1]), 1e-300)] / columns[:, None]
    return np.asarray(np.linalg.qr(null)[0]) if null.shape[1] else null


def _frame(moves: FloatArray, points: FloatArray) -> tuple[str, ...]:
    if moves.shape[1] == 0:
        return ()
    d, basis, modes = points.shape[1], np.linalg.qr(moves)[0], rigid_modes(points)
    # Cosines of the principal angles between the two spaces: 1 for a common direction.
    shared = int((np.linalg.svd(basis.T @ modes, compute_uv=False) > 1.0 - 1e-7).sum())
    is_free = np.linalg.norm(basis.T @ modes[:, :d], axis=0) > 1.0 - 1e-7  # the first modes are translations
    names = [f"translation along {_AXES[axis]}" for axis in np.flatnonzero(is_free)]
    names += ["rotation"] if d == 2 else [f"rotation {number + 1}" for number in range(shared)]
    return tuple(names[:shared])


def _flexes(moves: FloatArray, points: FloatArray, network: RangeNetwork) -> tuple[str, ...]:
    count, d = points.shape
    base = _largest_rigid_part(moves, points)
    at = coordinates_of(base, d)
    # Subtract from each direction the rigid motion of its base.
    rigid = rigid_modes(points)
    moves = moves - rigid @ np.linalg.lstsq(rigid[at], moves[at], rcond=1e-9)[0]
    U, singular, _ = np.linalg.svd(moves, full_matrices=False)
    names, lines = network.names, Counter[str]()
    graph = adjacency(count, graph_pairs(network))
    steps = np.asarray(dijkstra(graph, directed=False, unweighted=True, indices=base, min_only=True))
    for row in _echelon(U[:, singular > 1e-7].T, coordinates_of(np.argsort(steps, kind="stable"), d)):
        speeds = np.linalg.norm(row.reshape(count, d), axis=1)
        moving = [names[mote] for mote in np.flatnonzero(speeds > _STILL * speeds.max())]
        lines[f"{listed(moving)} against {listed([names[mote] for mote in base])}"] += 1
    return tuple(line if times == 1 else f"{line} ({times} ways)" for line, times in lines.items())


def _echelon(rows: FloatArray, order: IndexArray) -> list[FloatArray]:
    left, found = list(rows), list[FloatArray]()
    for at in order:
        if not left:
            break
        pivot = max(range(len(left)), key=lambda k: abs(left[k][at]))
        if abs(left[pivot][at]) >= 1e-8:
            row = left.pop(pivot)
            found.append(row)
            left = [other - row * (other[at] / row[at]) for other in left]
    return found


_FOLD_OVER_NULL = 1e-9
_NAMED = 800  # largest number of motes for which separating pairs are searched
_SHOWN = 8


class FoldOver(NamedTuple):
    """Which parts of the map may fold.

    ``mirrors``: (separator, motes): these motes may be mirrored across the line (plane) through the separator.
    """

    is_unique: bool  # for almost all positions only one map fits, up to a rigid motion and a mirror image
    mirrors: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]
    warnings: tuple[str, ...]


def find_fold_over(network: RangeNetwork, rng: np.random.Generator) -> FoldOver:
    """Test generic global rigidity; if it fails, list the motes that can be mirrored.

    A graph of n > d + 1 vertices is generically globally rigid in d dimensions if and only if a random equilibrium
    stress of a random framework has a stress matrix of rank n - d - 1 (Connelly 2005; Gortler, Healy and Thurston
    2010). In the plane this means: three-connected, and rigid without any one range (Jackson and Jordan 2005). Pairs of
    a body and pairs of motes with known positions count as measured.
    """
    pairs = _all_pairs(network)
    count, d = network.count, network.dimension
    if len(pairs) == count * (count - 1) // 2:
        return FoldOver(True, (), ())
    single, rank = _stress(pairs, rng.standard_normal((count, d)), rng)
    if count > d + 1 and rank == count - d - 1:
        return FoldOver(True, (), ())
    # The same motes may have several separators; one is enough.
    mirrors = tuple({motes: (separator, motes) for separator, motes in _mirrors(pairs, count, d)}.values())
    measured = set(map(tuple, network.pairs.tolist()))
    single_pairs = [pair for pair in single.tolist() if tuple(pair) in measured]
    return FoldOver(False, mirrors, tuple(_warnings(network, mirrors, single_pairs)))


def _all_pairs(network: RangeNetwork) -> IndexArray:
    pairs = graph_pairs(network)
    known = np.flatnonzero(np.isfinite(network.known_m).all(axis=1))
    if known.size < 2:
        return pairs
    return np.unique(np.concatenate([pairs, every_pair(known)]), axis=0)


def _stress(pairs: IndexArray, points: FloatArray, rng: np.random.Generator) -> tuple[IndexArray, int]:
    """Pairs whose removal makes the graph flexible, and the rank of a random stress matrix."""
    count = len(points)
    i, j = pairs.T
    R = rigidity_matrix(points, i, j)
    values, vectors = np.linalg.eigh((R.T @ R).toarray())
    seen = values > _FOLD_OVER_NULL * values[-1]
    # Orthonormal basis of the column space of R; the part of a random vector orthogonal to it is an equilibrium stress.
    columns = np.asarray(R @ (vectors[:, seen] / np.sqrt(values[seen])))
    is_single = (columns**2).sum(axis=1) > 1.0 - 1e-7
    draw = rng.standard_normal(len(pairs))
    stress = draw - columns @ (columns.T @ draw)
    if is_single.all() or float(np.abs(stress).max()) < 1e-8:
        return pairs[is_single], 0
    stress = np.where(is_single, 0.0, stress) / np.linalg.norm(points[i] - points[j], axis=1)
    stresses = adjacency(count, pairs, stress).toarray()
    stresses += stresses.T
    omega = np.diag(stresses.sum(axis=0)) - stresses
    eigenvalues = np.abs(np.linalg.eigvalsh(omega))
    return pairs[is_single], int((eigenvalues > _FOLD_OVER_NULL * eigenvalues.max()).sum())


def _mirrors(pairs: IndexArray, count: int, d: int) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
    partners = [pairs[(pairs == mote).any(axis=1)].sum(axis=1) - mote for mote in range(count)]
    for mote in range(count):
        if len(partners[mote]) <= d and count > len(partners[mote]) + 1:
            yield tuple(sorted(partners[mote].tolist())), (mote,)
    if d != 2 or count > _NAMED:
        return
    for first in range(count):
        for second in _cut_vertices(pairs, count, first):
            if second > first:
                parts = sorted(sides(count, pairs, (first, second)), key=len)[:-1]
                yield from (((first, second), part) for part in parts if len(part) > 1)


def _cut_vertices(pairs: IndexArray, count: int, without: int) -> list[int]:
    """Cut vertices of the graph without ``without`` (low points: Hopcroft and Tarjan 1973)."""
    kept = pairs[(pairs != without).all(axis=1)]
    graph = adjacency(count, kept)
    low, cuts, left = np.full(count, -1), set[int](), set(range(count)) - {without}
    while left:
        root = min(left)
        nodes, before = depth_first_order(graph, root, directed=False)
        left -= set(nodes.tolist())
        order = np.full(count, -1)
        order[nodes] = np.arange(len(nodes))
        low[nodes] = order[nodes]
        i, j = kept[order[kept[:, 0]] >= 0].T
        np.minimum.at(low, i, order[j])
        np.minimum.at(low, j, order[i])
        for vertex in nodes[:0:-1].tolist():  # children before their parents
            above = int(before[vertex])
            low[above] = min(low[above], low[vertex])
            if above != root and low[vertex] >= order[above]:
                cuts.add(above)
        if int((before[nodes[1:]] == root).sum()) > 1:
            cuts.add(root)
    return sorted(cuts)


def _warnings(
    network: RangeNetwork, mirrors: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...], single_pairs: list[list[int]]
) -> Iterator[str]:
    names, shape = network.names, "line" if network.dimension == 2 else "plane"
    for separator, motes in mirrors[:_SHOWN]:
        held = listed([names[mote] for mote in separator])
        yield f"{listed([names[mote] for mote in motes])} may be mirrored across the {shape} through {held}"
    if len(mirrors) > _SHOWN:
        yield f"and {len(mirrors) - _SHOWN} more sets of motes may be mirrored"
    if not mirrors and single_pairs:
        shown = listed([f"{names[i]} to {names[j]}" for i, j in single_pairs])
        yield f"ranges that nothing confirms, so that several maps may fit: {shown}"
    if not mirrors and not single_pairs:
        yield "several maps may fit all ranges; a few more pairs would exclude it"
