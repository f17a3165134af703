"""The page of two runs beside each other: figures, configuration, time, errors, events, and their mirror.

Two runs on one mirror: their paths, the points that ended otherwise, surfaces, panels, adjusters.

Two runs beside each other for a terminal, and as data.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from ccatp.core import PanelId
from ccatp.mirror.panel_alignment import PanelResult
from ccatp.report.compare import (
    Draw,
    PanelChange,
    RunPair,
    change_figure,
    compared_figures,
    distribution_figure,
    errors_figure,
    paths_figure,
)
from ccatp.report.drawing import Drawing
from ccatp.report.findings import Findings
from ccatp.report.html import NARROW, WIDE, Section, beside, figure, folded, gaps, page, shown, table, text
from ccatp.report.record import changed_keys
from ccatp.report.run_figures import point_text, surface_figure, time_figure
from ccatp.report.run_page import run_data, survey_chips, wavefront_data
from ccatp.report.sections import events_body

_MICRO = 1e6
_FEW = 12


def paths_section(pair: RunPair) -> Section | None:
    """The mirror with both paths."""
    draw = paths_drawing(pair)
    return None if draw is None else Section("map", "Paths", figure(draw, "True paths where they are known."))


def paths_drawing(pair: RunPair) -> Draw | None:
    """What draws both paths; None where there are none, or of different mirrors."""
    records = {letter: found.record for letter, found in pair.named if found.record.sessions}
    return partial(paths_figure, pair.b.record.mirror, records) if pair.is_one_mirror and records else None


def points_section(pair: RunPair) -> Section | None:
    """Points that ended otherwise."""
    if not pair.is_one_mirror or not (pair.a.points and pair.b.points):
        return None
    a = {verdict.point: verdict for verdict in pair.a.points}
    both = [(a[verdict.point], verdict) for verdict in pair.b.points if verdict.point in a]
    rows = [
        [point_text(one.point), str(one.grade), str(other.grade), shown(one.first_mm), shown(other.first_mm)]
        for one, other in both
        if one.grade is not other.grade
    ]
    only = f"<p>{len(both)} points are in both missions.</p>"
    head = ["point", "A", "B", "first in A, mm", "first in B, mm"]
    return Section("points", "Points", only + (table(head, rows) if rows else "<p>All ended the same way.</p>"))


def surfaces_section(pair: RunPair) -> Section | None:
    """Both surfaces in the same colours."""
    drawn = _surfaces(pair) if pair.is_one_mirror else []
    if not drawn:
        return None
    return Section("surface", "Surfaces", beside(drawn) + "<p>Both in the same colours.</p>")


def _surfaces(pair: RunPair) -> list[tuple[str, Drawing]]:
    mirror, known = pair.b.record.mirror, [(n, f.alignment.panels) for n, f in pair.named if f.alignment is not None]
    everything = [panel for _, panels in known for panel in panels]
    return [
        (name, surface_figure(mirror, panels, f"{mirror.name}: surface of {name}", NARROW, scaled_as=everything))
        for name, panels in known
        if panels
    ]


def panels_section(pair: RunPair) -> Section | None:
    """Which panels have moved."""
    changes, draw = pair.changes, change_drawing(pair)
    if changes is None or draw is None:
        return None
    moved = [panel for panel in changes.panels if panel.has_moved]
    verdict = "The surveys agree" if changes.agree else f"{len(moved)} of {len(changes.panels)} panels have moved"
    lead = (
        f"<p><strong>{verdict}</strong>: \u03c7\u00b2 of no change {changes.chi2:.1f} for {changes.dof} degrees of "
        f"freedom; noise alone keeps it between {changes.low:.1f} and {changes.high:.1f} (99 %).</p>"
    )
    rows = [_change(panel) for panel in sorted(changes.panels, key=lambda panel: -panel.chi2)]
    head = ["panel", "piston, \u00b5m", "tip, \u00b5rad", "tilt, \u00b5rad", "\u03c7\u00b2 (3)", ""]
    return Section("panels", "Panels, B less A", lead + figure(draw, "") + _few(head, rows))


def _change(panel: PanelChange) -> list[str]:
    pairs = zip(panel.values.tolist(), panel.sigma.tolist(), strict=True)
    cells = [f"{shown(_MICRO * value, 1)} \u00b1 {shown(_MICRO * sigma, 1)}" for value, sigma in pairs]
    return [f"{panel.panel.row}/{panel.panel.col}", *cells, shown(panel.chi2, 1), "moved" if panel.has_moved else ""]


def change_drawing(pair: RunPair) -> Draw | None:
    """What draws the change of the surface."""
    if pair.changes is None or pair.a.alignment is None or pair.b.alignment is None:
        return None
    return partial(change_figure, pair.b.record.mirror, pair.a.alignment.panels, pair.b.alignment.panels)


def adjusters_section(pair: RunPair) -> Section | None:
    """The moves that each survey asks for; those of B are still to be made."""
    if not pair.is_one_mirror:
        return None
    a, b = (_by_panel(found.alignment.panels if found.alignment else ()) for _, found in pair.named)
    panels = sorted({*a, *b}, key=lambda panel: (-_largest(b.get(panel)), panel))
    if not panels:
        return None
    names = next(iter((b or a).values())).adjusters
    rows = []
    for panel in panels:
        one, other = (_moves(found.get(panel), len(names)) for found in (a, b))
        moves = (f"{first} \u2192 <strong>{then}</strong>" for first, then in zip(one, other, strict=True))
        rows.append([f"{panel.row}/{panel.col}", *moves])
    lead = (
        "<p>Moves of the vertical adjusters in \u00b5m, positive towards the robot: those that A asks for \u2192 those "
        "that B asks for, which are <strong>still to be made</strong>.</p>"
    )
    return Section("adjusters", "Adjuster moves", lead + _few(["panel", *names], rows, "dense"))


def _by_panel(panels: tuple[PanelResult, ...]) -> dict[PanelId, PanelResult]:
    return {panel.panel: panel for panel in panels}


def _largest(panel: PanelResult | None) -> float:
    return 0.0 if panel is None else float(abs(panel.rigid.moves.values_m).max())


def _moves(panel: PanelResult | None, count: int) -> list[str]:
    if panel is None:
        return [shown(None)] * count
    return [shown(float(move) * _MICRO, 1) for move in panel.rigid.moves.values_m]


def _few(head: list[str], rows: list[list[str]], kind: str = "") -> str:
    """The first rows, and under a line all of them."""
    whole = folded(text(f"All {len(rows)} panels"), table(head, rows, kind)) if len(rows) > _FEW else ""
    return table(head, rows[:_FEW], kind) + whole


_MANY = 24


def compare_page(pair: RunPair) -> str:
    """The comparison as one HTML file."""
    names = f"{pair.a.record.name} and {pair.b.record.name}"
    head = f"<h1>{text(names)}</h1>{''.join(_introduced(*one) for one in pair.named)}"
    if pair.warning:
        head += f"<p class='bad'>{text(pair.warning)}</p>"
    sections = [section for make in _SECTIONS if (section := make(pair)) is not None]
    return page(names, head, sections, "Made by <code>ccatp compare</code>; this file needs nothing else.")


def _introduced(letter: str, found: Findings) -> str:
    outcome = found.outcome
    cause = f": {text(outcome.cause)}" if outcome.cause else ""
    kind = "good" if outcome.is_good else "bad"
    name = f"<strong>{letter}</strong> {text(found.record.name)}, {text(found.record.mirror.name)}"
    boxes = gaps(found.record, found.warnings)
    return f"<p>{survey_chips(found.record)} {name}, <span class='{kind}'>{text(outcome.text)}</span>{cause}</p>{boxes}"


def _figures(pair: RunPair) -> Section:
    rows = []
    for one in compared_figures(pair):
        values = (one.a, one.b, one.change)
        rows.append([text(one.name), *(shown(value, one.decimals) for value in values)])
    return Section("figures", "Figures", table(["", "A", "B", "B less A"], rows, "figures"))


def _settings(pair: RunPair) -> Section:
    a, b = (found.record.cfg.model_dump(mode="json") for found in (pair.a, pair.b))
    changes = changed_keys(a, b)
    rows = [[text(key), text(one), text(other)] for key, (one, other) in changes.items()]
    whole = table(["key", "A", "B"], rows, "texts") if rows else "<p>The same in every key.</p>"
    body = whole if len(rows) <= _MANY else folded(f"{len(rows)} keys differ", whole)
    return Section("configuration", "Configuration", body)


def _time(pair: RunPair) -> Section | None:
    draw = _time_figure(pair)
    return None if draw is None else Section("time", "Time budget", figure(draw, ""))


def _time_figure(pair: RunPair) -> Draw | None:
    budgets = [(name, found.budget) for name, found in pair.named if found.budget is not None]
    if not budgets:
        return None
    return partial(time_figure, budgets, max(found.record.cfg.run.budget_s for found in (pair.a, pair.b)))


def _errors(pair: RunPair) -> Section | None:
    arrivals, series = _arrival_figure(pair), _error_figure(pair)
    body = "" if series is None else figure(series, "The largest error in each time; dashed 3 \u03c3.")
    body += "" if arrivals is None else figure(arrivals, "First arrivals, before any correction.")
    return Section("errors", "Errors", body) if body else None


def _error_figure(pair: RunPair) -> Draw | None:
    series = {name: f.errors for name, f in pair.named if f.errors is not None}
    return partial(errors_figure, series) if series else None


def _arrival_figure(pair: RunPair) -> Draw | None:
    values = {
        name: np.array([v.first_mm for v in found.points if v.first_mm is not None]) for name, found in pair.named
    }
    known = {name: some for name, some in values.items() if len(some)}
    return partial(distribution_figure, known, "distance at first arrival, mm") if known else None


def _events(pair: RunPair) -> Section | None:
    told = [f"<h3>{letter}</h3>{events_body(found.record.log)}" for letter, found in pair.named if found.record.log]
    return Section("events", "Events", "".join(told)) if told else None


_SECTIONS = (
    _figures,
    _settings,
    paths_section,
    _time,
    _errors,
    points_section,
    surfaces_section,
    panels_section,
    adjusters_section,
    _events,
)


def compare_figures(pair: RunPair) -> dict[str, Drawing]:
    """The figures of the comparison, by the names of their files."""
    made = {
        "time": _time_figure(pair),
        "localization": _error_figure(pair),
        "arrivals": _arrival_figure(pair),
        "change": change_drawing(pair),
        "paths": paths_drawing(pair),
    }
    return {name: draw(WIDE) for name, draw in made.items() if draw is not None}


_WIDTH = 12


def compare_lines(pair: RunPair) -> Iterator[str]:
    """A line for each figure that differs, then the panels that have moved."""
    if pair.warning:
        yield f"warning: {pair.warning}"
    rows = [(_ascii(one.name), one) for one in compared_figures(pair) if one.change != 0.0]
    width = max((len(name) for name, _ in rows), default=0) + 2
    yield f"{'':<{width}}{'A':>{_WIDTH}}{'B':>{_WIDTH}}{'B less A':>{_WIDTH}}"
    for name, one in rows:
        cells = "".join(f"{_cell(value, one.decimals):>{_WIDTH}}" for value in (one.a, one.b, one.change))
        yield f"{name:<{width}}{cells}"
    changes = pair.changes
    if changes is None:
        return
    verdict = "the surveys agree" if changes.agree else "the surveys differ"
    chi2 = f"chi2 of no change {changes.chi2:.1f} for {changes.dof} degrees of freedom"
    yield f"{verdict}: {chi2}, {changes.high:.1f} at most by noise alone"
    for panel in changes.panels:
        if panel.has_moved:
            piston, tip, tilt = (_MICRO * value for value in panel.values)
            where = f"panel {panel.panel.row}/{panel.panel.col} has moved"
            yield f"{where}: piston {piston:+.1f} um, tip {tip:+.1f} urad, tilt {tilt:+.1f} urad"


def _ascii(name: str) -> str:
    return name.replace("\u00b5", "u").replace("\u03c3", "sigma")


def _cell(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"


def compare_data(pair: RunPair) -> dict[str, Any]:
    """What ``ccatp compare --json`` tells."""
    changes, (a, b) = pair.changes, pair.wavefronts
    return {
        "a": run_data(pair.a),
        "b": run_data(pair.b),
        "one_mirror": pair.is_one_mirror,
        "half_wavefront_common_um": {"a": wavefront_data(a), "b": wavefront_data(b)},
        "panels": None if changes is None else [_panel(panel) for panel in changes.panels],
        "chi2": None if changes is None else round(changes.chi2, 4),
        "dof": None if changes is None else changes.dof,
        "agree": None if changes is None else changes.agree,
    }


def _panel(panel: PanelChange) -> dict[str, Any]:
    piston, tip, tilt = (round(_MICRO * value, 4) for value in panel.values.tolist())
    return {
        "row": panel.panel.row,
        "col": panel.panel.col,
        "piston_um": piston,
        "tip_urad": tip,
        "tilt_urad": tilt,
        "sigma": [round(_MICRO * value, 4) for value in panel.sigma.tolist()],
        "chi2": round(panel.chi2, 4),
        "has_moved": panel.has_moved,
    }
