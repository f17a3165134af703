"""Pure. The page of two runs beside each other: figures, configuration, time, errors, events, and their mirror."""

from functools import partial

import numpy as np

from ccatp.drawing.shapes import Picture
from ccatp.reporting.compare_figures import Draw, distribution_figure, errors_figure
from ccatp.reporting.compare_mirror import (
    adjusters_section,
    change_drawing,
    panels_section,
    paths_drawing,
    paths_section,
    points_section,
    surfaces_section,
)
from ccatp.reporting.event_section import events_body
from ccatp.reporting.findings import Findings
from ccatp.reporting.head import gaps
from ccatp.reporting.html import WIDE, figure, folded, shown, table, text
from ccatp.reporting.page import Section, page
from ccatp.reporting.pair import Pair, compared_figures
from ccatp.reporting.record import changed_keys
from ccatp.reporting.run_page import survey_chips
from ccatp.reporting.time_figure import time_figure

_MANY = 24


def compare_page(pair: Pair) -> str:
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


def _figures(pair: Pair) -> Section:
    rows = []
    for one in compared_figures(pair):
        values = (one.a, one.b, one.change)
        rows.append([text(one.name), *(shown(value, one.decimals) for value in values)])
    return Section("figures", "Figures", table(["", "A", "B", "B less A"], rows, "figures"))


def _settings(pair: Pair) -> Section:
    a, b = (found.record.cfg.model_dump(mode="json") for found in (pair.a, pair.b))
    changes = changed_keys(a, b)
    rows = [[text(key), text(one), text(other)] for key, (one, other) in changes.items()]
    whole = table(["key", "A", "B"], rows, "texts") if rows else "<p>The same in every key.</p>"
    body = whole if len(rows) <= _MANY else folded(f"{len(rows)} keys differ", whole)
    return Section("configuration", "Configuration", body)


def _time(pair: Pair) -> Section | None:
    draw = _time_figure(pair)
    return None if draw is None else Section("time", "Time budget", figure(draw, ""))


def _time_figure(pair: Pair) -> Draw | None:
    budgets = [(name, found.budget) for name, found in pair.named if found.budget is not None]
    if not budgets:
        return None
    return partial(time_figure, budgets, max(found.record.cfg.run.budget_s for found in (pair.a, pair.b)))


def _errors(pair: Pair) -> Section | None:
    arrivals, series = _arrival_figure(pair), _error_figure(pair)
    body = "" if series is None else figure(series, "The largest error in each time; dashed 3 \u03c3.")
    body += "" if arrivals is None else figure(arrivals, "First arrivals, before any correction.")
    return Section("errors", "Errors", body) if body else None


def _error_figure(pair: Pair) -> Draw | None:
    series = {name: f.errors for name, f in pair.named if f.errors is not None}
    return partial(errors_figure, series) if series else None


def _arrival_figure(pair: Pair) -> Draw | None:
    values = {
        name: np.array([v.first_mm for v in found.points if v.first_mm is not None]) for name, found in pair.named
    }
    known = {name: some for name, some in values.items() if len(some)}
    return partial(distribution_figure, known, "distance at first arrival, mm") if known else None


def _events(pair: Pair) -> Section | None:
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


def compare_figures(pair: Pair) -> dict[str, Picture]:
    """The figures of the comparison, by the names of their files."""
    made = {
        "time": _time_figure(pair),
        "localization": _error_figure(pair),
        "arrivals": _arrival_figure(pair),
        "change": change_drawing(pair),
        "paths": paths_drawing(pair),
    }
    return {name: draw(WIDE) for name, draw in made.items() if draw is not None}
