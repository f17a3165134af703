"""Places for a fit to begin with: unfolded, stitched from patches, trilaterated, drawn, or grown mote by mote."""

from collections.abc import Iterator
from contextlib import suppress
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import lsqr, splu

from ccatp.beacons.cricket.range_network import (
    IndexArray,
    MappingError,
    PairMeans,
    RangeNetwork,
    components,
    every_pair,
)
from ccatp.beacons.cricket.trilateration import map_as_possible
from ccatp.beacons.cricket.unfolding import classical_scaling, unfolded
from ccatp.core import FloatArray
from ccatp.filters.metrics import best_motion

_SEEDS = 30  # draws of a first triangle (tetrahedron) before there is taken to be none
_CROSSINGS = 30  # crossings of spheres that are tried for one mote
_WIDE = 3.0  # places that were just found are off by more than a range: robust scales that still count as meeting
_FLAT = 0.05  # height over length of a triangle that is too flat to begin with


def grown(
    count: int, pairs: IndexArray, distances_m: FloatArray, sigmas_m: FloatArray, dimension: int, robust_scale: float,
    rng: np.random.Generator,
) -> FloatArray | None:  # fmt: skip
    """Places of n points, nan where d ranges do not reach, shape (n, d); None where there is no triangle to begin with.

    Least squares lets a wrong range bend the whole map. Here no range is used that is not drawn: d + 1 points that all
    know their distances come first; then the point that most ranges agree on, at the crossing of d spheres that has the
    least robust cost of all ranges to points with a place (consensus: Fischler and Bolles 1981). ``pairs``: known
    distances, each pair once, shape (e, 2). ``distances_m``: shape (e,). ``sigmas_m``: shape (e,).
    """
    table, scale = np.full((2, count, count), np.nan)
    for i, j in (pairs.T, pairs.T[::-1]):
        table[i, j], scale[i, j] = distances_m, _WIDE * robust_scale * sigmas_m
    places = np.full((count, dimension), np.nan)
    seed = _seed(table, scale, dimension, rng)
    if seed is None:
        return None
    places[seed[0]] = seed[1]
    candidates: dict[int, tuple[float, FloatArray]] = {}
    fresh = list(range(count))
    while True:
        is_placed = np.isfinite(places[:, 0])
        for mote in fresh:
            near = np.flatnonzero(is_placed & np.isfinite(table[mote]))
            if not is_placed[mote] and len(near) >= dimension:
                candidates[mote] = _crossing(places[near], table[mote, near], scale[mote, near], rng)
        if not candidates:
            return places
        mote = max(candidates, key=lambda which: candidates[which][0])
        places[mote] = candidates.pop(mote)[1]
        fresh = np.flatnonzero(np.isfinite(table[mote])).tolist()


def _seed(
    table: FloatArray, scale: FloatArray, dimension: int, rng: np.random.Generator
) -> tuple[list[int], FloatArray] | None:
    for _ in range(_SEEDS):
        chosen = [int(rng.integers(len(table)))]
        while len(chosen) <= dimension:
            common = np.flatnonzero(np.isfinite(table[chosen]).all(axis=0))
            if not common.size:
                break
            chosen.append(int(rng.choice(common)))
        if len(chosen) <= dimension:
            continue
        lengths = np.nan_to_num(table[np.ix_(chosen, chosen)])
        points = classical_scaling(lengths, dimension)
        missed = np.abs(np.linalg.norm(points[:, None] - points[None], axis=2) - lengths)
        extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if np.nanmax(missed / scale[np.ix_(chosen, chosen)]) < 1.0 and extents[-1] > _FLAT * extents[0]:
            return chosen, points
    return None


def _crossing(
    anchors: FloatArray, ranges_m: FloatArray, scales_m: FloatArray, rng: np.random.Generator
) -> tuple[float, FloatArray]:
    count, d = anchors.shape
    drawn = np.array(
        list(combinations(range(count), d))
        if count <= 8
        else [rng.choice(count, d, replace=False) for _ in range(_CROSSINGS)]
    )
    if len(drawn) > _CROSSINGS:
        drawn = drawn[rng.choice(len(drawn), _CROSSINGS, replace=False)]
    first, radii = anchors[drawn[:, 0]], ranges_m[drawn]
    ways = anchors[drawn[:, 1:]] - first[:, None]
    level = 0.5 * (radii[:, :1] ** 2 - radii[:, 1:] ** 2 + (ways**2).sum(axis=2))
    foot = np.einsum("kij,kj->ki", np.linalg.pinv(ways), level)
    normal = np.linalg.svd(ways)[2][:, -1]
    height = np.sqrt(np.maximum(radii[:, 0] ** 2 - (foot**2).sum(axis=1), 0.0))
    tips = np.concatenate([first + foot + side * height[:, None] * normal for side in (1.0, -1.0)])
    missed = (np.linalg.norm(tips[:, None] - anchors[None], axis=2) - ranges_m) / scales_m
    # 1 for a range that meets the place, nought for one that is far off it.
    met = (1.0 / (1.0 + missed**2)).sum(axis=1)
    best = int(np.argmax(met))
    return float(met[best]), tips[best]


_MISFIT = 6.0  # root mean square residual of a patch, in sigmas, beyond which it is folded or its ranges are wrong
_QUICK, _SLOW = (1e3,), (1e-2, 1.0, 1e3)  # a patch is nearly complete: most unfold at once, the others in a few steps
_GOOD = 1.7  # root mean square residual, in sigmas, of a patch that needs no slower try
_ROUNDS = 4  # of weighing the relations again
_SHIFT, _ITERATIONS = 1e-3, 30  # of the inverse iteration: eigenvalues are at most 1, those wanted next to it
_AGREE = 0.2  # distance of a relation from the turns found, beyond which it weighs less and less
_PARTNERS = 24  # patches that one patch is compared with at most


class Patch(NamedTuple):
    """A map of a mote and its neighbours, in a frame of its own."""

    motes: IndexArray  # their indices, shape (k,)
    places_m: FloatArray  # shape (k, d)


def stitched(count: int, means: PairMeans, dimension: int) -> FloatArray:
    """Places of n motes, nan where no patch holds a mote, shape (n, d).

    Each mote and its neighbours give a patch; two patches that share d + 1 motes show how one is turned, or mirrored,
    against the other. The turns of all patches are the leading eigenvectors of the matrix of these relations
    (eigenvector synchronization over O(d): Cucuringu, Lipman and Singer 2012), and their shifts a linear least-squares
    problem. No patch decides for the others, so that errors do not grow with the way from a first one.
    """
    patches = [patch for mote in range(count) if (patch := _patch(mote, means, dimension)) is not None]
    if not patches:
        return np.full((count, dimension), np.nan)
    group, turns = _turns(patches, count, dimension)
    return _shifted([patches[number] for number in group], turns, count, dimension)


def _patch(centre: int, means: PairMeans, dimension: int) -> Patch | None:
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


def _turns(patches: list[Patch], count: int, dimension: int) -> tuple[list[int], FloatArray]:
    """The largest group of patches that hang together, and their turns into one frame, shape (p, d, d)."""
    relations = _relations(patches, count, dimension)
    size = len(patches)
    if not relations:
        largest = max(range(size), key=lambda number: len(patches[number].motes))
        return [largest], np.eye(dimension)[None]
    labels = components(size, np.array([(a, b) for a, b, _, _ in relations], dtype=np.intp))
    group = np.flatnonzero(labels == np.bincount(labels).argmax()).tolist()
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
    return group, found


def _synchronised(ends: IndexArray, blocks: FloatArray, weights: FloatArray, size: int) -> FloatArray:
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


def _shifted(patches: list[Patch], turns: FloatArray, count: int, dimension: int) -> FloatArray:
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


_WHOLE = 130  # motes up to which the whole map is unfolded at once; beyond, it is stitched from patches
FEW = 60  # motes up to which unfolding from drawn places costs little
_DRAWS = 16
_FEW_DRAWS = 2  # where there are more, and each takes seconds
_MAX_DOP = 60.0  # of a trilateration that is but a start


def map_starts(network: RangeNetwork, given_m: FloatArray | None) -> Iterator[list[FloatArray]]:
    """Places to begin, the most promising first; each with its mirror image, where bodies distinguish them.

    ``given_m``: what the caller has, shape (n, d), nan where nothing is known.
    """
    means = PairMeans(network)
    pairs, distances_m, sigmas_m = _with_bodies(network, means)
    count, d = network.count, network.dimension
    if count > _WHOLE and not network.bodies:
        yield _images(network, _filled(stitched(count, means, d), means))
    yield _images(network, unfolded(count, pairs, distances_m, sigmas_m, d))
    if given_m is not None:
        yield [_filled(given_m, means)]
    with suppress(MappingError):  # no triangle to begin with, or none that is good: the other starts need none
        yield _images(network, _filled(map_as_possible(network, _MAX_DOP).positions_m, means))
    if count <= FEW:
        for draw in range(_DRAWS):  # the same ranges give the same map
            yield _images(network, unfolded(count, pairs, distances_m, sigmas_m, d, rng=np.random.default_rng(draw)))


def grown_starts(network: RangeNetwork, robust_scale: float) -> Iterator[list[FloatArray]]:
    """Maps grown from drawn triangles, which a few wrong ranges do not bend; with their mirror images as before."""
    means = PairMeans(network)
    pairs, distances_m, sigmas_m = _with_bodies(network, means)
    for draw in range(_DRAWS if network.count <= FEW else _FEW_DRAWS):
        rng = np.random.default_rng(draw)
        places = grown(network.count, pairs, distances_m, sigmas_m, network.dimension, robust_scale, rng)
        if places is not None:
            yield _images(network, _filled(places, means))


def _images(network: RangeNetwork, places_m: FloatArray) -> list[FloatArray]:
    known = np.isfinite(network.known_m).all(axis=1)
    if known.sum() > network.dimension:
        return [best_motion(places_m[known], network.known_m[known], mirrors=True).moved(places_m)]
    if not network.bodies and not np.isfinite(network.known_m).any():
        return [places_m]
    flip = np.ones(network.dimension)
    flip[0] = -1.0
    return [places_m, places_m * flip]


def _filled(places_m: FloatArray, means: PairMeans) -> FloatArray:
    places = places_m.copy()
    for _ in range(len(places)):
        missing = np.flatnonzero(np.isnan(places[:, 0]))
        if missing.size == 0:
            break
        for mote in missing.tolist():
            partners = places[means.partners(mote)]
            known = partners[np.isfinite(partners[:, 0])] if len(partners) else partners
            if len(known):
                # Beside the mean: two motes in one place would have no direction between them.
                places[mote] = known.mean(axis=0) + 1e-3 * (1.0 + mote % 7)
    return np.nan_to_num(places)


def _with_bodies(network: RangeNetwork, means: PairMeans) -> tuple[IndexArray, FloatArray, FloatArray]:
    pairs, distances, sigmas = [means.pairs], [means.ranges_m], [means.sigmas_m]
    for body in network.bodies:
        a, b = every_pair(np.arange(len(body.motes))).T
        pairs.append(every_pair(np.array(body.motes, dtype=np.intp)))
        distances.append(np.linalg.norm(body.local_m[a] - body.local_m[b], axis=1))
        sigmas.append(np.full(len(a), float(means.sigmas_m.min())))
    return np.concatenate(pairs), np.concatenate(distances), np.concatenate(sigmas)
