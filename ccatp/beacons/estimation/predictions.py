"""How well a causal estimate predicts its next ranges, beside dead reckoning: what can be judged without a truth."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from ccatp.beacons.estimation.range_noise import FEWEST, correlations
from ccatp.beacons.estimation.recording import Calibrated, EstimatedPath, RecordedRun, dead_reckoned
from ccatp.beacons.rigid_motion import best_motion
from ccatp.core import FloatArray

_NONE = Calibrated(0.0, 0.0)
_CLIPPED = 3.0  # medians at which errors are cut off: a few outliers must not decide


class Predictions(NamedTuple):
    """Errors of predicted ranges on the map at the end of the run."""

    estimate_m: float  # mean absolute error, from the estimate before the reading
    reckoned_m: float  # the same from dead reckoning alone, aligned with the estimate by a rigid motion
    correlation: float | None  # of successive errors of a beacon, mean over the beacons; zero if they are white


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
    r = r.where(used)
    reckoned = dead_reckoned(run.steps, run.first_pose)
    before = np.searchsorted(track.times_s, r.times_s) - 1
    then, now = (_poses_at(at_s, run.steps.times_s, reckoned) for at_s in (track.times_s[before], r.times_s))
    turned = track.poses[before, 2] - then[:, 2]
    (dx, dy), c, s = (now - then)[:, :2].T, np.cos(turned), np.sin(turned)
    ahead = track.poses[before, :2] + np.column_stack([c * dx - s * dy, s * dx + c * dy])
    alignment = best_motion(now[:, :2], ahead)
    aligned = r.radios_at(np.column_stack([alignment.moved(now[:, :2]), now[:, 2] + alignment.angle_rad]))
    ahead = r.radios_at(np.column_stack([ahead, now[:, 2] + turned]))
    places = np.array([track.beacons[name][:2] if name in track.beacons else (np.nan, np.nan) for name in names])
    scale, offset_m = (track.calibration.get(name, _NONE).value for name in ("range_scale", "range_offset_m"))
    range_m = (r.range_m - offset_m) / (1.0 + scale)
    own_m, reckoned_m = (range_m - np.hypot(*(places[r.beacon] - at).T) for at in (ahead, aligned))
    return Predictions(_size(own_m), _size(reckoned_m), _correlation(own_m, r.beacon))


def prediction_doubts(found: Predictions | None) -> Iterator[str]:
    """A warning if dead reckoning predicts the readings better."""
    if found is not None and found.estimate_m > found.reckoned_m:
        yield (
            f"the estimate predicts its next ranges to {found.estimate_m:.2f} m, dead reckoning on the same map to "
            f"{found.reckoned_m:.2f} m: heights, an antenna off the vehicle's middle, reflections, or a wrong map?"
        )


def prediction_lines(data: Mapping[str, float | None] | None) -> Iterator[str]:
    """``Predictions`` as lines of text."""
    if data is None:
        return
    yield ""
    errors = f"{data['estimate_m']:.3f} m mean error of the next range, {data['reckoned_m']:.3f} m by dead reckoning"
    yield f"{'predictions':<12} {errors}"
    if data["correlation"] is not None:
        yield f"{'whiteness':<12} {data['correlation']:.2f} correlation of successive errors of a beacon (0 expected)"


def _poses_at(at_s: FloatArray, times_s: FloatArray, poses: FloatArray) -> FloatArray:
    return np.column_stack([np.interp(at_s, times_s, column) for column in poses.T])


def _size(errors_m: FloatArray) -> float:
    off_m = np.abs(errors_m)
    return float(np.minimum(off_m, _CLIPPED * np.median(off_m)).mean())


def _correlation(errors_m: FloatArray, beacon: np.ndarray) -> float | None:
    found = []
    for k in np.unique(beacon):
        own = errors_m[beacon == k] - np.median(errors_m[beacon == k])
        if own.size >= FEWEST and own.any():
            own = np.clip(own, -_CLIPPED * np.std(own), _CLIPPED * np.std(own))
            found.append(float(correlations(own)[1]))
    return float(np.mean(found)) if found else None
