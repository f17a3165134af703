"""Initialisation of beacons: readings wait with copies of the poses where they were taken, until the place is known."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from math import cos, hypot, inf, isfinite, pi, sin, sqrt
from statistics import median
from typing import NamedTuple

import numpy as np

from ccatp.beacons.estimation.measurement_models import MeasurementRows, scalars_of
from ccatp.beacons.estimation.motion import POSE
from ccatp.beacons.estimation.recording import BeaconEstimate, BeaconId, Reading
from ccatp.beacons.filters.ekf_slam import BlockId, Columns, EkfSlam, columns_of
from ccatp.core import FloatArray, IntArray
from ccatp.kinematics import wrap_pi

# From kind, poses (m, 3), calibration and states of the beacon (m, b) to rows.
RowsOf = Callable[[str, FloatArray, list[float], FloatArray], MeasurementRows]
PriorAt = Callable[[float, float], BeaconEstimate]

PLACE = 2  # x_m, y_m
MOST = 24  # most readings of a beacon that are kept; above, every other one is dropped and the spacing is doubled
LEAST = 8  # readings needed before a beacon without bearings is searched: four times the unknowns of its place
SPACING = 0.01  # initial distance between kept readings, relative to the range
STARTS = 24  # directions about the vehicle in which a beacon is searched
TIGHT = 0.1  # largest standard deviation, across the line of sight, of a beacon that joins, relative to its distance
# Largest factor on TIGHT and BEND, which grow with the number of readings: odometry drifts while beacons wait.
LOOSEST = 2.5
# Largest second-order change of a waiting reading, in its sigmas, over one standard deviation of the place across its
# line of sight: from nearby, the arc on which a far beacon may lie is not Gaussian.
BEND = 1.0
DEEP = 0.3  # as TIGHT, along the line of sight, where ranges are almost linear: a shared scale may be that uncertain
APART = 0.05  # candidates closer together than this, relative to the distance, are the same
# Residuals beyond this many sigmas first get Huber's weight and finally none: ranges by reflection are too long. Each
# reading that is left out costs as much as one at the limit, so that candidates can be compared.
KNEE = 3.0
MEDIAN_TO_SIGMA = 1.4826  # standard deviation of a Gaussian over the median of its absolute value
OUT = 100.0  # a reading that is left out gets its squared residual times this as variance
PLAIN, ROBUST, ITERATIONS = 3, 7, 14  # Gauss-Newton: step where Huber's weights begin, where they end, most steps
# Smallest excess of the second candidate's chi-squared over the best one's, so that the best is no mirror image: odds
# of a thousand to one, even with two outliers.
MARGIN = 14.0 + 2.0 * KNEE**2
# Sigmas by which chi-squared may exceed its expectation; after MOST readings it may exceed more. The noise is increased
# by chi-squared over its degrees of freedom (Birge's ratio). Otherwise, with too small a noise in the settings, no
# beacon would ever join.
FIT = 6.0
LINEARISATIONS = 8  # largest number; Gauss-Newton converges within five
TRIAL = 2  # number of readings that must agree with the first one: a misread name would give any place


class JoinLimits(NamedTuple):
    """What a candidate must satisfy to be a beacon."""

    across: float  # largest standard deviation across the line of sight, relative to the distance
    along: float  # the same along it
    bend: float
    margin: float


ONCE = JoinLimits(TIGHT, DEEP, BEND, MARGIN)  # where readings are linearised once
# Where readings are linearised again, the arc may be longer, and a mirror image is found out by later readings.
AGAIN = JoinLimits(0.25, DEEP, inf, 16.0)


class ReadingRecord(NamedTuple):
    """A reading that waits."""

    reading: Reading
    place: BlockId  # block of the state: the place (x_m, y_m) where it was taken, or the pose if there is a bearing
    distance_m: float


class Candidate(NamedTuple):
    """A possible place of a beacon."""

    mean: FloatArray  # states of the beacon, shape (b,)
    covariance: FloatArray  # shape (b, b)
    cost: float  # chi-squared of the readings, with the cost of those that were left out
    variances: FloatArray  # of the readings' noise, increased for large residuals, shape (m,)
    bend: float  # largest second-order change of a reading over a sigma across its line of sight, in sigmas


class StackedRows:
    """All scalars of the waiting readings of one beacon, as functions of their poses and the calibration.

    ``walk_m2_s``: variance that the beacon's place gains in a second.
    """

    def __init__(
        self, engine: EkfSlam, records: Sequence[ReadingRecord], shared: slice, rows_of: RowsOf, walk_m2_s: float = 0.0
    ) -> None:
        self.blocks = [engine.block(record.place) for record in records]
        self.columns = columns_of(*self.blocks, shared)
        self._shared, self._rows_of = shared, rows_of
        starts = np.cumsum([0, *(block.stop - block.start for block in self.blocks)]).tolist()
        scalars = [
            (kind, z, block, start, records[-1].reading.time_s - record.reading.time_s)
            for record, block, start in zip(records, self.blocks, starts, strict=False)
            for kind, z in scalars_of(record.reading)
        ]
        self.size, self._shared_start = len(scalars), starts[-1]
        kinds = np.array([kind for kind, *_ in scalars])
        self._of_kind: dict[str, slice | IntArray] = {
            kind: np.flatnonzero(kinds == kind) for kind in set(kinds.tolist())
        }
        if len(self._of_kind) == 1:  # NumPy takes a slice far sooner than indices
            self._of_kind = dict.fromkeys(self._of_kind, slice(None))
        self._z = np.array([z for _, z, *_ in scalars])
        # Each pose or place, in the state and in the columns; the heading of a place counts as zero.
        self._places = np.array([range(block.start, block.start + PLACE) for _, _, block, *_ in scalars])
        self._place_columns = np.array([range(start, start + PLACE) for *_, start, _ in scalars])
        self._numbers = np.arange(self.size)[:, None]
        self._posed = np.flatnonzero([block.stop - block.start == POSE for _, _, block, *_ in scalars])
        # A beacon that moves was elsewhere at the earlier readings.
        self._moved_m2 = walk_m2_s * np.array([before_s for *_, before_s in scalars]) if walk_m2_s > 0.0 else None

    def at(self, x: FloatArray, beacon: list[float]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """At a state x (n,): derivatives by ``columns`` (m, k) and by the beacon (m, b), z - h (m,), variances (m,)."""
        H, G, e, R = self.at_each(x, np.array([beacon]))
        return H[0], G[0], e[0], R[0]

    def at_each(self, x: FloatArray, beacons: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The same for s states of the beacon, (s, b): shapes (s, m, k), (s, m, b), (s, m), (s, m)."""
        count, first = len(beacons), self._shared_start
        H, G = np.zeros((count, self.size, self.columns.size)), np.empty((count, self.size, beacons.shape[1]))
        e, R, by_pose = np.empty(G.shape[:2]), np.empty(G.shape[:2]), np.empty((*G.shape[:2], POSE))
        poses, calibration = self._poses(x), x[self._shared].tolist()
        for kind, at in self._of_kind.items():
            of_kind = poses[at]
            n = len(of_kind)
            states = np.repeat(beacons, n, axis=0)
            rows = self._rows_of(kind, np.tile(of_kind, (count, 1)), calibration, states)
            c = rows.calibration.shape[1]
            H[:, at, first : first + c] = rows.calibration.reshape(count, n, c)
            G[:, at], by_pose[:, at] = rows.beacon.reshape(count, n, -1), rows.pose.reshape(count, n, POSE)
            e[:, at] = self._z[at] - rows.expected.reshape(count, n)
            R[:, at] = self._variances(rows, at).reshape(count, n)
            if kind == "bearing":
                e[:, at] = [[wrap_pi(off) for off in one] for one in e[:, at].tolist()]
        H[:, self._numbers, self._place_columns] = by_pose[:, :, :PLACE]
        if self._posed.size:
            H[:, self._posed, self._place_columns[self._posed, 0] + PLACE] = by_pose[:, self._posed, PLACE]
        return H, G, e, R

    def _poses(self, x: FloatArray) -> FloatArray:
        poses = np.zeros((self.size, POSE))
        poses[:, :PLACE] = x[self._places]
        if self._posed.size:
            poses[self._posed, PLACE] = x[self._places[self._posed, 0] + PLACE]
        return poses

    def _variances(self, rows: MeasurementRows, at: slice | IntArray) -> FloatArray:
        """Variances of the readings, and of the motion of the beacon since each one."""
        if self._moved_m2 is None:
            return rows.variance
        slopes = zip(cycle(self._moved_m2[at].tolist()), rows.beacon.tolist(), strict=False)
        moved = [m2 * (gx**2 + gy**2) for m2, (gx, gy, *_) in slopes]
        return np.asarray(rows.variance + moved)


@dataclass(slots=True)
class PendingLandmark:
    """Readings of a beacon that is not on the map yet.

    The vehicle's pose at each of them is kept in the state as a clone (Mourikis and Roumeliotis 2007), so the
    correlations are right, however long the readings wait. With H the derivatives by clones and calibration, and
    S = H P H^T + R, each candidate minimises e^T S^-1 e. ``candidates``: possible places, best first, at most two.
    """

    beacon: BeaconId
    records: list[ReadingRecord] = field(default_factory=list)
    candidates: list[Candidate] = field(default_factory=list)
    spacing_m: float = 0.0
    count: int = 0

    def is_apart(self, engine: EkfSlam, record: ReadingRecord, place: Sequence[float]) -> bool:
        """Whether a place is at least the spacing away from the last reading of the same radio that was kept."""
        if not self.records:
            self.spacing_m = SPACING * record.distance_m
            return True
        radio = record.reading.radio
        last = next((one for one in reversed(self.records) if one.reading.radio == radio), None)
        if last is None:
            return True
        last_x, last_y = engine.mean[engine.block(last.place)][:2].tolist()
        return hypot(place[0] - last_x, place[1] - last_y) >= self.spacing_m

    def take(self, engine: EkfSlam, record: ReadingRecord, pose: FloatArray, columns: Columns, J: FloatArray) -> None:
        """Keep a reading with a copy of the place (2,) or pose (3,) and its derivatives by ``columns``, (2 or 3, k)."""
        self.count += 1
        engine.augment(record.place, pose, columns, J)
        self.records.append(record)

    def thin(self, engine: EkfSlam) -> None:
        """If there are more than MOST readings, drop every other one of each radio."""
        if len(self.records) > MOST:
            self.spacing_m *= 2.0
            halves, of_radio = (list[ReadingRecord](), list[ReadingRecord]()), Counter[object]()
            for record in self.records:
                halves[of_radio[record.reading.radio] % 2].append(record)
                of_radio[record.reading.radio] += 1
            engine.remove(*(record.place for record in halves[1]))
            self.records = halves[0]

    def drop(self, engine: EkfSlam) -> None:
        """Remove all readings and their clones."""
        engine.remove(*(record.place for record in self.records))
        self.records = []

    def look(self, engine: EkfSlam, rows: StackedRows, prior_at: PriorAt) -> None:
        """Search the beacon: sets ``candidates``."""
        reach_m, pointed = self.records[-1].distance_m, self.pointed(engine)
        problem = _Problem(
            engine.mean.copy(), engine.covariance[np.ix_(rows.columns, rows.columns)], rows, reach_m, pointed is None
        )
        places = [engine.mean[block].tolist() for block in rows.blocks]
        if pointed is not None:
            prior = prior_at(*pointed)
            start = self.candidates[0].mean if self.candidates else np.array([*pointed, *prior.mean[2:]])
            self.candidates = problem.refined([prior], start[None])
            return
        starts = [BeaconEstimate(c.mean, prior_at(*c.mean[:2].tolist()).covariance) for c in self.candidates]
        # The last range may be a reflection: the median is tried, too.
        for radius_m in {reach_m, median([record.distance_m for record in self.records])}:
            starts = [*problem.around(prior_at, places[-1], radius_m), *starts]
        found = problem.refined(starts)
        best = min(found, key=lambda c: c.cost, default=None)
        if best is not None:
            found += problem.refined([prior_at(*_mirrored(np.array(places), best.mean[:2]))])
        found.sort(key=lambda c: c.cost)
        apart: list[Candidate] = []
        for candidate in found:
            if all(hypot(*(candidate.mean - c.mean)[:2].tolist()) > APART * reach_m for c in apart):
                apart.append(candidate)
        self.candidates = apart[:2]

    def pointed(self, engine: EkfSlam) -> tuple[float, float] | None:
        """Place given by bearing and distance of the first reading with a bearing; None if there is no such reading."""
        for reading, place, distance_m in self.records:
            if reading.bearing_rad is not None:
                x, y, heading = engine.mean[engine.block(place)].tolist()
                way_rad = heading + reading.bearing_rad
                return x + distance_m * cos(way_rad), y + distance_m * sin(way_rad)
        return None

    def found(self, engine: EkfSlam, limits: JoinLimits = ONCE) -> Candidate | None:
        """The best candidate with the variances to use; None unless it is unique, accurate and fits the readings."""
        if not self.candidates:
            return None
        best = self.candidates[0]
        sight = best.mean[:2] - engine.mean[engine.block(self.records[-1].place)][:2]
        distance = hypot(*sight.tolist())
        along, across = sight / distance, np.array((-sight[1], sight[0])) / distance
        C = best.covariance[:2, :2]
        loose = min(max(self.count / MOST, 1.0), LOOSEST)
        if best.bend > limits.bend * loose:
            return None
        widths = (across, limits.across * loose), (along, limits.along)
        if any(way.dot(C).dot(way) > (limit * distance) ** 2 for way, limit in widths):
            return None
        m = len(self.records)
        excess = max(1.0, best.cost / (m - best.mean.size))
        if best.cost > m + FIT * sqrt(2.0 * m) and self.count <= MOST:
            return None
        if any(other.cost - best.cost < limits.margin * excess for other in self.candidates[1:]):
            return None
        return best._replace(variances=excess * best.variances)


class _Problem(NamedTuple):
    x: FloatArray
    P: FloatArray  # covariance of ``rows.columns``, shape (k, k)
    rows: StackedRows
    reach_m: float
    is_robust: bool  # outliers are left out; False if a bearing determines the place

    def around(self, prior_at: PriorAt, place: Sequence[float], radius_m: float) -> list[BeaconEstimate]:
        """Initial places: local minima of the cost on a circle about the last place, with poses and calibration fixed.

        The cost is Cauchy's, so outliers have little weight.
        """
        angles = [2.0 * pi * k / STARTS for k in range(STARTS)]
        ring = [prior_at(place[0] + radius_m * cos(angle), place[1] + radius_m * sin(angle)) for angle in angles]
        _, _, e, R = self.rows.at_each(self.x, np.array([prior.mean for prior in ring]))
        costs = [float(of_one.sum()) for of_one in np.log1p(e * e / R)]
        return [ring[k] for k in range(STARTS) if costs[k] <= min(costs[k - 1], costs[(k + 1) % STARTS])]

    def refined(self, priors: Sequence[BeaconEstimate], starts: FloatArray | None = None) -> list[Candidate]:
        """Gauss-Newton from ``starts`` (s, b), or from the means of the priors; without those that diverge.

        All steps are made side by side: each one costs little, and calling NumPy for it costs more.
        """
        means, W = np.array([prior.mean for prior in priors]), np.linalg.inv([prior.covariance for prior in priors])
        b, A = (means if starts is None else starts).copy(), W.copy()
        going, ended, stride = [*range(len(b))], dict[int, tuple[float, FloatArray]](), 0.5 * self.reach_m
        for k in range(ITERATIONS):
            H, G, e, R = self.rows.at_each(self.x, b[going])
            S = H @ self.P @ H.transpose(0, 2, 1)
            innovations, diagonals = S.diagonal(axis1=1, axis2=2) + R, S.reshape(len(S), -1)[:, :: R.shape[1] + 1]
            weighed = [_weighed(*each, k if self.is_robust else 0) for each in zip(e, innovations, R, strict=True)]
            diagonals += [variances for variances, _ in weighed]
            SG, Se = np.linalg.solve(S, G), np.linalg.solve(S, e[:, :, None])[:, :, 0]
            A[going] = G.transpose(0, 2, 1) @ SG + W[going]
            sides = [SG[i].T.dot(e[i]) + W[one].dot(means[one] - b[one]) for i, one in enumerate(going)]
            steps, still = np.linalg.solve(A[going], np.array(sides)[:, :, None])[:, :, 0], list[int]()
            for i, one in enumerate(going):
                variances, left_out = weighed[i]
                size, cost = hypot(steps[i, 0], steps[i, 1]), float(e[i].dot(Se[i])) + left_out
                if not (isfinite(cost) and isfinite(size)):
                    ended.pop(one, None)
                    continue
                ended[one] = cost, variances
                if size < 1e-3 * stride and (k > ROBUST or not self.is_robust):
                    continue
                b[one] += steps[i] * min(1.0, stride / max(size, 1e-12))
                still.append(one)
            if not (going := still):
                break
        if not ended:
            return []
        good = sorted(ended)
        C = np.linalg.inv(A[good])
        bends = self._bends(b[good], C) if self.is_robust else [0.0] * len(good)
        return [Candidate(b[one], C[i], ended[one][0], ended[one][1], bends[i]) for i, one in enumerate(good)]

    def _bends(self, b: FloatArray, C: FloatArray) -> list[float]:
        _, G, _, R = self.rows.at_each(self.x, b)
        x, y = (b[:, :2, None] - np.array([self.x[block][:2] for block in self.rows.blocks]).T).transpose(1, 0, 2)
        C = C[:, :, :, None]
        across = (C[:, 0, 0] * y * y - 2.0 * C[:, 0, 1] * x * y + C[:, 1, 1] * x * x) / (x * x + y * y)
        bends = 0.5 * np.hypot(G[:, :, 0], G[:, :, 1]) * across / (np.hypot(x, y) * np.sqrt(R))
        return [float(bend) for bend in bends.max(axis=1)]


def _mirrored(places: FloatArray, point: FloatArray) -> tuple[float, float]:
    """Mirror image of a point (2,) in the principal axis of the places (m, 2): ranges hardly distinguish the two."""
    middle = places.mean(axis=0)
    along = np.linalg.svd(places - middle)[2][0]
    x, y = middle + 2.0 * along * along.dot(point - middle) - (point - middle)
    return float(x), float(y)


def _weighed(e: FloatArray, S: FloatArray, R: FloatArray, step: int) -> tuple[FloatArray, float]:
    """Variances of the readings at a step of the iteration, (m,), and the cost of those that are left out.

    ``e``: residuals, shape (m,). ``S``: innovation variances, shape (m,). ``R``: variances of the readings, shape (m,).
    """
    if step < PLAIN:
        return R, 0.0
    sigmas = np.abs(e) / np.sqrt(S)
    if step < ROBUST:
        return R + S * np.maximum(sigmas / KNEE - 1.0, 0.0), 0.0
    # relative to the median residual, not to the configured noise: a wrong place must not leave out all that contradict
    limit = KNEE * max(1.0, MEDIAN_TO_SIGMA * median(sigmas.tolist()))
    is_out = sigmas > limit
    return R + np.where(is_out, OUT * e * e, 0.0), limit**2 * float(is_out.sum())
