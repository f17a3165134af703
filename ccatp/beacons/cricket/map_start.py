"""Start positions for a map fit: unfolded from more dimensions, drawn at random, or added mote by mote."""

from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.sparse.csgraph import shortest_path

from ccatp.beacons.cricket.map_fit import MapFitSettings, MapModel, fit_map
from ccatp.beacons.cricket.range_network import PairMeans, RangeNetwork, adjacency, every_pair
from ccatp.beacons.cricket.trilateration import sphere_crossings
from ccatp.beacons.rigid_motion import best_motion
from ccatp.core import FloatArray

_SPARE = 2  # extra dimensions, in which a folded part of the map can turn over
# Successive weights of the spare dimensions, in units of the median weight of a distance.
_SQUEEZES = tuple(np.geomspace(1e-3, 1e3, 7).tolist())
_SQUEEZED = MapFitSettings(max_iterations=25, damping=1e-2)  # for each weight; the caller makes the final fit
# Largest weight of a range over the median weight. If weights differed by orders of magnitude, the strong ranges would
# fix the map before the weak ones have turned it over.
_HEAVIEST = 25.0


def unfolded(network: RangeNetwork, rng: np.random.Generator | None = None) -> FloatArray:
    """Positions of n motes from their ranges, shape (n, d); the frame and the mirror image are arbitrary.

    It starts in d + 2 dimensions: from classical scaling, or from random positions if ``rng`` is given. Weighted least
    squares on the ranges then refines the positions, while a growing weight on the spare dimensions forces the points
    into d dimensions. A map that is folded in d dimensions can often unfold through the spare ones. ``network``:
    without bodies and known positions.
    """
    count, d = network.count, network.dimension
    wide = d + _SPARE
    if rng is None:
        points = classical_scaling(completed(network), wide)
    else:
        points = rng.normal(0.0, float(np.median(network.ranges_m)), (count, wide))
    weights = 1.0 / network.sigmas_m**2
    weights = np.minimum(weights / np.median(weights), _HEAVIEST)
    known_m = np.full((count, wide), np.nan)
    model = MapModel(replace(network, dimension=wide, sigmas_m=1.0 / np.sqrt(weights), known_m=known_m))
    for squeeze in _SQUEEZES:
        penalty = np.tile(np.where(np.arange(wide) < d, 0.0, squeeze), count)
        points = fit_map(model, model.state(points), _SQUEEZED, penalty).state.positions_m
        centred = points - points.mean(axis=0)
        points = np.asarray(centred @ np.linalg.eigh(centred.T @ centred)[1][:, ::-1])  # along the principal axes
    return np.ascontiguousarray(points[:, :d])


def classical_scaling(distances_m: FloatArray, dimension: int) -> FloatArray:
    """Torgerson's scaling (1952): the leading eigenvectors of -1/2 J D^2 J, shape (n, dimension)."""
    squares = distances_m**2
    centred = squares - squares.mean(axis=0) - squares.mean(axis=1)[:, None] + squares.mean()
    values, vectors = np.linalg.eigh(-0.5 * centred)
    points = np.zeros((len(distances_m), dimension))
    kept = min(dimension, len(distances_m))
    points[:, :kept] = vectors[:, ::-1][:, :kept] * np.sqrt(np.maximum(values[::-1][:kept], 0.0))
    return points


def completed(network: RangeNetwork) -> FloatArray:
    """All distances, unknown ones as the shortest path along ranges, shape (n, n) (Shang et al., MDS-MAP, 2003)."""
    # A sparse graph takes a weight of zero for a missing edge.
    graph = adjacency(network.count, network.pairs, np.maximum(network.ranges_m, 1e-9))
    return np.asarray(shortest_path(graph, directed=False))


_SEEDS = 30  # attempts to draw a first triangle (tetrahedron)
_CROSSINGS = 30  # intersections of spheres that are tried for one mote
_WIDE = 3.0  # factor of the robust scale, because new positions have larger errors than ranges
_FLAT = 0.05  # height over length, below which a first triangle is too flat


def grown(network: RangeNetwork, robust_scale: float, rng: np.random.Generator) -> FloatArray | None:
    """Positions of n motes, shape (n, d); nan for motes that cannot be placed, None without a first triangle.

    In least squares one wrong range bends the whole map. Here only drawn ranges place a mote. The first d + 1 motes
    have all their mutual distances measured. Then the mote that most ranges agree on is added, again and again: at the
    intersection of d spheres with the least robust cost over its ranges to placed motes (consensus: Fischler and Bolles
    1981).
    """
    means, count, dimension = PairMeans(network), network.count, network.dimension
    table, scale = means.table_m, _WIDE * robust_scale * means.sigma_table_m
    places = np.full((count, dimension), np.nan)
    seed = _drawn_simplex(table, scale, dimension, rng)
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


def _drawn_simplex(
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
    tips = sphere_crossings(anchors[drawn], ranges_m[drawn]).reshape(-1, d)
    missed = (np.linalg.norm(tips[:, None] - anchors[None], axis=2) - ranges_m) / scales_m
    # 1 for a range that fits the position, towards 0 for one that is far off.
    met = (1.0 / (1.0 + missed**2)).sum(axis=1)
    best = int(np.argmax(met))
    return float(met[best]), tips[best]


def images(network: RangeNetwork, places_m: FloatArray) -> list[FloatArray]:
    """Positions (n, d) moved onto the known ones; also the mirror image, where known positions or bodies can decide."""
    known = np.isfinite(network.known_m).all(axis=1)
    if known.sum() > network.dimension:
        return [best_motion(places_m[known], network.known_m[known], mirrors=True).moved(places_m)]
    if not network.bodies and not np.isfinite(network.known_m).any():
        return [places_m]
    return [places_m, places_m * np.where(np.arange(network.dimension) == 0, -1.0, 1.0)]


def filled(places_m: FloatArray, network: RangeNetwork) -> FloatArray:
    """Positions (n, d); each unknown (nan) one is replaced by a point near the motes that it has ranges to."""
    places, pairs = places_m.copy(), network.pairs
    for _ in range(len(places)):
        is_known = np.isfinite(places[:, 0])
        for mote in np.flatnonzero(~is_known).tolist():
            partners = np.setdiff1d(pairs[(pairs == mote).any(axis=1)], [mote])
            if (near := partners[np.isfinite(places[partners, 0])]).size:
                # Not at the mean itself: two motes at the same point have no direction between them.
                places[mote] = places[near].mean(axis=0) + 1e-3 * (1.0 + mote % 7)
        if np.isfinite(places[:, 0]).sum() == is_known.sum():
            break
    return np.nan_to_num(places)


def with_bodies(network: RangeNetwork) -> RangeNetwork:
    """The network with one range for each pair; bodies become ranges, known positions are dropped."""
    means = PairMeans(network)
    pairs, ranges, sigmas = [means.pairs], [means.ranges_m], [means.sigmas_m]
    for body in network.bodies:
        a, b = every_pair(np.arange(len(body.motes))).T
        pairs.append(every_pair(np.array(body.motes, dtype=np.intp)))
        ranges.append(np.linalg.norm(body.local_m[a] - body.local_m[b], axis=1))
        sigmas.append(np.full(len(a), float(means.sigmas_m.min())))
    first, second = np.concatenate(pairs).T
    known_m = np.full_like(network.known_m, np.nan)
    return replace(
        network, first=first, second=second, ranges_m=np.concatenate(ranges), sigmas_m=np.concatenate(sigmas),
        bodies=(), known_m=known_m,
    )  # fmt: skip
