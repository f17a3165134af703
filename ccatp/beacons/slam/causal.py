"""``BeaconSlam`` over a recorded run: what is known at each instant from readings up to it."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from itertools import pairwise
from math import inf, pi, sqrt

import numpy as np

from ccatp.beacons.slam.beacon_map import HEADING
from ccatp.beacons.slam.beacon_slam import BeaconInnovation, BeaconSlam, recorded_slam
from ccatp.beacons.slam.motion import POSE, Increment
from ccatp.beacons.slam.recording import BeaconFix, Calibrated, DelayedPath, EstimatedPath, Reading, RecordedRun, Steps
from ccatp.config.beacon_models import FixedLagConfig, RecordingConfig, SlamFilterConfig
from ccatp.core import FloatArray
from ccatp.filters.ekf_slam import columns_of

FAR = 3.0  # standard deviations of the prior beyond which a value is reported
UNCHANGED = 0.999  # of the prior's standard deviation: what is left of it without readings of it


def beyond_priors(calibration: Mapping[str, Calibrated], priors: Mapping[str, float], kind: str) -> Iterator[str]:
    """Values that their prior all but excludes, a line each: they would be further off still if it let them."""
    for name, (value, _) in calibration.items():
        sigma = priors[name]
        if abs(value) > FAR * sigma:
            yield (
                f"{name} comes out as {value:+.3g}, {abs(value) / sigma:.1f} standard deviations of its prior: "
                f"if that can be, widen {kind}.priors.{name} (now {sigma:g})"
            )


HEADINGS = 8  # followed at once; within an eighth of a circle the filter finds its way
LOST_RAD = pi / HEADINGS  # standard deviation of a heading beyond which it is looked for
WORSE = 30.0  # twice the log-likelihood by which one falls behind the best and is given up: more than two outliers make
LONGEST = 400  # readings after which the best is taken
OUTLIER = 25.0  # what a reading may count at most against one of them


class HeadingRelocalizer:
    """One ``BeaconSlam``, or several that differ by their heading.

    A Gaussian whose heading is spread over the circle is split into ``HEADINGS`` narrow ones; each reading that all of
    them take is held against each (a Gaussian sum: Alspach and Sorenson 1972).
    """

    def __init__(self, slam: BeaconSlam) -> None:
        self.best, self._others = slam, list[BeaconSlam]()
        self._scores, self._taken, self._is_guessed = [0.0], 0, False

    @property
    def all(self) -> list[BeaconSlam]:
        """All of them, the best one first."""
        return [self.best, *self._others]

    def predict(self, odometry: Increment) -> None:
        """Carry all of them on; behind a gap the heading is split."""
        for slam in self.all:
            slam.predict(odometry)
        was_guessed, self._is_guessed = self._is_guessed, odometry.guess_rad2 > 0.0
        if was_guessed and not self._is_guessed and self.best.pose_covariance[HEADING, HEADING] > LOST_RAD**2:
            self._split()

    def observe(self, readings: Sequence[Reading]) -> list[BeaconInnovation]:
        """Take readings; what they did to the best."""
        learned = self.best.observe(readings)
        if self._others:
            self._weigh([learned, *(slam.observe(readings) for slam in self._others)])
        return learned

    def _split(self) -> None:
        for beacon in list(self.best.waiting):  # its readings before the gap belong to another frame
            self.best.remove(beacon)
        if not self.best.beacons:
            return
        step_rad = 2.0 * pi / HEADINGS
        slams = [self.best, *(deepcopy(self.best) for _ in range(HEADINGS - 1))]
        self._scores = [
            slam.correct_heading(((k + HEADINGS // 2) % HEADINGS - HEADINGS // 2) * step_rad, step_rad / sqrt(12.0))
            for k, slam in enumerate(slams)
        ]
        self._others, self._taken = slams[1:], 0

    def _weigh(self, learned: Sequence[list[BeaconInnovation]]) -> None:
        """Readings that not all have taken, because a beacon is not on every map, say nothing."""
        for each in learned:
            each.sort(key=lambda one: str(one.beacon))
        if len({tuple(one.beacon for one in each) for each in learned}) > 1:
            return
        slams = self.all
        self._scores = [
            score + sum(one.surprise - max(one.nis - OUTLIER, 0.0) for one in each)
            for score, each in zip(self._scores, learned, strict=True)
        ]
        self._taken += len(learned[0])
        limit = min(self._scores) + (WORSE if self._taken < LONGEST else 0.0)
        kept = sorted((s, k) for k, s in enumerate(self._scores) if s <= limit and s < inf)
        self._scores = [score for score, _ in kept]
        self.best, *self._others = (slams[k] for _, k in kept)


class FixedLag:
    """Copies of the poses of the last seconds in the filter's state: each reading corrects them with it.

    A fixed-lag smoother by state augmentation (Moore 1973). The copies are a ring, so nothing else in the state moves.
    """

    def __init__(self, how: FixedLagConfig, slam: BeaconSlam) -> None:
        self._lag_s, self._count, self._spacing_s = how.lag_s, how.poses, how.lag_s / how.poses
        self._kept, self._times_s = list[tuple[FloatArray, FloatArray]](), list[float]()
        for k in range(how.poses):
            slam.engine.augment((KEPT, k), slam.engine.mean[:POSE].copy(), np.arange(POSE), np.eye(POSE))

    def keep(self, time_s: float, search: HeadingRelocalizer) -> None:
        """Keep the pose of now where it is due, in place of the oldest one, which is what is known of it then."""
        if self._times_s and time_s < self._times_s[-1] + self._spacing_s:
            return
        if len(self._times_s) >= self._count:
            self._hand_over(search.best)
        for slam in search.all:
            slam.engine.copy_states((KEPT, len(self._times_s) % self._count), 0)
        self._times_s.append(time_s)

    def path(self, slam: BeaconSlam) -> DelayedPath:
        """All of it, at the end."""
        while len(self._kept) < len(self._times_s):
            self._hand_over(slam)
        poses, covariances = zip(*self._kept, strict=True)
        return DelayedPath(self._lag_s, *map(np.array, (self._times_s, poses, covariances)))

    def _hand_over(self, slam: BeaconSlam) -> None:
        at = slam.engine.block((KEPT, len(self._kept) % self._count))
        self._kept.append((slam.engine.mean[at].copy(), slam.engine.covariance[at, at].copy()))


KEPT = "kept"  # first part of the name of a block that holds the copy of a pose
FINEST_S = 0.1
# Mean square of normalised innovations, per degree of freedom, that is reported: of learned noise it is one.
DOUBTFUL_NIS = 1.3
DOUBTFUL_JUMPS = 0.003  # how often the pose has to be doubted, for each reading, that it is reported
DOUBTFUL_SHARE = 0.05  # share of refused readings that is reported: twice that of ranges indoors


def filter_run(
    run: RecordedRun, cfg: RecordingConfig, how: SlamFilterConfig, clock_s: Callable[[], float]
) -> EstimatedPath:
    """Run the filter over a recording; of the truth the first pose alone is used."""
    return follow(run, cfg, how, clock_s)[0]


def follow(
    run: RecordedRun, cfg: RecordingConfig, how: SlamFilterConfig, clock_s: Callable[[], float],
    finest_s: float = FINEST_S, lag: FixedLagConfig | None = None,
) -> tuple[EstimatedPath, BeaconSlam]:  # fmt: skip
    """The path by the filter, and the filter as it is at the end.

    ``finest_s``: steps of odometry shorter than that are put together.
    """
    sigmas = cfg.priors.pose_m, cfg.priors.pose_m, cfg.priors.heading_rad
    search = HeadingRelocalizer(recorded_slam(cfg, how, run.first_pose, np.diag(np.square(sigmas))))
    window = None if lag is None else FixedLag(lag, search.best)
    times = np.union1d(_spaced(run.steps.times_s, finest_s), run.readings.times_s)
    increments, readings = _increments(run.steps, times), list(_readings(run, cfg.radio.camera_field_rad))
    ends = np.searchsorted([reading.time_s for reading in readings], times, side="right").tolist()
    poses, covariances = np.empty((len(times), 3)), np.empty((len(times), 3, 3))
    log = _Log()
    for k, (begin, end) in enumerate(pairwise((0, *ends))):
        begin_s = clock_s()
        if k:
            search.predict(increments[k - 1])
        predicted_s = clock_s()
        log.predict_s.append(predicted_s - begin_s)
        if window is not None:
            window.keep(float(times[k]), search)
        if now := readings[begin:end]:
            log.take(search.observe(now), len(now), clock_s() - predicted_s)
        poses[k], covariances[k] = search.best.pose, search.best.pose_covariance
    delayed = None if window is None else window.path(search.best)
    path = _result(run, search.best, log)
    return path._replace(times_s=times, poses=poses, covariances=covariances, delayed=delayed), search.best


class _Log:
    """What the readings did, and how long it took: ``predict_s`` of each instant, the others of each reading, s."""

    def __init__(self) -> None:
        self.learned, self.predict_s = list[BeaconInnovation](), list[float]()
        self.update_s, self.scalar_s = list[float](), list[float]()

    def take(self, learned: Sequence[BeaconInnovation], count: int, lasted_s: float) -> None:
        """Take what ``count`` readings of the instant did."""
        self.learned += learned
        self.update_s += [(self.predict_s[-1] + lasted_s) / count] * count
        if len(learned) == count:  # nothing that waits or joins: updates alone
            scalars = sum(one.size for one in learned)
            self.scalar_s += [lasted_s / scalars] * scalars


def _result(run: RecordedRun, slam: BeaconSlam, log: _Log) -> EstimatedPath:
    """All but the path, which is empty."""
    used = [one for one in log.learned if one.accepted]
    refused = len(log.learned) - len(used)
    nis, sizes = np.array([(one.nis, float(one.size)) for one in used]).reshape(-1, 2).T
    priors = dict(zip(slam.calibration, slam.prior_sigmas, strict=True))
    # Those that the readings have determined in part; a prior is no result.
    calibration = {
        name: Calibrated(*found) for name, found in slam.calibration.items() if found[1] < UNCHANGED * priors[name]
    }
    beacons, none = slam.beacons.items(), np.empty(0)
    at = columns_of(*((first := slam.engine.block(name).start, first + 1) for name, _ in beacons))
    return EstimatedPath(
        none, none, none,
        beacons={str(b): BeaconFix(float(e.mean[0]), float(e.mean[1]), e.covariance[:2, :2]) for b, e in beacons},
        calibration=calibration,
        refused=refused,
        updates=nis.size,
        warnings=(
            *_unplaced(run, slam), *beyond_priors(calibration, priors, run.kind), *_doubts(slam, nis, sizes, refused)
        ),
        nis=nis,
        nis_sizes=sizes,
        update_s=np.array(log.update_s),
        predict_s=np.array(log.predict_s[1:]),
        scalar_s=np.array(log.scalar_s),
        map_covariance=slam.engine.covariance[np.ix_(at, at)],
    )  # fmt: skip


def _doubts(slam: BeaconSlam, nis: FloatArray, sizes: FloatArray, refused: int) -> Iterator[str]:
    for beacon in dict.fromkeys(beacon for beacon, _ in slam.moved):
        times = ", ".join(f"{time_s:.1f}" for name, time_s in slam.moved if name == beacon)
        yield f"beacon {beacon} was placed again at {times} s: was it moved, or exchanged for another?"
    if nis.size and nis.sum() > DOUBTFUL_NIS * sizes.sum():
        yield (
            f"innovations are {float(nis.sum() / sizes.sum()):.2f} times as large, in squares, as they should be: "
            "clocks apart, scales beyond what the configuration allows, or beacons exchanged on the way?"
        )
    readings = nis.size + refused
    if slam.jumps > DOUBTFUL_JUMPS * readings:
        why = "pushed, beacons misread, or odometry that misses something?"
        yield f"the pose had to be doubted {slam.jumps} times: {why}"
    if refused > DOUBTFUL_SHARE * readings:
        yield f"{refused} of {readings} readings were refused: do they belong to this odometry?"


def _unplaced(run: RecordedRun, slam: BeaconSlam) -> Iterator[str]:
    r = run.readings
    ranged = {run.beacon_ids[k] for k in np.unique(r.beacon[np.isfinite(r.range_m) | np.isfinite(r.rssi_dbm)])}
    whys = ("only bearings of it were received, no range", "its readings leave two places or none")
    for name in run.beacon_ids:
        if name not in slam.beacons:
            yield f"beacon {name} could not be placed: {whys[name in ranged]}"
    if slam.unplaced:
        early = f"{slam.unplaced} bearings had no range or strength of the same time"
        yield f"{early} and came before their beacon was placed"


def _spaced(times_s: FloatArray, finest_s: float) -> FloatArray:
    _, first = np.unique(np.floor((times_s - times_s[0]) / finest_s), return_index=True)
    return np.union1d(times_s[first], times_s[-1:])


def _increments(steps: Steps, times_s: FloatArray) -> list[Increment]:
    def shares(amounts: FloatArray | float) -> list[float]:
        total = np.concatenate([[0.0], np.cumsum(np.broadcast_to(amounts, steps.distance_m.shape))])
        shared: list[float] = np.diff(np.interp(times_s, steps.times_s, total)).tolist()
        return shared

    amounts = map(shares, steps[1:])
    return [Increment(*row) for row in zip(times_s[1:].tolist(), np.diff(times_s).tolist(), *amounts, strict=True)]


def _readings(run: RecordedRun, camera_field_rad: float) -> Iterator[Reading]:
    r = run.readings.with_distances(camera_field_rad)
    for time_s, beacon, range_m, bearing_rad, rssi_dbm in zip(*(column.tolist() for column in r), strict=True):
        bearing = None if math.isnan(bearing_rad) else bearing_rad
        level_dbm = rssi_dbm if math.isnan(range_m) else math.nan
        if not (bearing is None and math.isnan(range_m) and math.isnan(level_dbm)):
            yield Reading(time_s, run.beacon_ids[beacon], range_m, bearing, level_dbm)
