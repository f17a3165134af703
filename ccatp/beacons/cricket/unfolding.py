"""A first map of a few dozen motes, unfolded in more dimensions; whether a map and its ranges agree."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import shortest_path
from scipy.sparse.linalg import splu

from ccatp.beacons.cricket.map_fit import MapFit
from ccatp.beacons.cricket.range_network import IndexArray
from ccatp.core import FloatArray

_SPARE = 2  # dimensions more than the map has, in which what is folded can turn over
# Weights of the spare dimensions one after the other, in units of the median weight of a distance.
_SQUEEZES = tuple(np.geomspace(1e-3, 1e3, 7).tolist())
_STEPS = 25  # of each squeeze; the last fit of all is left to others


def unfolded(
    count: int, pairs: IndexArray, distances_m: FloatArray, sigmas_m: FloatArray, dimension: int,
    rng: np.random.Generator | None = None,
) -> FloatArray:  # fmt: skip
    """Places of n points from some of their distances, shape (n, d); as ranges do, it leaves frame and mirror open.

    The missing distances are taken as the shortest way along known ones (Shang et al., MDS-MAP, 2003), classical
    scaling (Torgerson 1952) gives places in d + 2 dimensions, and weighted least squares on the known distances alone
    go on from there, while a weight on the spare dimensions grows until the points lie in d. A map that is folded over
    in d dimensions often has a way down through the spare ones.

    ``pairs`` whose distances (e,) and sigmas (e,) are known have the shape (e, 2), connected.
    """
    wide = dimension + _SPARE
    if rng is None:
        points = classical_scaling(completed(count, pairs, distances_m), wide)
    else:
        points = rng.normal(0.0, float(np.median(distances_m)), (count, wide))
    weights = 1.0 / sigmas_m**2
    # Weights that differ by orders of magnitude would freeze the strong ones before the weak ones have turned.
    weights = np.minimum(weights / np.median(weights), 25.0)
    for squeeze in _SQUEEZES:
        points = _relaxed(points, pairs, distances_m, weights, squeeze, dimension)
        centred = points - points.mean(axis=0)
        points = np.asarray(centred @ np.linalg.svd(centred, full_matrices=False)[2].T)
    return np.ascontiguousarray(points[:, :dimension])


def completed(count: int, pairs: IndexArray, distances_m: FloatArray) -> FloatArray:
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


def _relaxed(
    points: FloatArray, pairs: IndexArray, distances_m: FloatArray, weights: FloatArray, squeeze: float, dimension: int
) -> FloatArray:
    """Points after some damped Gauss-Newton steps (Levenberg 1944) down the stress.

    It is sum w (d - |p_i - p_j|)^2 + squeeze |spare coordinates|^2.
    """
    count, wide = points.shape
    size, (i, j) = count * wide, pairs.T
    penalty = np.where(np.arange(wide) < dimension, 0.0, squeeze)
    frame = np.arange(wide)
    at = np.concatenate([i[:, None] * wide + frame, j[:, None] * wide + frame], axis=1)
    indptr = np.arange(len(pairs) + 1) * 2 * wide

    def look(places: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Cost, errors of the distances (e,), and unit vectors (e, wide)."""
        ways = places[i] - places[j]
        lengths = np.sqrt(np.einsum("ij,ij->i", ways, ways))
        errors = distances_m - lengths
        cost = float(weights @ errors**2 + penalty @ (places**2).sum(axis=0))
        return cost, errors, ways / np.maximum(lengths, 1e-9)[:, None]

    cost, errors, units = look(points)
    damping = 1e-2
    for _ in range(_STEPS):
        J = csr_array((np.concatenate([units, -units], axis=1).ravel(), at.ravel(), indptr), shape=(len(pairs), size))
        heavy = diags_array(weights) @ J
        normal = (J.T @ heavy + diags_array(np.tile(penalty, count) + damping)).tocsc()
        gradient = heavy.T @ errors - (points * penalty).ravel()
        step = splu(normal, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(gradient)
        trial = points + step.reshape(count, wide)
        seen = look(trial)
        if seen[0] < cost:
            gain = cost - seen[0]
            points, (cost, errors, units), damping = trial, seen, max(0.3 * damping, 1e-6)
            if gain < 1e-9 * cost:
                break
        else:
            damping *= 5.0
            if damping > 1e6:
                break
    return points


_DENIED = 3.0  # chi-squared for each degree of freedom


@dataclass(frozen=True, slots=True)
class Agreement:
    """How the ranges fit a map."""

    outlying: tuple[int, ...]  # ranges of which the loss left less than half
    inlier_cost: float
    dof: int

    @property
    def outliers(self) -> int:
        """The number of ``outlying``."""
        return len(self.outlying)

    @property
    def factor(self) -> float:
        """Chi-squared of the ranges that are no outliers by their degree of freedom: 1 where the sigmas are right."""
        left = self.dof - self.outliers
        return self.inlier_cost / left if left > 0 else 1.0

    @property
    def is_denied(self) -> bool:
        """Whether the good ranges do not fit, or more than half of those to spare are outliers.

        As many outliers as that can agree on another map (breakdown point: Rousseeuw 1984).
        """
        return self.factor > _DENIED or 2 * self.outliers > self.dof > 0


def agreement_of(fit: MapFit, sigmas_m: FloatArray, dof: int) -> Agreement:
    """How the ranges fit a map. ``sigmas_m``: of its ranges, shape (m,)."""
    is_out = fit.weights < 0.5
    cost = float(((fit.residuals_m / sigmas_m)[~is_out] ** 2).sum())
    return Agreement(tuple(np.flatnonzero(is_out).tolist()), cost, dof)
