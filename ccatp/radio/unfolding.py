"""Pure. A first map of a few dozen motes: multidimensional scaling, unfolded in more dimensions than there are."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array
from scipy.sparse.csgraph import shortest_path

from ccatp.radio.range_network import FloatArray, IntArray

_SPARE = 2  # dimensions more than the map has, in which what is folded can turn over
_SQUEEZES = np.geomspace(1e-3, 1e3, 7)  # weight of the spare dimensions, in units of the mean weight of a range
_STEPS = 25  # of each squeeze; the last fit of all is left to others


def unfolded(count: int, pairs: IntArray, distances_m: FloatArray, sigmas_m: FloatArray, dimension: int) -> FloatArray:
    """Places of n points from some of their distances, shape (n, d); as ranges do, it leaves frame and mirror open.

    The missing distances are taken as the shortest way along known ones (Shang et al., MDS-MAP, 2003), classical scaling
    (Torgerson 1952) gives places in d + 2 dimensions, and weighted least squares on the known distances alone go on
    from there, while a weight on the spare dimensions grows until the points lie in d. A map that is folded over in d
    dimensions has a way down through the spare ones.

    Args:
        count: n.
        pairs: known distances, shape (e, 2), connected.
        distances_m: shape (e,).
        sigmas_m: shape (e,).
        dimension: d.
    """
    points = classical_scaling(completed(count, pairs, distances_m), dimension + _SPARE)
    weights = 1.0 / sigmas_m**2
    # Weights that differ by orders of magnitude would freeze the strong ones before the weak ones have turned.
    weights = np.minimum(weights / np.median(weights), 25.0)
    for squeeze in _SQUEEZES:
        points = _relaxed(points, pairs, distances_m, weights, squeeze, dimension)
        points = _turned(points)
    return np.ascontiguousarray(points[:, :dimension])


def completed(count: int, pairs: IntArray, distances_m: FloatArray) -> FloatArray:
    """All distances, unknown ones as the shortest way along known ones, shape (n, n)."""
    # A distance of nought would be no edge.
    graph = coo_array((np.maximum(distances_m, 1e-9), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return np.asarray(shortest_path(graph.tocsr(), directed=False))


def classical_scaling(distances_m: FloatArray, dimension: int) -> FloatArray:
    """Torgerson's scaling: the leading eigenvectors of -1/2 J D^2 J, shape (n, dimension)."""
    squares = distances_m**2
    centred = squares - squares.mean(axis=0) - squares.mean(axis=1)[:, None] + squares.mean()
    values, vectors = np.linalg.eigh(-0.5 * centred)
    points = np.zeros((len(distances_m), dimension))
    kept = min(dimension, len(distances_m))
    leading = np.maximum(values[::-1][:kept], 0.0)
    points[:, :kept] = vectors[:, ::-1][:, :kept] * np.sqrt(leading)
    return points


def _turned(points: FloatArray) -> FloatArray:
    """The points along their principal axes, the widest first."""
    centred = points - points.mean(axis=0)
    return np.asarray(centred @ np.linalg.svd(centred, full_matrices=False)[2].T)


def _relaxed(
    points: FloatArray, pairs: IntArray, distances_m: FloatArray, weights: FloatArray, squeeze: float, dimension: int
) -> FloatArray:
    """Points after damped Gauss-Newton steps on sum w (d - |p_i - p_j|)^2 + squeeze |spare coordinates|^2."""
    count, wide = points.shape
    penalty = np.zeros(wide)
    penalty[dimension:] = squeeze
    frame = np.arange(wide)
    i, j = pairs[:, 0], pairs[:, 1]
    at = np.concatenate([i[:, None] * wide + frame, j[:, None] * wide + frame], axis=1)
    rows, cols = (
        np.broadcast_to(at[:, :, None], (*at.shape, 2 * wide)),
        np.broadcast_to(at[:, None, :], (*at.shape, 2 * wide)),
    )
    flat = (rows * (count * wide) + cols).ravel()
    damping = 1e-2

    def look(places: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        offsets = places[i] - places[j]
        lengths = np.sqrt(np.einsum("ij,ij->i", offsets, offsets))
        errors = distances_m - lengths
        cost = float(weights @ errors**2 + penalty @ (places**2).sum(axis=0))
        return offsets / np.maximum(lengths, 1e-9)[:, None], errors, cost

    u, errors, cost = look(points)
    for _ in range(_STEPS):
        rows_of = np.concatenate([u, -u], axis=1)
        blocks = weights[:, None, None] * rows_of[:, :, None] * rows_of[:, None, :]
        normal = np.bincount(flat, blocks.ravel(), (count * wide) ** 2).reshape(count * wide, count * wide)
        gradient = np.bincount(
            at.ravel(), (weights * errors)[:, None].repeat(2 * wide, 1).ravel() * rows_of.ravel(), count * wide
        )
        gradient -= (points * penalty).ravel()
        normal[np.diag_indices_from(normal)] += np.tile(penalty, count) + damping
        step = cho_solve(cho_factor(normal, check_finite=False), gradient, check_finite=False).reshape(count, wide)
        trial = points + step
        u_trial, errors_trial, cost_trial = look(trial)
        if cost_trial < cost:
            gain = cost - cost_trial
            points, u, errors, cost = trial, u_trial, errors_trial, cost_trial
            damping = max(0.3 * damping, 1e-6)
            if gain < 1e-9 * cost:
                break
        else:
            damping *= 5.0
            if damping > 1e6:
                break
    return points
