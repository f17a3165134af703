"""Pure. The report of one run: head, sections, and the figures by name."""

from ccatp.drawing.shapes import Picture
from ccatp.reporting.error_figure import error_figure
from ccatp.reporting.findings import Findings
from ccatp.reporting.head import chips, foot, head
from ccatp.reporting.html import WIDE, shown
from ccatp.reporting.page import page
from ccatp.reporting.path_figure import path_figure
from ccatp.reporting.points import Grade
from ccatp.reporting.record import WITHIN_MM, RunRecord
from ccatp.reporting.sections import duration, sections_of
from ccatp.reporting.surface_figure import surface_figure
from ccatp.reporting.time_figure import time_figure

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


def run_figures(found: Findings) -> dict[str, Picture]:
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
