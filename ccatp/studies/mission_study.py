"""A mission as a job, and the statistics of missions that most studies use: estimates, stops, time and danger.

Consistency of a filter: the sum of N independent chi-square values with n degrees of freedom is chi-square with N n
degrees of freedom. So in 95 % of the campaigns the mean of a consistent filter lies between the 2.5 and 97.5 %
quantiles of that distribution divided by N (Bar-Shalom, Li and Kirubarajan 2001, 5.4). The stops are treated as
independent, because a new leg begins after the fix of each stop.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ccatp.config.models import Config
from ccatp.core import FloatArray, IntArray, PointId
from ccatp.filters.metrics import nees, rms
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.records.summary import WITHIN_M, arrival_error_m, distribution, rounded
from ccatp.studies.campaign import Arrays, Factors, Job, JobOutcome
from ccatp.studies.results import chi_square_band
from ccatp.studies.sil_run import SilResult, StopRow, rehearse

# Columns of the array ``stops``: one row for each measurement, in order of time. Errors are true minus estimated, deck
# frame, before the fix; the covariance is that of x, y, heading, upper triangle by rows.
STOP_COLUMNS = (
    "t_s", "row", "col", "point", "approach", "error_x_m", "error_y_m", "error_heading_rad",
    "p_xx", "p_xy", "p_xh", "p_yy", "p_yh", "p_hh", "distance_m", "nis", "fix_distance_m", "arrival_m",
)  # fmt: skip
COLUMN = {name: index for index, name in enumerate(STOP_COLUMNS)}
PER_DECADE = 1000
LEAST = 1e-9  # smaller values fall into the first bin
BINS = 12 * PER_DECADE + 1  # up to a kilometre; larger values fall into the last bin
_T, _X, _Y, _HEADING, _EST_X, _EST_Y, _EST_HEADING = range(7)  # columns of a mission's track
_PARTS = ("mean", "p50", "p99", "p99_9", "max")


@dataclass(frozen=True, slots=True)
class Histogram:
    """Compact distribution of many values in fixed logarithmic bins.

    A mission has half a million localization errors, a campaign hundreds of missions. Bins are 1/1000 of a decade
    wide, so a quantile is accurate to 0.12 %; count, mean, maximum and the share within the limit are exact.
    """

    counts: IntArray  # in each bin, shape (BINS,); bin i ends at LEAST * 10**(i / PER_DECADE)
    total: float  # sum of the values
    largest: float  # 0 without values
    within: int  # number of values that meet the thesis's requirement

    @classmethod
    def of(cls, values: FloatArray) -> "Histogram":
        """The histogram of values, shape (n,). Raises ValueError: a value is negative or not finite."""
        if values.size and not (np.isfinite(values).all() and values.min() >= 0.0):
            raise ValueError(f"values from {values.min()} to {values.max()}: must be finite and not negative")
        places = np.ceil(PER_DECADE * np.log10(np.maximum(values, LEAST) / LEAST)).astype(np.int64)
        counts = np.bincount(np.minimum(places, BINS - 1), minlength=BINS)
        largest, within = float(values.max(initial=0.0)), int(np.count_nonzero(values <= WITHIN_M))
        return cls(counts, float(values.sum()), largest, within)

    @property
    def count(self) -> int:
        """Number of values."""
        return int(self.counts.sum())

    @property
    def mean(self) -> float:
        """Mean of the values; NaN without values."""
        return self.total / self.count if self.count else float("nan")

    def quantile(self, share: float) -> float:
        """The value that this share of the values does not exceed; NaN without values."""
        if not self.count:
            return float("nan")
        place = int(np.searchsorted(np.cumsum(self.counts), share * (self.count - 1), side="right"))
        return min(float(LEAST * 10.0 ** ((place - 0.5) / PER_DECADE)), self.largest)  # the bin's middle

    def exceedance(self) -> tuple[FloatArray, FloatArray]:
        """Upper ends of the bins that are not empty, and the share of larger values, shapes (k,), for a figure."""
        bins = np.flatnonzero(self.counts)
        edges = np.asarray(LEAST * 10.0 ** (bins / PER_DECADE), dtype=np.float64)
        return edges, 1.0 - np.cumsum(self.counts[bins]) / max(self.count, 1)

    def to_arrays(self, name: str) -> dict[str, NDArray[np.generic]]:
        """The histogram as arrays whose names begin with ``name``."""
        figures = np.array([self.total, self.largest, float(self.within)])
        return {f"{name}_counts": self.counts, f"{name}_figures": figures}

    @classmethod
    def from_arrays(cls, arrays: Arrays, name: str) -> "Histogram":
        """The inverse of ``to_arrays``."""
        total, largest, within = arrays[f"{name}_figures"].astype(np.float64).tolist()
        return cls(arrays[f"{name}_counts"].astype(np.int64), total, largest, int(within))


def pooled(parts: Sequence[Histogram]) -> Histogram:
    """Sum of histograms."""
    counts = np.sum([np.zeros(BINS, dtype=np.int64), *(part.counts for part in parts)], axis=0)
    largest = max((part.largest for part in parts), default=0.0)
    return Histogram(counts, sum(part.total for part in parts), largest, sum(part.within for part in parts))


# -- a mission --------------------------------------------------------------------------------------------------------


def run_mission(job: Job) -> JobOutcome:
    """Survey the mirror of the job's configuration."""
    return mission_outcome(job.cfg, rehearse(job.cfg))


def mission_outcome(cfg: Config, found: SilResult) -> JobOutcome:
    """Outcome of a mission that was run with its track: values, error histograms, and the array ``stops``."""
    mirror = build_mirror(cfg.mirror)
    track = found.track
    places = [
        np.column_stack([track[:, x], track[:, y], mirror.surface.heights_m(track[:, x], track[:, y])])
        for x, y in ((_X, _Y), (_EST_X, _EST_Y))
    ]
    squares = (places[0] - places[1]) ** 2
    errors_m = np.sqrt(squares[:, 0] + squares[:, 1] + squares[:, 2])
    turn = track[:, _EST_HEADING] - track[:, _HEADING]
    turns_rad = np.arctan2(np.sin(turn), np.cos(turn))
    first_s = found.stops[0].t_s if found.stops else np.inf
    names = (
        "points", "arrival_error_mm", "localization_error_mm", "mission_time_s", "lower_bound_s", "within_budget",
        "danger", "panels",
    )  # fmt: skip
    values: dict[str, Any] = {
        "outcome": found.outcome,
        "cause": found.cause,
        **{name: found.summary[name] for name in names},
        "heading_error_mrad": {"count": len(turns_rad), "square_sum": float(turns_rad @ turns_rad) * 1e6},
        "corrections": found.corrections,
        "counts": found.counts,
        "states_s": found.states_s,
    }
    arrays = {
        **Histogram.of(errors_m).to_arrays("localization"),
        **Histogram.of(errors_m[track[:, _T] > first_s]).to_arrays("localization_later"),
        "stops": _stop_rows(mirror, cfg.robot.puck_height_m, found.stops, track),
    }
    return JobOutcome(values, arrays)


def _stop_rows(mirror: Mirror, puck_height_m: float, stops: list[StopRow], track: FloatArray) -> FloatArray:
    true = track[np.searchsorted(track[:, _T], [stop.t_s for stop in stops])][:, [_X, _Y]].reshape(-1, 2)
    rows = []
    for stop, place_m in zip(stops, true.tolist(), strict=True):
        arrival_m = arrival_error_m(mirror, PointId(*stop.point), mirror.surface_point(*place_m), puck_height_m)
        rows.append((
            stop.t_s, *stop.point, stop.approach, *stop.error, *stop.covariance[np.triu_indices(3)], stop.distance_m,
            stop.nis, stop.fix_distance_m, arrival_m,
        ))  # fmt: skip
    return np.array(rows, dtype=np.float64).reshape(-1, len(STOP_COLUMNS))


# -- the missions of a cell -------------------------------------------------------------------------------------------


def _nees_figures(stops: FloatArray, states: int) -> dict[str, Any]:
    """NEES of the first ``states`` of x, y, heading, for stops with a positive definite covariance."""
    full = np.empty((len(stops), 3, 3))
    upper = np.triu_indices(3)
    full[:, upper[0], upper[1]] = full[:, upper[1], upper[0]] = stops[:, COLUMN["p_xx"] : COLUMN["p_hh"] + 1]
    errors = stops[:, COLUMN["error_x_m"] : COLUMN["error_x_m"] + states]
    covariances = full[:, :states, :states]
    is_definite = np.linalg.eigvalsh(covariances)[:, 0] > 0.0
    return chi_square_figures(nees(errors[is_definite], covariances[is_definite]), states)


def chi_square_figures(values: FloatArray, freedom: int) -> dict[str, Any]:
    """Comparison of values (k,) with chi-square; values that are not finite are left out.

    Returns ``count``; ``mean`` and ``band_95``, which contains the mean of a consistent filter; ``is_within_band``; 5,
    50 and 95 % quantiles; ``within_95_fraction``, the share below the 95 % quantile of a single value.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        names = ("mean", "band_95", "is_within_band", "p5", "p50", "p95", "within_95_fraction")
        return {"count": 0, **dict.fromkeys(names)}
    low, high = (freedom * end for end in chi_square_band(known.size * freedom))
    mean = float(known.mean())
    return {
        "count": int(known.size),
        "mean": round(mean, 4),
        "band_95": [round(low, 4), round(high, 4)],
        "is_within_band": low <= mean <= high,
        **{f"p{share}": round(float(np.percentile(known, share)), 4) for share in (5, 50, 95)},
        "within_95_fraction": round(float(np.mean(known <= chdtri(freedom, 0.05))), 4),
    }


def combine_missions(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Statistics of a cell from its missions, see ``mission_outcome``."""
    values = [outcome.values for outcome in outcomes]
    runs = [outcome.arrays["stops"] for outcome in outcomes]
    stops = np.concatenate(runs)
    firsts = [first_arrivals(rows) for rows in runs]
    arrivals, later = np.concatenate(firsts), np.concatenate([rows[1:] for rows in firsts])
    everywhere, afterwards = (
        pooled([Histogram.from_arrays(outcome.arrays, name) for outcome in outcomes])
        for name in ("localization", "localization_later")
    )
    turns = [v["heading_error_mrad"] for v in values]
    turn_count = sum(part["count"] for part in turns)
    turn_square = sum(part["square_sum"] for part in turns) / turn_count if turn_count else None
    lasts = np.concatenate([_last_of_each(rows) for rows in runs])
    figures: dict[str, Any] = {
        "complete": sum(v["outcome"] == "complete" for v in values),
        "causes": sorted({v["cause"] for v in values if v["cause"]}),
        "points": sums(v["points"] for v in values),
        "arrival_error_mm": of_values(arrivals[:, COLUMN["arrival_m"]]),
        "arrival_error_after_first_leg_mm": of_values(later[:, COLUMN["arrival_m"]]),
        "localization_error_mm": of_histogram(everywhere),
        "localization_error_after_first_leg_mm": of_histogram(afterwards),
        "heading_error_mrad": {"rms": None if turn_square is None else rounded(np.sqrt(turn_square), 3)},
        "stop_error_mm": {**_stop_errors(arrivals), "after_first_leg": _stop_errors(later)},
        "nees": {"pose": _nees_figures(arrivals, 3), "position": _nees_figures(arrivals, 2)},
        "nis": chi_square_figures(stops[:, COLUMN["nis"]], 2),
        "corrections": sum(v["corrections"] for v in values),
        # Distance of the robot from its points when it left them, by the last fix and true.
        "after_correction_mm": {
            name: _mm(lasts[:, COLUMN[column]].max()) if len(lasts) else None
            for name, column in (("max", "fix_distance_m"), ("true_max", "distance_m"))
        },
        **times(values),
        "danger": dangers(values),
        "panels": {
            name: rounded(rms(np.array([v["panels"][name] for v in values if v["panels"][name] is not None])), 3)
            for name in ("piston_rms_um", "tilt_rms_urad")
        },
        "counts": dict(sum((Counter(v["counts"]) for v in values), Counter[str]())),
    }
    numbers = np.repeat(np.arange(len(runs), dtype=np.float64), [len(rows) for rows in runs])
    arrays = {
        **everywhere.to_arrays("localization"),
        **afterwards.to_arrays("localization_later"),
        "stops": np.column_stack([numbers, stops]),
    }
    return JobOutcome(figures, arrays)


def first_arrivals(stops: FloatArray) -> FloatArray:
    """The first measurement of each point, shape (k, columns)."""
    return stops[stops[:, COLUMN["approach"]] <= 1.0]


def of_values(errors_m: FloatArray) -> dict[str, Any]:
    """Distribution of errors, mm."""
    within = round(float(np.mean(errors_m <= WITHIN_M)), 6) if errors_m.size else None
    return {**distribution(errors_m, _PARTS, scale=1e3, decimals=4), "within_10mm_fraction": within}


def of_histogram(errors_m: Histogram) -> dict[str, Any]:
    """Distribution of pooled errors, mm, as ``of_values``."""
    if not errors_m.count:
        return of_values(np.empty(0))
    figures_m = errors_m.mean, *map(errors_m.quantile, (0.5, 0.99, 0.999)), errors_m.largest
    named = {name: _mm(value) for name, value in zip(_PARTS, figures_m, strict=True)}
    return {**named, "within_10mm_fraction": round(errors_m.within / errors_m.count, 6)}


def rms_and_p50(squares_m2: FloatArray) -> dict[str, float | None]:
    """Root mean square and median of distances, mm; None without values."""
    if not squares_m2.size:
        return {"rms": None, "p50": None}
    return {"rms": _mm(np.sqrt(squares_m2.mean())), "p50": _mm(np.sqrt(np.median(squares_m2)))}


def _stop_errors(rows: FloatArray) -> dict[str, float | None]:
    """Errors of the estimated position at the stops, before the fix, mm."""
    return rms_and_p50(rows[:, COLUMN["error_x_m"]] ** 2 + rows[:, COLUMN["error_y_m"]] ** 2)


def times(values: Sequence[Any]) -> dict[str, Any]:
    """Mission time, its lower bound for the same path, and the time in each state; means over complete missions."""
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


def sums(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Sums of counts over several runs."""
    first, *others = counts
    return {name: sum((other[name] for other in others), start=number) for name, number in first.items()}


def dangers(values: Sequence[Any]) -> dict[str, Any]:
    """Sums over the runs, and the largest overrun."""
    found = [v["danger"] for v in values]
    counts = sums({name: danger[name] for name in ("true_edges", "false_edges", "falls")} for danger in found)
    return {**counts, "max_overrun_mm": max(danger["max_overrun_mm"] for danger in found)}


def _last_of_each(stops: FloatArray) -> FloatArray:
    names = stops[:, [COLUMN["row"], COLUMN["col"], COLUMN["point"]]]
    _, backwards = np.unique(names[::-1], axis=0, return_index=True)
    return stops[::-1][np.sort(backwards)]


def _mm(value_m: Any) -> float:
    return round(float(value_m) * 1e3, 4)
