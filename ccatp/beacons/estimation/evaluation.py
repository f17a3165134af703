"""Errors of an estimated path and map against the ground truth; results of ``ccatp radio slam`` as data and text."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ccatp.beacons.estimation.recording import (
    BeaconFix,
    BeaconTrack,
    EstimatedPath,
    RecordedRun,
    ReferencePath,
    dead_reckoned,
)
from ccatp.beacons.rigid_motion import RigidMotion, best_motion
from ccatp.core import FloatArray
from ccatp.filters.metrics import Consistency, consistency, nees, rms, wrapped

LONGEST_GAP_S = 0.5  # the truth is interpolated over gaps up to this length,
USUAL_GAPS = 3.0  # or up to this many of its median intervals

FIRST_POSE_S = 1.0  # latest start of the truth after the odometry, for its first row to be the first pose
LEAST_KNOWN = 3  # instants with a truth: an alignment fits one exactly, and two except for their distance


class TrackEvaluation(NamedTuple):
    """Errors of a track; None where there is no truth.

    ``nees``: of the poses without alignment; of positions alone if the truth has no headings; None if the first pose is
    not that of the truth.
    """

    alignment: RigidMotion
    trajectory_rmse_m: float | None
    heading_rmse_rad: float | None
    beacon_rmse_m: float | None
    beacon_errors_m: Mapping[str, float]
    nees: Consistency | None
    nis: Consistency | None
    times_s: FloatArray  # of the poses that are compared, shape (n,)
    errors_m: FloatArray  # of each of these aligned positions, shape (n,); NaN where there is no truth


def judge(track: EstimatedPath, run: RecordedRun) -> TrackEvaluation:
    """Compare a track with the truth of the run.

    One rigid motion without scale aligns the positions with the truth, and is applied to the beacons. If only the
    beacons were surveyed, they are aligned themselves. On a known map nothing is aligned.
    """
    track = comparable(track, run.truth)
    truth = np.full((len(track.times_s), 3), np.nan) if run.truth is None else truth_at(run.truth, track.times_s)
    known = np.isfinite(truth[:, 0])
    if known.sum() < LEAST_KNOWN:
        truth[:], known[:] = np.nan, False
    common = [name for name in track.beacons if name in run.beacon_truth_m]
    places = np.array([(track.beacons[name].x_m, track.beacons[name].y_m) for name in common]).reshape(-1, 2)
    surveyed = np.array([run.beacon_truth_m[name] for name in common]).reshape(-1, 2)
    if run.known_map is not None:
        alignment = RigidMotion(np.eye(2), np.zeros(2))
    elif known.any():
        alignment = best_motion(track.poses[known, :2], truth[known, :2])
    elif len(common) > 1:
        alignment = best_motion(places, surveyed)
    else:
        alignment = RigidMotion(np.eye(2), np.zeros(2))
    errors = np.hypot(*(alignment.moved(track.poses[:, :2]) - truth[:, :2]).T)
    headings = wrapped(track.poses[:, 2] + alignment.angle_rad - truth[:, 2])
    offsets = np.hypot(*(alignment.moved(places) - surveyed).T)
    measurable = known.any() or len(common) > 2  # an alignment of two points says nothing of their errors
    is_one_frame = False  # True if the first pose came from the truth; otherwise the frames differ
    if run.truth is not None:
        start_s, end_s = run.truth.times_s[0] - FIRST_POSE_S, run.truth.times_s[-1]
        is_one_frame = bool(start_s <= run.steps.times_s[0] <= end_s)
    return TrackEvaluation(
        alignment=alignment,
        trajectory_rmse_m=rms(errors),
        heading_rmse_rad=rms(headings),
        beacon_rmse_m=rms(offsets) if measurable else None,
        beacon_errors_m=dict(zip(common, offsets.tolist(), strict=True)) if measurable else {},
        nees=_nees(track, truth, known) if is_one_frame else None,
        nis=consistency(track.nis, track.nis_sizes),
        times_s=track.times_s,
        errors_m=errors,
    )


def comparable(track: EstimatedPath, truth: ReferencePath | None) -> EstimatedPath:
    """The track at the times of a sparse truth, between whose rows the vehicle turns; else the track itself.

    Covariances are those of the nearest pose.
    """
    if truth is None or float(np.median(np.diff(truth.times_s))) <= LONGEST_GAP_S:
        return track
    at_s = truth.times_s[(truth.times_s >= track.times_s[0]) & (truth.times_s <= track.times_s[-1])]
    poses = np.column_stack([np.interp(at_s, track.times_s, column) for column in track.poses.T])
    middle_s = 0.5 * (track.times_s[1:] + track.times_s[:-1])
    return track._replace(times_s=at_s, poses=poses, covariances=track.covariances[np.searchsorted(middle_s, at_s)])


def truth_at(truth: ReferencePath, times_s: FloatArray) -> FloatArray:
    """True x_m, y_m, heading_rad at ``times_s``, shape (n, 3); NaN outside the truth and in its gaps."""
    columns = [np.interp(times_s, truth.times_s, column) for column in truth[1:]]
    after = np.searchsorted(truth.times_s, times_s).clip(1, len(truth.times_s) - 1)
    gap = truth.times_s[after] - truth.times_s[after - 1]
    longest_s = max(LONGEST_GAP_S, USUAL_GAPS * float(np.median(np.diff(truth.times_s))))
    inside = (times_s >= truth.times_s[0]) & (times_s <= truth.times_s[-1]) & (gap <= longest_s)
    return np.where(inside[:, None], np.column_stack(columns), np.nan)


def aligned_beacons(track: EstimatedPath, alignment: RigidMotion) -> dict[str, BeaconFix]:
    """The map after an alignment."""
    moved = {}
    for name, fix in track.beacons.items():
        ((x, y),) = alignment.moved(np.array([(fix.x_m, fix.y_m)])).tolist()
        moved[name] = BeaconFix(x, y, alignment.turned(fix.covariance))
    return moved


def _nees(track: EstimatedPath, truth: FloatArray, known: np.ndarray) -> Consistency | None:
    if not known.any():
        return None
    size = 3 if np.isfinite(truth[known, 2]).all() else 2
    errors = track.poses[known] - truth[known]
    errors[:, 2] = wrapped(errors[:, 2])
    squares = nees(errors[:, :size], track.covariances[known][:, :size, :size])
    return consistency(squares, np.full(squares.size, float(size)))


RECKONING = "dead reckoning"


def reckoned_track(run: RecordedRun) -> EstimatedPath:
    """The path by odometry alone, from the first pose; its covariances have no meaning."""
    poses = dead_reckoned(run.steps, run.first_pose)
    unknown = np.broadcast_to(np.eye(3), (len(poses), 3, 3))
    return EstimatedPath(run.steps.times_s, poses, unknown, {}, {}, refused=0, updates=0, warnings=())


SCALES = ("range_scale", "distance_scale", "turn_scale")  # shown as factors: 1.07 if ranges are 7 % too long


def result_data(run: RecordedRun, filter_name: str, track: EstimatedPath, judged: TrackEvaluation) -> dict[str, Any]:
    """The result for JSON; unknown values are None."""
    beacons = aligned_beacons(track, judged.alignment)
    calibration = {name: (value + (name in SCALES), sigma) for name, (value, sigma) in track.calibration.items()}
    nis, nees = judged.nis, judged.nees
    return {
        "dataset": run.name,
        "format": run.kind,
        "filter": filter_name,
        "trajectory_rmse_m": _finite(judged.trajectory_rmse_m),
        "heading_rmse_rad": _finite(judged.heading_rmse_rad),
        "beacon_rmse_m": _finite(judged.beacon_rmse_m),
        "beacons": {name: [fix.x_m, fix.y_m] for name, fix in beacons.items()},
        "beacon_sigmas_m": {name: np.sqrt(np.diag(fix.covariance)).tolist() for name, fix in beacons.items()},
        "beacon_errors_m": dict(judged.beacon_errors_m),
        "moving": {name: _where(one, judged.alignment) for name, one in track.tracks.items()},
        "range_scale": calibration["range_scale"][0] if "range_scale" in calibration else None,
        "range_offset_m": calibration["range_offset_m"][0] if "range_offset_m" in calibration else None,
        "calibration": {name: {"value": value, "sigma": sigma} for name, (value, sigma) in calibration.items()},
        "nis_mean": None if nis is None else nis.mean,
        "nis_band": None if nis is None else [nis.low, nis.high],
        "nees_mean": None if nees is None else nees.mean,
        "delayed": _delayed(run, track),
        "dead_reckoning_rmse_m": _finite(judge(reckoned_track(run), run).trajectory_rmse_m),
        "updates": track.updates,
        "refused": track.refused,
        "update_us_p50": _median_us(track.update_s),
        "predict_us_p50": _median_us(track.predict_s),
        "scalar_us_p50": _median_us(track.scalar_s),
        "warnings": [*run.warnings, *track.warnings],
    }


def _where(one: BeaconTrack, alignment: RigidMotion) -> dict[str, list[Any]]:
    sigmas_m = [np.sqrt(np.diag(alignment.turned(P))).tolist() for P in one.covariances_m2]
    return {"time_s": one.times_s.tolist(), "at_m": alignment.moved(one.places_m).tolist(), "sigma_m": sigmas_m}


def _delayed(run: RecordedRun, track: EstimatedPath) -> dict[str, float | None] | None:
    if track.delayed is None:
        return None
    lag_s, times_s, poses, covariances = track.delayed
    judged = judge(track._replace(times_s=times_s, poses=poses, covariances=covariances), run)
    return {
        "lag_s": lag_s,
        "trajectory_rmse_m": _finite(judged.trajectory_rmse_m),
        "heading_rmse_rad": _finite(judged.heading_rmse_rad),
        "nees_mean": None if judged.nees is None else judged.nees.mean,
    }


def table_lines(run: RecordedRun, data: dict[str, Any]) -> list[str]:
    """The result as lines of text."""
    span_s = run.steps.times_s[-1] - run.steps.times_s[0]
    way_m = float(np.abs(run.steps.distance_m).sum())
    readings = f"{len(run.readings.times_s)} readings of {len(run.beacon_ids)} beacons"
    if run.tags:
        readings += f" by {len(run.tags)} tags"
    rows = [
        ("data", f"{data['dataset']} ({data['format']}): {span_s:.0f} s, {way_m:.0f} m by odometry, {readings}"),
        ("filter", f"{data['filter']}: {data['updates']} updates, {data['refused']} refused"),
        ("path", _errors(data)),
        ("by odometry", _number(data["dead_reckoning_rmse_m"], "{:.3f} m rms, dead reckoning")),
        ("beacons", _number(data["beacon_rmse_m"], "{:.3f} m rms")),
    ]
    if (late := data["delayed"]) is not None:
        rows.insert(3, ("delayed", f"by {late['lag_s']:g} s: {_errors(late)}"))
    rows += [("calibration", f"{name} {c['value']:.5g} +- {c['sigma']:.2g}") for name, c in data["calibration"].items()]
    if data["nis_mean"] is not None:
        low, high = data["nis_band"]
        rows.append(("NIS", f"{data['nis_mean']:.3f} per degree of freedom (95 % band {low:.3f} to {high:.3f})"))
    if data["nees_mean"] is not None:
        meaning = "1 expected; more: errors beyond their covariance"
        rows.append(("NEES", f"{data['nees_mean']:.3f} per degree of freedom ({meaning})"))
    rows.append(("update", _number(data["update_us_p50"], "{:.0f} us a reading") + _parts(data)))
    lines = [f"{name:<12} {text}" for name, text in rows]
    lines += ["", f"{'beacon':<8} {'x_m':>9} {'y_m':>9} {'sigma_x':>8} {'sigma_y':>8} {'error_m':>8}"]
    for name, (x, y) in data["beacons"].items():
        sx, sy = data["beacon_sigmas_m"][name]
        error = _number(data["beacon_errors_m"].get(name), "{:.3f}")
        lines.append(f"{name:<8} {x:9.3f} {y:9.3f} {sx:8.3f} {sy:8.3f} {error:>8}")
    for name, one in data["moving"].items():
        for k in dict.fromkeys((0, -1)) if len(one["time_s"]) > 1 else (0,):
            (x, y), (sx, sy) = one["at_m"][k], one["sigma_m"][k]
            lines.append(f"{name:<8} {x:9.3f} {y:9.3f} {sx:8.3f} {sy:8.3f}  at {one['time_s'][k]:.1f} s")
    return lines


def _errors(data: dict[str, Any]) -> str:
    if data["trajectory_rmse_m"] is None:
        return "no truth"
    heading = _number(data["heading_rmse_rad"], ", heading {:.4f} rad rms")
    return f"{data['trajectory_rmse_m']:.3f} m rms" + ("" if heading == "-" else heading)


def _median_us(times_s: FloatArray) -> float | None:
    return float(np.median(times_s)) * 1e6 if times_s.size else None


def _parts(data: dict[str, Any]) -> str:
    predict_us, scalar_us = data["predict_us_p50"], data["scalar_us_p50"]
    if predict_us is None or scalar_us is None:
        return ""
    return f": prediction {predict_us:.0f} us, each scalar {scalar_us:.0f} us"


def _number(value: Any, shape: str) -> str:
    return "-" if value is None else shape.format(value)


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
