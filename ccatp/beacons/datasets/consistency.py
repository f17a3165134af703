"""Units and clocks from the run itself: readings against the shape of the odometry, and the truth against it."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import fmin

from ccatp.beacons.datasets.tables import instant
from ccatp.beacons.datasets.trajectory import CONSTANT_RAD, STRAIGHT
from ccatp.beacons.estimation.evaluation import truth_at
from ccatp.beacons.estimation.recording import (
    BoolArray,
    Radio,
    Readings,
    RecordedRun,
    ReferencePath,
    Steps,
    antenna_path,
    dead_reckoned,
    running_total,
)
from ccatp.core import FloatArray, IntArray

# An odometry that comes so rarely, s, at such a speed, m/s, has its times in another unit.
RARE = ((2.0, 0.02), (0.5, 0.003))
MOVING_M_S = 1e-6
APART = 0.15  # of the extent of the path: distance of two places at which ranges of a beacon are compared
LONGEST_PAIR_S = 120.0  # between them; the odometry drifts
FEWEST_PAIRS = 10
TOO_LONG, TOO_SHORT = 1.5, 0.03  # change of a range over the distance travelled, which is at most 1
LENGTHS = (("feet", 1.0 / 0.3048, 1.4), ("centimetres", 100.0, 3.2), ("millimetres", 1000.0, 3.2))  # and their latitude
USUAL = 0.9  # 75th percentile of |cos| of an angle: change of a range over the distance travelled
WIDE = 20.0  # times survey and path together, which no range is long

PER_WINDOW = 24  # readings of a beacon in a window: shorter ones do not tell a lag from another place of the beacon
FEWEST = 8
SHORTEST_WINDOW_S, LONGEST_WINDOW_S = 20.0, 60.0
LEAST_GROUPS = 6
LAGS_S = np.arange(-20.0, 20.01, 0.5)
FINE_S = np.arange(-0.5, 0.501, 0.05)
LEAST_LAG_S = 0.6  # smaller ones are the delay that the estimators calibrate: two sigmas of its widest prior
LEAST_TRUTH_LAG_S = 0.15  # of the truth, which no estimator uses: nothing calibrates it; above the interval of most
BETTER = 0.6  # of the misfit that remains with a lag, or in another unit
MAJORITY = 0.65  # of the windows fit better
LEAST_HEIGHT_M = 1.0
DETERMINED = 0.3  # of the usual range: standard deviation of a beacon's place, up to which a window determines it
FIRST_ARM_M, FINE_ARM_M, MOST_TRIES = 0.3, 0.01, 80  # of the search for the place of a radio on the vehicle
LEAST_ARM_M, MOST_ARM_M = 0.15, 10.0  # above the error of the ranges, and as long as vehicles are
CLEARLY = 0.9  # of the misfit that remains with another clock, or with another sign
FARTHEST = 5.0  # windows beyond this many usual misfits count as that
DEGREES = np.pi / 180.0
LEAST_TURN_RAD = 3.0

PIECE_S, PIECE_POINTS = 8.0, 24
LEAST_PIECES = LEAST_GROUPS
LEAST_SHAPE_M = 0.3  # extent of a piece of the path


def inconsistencies(run: RecordedRun) -> Iterator[str]:
    """Warnings about units and clocks that need no truth, and of a truth with another clock than the odometry."""
    if not np.hypot(run.steps.distance_m, run.steps.lateral_m).any():
        yield "the odometry never moves: is it of this run, and are its columns those of distances or places?"
        return
    rare = list(_rare(run.steps))
    yield from rare
    yield from _heading_against_course(run.steps)
    if rare:
        return
    path = dead_reckoned(run.steps, (0.0, 0.0, 0.0))
    units = list(_lengths(run, path))
    yield from units
    yield from _against_survey(run, path)
    if not units:
        yield from _readings_clock(run, path)
    if run.truth is not None:
        yield from _truth_clock(run.truth, run.steps.times_s, path)


def _rare(steps: Steps) -> Iterator[str]:
    interval_s = np.diff(steps.times_s)
    usual_s = float(np.median(interval_s))
    speed = np.hypot(steps.distance_m, steps.lateral_m) / interval_s
    moving = speed[speed > MOVING_M_S]
    if not moving.size:
        return
    fast = float(np.percentile(moving, 90.0))
    if any(usual_s > least_s and fast < most for least_s, most in RARE):
        yield (
            f"odometry comes every {usual_s:.3g} s at {fast:.2g} m/s: are its times in milliseconds? Nothing was "
            "converted; give s"
        )


def _heading_against_course(steps: Steps) -> Iterator[str]:
    """Poses whose heading is none, or has the other sign: the vehicle moves in all directions relative to it."""
    moving = np.hypot(steps.distance_m, steps.lateral_m) > 0.0
    if moving.sum() < FEWEST_PAIRS:
        return
    aside = np.arctan2(steps.lateral_m[moving], steps.distance_m[moving])
    if abs(np.mean(np.exp(1j * aside))) >= STRAIGHT:
        return
    if np.abs(steps.turn_rad).max() < CONSTANT_RAD:
        yield (
            "the odometry never turns while its course does: its poses have no heading, so bearings and errors of "
            "the heading mean nothing"
        )
        return
    heading = (running_total(steps.turn_rad)[:-1] + 0.5 * steps.turn_rad)[moving]
    if abs(np.mean(np.exp(1j * (aside + 2.0 * heading)))) > STRAIGHT:  # course + heading is constant
        yield (
            "the heading of the odometry turns against the course of its positions: is it clockwise, as that of a "
            "compass? Give it counter-clockwise from x"
        )


def _lengths(run: RecordedRun, path: FloatArray) -> Iterator[str]:
    """A range changes by at most the distance between two places, and usually by most of it."""
    extent_m = float(np.ptp(path[:, :2], axis=0).max())
    if extent_m <= 0.0:
        return
    shares, largest = [], []
    for beacon in range(len(run.beacon_ids)):
        seen = run.readings.where((run.readings.beacon == beacon) & np.isfinite(run.readings.range_m))
        ratios = _changes(seen, seen.radios_at(_poses(run.steps.times_s, path, seen.times_s)), APART * extent_m)
        if ratios.size >= FEWEST_PAIRS:
            shares.append(float(np.percentile(ratios, 75.0)))
            largest.append(float(np.percentile(ratios, 90.0)))
    if not shares:
        return
    share = float(np.median(shares))
    if share > TOO_LONG:
        near = [unit for unit, factor, latitude in LENGTHS if 1.0 / latitude < share / USUAL / factor < latitude]
        asks = f"are they in {near[0]}?" if near else "are they of this vehicle, in metres, and of the same clock?"
        yield f"ranges change by {share:.3g} times the distance that the odometry travels: {asks}"
    elif len(shares) > 1 and max(largest) < TOO_SHORT:
        yield (
            f"ranges change by at most {max(largest):.2g} times the distance that the odometry travels: is one of them "
            "in another unit?"
        )


def _changes(seen: Readings, at: FloatArray, apart_m: float) -> FloatArray:
    found = []
    last = 0
    for row in range(1, len(seen.times_s)):
        while last < row and seen.times_s[row] - seen.times_s[last] > LONGEST_PAIR_S:
            last += 1
        off_m = float(np.hypot(*(at[row] - at[last])))
        if last < row and off_m >= apart_m:
            found.append(abs(seen.range_m[row] - seen.range_m[last]) / off_m)
            last = row
    return np.array(found)


def _poses(times_s: FloatArray, path: FloatArray, at_s: FloatArray) -> FloatArray:
    return np.column_stack([np.interp(at_s, times_s, column) for column in path.T])


def _against_survey(run: RecordedRun, path: FloatArray) -> Iterator[str]:
    ranges = run.readings.range_m[np.isfinite(run.readings.range_m)]
    if len(run.beacon_truth_m) < 2 or not ranges.size:
        return
    width_m = float(np.hypot(*np.ptp(np.array(list(run.beacon_truth_m.values())), axis=0)))
    extent_m, usual_m = float(np.hypot(*np.ptp(path[:, :2], axis=0))), float(np.median(ranges))
    if usual_m > WIDE * (width_m + extent_m):
        yield (
            f"half of the ranges are longer than {usual_m:.3g} m, among beacons and ways of {width_m + extent_m:.3g} m:"
            " are ranges in millimetres or centimetres?"
        )
    elif width_m > WIDE * (usual_m + extent_m):
        yield (
            f"surveyed beacons are {width_m:.3g} m apart, with ranges of {usual_m:.3g} m and ways of {extent_m:.3g} m: "
            "are their places in millimetres or centimetres?"
        )


class _Windows:
    """Readings of each beacon in short windows, each fitted by the place of the beacon on the path by odometry.

    r^2 = |p|^2 - 2 p b + |b|^2 is linear in b and |b|^2, so no place, no pose and no truth has to be known. Ranges that
    most often have a bearing are fitted together with it: each such reading is a point at which the beacon is.
    """

    def __init__(self, run: RecordedRun) -> None:
        seen = run.readings.where(np.isfinite(run.readings.range_m) & (run.readings.range_m > 0.0))
        pointed = np.isfinite(seen.bearing_rad)
        self.is_pointed = bool(pointed.sum() > 0.5 * pointed.size)
        if self.is_pointed:
            seen = seen.where(pointed)
        self.group: IntArray = np.full(len(seen.times_s), -1, dtype=np.int64)
        intervals = [np.diff(seen.times_s[seen.beacon == k]) for k in range(len(run.beacon_ids))]
        usual = [float(np.median(one)) for one in intervals if one.size]
        span_s = PER_WINDOW * float(np.median(usual)) if usual else LONGEST_WINDOW_S
        span_s = min(max(span_s, SHORTEST_WINDOW_S), LONGEST_WINDOW_S)
        window = ((seen.times_s - run.steps.times_s[0]) / span_s).astype(np.int64)
        _, group, counts = np.unique(
            np.column_stack([seen.beacon, window]), axis=0, return_inverse=True, return_counts=True
        )
        group = group.ravel()
        kept = counts >= FEWEST
        renumbered = np.cumsum(kept) - 1
        self.group = np.where(kept[group], renumbered[group], -1)
        self.count = int(kept.sum())
        self._seen, self.group = seen.where(self.group >= 0), self.group[self.group >= 0]
        self.times_s, self.range_m, self.bearing_rad = self._seen.times_s, self._seen.range_m, self._seen.bearing_rad
        self.begin_s = np.full(self.count, np.inf)
        np.minimum.at(self.begin_s, self.group, self.times_s)

    def misfits(
        self, times_s: FloatArray, path: FloatArray, lag_s: float = 0.0, signs: tuple[float, float] = (1.0, 1.0)
    ) -> FloatArray:
        """Root mean square of the misfit of each window, m, if the path is taken ``lag_s`` later; shape (count,).

        ``signs``: of the places of several radios, ahead and left.
        """
        poses = _poses(times_s, path, self.times_s + lag_s)
        seen = self._seen
        if seen.arm_m is not None:
            seen = seen._replace(arm_m=seen.arm_m * np.array(signs))
        at = seen.radios_at(poses)
        counts = np.bincount(self.group, minlength=self.count)
        if self.is_pointed:
            way = poses[:, 2] + self.bearing_rad
            at = at + self.range_m[:, None] * np.column_stack([np.cos(way), np.sin(way)])
        at = self._centred(at)
        if self.is_pointed:
            return np.asarray(np.sqrt(np.bincount(self.group, (at**2).sum(axis=1), self.count) / (2 * counts - 2)))
        fitted = self._fitted(at)
        return np.asarray(np.sqrt(fitted.squares / np.maximum(counts - 3, 1)))

    def heights_m2(self, times_s: FloatArray, path: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Square of the height of the beacon over the path that a window fits, and its sigma, m^2, shape (k,).

        With a height h the free term is |b|^2 + h^2. Windows that do not determine the place b, as where the vehicle
        stands, are left out: there all of the range would be height.
        """
        fitted = self._fitted(self._centred(self._seen.radios_at(_poses(times_s, path, self.times_s))))
        counts = np.bincount(self.group, minlength=self.count)
        slope = np.column_stack([-0.5 * fitted.terms[:, :2], np.ones(self.count)])
        spread = np.linalg.inv(fitted.normal) * (fitted.squares / np.maximum(counts - 3, 1))[:, None, None]
        variance = np.einsum("na,nab,nb->n", slope, spread, slope)
        of_place_m2 = 0.25 * np.trace(spread[:, :2, :2], axis1=1, axis2=2)
        usual_m = np.bincount(self.group, self.range_m, self.count) / counts
        is_known = of_place_m2 < (DETERMINED * usual_m) ** 2
        squares_m2 = fitted.terms[:, 2] - 0.25 * (fitted.terms[:, :2] ** 2).sum(axis=1)
        return squares_m2[is_known], np.sqrt(np.maximum(variance, 0.0))[is_known]

    def _centred(self, at: FloatArray) -> FloatArray:
        counts = np.bincount(self.group, minlength=self.count)
        middle = np.column_stack([np.bincount(self.group, column, self.count) / counts for column in at.T])
        return np.asarray(at - middle[self.group])

    def _fitted(self, at: FloatArray) -> "_Fitted":
        weight = 0.5 / self.range_m  # an error of r^2 over 2 r is one of r
        rows = np.column_stack([at, np.ones(len(at))]) * weight[:, None]
        wanted = (self.range_m**2 - (at**2).sum(axis=1)) * weight
        normal = np.zeros((self.count, 3, 3))
        right = np.zeros((self.count, 3))
        np.add.at(normal, self.group, rows[:, :, None] * rows[:, None, :])
        np.add.at(right, self.group, rows * wanted[:, None])
        ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        normal = normal + ridge + 1e-300 * np.eye(3)
        terms = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        errors = wanted - (rows * terms[self.group]).sum(axis=1)
        squares = np.bincount(self.group, errors**2, self.count).astype(np.float64)
        return _Fitted(terms, normal, squares)


class _Fitted(NamedTuple):
    """Linear fits of -2 p b + |b|^2, one a window: its terms (n, 3), normal matrices, sums of squares, m^2."""

    terms: FloatArray
    normal: FloatArray
    squares: FloatArray


def _readings_clock(run: RecordedRun, path: FloatArray) -> Iterator[str]:
    windows = _Windows(run)
    if windows.count < LEAST_GROUPS:
        return
    times_s = run.steps.times_s
    if off := _mirrored_tags(windows, times_s, path, run.tags) or _radio_off_the_origin(windows, times_s, path):
        yield off
        return
    if not windows.is_pointed:
        yield from _above(*windows.heights_m2(times_s, path), run.kind)
    middle_s = float(np.median(windows.begin_s))
    parts = [np.ones(windows.count, dtype=bool), windows.begin_s < middle_s, windows.begin_s >= middle_s]
    lags = _lags(lambda lag_s: windows.misfits(times_s, path, lag_s), parts)
    if all(lags[1:]) and abs(lags[1] - lags[2]) < LEAST_LAG_S:
        yield f"ranges fit the odometry best {_shifted(lags[0] or lags[1])}: are their clocks the same?"
    elif any(lags):
        for lag_s, what in zip(lags[1:], ("first", "second"), strict=True):
            if lag_s:
                yield (
                    f"in the {what} half of the run (at {instant(middle_s)}) ranges fit the odometry best "
                    f"{_shifted(lag_s)}: was a clock set?"
                )
        if not any(lags[1:]):
            yield f"ranges fit the odometry best {_shifted(lags[0])}: are their clocks the same?"
    elif np.abs(run.steps.turn_rad).sum() > LEAST_TURN_RAD:
        for factor, what in ((DEGREES, "degrees"), (1.0 / DEGREES, "another unit than rad")):
            other = dead_reckoned(run.steps._replace(turn_rad=factor * run.steps.turn_rad), (0.0, 0.0, 0.0))
            if _is_better(windows.misfits(times_s, path), windows.misfits(times_s, other)):
                yield f"ranges fit an odometry that turns {factor:.3g} times as much: are its turns in {what}?"


def _above(squares_m2: FloatArray, sigmas_m2: FloatArray, kind: str) -> Iterator[str]:
    if (
        squares_m2.size >= LEAST_GROUPS
        and np.mean(squares_m2 > 2.0 * sigmas_m2) > MAJORITY
        and (usual_m2 := float(np.median(squares_m2))) > LEAST_HEIGHT_M**2
    ):
        yield (
            f"ranges are as those of beacons about {np.sqrt(usual_m2):.1g} m above or below the radio, or too long: "
            "give the heights of the beacons (z) and of the antenna, or a prior of their squares "
            f"({kind}.priors.beacon_height_m2=4) or of the offset"
        )


def _mirrored_tags(windows: _Windows, times_s: FloatArray, path: FloatArray, tags: tuple[Radio, ...]) -> str:
    """A warning if ranges of several radios fit far better with the sign of their places changed."""
    if not tags:
        return ""
    now = windows.misfits(times_s, path)
    for signs, what in (((1.0, -1.0), "left and right"), ((-1.0, 1.0), "ahead and behind"), ((-1.0, -1.0), "both")):
        other = windows.misfits(times_s, path, signs=signs)
        # One of few alternatives, so a smaller advantage counts than for a place that is searched.
        if _typical(other, now) < CLEARLY * _typical(now, now) and np.mean(other < now) > MAJORITY:
            return (
                f"ranges fit the odometry far better if {what} are exchanged in the places of the tags: forward and "
                "left are positive"
            )
    return ""


def _radio_off_the_origin(windows: _Windows, times_s: FloatArray, path: FloatArray) -> str:
    """A warning if ranges fit far better to a radio ahead or beside of where it should be, and better than with a lag.

    On a straight way a radio ahead is like a clock that is late; in turns the two differ.
    """

    def misfits(arm_m: FloatArray) -> FloatArray:
        ahead_m, left_m = arm_m.tolist()
        return windows.misfits(times_s, np.column_stack([antenna_path(path, (ahead_m, left_m)), path[:, 2]]))

    now = windows.misfits(times_s, path)

    def typical(arm_m: FloatArray) -> float:
        return _typical(misfits(arm_m), now)

    start = np.array([[0.0, 0.0], [FIRST_ARM_M, 0.0], [0.0, FIRST_ARM_M]])
    arm_m = fmin(typical, start[0], xtol=FINE_ARM_M, ftol=1e-6, maxfun=MOST_TRIES, disp=False, initial_simplex=start)
    best, far_m = misfits(arm_m), float(np.hypot(*arm_m))
    if not LEAST_ARM_M <= far_m <= MOST_ARM_M or not _is_better(now, best):
        return ""
    lagged = min(_typical(windows.misfits(times_s, path, float(lag_s)), now) for lag_s in LAGS_S)
    if _typical(best, now) > CLEARLY * lagged:
        return ""
    ahead_m, left_m = arm_m.tolist()
    return (
        f"ranges fit the odometry best for a radio {abs(ahead_m):.2g} m {'ahead' if ahead_m > 0.0 else 'behind'} and "
        f"{abs(left_m):.2g} m to the {'left' if left_m > 0.0 else 'right'} of where it is taken to be: give its place"
    )


def _shifted(lag_s: float) -> str:
    return f"if taken {abs(lag_s):.2g} s {'later' if lag_s > 0.0 else 'earlier'}"


def _lags(misfits: Callable[[float], FloatArray], parts: list[BoolArray], least_s: float = LEAST_LAG_S) -> list[float]:
    """For each part of the windows the lag at which most of them fit much better, s; 0.0: there is none."""
    now, later = misfits(0.0), [misfits(float(lag_s)) for lag_s in LAGS_S]
    found = []
    for part in parts:
        if part.sum() < LEAST_GROUPS:
            found.append(0.0)
            continue
        coarse = LAGS_S[int(np.argmin([_typical(one[part], now[part]) for one in later]))]
        near = [(float(lag_s), misfits(float(lag_s))[part]) for lag_s in coarse + FINE_S]
        best_s, best = min(near, key=lambda one: _typical(one[1], now[part]))
        is_lag = abs(best_s) >= least_s and _is_better(now[part], best)
        found.append(best_s if is_lag else 0.0)
    return found


def _typical(misfits: FloatArray, now: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.minimum(misfits, FARTHEST * np.median(now)) ** 2)))


def _is_better(now: FloatArray, other: FloatArray) -> bool:
    return _typical(other, now) < BETTER * _typical(now, now) and bool(np.mean(other < now) > MAJORITY)


def _truth_clock(truth: ReferencePath, times_s: FloatArray, path: FloatArray) -> Iterator[str]:
    """The lag at which short pieces of the true path have the shape of those of the odometry."""
    start_s, end_s = max(times_s[0], truth.times_s[0]), min(times_s[-1], truth.times_s[-1])
    pieces = int((end_s - start_s) / PIECE_S)
    if pieces < LEAST_PIECES:
        return
    t = np.linspace(start_s, start_s + pieces * PIECE_S, pieces * PIECE_POINTS)

    def cut(of_s: FloatArray, x: FloatArray, y: FloatArray, at_s: FloatArray) -> npt.NDArray[np.complex128]:
        points = (np.interp(at_s, of_s, x) + 1j * np.interp(at_s, of_s, y)).reshape(pieces, PIECE_POINTS)[there]
        return np.asarray(points - points.mean(axis=1, keepdims=True))

    there = np.isfinite(truth_at(truth, t)[:, 0]).reshape(pieces, PIECE_POINTS).all(axis=1)
    if there.sum() < LEAST_PIECES:
        return
    true = cut(*truth[:3], t)
    if float(np.median(np.abs(true).max(axis=1))) < LEAST_SHAPE_M:
        return

    def misfits(lag_s: float) -> FloatArray:
        own = cut(times_s, path[:, 0], path[:, 1], t + lag_s)
        turned = (own.conj() * true).sum(axis=1)
        turned /= np.maximum(np.abs(turned), 1e-12)
        return np.asarray(np.sqrt((np.abs(own * turned[:, None] - true) ** 2).mean(axis=1)))

    (lag_s,) = _lags(misfits, [np.ones(int(there.sum()), dtype=bool)], LEAST_TRUTH_LAG_S)
    if lag_s:
        yield f"the truth fits the odometry best {_shifted(lag_s)}: their clocks differ, and the errors contain that"
