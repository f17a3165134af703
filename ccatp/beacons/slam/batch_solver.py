"""Levenberg-Marquardt over a batch problem whose noise follows Student's t: reweighted least squares.

First places of beacons from readings taken along a known path: the best one, and how sure it is.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError

from ccatp.beacons.slam.batch_problem import BEARING_OFFSET, ArrowSystem, BatchProblem, BatchState, Factored, Residuals
from ccatp.core import FloatArray

LEAST_DAMPING = 1e-9
MOST_DAMPING = 1e9
CONVERGED = 1e-5  # relative gain below which a cost has converged


class Descent(NamedTuple):
    """Where a descent ended.

    Attributes:
        cost: there, negative log posterior up to a constant.
    """

    state: BatchState
    cost: float
    iterations: int
    converged: bool


def t_weights(chi2: FloatArray, sizes: FloatArray, freedom: float, softness: FloatArray | float = 1.0) -> FloatArray:
    """Weight of each reading: (nu + p) / (nu + chi2 / softness), the M-estimator of Student's t with p components.

    A softness above one forgives large residuals: it is how a start far off is not mistaken for outliers.
    """
    weights: FloatArray = (freedom + sizes) / (freedom + chi2 / softness)
    return weights


def t_cost(chi2: FloatArray, sizes: FloatArray, freedom: float, softness: FloatArray | float = 1.0) -> float:
    """Negative log likelihood of Student's t without its constants, with the weights above as its gradient's."""
    return float((0.5 * (freedom + sizes) * softness * np.log1p(chi2 / (freedom * softness))).sum())


def descend(
    problem: BatchProblem,
    state: BatchState,
    most: int,
    softness: FloatArray | float = 1.0,
    odometry_freedom: float = np.inf,
    enough: float = CONVERGED,
) -> Descent:
    """Minimise the negative log posterior.

    Args:
        softness: of each reading's law, shape (m,) or one for all.
        enough: relative gain below which the cost counts as converged.
    """
    damping = 1e-6

    def tried_cost(tried: BatchState) -> float:
        return _cost(problem, tried, problem.residuals(tried), softness, odometry_freedom)

    residuals, cost = problem.residuals(state), tried_cost(state)
    for iteration in range(1, most + 1):
        weights = t_weights(residuals.chi2, problem.sizes, problem.radio.freedom, softness)
        system = problem.normal_equations(state, weights, _odometry_weights(residuals, odometry_freedom))
        while (tried := _step(problem, state, system, damping)) is None or tried_cost(tried) > cost:
            damping = max(damping, LEAST_DAMPING) * 10.0
            if damping > MOST_DAMPING:
                return Descent(state, cost, iteration, True)
        gain, state = cost - tried_cost(tried), tried
        residuals, cost = problem.residuals(state), cost - gain
        damping = max(damping * 0.1, LEAST_DAMPING)
        if gain <= enough * max(abs(cost), 1.0):
            return Descent(state, cost, iteration, True)
    return Descent(state, cost, most, False)


def _step(problem: BatchProblem, state: BatchState, system: ArrowSystem, damping: float) -> BatchState | None:
    try:
        poses, shared = Factored(system, damping).solution()
    except LinAlgError:
        return None
    return state.moved(poses, problem.spread(shared))


def _odometry_chi2(residuals: Residuals) -> FloatArray:
    chi2: FloatArray = np.einsum("ki,kij,kj->k", residuals.odometry, residuals.odometry_information, residuals.odometry)
    return chi2


def _odometry_weights(residuals: Residuals, freedom: float) -> FloatArray:
    chi2 = _odometry_chi2(residuals)
    if np.isinf(freedom):
        return np.ones_like(chi2)
    return t_weights(chi2, np.full(chi2.size, 3.0), freedom)


def _cost(
    problem: BatchProblem,
    state: BatchState,
    residuals: Residuals,
    softness: FloatArray | float,
    odometry_freedom: float,
) -> float:
    chi2 = _odometry_chi2(residuals)
    odometry = (
        0.5 * float(chi2.sum())
        if np.isinf(odometry_freedom)
        else t_cost(chi2, np.full(chi2.size, 3.0), odometry_freedom)
    )
    readings = t_cost(residuals.chi2, problem.sizes, problem.radio.freedom, softness)
    return problem.prior_cost(state) + odometry + readings


STARTS = 48  # directions, around the place of a range's reading, from which a beacon is sought
PLACING_ITERATIONS = 20
FREEDOM = 4.0  # of Student's t by which outliers are bounded
MOST_READINGS = 200  # of one beacon; more are thinned, since first places need no more
APART = 0.1  # two minima are different places if they lie further apart than that part of the beacon's distance


class Placement(NamedTuple):
    """A beacon's first place.

    Attributes:
        margin: by how much the next best place costs more (half a chi-squared); infinite if there is none.
        spread: largest standard deviation over the distance of the nearest reading.
    """

    x_m: float
    y_m: float
    margin: float
    spread: float
    cost: float


def place_by_bearings(
    poses: FloatArray, distance_m: FloatArray, bearing_rad: FloatArray, shared: FloatArray
) -> tuple[float, float]:
    """Median of the places that distances with bearings point at.

    Args:
        poses: of the readings, shape (m, 3).
        distance_m: to one beacon, shape (m,).
        bearing_rad: of the same readings, shape (m,).
        shared: calibration by ``problem.SHARED``.
    """
    way = poses[:, 2] + bearing_rad - shared[BEARING_OFFSET]
    x, y = poses[:, 0] + distance_m * np.cos(way), poses[:, 1] + distance_m * np.sin(way)
    return float(np.median(x)), float(np.median(y))


def place_by_distances(poses: FloatArray, distance_m: FloatArray, variance: FloatArray) -> Placement:
    """Best of the minima of the robust cost of distances, sought from all around the nearest reading.

    A straight path leaves two mirror images that cost the same; ``margin`` tells.

    Args:
        poses: of the readings, shape (m, 3).
        distance_m: to one beacon, shape (m,).
        variance: of the distances, m^2, shape (m,).
    """
    thin = max(1, -(-len(distance_m) // MOST_READINGS))
    x, y, distance, information = poses[::thin, 0], poses[::thin, 1], distance_m[::thin], 1.0 / variance[::thin]
    nearest = int(np.argmin(distance))
    angle = 2.0 * np.pi * np.arange(STARTS) / STARTS
    bx = x[nearest] + distance[nearest] * np.cos(angle)
    by = y[nearest] + distance[nearest] * np.sin(angle)
    reach = float(distance.max())
    xx = yy = xy = np.ones(STARTS)
    for _ in range(PLACING_ITERATIONS):
        dx, dy = bx[:, None] - x, by[:, None] - y
        r = np.maximum(np.hypot(dx, dy), 1e-3)
        e, ux, uy = r - distance, dx / r, dy / r
        w = information * (FREEDOM + 1.0) / (FREEDOM + e * e * information)
        xx, yy, xy = (w * ux * ux).sum(1), (w * uy * uy).sum(1), (w * ux * uy).sum(1)
        little = 1e-3 * (xx + yy)  # a straight path that points at the beacon says nothing across
        xx, yy = xx + little, yy + little
        gx, gy = (w * ux * e).sum(1), (w * uy * e).sum(1)
        determinant = xx * yy - xy * xy
        sx, sy = (yy * gx - xy * gy) / determinant, (xx * gy - xy * gx) / determinant
        size = np.hypot(sx, sy)
        short = np.minimum(1.0, 0.3 * reach / np.maximum(size, 1e-12))
        bx, by = bx - short * sx, by - short * sy
    e = np.hypot(bx[:, None] - x, by[:, None] - y) - distance
    cost = (0.5 * (FREEDOM + 1.0) * np.log1p(e * e * information / FREEDOM)).sum(1)
    best = int(np.argmin(cost))
    others = np.hypot(bx - bx[best], by - by[best]) > APART * reach
    margin = float(cost[others].min() - cost[best]) if others.any() else np.inf
    half_trace, d = 0.5 * (xx[best] + yy[best]), xx[best] * yy[best] - xy[best] ** 2
    least = half_trace - np.sqrt(max(half_trace**2 - d, 0.0))
    spread = float(1.0 / np.sqrt(max(least, 1e-12)) / distance[nearest])
    return Placement(float(bx[best]), float(by[best]), margin, spread, float(cost[best] / len(distance)))
