"""The reports of runs; that of a survey: page, figures by the names of their files, and values as data.

Data of a survey have lengths in mm and times in s, unless a name has another unit; null means not known.
"""

from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from ccatp.config.files import write_file
from ccatp.mirror.panel_alignment import MirrorWavefront, PanelResult, mirror_wavefront
from ccatp.records.run_reader import RunReadError
from ccatp.report import figures
from ccatp.report.alignment import places_of, worst_corner
from ccatp.report.findings import Findings, Grade, coverage_of, findings_of, observation_of
from ccatp.report.html import MICRO, Draw, RunReport, environment, events_of, page_figures, write_pictures
from ccatp.report.mirror_map import path_figure, surface_figure
from ccatp.report.network import air_text, network_data, sentence, undetermined_text
from ccatp.report.plots import check_drawing
from ccatp.report.record import WITHIN_MM, kind_of_run, read_record
from ccatp.report.tables import write_tables

REPORT = "report.html"
PAGE_MODE = 0o644
_PAGE = environment().get_template("run.html")  # compiled here: while the robot drives, if a run draws its report
_FEW = 12  # panels of a table; a longer table is folded


def report_run(
    run_dir: Path, out: Path | None = None, figures_dir: Path | None = None, tables_dir: Path | None = None
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Write the report of a run, by default into its directory, its figures and tables if directories are given.

    Returns the output of ``ccatp report --json``, and warnings. RunReadError: no run, or no survey for the tables;
    ConfigError: its configuration cannot be used, or the page or a table cannot be written; PictureError: a figure.
    """
    path = out or run_dir / REPORT
    for folder in filter(None, (figures_dir, tables_dir)):
        check_drawing(folder)
    kind = kind_of_run(run_dir)
    if kind.report is None:
        raise RunReadError(f"{run_dir}: a {kind.title} has no report; its result is in summary.json")
    make: Callable[[Path], RunReport] = kind.report.get()
    report = make(run_dir)
    if tables_dir is not None:
        if report.write_tables is None:
            raise RunReadError(f"{run_dir}: a {kind.title} has no tables; leave out --tables")
        report.write_tables(tables_dir)
    write_file(path, report.markup, PAGE_MODE)
    if figures_dir is not None:
        write_pictures(report.drawings, figures_dir)
    return {"report": str(path), **report.data}, report.warnings


def survey_report(run_dir: Path) -> RunReport:
    """The report of a survey; errors as of ``read_record``."""
    found = findings_of(read_record(run_dir))
    warnings = tuple(found.record.warnings)
    return RunReport(run_page(found), run_data(found), run_drawings(found), warnings, partial(write_tables, found))


def run_page(found: Findings) -> str:
    """The report as one HTML file. A section without data is left out."""
    record, fitted = found.record, () if found.alignment is None else found.alignment.panels
    panels = [
        (panel, mirror_wavefront([panel.rigid.wavefront]), worst_corner(record.mirror, panel), _remarks(panel))
        for panel in fitted
    ]
    return _PAGE.render(
        found=found,
        record=record,
        alignment=found.alignment,
        data=run_data(found),
        network=sentence(found.network) if found.record.measured else "",
        network_more=f"{air_text(found.network)} {undetermined_text(found.network)}".strip(),
        figures=page_figures(run_drawings(found)),
        within_mm=f"{WITHIN_MM:.0f}",
        never=Counter(verdict.why for verdict in found.points if verdict.grade is Grade.OPEN),
        panels=panels,
        bent=[panel for panel in fitted if panel.bending is not None and panel.explained.has_shape],
        places=places_of(record.mirror, [panel.panel for panel in fitted]),
        worst=sorted(panels, key=lambda row: abs(row[2][0]), reverse=True)[:_FEW],
        few=_FEW,
        events=events_of(record.log),
    )


def _remarks(panel: PanelResult) -> str:
    left_out = ", ".join(str(point.point) for point in panel.outliers)
    is_bent = panel.shape is not None and panel.shape.is_significant
    again = f"undecided: measure {panel.deciding.point} again" if panel.deciding is not None else ""
    return "; ".join(filter(None, (again, left_out and f"not used: {left_out}", "bent" if is_bent else "")))


def run_drawings(found: Findings) -> dict[str, Draw]:
    """Functions that draw the figures of the report, by file name."""
    record, alignment = found.record, found.alignment
    drawings: dict[str, Draw] = {}
    if found.points or record.sessions:
        drawings["path"] = partial(path_figure, record, found.points)
    if alignment is not None and alignment.panels:
        title = f"{record.mirror.name}: deviation of the surface"
        drawings["surface"] = partial(surface_figure, record.mirror, alignment.panels, title)
    if found.budget is not None:
        drawings["time"] = partial(figures.time_figure, [("this run", found.budget)], record.cfg.run.budget_s)
    if found.errors is not None:
        drawings["localization"] = partial(figures.error_figure, found.errors)
    return drawings


def run_data(found: Findings) -> dict[str, Any]:
    """Data of a survey in the output of ``ccatp report --json``."""
    record, budget = found.record, found.budget
    first = [one.first_mm for one in found.points if one.first_mm is not None]
    return {
        "run": record.name,
        "mirror": record.mirror.name,
        "simulation": record.is_simulation,
        "world": record.cfg.world.name if record.is_simulation else None,
        "seed": record.cfg.run.seed,
        "outcome": found.outcome.text,
        "cause": found.outcome.cause,
        "alarms_at_end": [{"name": one.name, "severity": one.severity} for one in found.outcome.alarms],
        "observation": observation_of(record),
        "coverage": coverage_of(found),
        "points": {
            "total": len(found.points),
            **{str(grade).replace(" ", "_"): sum(v.grade is grade for v in found.points) for grade in Grade},
        },
        "arrival_error_mm": _rounded({"mean": sum(first) / len(first), "max": max(first)}) if first else None,
        "localization_error_mm": found.figures and _rounded(found.figures),
        "time_budget_s": budget
        and {
            "spent": _rounded(budget.spent_s),
            "least": budget.least_s and _rounded(budget.least_s),
            "total": round(budget.total_s, 3),
            "bound": None if budget.bound_s is None else round(budget.bound_s, 3),
            "is_exact": budget.is_exact,
        },
        "half_wavefront_um": found.alignment and wavefront_data(found.alignment.wavefront),
        "network": network_data(found.network),
        "missing": list(record.missing),
        "warnings": list(record.warnings),
    }


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 6) for name, value in values.items()}


def wavefront_data(wavefront: MirrorWavefront | None) -> dict[str, float] | None:
    """Half-wavefront errors, um; None if there are none."""
    return wavefront and {name.removesuffix("_m"): round(v * MICRO, 4) for name, v in wavefront._asdict().items()}
