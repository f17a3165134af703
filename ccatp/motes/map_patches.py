"""Pure. A first map of hundreds of motes: small maps around each mote, turned and shifted to agree, all at once."""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import lsqr, splu

from ccatp.motes.pair_means import PairMeans
from ccatp.motes.range_network import FloatArray, IntArray
from ccatp.motes.unfolding import unfolded
from ccatp.radio.rigid_alignment import best_motion

_MISFIT = 6.0  # root mean square residual of a patch, in sigmas, beyond which it is folded or its ranges are wrong
_QUICK, _SLOW = (1e3,), (1e-2, 1.0, 1e3)  # a patch is nearly complete: most unfold at once, the others in a few steps
_GOOD = 1.7  # root mean square residual, in sigmas, of a patch that needs no slower try
_ROUNDS = 4  # of weighing the relations anew
_SHIFT, _ITERATIONS = 1e-3, 30  # of the inverse iteration: eigenvalues are at most 1, those wanted next to it
_AGREE = 0.2  # distance of a relation from the turns found, beyond which it weighs less and less
_PARTNERS = 24  # patches that one patch is compared with at most


class Patch(NamedTuple):
    """A map of a mote and its neighbours, in a frame of its own.

    Attributes:
        motes: their indices, shape (k,).
        places_m: shape (k, d).
    """

    motes: IntArray
    places_m: FloatArray


def stitched(count: int, means: PairMeans, dimension: int) -> FloatArray:
    """Places of n motes, nan where no patch holds a mote, shape (n, d).

    Each mote and its neighbours give a patch; two patches that share d + 1 motes tell how one is turned, or mirrored,
    against the other. The turns of all patches are the leading eigenvectors of the matrix of these relations
    (eigenvector synchronization over O(d): Cucuringu, Lipman and Singer 2012), and their shifts a linear least-squares
    problem. No patch decides for the others, so that errors do not grow with the way from a first one.

    Args:
        count: n.
        means: the ranges.
        dimension: d.
    """
    patches = [patch for mote in range(count) if (patch := _patch(mote, means, dimension)) is not None]
    places = np.full((count, dimension), np.nan)
    if not patches:
        return places
    turns = _turns(patches, count, dimension)
    kept = [number for number in range(len(patches)) if turns[number] is not None]
    return _shifted(
        [patches[number] for number in kept], np.array([turns[number] for number in kept]), count, dimension
    )


def _patch(centre: int, means: PairMeans, dimension: int) -> Patch | None:
    """The motes around one that hold together by d + 1 ranges each, mapped; None where they are too few or fold."""
    motes = {centre, *means.partners(centre)}
    while True:
        weak = {mote for mote in motes if len(motes.intersection(means.partners(mote))) <= dimension}
        if not weak:
            break
        motes -= weak
    if centre not in motes or len(motes) < dimension + 2:
        return None
    members = sorted(motes)
    place = {mote: row for row, mote in enumerate(members)}
    rows = [
        (place[mote], place[partner], *found)
        for mote in members
        for partner in means.partners(mote)
        if partner in place and mote < partner and (found := means.between(mote, partner)) is not None
    ]
    table = np.array(rows)
    pairs = table[:, :2].astype(np.intp)
    best, least = np.zeros((0, dimension)), _MISFIT
    for squeezes in (_QUICK, _SLOW):
        points = unfolded(len(members), pairs, table[:, 2], table[:, 3], dimension, squeezes=squeezes)
        lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
        misfit = float(np.sqrt(np.mean(((table[:, 2] - lengths) / table[:, 3]) ** 2)))
        if misfit < least:
            best, least = points, misfit
        if least < _GOOD:
            break
    return Patch(np.array(members, dtype=np.intp), best) if len(best) else None


def _turns(patches: list[Patch], count: int, dimension: int) -> list[FloatArray | None]:
    """Orthogonal matrices that bring the patches into one frame; None for patches that hang on no other."""
    relations = _relations(patches, count, dimension)
    size = len(patches)
    turns: list[FloatArray | None] = [None] * size
    if not relations:
        largest = max(range(size), key=lambda number: len(patches[number].motes))
        turns[largest] = np.eye(dimension)
        return turns
    group = _largest_group(relations, size)
    row_of = {number: row for row, number in enumerate(group)}
    linked = [(row_of[a], row_of[b], turn, weight) for a, b, turn, weight in relations if a in row_of]
    ends = np.array([(i, j) for i, j, _, _ in linked], dtype=np.intp)
    blocks = np.array([turn for _, _, turn, _ in linked])
    trust = np.array([weight for _, _, _, weight in linked])
    weights = trust
    found = np.zeros((len(group), dimension, dimension))
    for _ in range(_ROUNDS):
        found = _synchronised(ends, blocks, weights, len(group))
        # A patch that is folded, or an overlap that is nearly flat, contradicts the others: it loses its say.
        wanted = np.einsum("kji,kjl->kil", found[ends[:, 0]], found[ends[:, 1]])
        apart = ((wanted - blocks) ** 2).sum(axis=(1, 2))
        weights = trust / (1.0 + apart / _AGREE**2) + 1e-9
    for number, turn in zip(group, found, strict=True):
        turns[number] = turn
    return turns


def _synchronised(ends: IntArray, blocks: FloatArray, weights: FloatArray, size: int) -> FloatArray:
    """Turns O_k with O_a^T O_b nearest to the relations, shape (p, d, d)."""
    dimension = blocks.shape[1]
    axis = np.arange(dimension)
    degree = np.bincount(ends.ravel(), np.repeat(weights, 2), size)
    values, rows, cols = [], [], []
    for here, there, block in ((0, 1, blocks), (1, 0, blocks.transpose(0, 2, 1))):
        values.append((weights[:, None, None] * block).ravel())
        rows.append(np.repeat(ends[:, here, None] * dimension + axis, dimension, axis=1).ravel())
        cols.append(np.tile(ends[:, there, None] * dimension + axis, (1, dimension)).ravel())
    n = size * dimension
    matrix = coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))), shape=(n, n)).tocsr()
    leading = _leading(matrix, np.repeat(1.0 / np.sqrt(degree), dimension), dimension)
    U, _, Vt = np.linalg.svd(leading.transpose(0, 2, 1))
    return np.asarray(U @ Vt)


def _leading(matrix: csr_array, half: FloatArray, dimension: int) -> FloatArray:
    """Blocks of the d leading eigenvectors of D^-1/2 A D^-1/2, times D^-1/2, shape (p, d, d).

    By inverse iteration of the whole subspace: where the relations agree its eigenvalues coincide, and a Lanczos
    method, which starts from one vector, may miss one of them.
    """
    scaled = diags_array(half) @ matrix @ diags_array(half)
    n = matrix.shape[0]
    solver = splu((diags_array(np.full(n, 1.0 + _SHIFT)) - scaled).tocsc(), permc_spec="MMD_AT_PLUS_A")
    # A fixed start: the same ranges give the same map.
    basis = np.cos(np.outer(np.arange(n), 1.0 + np.arange(dimension)))
    for _ in range(_ITERATIONS):
        basis = np.linalg.qr(solver.solve(basis))[0]
    return np.asarray((basis * half[:, None]).reshape(-1, dimension, dimension))


def _relations(patches: list[Patch], count: int, dimension: int) -> list[tuple[int, int, FloatArray, float]]:
    """For patches a < b that share d + 1 motes: the turn from b's frame to a's, and how far it is to be trusted."""
    holders: list[list[int]] = [[] for _ in range(count)]
    for number, patch in enumerate(patches):
        for mote in patch.motes.tolist():
            holders[mote].append(number)
    found = []
    for a, patch in enumerate(patches):
        shared: dict[int, int] = {}
        for mote in patch.motes.tolist():
            for b in holders[mote]:
                if b > a:
                    shared[b] = shared.get(b, 0) + 1
        usable = sorted((b for b, common in shared.items() if common > dimension), key=lambda b: -shared[b])
        for b in usable[:_PARTNERS]:
            relation = _relation(patch, patches[b], dimension)
            if relation is not None:
                found.append((a, b, *relation))
    return found


def _relation(first: Patch, second: Patch, dimension: int) -> tuple[FloatArray, float] | None:
    """The turn, and as its weight how much better it fits than its mirror image; None where both fit alike."""
    _, at_first, at_second = np.intersect1d(first.motes, second.motes, assume_unique=True, return_indices=True)
    target, source = first.places_m[at_first], second.places_m[at_second]
    centred, other = source - source.mean(axis=0), target - target.mean(axis=0)
    motion = best_motion(source, target, mirrors=True)
    error = float(((motion.moved(source) - target) ** 2).sum())
    # The best turn of the opposite handedness loses twice the least singular value.
    singular = np.linalg.svd(centred.T @ other, compute_uv=False)
    gap = 4.0 * float(singular[-1])
    if gap <= 4.0 * error:
        return None
    return motion.rotation, float(np.sqrt(gap / (gap + error)) * np.sqrt(len(at_first) - dimension))


def _largest_group(relations: list[tuple[int, int, FloatArray, float]], size: int) -> list[int]:
    a, b = np.array([relation[0] for relation in relations]), np.array([relation[1] for relation in relations])
    labels = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(size, size)), directed=False)[1]
    return [int(number) for number in np.flatnonzero(labels == np.bincount(labels).argmax())]


def _shifted(patches: list[Patch], turns: FloatArray, count: int, dimension: int) -> FloatArray:
    """Places x and shifts t of x_i = O_k p_ik + t_k, by least squares over all motes of all patches."""
    motes = np.concatenate([patch.motes for patch in patches])
    owner = np.repeat(np.arange(len(patches)), [len(patch.motes) for patch in patches])
    turned = np.concatenate([patch.places_m @ turn.T for patch, turn in zip(patches, turns, strict=True)])
    rows = np.arange(len(motes))
    values = np.concatenate([np.ones(len(motes)), -np.ones(len(motes))])
    shape = (len(motes), count + len(patches))
    A = coo_array((values, (np.tile(rows, 2), np.concatenate([motes, count + owner]))), shape=shape).tocsr()
    found = np.column_stack([lsqr(A, turned[:, axis], atol=1e-10, btol=1e-10)[0] for axis in range(dimension)])[:count]
    found[~np.isin(np.arange(count), motes)] = np.nan
    return np.asarray(found)
