"""Localization error over time with three sigma, and how far each fix moved the estimate.

Where the time went, as bars: what runs took, each above the least that its way takes.

The mirror as a picture's ground: panels, rim, numbers of rows and columns, a colour bar beside or below.

The mirror with the driven path, and each point coloured by how near the robot came at its first arrival.

The mirror with the deviation of its surface, as fitted panel by panel and as measured point by point.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil, cos, floor, log10, sin
from typing import NamedTuple

import numpy as np

from ccatp.core import FloatArray, PointId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panel_alignment import PanelResult, on_grid_m
from ccatp.report.analysis import KINDS, ErrorSeries, TimeBreakdown
from ccatp.report.drawing import (
    BAD,
    BELOW_TO_ABOVE,
    CHARACTER,
    INK,
    LEVELS,
    PANEL,
    PAPER,
    PATH,
    QUIET,
    SEAM,
    SERIES,
    SMALL_TO_LARGE,
    Area,
    Boxes,
    ColourScale,
    Dots,
    Drawing,
    Envelope,
    Plot,
    PlotAxis,
    PolyLine,
    Shape,
    TextShape,
    colour_bar,
    envelope,
    legend,
    thinned,
)
from ccatp.report.findings import Grade, PointVerdict
from ccatp.report.html import NARROW
from ccatp.report.record import WITHIN_MM, RunRecord

_ERROR, _SIGMA, _FIX = SERIES[0], SERIES[1], SERIES[2]
_HEIGHT_WIDE, _HEIGHT_NARROW = 300.0, 250.0
_LEAST_MM = 1e-3  # a micrometre: less is of no interest, and of the noise of the laser


def error_figure(series: ErrorSeries, width: float) -> Drawing:
    """Draw the series; where no truth is known, three sigma and the fixes alone."""
    is_wide = width > 500.0
    left, top, right, bottom = 62.0, 10.0, width - 12.0, _HEIGHT_WIDE if is_wide else _HEIGHT_NARROW
    y = PlotAxis(*_ends(series), bottom, top, is_logarithmic=True)
    begin, end = float(series.t_s[0]), max(float(series.t_s[-1]), float(series.t_s[0]) + 1.0)
    plot = Plot(left, top, right, bottom, PlotAxis(begin / 60.0, end / 60.0, left, right), y, 11.5 if is_wide else 10.5)
    plot.frame("robot time, min", "mm")
    intervals = max(1, int((right - left) / 1.5))
    sigma = envelope(series.t_s, series.sigma3_mm, intervals)
    _band(plot, sigma, _SIGMA)
    entries = [("3 \u03c3 of the estimate", _SIGMA)]
    errors = envelope(series.t_s, series.error_mm, intervals)
    if len(errors.x):
        _band(plot, errors, _ERROR)
        entries = [("true error, least to largest", _ERROR), *entries]
    entries += _draw_fixes(plot, series, is_wide)
    for at_s in series.breaks_s:
        x = plot.x.pixel(at_s / 60.0)
        plot.shapes.append(PolyLine(np.array([[x, top], [x, bottom]]), INK, 1.0, (2.0, 3.0)))
    if y.high >= WITHIN_MM:
        plot.level(WITHIN_MM, BAD)
        entries.append(("10 mm", BAD))
    shapes, height = legend(12.0, bottom + 56.0, entries, plot.size, width - 24.0)
    return Drawing(width, bottom + 48.0 + height, (*plot.shapes, *shapes), "localization error over time")


def _ends(series: ErrorSeries) -> tuple[float, float]:
    values = np.concatenate([series.sigma3_mm, series.error_mm[np.isfinite(series.error_mm)], series.fix_mm])
    largest = max(float(values.max()), 0.1)
    usual = (
        np.percentile(series.error_mm[np.isfinite(series.error_mm)], 2) if np.isfinite(series.error_mm).any() else 0.1
    )
    low = 10.0 ** floor(log10(max(min(float(usual), float(series.sigma3_mm.min())), _LEAST_MM)))
    return low, largest * 1.5


def _band(plot: Plot, found: Envelope, colour: str) -> None:
    """From least to largest in each interval, and the mean in it."""
    upper, lower = plot.y.pixels(found.high), plot.y.pixels(found.low)
    x = plot.x.pixels(found.x / 60.0)
    for part in _runs(found.x):
        outline = np.concatenate(
            [np.column_stack([x[part], upper[part]]), np.column_stack([x[part], lower[part]])[::-1]]
        )
        plot.shapes.append(Area(outline, fill=colour, opacity=0.28))
        plot.shapes.append(PolyLine(np.column_stack([x[part], upper[part]]), colour, 1.2))


def _runs(x: FloatArray) -> list[slice]:
    if len(x) < 2:
        return []
    steps = np.diff(x)
    ends = np.flatnonzero(steps > 10.0 * np.median(steps)) + 1
    bounds = [0, *ends.tolist(), len(x)]
    return [slice(a, b) for a, b in pairwise(bounds) if b - a > 1]


def _draw_fixes(plot: Plot, series: ErrorSeries, is_wide: bool) -> list[tuple[str, str]]:
    entries = []
    for is_fused, colour, name in ((True, _FIX, "fix: correction"), (False, BAD, "fix, not taken")):
        chosen = series.fix_fused == is_fused
        if not chosen.any():
            continue
        x, y = plot.x.pixels(series.fix_t_s[chosen] / 60.0), plot.y.pixels(series.fix_mm[chosen])
        places = np.column_stack([x, y])
        places = np.unique(np.rint(places), axis=0)  # what falls on one pixel is one dot
        plot.shapes.append(Dots(places, 1.6 if is_wide else 1.2, colour))
        entries.append((name, colour))
    return entries


_SHADES = (SERIES[1], SERIES[0], SERIES[5], SERIES[2], SERIES[4], SERIES[3], "#6b5b95", QUIET)
_COLOURS = dict(zip(KINDS, _SHADES, strict=True))
_BAR = 26.0
_OF_THE_BUDGET = 0.4  # a few panels are no matter of an hour


def time_figure(budgets: Sequence[tuple[str, TimeBreakdown]], budget_s: float, width: float) -> Drawing:
    """Draw the bars.

    Args:
        budget_s: what a mission may take; marked where it is near.
    """
    size = 11.5 if width > 500.0 else 10.5
    bars = [bar for name, found in budgets for bar in _bars(name, found)]
    left = 12.0 + CHARACTER * size * max(len(name) for name, _ in bars)
    longest = max(sum(parts.values()) for _, parts in bars)
    end = max(longest, budget_s) if longest > _OF_THE_BUDGET * budget_s else longest
    top, bottom = 10.0, 10.0 + (_BAR + 8.0) * len(bars)
    right = width - 16.0 - CHARACTER * size * 6
    plot = Plot(left, top, right, bottom, PlotAxis(0.0, end, left, right), PlotAxis(0.0, 1.0, bottom, top), size)
    if end >= budget_s:
        x = plot.x.pixel(budget_s)
        plot.shapes.append(Boxes(np.array([[x - 0.7, top, 1.4, bottom - top]]), BAD))
        plot.shapes.append(TextShape(x - 4.0, bottom - 2.0, "budget", size, BAD, "end"))
    for place, (name, parts) in enumerate(bars):
        _draw_bar(plot, name, parts, top + place * (_BAR + 8.0))
    plot.shapes += plot.along("time, s")
    used = [kind for kind in KINDS if any(kind in parts for _, parts in bars)]
    shapes, height = legend(12.0, bottom + 56.0, [(kind, _COLOURS[kind]) for kind in used], size, width - 24.0)
    return Drawing(width, bottom + 48.0 + height, (*plot.shapes, *shapes), "where the time went")


def _bars(name: str, found: TimeBreakdown) -> list[tuple[str, dict[str, float]]]:
    bars = [(name, found.spent_s)]
    return bars if found.least_s is None else [*bars, ("least", found.least_s)]


def _draw_bar(plot: Plot, name: str, parts: dict[str, float], y: float) -> None:
    plot.shapes.append(TextShape(plot.left - 6.0, y + _BAR / 2.0 + 4.0, name, plot.size, INK, "end"))
    at_s = 0.0
    for kind in KINDS:
        if kind not in parts:
            continue
        start, end = plot.x.pixel(at_s), plot.x.pixel(at_s + parts[kind])
        plot.shapes.append(Boxes(np.array([[start, y, end - start, _BAR]]), _COLOURS[kind]))
        label = f"{parts[kind]:.0f}"
        if end - start > CHARACTER * plot.size * len(label) + 6.0:
            plot.shapes.append(TextShape((start + end) / 2.0, y + _BAR / 2.0 + 4.0, label, plot.size, PAPER, "middle"))
        at_s += parts[kind]
    total, x = f"{at_s:.0f} s", plot.x.pixel(at_s) + 3.0
    plot.shapes.append(Boxes(np.array([[x, y + 4.0, CHARACTER * plot.size * (len(total) + 1), _BAR - 8.0]]), PAPER))
    plot.shapes.append(TextShape(x + 3.0, y + _BAR / 2.0 + 4.0, total, plot.size, QUIET))


_MARGIN_M = 0.04  # around the rim


@dataclass(slots=True)
class MapFrame:
    """A map of a mirror, deck frame: x to the right, y up."""

    mirror: Mirror
    width: float
    shapes: list[Shape] = field(default_factory=list)
    _low: FloatArray = field(init=False)
    _high: FloatArray = field(init=False)
    _scale: float = field(init=False)

    def __post_init__(self) -> None:
        """The mirror fills the width but for the numbers beside it and, on a wide picture, the colour bar."""
        vertices = self.mirror.rim.vertices
        self._low, self._high = vertices.min(axis=0) - _MARGIN_M, vertices.max(axis=0) + _MARGIN_M
        self._scale = (self.width - self._left - (92.0 if self.is_wide else 4.0)) / float(self._high[0] - self._low[0])

    @property
    def is_wide(self) -> bool:
        """For a screen, not for a telephone."""
        return self.width > NARROW

    @property
    def size(self) -> float:
        """Of the type."""
        return 11.5 if self.is_wide else 10.5

    @property
    def pixel_m(self) -> float:
        """Length of a pixel on the mirror."""
        return 1.0 / self._scale

    @property
    def _left(self) -> float:
        return 22.0 if self.is_wide else 16.0

    @property
    def bottom(self) -> float:
        """Where the mirror ends."""
        return float(self._high[1] - self._low[1]) * self._scale + 4.0

    def pixels(self, deck_m: FloatArray) -> FloatArray:
        """Deck (x, y), shape (k, 2), as pixels."""
        x = self._left + (deck_m[:, 0] - self._low[0]) * self._scale
        y = 4.0 + (self._high[1] - deck_m[:, 1]) * self._scale
        return np.column_stack([x, y])

    def boxes(self, corners_m: FloatArray) -> FloatArray:
        """Rows of least x, least y, greatest x, greatest y (deck) as rows of left, top, width, height (pixels)."""
        low, high = self.pixels(corners_m[:, :2]), self.pixels(corners_m[:, 2:])
        return np.column_stack([low[:, 0], high[:, 1], high[:, 0] - low[:, 0], low[:, 1] - high[:, 1]])

    def draw_panels(self) -> None:
        """Panels, rim, and the numbers of rows and columns."""
        self.shapes.append(Boxes(self._tiles(), PANEL, SEAM, 0.7))
        self._draw_numbers()

    def draw_seams(self) -> None:
        """The outlines of the panels, above what was drawn before."""
        self.shapes.append(Boxes(self._tiles(), None, PAPER, 1.0))

    def _tiles(self) -> FloatArray:
        corners = [
            (p.x_m - p.half_x_m, p.y_m - p.half_y_m, p.x_m + p.half_x_m, p.y_m + p.half_y_m)
            for p in self.mirror.panels.values()
        ]
        return self.boxes(np.array(corners))

    def draw_rim(self) -> None:
        """The outline of the mirror, above what was drawn before."""
        self.shapes.append(Area(self.pixels(self.mirror.rim.vertices), colour=INK, width=1.4))

    def _draw_numbers(self) -> None:
        panels = self.mirror.panels.values()
        for col, x_m in {p.id.col: p.x_m for p in panels}.items():
            ((x, _),) = self.pixels(np.array([(x_m, 0.0)])).tolist()
            self.shapes.append(TextShape(x, self.bottom + 4.0 + self.size, str(col), self.size, QUIET, "middle"))
        for row, y_m in {p.id.row: p.y_m for p in panels}.items():
            ((_, y),) = self.pixels(np.array([(0.0, y_m)])).tolist()
            self.shapes.append(TextShape(self._left - 5.0, y + 0.35 * self.size, str(row), self.size, QUIET, "end"))

    def draw_base(self) -> None:
        """Where the robot starts, and its heading."""
        base = self.mirror.base_pose
        here = np.array([(base.x_m, base.y_m)])
        ahead = here + 0.2 * np.array([(cos(base.heading_rad), sin(base.heading_rad))])
        self.shapes.append(PolyLine(self.pixels(np.concatenate([here, ahead])), INK, 2.4))
        self.shapes.append(Dots(self.pixels(here), 4.5 if self.is_wide else 3.0, INK, titles=("base",)))

    def finish(self, scale: ColourScale | None, label: str, keys: list[tuple[str, Shape]], title: str) -> Drawing:
        """Colour bar and legend; then it is a picture.

        Args:
            scale: of the colours, and ``label`` what they mean; None where they mean nothing.
            keys: names, each with a shape drawn around the origin.
        """
        y = self.bottom + 2.2 * self.size + 12.0
        if scale is None:
            return Drawing(self.width, self._legend(keys, y) + 8.0, tuple(self.shapes), title)
        if self.is_wide:
            length = min(420.0, 0.7 * self.bottom)
            top = (self.bottom - length) / 2.0
            self.shapes += colour_bar(scale, self.width - 80.0, top, length, label, self.size, is_upright=True)
        else:
            self.shapes += colour_bar(scale, 30.0, y - 8.0, self.width - 60.0, label, self.size, is_upright=False)
            y += 58.0
        return Drawing(self.width, self._legend(keys, y) + 8.0, tuple(self.shapes), title)

    def _legend(self, keys: list[tuple[str, Shape]], y: float) -> float:
        x = self._left
        for name, shape in keys:
            width = 30.0 + CHARACTER * self.size * len(name) + 14.0
            if x + width > self.width and x > self._left:
                x, y = self._left, y + 1.7 * self.size
            self.shapes.append(_moved(shape, x + 10.0, y - 0.35 * self.size))
            self.shapes.append(TextShape(x + 26.0, y, name, self.size, INK))
            x += width
        return y


def _moved(shape: Shape, x: float, y: float) -> Shape:
    if isinstance(shape, Dots):
        return Dots(shape.places + np.array((x, y)), shape.radius, shape.colour, shape.mark, (), shape.edge)
    if isinstance(shape, PolyLine):
        return PolyLine(shape.points + np.array((x, y)), shape.colour, shape.width, shape.dash)
    raise TypeError(f"a legend shows dots and lines, no {type(shape).__name__}")


_TOLERANCE_PX = 0.6
_KEY_LINE = np.array([(-9.0, 0.0), (9.0, 0.0)])


def driven_path_m(record: RunRecord) -> FloatArray:
    """True path where there is one, else the estimated, deck x, y; shape (k, 2), sessions set apart by NaN."""
    pieces: list[FloatArray] = []
    for session in record.sessions:
        source = session.track.place_m if session.truth is None else session.truth.place_m
        pieces += [source[:, :2], np.full((1, 2), np.nan)]
    return np.concatenate(pieces) if pieces else np.empty((0, 2))


def path_figure(record: RunRecord, verdicts: list[PointVerdict], width: float) -> Drawing:
    """Draw the map."""
    frame = MapFrame(record.mirror, width)
    frame.draw_panels()
    frame.draw_rim()
    path = driven_path_m(record)
    keys: list[tuple[str, Shape]] = []
    if len(path):
        frame.shapes.append(PolyLine(thinned(frame.pixels(path), _TOLERANCE_PX), PATH, 1.0 if frame.is_wide else 0.7))
        keys.append(("true path" if record.has_truth else "estimated path", PolyLine(_KEY_LINE, PATH, 1.6)))
    frame.draw_base()
    keys.append(("base", Dots(np.zeros((1, 2)), 4.0, INK)))
    scale = _scale(verdicts)
    keys += _draw_points(frame, verdicts, scale)
    return frame.finish(scale, "distance at first arrival, mm", keys, f"{record.mirror.name}: path and arrival errors")


def _scale(verdicts: list[PointVerdict]) -> ColourScale:
    errors = np.array([error for v in verdicts if (error := _shown_mm(v)) is not None])
    # A single far one must not make all others look alike.
    usual = float(np.percentile(errors, 98)) if len(errors) else 1.0
    return ColourScale(0.0, min(WITHIN_MM, max(0.1, ceil(usual * 10) / 10)), SMALL_TO_LARGE)


def _shown_mm(verdict: PointVerdict) -> float | None:
    if verdict.left_mm is None:
        return None
    return verdict.left_mm if verdict.first_mm is None else verdict.first_mm


def _draw_points(frame: MapFrame, verdicts: list[PointVerdict], scale: ColourScale) -> list[tuple[str, Shape]]:
    radius = 4.4 if frame.is_wide else 2.2
    shown = [(v, error) for v in verdicts if (error := _shown_mm(v)) is not None]
    levels = scale.levels(np.array([error for _, error in shown])).tolist()
    palette = scale.palette()
    for level in sorted(set(levels)):
        some = [verdict for (verdict, _), own in zip(shown, levels, strict=True) if own == level]
        frame.shapes.append(_dots(frame, some, radius, palette[level]))
    keys: list[tuple[str, Shape]] = []
    for name, grades, mark, colour in (
        ("beyond 10 mm when measured", (Grade.FAIL,), "ring", BAD),
        ("skipped", (Grade.SKIPPED,), "cross", BAD),
        ("not measured", (Grade.OPEN,), "ring", QUIET),
    ):
        some = [v for v in verdicts if v.grade in grades]
        if not some:
            continue
        if mark == "ring" and colour == BAD:  # around the point's own colour
            frame.shapes.append(_dots(frame, some, radius + 2.0, PAPER, BAD))
            frame.shapes.append(_dots(frame, some, radius, palette[-1]))
            keys.append((name, Dots(np.zeros((1, 2)), 4.0, palette[-1], edge=BAD)))
            continue
        size = 0.8 * radius
        places = frame.pixels(np.array([v.place_m for v in some]))
        titles = tuple(map(_title, some)) if frame.is_wide else ()
        dots = Dots(places, size, colour, "cross" if mark == "cross" else "ring", titles)
        frame.shapes.append(dots)
        keys.append((name, Dots(np.zeros((1, 2)), 4.0, colour, dots.mark)))
    return keys


def _dots(frame: MapFrame, some: list[PointVerdict], radius: float, colour: str, edge: str = PAPER) -> Dots:
    titles = tuple(map(_title, some)) if frame.is_wide else ()
    return Dots(frame.pixels(np.array([v.place_m for v in some])), radius, colour, titles=titles, edge=edge)


def _title(verdict: PointVerdict) -> str:
    parts = [f"{point_text(verdict.point)}: {verdict.grade}"]
    if verdict.first_mm is not None:
        parts.append(f"first {verdict.first_mm:.2f} mm")
    if verdict.left_mm is not None:
        parts.append(f"measured at {verdict.left_mm:.2f} mm")
    return ", ".join(parts)


def point_text(point: PointId) -> str:
    """A point as in the commands: row/column/number."""
    return "/".join(map(str, point))


_CELLS_WIDE, _CELLS_NARROW = 8, 5
_LABEL = "deviation along the normal, \u00b5m (> 0 towards the robot)"
_MICRO = 1e6
# A single far point must not make all others look alike.
_USUAL_PERCENT = 99.0


class PanelCells(NamedTuple):
    """Values in a grid of cells over a panel: edges along deck x and y, shape (c + 1,), values (m), shape (c, c)."""

    x_m: FloatArray
    y_m: FloatArray
    values_m: FloatArray


def surface_figure(
    mirror: Mirror,
    panels: Sequence[PanelResult],
    title: str,
    width: float,
    scaled_as: Sequence[PanelResult] | None = None,
) -> Drawing:
    """Draw the map: dots show what was measured in the same colours, and vanish where the fit agrees with it.

    Args:
        scaled_as: panels that the colours are to span; those shown if not given.
    """
    frame = MapFrame(mirror, width)
    spanned = panels if scaled_as is None else scaled_as
    scale = _surface_figure_scale([panel.deviations.values_m[panel.is_kept] for panel in spanned])
    count = _CELLS_WIDE if frame.is_wide else _CELLS_NARROW
    _draw_cells(frame, [PanelCells(*on_grid_m(mirror, panel, count)) for panel in panels], scale)
    keys: list[tuple[str, Shape]] = []
    if panels:
        _draw_measured(frame, panels, scale)
        keys.append(("measured point", Dots(np.zeros((1, 2)), 3.4, scale.colour(0.0), edge=QUIET)))
    outliers = [panel.deviations.deck_m[~panel.is_kept] for panel in panels if not panel.is_kept.all()]
    if outliers:
        frame.shapes.append(Dots(frame.pixels(np.concatenate(outliers)), 4.0, BAD, "cross"))
        keys.append(("outlier, left out", Dots(np.zeros((1, 2)), 4.0, BAD, "cross")))
    return frame.finish(scale, _LABEL, keys, title)


def cells_figure(mirror: Mirror, cells: Sequence[PanelCells], label: str, title: str, width: float) -> Drawing:
    """Draw values without measured points; ``label`` is what they are, with their unit, um."""
    frame = MapFrame(mirror, width)
    scale = _surface_figure_scale([one.values_m.ravel() for one in cells])
    _draw_cells(frame, cells, scale)
    return frame.finish(scale, label, [], title)


def _surface_figure_scale(values_m: Sequence[FloatArray]) -> ColourScale:
    usual = float(np.percentile(np.abs(np.concatenate(values_m)), _USUAL_PERCENT)) * _MICRO if values_m else 1.0
    top = max(1.0, float(ceil(usual)))
    return ColourScale(-top, top, BELOW_TO_ABOVE)


def _draw_cells(frame: MapFrame, cells: Sequence[PanelCells], scale: ColourScale) -> None:
    frame.draw_panels()
    corners, values = [np.empty((0, 4))], [np.empty(0)]
    for x, y, found in cells:
        left, low = np.meshgrid(x[:-1], y[:-1])
        right, high = np.meshgrid(x[1:], y[1:])
        corners.append(np.column_stack([part.ravel() for part in (left, low, right, high)]))
        values.append(found.ravel() * _MICRO)
    boxes, levels = _whole(frame.boxes(np.concatenate(corners))), scale.levels(np.concatenate(values))
    palette = scale.palette()
    frame.shapes += [
        Boxes(boxes[levels == level], palette[level]) for level in range(LEVELS) if (levels == level).any()
    ]
    frame.draw_seams()
    frame.draw_rim()


def _whole(boxes: FloatArray) -> FloatArray:
    """Corners on whole pixels, so that cells that touch do so in every renderer."""
    start, end = np.rint(boxes[:, :2]), np.rint(boxes[:, :2] + boxes[:, 2:])
    return np.column_stack([start, end - start])


def _draw_measured(frame: MapFrame, panels: Sequence[PanelResult], scale: ColourScale) -> None:
    places = np.concatenate([panel.deviations.deck_m[panel.is_kept] for panel in panels])
    values = np.concatenate([panel.deviations.values_m[panel.is_kept] for panel in panels]) * _MICRO
    levels, palette = scale.levels(values), scale.palette()
    for level in np.unique(levels).tolist():
        dots = frame.pixels(places[levels == level])
        frame.shapes.append(Dots(dots, 2.8 if frame.is_wide else 1.4, palette[level], edge=QUIET))
