"""The sections of a report. Each appears where the run holds what it shows; a new kind of run adds its own.

The table of panels: how each lies, and how to turn its adjusters.

What the processes said. Lines that differ in their numbers alone are gathered, so that none hides another.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from ccatp.core import FloatArray
from ccatp.mirror.panel_alignment import PanelResult, mirror_wavefront
from ccatp.records.state_log import LogLine
from ccatp.report.analysis import KINDS, START_ANEW
from ccatp.report.findings import Findings, Grade, PointVerdict, by_panel, counted
from ccatp.report.html import Section, clock, facts, figure, folded, listed, shown, table, text
from ccatp.report.record import WITHIN_MM
from ccatp.report.run_figures import error_figure, path_figure, point_text, surface_figure, time_figure

_MICRO = 1e6
_FEW = 12


def panel_section(found: Findings) -> Section | None:
    """One row a panel."""
    alignment = found.alignment
    if alignment is None or not (alignment.panels or alignment.undetermined):
        return None
    lead = (
        "<p>Piston, tip and tilt with their standard deviations; moves of the vertical adjusters in \u00b5m, positive "
        "towards the robot; half-wavefront error of the panel before and after the moves. All pistons share an "
        f"uncertainty of {_um(found.record.cfg.align.puck_height_sigma_m)} \u00b5m, the puck's height.</p>"
    )
    body = lead
    if alignment.panels:
        names = alignment.panels[0].adjusters
        few = sorted(alignment.panels, key=_before_m, reverse=True)[:_FEW]
        if len(few) < len(alignment.panels):
            whole = folded(f"All {len(alignment.panels)} panels", _table(names, alignment.panels))
            body += "<h3>The furthest from where they should be</h3>" + _table(names, few) + whole
        else:
            body += _table(names, alignment.panels)
    others = [f"{one.panel.row}/{one.panel.col}: {one.why}" for one in alignment.undetermined]
    if others:
        body += folded(f"{len(others)} panels not determined", listed(others))
    return Section("panels", "Panels and adjusters", body)


def _table(names: Sequence[str], panels: Sequence[PanelResult]) -> str:
    head = ["panel", "points", "piston, \u00b5m", "tip, \u00b5rad", "tilt, \u00b5rad", "\u03c7\u00b2/dof"]
    remarks = [_remarks(panel) for panel in panels]
    rows = [[*_row(panel), text(remark)] for panel, remark in zip(panels, remarks, strict=True)]
    columns = [*head, *names, "before, \u00b5m", "after, \u00b5m", "remarks"]
    if not any(remarks):
        return table(columns[:-1], [row[:-1] for row in rows], "dense")
    return table(columns, rows, "dense")


def _row(panel: PanelResult) -> list[str]:
    wavefront = mirror_wavefront([panel.rigid.wavefront])
    before, after = (shown(None),) * 2 if wavefront is None else map(_um, (wavefront.before_m, wavefront.after_m))
    return [
        f"{panel.panel.row}/{panel.panel.col}",
        text(int(panel.is_kept.sum())),
        *_with_sigma(panel.fit.values, panel.fit.sigma),
        f"{panel.fit.chi2:.1f}/{panel.fit.dof}",
        *(_um(move) for move in panel.rigid.moves.values_m),
        before,
        after,
    ]


def _before_m(panel: PanelResult) -> float:
    found = mirror_wavefront([panel.rigid.wavefront])
    return 0.0 if found is None else found.before_m


def _with_sigma(values: FloatArray, sigmas: FloatArray) -> Iterable[str]:
    return (f"{_um(value)} \u00b1 {_um(sigma)}" for value, sigma in zip(values, sigmas, strict=True))


def _um(value: float) -> str:
    return shown(float(value) * _MICRO, 1)


def _remarks(panel: PanelResult) -> str:
    found = []
    if panel.outliers:
        found.append("left out: " + ", ".join(str(point.point) for point in panel.outliers))
    if panel.shape is not None and panel.shape.is_significant:
        found.append("bent")
    return "; ".join(found)


_EVENT_SECTION_FEW = 40
_CLASSES = {"error": "bad", "critical": "bad", "warning": "mid"}
_CALM = ("info", "debug")
# What no reader may miss, at whatever level it was said.
_GRAVE = re.compile(r"(?i)\banew\b|\babort|emergenc|was killed|\bdied\b|link lost|returning to base|interrupted")
# The name of a point or an address is one token; a number may have a fraction.
_TOKEN = re.compile(r"\d+(?:[-/:.]\d+){2,}|\d+(?:\.\d+)?(?:e[+-]?\d+)?")


class Gathered(NamedTuple):
    """Lines of one kind: what they say, how often, and the first and the last of them."""

    text: str
    lines: tuple[LogLine, ...]

    @property
    def rank(self) -> int:
        """0 errors, 1 what no reader may miss, 2 warnings, 3 the rest."""
        first = self.lines[0]
        if _CLASSES.get(first.level) == "bad":
            return 0
        return 1 if _GRAVE.search(first.text) else 3 if first.level in _CALM else 2


def events_section(found: Findings) -> Section | None:
    """What the processes said."""
    lines = found.record.log
    return Section("events", "Events", events_body(lines)) if lines else None


def events_body(lines: Sequence[LogLine]) -> str:
    """Lines of a log: all of few, of many the kinds that matter, the gravest and then the rarest first."""
    whole = table(["robot, s", "UTC", "process", "what"], map(_event, lines), "texts log")
    if len(lines) <= _EVENT_SECTION_FEW:
        return whole
    kinds = sorted((kind for kind in gathered(lines) if kind.rank < 3), key=lambda kind: (kind.rank, len(kind.lines)))
    always = sum(kind.rank < 2 for kind in kinds)
    told = kinds[: max(always, _EVENT_SECTION_FEW)]
    some = table(["first", "last", "times", "process", "what"], map(_kind, told), "texts log") if told else ""
    some = some or "<p>No warnings, no errors.</p>"
    if len(told) < len(kinds):
        some += f"<p>and {len(kinds) - len(told)} more kinds of warnings.</p>"
    return some + folded(f"All {len(lines)} lines", whole)


def gathered(lines: Iterable[LogLine]) -> list[Gathered]:
    """Lines by process, level and text but for its numbers, in the order of their first."""
    kinds: dict[tuple[str, ...], list[LogLine]] = {}
    for line in lines:
        kinds.setdefault((line.process, line.level, *_TOKEN.split(line.text)), []).append(line)
    return [Gathered(_common(alike), tuple(alike)) for alike in kinds.values()]


def _common(lines: Sequence[LogLine]) -> str:
    """The text, each number that varies as the span of its values: the worst of them is one of its ends."""
    first = lines[0].text
    columns = zip(*(_TOKEN.findall(line.text) for line in lines), strict=True)
    spans = iter([_span(values) for values in columns])
    return _TOKEN.sub(lambda _: next(spans), first)


def _span(values: Sequence[str]) -> str:
    found = list(dict.fromkeys(values))
    if len(found) == 1:
        return found[0]
    try:
        return f"{min(found, key=float)} to {max(found, key=float)}"
    except ValueError:
        return f"{found[0]} and {len(found) - 1} other{'s' if len(found) > 2 else ''}"


def _event(line: LogLine) -> list[str]:
    wall = line.wall[11:19] or shown(None)
    return [shown(line.t_s), text(wall), text(line.process), _marked(line.level, line.text)]


def _kind(kind: Gathered) -> list[str]:
    first, last = kind.lines[0], kind.lines[-1]
    times = [_when(first), _when(last), text(len(kind.lines))]
    return [*times, text(first.process), _marked(first.level, kind.text)]


def _when(line: LogLine) -> str:
    return f"{shown(line.t_s)} s" if line.t_s is not None else text(line.wall[11:19]) or shown(None)


def _marked(level: str, words: str) -> str:
    kind = _CLASSES.get(level)
    return (f'<strong class="{kind}">{text(level)}</strong> ' if kind else "") + text(words)


_SECTIONS_CLASSES = {Grade.GOOD: "pass", Grade.CORRECTED: "corrected", Grade.FAIL: "fail", Grade.SKIPPED: "skipped"}
_SURFACE = "Each panel as fitted; dots show what was measured in the same colours, and vanish where the fit agrees."


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
    kind = _SECTIONS_CLASSES.get(verdict.grade, "open")
    if verdict.grade in (Grade.SKIPPED, Grade.OPEN):
        return f"@{kind}@{verdict.grade}"
    value = verdict.left_mm if verdict.first_mm is None else verdict.first_mm
    mark = " \u2717" if verdict.grade is Grade.FAIL else ""
    return f"@{kind}@{shown(value)}{mark}"


def _cells_with_classes(markup: str) -> str:
    for kind in (*_SECTIONS_CLASSES.values(), "open"):
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
