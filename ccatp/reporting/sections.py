"""Pure. The sections of a report. Each appears where the run holds what it shows; a new kind of run adds its own."""

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from ccatp.reporting.error_figure import error_figure
from ccatp.reporting.event_section import events_section
from ccatp.reporting.findings import Findings
from ccatp.reporting.html import clock, facts, figure, folded, shown, table, text
from ccatp.reporting.page import Section
from ccatp.reporting.panel_section import panel_section
from ccatp.reporting.path_figure import path_figure, point_text
from ccatp.reporting.points import Grade, PointVerdict, by_panel, counted
from ccatp.reporting.record import WITHIN_MM
from ccatp.reporting.surface_figure import surface_figure
from ccatp.reporting.time_budget import KINDS, START_ANEW
from ccatp.reporting.time_figure import time_figure

_CLASSES = {Grade.GOOD: "pass", Grade.CORRECTED: "corrected", Grade.FAIL: "fail", Grade.SKIPPED: "skipped"}
_SURFACE = "Each panel as fitted; dots show what was measured in the same colours, and vanish where the fit agrees."
_MICRO = 1e6


def map_section(found: Findings) -> Section | None:
    """The mirror with the path and the arrival errors."""
    if not found.points and not found.record.sessions:
        return None
    measured = "as the simulation knows it" if found.record.has_truth else "as the laser measured it"
    caption = f"Distance of the puck from each point when the robot first came to rest there, {measured}."
    return Section("map", "Path and arrivals", figure(partial(path_figure, found.record, found.points), caption))


def points_section(found: Findings) -> Section | None:
    """Pass or fail of each point."""
    if not found.points:
        return None
    count = ", ".join(f"{number} {grade}" for grade, number in counted(found.points).items())
    lead = (
        f"<p>A point passes if it was measured with the puck within {WITHIN_MM:.0f} mm of it at the first arrival; "
        f"corrected: beyond that first, within it when it was measured. <strong>{text(count)}</strong>. "
        "The table shows the distance at the first arrival in mm, column by column the points 1 to 9 of each panel.</p>"
    )
    panels = by_panel(found.points)
    rows = [
        [f"{panel.row}/{panel.col}", *(_point_cell(points.get(number)) for number in range(1, 10))]
        for panel, points in sorted(panels.items())
    ]
    grid = _cells_with_classes(table(["panel", *map(str, range(1, 10))], rows))
    body = lead + _failed(found.points) + (grid if len(rows) <= 12 else folded(f"All {len(rows)} panels", grid))
    return Section("points", "Points: pass or fail", body)


def _point_cell(verdict: PointVerdict | None) -> str:
    if verdict is None:
        return ""
    kind = _CLASSES.get(verdict.grade, "open")
    if verdict.grade in (Grade.SKIPPED, Grade.OPEN):
        return f"@{kind}@{verdict.grade}"
    value = verdict.left_mm if verdict.first_mm is None else verdict.first_mm
    mark = " \u2717" if verdict.grade is Grade.FAIL else ""
    return f"@{kind}@{shown(value)}{mark}"


def _cells_with_classes(markup: str) -> str:
    """``<td>@pass@0.05`` as a cell of that class."""
    for kind in (*_CLASSES.values(), "open"):
        markup = markup.replace(f"<td>@{kind}@", f'<td class="{kind}">')
    return markup


def _failed(points: list[PointVerdict]) -> str:
    never = Counter(v.why or "nobody said why" for v in points if v.grade is Grade.OPEN)
    return "".join(f"<p>{count} not measured: {text(why)}.</p>" for why, count in never.items()) + _one_by_one(points)


def _one_by_one(points: list[PointVerdict]) -> str:
    bad = [v for v in points if v.grade in (Grade.FAIL, Grade.SKIPPED, Grade.CORRECTED)]
    if not bad:
        return ""
    rows = [[point_text(v.point), str(v.grade), shown(v.first_mm), shown(v.left_mm), text(v.why)] for v in bad]
    head = ["point", "grade", "first, mm", "measured at, mm", "why it was left out"]
    return table(head, rows, "texts")


def surface_section(found: Findings) -> Section | None:
    """The deviation of the surface, and the half-wavefront error before and after the moves."""
    alignment = found.alignment
    if alignment is None or not alignment.panels:
        why = "No panel has enough points" if found.record.measured else "No point measured"
        nothing = f"<p>{why}: no surface, no adjuster moves.</p>"
        return Section("surface", "Surface", nothing) if found.points else None
    mirror = found.record.mirror
    title = f"{mirror.name}: deviation of the surface"
    picture = figure(partial(surface_figure, mirror, alignment.panels, title), _SURFACE)
    values = {}
    if alignment.wavefront is not None:
        before, level, after, noise = (shown(_MICRO * value) for value in alignment.wavefront)
        values = {
            "half-wavefront error": f"{before} <small>\u00b5m rms</small>",
            "without its mean": f"{level} <small>\u00b5m rms</small>",
            "after the moves, predicted": f"{after} <small>\u00b5m rms</small>",
            "noise of one point": f"{noise} <small>\u00b5m</small>",
        }
    return Section("surface", "Surface", facts(values) + picture + _against(found))


def _against(found: Findings) -> str:
    known = found.against
    if known is None:
        return ""
    verdict = "inside" if known.agrees else "<strong class='bad'>outside</strong>"
    piston, tilt = shown(_MICRO * known.piston_rms_m), shown(_MICRO * known.tilt_rms_rad)
    return (
        f"<p>Against the simulated misalignment of {known.panels} panels: piston {piston} \u00b5m rms, tip and tilt "
        f"{tilt} \u00b5rad rms; \u03c7\u00b2 {known.chi2:.1f} for {known.dof} degrees of freedom, {verdict} its 99 % "
        f"band of {known.low:.1f} to {known.high:.1f}.</p>"
    )


def time_section(found: Findings) -> Section | None:
    """Where the time went."""
    budget = found.budget
    if budget is None:
        return None
    limit_s = found.record.cfg.run.budget_s
    least = budget.least_s or {}
    rows = []
    for kind in KINDS:
        if kind in budget.spent_s:
            spent = budget.spent_s[kind]
            bound = least.get(kind)
            visits = str(budget.visits[kind]) if budget.visits[kind] else shown(None)
            rows.append([kind, shown(spent, 1), shown(bound, 1), shown(spent - (bound or 0.0), 1), visits])
    bound_s = budget.bound_s
    over = None if bound_s is None else budget.total_s - bound_s
    rows.append(["all", shown(budget.total_s, 1), shown(bound_s, 1), shown(over, 1), ""])
    head = ["", "this run, s", "least, s", "above it, s", "times"]
    notes = (
        [] if bound_s is None else [f"Least: bang-bang from rest to rest and turning in place, for {budget.covers}."]
    )
    if START_ANEW in budget.spent_s:
        notes.append(
            f"While the main loop was started anew nobody counted: the mission time of the summary is without that, "
            f"{shown(budget.mission_s, 1)} s."
        )
    if not budget.is_exact:
        notes.append("The states are sampled from the status, so single rows may be off by some seconds.")
    return Section(
        "time",
        "Time budget",
        figure(partial(time_figure, [("this run", budget)], limit_s), text(" ".join(notes))) + table(head, rows),
    )


def error_section(found: Findings) -> Section | None:
    """How well the robot knew where it was."""
    series, known = found.errors, found.figures
    if series is None:
        return None
    values = {}
    if known is not None:
        values = {
            "mean": f"{known.mean_mm:.3f} <small>mm</small>",
            "99th percentile": f"{known.p99_mm:.3f} <small>mm</small>",
            "largest": f"{known.max_mm:.3f} <small>mm</small>",
            "within 3 \u03c3": f"{100.0 * known.within_sigma3:.2f} <small>% of the frames</small>",
        }
    note = "" if known is not None else "<p>The true pose is not known: three sigma, and what the fixes found.</p>"
    caption = "Each column of the picture spans from the least to the largest value of its time. " + (
        "Dotted: a new session. " if series.breaks_s else ""
    )
    return Section(
        "localization", "Localization error", facts(values) + note + figure(partial(error_figure, series), caption)
    )


def configuration_section(found: Findings) -> Section:
    """Configuration, seed, and files."""
    record = found.record
    cfg = record.cfg
    versions = sorted({session.version for session in record.sessions})
    values = {
        "mirror": text(cfg.mirror.name),
        "seed": text(cfg.run.seed),
        "filter": text(cfg.run.filter),
        "world": text(cfg.world.name) if record.is_simulation else shown(None),
        "order": text(cfg.run.order),
        "ccatp": text(", ".join(versions)) or shown(None),
        "sessions": text(len(record.sessions)),
    }
    body = facts(values) + changes_body(record.changed, record.config_text, record.files)
    return Section("configuration", "Configuration", body)


def changes_body(changed: Mapping[str, tuple[object, object]], config_text: str, files: Mapping[str, int]) -> str:
    """What differs from the shipped configuration; under a line each, all of it, and the files of the run."""
    changes = [[text(key), _value(ours), _value(usual)] for key, (ours, usual) in changed.items()]
    shown_changes = (
        table(["key", "this run", "default"], changes, "texts") if changes else "<p>Everything as shipped.</p>"
    )
    sizes = table(["file", "kB"], [[text(name), shown(size / 1e3, 1)] for name, size in files.items()])
    whole = folded("The whole configuration", f"<pre>{text(config_text)}</pre>") + folded("Files", sizes)
    return f"<h3>Other than the defaults</h3>{shown_changes}{whole}"


def _value(value: Any) -> str:
    return text(value) if value != "" else "(empty)"


SECTIONS: tuple[Callable[[Findings], Section | None], ...] = (
    map_section,
    points_section,
    surface_section,
    panel_section,
    time_section,
    error_section,
    events_section,
    configuration_section,
)
"""In the order of the page. A section that a run has nothing for is left out."""


def sections_of(found: Findings) -> list[Section]:
    """The sections that the run holds something for."""
    return [section for make in SECTIONS if (section := make(found)) is not None]


def duration(found: Findings) -> str:
    """Mission time, and the least it takes."""
    budget = found.budget
    if budget is None:
        return shown(None)
    bound = f" <small>at least {clock(budget.bound_s)}</small>" if budget.bound_s is not None else ""
    return clock(budget.total_s) + bound
