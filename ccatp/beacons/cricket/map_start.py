"""Places for a fit to begin with: unfolded, trilaterated, drawn, or grown mote by mote."""

from collections.abc import Iterator
from contextlib import suppress
from itertools import combinations

import numpy as np

from ccatp.beacons.cricket.range_network import (
    IndexArray,
    MappingError,
    PairMeans,
    RangeNetwork,
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
