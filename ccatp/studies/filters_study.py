"""Pure. The study `filters`: which filter in which world, over whole missions, against the least possible error."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccatp.mirror.mirror import build_mirror
from ccatp.studies.campaign import Cell, Column, Factors, Job, Outcome, Study
from ccatp.studies.cramer_rao import bounds_of
from ccatp.studies.cramer_rao_record import rehearse_recorded
from ccatp.studies.filters_figures import draw_filters
from ccatp.studies.mission_cell import combine_missions
from ccatp.studies.mission_job import mission_outcome

FloatArray = NDArray[np.float64]

WORLDS = ("thesis", "thesis-x2", "hard", "extreme")
FILTERS = ("kf", "ekf", "ukf")
COLUMNS = (
    Column("complete", "complete"),
    Column("localization mean, mm", "localization_error_mm.mean", ".3f"),
    Column("p99", "localization_error_mm.p99", ".3f"),
    Column("p99.9", "localization_error_mm.p99_9", ".3f"),
    Column("max", "localization_error_mm.max", ".2f"),
    Column("within 10 mm", "localization_error_mm.within_10mm_fraction", ".4%"),
    Column("max after first leg", "localization_error_after_first_leg_mm.max", ".2f"),
    Column("heading rms, mrad", "heading_error_mrad.rms", ".3f"),
    Column("arrival mean, mm", "arrival_error_mm.mean", ".3f"),
    Column("p99", "arrival_error_mm.p99", ".3f"),
    Column("p99.9", "arrival_error_mm.p99_9", ".3f"),
    Column("max", "arrival_error_mm.max", ".2f"),
    Column("first arrivals within 10 mm", "arrival_error_mm.within_10mm_fraction", ".3%"),
    Column("max after first leg", "arrival_error_after_first_leg_mm.max", ".2f"),
    Column("stop error rms, mm", "bound.error_rms_mm", ".3f"),
    Column("bound rms, mm", "bound.rms_mm", ".3f"),
    Column("ratio", "bound.ratio", ".3f"),
    Column("NEES pose (3)", "nees.pose.mean", ".2f"),
    Column("NEES position (2)", "nees.position.mean", ".2f"),
    Column("NIS of fixes (2)", "nis.mean", ".2f"),
    Column("corrections", "corrections"),
    Column("largest distance left, mm", "after_correction_mm.max", ".2f"),
    Column("mission, s", "mission_time_s", ".0f"),
    Column("time / bound", "time_ratio", ".4f"),
    Column("falls", "danger.falls"),
    Column("false edges", "danger.false_edges"),
)


def cells() -> Sequence[Cell]:
    """Worlds times filters."""
    return [
        Cell({"world": world, "filter": name}, {"run.world": world, "run.filter": name})
        for world in WORLDS
        for name in FILTERS
    ]


def run_job(job: Job) -> Outcome:
    """One mission, and the bound along its true way."""
    rehearsal, record = rehearse_recorded(job.cfg, with_track=True)
    values, arrays = mission_outcome(job.cfg, rehearsal)
    bounds = [
        (stop.t_s, *stop.covariance_m2[np.triu_indices(2)].tolist(), *stop.error_m)
        for stop in bounds_of(job.cfg, build_mirror(job.cfg.mirror), record)
        if stop.point is not None
    ]
    return Outcome(values, {**arrays, "bounds": np.array(bounds, dtype=np.float64).reshape(-1, 6)})


def combine(factors: Factors, outcomes: Sequence[Outcome]) -> Outcome:
    """The missions pooled, and their stop errors beside the bound."""
    values, arrays = combine_missions(factors, outcomes)
    # At the first point of a run the start errors count: it says little about the filter.
    bounds = np.concatenate([outcome.arrays["bounds"][1:] for outcome in outcomes])
    return Outcome({**values, "bound": bound_figures(bounds)}, {**arrays, "bounds": bounds})


def bound_figures(bounds: FloatArray) -> dict[str, Any]:
    """Errors and bounds at the fixes.

    Args:
        bounds: rows of t (s), the bound's xx, xy, yy (m^2), error x, y (m), shape (k, 6).

    Returns:
        ``rms_mm`` and ``p50_mm`` of the bound, ``error_rms_mm`` of the same fixes, their ``ratio``.
    """
    if not len(bounds):
        return dict.fromkeys(("rms_mm", "p50_mm", "error_rms_mm", "ratio"))
    least = bounds[:, 1] + bounds[:, 3]
    squares = bounds[:, 4] ** 2 + bounds[:, 5] ** 2
    rms, error = np.sqrt(least.mean()), np.sqrt(squares.mean())
    return {
        "rms_mm": round(float(rms) * 1e3, 4),
        "p50_mm": round(float(np.sqrt(np.median(least))) * 1e3, 4),
        "error_rms_mm": round(float(error) * 1e3, 4),
        "ratio": round(float(error / rms), 4),
    }


STUDY = Study(
    name="filters",
    title="Filters in four worlds",
    cells=cells,
    run_job=run_job,
    combine=combine,
    columns=COLUMNS,
    draw=draw_filters,
)
