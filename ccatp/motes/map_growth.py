"""Pure. Maps grown mote by mote from a drawn triangle, each mote where most ranges meet: starts among wrong ranges."""

from itertools import combinations

import numpy as np

from ccatp.motes.range_network import FloatArray, IntArray
from ccatp.motes.unfolding import classical_scaling

_SEEDS = 30  # draws of a first triangle (tetrahedron) before there is taken to be none
_CROSSINGS = 30  # crossings of spheres that are tried for one mote
_WIDE = 3.0  # places that were just found are off by more than a range: robust scales that still count as meeting
_FLAT = 0.05  # height over length of a triangle that is too flat to begin with


def grown(
    count: int,
    pairs: IntArray,
    distances_m: FloatArray,
    sigmas_m: FloatArray,
    dimension: int,
    robust_scale: float,
    rng: np.random.Generator,
) -> FloatArray | None:
    """Places of n points, nan where d ranges do not reach, shape (n, d); None where there is no triangle to begin with.

    Least squares lets a wrong range bend the whole map. Here no range is used that is not drawn: d + 1 points that all
    know their distances come first; then the point that most ranges agree on, at the crossing of d spheres that has
    the least robust cost of all ranges to points with a place (consensus: Fischler and Bolles 1981).

    Args:
        count: n.
        pairs: known distances, each pair once, shape (e, 2).
        distances_m: shape (e,).
        sigmas_m: shape (e,).
        dimension: d.
        robust_scale: of the Cauchy loss, in sigmas.
        rng: draws the first points, and crossings where there are many.
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
    """Points that all know their distances, not flat, and their places."""
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
    """How many ranges meet at the best crossing of d spheres, and where that is."""
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
