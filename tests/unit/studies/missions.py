"""Made-up outcomes of missions, as workers send them."""

from typing import Any

import numpy as np

from ccatp.records.summary import WITHIN_M
from ccatp.studies.campaign import JobOutcome
from ccatp.studies.mission_study import COLUMN, STOP_COLUMNS, Histogram

SIGMA_M, SIGMA_RAD = 1e-3, 2e-3


def stops_of(errors_m: list[float], approaches: list[int] | None = None) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Stops at the points of one panel in turn, each this far off along x, in truth, in the estimate and at the fix."""
    rows = np.zeros((len(errors_m), len(STOP_COLUMNS)))
    approach = np.array(approaches or [1] * len(errors_m))
    rows[:, COLUMN["t_s"]] = np.arange(len(errors_m))
    rows[:, COLUMN["row"]] = rows[:, COLUMN["col"]] = 1
    rows[:, COLUMN["point"]] = np.cumsum(approach == 1)
    rows[:, COLUMN["approach"]] = approach
    for name in ("error_x_m", "arrival_m", "distance_m", "fix_distance_m"):
        rows[:, COLUMN[name]] = errors_m
    rows[:, COLUMN["nis"]] = (np.array(errors_m) / SIGMA_M) ** 2
    rows[:, [COLUMN["p_xx"], COLUMN["p_yy"]]] = SIGMA_M**2
    rows[:, COLUMN["p_hh"]] = SIGMA_RAD**2
    return rows


def mission(errors_m: list[float], approaches: list[int] | None = None, **changes: Any) -> JobOutcome:
    """A mission whose localization errors are those at its stops."""
    values = {
        "outcome": "complete",
        "cause": "",
        "points": {"total": 9, "measured": 9, "first_arrival_within_10mm": 9, "skipped": 0},
        "heading_error_mrad": {"count": 2, "square_sum": 8.0},
        "mission_time_s": 110.0,
        "lower_bound_s": 100.0,
        "within_budget": True,
        "danger": {"true_edges": 0, "false_edges": 1, "falls": 0, "max_overrun_mm": 0.5},
        "panels": {"count": 1, "piston_rms_um": 3.0, "tilt_rms_urad": None},
        "corrections": sum(a > 1 for a in approaches or []),
        "counts": {"fixes": 9},
        "states_s": {"driving": 60.0, "turning": 50.0, "settling": 5.0, "measuring": 4.0},
        "tour_bound_s": 90.0,
        "budget_s": 3600.0,
        **changes,
    }
    errors = np.array(errors_m)
    arrays = {
        **Histogram.of(errors, WITHIN_M).to_arrays("localization"),
        **Histogram.of(errors[1:], WITHIN_M).to_arrays("localization_later"),
        "stops": stops_of(errors_m, approaches),
        "bounds": np.array([(k, 8e-6, 2e-6, e, 0.0) for k, e in enumerate(errors_m)]),
    }
    return JobOutcome(values, arrays)
