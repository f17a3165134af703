"""Pure. Where the time went, as bars: what runs took, each above the least that its way takes."""

from collections.abc import Sequence

import numpy as np

from ccatp.drawing.axes import CHARACTER, Axis, Plot, legend
from ccatp.drawing.colours import BAD, INK, PAPER, QUIET, SERIES
from ccatp.drawing.shapes import Boxes, Picture, Text
from ccatp.reporting.time_budget import KINDS, TimeBudget

_SHADES = (SERIES[1], SERIES[0], SERIES[5], SERIES[2], SERIES[4], SERIES[3], "#6b5b95", QUIET)
_COLOURS = dict(zip(KINDS, _SHADES, strict=True))
_BAR = 26.0
_OF_THE_BUDGET = 0.4  # a few panels are no matter of an hour


def time_figure(budgets: Sequence[tuple[str, TimeBudget]], budget_s: float, width: float) -> Picture:
    """Draw the bars.

    Args:
        budgets: runs by name.
        budget_s: what a mission may take; marked where it is near.
        width: of the picture, pixels.
    """
    size = 11.5 if width > 500.0 else 10.5
    bars = [bar for name, found in budgets for bar in _bars(name, found)]
    left = 12.0 + CHARACTER * size * max(len(name) for name, _ in bars)
    longest = max(sum(parts.values()) for _, parts in bars)
    end = max(longest, budget_s) if longest > _OF_THE_BUDGET * budget_s else longest
    top, bottom = 10.0, 10.0 + (_BAR + 8.0) * len(bars)
    right = width - 16.0 - CHARACTER * size * 6
    plot = Plot(left, top, right, bottom, Axis(0.0, end, left, right), Axis(0.0, 1.0, bottom, top), size)
    if end >= budget_s:
        x = plot.x.pixel(budget_s)
        plot.shapes.append(Boxes(np.array([[x - 0.7, top, 1.4, bottom - top]]), BAD))
        plot.shapes.append(Text(x - 4.0, bottom - 2.0, "budget", size, BAD, "end"))
    for place, (name, parts) in enumerate(bars):
        _draw_bar(plot, name, parts, top + place * (_BAR + 8.0))
    plot.shapes += plot.along("time, s")
    used = [kind for kind in KINDS if any(kind in parts for _, parts in bars)]
    shapes, height = legend(12.0, bottom + 56.0, [(kind, _COLOURS[kind]) for kind in used], size, width - 24.0)
    return Picture(width, bottom + 48.0 + height, (*plot.shapes, *shapes), "where the time went")


def _bars(name: str, found: TimeBudget) -> list[tuple[str, dict[str, float]]]:
    bars = [(name, found.spent_s)]
    return bars if found.least_s is None else [*bars, ("least", found.least_s)]


def _draw_bar(plot: Plot, name: str, parts: dict[str, float], y: float) -> None:
    plot.shapes.append(Text(plot.left - 6.0, y + _BAR / 2.0 + 4.0, name, plot.size, INK, "end"))
    at_s = 0.0
    for kind in KINDS:
        if kind not in parts:
            continue
        start, end = plot.x.pixel(at_s), plot.x.pixel(at_s + parts[kind])
        plot.shapes.append(Boxes(np.array([[start, y, end - start, _BAR]]), _COLOURS[kind]))
        label = f"{parts[kind]:.0f}"
        if end - start > CHARACTER * plot.size * len(label) + 6.0:
            plot.shapes.append(Text((start + end) / 2.0, y + _BAR / 2.0 + 4.0, label, plot.size, PAPER, "middle"))
        at_s += parts[kind]
    total, x = f"{at_s:.0f} s", plot.x.pixel(at_s) + 3.0
    plot.shapes.append(Boxes(np.array([[x, y + 4.0, CHARACTER * plot.size * (len(total) + 1), _BAR - 8.0]]), PAPER))
    plot.shapes.append(Text(x + 3.0, y + _BAR / 2.0 + 4.0, total, plot.size, QUIET))
