"""Pure. Whether ranges leave several maps that fit equally well: generic global rigidity, and who can fold over."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array

from ccatp.motes.range_network import FloatArray, IntArray, RangeNetwork, components, graph_pairs, list_names

_NULL = 1e-9
_NAMED = 800  # motes up to which pairs that part the graph are looked for
_SHOWN = 8


class FoldOver(NamedTuple):
    """What may fold.

    Attributes:
        is_unique: whether almost all places give a map that is the only one, up to a rigid motion and the mirror.
        mirrors: (separator, motes): these motes may be mirrored across the line (plane) through the separator.
        single_pairs: pairs whose range nothing else confirms, shape (k, 2): without it something moves.
        warnings: the same in words.
    """

    is_unique: bool
    mirrors: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]
    single_pairs: IntArray
    warnings: tuple[str, ...]


def find_fold_over(network: RangeNetwork, rng: np.random.Generator) -> FoldOver:
    """Test generic global rigidity, and name what can be mirrored where it fails.

    A graph of n > d + 1 vertices is generically globally rigid in d dimensions if and only if a random equilibrium
    stress of a random framework has a stress matrix of rank n - d - 1 (Connelly 2005; Gortler, Healy and Thurston
    2010). In the plane that is: three-connected, and rigid without any one range (Jackson and Jordan 2005). The pairs
    of a body, and of motes whose places are known, count as measured.

    Args:
        network: the graph.
        rng: for random places.
    """
    pairs = _all_pairs(network)
    count, d = network.count, network.dimension
    complete = len(pairs) == count * (count - 1) // 2
    if complete:
        return FoldOver(True, (), np.zeros((0, 2), dtype=np.intp), ())
    single, rank = _stress(pairs, rng.standard_normal((count, d)), rng)
    single = _measured(network, single)
    if count > d + 1 and rank == count - d - 1:
        return FoldOver(True, (), single, ())
    # The same motes may hang on many pairs, one of which is a mote they all turn about: once is enough.
    mirrors = tuple({motes: (separator, motes) for separator, motes in _mirrors(pairs, count, d)}.values())
    return FoldOver(False, mirrors, single, tuple(_warnings(network, mirrors, single)))


def _all_pairs(network: RangeNetwork) -> IntArray:
    pairs = graph_pairs(network)
    known = np.flatnonzero(np.isfinite(network.known_m).all(axis=1))
    if known.size < 2:
        return pairs
    upper = np.triu_indices(len(known), 1)
    return np.unique(np.concatenate([pairs, np.column_stack([known[upper[0]], known[upper[1]]])]), axis=0)


def _measured(network: RangeNetwork, pairs: IntArray) -> IntArray:
    """Those of some pairs that have a range of their own."""
    ends = np.sort(np.column_stack([network.first, network.second]), axis=1)
    measured = set(map(tuple, ends.tolist()))
    return np.array([pair for pair in pairs.tolist() if tuple(pair) in measured], dtype=np.intp).reshape(-1, 2)


def _stress(pairs: IntArray, points: FloatArray, rng: np.random.Generator) -> tuple[IntArray, int]:
    """Pairs that bear no stress in any equilibrium, and the rank of the stress matrix of a random one."""
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
    seen = values > _NULL * values[-1]
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
    return single, int((eigenvalues > _NULL * eigenvalues.max()).sum())


def _mirrors(pairs: IntArray, count: int, d: int) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Motes with too few partners, and in the plane all that hangs on two motes."""
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
    pairs: IntArray, count: int, separator: tuple[int, int]
) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
    """All but the largest part of what is left without two motes; single motes are named already."""
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
    network: RangeNetwork, mirrors: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...], single: IntArray
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
