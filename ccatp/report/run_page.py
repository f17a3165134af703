"""The report of a survey: its page, its figures by the names of their files, and its values as data.

Lengths of the data in mm, times in s, unless a name says otherwise; null is not known.
"""

from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ccatp.mirror.panel_alignment import MirrorWavefront, PanelResult, mirror_wavefront
from ccatp.report.beacon_page import beacon_data, beacon_drawings, beacon_page
from ccatp.report.beacon_record import read_beacon_record
from ccatp.report.figures import error_figure, time_figure
from ccatp.report.findings import Findings, Grade, PointVerdict, findings_of
from ccatp.report.html import MICRO, Draw, events_of, page_figures, render, write_page, write_pictures
from ccatp.report.mirror_map import path_figure, surface_figure
from ccatp.report.record import WITHIN_MM, is_beacon_run, read_record

REPORT = "report.html"
_FEW = 12  # panels of a table; more are folded


class Report(NamedTuple):
    """A report that was written."""

    path: Path
    data: dict[str, Any]
    warnings: tuple[str, ...]


def report_run(run_dir: Path, out: Path | None = None, figures: Path | None = None) -> Report:
    """Write the report of a run, by default into its directory, and its figures if a directory is given.

    Raises:
        RunReadError: no run there.
        ConfigError: its configuration cannot be used.
        ReportError: the page cannot be written.
        PictureError: a figure cannot be written.
    """
    path = out or run_dir / REPORT
    if is_beacon_run(run_dir):
        record = read_beacon_record(run_dir)
        markup, data, pictures = beacon_page(record), beacon_data(record), beacon_drawings(record)
        warnings = record.warnings
    else:
        found = findings_of(read_record(run_dir))
        markup, data, pictures = run_page(found), run_data(found), run_drawings(found)
        warnings = found.record.warnings
    write_page(markup, path)
    if figures is not None:
        write_pictures(pictures, figures)
    return Report(path, data, warnings)


def run_page(found: Findings) -> str:
    """The report as one HTML file. A section that a run holds nothing for is left out."""
    record, alignment = found.record, found.alignment
    figures = page_figures(run_drawings(found))
    fitted = () if alignment is None else alignment.panels
    panels = [(panel, mirror_wavefront([panel.rigid.wavefront]), _remarks(panel)) for panel in fitted]
    by_panel: dict[tuple[int, int], dict[int, PointVerdict]] = {}
    for verdict in found.points:
        by_panel.setdefault(verdict.point.panel, {})[verdict.point.point] = verdict
    sections = (
        ("map", "Path and arrivals", "path" in figures),
        ("points", "Points: pass or fail", found.points),
        ("surface", "Surface", found.points or "surface" in figures),
        ("panels", "Panels and adjusters", alignment is not None and (fitted or alignment.undetermined)),
        ("time", "Time budget", found.budget),
        ("localization", "Localization error", found.errors),
        ("events", "Events", record.log),
        ("configuration", "Configuration", True),
    )
    return render(
        "run.html",
        f"{record.name}: {record.mirror.name}",
        sections,
        found=found,
        record=record,
        data=run_data(found),
        figures=figures,
        within_mm=f"{WITHIN_MM:.0f}",
        counts=found.counts,
        never=Counter(verdict.why for verdict in found.points if verdict.grade is Grade.OPEN),
        by_panel=by_panel,
        panels=panels,
        worst=sorted(panels, key=lambda row: row[1].before_m if row[1] else 0.0, reverse=True)[:_FEW],
        few=_FEW,
        wavefront=None if alignment is None else alignment.wavefront,
        events=events_of(record.log),
    )


def _remarks(panel: PanelResult) -> str:
    found = []
    if panel.outliers:
        found.append("left out: " + ", ".join(str(point.point) for point in panel.outliers))
    if panel.shape is not None and panel.shape.is_significant:
        found.append("bent")
    return "; ".join(found)


def run_drawings(found: Findings) -> dict[str, Draw]:
    """What draws each figure of the report, by the names of their files."""
    record, alignment = found.record, found.alignment
    drawings: dict[str, Draw] = {}
    if found.points or record.sessions:
        drawings["path"] = partial(path_figure, record, found.points)
    if alignment is not None and alignment.panels:
        title = f"{record.mirror.name}: deviation of the surface"
        drawings["surface"] = partial(surface_figure, record.mirror, alignment.panels, title)
    if found.budget is not None:
        drawings["time"] = partial(time_figure, [("this run", found.budget)], record.cfg.run.budget_s)
    if found.errors is not None:
        drawings["localization"] = partial(error_figure, found.errors)
    return drawings


def run_data(found: Findings) -> dict[str, Any]:
    """What ``ccatp report --json`` prints."""
    record, budget = found.record, found.budget
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
        "time_budget_s": None
        if budget is None
        else {
            "spent": _rounded(budget.spent_s),
            "least": None if budget.least_s is None else _rounded(budget.least_s),
            "total": round(budget.total_s, 3),
            "bound": None if budget.bound_s is None else round(budget.bound_s, 3),
            "is_exact": budget.is_exact,
        },
        "half_wavefront_um": None if found.alignment is None else wavefront_data(found.alignment.wavefront),
        "missing": list(record.missing),
        "warnings": list(record.warnings),
    }


def _spread(values: list[float]) -> dict[str, float] | None:
    return _rounded({"mean": sum(values) / len(values), "max": max(values)}) if values else None


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 6) for name, value in values.items()}


def wavefront_data(wavefront: MirrorWavefront | None) -> dict[str, float] | None:
    """Half-wavefront errors, um; None where there are none."""
    if wavefront is None:
        return None
    return {name.removesuffix("_m"): round(v * MICRO, 4) for name, v in wavefront._asdict().items()}
