"""What ranges can determine: free directions by name, and whether several maps fit equally well (global rigidity)."""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from ccatp.beacons.cricket.map_fit import MapModel, MapState
from ccatp.beacons.cricket.range_network import (
    IndexArray,
    RangeNetwork,
    components,
    coordinates_of,
    every_pair,
    graph_pairs,
    list_names,
)
from ccatp.core import FloatArray
from ccatp.filters.metrics import rigid_modes

_NULL = 1e-10  # of the largest eigenvalue: no range sees the direction
_STILL = 1e-6  # of the fastest mote: a mote that does not move
_AXES = ("x", "y", "z")


class Freedom(NamedTuple):
    """Directions of the unknowns that no range sees, to first order."""

    unknowns: int
    rank: int
    frame: tuple[str, ...]  # names of rigid motions of the whole map that are free
    flexes: tuple[str, ...]
    untold: tuple[str, ...]  # what of offset and scale cannot be separated from the map
    parts: tuple[tuple[int, ...], ...]

    @property
    def deficiency(self) -> int:
        """Free directions beyond the frame's."""
        return self.unknowns - self.rank - len(self.frame)

    @property
    def calibration(self) -> tuple[str, ...]:
        """A line for each of ``untold``."""
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
    """Rank and free directions at a state."""
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

    ``moves``: free directions, shape (n d, k). ``points``: shape (n, d).
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
    count, d = points.shape
    base = list(parts[0])
    at = coordinates_of(base, d)
    # Take from each direction the rigid motion that its base makes.
    rigid = rigid_modes(points)
    moves = moves - rigid @ np.linalg.lstsq(rigid[at], moves[at], rcond=1e-9)[0]
    U, singular, _ = np.linalg.svd(moves, full_matrices=False)
    rows = U[:, singular > 1e-7].T
    names, lines = network.names, Counter[str]()
    pairs = graph_pairs(network)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()
    steps = np.asarray(dijkstra(graph, directed=False, unweighted=True, indices=base, min_only=True))
    for row in _echelon(rows, steps, d):
        speeds = np.linalg.norm(row.reshape(count, d), axis=1)
        moving = [names[mote] for mote in np.flatnonzero(speeds > _STILL * speeds.max())]
        lines[f"{list_names(moving)} against {list_names([names[mote] for mote in base])}"] += 1
    return tuple(line if times == 1 else f"{line} ({times} ways)" for line, times in lines.items())


def _echelon(rows: FloatArray, steps: FloatArray, d: int) -> list[FloatArray]:
    order = coordinates_of(np.argsort(steps, kind="stable"), d)
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


_FOLD_OVER_NULL = 1e-9
_NAMED = 800  # motes up to which pairs that part the graph are looked for
_SHOWN = 8


class FoldOver(NamedTuple):
    """What may fold.

    ``mirrors``: (separator, motes): these motes may be mirrored across the line (plane) through the separator.
    """

    is_unique: bool  # whether almost all places give a map that is the only one, up to a rigid motion and the mirror
    mirrors: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]
    single_pairs: IndexArray  # pairs whose range nothing else confirms, shape (k, 2): without it something moves
    warnings: tuple[str, ...]


def find_fold_over(network: RangeNetwork, rng: np.random.Generator) -> FoldOver:
    """Test generic global rigidity, and name what can be mirrored where it fails.

    A graph of n > d + 1 vertices is generically globally rigid in d dimensions if and only if a random equilibrium
    stress of a random framework has a stress matrix of rank n - d - 1 (Connelly 2005; Gortler, Healy and Thurston
    2010). In the plane that is: three-connected, and rigid without any one range (Jackson and Jordan 2005). The pairs
    of a body, and of motes whose places are known, count as measured.
    """
    pairs = _all_pairs(network)
    count, d = network.count, network.dimension
    complete = len(pairs) == count * (count - 1) // 2
    if complete:
        return FoldOver(True, (), np.zeros((0, 2), dtype=np.intp), ())
    single, rank = _stress(pairs, rng.standard_normal((count, d)), rng)
    measured = set(map(tuple, network.pairs.tolist()))
    rows = [pair for pair in single.tolist() if tuple(pair) in measured]
    single = np.array(rows, dtype=np.intp).reshape(-1, 2)
    if count > d + 1 and rank == count - d - 1:
        return FoldOver(True, (), single, ())
    # The same motes may hang on many pairs, one of which is a mote they all turn about: once is enough.
    mirrors = tuple({motes: (separator, motes) for separator, motes in _mirrors(pairs, count, d)}.values())
    return FoldOver(False, mirrors, single, tuple(_warnings(network, mirrors, single)))


def _all_pairs(network: RangeNetwork) -> IndexArray:
    pairs = graph_pairs(network)
    known = np.flatnonzero(np.isfinite(network.known_m).all(axis=1))
    if known.size < 2:
        return pairs
    return np.unique(np.concatenate([pairs, every_pair(known)]), axis=0)


def _stress(pairs: IndexArray, points: FloatArray, rng: np.random.Generator) -> tuple[IndexArray, int]:
    count, d = points.shape
    i, j = pairs[:, 0], pairs[:, 1]
    ways = points[i] - points[j]
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    axis = np.arange(d)
    at = np.concatenate([i[:, None] * d + axis, j[:, None] * d + axis], axis=1)
    rows = np.repeat(np.arange(len(pairs)), 2 * d)
    R = coo_array(
        (np.concatenate([ways, -ways], axis=1).ravel(), (rows, at.ravel())), shape=(len(pairs), count * d)
    ).tocsr()
    values, vectors = np.linalg.eigh((R.T @ R).toarray())
    seen = values > _FOLD_OVER_NULL * values[-1]
    # Orthonormal basis of the column space of R; what a random vector has across it is an equilibrium stress.
    columns = np.asarray(R @ (vectors[:, seen] / np.sqrt(values[seen])))
    leverage = (columns**2).sum(axis=1)
    single = pairs[leverage > 1.0 - 1e-7]
    draw = rng.standard_normal(len(pairs))
    stress = draw - columns @ (columns.T @ draw)
    if len(single) == len(pairs) or float(np.abs(stress).max()) < 1e-8:
        return single, 0
    stress = np.where(leverage > 1.0 - 1e-7, 0.0, stress) / np.linalg.norm(points[i] - points[j], axis=1)
    omega = np.zeros((count, count))
    np.subtract.at(omega, (i, j), stress)
    np.subtract.at(omega, (j, i), stress)
    omega[np.diag_indices(count)] = -omega.sum(axis=1)
    eigenvalues = np.abs(np.linalg.eigvalsh(omega))
    return single, int((eigenvalues > _FOLD_OVER_NULL * eigenvalues.max()).sum())


def _mirrors(pairs: IndexArray, count: int, d: int) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
    partners = [set[int]() for _ in range(count)]
    for i, j in pairs.tolist():
        partners[i].add(j)
        partners[j].add(i)
    for mote in range(count):
        if len(partners[mote]) <= d and count > len(partners[mote]) + 1:
            yield tuple(sorted(partners[mote])), (mote,)
    if d != 2 or count > _NAMED:
        return
    for first in range(count):
        for second in _cut_vertices(partners, first):
            if second > first:
                yield from _sides(pairs, count, (first, second))


def _sides(
    pairs: IndexArray, count: int, separator: tuple[int, int]
) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
    kept = ~np.isin(pairs, separator).any(axis=1)
    labels = components(count, pairs[kept])
    labels[list(separator)] = -1
    sides = [np.flatnonzero(labels == label) for label in np.unique(labels[labels >= 0])]
    for side in sorted(sides, key=len)[:-1]:
        if len(side) > 1:
            yield separator, tuple(side.tolist())


def _cut_vertices(partners: list[set[int]], without: int) -> list[int]:
    """Vertices that part the graph once ``without`` is gone (Hopcroft and Tarjan 1973), without recursion."""
    count = len(partners)
    order, low = [-1] * count, [0] * count
    cuts: set[int] = set()
    clock = 0
    for root in range(count):
        if root == without or order[root] >= 0:
            continue
        branches = 0
        order[root] = low[root] = clock
        clock += 1
        stack = [(root, -1, iter(partners[root]))]
        while stack:
            vertex, parent, rest = stack[-1]
            for other in rest:
                if other in (without, parent):
                    continue
                if order[other] >= 0:
                    low[vertex] = min(low[vertex], order[other])
                    continue
                order[other] = low[other] = clock
                clock += 1
                branches += vertex == root
                stack.append((other, vertex, iter(partners[other])))
                break
            else:
                stack.pop()
                if stack:
                    above = stack[-1][0]
                    low[above] = min(low[above], low[vertex])
                    if above != root and low[vertex] >= order[above]:
                        cuts.add(above)
        if branches > 1:
            cuts.add(root)
    return sorted(cuts)


def _warnings(
    network: RangeNetwork, mirrors: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...], single: IndexArray
) -> Iterator[str]:
    names, shape = network.names, "line" if network.dimension == 2 else "plane"
    for separator, motes in mirrors[:_SHOWN]:
        held = list_names([names[mote] for mote in separator])
        yield f"{list_names([names[mote] for mote in motes])} may be mirrored across the {shape} through {held}"
    if len(mirrors) > _SHOWN:
        yield f"and {len(mirrors) - _SHOWN} more sets of motes may be mirrored"
    if not mirrors and len(single):
        shown = list_names([f"{names[i]} to {names[j]}" for i, j in single.tolist()])
        yield f"ranges that nothing confirms, so that several maps may fit: {shown}"
    if not mirrors and not len(single):
        yield "several maps may fit all ranges; a few more pairs would exclude it"
