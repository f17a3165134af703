"""Pure. The job that most studies share: a mission, and what it says about estimates, stops, time and danger."""

from typing import Any

import numpy as np

from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.samples import FloatArray, PointId, Vector3
from ccatp.studies.campaign import Job, Outcome
from ccatp.studies.rehearsal import rehearse
from ccatp.studies.rehearsal_result import Rehearsal, StopRow
from ccatp.studies.spread import Spread
from ccatp.summary import WITHIN_M, PuckTarget, puck_targets

# Columns of the array ``stops``: one row for each measurement, in the order they were taken. Errors are true minus
# estimated, deck frame, before the fix; the covariance is that of x, y, heading, upper triangle row by row.
STOP_COLUMNS = (
    "t_s", "row", "col", "point", "approach", "error_x_m", "error_y_m", "error_heading_rad",
    "p_xx", "p_xy", "p_xh", "p_yy", "p_yh", "p_hh", "distance_m", "nis", "fix_distance_m", "arrival_m",
)  # fmt: skip
COLUMN = {name: index for index, name in enumerate(STOP_COLUMNS)}
_T, _X, _Y, _HEADING, _EST_X, _EST_Y, _EST_HEADING = range(7)  # columns of a rehearsal's track


def run_mission(job: Job) -> Outcome:
    """Survey the mirror of the job's configuration."""
    rehearsal = rehearse(job.cfg, with_track=True)
    return mission_outcome(job.cfg, rehearsal)


def mission_outcome(cfg: Config, rehearsal: Rehearsal) -> Outcome:
    """What a campaign keeps of a rehearsal that was run with its track."""
    summary, mirror = rehearsal.summary, build_mirror(cfg.mirror)
    track = rehearsal.track if rehearsal.track is not None else np.empty((0, 7))
    errors_m, turns_rad = localization_errors_m(mirror, track), heading_errors_rad(track)
    first_s = rehearsal.stops[0].t_s if rehearsal.stops else np.inf
    is_later = track[:, _T] > first_s
    values: dict[str, Any] = {
        "outcome": rehearsal.outcome,
        "cause": rehearsal.cause,
        "points": summary["points"],
        "arrival_error_mm": summary["arrival_error_mm"],
        "localization_error_mm": summary["localization_error_mm"],
        "heading_error_mrad": {"count": len(turns_rad), "square_sum": float(turns_rad @ turns_rad) * 1e6},
        "mission_time_s": summary["mission_time_s"],
        "lower_bound_s": summary["lower_bound_s"],
        "within_budget": summary["within_budget"],
        "danger": summary["danger"],
        "panels": summary["panels"],
        "corrections": rehearsal.corrections,
        "counts": rehearsal.counts,
        "states_s": rehearsal.states_s,
    }
    arrays = {
        **Spread.of(errors_m, WITHIN_M).to_arrays("localization"),
        **Spread.of(errors_m[is_later], WITHIN_M).to_arrays("localization_later"),
        "stops": stop_rows(mirror, cfg.robot.puck_height_m, rehearsal.stops, track),
    }
    return Outcome(values, arrays)


def localization_errors_m(mirror: Mirror, track: FloatArray) -> FloatArray:
    """Distance between the true and the estimated place on the surface, each row of a track, shape (k,)."""
    heights = [mirror.surface.heights_m(track[:, x], track[:, y]) for x, y in ((_X, _Y), (_EST_X, _EST_Y))]
    return np.sqrt(
        (track[:, _X] - track[:, _EST_X]) ** 2 + (track[:, _Y] - track[:, _EST_Y]) ** 2 + (heights[0] - heights[1]) ** 2
    )


def heading_errors_rad(track: FloatArray) -> FloatArray:
    """Estimated minus true heading, within half a turn, shape (k,)."""
    turn = track[:, _EST_HEADING] - track[:, _HEADING]
    return np.arctan2(np.sin(turn), np.cos(turn))


def stop_rows(mirror: Mirror, puck_height_m: float, stops: list[StopRow], track: FloatArray) -> FloatArray:
    """The measurements as an array, columns ``STOP_COLUMNS``."""
    points = [PointId(*stop.point) for stop in stops]
    targets = puck_targets(mirror, dict.fromkeys(points), puck_height_m)
    true = _true_places(stops, track)
    rows = [
        (
            stop.t_s, *stop.point, stop.approach, *stop.error, *stop.covariance[np.triu_indices(3)],
            stop.distance_m, stop.nis, stop.fix_distance_m, arrival_m(mirror, puck_height_m, targets[point], x, y),
        )
        for stop, point, (x, y) in zip(stops, points, true.tolist(), strict=True)
    ]  # fmt: skip
    return np.array(rows, dtype=np.float64).reshape(-1, len(STOP_COLUMNS))


def arrival_m(mirror: Mirror, puck_height_m: float, target: PuckTarget, x_m: float, y_m: float) -> float:
    """How far the puck of a robot at deck (x, y) is from where it shall be, along the panel, as in a summary."""
    normal: Vector3 = mirror.surface.normal(x_m, y_m)
    puck = np.array(mirror.surface_point(x_m, y_m)) + puck_height_m * np.array(normal)
    offset, across = puck - target.position_m, np.array(target.normal)
    return float(np.linalg.norm(offset - (offset @ across) * across))


def _true_places(stops: list[StopRow], track: FloatArray) -> FloatArray:
    """True deck x, y at the measurements, shape (k, 2)."""
    rows = np.searchsorted(track[:, _T], [stop.t_s for stop in stops])
    return track[rows][:, [_X, _Y]].reshape(-1, 2)
