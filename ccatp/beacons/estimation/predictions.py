"""How well a causal estimate predicts its next ranges, beside dead reckoning: what can be judged without a truth."""

from collections.abc import Iterator, Mapping
from math import log
from typing import NamedTuple

import numpy as np

from ccatp.beacons.estimation.range_noise import FEWEST, correlations, readings_as_one
from ccatp.beacons.estimation.recording import EstimatedPath, Readings, RecordedRun, dead_reckoned
from ccatp.beacons.rigid_motion import best_motion
from ccatp.core import FloatArray

_MOST = 0.999
_NEAR_M, _FLAT = 1e-3, 1e-6
_BY_CHANCE = 3.0  # standard errors
_LEAST_SHARE = 0.02  # of the error, below which a difference does not matter
_CLIPPED = 3.0  # medians at which errors are cut off: a few outliers must not decide


LATER = 3.0  # correlation times between an estimate and the reading that it predicts: its error is then a new one
FURTHEST_S = 20.0  # longest prediction
SURE = 0.2  # correlation of successive errors that counts as none: by chance, and by the errors of the estimate
FITS = 8  # iterations of the places of beacons


class Predictions(NamedTuple):
    """Errors of predicted ranges on the map at the end of the run."""

    estimate_m: float  # mean absolute error, from the estimate before the reading
    reckoned_m: float  # the same from dead reckoning alone, aligned with the estimate by a rigid motion
    correlation: float | None  # of successive errors of a beacon, mean over the beacons; zero if they are white
    horizon_s: float  # after which the next two are predicted: errors that last help the estimate with the next range
    estimate_later_m: float  # mean absolute error, each beacon where it fits best
    reckoned_later_m: float  # the same from dead reckoning alone
    difference_sigma_m: float  # standard error of the difference of the last two, of errors that last


def predicted(run: RecordedRun, track: EstimatedPath, camera_field_rad: float) -> Predictions | None:
    """The prediction errors of a causal estimate; None with fewer than ``FEWEST`` ranges of beacons on the map."""
    r, names = run.readings.with_distances(camera_field_rad), run.beacon_ids
    joined_s = dict[str, float]()
    for one in track.innovations:
        joined_s.setdefault(one.beacon, one.time_s)
    begin_s = np.array([joined_s.get(name, np.inf) if name in track.beacons else np.inf for name in names])
    used = np.isfinite(r.range_m) & (r.times_s >= begin_s[r.beacon]) & (r.times_s > track.times_s[0])
    if used.sum() < FEWEST:
        return None
    r = track.calibrated(r.where(used), names)
    places = np.array([track.beacons[name][:2] if name in track.beacons else (np.nan, np.nan) for name in names])
    reckoned = dead_reckoned(run.steps, run.first_pose)
    own_m, reckoned_m = (_errors(r, at, places) for at in _ahead(run, track, reckoned, r, 0.0))
    correlation, lasts_s = _correlation(own_m, r)
    horizon_s = min(LATER * lasts_s, FURTHEST_S)
    later = r.where(r.times_s - horizon_s > max(float(r.times_s[0]), float(track.times_s[0])))
    if len(later.times_s) < FEWEST:
        later, horizon_s = r, 0.0
    fitted = [_errors(later, at, _fitted(later, at, places)) for at in _ahead(run, track, reckoned, later, horizon_s)]
    own_later_m, reckoned_later_m = map(_clipped, fitted)
    return Predictions(
        _size(own_m), _size(reckoned_m), correlation, horizon_s, float(own_later_m.mean()),
        float(reckoned_later_m.mean()), _standard_error(own_later_m - reckoned_later_m),
    )  # fmt: skip


def _ahead(
    run: RecordedRun, track: EstimatedPath, reckoned: FloatArray, r: Readings, horizon_s: float
) -> tuple[FloatArray, FloatArray]:
    """Places of readings (m, 2): by the estimate before each and odometry since then, and by odometry alone, aligned.

    ``horizon_s``: least time between the estimate and the reading.
    """
    before = np.maximum(np.searchsorted(track.times_s, r.times_s - horizon_s) - 1, 0)
    then, now = (_poses_at(at_s, run.steps.times_s, reckoned) for at_s in (track.times_s[before], r.times_s))
    turned = track.poses[before, 2] - then[:, 2]
    (dx, dy), c, s = (now - then)[:, :2].T, np.cos(turned), np.sin(turned)
    ahead = track.poses[before, :2] + np.column_stack([c * dx - s * dy, s * dx + c * dy])
    alignment = best_motion(now[:, :2], ahead)
    aligned = np.column_stack([alignment.moved(now[:, :2]), now[:, 2] + alignment.angle_rad])
    return r.radios_at(np.column_stack([ahead, now[:, 2] + turned])), r.radios_at(aligned)


def _errors(r: Readings, at: FloatArray, places: FloatArray) -> FloatArray:
    return np.asarray(r.range_m - np.hypot(*(places[r.beacon] - at).T))


def _fitted(r: Readings, at: FloatArray, places: FloatArray) -> FloatArray:
    """Places of the beacons that fit ranges from given places (m, 2) best, near those given.

    So both paths get their own map.
    """
    places = places.copy()
    for k in np.unique(r.beacon).tolist():
        rows = r.beacon == k
        places[k] = place_by_ranges(r.range_m[rows], at[rows], places[k])
    return places


def place_by_ranges(range_m: FloatArray, at: FloatArray, start: FloatArray) -> FloatArray:
    """The place (2,) that fits ranges (m,) from places (m, 2) best, near ``start``.

    Gauss-Newton with the weights of Cauchy's distribution, as wide as the errors.
    """
    place = start.copy()
    for _ in range(FITS):
        way = place - at
        distance_m = np.maximum(np.hypot(*way.T), _NEAR_M)
        e = range_m - distance_m
        weights = 1.0 / (1.0 + (e / max(float(np.median(np.abs(e))), _NEAR_M)) ** 2)
        J = way / distance_m[:, None]
        square = J.T @ (weights[:, None] * J)
        place = place + np.linalg.solve(square + np.trace(square) * _FLAT * np.eye(2), J.T @ (weights * e))
    return np.asarray(place)


def prediction_doubts(found: Predictions | None) -> Iterator[str]:
    """A warning if dead reckoning predicts the readings better, and not by chance."""
    if found is None:
        return
    by_m = found.estimate_later_m - found.reckoned_later_m
    if by_m > max(_BY_CHANCE * found.difference_sigma_m, _LEAST_SHARE * found.reckoned_later_m):
        after = f" {found.horizon_s:.1f} s later" if found.horizon_s > 0.0 else ""
        yield (
            f"the estimate predicts its ranges{after} to {found.estimate_later_m:.3g} m, dead reckoning on its own "
            f"map to {found.reckoned_later_m:.3g} m: heights, an antenna off the vehicle's middle, reflections, or a "
            "wrong map?"
        )


def prediction_lines(data: Mapping[str, float | None] | None) -> Iterator[str]:
    """``Predictions`` as lines of text."""
    if data is None:
        return
    yield ""
    errors = f"{data['estimate_m']:.3f} m mean error of the next range, {data['reckoned_m']:.3f} m by dead reckoning"
    yield f"{'predictions':<12} {errors}"
    if data["horizon_s"]:
        later = f"{data['estimate_later_m']:.3f} m of the range {data['horizon_s']:.1f} s later"
        yield f"{'':<12} {later}, {data['reckoned_later_m']:.3f} m by dead reckoning, each with its own map"
    if data["correlation"] is not None:
        yield f"{'whiteness':<12} {data['correlation']:.2f} correlation of successive errors of a beacon (0 expected)"


def _poses_at(at_s: FloatArray, times_s: FloatArray, poses: FloatArray) -> FloatArray:
    return np.column_stack([np.interp(at_s, times_s, column) for column in poses.T])


def _size(errors_m: FloatArray) -> float:
    return float(_clipped(errors_m).mean())


def _clipped(errors_m: FloatArray) -> FloatArray:
    off_m = np.abs(errors_m)
    return np.asarray(np.minimum(off_m, _CLIPPED * np.median(off_m)))


def _standard_error(values: FloatArray) -> float:
    """Of the mean of values in order of time, which are correlated."""
    off = values - values.mean()
    if not off.any():
        return 0.0
    return float(np.sqrt(np.mean(off**2) * readings_as_one(correlations(off)) / off.size))


def _correlation(errors_m: FloatArray, r: Readings) -> tuple[float | None, float]:
    """Correlation of successive errors of a beacon, mean over the beacons, and the time for which errors last, s."""
    found, between_s = [], []
    for k in np.unique(r.beacon):
        own = errors_m[r.beacon == k] - np.median(errors_m[r.beacon == k])
        if own.size >= FEWEST and own.any():
            own = np.clip(own, -_CLIPPED * np.std(own), _CLIPPED * np.std(own))
            found.append(float(correlations(own)[1]))
            between_s.append(float(np.median(np.diff(r.times_s[r.beacon == k]))))
    if not found:
        return None, 0.0
    mean = float(np.mean(found))
    return mean, -float(np.mean(between_s)) / log(min(mean, _MOST)) if mean > SURE else 0.0
