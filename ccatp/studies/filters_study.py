"""The study `filters`: which filter in which world, over whole missions, against the least possible error."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.core import FloatArray
from ccatp.mirror.mirror import build_mirror
from ccatp.report.plots import GRID, INK, QUIET
from ccatp.studies.campaign import Cell, CellResult, Column, Factors, Job, JobOutcome, Study
from ccatp.studies.cramer_rao import bounds_of, rehearse_recorded
from ccatp.studies.mission_study import COLUMN, Histogram, combine_missions, first_arrivals, mission_outcome, nees
from ccatp.studies.results import LIMIT, colour, plot
from ccatp.studies.sil_run import rehearse

WORLDS = ("thesis", "thesis-x2", "hard", "extreme")
FILTERS = ("kf", "ekf", "ukf")
_BOUND_EVERY = 4  # the bounds cost half a mission, and differ little from one run to the next
_SHOWN_MM = (0.01, 300.0)
_LIMIT_MM = 10.0
_DASHES = ("-", "--", ":")  # curves that coincide stay visible


def run_job(job: Job) -> JobOutcome:
    """One mission; of every fourth seed also the bounds along its true way: without and with the accelerometer."""
    if job.seed % _BOUND_EVERY != 1:
        values, arrays = mission_outcome(job.cfg, rehearse(job.cfg, with_track=True))
        return JobOutcome(values, {**arrays, "bounds": np.empty((0, 5))})
    found, record = rehearse_recorded(job.cfg, with_track=True)
    values, arrays = mission_outcome(job.cfg, found)
    mirror = build_mirror(job.cfg.mirror)
    without, with_it = (bounds_of(job.cfg, mirror, record, with_accelerometer=flag) for flag in (False, True))
    bounds = [
        (stop.t_s, float(np.trace(stop.covariance_m2)), float(np.trace(more.covariance_m2)), *stop.error_m)
        for stop, more in zip(without, with_it, strict=True)
        if stop.point is not None
    ]
    return JobOutcome(values, {**arrays, "bounds": np.array(bounds, dtype=np.float64).reshape(-1, 5)})


def combine(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """The missions pooled, and their stop errors beside the bound.

    Array ``bounds``: rows of t (s), the least mean square distance without and with the accelerometer (m^2), error
    x, y (m), shape (k, 5). ``rms_mm`` and ``p50_mm`` of a bound, ``error_rms_mm`` of the same fixes, and their
    ``ratio``; the bound with ``with_accelerometer`` has its own.
    """
    values, arrays = combine_missions(factors, outcomes)
    # At the first point of a run the start errors count: it says little about the filter.
    bounds = np.concatenate([outcome.arrays["bounds"][1:] for outcome in outcomes])
    error_rms_mm = _root_mean(np.sqrt(np.sum(bounds[:, 3:] ** 2, axis=1)) ** 2)
    bound: dict[str, Any] = {
        **_bound(bounds[:, 1], error_rms_mm),
        "error_rms_mm": error_rms_mm,
        "with_accelerometer": _bound(bounds[:, 2], error_rms_mm),
    }
    return JobOutcome({**values, "bound": bound}, {**arrays, "bounds": bounds})


def _bound(squares_m2: FloatArray, error_rms_mm: float | None) -> dict[str, float | None]:
    rms = _root_mean(squares_m2)
    if rms is None or error_rms_mm is None:
        return dict.fromkeys(("rms_mm", "p50_mm", "ratio"))
    median = round(1e3 * float(np.sqrt(np.median(squares_m2))), 4)
    return {"rms_mm": rms, "p50_mm": median, "ratio": round(error_rms_mm / rms, 4)}


def _root_mean(squares_m2: FloatArray) -> float | None:
    return round(1e3 * float(np.sqrt(squares_m2.mean())), 4) if squares_m2.size else None


# -- figures ----------------------------------------------------------------------------------------------------------


def draw(cells: Sequence[CellResult], out: Path) -> None:
    """Exceedance of localization and arrival errors, stop errors beside their bound, consistency."""
    for mirror in dict.fromkeys(str(cell.factors["mirror"]) for cell in cells):
        there = [cell for cell in cells if cell.factors["mirror"] == mirror]
        _draw_exceedance(there, _localization, f"Localization error on {mirror}", out / f"localization-{mirror}")
        _draw_exceedance(there, _arrival, f"First arrival error on {mirror}", out / f"arrival-{mirror}")
        _draw_bound(there, out / f"bound-{mirror}")
        _draw_consistency(there, out / f"consistency-{mirror}")


def _localization(cell: CellResult) -> tuple[FloatArray, FloatArray]:
    return Histogram.from_arrays(cell.arrays, "localization").exceedance()


def _arrival(cell: CellResult) -> tuple[FloatArray, FloatArray]:
    values = np.sort(first_arrivals(cell.arrays["stops"][:, 1:])[:, COLUMN["arrival_m"]])
    return values, 1.0 - np.arange(len(values)) / max(len(values), 1)  # this large or larger: shows the largest


def _draw_exceedance(
    cells: Sequence[CellResult], curve: Callable[[CellResult], tuple[FloatArray, FloatArray]], title: str, stem: Path
) -> None:
    worlds, filters = _levels(cells, "world"), _levels(cells, "filter")
    columns = min(2, len(worlds))
    rows = -(-len(worlds) // columns)
    size = 4.4 * columns, 3.1 * rows + 0.5
    with plot(stem, *size, rows, columns, sharex=True, sharey=True) as (figure, panels):
        lowest = 1.0
        for axes, world in zip(panels, worlds, strict=False):
            for cell in cells:
                if cell.factors["world"] != world:
                    continue
                values, share = curve(cell)
                is_seen = share > 0.0
                lowest = min(lowest, float(share[is_seen].min(initial=1.0)))
                name = str(cell.factors["filter"])
                index = filters.index(name)
                look = {"color": colour(index), "linestyle": _DASHES[index % len(_DASHES)], "linewidth": 1.6}
                axes.loglog(1e3 * values[is_seen], share[is_seen], label=name, **look)
            axes.axvline(_LIMIT_MM, color=LIMIT, linewidth=1.0, linestyle=":")
            axes.set(xlim=_SHOWN_MM, title=f"world {world}")
        for axes in panels[len(worlds) :]:
            axes.set_visible(False)
        panels[0].set_ylim(max(lowest, 1e-6) * 0.8, 1.3)
        panels[0].text(_LIMIT_MM * 1.08, 0.9, "10 mm", color=LIMIT, fontsize=8, va="top")
        figure.supxlabel("error, mm", fontsize=9)
        figure.supylabel("share of all that is as large", fontsize=9)
        figure.suptitle(title, fontsize=11, x=0.02, ha="left")
        labelled = panels[0].get_legend_handles_labels()
        figure.legend(*labelled, loc="outside upper right", ncols=len(filters), frameon=False, fontsize=9)


def _draw_bound(cells: Sequence[CellResult], stem: Path) -> None:
    """Rms error at the stops of each filter, and the bound of each world as a line under it."""
    worlds, filters = _levels(cells, "world"), _levels(cells, "filter")
    known = [cell for cell in cells if cell.values["bound"]["rms_mm"] is not None]
    shown_mm = [cell.values["bound"][name] for cell in known for name in ("rms_mm", "error_rms_mm")] or [1.0]
    with plot(stem, 6.4, 3.8, legend=len(filters) + 2) as (_, (axes,)):
        for cell in known:
            bound = cell.values["bound"]
            at, shade = _place(cell, worlds, filters)
            tight_mm, error_mm, bound_mm = bound["with_accelerometer"]["rms_mm"], bound["error_rms_mm"], bound["rms_mm"]
            axes.plot([at - 0.09, at + 0.09], [bound_mm] * 2, color=INK, linewidth=1.5)
            axes.plot([at - 0.09, at + 0.09], [tight_mm] * 2, color=INK, linewidth=1.0, linestyle=":")
            axes.plot([at, at], [bound_mm, error_mm], color=GRID, linewidth=2.0, zorder=1)
            axes.plot(at, error_mm, "o", color=shade, markersize=6)
            axes.annotate(
                f"{bound['ratio']:.3g}", (at, max(error_mm, bound_mm)), xytext=(0, 7), textcoords="offset points",
                ha="center", fontsize=7, color=QUIET,
            )  # fmt: skip
        for index, name in enumerate(filters):
            axes.plot([], [], "o", color=colour(index), label=name)
        axes.plot([], [], color=INK, linewidth=1.5, label="posterior Cramér-Rao bound")
        axes.plot([], [], color=INK, linewidth=1.0, linestyle=":", label="with the accelerometer")
        axes.set_yscale("log")
        axes.set_ylim(10.0 ** np.floor(np.log10(min(shown_mm))), 10.0 ** np.ceil(np.log10(1.5 * max(shown_mm))))
        axes.set_xticks(range(len(worlds)), worlds)
        axes.set_ylabel("rms position error at the stops, mm")
        axes.set_title("Stop errors and the least possible; numbers: ratio")


def _draw_consistency(cells: Sequence[CellResult], stem: Path) -> None:
    """Normalised errors: the middle 90 % as a bar, the mean as a dot, what a consistent filter has as a line."""
    worlds, filters = _levels(cells, "world"), _levels(cells, "filter")
    shown: tuple[tuple[str, float, Callable[[FloatArray], FloatArray]], ...] = (
        ("NEES of the pose", 3.0, lambda stops: nees(first_arrivals(stops), 3)),
        ("NEES of the position", 2.0, lambda stops: nees(first_arrivals(stops), 2)),
        ("NIS of the fixes", 2.0, lambda stops: stops[:, COLUMN["nis"]]),
    )
    with plot(stem, 9.6, 3.6, 1, len(shown), legend=len(filters), sharey=True) as (_, panels):
        for axes, (title, expected, of) in zip(panels, shown, strict=True):
            for cell in cells:
                at, shade = _place(cell, worlds, filters)
                values = of(cell.arrays["stops"][:, 1:])
                known = values[np.isfinite(values)]
                if known.size:
                    low, high = np.percentile(known, (5.0, 95.0))
                    bar: dict[str, Any] = {"linewidth": 3.0, "alpha": 0.35, "solid_capstyle": "round"}
                    axes.plot([at, at], [max(low, 1e-3), high], color=shade, **bar)
                    axes.plot(at, known.mean(), "o", color=shade, markersize=5)
            axes.axhline(expected, color=LIMIT, linewidth=1.0, linestyle=":")
            axes.set_yscale("log")
            axes.set_xticks(range(len(worlds)), worlds)
            axes.set_title(f"{title} (consistent: {expected:g})")
        for index, name in enumerate(filters):
            panels[0].plot([], [], "o", color=colour(index), label=name)
        panels[0].set_ylabel("mean (dot), 5 to 95 % (bar)")


def _levels(cells: Sequence[CellResult], factor: str) -> list[str]:
    return list(dict.fromkeys(str(cell.factors[factor]) for cell in cells))


def _place(cell: CellResult, worlds: Sequence[str], filters: Sequence[str]) -> tuple[float, str]:
    """Of a filter within its world: x and colour."""
    index = filters.index(str(cell.factors["filter"]))
    return worlds.index(str(cell.factors["world"])) + 0.22 * (index - 0.5 * (len(filters) - 1)), colour(index)


STUDY = Study(
    name="filters",
    title="Filters in four worlds",
    cells=lambda: [
        Cell({"world": world, "filter": name}, {"run.world": world, "run.filter": name})
        for world in WORLDS
        for name in FILTERS
    ],
    run_job=run_job,
    combine=combine,
    columns=(
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
    ),
    draw=draw,
)
