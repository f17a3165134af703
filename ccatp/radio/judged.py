"""Pure. A track against the truth of its recording: the figures that ``ccatp radio slam`` tells."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.radio.metrics import Consistency, consistency, nees, rms, wrapped
from ccatp.radio.recording import RecordedRun, Truth
from ccatp.radio.rigid_alignment import RigidMotion, best_motion
from ccatp.radio.track import BeaconFix, Track

LONGEST_GAP_S = 0.5
"""The truth is taken as known between two of its rows that lie no further apart,"""
USUAL_GAPS = 3.0
"""or no further than that many of its usual intervals."""

FIRST_POSE_S = 1.0
"""The truth's first row tells the first pose if it comes no later than that."""
LEAST_KNOWN = 3
"""Instants with a truth: one always fits, and two but for their distance."""


class Judgement(NamedTuple):
    """Errors of a track; None where there is no truth to tell.

    Attributes:
        alignment: lays the track on the truth.
        trajectory_rmse_m: of the aligned positions.
        heading_rmse_rad: of the aligned headings.
        beacon_rmse_m: of the beacons, moved by the same alignment.
        beacon_errors_m: by name.
        nees: of the poses as they are, without alignment; positions alone if the truth has no headings; None where the
            first pose was not the truth's of that time.
        nis: of the innovations.
        errors_m: of each aligned position, shape (n,); NaN where there is no truth.
    """

    alignment: RigidMotion
    trajectory_rmse_m: float | None
    heading_rmse_rad: float | None
    beacon_rmse_m: float | None
    beacon_errors_m: Mapping[str, float]
    nees: Consistency | None
    nis: Consistency | None
    errors_m: FloatArray


def judge(track: Track, run: RecordedRun) -> Judgement:
    """Compare a track with the truth of the run.

    One rigid motion without scale lays the positions on the truth; the beacons move with it. If only the beacons were
    surveyed, they are aligned themselves.
    """
    truth = np.full((len(track.times_s), 3), np.nan) if run.truth is None else truth_at(run.truth, track.times_s)
    known = np.isfinite(truth[:, 0])
    if known.sum() < LEAST_KNOWN:
        truth[:], known[:] = np.nan, False
    common = [name for name in track.beacons if name in run.beacon_truth_m]
    places = np.array([(track.beacons[name].x_m, track.beacons[name].y_m) for name in common]).reshape(-1, 2)
    surveyed = np.array([run.beacon_truth_m[name] for name in common]).reshape(-1, 2)
    if known.any():
        alignment = best_motion(track.poses[known, :2], truth[known, :2])
    elif len(common) > 1:
        alignment = best_motion(places, surveyed)
    else:
        alignment = RigidMotion(np.eye(2), np.zeros(2))
    errors = np.hypot(*(alignment.moved(track.poses[:, :2]) - truth[:, :2]).T)
    headings = wrapped(track.poses[:, 2] + alignment.angle_rad - truth[:, 2])
    offsets = np.hypot(*(alignment.moved(places) - surveyed).T)
    measurable = known.any() or len(common) > 2  # two points always fit
    return Judgement(
        alignment=alignment,
        trajectory_rmse_m=rms(errors),
        heading_rmse_rad=rms(headings),
        beacon_rmse_m=rms(offsets) if measurable else None,
        beacon_errors_m=dict(zip(common, offsets.tolist(), strict=True)) if measurable else {},
        nees=_nees(track, truth, known) if _begins_on_truth(run) else None,
        nis=consistency(track.nis, track.nis_sizes),
        errors_m=errors,
    )


def truth_at(truth: Truth, times_s: FloatArray) -> FloatArray:
    """True x_m, y_m, heading_rad at some times, shape (n, 3); NaN outside the truth and in its gaps."""
    columns = [np.interp(times_s, truth.times_s, column) for column in truth[1:]]
    after = np.searchsorted(truth.times_s, times_s).clip(1, len(truth.times_s) - 1)
    gap = truth.times_s[after] - truth.times_s[after - 1]
    longest_s = max(LONGEST_GAP_S, USUAL_GAPS * float(np.median(np.diff(truth.times_s))))
    inside = (times_s >= truth.times_s[0]) & (times_s <= truth.times_s[-1]) & (gap <= longest_s)
    return np.where(inside[:, None], np.column_stack(columns), np.nan)


def aligned_beacons(track: Track, alignment: RigidMotion) -> dict[str, BeaconFix]:
    """The map after an alignment."""
    moved = {}
    for name, fix in track.beacons.items():
        ((x, y),) = alignment.moved(np.array([(fix.x_m, fix.y_m)])).tolist()
        moved[name] = BeaconFix(x, y, alignment.turned(fix.covariance))
    return moved


def _begins_on_truth(run: RecordedRun) -> bool:
    """Whether the truth told the first pose: else track and truth are of two frames."""
    if run.truth is None:
        return False
    return bool(run.truth.times_s[0] - FIRST_POSE_S <= run.steps.times_s[0] <= run.truth.times_s[-1])


def _nees(track: Track, truth: FloatArray, known: np.ndarray) -> Consistency | None:
    if not known.any():
        return None
    size = 3 if np.isfinite(truth[known, 2]).all() else 2
    errors = track.poses[known] - truth[known]
    errors[:, 2] = wrapped(errors[:, 2])
    squares = nees(errors[:, :size], track.covariances[known][:, :size, :size])
    return consistency(squares, np.full(squares.size, float(size)))
