"""Pure. The missions of a cell, pooled: every error of every run counts once."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccatp.samples import FloatArray
from ccatp.studies.campaign import Arrays, Factors, Outcome
from ccatp.studies.consistency import nees_figures, nis_figures
from ccatp.studies.mission_job import COLUMN
from ccatp.studies.spread import Spread, pooled
from ccatp.summary import WITHIN_M


def combine_missions(factors: Factors, outcomes: Sequence[Outcome]) -> Outcome:
    """Figures of a cell out of its missions, see ``mission_job.mission_outcome``."""
    values = [outcome.values for outcome in outcomes]
    stops = np.concatenate([outcome.arrays["stops"] for outcome in outcomes])
    firsts = [first_arrivals(outcome.arrays["stops"]) for outcome in outcomes]
    arrivals, later = np.concatenate(firsts), np.concatenate([rows[1:] for rows in firsts])
    everywhere, afterwards = (
        pooled([Spread.from_arrays(dict(outcome.arrays), name) for outcome in outcomes])
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
    return Outcome(figures, {**arrays, "stops": np.column_stack([_runs(outcomes), stops])})


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


def of_spread(spread: Spread) -> dict[str, Any]:
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
    """The last measurement of each point of one run."""
    names = stops[:, [COLUMN["row"], COLUMN["col"], COLUMN["point"]]]
    _, backwards = np.unique(names[::-1], axis=0, return_index=True)
    return stops[::-1][np.sort(backwards)]


def _runs(outcomes: Sequence[Outcome]) -> FloatArray:
    return np.repeat(np.arange(len(outcomes), dtype=np.float64), [len(outcome.arrays["stops"]) for outcome in outcomes])


def _heading_rms(parts: Sequence[Any]) -> float | None:
    count = sum(part["count"] for part in parts)
    return round(float(np.sqrt(sum(part["square_sum"] for part in parts) / count)), 3) if count else None


def _rms(values: Sequence[float]) -> float | None:
    return round(float(np.sqrt(np.mean(np.square(values)))), 3) if values else None


def _mm(value_m: Any) -> float:
    return round(float(value_m) * 1e3, 4)


def spread_of(arrays: Arrays, name: str) -> Spread:
    """A spread out of the arrays of a cell."""
    return Spread.from_arrays(dict(arrays), name)
