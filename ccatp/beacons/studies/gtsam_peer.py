"""GTSAM on the same raw input as our own estimators: iSAM2 during the run, Levenberg-Marquardt at its end.

Needs the extra ``peers`` (gtsam), imported only on request. Its stock factors have no calibration, so ranges and
odometry are used as recorded. The noise is the same as ours, with Huber's loss for the readings. Beacons without
bearings start at a place found by trilateration on GTSAM's own path. Each beacon has a prior: that of a known map, or
one so wide that it only keeps the equations regular while few readings have weight.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ccatp.beacons.config.models import RecordingConfig
from ccatp.beacons.cricket.trilateration import trilaterate
from ccatp.beacons.estimation.measurement_models import range_variance
from ccatp.beacons.estimation.reckoning import CALIBRATION, Reckoning
from ccatp.beacons.estimation.recording import BeaconFix, EstimatedPath, RecordedRun
from ccatp.core import FloatArray
from ccatp.errors import CcatpError, ExitStatus

HUBER = 2.0
"""Residual, in sigmas, from which the robust loss is linear. Under a loss that ignores large residuals some beacons
would have no reading left, and GTSAM would stop."""
LEAST_READINGS = 8
SURE_MARGIN = 8.0
SURE_SPREAD = 0.15
WIDE = 10.0  # standard deviation of a beacon's prior, relative to its distance
UNKNOWN = np.full((2, 2), np.nan)  # covariances of the peers are not computed


class PeerError(CcatpError):
    """The peer is not installed."""

    exit_status = ExitStatus.USAGE


class PeerGaveUp(CcatpError):
    """The peer has no result for a run."""

    exit_status = ExitStatus.USAGE


Progress = Callable[[int], Callable[[int], None]]  # from the number of instants: what is called with those done


def run_gtsam(
    run: RecordedRun, settings: RecordingConfig, clock_s: Callable[[], float], limit_s: float,
    progress: Progress = lambda _: lambda _: None,
) -> Iterator[EstimatedPath]:  # fmt: skip
    """The estimates of a run: of iSAM2, then of the batch, which begins with it. ``limit_s``: longest time of each, s.

    For iSAM2 each pose is from the readings up to it, and the map is that at the end. Raises PeerError: gtsam is not
    installed. Raises PeerGaveUp: its optimisation failed, a reading has no range, or the time is over.
    """
    gtsam = import_gtsam()
    if not np.isfinite(run.readings.range_m).all():
        raise PeerGaveUp(f"{run.name}: not all readings have a range, and GTSAM has no factor of signal strengths")
    if run.moving:
        raise PeerGaveUp(f"{run.name}: GTSAM has no stock factor of a beacon that moves")
    if run.tags and np.isfinite(run.readings.bearing_rad).any():
        raise PeerGaveUp(f"{run.name}: GTSAM has no factor of a bearing by one of several tags")
    try:
        yield from _Session(gtsam, run, settings).solve(clock_s, limit_s, progress)
    except RuntimeError as error:
        raise PeerGaveUp(f"{run.name}: GTSAM gave up: {' '.join(str(error).split())[:120]}") from error


def import_gtsam() -> Any:
    """The module gtsam, which belongs to an extra. Raises PeerError: it is not installed."""
    try:
        import gtsam  # noqa: PLC0415
    except ImportError as error:
        raise PeerError("--peers needs GTSAM: install ccatp with its extra, ccatp[peers]") from error
    return gtsam


STARTS = 48  # directions around the nearest reading in which a beacon is searched
OUTLYING = 2.0  # sigmas beyond which a reading weighs less than half
MOST_READINGS = 200  # used of one beacon; more are thinned
APART = 0.1  # minima further apart than this share of the largest range are different places


class Placement(NamedTuple):
    """Initial place of a beacon."""

    x_m: float
    y_m: float
    margin: float  # excess cost of the second best place (half a chi-squared); infinite if there is none
    spread: float  # largest standard deviation, relative to the distance of the nearest reading


def place_by_distances(poses: FloatArray, distance_m: FloatArray, variance: FloatArray) -> Placement:
    """Best minimum of the robust cost of distances, searched from all directions around the nearest reading.

    On a straight path two mirror images have the same cost: see ``margin``. ``poses``: of the readings, shape (m, 3).
    ``distance_m``: to one beacon, shape (m,). ``variance``: of the distances, m^2, shape (m,).
    """
    thin = max(1, -(-len(distance_m) // MOST_READINGS))
    anchors, distance, sigmas = poses[::thin, :2], distance_m[::thin], np.sqrt(variance[::thin])
    nearest = int(np.argmin(distance))
    angle = 2.0 * np.pi * np.arange(STARTS) / STARTS
    starts = anchors[nearest] + distance[nearest] * np.column_stack([np.cos(angle), np.sin(angle)])
    found, costs = trilaterate(starts, anchors, distance, sigmas, OUTLYING)
    best = int(np.argmin(costs))
    others = np.hypot(*(found - found[best]).T) > APART * float(distance.max())
    margin = 0.5 * float(costs[others].min() - costs[best]) if others.any() else np.inf
    ways = found[best] - anchors
    off = np.hypot(*ways.T)
    J = ways / (np.maximum(off, 1e-3) * sigmas * np.sqrt(1.0 + ((off - distance) / (OUTLYING * sigmas)) ** 2))[:, None]
    least = max(float(np.linalg.eigvalsh(J.T @ J)[0]), 1e-12)
    return Placement(
        float(found[best, 0]), float(found[best, 1]), margin, 1.0 / np.sqrt(least) / float(distance[nearest])
    )


class _Session:
    def __init__(self, gtsam: Any, run: RecordedRun, settings: RecordingConfig) -> None:
        self._gtsam, self._run, self._settings = gtsam, run, settings
        self._x, self._l = partial(gtsam.symbol, "x"), partial(gtsam.symbol, "l")
        self._times = np.union1d(run.readings.times_s, run.steps.times_s[:1])
        reckoning = Reckoning(run.steps, self._times, delayed=False)
        self._motion, _, self._covariances = reckoning.increments(np.zeros(len(CALIBRATION)), settings.odometry)
        self._at = np.searchsorted(self._times, run.readings.times_s)
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._placed: set[int] = set()
        self._waiting: dict[int, list[int]] = {}
        self._path = np.empty((len(self._times), 3))

    def solve(self, clock_s: Callable[[], float], limit_s: float, progress: Progress) -> Iterator[EstimatedPath]:
        gtsam, run = self._gtsam, self._run
        show, started_s = progress(len(self._times)), clock_s()
        isam = gtsam.ISAM2(gtsam.ISAM2Params())
        rows_at = np.split(np.arange(len(self._at)), np.searchsorted(self._at, np.arange(1, len(self._times))))
        took = []
        pose = gtsam.Pose2(*run.first_pose)
        p = self._settings.priors
        prior = gtsam.noiseModel.Diagonal.Sigmas(np.array((p.pose_m, p.pose_m, p.heading_rad)))
        for k in range(len(self._times)):
            begin_s = clock_s()
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            if k == 0:
                graph.add(gtsam.PriorFactorPose2(self._x(0), pose, prior))
                self._know(graph, values)
            else:
                step = gtsam.Pose2(*self._motion[k - 1])
                noise = gtsam.noiseModel.Gaussian.Covariance(self._covariances[k - 1])
                graph.add(gtsam.BetweenFactorPose2(self._x(k - 1), self._x(k), step, noise))
                pose = pose.compose(step)
            values.insert(self._x(k), pose)
            self._path[k] = pose.x(), pose.y(), pose.theta()
            for row in rows_at[k].tolist():
                self._read(row, graph, values)
            self._graph.push_back(graph)
            self._values.insert(values)
            isam.update(graph, values)
            pose = isam.calculateEstimatePose2(self._x(k))
            self._path[k] = pose.x(), pose.y(), pose.theta()
            took += [(clock_s() - begin_s) / max(len(rows_at[k]), 1)] * len(rows_at[k])
            show(k + 1)
            if clock_s() - started_s > limit_s:
                raise PeerGaveUp(
                    f"{run.name}: GTSAM was stopped after {limit_s:g} s, at {(k + 1) / len(self._times):.0%} of the "
                    "run: run.peer_limit_s allows more"
                )
        final = isam.calculateEstimate()
        yield self._track(self._path, final, np.array(took))
        begin_s = clock_s()
        how = self._stopped_at(limit_s, clock_s)
        best = gtsam.LevenbergMarquardtOptimizer(self._graph, final, how).optimize()
        # time of the optimisation only: iSAM2 gives its initial values
        spent = clock_s() - begin_s
        poses = np.array([(q.x(), q.y(), q.theta()) for q in map(best.atPose2, map(self._x, range(len(self._times))))])
        share = np.array([spent / max(len(self._at), 1)])
        yield self._track(poses, best, share)

    def _stopped_at(self, limit_s: float, clock_s: Callable[[], float]) -> Any:
        """Parameters of the batch that end it after a step beyond the limit."""
        begin_s, how = clock_s(), self._gtsam.LevenbergMarquardtParams()

        def look(steps: int, _before: float, _after: float) -> None:
            if clock_s() - begin_s > limit_s:
                raise PeerGaveUp(
                    f"{self._run.name}: GTSAM's batch was stopped after {limit_s:g} s and {steps} steps: "
                    "run.peer_limit_s allows more"
                )

        how.iterationHook = look
        return how

    def _know(self, graph: Any, values: Any) -> None:
        """Beacons of a known map, each with its own covariance."""
        if (known := self._run.known_map) is None:
            return
        for k, name in enumerate(known.names):
            beacon, at = self._run.beacon_ids.index(name), slice(2 * k, 2 * k + 2)
            noise = self._gtsam.noiseModel.Gaussian.Covariance(known.covariance_m2[at, at])
            self._insert(beacon, known.places_m[k], noise, graph, values)

    def _insert(self, beacon: int, place: FloatArray, noise: Any, graph: Any, values: Any) -> None:
        self._placed.add(beacon)
        values.insert(self._l(beacon), place)
        graph.add(self._gtsam.PriorFactorPoint2(self._l(beacon), place, noise))

    def _read(self, row: int, graph: Any, values: Any) -> None:
        """Add a factor for a reading if its beacon has a place; otherwise the reading waits until it has."""
        r = self._run.readings
        beacon = int(r.beacon[row])
        if beacon not in self._placed:
            waiting = self._waiting.setdefault(beacon, [])
            waiting.append(row)
            place = self._place(row, waiting)
            if place is None:
                return
            noise = self._gtsam.noiseModel.Isotropic.Sigma(2, WIDE * max(float(r.range_m[row]), 1.0))
            self._insert(beacon, np.array(place), noise, graph, values)
            for earlier in self._waiting.pop(beacon):
                graph.add(self._factor(earlier))
            return
        graph.add(self._factor(row))

    def _place(self, row: int, waiting: list[int]) -> tuple[float, float] | None:
        r = self._run.readings
        poses = self._path[self._at[waiting]].copy()
        poses[:, :2] = r.where(np.array(waiting)).radios_at(poses)
        if np.isfinite(r.bearing_rad[row]):
            x, y, heading = poses[-1]
            way = heading + r.bearing_rad[row]
            return float(x + r.range_m[row] * np.cos(way)), float(y + r.range_m[row] * np.sin(way))
        if len(waiting) < LEAST_READINGS:
            return None
        found = place_by_distances(poses, r.range_m[waiting], range_variance(self._settings.radio, r.range_m[waiting]))
        last = row >= len(r.times_s) - len(self._run.beacon_ids)
        if last or (found.margin > SURE_MARGIN and found.spread < SURE_SPREAD):
            return found.x_m, found.y_m
        return None

    def _factor(self, row: int) -> Any:
        gtsam, r = self._gtsam, self._run.readings
        keys = self._x(int(self._at[row])), self._l(int(r.beacon[row]))
        sigma = float(np.sqrt(range_variance(self._settings.radio, r.range_m[row])))
        if np.isfinite(r.bearing_rad[row]):
            sigmas = np.array((self._settings.radio.bearing_sigma_rad, sigma))
            noise = self._robust(gtsam.noiseModel.Diagonal.Sigmas(sigmas))
            return gtsam.BearingRangeFactor2D(*keys, gtsam.Rot2(r.bearing_rad[row]), r.range_m[row], noise)
        noise = self._robust(gtsam.noiseModel.Isotropic.Sigma(1, sigma))
        if r.arm_m is not None:
            return gtsam.RangeFactorWithTransform2D(*keys, r.range_m[row], noise, gtsam.Pose2(*r.arm_m[row], 0.0))
        return gtsam.RangeFactor2D(*keys, r.range_m[row], noise)

    def _robust(self, noise: Any) -> Any:
        model = self._gtsam.noiseModel
        return model.Robust.Create(model.mEstimator.Huber.Create(HUBER), noise)

    def _track(self, path: FloatArray, values: Any, update_s: FloatArray) -> EstimatedPath:
        beacons = {}
        for beacon in sorted(self._placed):
            x, y = values.atPoint2(self._l(beacon)).tolist()
            beacons[self._run.beacon_ids[beacon]] = BeaconFix(x, y, UNKNOWN)
        return EstimatedPath(
            times_s=self._times,
            poses=np.column_stack([path[:, :2], np.unwrap(path[:, 2])]),
            covariances=np.broadcast_to(np.eye(3), (len(path), 3, 3)),
            beacons=beacons,
            calibration={},
            refused=0,
            update_s=update_s,
            updates=len(self._at),
            warnings=(),
        )
