"""``BeaconSlam`` on a recorded run: the estimate at each instant uses only the data received up to it."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from itertools import pairwise
from math import inf, pi, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.beacons.config.models import FixedLagConfig, PriorsConfig, RecordingConfig, SlamFilterConfig
from ccatp.beacons.estimation.batch_problem import BeaconNoise
from ccatp.beacons.estimation.beacon_map import HEADING
from ccatp.beacons.estimation.beacon_slam import BeaconInnovation, BeaconSlam, recorded_slam
from ccatp.beacons.estimation.measurement_models import ANTENNA, HEIGHT_M2
from ccatp.beacons.estimation.motion import POSE, Increment
from ccatp.beacons.estimation.odometry_noise import OdometryNoise
from ccatp.beacons.estimation.recording import (
    BeaconFix,
    BeaconId,
    BeaconTrack,
    Calibrated,
    EstimatedPath,
    Reading,
    ReadingInnovation,
    RecordedRun,
    Steps,
    first_of_each,
)
from ccatp.beacons.estimation.window import Window, excesses
from ccatp.beacons.filters.ekf_slam import columns_of
from ccatp.core import FloatArray
from ccatp.errors import counted

FAR = 3.0  # standard deviations of the prior beyond which a value is reported
BOTH_SCALES = ("distance_scale", "range_scale")
SCALES, NO_SCALE = (*BOTH_SCALES, "turn_scale"), 0.3  # larger ones are no calibration of an instrument
TOGETHER = 0.5  # of the larger scale is in the other one, too
UNCHANGED = 0.999  # share of the prior's standard deviation above which a value counts as not determined by readings


def beyond_priors(calibration: Mapping[str, Calibrated], priors: Mapping[str, float], kind: str) -> Iterator[str]:
    """A warning for each value that is more than FAR standard deviations from zero, the mean of its prior.

    If both scales have grown together, the readings do not tell the size of the map: a wider prior is no remedy.
    """
    by, longer = (calibration[name].value if name in calibration else 0.0 for name in BOTH_SCALES)
    together = by * longer > 0.0 and min(abs(by), abs(longer)) > TOGETHER * max(abs(by), abs(longer))
    far = [name for name, (value, _) in calibration.items() if abs(value) > FAR * priors.get(name, np.inf)]
    if together and {*far} & {*BOTH_SCALES}:
        yield (
            f"distance_scale and range_scale grow together, to {by:+.3g} and {longer:+.3g}: the readings do not tell "
            "them apart, and the map may have this error of its size. Do not widen their priors; narrow those in "
            f"{kind}.priors of the scale that is known better, and look for ranges that are too long"
        )
    for name, (value, _) in calibration.items():
        key = name if name in priors else HEIGHT_M2  # of one beacon
        sigma = priors[key]
        if abs(value) <= FAR * sigma or (together and name in BOTH_SCALES):
            continue
        if name in SCALES and abs(value) > NO_SCALE:
            yield (
                f"{name} comes out as {value:+.3g}, which no calibration is: look for a wrong unit, clock or sign, or "
                f"a vehicle or beacons that were moved; do not widen {kind}.priors.{key} for it"
            )
        else:
            yield (
                f"{name} comes out as {value:+.3g}, {abs(value) / sigma:.1f} standard deviations of its prior: "
                f"if that can be, widen {kind}.priors.{key} (now {sigma:g})"
            )


HEADINGS = 8  # number of hypotheses; within an eighth of a circle the filter converges
LOST_RAD = pi / HEADINGS  # standard deviation of the heading beyond which the filter is split
WORSE = 30.0  # excess of minus twice the log-likelihood that ends a hypothesis: more than two outliers cause
LONGEST = 400  # readings after which only the best hypothesis is kept
OUTLIER = 25.0  # largest NIS with which one reading counts against a hypothesis


class HeadingRelocalizer:
    """One ``BeaconSlam``, or several hypotheses with different headings.

    If the heading is unknown after a gap, the Gaussian is split into ``HEADINGS`` narrow ones; they are compared by the
    likelihoods of the readings that all of them process (Gaussian sum filter: Alspach and Sorenson 1972).
    """

    def __init__(self, slam: BeaconSlam) -> None:
        self.best, self._others = slam, list[BeaconSlam]()
        self._scores, self._taken, self._is_guessed = [0.0], 0, False

    @property
    def all(self) -> list[BeaconSlam]:
        """All hypotheses, the best one first."""
        return [self.best, *self._others]

    def predict(self, odometry: Increment) -> None:
        """Predict all hypotheses; split the filter after a gap that leaves the heading unknown."""
        for slam in self.all:
            slam.predict(odometry)
        was_guessed, self._is_guessed = self._is_guessed, odometry.guess_rad2 > 0.0
        if was_guessed and not self._is_guessed and self.best.pose_covariance[HEADING, HEADING] > LOST_RAD**2:
            self._split()

    def observe(self, readings: Sequence[Reading]) -> list[BeaconInnovation]:
        """Update all hypotheses by readings; returns the innovations of the best one before the update."""
        learned = self.best.observe(readings)
        if self._others:
            self._weigh([learned, *(slam.observe(readings) for slam in self._others)])
        return learned

    def _split(self) -> None:
        for beacon in list(self.best.waiting):  # their relation to readings after the gap is unknown
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
        """Compare the hypotheses by readings that all have processed: a beacon may not be on every map."""
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


FINEST_S = 0.1
DOUBTFUL_NIS = 1.3  # NIS per degree of freedom above which a warning is given: with learned noise it is one
DOUBTFUL_JUMPS = 0.003  # pose jumps per reading above which a warning is given
DOUBTFUL_SHARE = 0.05  # share of refused readings above which a warning is given: twice that of ranges indoors


def filter_run(
    run: RecordedRun, cfg: RecordingConfig, how: SlamFilterConfig, clock_s: Callable[[], float]
) -> EstimatedPath:
    """Run the filter over a recording; the first pose is the only part of the ground truth that is used."""
    return follow(run, cfg, how, clock_s).path


class Followed(NamedTuple):
    """A causal estimate of a run, and what it has learnt by the end of it."""

    path: EstimatedPath
    slam: BeaconSlam
    settings: RecordingConfig  # in use: priors of the calibration, noise of the odometry
    noise: BeaconNoise  # of the ranges, as estimated; the configured one by the filter alone
    odometry: OdometryNoise  # factors on the configured noise that are in the settings


def follow(
    run: RecordedRun, cfg: RecordingConfig, how: SlamFilterConfig, clock_s: Callable[[], float],
    finest_s: float = FINEST_S, lag: FixedLagConfig | None = None,
) -> Followed:  # fmt: skip
    """The path of the filter, or with ``lag`` that of the fixed-lag smoother.

    ``finest_s``: steps of odometry within an interval of this length are combined, but cut at each reading.
    """
    # Levels are too coarse to tell the place of the antenna; of several radios each would have an error of its own.
    if run.tags or not np.isfinite(run.readings.range_m).any():
        cfg = cfg.model_copy(update={"priors": cfg.priors.model_copy(update=dict.fromkeys(ANTENNA, 0.0))})
    sigmas = cfg.priors.pose_m, cfg.priors.pose_m, cfg.priors.heading_rad
    window = None if lag is None else Window(run, cfg, how, lag)
    assumed = cfg if window is None else window.settings
    raised = None if window is None else window.raised
    search = HeadingRelocalizer(recorded_slam(assumed, how, run.first_pose, np.diag(np.square(sigmas)), raised))
    if run.known_map is not None:
        search.best.know(run.known_map, _kinds(run))
    search.best.walks_m2_s = dict.fromkeys(run.moving, how.beacon_walk_m_sqrt_s**2)
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
        if now := readings[begin:end]:
            log.take(float(times[k]), search.observe(now), len(now), clock_s() - predicted_s)
        poses[k], covariances[k] = search.best.pose, search.best.pose_covariance
        if window is not None:
            window.step(float(times[k]), search.all, times[: k + 1], poses[: k + 1])
            excess = excesses(window.assumed, cfg.priors)
            poses[k], covariances[k] = search.best.pose, search.best.error_covariance(slice(POSE), excess)
        if run.moving and now:
            log.track({reading.beacon for reading in now}, search.best, float(times[k]))
    delayed = None if window is None else window.delayed(search.best, times, poses, covariances)
    used, noise, odometry = cfg, BeaconNoise.configured(len(run.beacon_ids) * len(run.radios)), OdometryNoise()
    if window is not None:
        used, noise, odometry = window.settings, window.noise, window.odometry
    path = _result(run, search.best, log, used.priors, {} if window is None else excesses(window.assumed, cfg.priors))
    beyond = beyond_priors(path.calibration, cfg.priors.model_dump(), run.kind)
    found = () if window is None else window.findings()
    path = path._replace(
        times_s=times, poses=poses, covariances=covariances, delayed=delayed,
        warnings=(*path.warnings, *beyond, *found),
    )  # fmt: skip
    return Followed(path, search.best, used, noise, odometry)


class _Log:
    """Innovations and elapsed times, s: ``predict_s`` by instant, ``update_s`` by reading, ``scalar_s`` by scalar."""

    def __init__(self) -> None:
        self.learned, self.times_s = list[BeaconInnovation](), list[float]()
        self.predict_s = list[float]()
        self.tracks = dict[str, list[tuple[float, FloatArray, FloatArray]]]()
        self.update_s, self.scalar_s = list[float](), list[float]()

    def track(self, read: set[BeaconId], slam: BeaconSlam, time_s: float) -> None:
        """Add the places of beacons that move, of those that were read."""
        if read.isdisjoint(slam.walks_m2_s):
            return
        for name, fix in slam.beacons.items():
            if name in read and name in slam.walks_m2_s:
                self.tracks.setdefault(str(name), []).append((time_s, fix.mean[:2], fix.covariance[:2, :2]))

    def take(self, time_s: float, learned: Sequence[BeaconInnovation], count: int, lasted_s: float) -> None:
        """Add the innovations of the ``count`` readings of an instant, which took ``lasted_s``."""
        self.learned += learned
        self.times_s += [time_s] * len(learned)
        self.update_s += [(self.predict_s[-1] + lasted_s) / count] * count
        if len(learned) == count:  # only updates: no reading waits, no beacon joins
            scalars = sum(one.size for one in learned)
            self.scalar_s += [lasted_s / scalars] * scalars


def _result(
    run: RecordedRun, slam: BeaconSlam, log: _Log, assumed: PriorsConfig, excess: Mapping[str, tuple[float, float]]
) -> EstimatedPath:
    """The result without the path, which is empty.

    ``assumed``: the priors of the calibration in use. ``excess``: as for ``BeaconSlam.error_covariance``.
    """
    used = [one for one in log.learned if one.accepted]
    refused = len(log.learned) - len(used)
    nis, sizes = np.array([(one.nis, float(one.size)) for one in used]).reshape(-1, 2).T
    states, priors = slam.calibration_states, assumed.model_dump()
    at = columns_of(tuple(states.values()))
    own, spread = slam.engine.covariance[at, at].tolist(), slam.error_covariance(at, excess).diagonal().tolist()
    calibration = {}
    for k, (key, state) in enumerate(states.items()):
        prior = priors.get(key, assumed.beacon_height_m2)
        if own[k] < (UNCHANGED * prior) ** 2:  # only values that the readings have determined at least in part
            calibration[key] = Calibrated(float(slam.engine.mean[state]), sqrt(spread[k]))
    beacons, none = [(name, fix) for name, fix in slam.beacons.items() if name not in slam.walks_m2_s], np.empty(0)
    for name, until_s, fix in slam.left:
        log.tracks.setdefault(str(name), []).append((until_s, fix.mean[:2], fix.covariance[:2, :2]))
    at = columns_of(*((first := slam.engine.block(name).start, first + 1) for name, _ in beacons))
    of_map = slam.error_covariance(at, excess)
    return EstimatedPath(
        none, none, none,
        beacons={
            str(b): BeaconFix(float(e.mean[0]), float(e.mean[1]), of_map[2 * k : 2 * k + 2, 2 * k : 2 * k + 2])
            for k, (b, e) in enumerate(beacons)
        },
        calibration=calibration,
        refused=refused,
        updates=nis.size,
        warnings=(*_unplaced(run, slam), *_doubts(slam, nis, sizes, refused)),
        nis=nis,
        nis_sizes=sizes,
        update_s=np.array(log.update_s),
        predict_s=np.array(log.predict_s[1:]),
        scalar_s=np.array(log.scalar_s),
        map_covariance=of_map,
        innovations=tuple(
            ReadingInnovation(
                time_s, str(one.beacon), one.nis, one.size, one.accepted, one.radio.name if one.radio else ""
            )
            for time_s, one in zip(log.times_s, log.learned, strict=True)
        ),
        tracks={
            name: BeaconTrack(*map(np.array, zip(*sorted(rows, key=lambda row: row[0]), strict=True)))
            for name, rows in log.tracks.items()
        },
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
        yield f"the pose was uncertain {slam.jumps} times: {why}"
    if refused > DOUBTFUL_SHARE * readings:
        yield f"{refused} of {readings} readings were refused: are they of this odometry, or reflections?"


def _unplaced(run: RecordedRun, slam: BeaconSlam) -> Iterator[str]:
    r = run.readings
    ranged = {run.beacon_ids[k] for k in np.unique(r.beacon[np.isfinite(r.range_m) | np.isfinite(r.rssi_dbm)])}
    lost = [name for name in run.beacon_ids if name not in slam.beacons]
    whys = {
        "only bearings were received, no range": [name for name in lost if name not in ranged],
        "the readings leave two places or none": [name for name in lost if name in ranged],
    }
    yield from (f"{counted('beacon', names)} could not be placed: {why}" for why, names in whys.items() if names)
    if slam.unplaced:
        early = f"{slam.unplaced} bearings had no range or strength of the same time"
        yield f"{early} and came before their beacon was placed"


def _kinds(run: RecordedRun) -> dict[BeaconId, str]:
    """Whether the distance of each beacon is measured by a range or a level."""
    r = run.readings
    ranged = np.unique(r.beacon[np.isfinite(r.range_m) | ~np.isfinite(r.rssi_dbm)]).tolist()
    return {name: "range" if k in ranged else "rssi" for k, name in enumerate(run.beacon_ids)}


def _spaced(times_s: FloatArray, finest_s: float) -> FloatArray:
    return np.union1d(times_s[first_of_each(times_s, finest_s)], times_s[-1:])


def _increments(steps: Steps, times_s: FloatArray) -> list[Increment]:
    def shares(amounts: FloatArray | float) -> list[float]:
        total = np.concatenate([[0.0], np.cumsum(np.broadcast_to(amounts, steps.distance_m.shape))])
        shared: list[float] = np.diff(np.interp(times_s, steps.times_s, total)).tolist()
        return shared

    amounts = map(shares, steps[1:])
    return [Increment(*row) for row in zip(times_s[1:].tolist(), np.diff(times_s).tolist(), *amounts, strict=True)]


def _readings(run: RecordedRun, camera_field_rad: float) -> Iterator[Reading]:
    r = run.readings.with_distances(camera_field_rad)
    radios = [None] * len(r.times_s) if r.tag is None else [run.tags[k] for k in r.tag.tolist()]
    columns = (r.times_s, r.beacon, r.range_m, r.bearing_rad, r.rssi_dbm)
    for time_s, beacon, range_m, bearing_rad, rssi_dbm, radio in zip(
        *(column.tolist() for column in columns), radios, strict=True
    ):
        bearing = None if math.isnan(bearing_rad) else bearing_rad
        level_dbm = rssi_dbm if math.isnan(range_m) else math.nan
        if not (bearing is None and math.isnan(range_m) and math.isnan(level_dbm)):
            yield Reading(time_s, run.beacon_ids[beacon], range_m, bearing, level_dbm, radio)
