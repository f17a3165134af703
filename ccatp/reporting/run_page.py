"""Pure. The report of one run: head, sections, and the figures by name."""

from ccatp.drawing.shapes import Picture
from ccatp.reporting.error_figure import error_figure
from ccatp.reporting.findings import Findings
from ccatp.reporting.html import WIDE, facts, shown, text
from ccatp.reporting.page import page
from ccatp.reporting.path_figure import path_figure
from ccatp.reporting.points import Grade
from ccatp.reporting.record import WITHIN_MM, RunRecord
from ccatp.reporting.sections import duration, gaps, sections_of
from ccatp.reporting.surface_figure import surface_figure
from ccatp.reporting.time_figure import time_figure

_MICRO = 1e6


def run_page(found: Findings) -> str:
    """The report as one HTML file."""
    record = found.record
    title = f"{record.name}: {record.mirror.name}"
    foot = f"Made by <code>ccatp report</code> from {text(record.name)}; this file needs nothing else."
    return page(title, _head(found), sections_of(found), foot)


def _head(found: Findings) -> str:
    record, outcome = found.record, found.outcome
    cause = f": {text(outcome.cause)}" if outcome.cause else ""
    began = next((line.wall[:19].replace("T", " ") + " UTC" for line in record.log if line.wall), "")
    return (
        f"{chips(record)}<h1>Survey of {text(record.mirror.name)}</h1>"
        f'<p class="quiet">{text(record.name)}{f", begun {text(began)}" if began else ""}</p>'
        f'<p><strong class="{"good" if outcome.is_good else "bad"}">{text(outcome.text)}</strong>{cause}</p>'
        f"{gaps(found)}{facts(headline(found))}"
    )


def chips(record: RunRecord) -> str:
    """What kind of run it was, so that nobody takes a simulation for the telescope."""
    if record.is_simulation:
        return (
            f'<span class="chip sim">SIMULATION, world {text(record.cfg.world.name)}, seed {record.cfg.run.seed}</span>'
        )
    known = "real robot" if record.is_simulation is False else "robot or simulation: no recording tells"
    return f'<span class="chip">{known}</span>'


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
