"""The report of a survey: sections of the page, figures by the names of their files, and its values as data.

Lengths of the data in mm, times in s, unless a name says otherwise; null is not known.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from ccatp.mirror.panel_alignment import MirrorWavefront, PanelResult, mirror_wavefront
from ccatp.report.analysis import START_ANEW, TimeBreakdown
from ccatp.report.findings import Findings, Grade, PointVerdict, by_panel, counted
from ccatp.report.html import (
    MICRO,
    Cell,
    Fact,
    Section,
    Table,
    clock_text,
    events_of,
    micro_text,
    number_text,
    page_figure,
    render,
)
from ccatp.report.mirror_map import path_figure, surface_figure
from ccatp.report.plots import WIDE
from ccatp.report.record import WITHIN_MM
from ccatp.report.run_figures import error_figure, time_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FEW = 12
_CLASSES = {
    Grade.GOOD: "pass", Grade.CORRECTED: "corrected", Grade.FAIL: "fail", Grade.SKIPPED: "skipped", Grade.OPEN: "open",
}  # fmt: skip


def run_page(found: Findings) -> str:
    """The report as one HTML file."""
    record = found.record
    sections = [section for make in SECTIONS if (section := make(found)) is not None]
    return render(
        "run.html", f"{record.name}: {record.mirror.name}", sections, found=found, record=record,
        headline=headline(found), within_mm=f"{WITHIN_MM:.0f}",
    )  # fmt: skip


def headline(found: Findings) -> list[Fact]:
    """The values that everybody asks for first; what is not known is left out."""
    values = []
    if found.points:
        measured = sum(verdict.left_mm is not None for verdict in found.points)
        good = sum(verdict.grade is Grade.GOOD for verdict in found.points)
        values.append(Fact("points measured", f"{measured}", f"of {len(found.points)}"))
        values.append(Fact(f"first arrivals within {WITHIN_MM:.0f} mm", f"{good}", f"of {measured} measured"))
        first = [verdict.first_mm for verdict in found.points if verdict.first_mm is not None]
        if first:
            values.append(Fact("arrival error", f"{sum(first) / len(first):.2f}", f"mm mean, {max(first):.2f} largest"))
    if found.figures is not None:
        error = found.figures
        values.append(Fact("localization error", f"{error.mean_mm:.3f}", f"mm mean, {error.max_mm:.2f} largest"))
    if found.budget is not None:
        bound_s = found.budget.bound_s
        least = "" if bound_s is None else f"at least {clock_text(bound_s)}"
        values.append(Fact("time", clock_text(found.budget.total_s), least))
    if found.alignment is not None and found.alignment.wavefront is not None:
        wavefront = found.alignment.wavefront
        after = f"µm rms, {MICRO * wavefront.after_m:.2f} after the moves"
        values.append(Fact("half-wavefront error", f"{MICRO * wavefront.before_m:.1f}", after))
    danger = (found.record.summary or {}).get("danger") or {}
    if danger.get("falls") is not None:
        counts = f"{number_text(danger.get('falls'))}, {number_text(danger.get('false_edges'))}"
        values.append(Fact("falls, false edges", counts))
    return values


# -- sections ---------------------------------------------------------------------------------------------------------


def _map_section(found: Findings) -> Section | None:
    if not found.points and not found.record.sessions:
        return None
    picture = page_figure(partial(path_figure, found.record, found.points))
    return Section("map", "Path and arrivals", {"figure": picture})


def _points_section(found: Findings) -> Section | None:
    if not found.points:
        return None
    rows: list[list[Cell]] = [
        [f"{panel.row}/{panel.col}", *(_point_cell(points.get(number)) for number in range(1, 10))]
        for panel, points in sorted(by_panel(found.points).items())
    ]
    bad = [
        [point_text(v.point), str(v.grade), number_text(v.first_mm), number_text(v.left_mm), v.why]
        for v in found.points
        if v.grade in (Grade.FAIL, Grade.SKIPPED, Grade.CORRECTED)
    ]
    values = {
        "count": ", ".join(f"{number} {grade}" for grade, number in counted(found.points).items()),
        "never": Counter(v.why or "no reason is recorded" for v in found.points if v.grade is Grade.OPEN),
        "bad": Table(["point", "grade", "first, mm", "measured at, mm", "why it was left out"], bad),
        "grid": Table(["panel", *map(str, range(1, 10))], rows),
    }
    return Section("points", "Points: pass or fail", values)


def _point_cell(verdict: PointVerdict | None) -> Cell:
    if verdict is None:
        return ""
    kind = _CLASSES[verdict.grade]
    if verdict.grade in (Grade.SKIPPED, Grade.OPEN):
        return str(verdict.grade), kind
    value = verdict.left_mm if verdict.first_mm is None else verdict.first_mm
    return number_text(value) + (" \u2717" if verdict.grade is Grade.FAIL else ""), kind


def point_text(point: Sequence[int]) -> str:
    """A point as in the commands: row/column/number."""
    return "/".join(map(str, point))


def _surface_section(found: Findings) -> Section | None:
    alignment = found.alignment
    if alignment is None or not alignment.panels:
        return Section("surface", "Surface", {"figure": None}) if found.points else None
    facts = []
    if alignment.wavefront is not None:
        before, level, after, noise = (number_text(MICRO * value) for value in alignment.wavefront)
        facts = [
            Fact("half-wavefront error", before, "µm rms"),
            Fact("without its mean", level, "µm rms"),
            Fact("after the moves, predicted", after, "µm rms"),
            Fact("noise of one point", noise, "µm"),
        ]
    return Section("surface", "Surface", {"figure": page_figure(_surface_drawing(found)), "facts": facts})


def _surface_drawing(found: Findings) -> "Callable[[float], Figure]":
    mirror, alignment = found.record.mirror, found.alignment
    panels = () if alignment is None else alignment.panels
    return partial(surface_figure, mirror, panels, f"{mirror.name}: deviation of the surface")


def _panels_section(found: Findings) -> Section | None:
    alignment = found.alignment
    if alignment is None or not (alignment.panels or alignment.undetermined):
        return None
    worst = sorted(alignment.panels, key=_before_m, reverse=True)[:_FEW]
    values = {
        "panels": _panel_table(alignment.panels) if alignment.panels else None,
        "worst": _panel_table(worst) if len(worst) < len(alignment.panels) else None,
        "others": [f"{one.panel.row}/{one.panel.col}: {one.why}" for one in alignment.undetermined],
    }
    return Section("panels", "Panels and adjusters", values)


def _panel_table(panels: Sequence[PanelResult]) -> Table:
    head = ["panel", "points", "piston, µm", "tip, µrad", "tilt, µrad", "χ²/dof", *panels[0].adjusters]
    remarks = [_remarks(panel) for panel in panels]
    rows = [[*_panel_row(panel), remark] for panel, remark in zip(panels, remarks, strict=True)]
    columns = [*head, "before, µm", "after, µm", "remarks"]
    return Table(columns, rows) if any(remarks) else Table(columns[:-1], [row[:-1] for row in rows])


def _panel_row(panel: PanelResult) -> list[str]:
    wavefront = mirror_wavefront([panel.rigid.wavefront])
    fit = zip(panel.fit.values, panel.fit.sigma, strict=True)
    return [
        f"{panel.panel.row}/{panel.panel.col}",
        str(int(panel.is_kept.sum())),
        *(f"{micro_text(value)} ± {micro_text(sigma)}" for value, sigma in fit),
        f"{panel.fit.chi2:.1f}/{panel.fit.dof}",
        *(micro_text(move) for move in panel.rigid.moves.values_m),
        number_text(None) if wavefront is None else micro_text(wavefront.before_m),
        number_text(None) if wavefront is None else micro_text(wavefront.after_m),
    ]


def _before_m(panel: PanelResult) -> float:
    found = mirror_wavefront([panel.rigid.wavefront])
    return 0.0 if found is None else found.before_m


def _remarks(panel: PanelResult) -> str:
    found = []
    if panel.outliers:
        found.append("left out: " + ", ".join(str(point.point) for point in panel.outliers))
    if panel.shape is not None and panel.shape.is_significant:
        found.append("bent")
    return "; ".join(found)


def _time_section(found: Findings) -> Section | None:
    budget = found.budget
    if budget is None:
        return None
    least = budget.least_s or {}
    rows = []
    for kind, spent in budget.spent_s.items():
        bound, visits = least.get(kind), budget.visits[kind]
        above = number_text(spent - (bound or 0.0), 1)
        rows.append([kind, number_text(spent, 1), number_text(bound, 1), above, number_text(visits or None)])
    bound_s = budget.bound_s
    above = number_text(None if bound_s is None else budget.total_s - bound_s, 1)
    rows.append(["all", number_text(budget.total_s, 1), number_text(bound_s, 1), above, ""])
    notes = (
        [] if bound_s is None else [f"Least: bang-bang from rest to rest and turning in place, for {budget.covers}."]
    )
    if START_ANEW in budget.spent_s:
        notes.append(
            "No mission time is counted while the main loop is restarted: the mission time of the summary is without "
            f"that, {number_text(budget.mission_s, 1)} s."
        )
    if not budget.is_exact:
        notes.append("The states are sampled from the status, so single rows may be off by some seconds.")
    values = {
        "figure": page_figure(partial(time_figure, [("this run", budget)], found.record.cfg.run.budget_s)),
        "budget": Table(["", "this run, s", "least, s", "above it, s", "times"], rows),
        "notes": notes,
    }
    return Section("time", "Time budget", values)


def _error_section(found: Findings) -> Section | None:
    series, known = found.errors, found.figures
    if series is None:
        return None
    facts = []
    if known is not None:
        facts = [
            Fact("mean", f"{known.mean_mm:.3f}", "mm"),
            Fact("99th percentile", f"{known.p99_mm:.3f}", "mm"),
            Fact("largest", f"{known.max_mm:.3f}", "mm"),
            Fact("within 3 \u03c3", f"{100.0 * known.within_sigma3:.2f}", "% of the frames"),
        ]
    values = {"figure": page_figure(partial(error_figure, series)), "facts": facts}
    return Section("localization", "Localization error", values)


def _events_section(found: Findings) -> Section | None:
    lines = found.record.log
    return Section("events", "Events", {"events": events_of(lines)}) if lines else None


def _configuration_section(found: Findings) -> Section:
    record, cfg = found.record, found.record.cfg
    facts = [
        Fact("mirror", cfg.mirror.name),
        Fact("seed", str(cfg.run.seed)),
        Fact("filter", str(cfg.run.filter)),
        Fact("world", cfg.world.name if record.is_simulation else number_text(None)),
        Fact("order", str(cfg.run.order)),
        Fact("ccatp", ", ".join(sorted({session.version for session in record.sessions})) or number_text(None)),
        Fact("sessions", str(len(record.sessions))),
    ]
    return Section("configuration", "Configuration", {"facts": facts})


SECTIONS: tuple[Callable[[Findings], Section | None], ...] = (
    _map_section,
    _points_section,
    _surface_section,
    _panels_section,
    _time_section,
    _error_section,
    _events_section,
    _configuration_section,
)
"""In the order of the page. A section that a run has nothing for is left out."""


# -- figures and data -------------------------------------------------------------------------------------------------


def run_figures(found: Findings) -> "dict[str, Figure]":
    """The figures of the report, by the names of their files."""
    record = found.record
    figures = {"path": path_figure(record, found.points, WIDE)} if found.points or record.sessions else {}
    if found.alignment is not None and found.alignment.panels:
        figures["surface"] = _surface_drawing(found)(WIDE)
    if found.budget is not None:
        figures["time"] = time_figure([("this run", found.budget)], record.cfg.run.budget_s, WIDE)
    if found.errors is not None:
        figures["localization"] = error_figure(found.errors, WIDE)
    return figures


def run_data(found: Findings) -> dict[str, Any]:
    """What ``ccatp report --json`` prints."""
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
    return {name.removesuffix("_m"): round(v * MICRO, 4) for name, v in wavefront._asdict().items()}
