"""The missions of a cell, pooled: every error of every run counts once.

The job that most studies share: a mission, and what it says about estimates, stops, time and danger.

Whether a filter knows how wrong it is: normalised errors at the stops and innovations of the fixes.

The mean of N values that follow chi-square with n degrees of freedom is n, and N times it follows chi-square with N n:
between its 2.5 and 97.5 % quantiles over N the mean of a consistent filter lies in 95 % of the campaigns (Bar-Shalom,
Li and Kirubarajan 2001, 5.4). The stops count as independent: each begins a leg of its own after its fix.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ccatp.config.models import Config
from ccatp.core import FloatArray, PointId, Vector3
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.records.summary import WITHIN_M, PuckTarget, puck_targets
from ccatp.studies.campaign import Arrays, Factors, Histogram, Job, JobOutcome, pooled
from ccatp.studies.sil_models import SilResult, StopRow
from ccatp.studies.sil_run import rehearse

# Columns of the array ``stops``: one row for each measurement, in the order they were taken. Errors are true minus
# estimated, deck frame, before the fix; the covariance is that of x, y, heading, upper triangle row by row.
STOP_COLUMNS = (
    "t_s", "row", "col", "point", "approach", "error_x_m", "error_y_m", "error_heading_rad",
    "p_xx", "p_xy", "p_xh", "p_yy", "p_yh", "p_hh", "distance_m", "nis", "fix_distance_m", "arrival_m",
)  # fmt: skip
COLUMN = {name: index for index, name in enumerate(STOP_COLUMNS)}
_T, _X, _Y, _HEADING, _EST_X, _EST_Y, _EST_HEADING = range(7)  # columns of a rehearsal's track


def run_mission(job: Job) -> JobOutcome:
    """Survey the mirror of the job's configuration."""
    rehearsal = rehearse(job.cfg, with_track=True)
    return mission_outcome(job.cfg, rehearsal)


def mission_outcome(cfg: Config, rehearsal: SilResult) -> JobOutcome:
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
        **Histogram.of(errors_m, WITHIN_M).to_arrays("localization"),
        **Histogram.of(errors_m[is_later], WITHIN_M).to_arrays("localization_later"),
        "stops": stop_rows(mirror, cfg.robot.puck_height_m, rehearsal.stops, track),
    }
    return JobOutcome(values, arrays)


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


_POSE = [COLUMN["error_x_m"], COLUMN["error_y_m"], COLUMN["error_heading_rad"]]
_UPPER = [COLUMN[name] for name in ("p_xx", "p_xy", "p_xh", "p_yy", "p_yh", "p_hh")]
POSE, POSITION = 3, 2  # degrees of freedom


def nees(rows: FloatArray, states: int) -> FloatArray:
    """Normalised estimation error squared, e' P^-1 e, of the first ``states`` of x, y, heading, shape (k,).

    Args:
        rows: stops, columns ``mission_job.STOP_COLUMNS``.
        states: 3 for the pose, 2 for the position.

    Returns:
        NaN where the covariance is not positive definite.
    """
    full = np.empty((len(rows), 3, 3))
    upper = np.triu_indices(3)
    full[:, upper[0], upper[1]] = full[:, upper[1], upper[0]] = rows[:, _UPPER]
    result = np.full(len(rows), np.nan)
    for k, covariance in enumerate(full[:, :states, :states]):
        error = rows[k, _POSE[:states]]
        try:
            half = np.linalg.solve(np.linalg.cholesky(covariance), error)
        except np.linalg.LinAlgError:
            continue
        result[k] = half @ half
    return result


def nees_figures(rows: FloatArray) -> dict[str, Any]:
    """Normalised errors of pose and position at the stops; see ``chi_square_figures``."""
    return {
        "pose": chi_square_figures(nees(rows, POSE), POSE),
        "position": chi_square_figures(nees(rows, POSITION), POSITION),
    }


def nis_figures(rows: FloatArray) -> dict[str, Any]:
    """Normalised innovations squared of the fixes; see ``chi_square_figures``."""
    return chi_square_figures(rows[:, COLUMN["nis"]], POSITION)


def chi_square_figures(values: FloatArray, freedom: int) -> dict[str, Any]:
    """How values compare with chi-square; those that are not finite are left out.

    Args:
        values: shape (k,).

    Returns:
        ``count``; ``mean`` and ``band_95``, in which that of a consistent filter lies; ``is_within_band``; ``p50``;
        ``within_95_fraction``, the share below the 95 % quantile of a single value.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        nothing = dict.fromkeys(("mean", "band_95", "is_within_band", "p50", "within_95_fraction"))
        return {"count": 0, **nothing}
    total = known.size * freedom
    low, high = (float(chdtri(total, tail)) / known.size for tail in (0.975, 0.025))
    mean = float(known.mean())
    return {
        "count": int(known.size),
        "mean": round(mean, 4),
        "band_95": [round(low, 4), round(high, 4)],
        "is_within_band": low <= mean <= high,
        "p50": round(float(np.median(known)), 4),
        "within_95_fraction": round(float(np.mean(known <= chdtri(freedom, 0.05))), 4),
    }


def combine_missions(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Figures of a cell out of its missions, see ``mission_job.mission_outcome``."""
    values = [outcome.values for outcome in outcomes]
    stops = np.concatenate([outcome.arrays["stops"] for outcome in outcomes])
    firsts = [first_arrivals(outcome.arrays["stops"]) for outcome in outcomes]
    arrivals, later = np.concatenate(firsts), np.concatenate([rows[1:] for rows in firsts])
    everywhere, afterwards = (
        pooled([Histogram.from_arrays(dict(outcome.arrays), name) for outcome in outcomes])
        for name in ("localization", "localization_later")
    )
    figures: dict[str, Any] = {
        "complete": sum(v["outcome"] == "complete" for v in values),
        "causes": sorted({v["cause"] for v in values if v["cause"]}),
        "points": {name: sum(v["points"][name] for v in values) for name in values[0]["points"]},
        "arrival_error_mm": of_values(arrivals[:, COLUMN["arrival_m"]]),
        "arrival_error_after_first_leg_mm": of_values(later[:, COLUMN["arrival_m"]]),
        "localization_error_mm": of_spread(everywhere),
        "localization_error_after_first_leg_mm": of_spread(afterwards),
        "heading_error_mrad": {"rms": _heading_rms([v["heading_error_mrad"] for v in values])},
        "stop_error_mm": {**stop_errors(arrivals), "after_first_leg": stop_errors(later)},
        "nees": nees_figures(arrivals),
        "nis": nis_figures(stops),
        "corrections": sum(v["corrections"] for v in values),
        "after_correction_mm": after_corrections([outcome.arrays["stops"] for outcome in outcomes]),
        **times(values),
        "danger": dangers([v["danger"] for v in values]),
        "panels": {
            name: _rms([v["panels"][name] for v in values if v["panels"][name] is not None])
            for name in ("piston_rms_um", "tilt_rms_urad")
        },
        "counts": {name: sum(v["counts"].get(name, 0) for v in values) for name in values[0]["counts"]},
    }
    arrays: dict[str, NDArray[Any]] = {
        **everywhere.to_arrays("localization"),
        **afterwards.to_arrays("localization_later"),
    }
    return JobOutcome(figures, {**arrays, "stops": np.column_stack([_runs(outcomes), stops])})


def first_arrivals(stops: FloatArray) -> FloatArray:
    """The first measurement of each point, shape (k, columns)."""
    return stops[stops[:, COLUMN["approach"]] <= 1.0]


def of_values(errors_m: FloatArray) -> dict[str, Any]:
    """Distribution of some errors, mm."""
    if not errors_m.size:
        return {"mean": None, "p50": None, "p99": None, "p99_9": None, "max": None, "within_10mm_fraction": None}
    p50, p99, p99_9 = np.percentile(errors_m, (50.0, 99.0, 99.9))
    figures = {"mean": errors_m.mean(), "p50": p50, "p99": p99, "p99_9": p99_9, "max": errors_m.max()}
    within = round(float(np.mean(errors_m <= WITHIN_M)), 6)
    return {**{name: _mm(value) for name, value in figures.items()}, "within_10mm_fraction": within}


def of_spread(spread: Histogram) -> dict[str, Any]:
    """The same of a pooled spread."""
    if not spread.count:
        return of_values(np.empty(0))
    shares = {"p50": 0.5, "p99": 0.99, "p99_9": 0.999}
    quantiles = {name: _mm(spread.quantile(share)) for name, share in shares.items()}
    within = round(spread.within / spread.count, 6)
    return {"mean": _mm(spread.mean), **quantiles, "max": _mm(spread.largest), "within_10mm_fraction": within}


def stop_errors(rows: FloatArray) -> dict[str, Any]:
    """Error of the estimated position at the stops, before the fix: rms and median, mm."""
    squares = rows[:, COLUMN["error_x_m"]] ** 2 + rows[:, COLUMN["error_y_m"]] ** 2
    if not squares.size:
        return {"rms": None, "p50": None}
    return {"rms": _mm(np.sqrt(squares.mean())), "p50": _mm(np.sqrt(np.median(squares)))}


def after_corrections(runs: Sequence[FloatArray]) -> dict[str, Any]:
    """Distance of the robot from its points when it left them, as the last fix shows it and in truth, mm."""
    lasts = [_last_of_each(stops) for stops in runs]
    last = np.concatenate(lasts)
    if not len(last):
        return {"max": None, "true_max": None}
    seen_m, true_m = (last[:, COLUMN[name]].max() for name in ("fix_distance_m", "distance_m"))
    return {"max": _mm(seen_m), "true_max": _mm(true_m)}


def times(values: Sequence[Any]) -> dict[str, Any]:
    """Mission time against the bound of the same path, and where the time goes; means over complete missions."""
    complete = [v for v in values if v["outcome"] == "complete"]
    if not complete:
        names = ("mission_time_s", "mission_time_max_s", "lower_bound_s", "time_ratio", "within_budget", "states_s")
        return dict.fromkeys(names)
    time_s = np.array([v["mission_time_s"] for v in complete])
    bound_s = np.array([v["lower_bound_s"] for v in complete])
    states = sorted({state for v in complete for state in v["states_s"]})
    return {
        "mission_time_s": round(float(time_s.mean()), 3),
        "mission_time_max_s": round(float(time_s.max()), 3),
        "lower_bound_s": round(float(bound_s.mean()), 3),
        "time_ratio": round(float((time_s / bound_s).mean()), 5),
        "within_budget": sum(bool(v["within_budget"]) for v in complete),
        "states_s": {s: round(float(np.mean([v["states_s"].get(s, 0.0) for v in complete])), 3) for s in states},
    }


def dangers(values: Sequence[Any]) -> dict[str, Any]:
    """Sums over the runs; the overrun is the largest."""
    sums = {name: sum(v[name] for v in values) for name in ("true_edges", "false_edges", "falls")}
    return {**sums, "max_overrun_mm": max(v["max_overrun_mm"] for v in values)}


def _last_of_each(stops: FloatArray) -> FloatArray:
    names = stops[:, [COLUMN["row"], COLUMN["col"], COLUMN["point"]]]
    _, backwards = np.unique(names[::-1], axis=0, return_index=True)
    return stops[::-1][np.sort(backwards)]


def _runs(outcomes: Sequence[JobOutcome]) -> FloatArray:
    return np.repeat(np.arange(len(outcomes), dtype=np.float64), [len(outcome.arrays["stops"]) for outcome in outcomes])


def _heading_rms(parts: Sequence[Any]) -> float | None:
    count = sum(part["count"] for part in parts)
    return round(float(np.sqrt(sum(part["square_sum"] for part in parts) / count)), 3) if count else None


def _rms(values: Sequence[float]) -> float | None:
    return round(float(np.sqrt(np.mean(np.square(values)))), 3) if values else None


def _mm(value_m: Any) -> float:
    return round(float(value_m) * 1e3, 4)


def spread_of(arrays: Arrays, name: str) -> Histogram:
    """A spread out of the arrays of a cell."""
    return Histogram.from_arrays(dict(arrays), name)
