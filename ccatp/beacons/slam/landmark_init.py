"""Readings of a beacon without a bearing wait until they suffice to place it; derivatives at a reading's time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import cos, hypot, inf, isfinite, log1p, pi, sin, sqrt
from statistics import median
from typing import NamedTuple

import numpy as np

from ccatp.beacons.slam.measurement_models import MeasurementRow, strength_of
from ccatp.beacons.slam.motion import CarriedOdometry
from ccatp.beacons.slam.recording import BeaconEstimate, BeaconId, Reading
from ccatp.core import FloatArray
from ccatp.filters.ekf_slam import BlockId, Columns, EkfSlam, columns_of

RowOf = Callable[[Reading, list[float], list[float], list[float]], MeasurementRow]

MOST = 24  # readings of a beacon that are kept; beyond, every other one goes, and they are taken twice as far apart
LEAST = 8  # readings without which a beacon is not looked for: what its place needs, four times over
SPACING = 0.01  # way between readings that are kept, at first, relative to the range
STARTS = 24  # directions about the vehicle in which a beacon is looked for
TIGHT = 0.1  # largest standard deviation, across the line of sight, of a beacon that joins, relative to its distance
# How many times that is borne at last, in proportion to the readings: the vehicle strays while beacons wait.
LOOSEST = 2.5
DEEP = 0.3  # the same along it, where ranges are all but linear: a scale that all share may be that uncertain
APART = 0.05  # places nearer to each other than that, relative to the distance, are one
# Residuals beyond that many sigmas first weigh no more than those at it (Huber), at last nothing: readings round a
# corner are too long. Each then costs what one at the knee does, so that places can be compared.
KNEE = 3.0
MEDIAN_TO_SIGMA = 1.4826  # standard deviation of a Gaussian over the median of its absolute value
OUT = 100.0  # what a residual squared is taken times for the variance of a reading that is left out
PLAIN, ROBUST, ITERATIONS = 3, 7, 14  # steps of Gauss-Newton without weights, until those of Huber end, and at most
# How much worse the second best place must be, chi-squared, so that the best is no mirror image: odds of a thousand
# to one, though two readings were off.
MARGIN = 14.0 + 2.0 * KNEE**2
# Sigmas by which chi-squared may exceed its expectation; if it stays beyond, the noise is taken for that much larger
# (Birge's ratio): with less noise in the settings than there is, no beacon would ever join.
FIT = 6.0
LINEARISATIONS = 8  # at most; Gauss-Newton on readings that a beacon joined by comes to rest within five
FLAT = 100.0  # standard deviation of a beacon's place before its readings, relative to its distance
TRIAL = 2  # readings that must agree with the one that a beacon joined by: a misread name would put it anywhere


class ReadingRecord(NamedTuple):
    """A reading that waits."""

    reading: Reading
    place: BlockId  # block of the state that holds the place (x_m, y_m) where it was taken
    distance_m: float


class Candidate(NamedTuple):
    """A place where a beacon may be."""

    mean: FloatArray  # states of the beacon, shape (b,)
    covariance: FloatArray  # shape (b, b)
    cost: float
    variances: FloatArray  # of the readings' noise, larger where they look too far off, shape (m,)


PriorAt = Callable[[float, float], BeaconEstimate]


@dataclass(slots=True)
class PendingLandmark:
    """Readings of a beacon that is not on the map yet.

    The vehicle's place at each of them is kept in the state as a clone (Mourikis and Roumeliotis 2007), so that what
    they say of the beacon comes with the right correlations, however long they wait. With H the derivatives by clones
    and calibration, S = H P H^T + R, each candidate minimises e^T S^-1 e. ``candidates``: where it may be, best first;
    two as long as a mirror image is possible.
    """

    beacon: BeaconId
    records: list[ReadingRecord] = field(default_factory=list)
    candidates: list[Candidate] = field(default_factory=list)
    spacing_m: float = 0.0
    count: int = 0

    def take(
        self, engine: EkfSlam, reading: Reading, place: FloatArray, by: tuple[Columns, FloatArray], range_m: float
    ) -> bool:
        """Keep a reading, if the vehicle has moved since the last one that was kept.

        ``place``: x_m, y_m of the vehicle then, shape (2,). ``by``: columns (k,) of the state that it depends on, and
        its derivatives, shape (2, k).
        """
        x, y = place.tolist()
        if not self.records:
            self.spacing_m = SPACING * range_m
        else:
            last_x, last_y = engine.mean[engine.block(self.records[-1].place)].tolist()
            if hypot(x - last_x, y - last_y) < self.spacing_m:
                return False
        block = ("place", self.beacon, self.count)
        self.count += 1
        engine.augment(block, place, *by)
        self.records.append(ReadingRecord(reading, block, range_m))
        if len(self.records) > MOST:
            self.spacing_m *= 2.0
            for record in self.records[1::2]:
                engine.remove(record.place)
            self.records = self.records[::2]
        return True

    def drop(self, engine: EkfSlam) -> None:
        """Forget the readings."""
        for record in self.records:
            engine.remove(record.place)
        self.records = []

    def look(self, engine: EkfSlam, row_of: RowOf, shared: slice, prior_at: PriorAt, reach_m: float) -> None:
        """Look for the beacon: sets ``candidates``."""
        readings = [record.reading for record in self.records]
        z = np.array([strength_of(reading) for reading in readings])
        blocks = [engine.block(record.place) for record in self.records]
        columns = columns_of(*blocks, shared)
        P = engine.covariance[np.ix_(columns, columns)]
        places = [engine.mean[block].tolist() for block in blocks]
        problem = _Problem(readings, z, places, engine.mean[shared].tolist(), P, row_of, reach_m)
        starts: list[BeaconEstimate] = []
        # The last distance may have gone round a corner: the usual one is tried, too.
        for radius_m in {reach_m, median([record.distance_m for record in self.records])}:
            starts += problem.around(prior_at, radius_m)
        starts += [BeaconEstimate(c.mean, prior_at(*c.mean[:2].tolist()).covariance) for c in self.candidates]
        found = [candidate for candidate in map(problem.refine, starts) if candidate is not None]
        best = min(found, key=lambda c: c.cost, default=None)
        if best is not None:
            mirrored = problem.refine(prior_at(*problem.mirrored(best.mean[:2])))
            found += [] if mirrored is None else [mirrored]
        found.sort(key=lambda c: c.cost)
        apart: list[Candidate] = []
        for candidate in found:
            if all(hypot(*(candidate.mean - c.mean)[:2].tolist()) > APART * reach_m for c in apart):
                apart.append(candidate)
        self.candidates = apart[:2]

    def found(self, engine: EkfSlam) -> Candidate | None:
        """The beacon's place, if there is only one, well enough known to be linearised at, and the readings agree."""
        if not self.candidates:
            return None
        best = self.candidates[0]
        x, y = engine.mean[engine.block(self.records[-1].place)].tolist()
        sight = best.mean[:2] - (x, y)
        distance = hypot(*sight.tolist())
        along, across = sight / distance, np.array((-sight[1], sight[0])) / distance
        C = best.covariance[:2, :2]
        tight = TIGHT * min(max(self.count / MOST, 1.0), LOOSEST)
        if across.dot(C).dot(across) > (tight * distance) ** 2 or along.dot(C).dot(along) > (DEEP * distance) ** 2:
            return None
        m = len(self.records)
        excess = max(1.0, best.cost / (m - best.mean.size))
        if best.cost > m + FIT * sqrt(2.0 * m) and self.count <= MOST:
            return None
        if any(other.cost - best.cost < MARGIN * excess for other in self.candidates[1:]):
            return None
        return best._replace(variances=excess * best.variances)


class _Problem(NamedTuple):
    readings: list[Reading]
    z: FloatArray
    places: list[list[float]]
    calibration: list[float]
    P: FloatArray
    row_of: RowOf
    reach_m: float

    def around(self, prior_at: PriorAt, radius_m: float) -> list[BeaconEstimate]:
        """Where to begin: the best directions on a circle about the last place."""
        x, y = self.places[-1]
        angles = [2.0 * pi * k / STARTS for k in range(STARTS)]
        ring = [prior_at(x + radius_m * cos(angle), y + radius_m * sin(angle)) for angle in angles]
        costs = [self.rough(prior) for prior in ring]
        return [ring[k] for k in range(STARTS) if costs[k] <= min(costs[k - 1], costs[(k + 1) % STARTS])]

    def mirrored(self, point: FloatArray) -> tuple[float, float]:
        """The image of a point (2,) on the other side of the way, which ranges distinguish last."""
        places = np.array(self.places)
        middle = places.mean(axis=0)
        along = np.linalg.svd(places - middle)[2][0]
        x, y = middle + 2.0 * along * along.dot(point - middle) - (point - middle)
        return float(x), float(y)

    def rough(self, prior: BeaconEstimate) -> float:
        """How badly a guess fits, places and calibration as they are; a reading that is off counts little (Cauchy)."""
        b = prior.mean.tolist()
        cost = 0.0
        for reading, z, place in zip(self.readings, self.z.tolist(), self.places, strict=True):
            row = self.row_of(reading, [*place, 0.0], self.calibration, b)
            cost += log1p((z - row.expected) ** 2 / row.variance)
        return cost

    def refine(self, prior: BeaconEstimate) -> Candidate | None:
        b, W, stride = prior.mean.copy(), np.linalg.inv(prior.covariance), 0.5 * self.reach_m
        variances, A, cost = self.z, W, inf
        for k in range(ITERATIONS):
            H, G, e, R = stacked_rows(
                self.readings, self.z.tolist(), self.places, self.calibration, b.tolist(), self.row_of
            )
            spread = H.dot(self.P).dot(H.T)
            variances, left_out = _weighed(e, spread.diagonal() + R, R, k)
            S = spread + np.diag(variances)
            SG = np.linalg.solve(S, G)
            A = G.T.dot(SG) + W
            step = np.linalg.solve(A, SG.T.dot(e) + W.dot(prior.mean - b))
            size = hypot(step[0], step[1])
            cost = float(e.dot(np.linalg.solve(S, e))) + left_out
            if not (isfinite(cost) and isfinite(size)):
                return None
            if size < 1e-3 * stride and k > ROBUST:
                break
            b = b + step * min(1.0, stride / max(size, 1e-12))
        return Candidate(b, np.linalg.inv(A), cost, variances)


def stacked_rows(
    readings: Sequence[Reading], z: Sequence[float], places: Sequence[list[float]], calibration: list[float],
    beacon: list[float], row_of: RowOf,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Derivatives by places and calibration (m, 2 m + c) and by the beacon (m, b), residuals and variances (m,)."""
    m, c = len(z), len(calibration)
    H, G, e, R = np.zeros((m, 2 * m + c)), np.zeros((m, len(beacon))), np.zeros(m), np.zeros(m)
    for i, (reading, place) in enumerate(zip(readings, places, strict=True)):
        row = row_of(reading, [*place, 0.0], calibration, beacon)
        H[i, 2 * i : 2 * i + 2] = row.pose[:2]
        H[i, 2 * m : 2 * m + len(row.calibration)] = row.calibration
        G[i], R[i], e[i] = row.beacon, row.variance, z[i] - row.expected
    return H, G, e, R


def _weighed(e: FloatArray, S: FloatArray, R: FloatArray, step: int) -> tuple[FloatArray, float]:
    """Variances of the readings at a step of the iteration, and what those that are left out cost.

    ``e``: residuals, shape (m,). ``S``: their variances by all that is unknown, shape (m,). ``R``: those of the
    readings, shape (m,).
    """
    if step < PLAIN:
        return R, 0.0
    sigmas = np.abs(e) / np.sqrt(S)
    if step < ROBUST:
        return R + S * np.maximum(sigmas / KNEE - 1.0, 0.0), 0.0
    # by the usual residual, not by the noise that was promised: or a bad place could leave out what speaks against it
    limit = KNEE * max(1.0, MEDIAN_TO_SIGMA * float(np.median(sigmas)))
    is_out = sigmas > limit
    return R + np.where(is_out, OUT * e * e, 0.0), limit**2 * float(is_out.sum())


def derivatives(row: MeasurementRow, at: CarriedOdometry, *, delayed: bool) -> list[float]:
    """Dh by the pose and the calibration of the state: a row at the pose that was carried to a reading's time."""
    hx, hy, turned = row.pose
    if not delayed and at.back_s == 0.0:
        return [hx, hy, turned, *row.calibration]
    vx, vy, turn = at.velocity
    by_heading = at.back_s * (hx * vy - hy * vx)
    found = [hx, hy, turned + by_heading, *row.calibration]
    if delayed:  # the heading turns at ``turn``, too
        found.append(-hx * vx - hy * vy - turn * (turned + by_heading))
    return found
