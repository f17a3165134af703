"""Pure. The study `filters`: which filter in which world, over whole missions, against the least possible error."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ccatp.mirror.mirror import build_mirror
from ccatp.samples import FloatArray
from ccatp.studies.campaign import Cell, Column, Factors, Job, Outcome, Study
from ccatp.studies.cramer_rao import bounds_of
from ccatp.studies.cramer_rao_record import rehearse_recorded
from ccatp.studies.filters_figures import draw_filters
from ccatp.studies.mission_cell import combine_missions
from ccatp.studies.mission_job import mission_outcome
from ccatp.studies.rehearsal import rehearse

WORLDS = ("thesis", "thesis-x2", "hard", "extreme")
FILTERS = ("kf", "ekf", "ukf")
_BOUND_COLUMNS = 5
_BOUND_EVERY = 4  # the bounds cost half a mission, and differ little from one run to the next
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
    Column("bound with accelerometer", "bound.with_accelerometer.rms_mm", ".3f"),
    Column("ratio", "bound.with_accelerometer.ratio", ".3f"),
    Column("NEES pose (3)", "nees.pose.mean", ".2f"),
    Column("95 % band", "nees.pose.band_95", ".2f"),
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
    """One mission; of every fourth seed also the bounds along its true way: without and with the accelerometer."""
    if job.seed % _BOUND_EVERY != 1:
        values, arrays = mission_outcome(job.cfg, rehearse(job.cfg, with_track=True))
        return Outcome(values, {**arrays, "bounds": np.empty((0, _BOUND_COLUMNS))})
    rehearsal, record = rehearse_recorded(job.cfg, with_track=True)
    values, arrays = mission_outcome(job.cfg, rehearsal)
    mirror = build_mirror(job.cfg.mirror)
    without, with_it = (bounds_of(job.cfg, mirror, record, with_accelerometer=flag) for flag in (False, True))
    bounds = [
        (stop.t_s, float(np.trace(stop.covariance_m2)), float(np.trace(more.covariance_m2)), *stop.error_m)
        for stop, more in zip(without, with_it, strict=True)
        if stop.point is not None
    ]
    return Outcome(values, {**arrays, "bounds": np.array(bounds, dtype=np.float64).reshape(-1, _BOUND_COLUMNS)})


def combine(factors: Factors, outcomes: Sequence[Outcome]) -> Outcome:
    """The missions pooled, and their stop errors beside the bound."""
    values, arrays = combine_missions(factors, outcomes)
    # At the first point of a run the start errors count: it says little about the filter.
    bounds = np.concatenate([outcome.arrays["bounds"][1:] for outcome in outcomes])
    return Outcome({**values, "bound": bound_figures(bounds)}, {**arrays, "bounds": bounds})


def bound_figures(bounds: FloatArray) -> dict[str, Any]:
    """Errors and bounds at the fixes.

    Args:
        bounds: rows of t (s), the least mean square distance without and with the accelerometer (m^2), error x, y (m),
            shape (k, 5).

    Returns:
        ``rms_mm`` and ``p50_mm`` of the bound, ``error_rms_mm`` of the same fixes, their ``ratio``; the bound with
        ``with_accelerometer`` has its own.
    """
    error = np.sqrt(np.sum(bounds[:, 3:] ** 2, axis=1))
    rms = _root_mean(error**2)
    return {
        **_bound(bounds[:, 1], rms),
        "error_rms_mm": rms,
        "with_accelerometer": _bound(bounds[:, 2], rms),
    }


def _bound(squares_m2: FloatArray, error_rms_mm: float | None) -> dict[str, float | None]:
    rms = _root_mean(squares_m2)
    if rms is None or error_rms_mm is None:
        return dict.fromkeys(("rms_mm", "p50_mm", "ratio"))
    median = round(1e3 * float(np.sqrt(np.median(squares_m2))), 4)
    return {"rms_mm": rms, "p50_mm": median, "ratio": round(error_rms_mm / rms, 4)}


def _root_mean(squares_m2: FloatArray) -> float | None:
    return round(1e3 * float(np.sqrt(squares_m2.mean())), 4) if squares_m2.size else None


STUDY = Study(
    name="filters",
    title="Filters in four worlds",
    cells=cells,
    run_job=run_job,
    combine=combine,
    columns=COLUMNS,
    draw=draw_filters,
)
