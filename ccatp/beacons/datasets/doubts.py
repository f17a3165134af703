"""Warnings about an estimate: a survey or a known map that it contradicts, readings that are off all at once."""

from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.stats import binom, chi2

from ccatp.beacons.cricket.map_fit import map_rms_m
from ccatp.beacons.datasets.checks import STRANGER_M
from ccatp.beacons.datasets.mounting import robust_fit
from ccatp.beacons.datasets.tables import instant
from ccatp.beacons.estimation.predictions import place_by_ranges
from ccatp.beacons.estimation.range_noise import correlations
from ccatp.beacons.estimation.recording import EstimatedPath, KnownMap, RecordedRun
from ccatp.beacons.estimation.track_review import range_residuals
from ccatp.beacons.rigid_motion import aligned_rms_m
from ccatp.core import FloatArray
from ccatp.errors import listed

LEAST_BEACONS = 3  # of which most are as they should be
MISSED = 5.0  # times the expected difference of map and survey, above which one of them is wrong
MENDED = 0.3  # a changed position explains the difference if at most this share of it remains


def survey_doubts(track: EstimatedPath, surveyed_m: Mapping[str, tuple[float, float]]) -> list[str]:
    """A warning of two exchanged beacons or one moved beacon in the survey, if the map fits far better without.

    Otherwise a warning if map and survey differ by more than the covariance of the map explains. For runs without a
    reference trajectory, which have no other check. Map and survey may be in different frames.
    """
    names = [name for name in track.beacons if name in surveyed_m]
    if len(names) < 4:  # three positions fit any three others too well
        return []
    found = np.array([track.beacons[name][:2] for name in names])
    surveyed = np.array([surveyed_m[name] for name in names])
    miss_m = aligned_rms_m(found, surveyed)
    if miss_m < STRANGER_M:
        return []
    fits_m: dict[str, float] = {}
    every = np.arange(len(names))
    for a, b in combinations(range(len(names)), 2):
        order = every.copy()
        order[[a, b]] = b, a
        line = f"beacons {names[a]} and {names[b]} look exchanged in the survey"
        fits_m[line] = aligned_rms_m(found, surveyed[order])
    for k, name in enumerate(names):
        line = f"beacon {name} was moved, or surveyed wrongly"
        fits_m[line] = aligned_rms_m(found[every != k], surveyed[every != k])
    mirrored = "the map is the mirror image of the survey (turns of the odometry, or its y, have the other sign)"
    fits_m[mirrored] = aligned_rms_m(found, surveyed * (1.0, -1.0))
    line, fit_m = min(fits_m.items(), key=lambda item: item[1])
    if fit_m > MENDED * miss_m:
        rows, places = [list(track.beacons).index(name) for name in names], list(track.beacons.values())
        of_all = np.array([place[:2] for place in places])
        expected_m = map_rms_m(track.map_covariance, of_all, rows, aligned=True)
        wrong = (
            f"the map misses the survey by {miss_m:.2g} m, where {expected_m:.2g} m are expected: one of them is wrong"
        )
        return [wrong] if miss_m > MISSED * expected_m else []
    return [f"{line}: the map misses the survey by {miss_m:.2g} m, else by {fit_m:.2g} m"]


SEEN = 0.1  # share of the variance of a known place that the readings take away, from which they have seen it
DOUBTED = 0.99  # chi-squared of known places, above which they are doubted


def map_doubts(track: EstimatedPath, known_map: KnownMap) -> list[str]:
    """A warning if the readings move the known places by more than the covariance of the map allows.

    A correct map moves by d with the covariance P0 - P1, before and after the readings. Directions of which the
    readings say little are left out.
    """
    names = [name for name in known_map.names if name in track.beacons]
    if not names or not track.map_covariance.size:
        return []
    every = list(track.beacons)
    at = [2 * every.index(name) + axis for name in names for axis in range(2)]
    before, after = known_map.of(names), track.map_covariance[np.ix_(at, at)]
    moved_m = np.array([track.beacons[name][:2] for name in names]) - before.places_m
    root = np.linalg.inv(np.linalg.cholesky(before.covariance_m2))
    share, turn = np.linalg.eigh(np.eye(len(at)) - root @ after @ root.T)
    d = turn.T @ root @ moved_m.ravel()
    seen = share > SEEN
    squares, count = float(np.sum(d[seen] ** 2 / share[seen])), int(seen.sum())
    if not count or chi2.cdf(squares, count) < DOUBTED:
        return []
    ratio = float(np.sqrt(squares / count))
    usual_m = float(np.sqrt(np.mean(before.covariance_m2.diagonal())))
    return [
        f"the readings move the known places {ratio:.2g} times as far as their standard deviations of {usual_m:.2g} m "
        f"allow, so those of the path are too small as well: about {ratio * usual_m:.2g} m would fit"
    ]


FEWEST = 20  # readings of a beacon
CERTAIN = 5.0  # standard deviations of a known place and of the fit, beyond which another place is named
LEAST_OFF_M = 0.05
AS_FAR = 0.5  # of the place that is furthest off: a wrong one bends the path, and with it what fits the others


def known_place_doubts(run: RecordedRun, track: EstimatedPath, camera_field_rad: float) -> Iterator[str]:
    """A warning for each known place that its own ranges contradict, and one if the survey of the recording does.

    The residual of a range is that of a place which is off by d: e = d u, with u from the radio to the beacon. So
    e(u) gives d by a robust fit; errors that last for several readings count as fewer.
    """
    if run.known_map is None:
        return
    known, residuals_m = run.known_map, range_residuals(run, track, camera_field_rad)
    r = run.readings
    at = r.radios_at(track.poses_at(r.times_s))
    off_m: dict[str, tuple[float, float, FloatArray]] = {}
    for k, name in enumerate(known.names):
        rows = (r.beacon == run.beacon_ids.index(name)) & np.isfinite(residuals_m)
        if name not in track.beacons or rows.sum() < FEWEST:
            continue
        place = np.array(track.beacons[name][:2])
        way = place - at[rows]
        u = way / np.maximum(np.hypot(*way.T), 1e-3)[:, None]
        d, _, sigmas = robust_fit(u, residuals_m[rows])
        left_m = residuals_m[rows] - u @ d
        likeness = float(np.clip(correlations(left_m)[1], 0.0, 0.99)) if left_m.any() else 0.0
        lasting = (1.0 + likeness) / (1.0 - likeness)
        variance = float(np.trace(known.covariance_m2[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]))
        fits = place + d
        far_m = float(np.hypot(*(fits - known.places_m[k])))
        if far_m > max(CERTAIN * np.sqrt(variance + lasting * float(sigmas @ sigmas)), LEAST_OFF_M):
            off_m[name] = far_m, float(np.sqrt(0.5 * variance)), fits
    furthest_m = max((far_m for far_m, *_ in off_m.values()), default=0.0)
    for name, (far_m, sigma_m, fits) in off_m.items():
        if far_m >= AS_FAR * furthest_m:
            yield (
                f"ranges of beacon {name} fit the place ({fits[0]:.2f}, {fits[1]:.2f}), {far_m:.2g} m from the known "
                f"one, whose standard deviation is {sigma_m:.2g} m: is the map wrong there, or are they reflections?"
            )


def map_against_survey(known: KnownMap, surveyed_m: Mapping[str, tuple[float, float]]) -> list[str]:
    """A warning if the places of a known map are not those of the survey of the recording."""
    differ_m = {}
    for k, name in enumerate(known.names):
        sigma_m = float(np.sqrt(np.trace(known.covariance_m2[2 * k : 2 * k + 2, 2 * k : 2 * k + 2])))
        far_m = float(np.hypot(*(known.places_m[k] - surveyed_m.get(name, known.places_m[k]))))
        if far_m > max(CERTAIN * sigma_m, LEAST_OFF_M):
            differ_m[name] = far_m
    if not differ_m:
        return []
    which = listed([f"{name} by {far_m:.2g} m" for name, far_m in differ_m.items()])
    return [f"the known map and the survey of the recording differ: {which}"]


STRAY = 5.0  # times the usual miss of the beacons
PARTS = 8  # of the readings of a beacon, between which it may have been moved
MOVED_M = 0.5  # distance of two places of a beacon that was moved, at least,
HALVED = 0.4  # and the share of its misses at the other place that its own one leaves, predicted, at most
OUTLYING = 3.0  # medians, or ``MOVED_M``, at which misses are cut off


def stray_beacons(run: RecordedRun, track: EstimatedPath) -> list[str]:
    """A warning for each beacon that was moved, and for those whose ranges miss their place far more than others'.

    Of one that was placed again on the way another warning says that it was moved.
    """
    misses_m, moved = {}, []
    for k, name in enumerate(run.beacon_ids):
        seen = run.readings.where((run.readings.beacon == k) & np.isfinite(run.readings.range_m))
        if name in track.beacons and len(seen.times_s) >= FEWEST:
            at = seen.radios_at(track.poses_at(seen.times_s))
            off_m = seen.range_m - np.hypot(*(np.array(track.beacons[name][:2]) - at).T)
            misses_m[name] = float(np.median(np.abs(off_m - np.median(off_m))))
            calibrated_m = track.calibrated(seen, run.beacon_ids).range_m
            if name not in track.tracks and (
                line := _moved_once(name, seen.times_s, calibrated_m, at, np.array(track.beacons[name][:2]))
            ):
                moved.append((name, line))
    if len(misses_m) < LEAST_BEACONS:
        return []
    if 2 * len(moved) > len(misses_m):  # the path has a bend that is none, not the beacons
        moved = []
    for name, _ in moved:
        del misses_m[name]
    usual_m = float(np.median(list(misses_m.values())))
    return [line for _, line in moved] + [
        f"ranges of beacon {name} miss its place by {miss_m:.2g} m (half of them), those of the others by "
        f"{usual_m:.2g} m: does it move?"
        for name, miss_m in misses_m.items()
        if miss_m > max(STRANGER_M, STRAY * usual_m)
    ]


def _moved_once(name: str, times_s: FloatArray, range_m: FloatArray, at: FloatArray, place: FloatArray) -> str:
    """A warning if the ranges (m,) from places (m, 2) fit two places of the beacon, one after the other, far better.

    ``place``: on the map. The cut is where they fit best. Each part must then be consistent in itself: the place by
    one half of its readings predicts the other half far better than the place of the other part does. Where the path
    drifts, or where a beacon is seen from one direction, it does not.
    """
    most_m = max(MOVED_M, OUTLYING * float(np.median(_misses(range_m, at, place_by_ranges(range_m, at, place)))))

    def fitted(rows: slice) -> FloatArray:
        return place_by_ranges(range_m[rows], at[rows], place)

    def miss_m(rows: slice, at_place: FloatArray) -> float:
        return float(np.minimum(_misses(range_m[rows], at[rows], at_place), most_m).sum())

    n = len(times_s)
    best: tuple[float, int, tuple[FloatArray, FloatArray]] | None = None
    for cut in np.unique(np.linspace(0, n, PARTS + 1).astype(int)[1:-1]).tolist():
        if min(cut, n - cut) < FEWEST:
            continue
        places = fitted(slice(cut)), fitted(slice(cut, n))
        both_m = miss_m(slice(cut), places[0]) + miss_m(slice(cut, n), places[1])
        if best is None or both_m < best[0]:
            best = both_m, cut, places
    if best is None:
        return ""
    both_m, cut, (first, second) = best
    if float(np.hypot(*(second - first))) < max(MOVED_M, STRAY * both_m / n):
        return ""
    for begin, end, other in ((0, cut, second), (cut, n, first)):
        halves = slice(begin, (begin + end) // 2), slice((begin + end) // 2, end)
        predicted_m = sum(miss_m(rows, fitted(by)) for rows, by in (halves, halves[::-1]))
        if predicted_m > HALVED * miss_m(slice(begin, end), other):
            return ""
    return (
        f"ranges of beacon {name} fit the place ({first[0]:.2f}, {first[1]:.2f}) until about {instant(times_s[cut])} "
        f"and ({second[0]:.2f}, {second[1]:.2f}) afterwards: was it moved? The map has one place of it; give its later "
        "readings another name"
    )


def _misses(range_m: FloatArray, at: FloatArray, place: FloatArray) -> FloatArray:
    return np.asarray(np.abs(range_m - np.hypot(*(place - at).T)))


TOGETHER_S = 5.0  # readings within this time are looked at together,
LEAST_TOGETHER = 8  # if there are as many, of two beacons
# Mean NIS per degree of freedom of the better half of the beacons, above which all are off: with two beacons of two
# degrees of freedom, by chance once in half a million.
SUDDEN = 8.0
OFF = 25.0  # median of one beacon: five standard deviations
SELDOM = 0.1  # number of times that so many beacons would be off at once in the run, if it were by chance


class _Together(NamedTuple):
    """Readings within ``TOGETHER_S`` from a time on."""

    begin_s: float
    readings: int
    beacons: int
    better_half: float  # mean NIS per degree of freedom of the worst beacon of the better half
    off: int  # beacons whose median is beyond ``OFF``


def sudden_disagreement(track: EstimatedPath) -> list[str]:
    """A warning if the readings of several beacons at once are far from what the filter expects.

    Outliers, reflections and a moved beacon are off alone; a vehicle that was moved, or whose clock was set, sees all
    beacons elsewhere, or those that it had seen before while new ones were placed.
    """
    groups = list(_together(track))
    several = [one for one in groups if one.beacons > 1 and one.readings >= LEAST_TOGETHER]
    worst = max(several, key=lambda one: one.better_half, default=None)
    asks = "was the vehicle moved, or a clock set, or are these reflections?"
    if worst is not None and worst.better_half >= SUDDEN:
        return [
            f"readings of several beacons at once are off, at {instant(worst.begin_s)} by {worst.better_half:.3g} "
            f"times their expected squares: {asks}"
        ]
    chances = [(_chance(one, groups), k) for k, one in enumerate(groups) if one.off > 1]
    chance, k = min(chances, default=(1.0, 0))
    if chance > SELDOM:
        return []
    where = f"at {instant(groups[k].begin_s)}"
    return [f"readings of {groups[k].off} of {groups[k].beacons} beacons are off at once, {where}, seldom else: {asks}"]


def _together(track: EstimatedPath) -> Iterator[_Together]:
    found = track.innovations
    times_s = np.array([one.time_s for one in found])
    nis = np.array([one.nis / one.size for one in found])
    _, beacon = np.unique([one.beacon for one in found], return_inverse=True)
    for begin_s in np.arange(times_s[0], times_s[-1], 0.2 * TOGETHER_S).tolist() if found else ():
        rows = slice(*np.searchsorted(times_s, (begin_s, begin_s + TOGETHER_S)))
        by_beacon = [nis[rows][beacon[rows] == one] for one in np.unique(beacon[rows])]
        if by_beacon:
            means = sorted(float(one.mean()) for one in by_beacon)
            off = sum(float(np.median(one)) > OFF for one in by_beacon)
            yield _Together(begin_s, rows.stop - rows.start, len(means), means[(len(means) - 1) // 2], off)


def _chance(group: _Together, groups: list[_Together]) -> float:
    """Expected number of groups with as many beacons off, if each is off as often as in the rest of the run."""
    others = [one for one in groups if abs(one.begin_s - group.begin_s) >= TOGETHER_S]
    overlap = len(groups) / max(len({int(one.begin_s // TOGETHER_S) for one in groups}), 1)
    share = (sum(one.off for one in others) / overlap + 1.0) / (sum(one.beacons for one in others) / overlap + 2.0)
    return float(binom.sf(group.off - 1, group.beacons, share)) * len(groups) / overlap
