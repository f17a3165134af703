"""The report of one run: head, sections, and the figures by name.

The figures of a report as data. Lengths in mm, times in s, unless a name says otherwise; null is not known.
"""

from typing import Any

from ccatp.mirror.panel_alignment import MirrorWavefront
from ccatp.report.analysis import TimeBreakdown
from ccatp.report.drawing import Drawing
from ccatp.report.findings import Findings, Grade
from ccatp.report.html import WIDE, chips, foot, head, page, shown
from ccatp.report.record import WITHIN_MM, RunRecord
from ccatp.report.run_figures import error_figure, path_figure, surface_figure, time_figure
from ccatp.report.sections import duration, sections_of

_MICRO = 1e6


def run_page(found: Findings) -> str:
    """The report as one HTML file."""
    record = found.record
    return page(f"{record.name}: {record.mirror.name}", _head(found), sections_of(found), foot(record))


def _head(found: Findings) -> str:
    record, title = found.record, f"Survey of {found.record.mirror.name}"
    return head(record, survey_chips(record), title, found.outcome, found.warnings, headline(found))


def survey_chips(record: RunRecord) -> str:
    """What kind of survey it was."""
    return chips(record.is_simulation, f"world {record.cfg.world.name}, seed {record.cfg.run.seed}")


def headline(found: Findings) -> dict[str, str]:
    """The figures that everybody asks for first, as markup; what is not known is left out."""
    values: dict[str, str] = {}
    if found.points:
        measured = sum(verdict.left_mm is not None for verdict in found.points)
        good = sum(verdict.grade is Grade.GOOD for verdict in found.points)
        values["points measured"] = f"{measured} <small>of {len(found.points)}</small>"
        values[f"first arrivals within {WITHIN_MM:.0f} mm"] = f"{good} <small>of {measured} measured</small>"
        first = [verdict.first_mm for verdict in found.points if verdict.first_mm is not None]
        if first:
            mean, most = sum(first) / len(first), max(first)
            values["arrival error"] = f"{mean:.2f} <small>mm mean, {most:.2f} largest</small>"
    if found.figures is not None:
        error = found.figures
        values["localization error"] = f"{error.mean_mm:.3f} <small>mm mean, {error.max_mm:.2f} largest</small>"
    if found.budget is not None:
        values["time"] = duration(found)
    if found.alignment is not None and found.alignment.wavefront is not None:
        wavefront = found.alignment.wavefront
        after = f"<small>\u00b5m rms, {_MICRO * wavefront.after_m:.2f} after the moves</small>"
        values["half-wavefront error"] = f"{_MICRO * wavefront.before_m:.1f} {after}"
    danger = (found.record.summary or {}).get("danger") or {}
    if danger.get("falls") is not None:
        values["falls, false edges"] = f"{shown(danger.get('falls'))}, {shown(danger.get('false_edges'))}"
    return values


def run_figures(found: Findings) -> dict[str, Drawing]:
    """The figures of the report, by the names of their files."""
    record = found.record
    figures = {"path": path_figure(record, found.points, WIDE)} if found.points or record.sessions else {}
    if found.alignment is not None and found.alignment.panels:
        title = f"{record.mirror.name}: deviation of the surface"
        figures["surface"] = surface_figure(record.mirror, found.alignment.panels, title, WIDE)
    if found.budget is not None:
        figures["time"] = time_figure([("this run", found.budget)], record.cfg.run.budget_s, WIDE)
    if found.errors is not None:
        figures["localization"] = error_figure(found.errors, WIDE)
    return figures


def run_data(found: Findings) -> dict[str, Any]:
    """What ``ccatp report --json`` tells."""
    record = found.record
    return {
        "run": record.name,
        "mirror": record.mirror.name,
        "simulation": record.is_simulation,
        "world": record.cfg.world.name if record.is_simulation else None,
        "seed": record.cfg.run.seed,
        "outcome": found.outcome.text,
        "cause": found.outcome.cause,
        "points": {
            "total": len(found.points),
            **{str(grade).replace(" ", "_"): sum(v.grade is grade for v in found.points) for grade in Grade},
        },
        "arrival_error_mm": _spread([v.first_mm for v in found.points if v.first_mm is not None]),
        "localization_error_mm": None if found.figures is None else _rounded(found.figures._asdict()),
        "time_budget_s": None if found.budget is None else budget_data(found.budget),
        "half_wavefront_um": None if found.alignment is None else wavefront_data(found.alignment.wavefront),
        "missing": list(record.missing),
        "warnings": list(record.warnings),
    }


def budget_data(budget: TimeBreakdown) -> dict[str, Any]:
    """A time budget: spent and least times by kind, and their sums."""
    return {
        "spent": _rounded(budget.spent_s),
        "least": None if budget.least_s is None else _rounded(budget.least_s),
        "total": round(budget.total_s, 3),
        "bound": None if budget.bound_s is None else round(budget.bound_s, 3),
        "is_exact": budget.is_exact,
    }


def _spread(values: list[float]) -> dict[str, float] | None:
    return _rounded({"mean": sum(values) / len(values), "max": max(values)}) if values else None


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 6) for name, value in values.items()}


def wavefront_data(wavefront: MirrorWavefront | None) -> dict[str, float] | None:
    """Half-wavefront errors, um; None where there are none."""
    if wavefront is None:
        return None
    return {name.removesuffix("_m"): round(v * _MICRO, 4) for name, v in wavefront._asdict().items()}
