"""Pure. Two runs beside each other: figures, configuration, time, errors, and what has changed on the mirror."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from ccatp.drawing.shapes import Picture
from ccatp.reporting.compare_figures import change_figure, distribution_figure, errors_figure
from ccatp.reporting.data import run_data
from ccatp.reporting.findings import Findings
from ccatp.reporting.head import gaps
from ccatp.reporting.html import WIDE, Cell, figure, folded, shown, table, text
from ccatp.reporting.page import Section, page
from ccatp.reporting.panel_changes import Changes, PanelChange, panel_changes
from ccatp.reporting.path_figure import point_text
from ccatp.reporting.record import changed_keys
from ccatp.reporting.run_page import survey_chips
from ccatp.reporting.time_figure import time_figure

_MICRO = 1e6
_FEW = 12
Draw = Callable[[float], Picture]


class Pair(NamedTuple):
    """Two runs, called A and B as on the page, and what changed between them on one mirror."""

    a: Findings
    b: Findings
    changes: Changes | None

    @property
    def is_one_mirror(self) -> bool:
        """Points and panels can be compared one by one."""
        return self.a.record.mirror.name == self.b.record.mirror.name


def pair_of(a: Findings, b: Findings) -> Pair:
    """Put two runs beside each other."""
    found = Pair(a, b, None)
    if not found.is_one_mirror or a.alignment is None or b.alignment is None:
        return found
    return found._replace(changes=panel_changes(a.alignment.panels, b.alignment.panels))


def compare_page(pair: Pair) -> str:
    """The comparison as one HTML file."""
    names = f"{pair.a.record.name} and {pair.b.record.name}"
    head = f"<h1>{text(names)}</h1>{''.join(_introduced(*one) for one in (('A', pair.a), ('B', pair.b)))}"
    if not pair.is_one_mirror:
        head += "<p class='bad'>The runs are of different mirrors: points and panels are not compared.</p>"
    made = (_figures, _settings, _time, _errors, _points, _panels)
    sections = [section for make in made if (section := make(pair)) is not None]
    return page(names, head, sections, "Made by <code>ccatp compare</code>; this file needs nothing else.")


def _introduced(letter: str, found: Findings) -> str:
    outcome = found.outcome
    cause = f": {text(outcome.cause)}" if outcome.cause else ""
    kind = "good" if outcome.is_good else "bad"
    name = f"<strong>{letter}</strong> {text(found.record.name)}, {text(found.record.mirror.name)}"
    boxes = gaps(found.record, found.warnings)
    return f"<p>{survey_chips(found.record)} {name}, <span class='{kind}'>{text(outcome.text)}</span>{cause}</p>{boxes}"


def compared_figures(pair: Pair) -> dict[str, tuple[float | None, float | None]]:
    """The figures of both runs by name; those that neither knows are left out."""
    a, b = (_flat(run_data(found)) for found in (pair.a, pair.b))
    return {name: (a.get(name), b.get(name)) for name in dict.fromkeys((*a, *b))}


def _flat(tree: dict[str, object], prefix: str = "") -> dict[str, float]:
    found: dict[str, float] = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{prefix}{name} ")
        elif isinstance(value, int | float) and not isinstance(value, bool) and name != "seed":
            found[prefix + name] = float(value)
    return found


def _figures(pair: Pair) -> Section:
    rows = []
    for name, (a, b) in compared_figures(pair).items():
        change = None if a is None or b is None else b - a
        rows.append([text(name.replace("_", " ")), *(_figure(value) for value in (a, b, change))])
    return Section("figures", "Figures", table(["", "A", "B", "B less A"], rows))


def _figure(value: Cell) -> str:
    is_whole = isinstance(value, float) and value == round(value) and abs(value) >= 1.0
    return shown(value, 0 if is_whole else 4)


def _settings(pair: Pair) -> Section:
    a, b = (found.record.cfg.model_dump(mode="json") for found in (pair.a, pair.b))
    changes = changed_keys(a, b)
    rows = [[text(key), text(one), text(other)] for key, (one, other) in changes.items()]
    whole = table(["key", "A", "B"], rows, "texts") if rows else "<p>The same in every key.</p>"
    body = whole if len(rows) <= 2 * _FEW else folded(f"{len(rows)} keys differ", whole)
    return Section("configuration", "Configuration", body)


def _time(pair: Pair) -> Section | None:
    draw = _time_figure(pair)
    return None if draw is None else Section("time", "Time budget", figure(draw, ""))


def _time_figure(pair: Pair) -> Draw | None:
    budgets = [(name, found.budget) for name, found in (("A", pair.a), ("B", pair.b)) if found.budget is not None]
    if not budgets:
        return None
    return partial(time_figure, budgets, max(found.record.cfg.run.budget_s for found in (pair.a, pair.b)))


def _errors(pair: Pair) -> Section | None:
    arrivals, series = _arrival_figure(pair), _error_figure(pair)
    body = "" if series is None else figure(series, "The largest error in each time.")
    body += "" if arrivals is None else figure(arrivals, "First arrivals, before any correction.")
    return Section("errors", "Errors", body) if body else None


def _error_figure(pair: Pair) -> Draw | None:
    series = {name: f.errors for name, f in (("A", pair.a), ("B", pair.b)) if f.errors is not None}
    return partial(errors_figure, series) if series else None


def _arrival_figure(pair: Pair) -> Draw | None:
    values = {
        name: np.array([v.first_mm for v in found.points if v.first_mm is not None])
        for name, found in (("A", pair.a), ("B", pair.b))
    }
    known = {name: some for name, some in values.items() if len(some)}
    return partial(distribution_figure, known, "distance at first arrival, mm") if known else None


def _points(pair: Pair) -> Section | None:
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


def _panels(pair: Pair) -> Section | None:
    changes, draw = pair.changes, _change_figure(pair)
    if changes is None or draw is None:
        return None
    moved = [panel for panel in changes.panels if panel.has_moved]
    verdict = "The surveys agree" if changes.agree else f"{len(moved)} of {len(changes.panels)} panels have moved"
    lead = (
        f"<p><strong>{verdict}</strong>: \u03c7\u00b2 of no change {changes.chi2:.1f} for {changes.dof} degrees of "
        f"freedom; noise alone keeps it between {changes.low:.1f} and {changes.high:.1f} (99 %).</p>"
    )
    order = sorted(changes.panels, key=lambda panel: -panel.chi2)
    rows = [_change(panel) for panel in order]
    head = ["panel", "piston, \u00b5m", "tip, \u00b5rad", "tilt, \u00b5rad", "\u03c7\u00b2 (3)", ""]
    body = table(head, rows[:_FEW])
    body += folded(f"All {len(rows)} panels", table(head, rows)) if len(rows) > _FEW else ""
    return Section("panels", "Panels, B less A", lead + figure(draw, "") + body)


def _change(panel: PanelChange) -> list[str]:
    pairs = zip(panel.values.tolist(), panel.sigma.tolist(), strict=True)
    cells = [f"{shown(_MICRO * value, 1)} \u00b1 {shown(_MICRO * sigma, 1)}" for value, sigma in pairs]
    return [f"{panel.panel.row}/{panel.panel.col}", *cells, shown(panel.chi2, 1), "moved" if panel.has_moved else ""]


def _change_figure(pair: Pair) -> Draw | None:
    if pair.changes is None or pair.a.alignment is None or pair.b.alignment is None:
        return None
    return partial(change_figure, pair.b.record.mirror, pair.a.alignment.panels, pair.b.alignment.panels)


def compare_figures(pair: Pair) -> dict[str, Picture]:
    """The figures of the comparison, by the names of their files."""
    made = {
        "time": _time_figure(pair),
        "localization": _error_figure(pair),
        "arrivals": _arrival_figure(pair),
        "change": _change_figure(pair),
    }
    return {name: draw(WIDE) for name, draw in made.items() if draw is not None}
