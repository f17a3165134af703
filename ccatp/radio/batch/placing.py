"""Pure. First places of beacons from readings taken along a known path: the best one, and how sure it is."""

from typing import NamedTuple

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.radio.batch.problem import BEARING_OFFSET

STARTS = 48
"""Directions, around the place of a range's reading, from which a beacon is sought."""
ITERATIONS = 20
FREEDOM = 4.0
"""Of Student's t by which outliers are bounded."""
MOST_READINGS = 200
"""Of one beacon; more are thinned, since first places need no more."""
APART = 0.1
"""Two minima are different places if they lie further apart than that part of the beacon's distance."""


class Placement(NamedTuple):
    """A beacon's first place.

    Attributes:
        x_m: best place.
        y_m: best place.
        margin: by how much the next best place costs more (half a chi-squared); infinite if there is none.
        spread: largest standard deviation over the distance of the nearest reading.
        cost: of the best place, per reading.
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
    for _ in range(ITERATIONS):
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
