"""Beacons that are heard and are not on the map yet: how they get there.

Beacons whose direction nobody hears: readings wait, with where they were taken, until they say where.

A beacon that has just joined, conditioned on what was heard of it, at the places where that was heard.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import cos, hypot, inf, isfinite, log1p, pi, sin, sqrt
from statistics import median
from typing import NamedTuple

import numpy as np

from ccatp.beacons.slam.beacon_map import BeaconMap, NoiseLevel
from ccatp.beacons.slam.measurement_models import MeasurementModels, MeasurementRow, bearing_of, kind_of, strength_of
from ccatp.beacons.slam.motion import POSE, CarriedOdometry, DeadReckoning
from ccatp.beacons.slam.recording import BeaconId, Reading
from ccatp.core import FloatArray, wrap_pi
from ccatp.filters.ekf_slam import BlockId, Columns, EkfSlam, Update, columns_of

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


class ReadingRecord(NamedTuple):
    """A reading that waits.

    Attributes:
        place: block of the state that holds the place (x_m, y_m) where it was taken.
    """

    reading: Reading
    place: BlockId
    distance_m: float


class Candidate(NamedTuple):
    """A place where a beacon may be.

    Attributes:
        mean: states of the beacon, shape (b,).
        covariance: shape (b, b).
        variances: of the readings' noise, larger where they look too far off, shape (m,).
    """

    mean: FloatArray
    covariance: FloatArray
    cost: float
    variances: FloatArray


class LandmarkPrior(NamedTuple):
    """What is known of a beacon before its readings: all but nothing of its place.

    Attributes:
        mean: x_m, y_m and what else is estimated of it, shape (b,).
        covariance: shape (b, b).
    """

    mean: FloatArray
    covariance: FloatArray


class PoseClone(NamedTuple):
    """The vehicle's place as a function of the state.

    Attributes:
        mean: x_m, y_m, shape (2,).
        columns: of the state that it depends on, shape (k,).
        jacobian: shape (2, k).
    """

    mean: FloatArray
    columns: Columns
    jacobian: FloatArray


PriorAt = Callable[[float, float], LandmarkPrior]


@dataclass(slots=True)
class PendingLandmark:
    """Readings of a beacon that is not on the map yet.

    The vehicle's place at each of them is kept in the state as a clone (Mourikis and Roumeliotis 2007), so that what
    they say of the beacon comes with the right correlations, however long they wait. With H the derivatives by clones
    and calibration, S = H P H^T + R, each candidate minimises e^T S^-1 e.

    Attributes:
        candidates: where it may be, best first; two as long as a mirror image is possible.
    """

    beacon: BeaconId
    records: list[ReadingRecord] = field(default_factory=list)
    candidates: list[Candidate] = field(default_factory=list)
    spacing_m: float = 0.0
    count: int = 0

    @property
    def is_ready(self) -> bool:
        """Whether there are enough readings to look for it."""
        return len(self.records) >= LEAST

    def take(self, engine: EkfSlam, reading: Reading, place: PoseClone, range_m: float) -> bool:
        """Keep a reading, if the vehicle has moved since the last one that was kept."""
        x, y = place.mean.tolist()
        if not self.records:
            self.spacing_m = SPACING * range_m
        else:
            last_x, last_y = engine.mean[engine.block(self.records[-1].place)].tolist()
            if hypot(x - last_x, y - last_y) < self.spacing_m:
                return False
        block = ("place", self.beacon, self.count)
        self.count += 1
        engine.augment(block, place.mean, place.columns, place.jacobian)
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
        """Look for the beacon: sets ``candidates``.

        Args:
            row_of: what a reading should be (the row without bearing).
            reach_m: how far it is from the last place, roughly.
        """
        problem = _problem(engine, self.records, row_of, shared, reach_m)
        starts: list[LandmarkPrior] = []
        for radius_m in {reach_m, self._usual_m(reach_m)}:
            starts += problem.around(prior_at, radius_m)
        starts += [LandmarkPrior(c.mean, prior_at(*c.mean[:2].tolist()).covariance) for c in self.candidates]
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

    def _usual_m(self, reach_m: float) -> float:
        return median([record.distance_m for record in self.records]) if self.records else reach_m

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

    def around(self, prior_at: PriorAt, radius_m: float) -> list[LandmarkPrior]:
        """Where to begin: the best directions on a circle about the last place."""
        x, y = self.places[-1]
        angles = [2.0 * pi * k / STARTS for k in range(STARTS)]
        ring = [prior_at(x + radius_m * cos(angle), y + radius_m * sin(angle)) for angle in angles]
        costs = [self.rough(prior) for prior in ring]
        return [ring[k] for k in range(STARTS) if costs[k] <= min(costs[k - 1], costs[(k + 1) % STARTS])]

    def mirrored(self, point: FloatArray) -> tuple[float, float]:
        """The image of a point (2,) on the other side of the way, which ranges tell apart last."""
        places = np.array(self.places)
        middle = places.mean(axis=0)
        along = np.linalg.svd(places - middle)[2][0]
        x, y = middle + 2.0 * along * along.dot(point - middle) - (point - middle)
        return float(x), float(y)

    def rough(self, prior: LandmarkPrior) -> float:
        """How badly a guess fits, places and calibration as they are; a reading that is off counts little (Cauchy)."""
        b = prior.mean.tolist()
        cost = 0.0
        for reading, z, place in zip(self.readings, self.z.tolist(), self.places, strict=True):
            row = self.row_of(reading, [*place, 0.0], self.calibration, b)
            cost += log1p((z - row.expected) ** 2 / row.variance)
        return cost

    def refine(self, prior: LandmarkPrior) -> Candidate | None:
        b, W, stride = prior.mean.copy(), np.linalg.inv(prior.covariance), 0.5 * self.reach_m
        variances, A, cost = self.z, W, inf
        for k in range(ITERATIONS):
            H, G, e, R = self._linear(b)
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

    def _linear(self, b: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        m, c = self.z.size, len(self.calibration)
        H, G, e, R = np.zeros((m, 2 * m + c)), np.zeros((m, b.size)), np.zeros(m), np.zeros(m)
        values = b.tolist()
        for i, (reading, place) in enumerate(zip(self.readings, self.places, strict=True)):
            row = self.row_of(reading, [*place, 0.0], self.calibration, values)
            H[i, 2 * i : 2 * i + 2] = row.pose[:2]
            H[i, 2 * m : 2 * m + len(row.calibration)] = row.calibration
            G[i], R[i], e[i] = row.beacon, row.variance, self.z[i] - row.expected
        return H, G, e, R


def _weighed(e: FloatArray, S: FloatArray, R: FloatArray, step: int) -> tuple[FloatArray, float]:
    """Variances of the readings at a step of the iteration, and what those that are left out cost.

    Args:
        e: residuals, shape (m,).
        S: their variances by all that is unknown, shape (m,).
        R: those of the readings, shape (m,).
        step: how many went before.
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


def _problem(engine: EkfSlam, records: list[ReadingRecord], row_of: RowOf, shared: slice, reach_m: float) -> _Problem:
    readings = [record.reading for record in records]
    z = np.array([strength_of(r) for r in readings])
    blocks = [engine.block(record.place) for record in records]
    columns = columns_of(*blocks, shared)
    P = engine.covariance[np.ix_(columns, columns)]
    places = [engine.mean[block].tolist() for block in blocks]
    return _Problem(readings, z, places, engine.mean[shared].tolist(), P, row_of, reach_m)


LINEARISATIONS = 8  # at most; Gauss-Newton on readings that a beacon joined by comes to rest within five


def settle_by_places(
    engine: EkfSlam, records: list[ReadingRecord], row_of: RowOf, shared: slice, block: slice, variances: FloatArray
) -> Update:
    """Condition a beacon, the places where it was heard, the calibration and all else on the readings, iterated.

    Args:
        engine: holds the places, and the beacon with an all but flat prior at its candidate.
        variances: of the readings, shape (m,).
    """
    places = [engine.block(record.place) for record in records]
    columns = columns_of(*places, shared, block)
    z = [strength_of(record.reading) for record in records]
    m, c = len(z), shared.stop - shared.start

    def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        residual, H = np.zeros(m), np.zeros((m, columns.size))
        calibration, beacon = x[shared].tolist(), x[block].tolist()
        for i, (record, place) in enumerate(zip(records, places, strict=True)):
            row = row_of(record.reading, [*x[place].tolist(), 0.0], calibration, beacon)
            residual[i] = z[i] - row.expected
            H[i, 2 * i : 2 * i + 2] = row.pose[:2]
            H[i, 2 * m : 2 * m + len(row.calibration)] = row.calibration
            H[i, 2 * m + c :] = row.beacon
        return residual, H

    return engine.update_iterated(columns, linearise, variances, LINEARISATIONS)


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


def wrapped(z: float, expected: float, *, is_angle: bool) -> float:
    """Residual z - h(x), the short way round for angles."""
    return wrap_pi(z - expected) if is_angle else z - expected


def pose_columns(shared: slice, block: slice) -> Columns:
    """Columns of pose, calibration and a beacon."""
    return columns_of(slice(0, POSE), shared, block)


# Standard deviation of a beacon's place before its readings, relative to its distance: they alone place it.
FLAT = 100.0
TRIAL = 2  # readings that must agree with the one that a beacon joined by: a misread name would put it anywhere


class LandmarkInitializer:
    """With a bearing a beacon joins at once, where range and bearing say; without one its readings wait.

    One that joined at once is on trial: if one of its next ``TRIAL`` readings is refused, it begins anew with that one.

    Args:
        delay: column of the odometry's delay; -1: none.

    Attributes:
        waiting: beacons that were heard, with what was, and the candidates for their places.
    """

    def __init__(
        self,
        engine: EkfSlam,
        sensors: MeasurementModels,
        beacons: BeaconMap,
        clock: DeadReckoning,
        levels: dict[str, NoiseLevel],
        shared: slice,
        delay: int,
    ) -> None:
        self._engine, self._sensors, self._map, self._clock = engine, sensors, beacons, clock
        self._levels, self._shared, self._delay = levels, shared, delay
        self._ranges = len(sensors.names)
        self.waiting: dict[BeaconId, PendingLandmark] = {}

    def forget(self, beacon: BeaconId) -> bool:
        """Forget what waits of a beacon; False if nothing does."""
        waiting = self.waiting.pop(beacon, None)
        if waiting is None:
            return False
        waiting.drop(self._engine)
        self._map.renumber()
        return True

    def carried(self, x: FloatArray, reading: Reading) -> CarriedOdometry:
        """The pose of a state x (n,) at a reading's time."""
        delay_s = float(x[self._delay]) if self._delay >= 0 else 0.0
        return self._clock.at(x[:POSE].tolist(), reading.time_s, delay_s)

    def meet(self, reading: Reading) -> None:
        """A reading of a beacon that is not on the map."""
        bearing = bearing_of(reading)
        reach_m = self._sensors.distance_m(reading)
        if bearing is not None:
            pose = self.carried(self._engine.mean, reading).pose
            way = pose[2] + bearing
            entry = self._map.join(
                reading.beacon,
                *self._prior(reading, reach_m, pose[0] + reach_m * cos(way), pose[1] + reach_m * sin(way)),
            )
            entry.on_trial = TRIAL
            self._settle(reading)
            return
        waiting = self.waiting.setdefault(reading.beacon, PendingLandmark(reading.beacon))
        is_kept = waiting.take(self._engine, reading, self._clone(reading), reach_m)
        if is_kept and waiting.is_ready:
            waiting.look(
                self._engine, self._row_of, self._shared, lambda x, y: self._prior(reading, reach_m, x, y), reach_m
            )
            self._join_waiting(reading, waiting, reach_m)
        self._map.renumber()

    def _join_waiting(self, reading: Reading, waiting: PendingLandmark, reach_m: float) -> None:
        found = waiting.found(self._engine)
        if found is None:
            return
        prior = self._prior(reading, reach_m, *found.mean[:2].tolist())
        prior.mean[:2] = found.mean[:2]
        self._map.join(reading.beacon, *prior)
        block = self._engine.block(reading.beacon)
        settle_by_places(self._engine, waiting.records, self._row_of, self._shared, block, found.variances)
        waiting.drop(self._engine)
        del self.waiting[reading.beacon]

    def _settle(self, reading: Reading) -> None:
        block = self._engine.block(reading.beacon)
        columns = pose_columns(self._shared, block)

        def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            at = self.carried(x, reading)
            beacon = x[block].tolist()
            rows = (
                self._row_of(reading, at.pose, x[self._shared].tolist(), beacon),
                self._sensors.bearing(at.pose, beacon),
            )
            z = (strength_of(reading), bearing_of(reading) or 0.0)
            residual = [wrapped(z[k], rows[k].expected, is_angle=k == 1) for k in range(2)]
            H = [[*derivatives(row, at, delayed=self._delay >= 0), *row.beacon] for row in rows]
            return np.array(residual), np.array(H)

        pose = self.carried(self._engine.mean, reading).pose
        x = self._engine.mean
        row = self._row_of(reading, pose, x[self._shared].tolist(), x[block].tolist())
        bearing = self._sensors.bearing(pose, x[block].tolist())
        R = np.array((row.variance, bearing.variance * self._levels["bearing"].factor))
        self._engine.update_iterated(columns, linearise, R, LINEARISATIONS)

    def _row_of(
        self, reading: Reading, pose: list[float], calibration: list[float], beacon: list[float]
    ) -> MeasurementRow:
        row = self._sensors.row(reading, pose, calibration[: self._ranges], beacon)
        level = self._levels[kind_of(reading)]
        return row._replace(variance=row.variance * level.factor)

    def _prior(self, reading: Reading, reach_m: float, x_m: float, y_m: float) -> LandmarkPrior:
        extra = self._sensors.extra_prior(reading)
        sigmas = (FLAT * reach_m, FLAT * reach_m, *(sigma for _, sigma in extra))
        return LandmarkPrior(np.array((x_m, y_m, *(mean for mean, _ in extra))), np.diag(np.square(sigmas)))

    def _clone(self, reading: Reading) -> PoseClone:
        at = self.carried(self._engine.mean, reading)
        (x_heading, y_heading), by = at.by_heading(), at.by_delay()
        columns, J = [0, 1, 2], [[1.0, 0.0, x_heading], [0.0, 1.0, y_heading]]
        if self._delay >= 0:
            columns.append(self._delay)
            J[0].append(by[0])
            J[1].append(by[1])
        return PoseClone(np.array(at.pose[:2]), columns_of(columns), np.array(J))
