"""Axes: from numbers to pixels, with round numbers beside them.

What a picture is made of. Lengths are CSS pixels, x to the right, y downwards; colours are ``#rrggbb``.

Colours: of ink and paper, of series, and scales from numbers to colours.

A picture as SVG text that needs nothing from outside: no fonts, no scripts, no references.

Long series made short without a visible change: lines by their corners, series by what a pixel shows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from html import escape
from math import ceil, floor, log10
from typing import Literal, NamedTuple

import numpy as np

from ccatp.core import FloatArray

Anchor = Literal["start", "middle", "end"]
Mark = Literal["disc", "ring", "cross"]


@dataclass(frozen=True, slots=True, eq=False)
class PolyLine:
    """An open line.

    Attributes:
        points: shape (k, 2); rows of NaN part it.
        dash: lengths of stroke and gap; empty for a full line.
        opacity: 0 to 1.
    """

    points: FloatArray
    colour: str
    width: float = 1.0
    dash: tuple[float, ...] = ()
    opacity: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Area:
    """A closed polygon of shape (k, 2); without ``fill`` only its outline, without ``width`` only its inside."""

    points: FloatArray
    fill: str | None = None
    colour: str = "#000000"
    width: float = 0.0
    opacity: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """Rectangles of one look: rows of left, top, width, height, shape (k, 4); without outline they leave no seams."""

    corners: FloatArray
    fill: str | None
    outline: str | None = None
    width: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Dots:
    """Marks of one look.

    Attributes:
        places: centres, shape (k, 2).
        colour: of the inside of a disc, of the stroke of a ring or a cross.
        titles: what each says when it is pointed at; empty or k texts.
    """

    places: FloatArray
    radius: float
    colour: str
    mark: Mark = "disc"
    titles: tuple[str, ...] = ()
    edge: str | None = None


@dataclass(frozen=True, slots=True)
class TextShape:
    """One line of text, its baseline at (x, y); ``turn_deg`` counts anticlockwise."""

    x: float
    y: float
    text: str
    size: float = 12.0
    colour: str = "#1f2933"
    anchor: Anchor = "start"
    is_bold: bool = False
    turn_deg: float = 0.0


Shape = PolyLine | Area | Boxes | Dots | TextShape


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """Shapes, the later above the earlier.

    Attributes:
        title: what it shows, in one line, for those who cannot see it and for file names.
    """

    width: float
    height: float
    shapes: tuple[Shape, ...]
    title: str


INK, QUIET, FAINT, PAPER = "#1f2933", "#5f6c7b", "#d5dce4", "#ffffff"
PANEL, SEAM, PATH, BAD, GOOD = "#f1f4f7", "#c5ced8", "#8fa3b8", "#c93f3f", "#1d7a55"
# Told apart by lightness as well, for those who do not see colours, and for printers.
SERIES = ("#123f6d", "#e0902f", "#1d8a99", "#a8577e", "#8a96a3", "#5b7f2b")
SMALL_TO_LARGE = ("#123f6d", "#1d8a99", "#f0b429")
BELOW_TO_ABOVE = ("#2f6aa5", "#a9cbe3", "#f7f7f5", "#f3c08c", "#c25a28")
LEVELS = 64  # of a scale; more are not told apart


@dataclass(frozen=True, slots=True)
class ColourScale:
    """Numbers to colours, in ``LEVELS`` steps; what lies beyond the ends has their colours.

    Attributes:
        low, high: numbers at the ends, low < high.
    """

    low: float
    high: float
    stops: Sequence[str]

    def levels(self, values: FloatArray) -> "np.ndarray[tuple[int, ...], np.dtype[np.int64]]":
        """Index of the colour of each value, 0 to ``LEVELS`` - 1."""
        part = (np.asarray(values) - self.low) / (self.high - self.low)
        return np.clip(np.floor(part * LEVELS), 0, LEVELS - 1).astype(np.int64)

    def palette(self) -> list[str]:
        """The colours of all levels."""
        stops = np.array([_channels(stop) for stop in self.stops], dtype=np.float64)
        at = np.linspace(0.0, len(stops) - 1.0, LEVELS)
        mixed = np.column_stack([np.interp(at, np.arange(len(stops)), channel) for channel in stops.T])
        return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in np.rint(mixed).astype(int).tolist()]

    def colour(self, value: float) -> str:
        """The colour of one value."""
        return self.palette()[int(self.levels(np.array([value]))[0])]


def _channels(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


_ROUND = (1.0, 2.0, 2.5, 5.0, 10.0)
# Mean width of a character of a sans-serif type, part of its size; only so well is known what a reader's screen has.
CHARACTER = 0.56


def ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers from low to high, at most so many.

    Args:
        low, high: the ends, low < high.
        most: at least 2.
    """
    least = (high - low) / most
    power = 10.0 ** floor(log10(least))
    step = next(part * power for part in _ROUND if part * power >= least * (1.0 - 1e-9))
    first, last = ceil(low / step - 1e-9), floor(high / step + 1e-9)
    return [round(i * step, 12) + 0.0 for i in range(first, last + 1)]


@dataclass(frozen=True, slots=True)
class PlotAxis:
    """One direction of a plot.

    Attributes:
        low, high: numbers at the ends; above 0 where logarithmic.
    """

    low: float
    high: float
    start: float
    end: float
    is_logarithmic: bool = False

    def pixels(self, values: FloatArray | float) -> FloatArray:
        """Where the numbers are; on a logarithmic axis what lies below its low end is put there."""
        found, low, high = np.asarray(values, dtype=np.float64), self.low, self.high
        if self.is_logarithmic:
            found, low, high = np.log10(np.maximum(found, low)), log10(low), log10(high)
        return np.asarray(self.start + (found - low) / (high - low) * (self.end - self.start))

    def pixel(self, value: float) -> float:
        """Where one number is."""
        return float(self.pixels(value))

    def ticks(self) -> list[float]:
        """The numbers to stand beside it."""
        length = abs(self.end - self.start)
        if self.is_logarithmic:
            return [10.0**power for power in range(ceil(log10(self.low) - 1e-9), floor(log10(self.high) + 1e-9) + 1)]
        return ticks(self.low, self.high, max(2, int(length / 70.0)))


def number_text(value: float) -> str:
    """A number as it stands beside an axis."""
    return f"{value:g}".replace("-", "\u2212")


@dataclass(slots=True)
class Plot:
    """A rectangle with two axes, and the shapes on it, in pixels."""

    left: float
    top: float
    right: float
    bottom: float
    x: PlotAxis
    y: PlotAxis
    size: float = 11.0
    shapes: list[Shape] = field(default_factory=list)

    def frame(self, x_label: str, y_label: str) -> None:
        """Grid, numbers and labels; before what is drawn on it."""
        self.shapes += [*self._across(y_label), *self.along(x_label)]

    def _across(self, label: str) -> Iterator[Shape]:
        widest = 0
        for value in self.y.ticks():
            y = self.y.pixel(value)
            text = number_text(value)
            widest = max(widest, len(text))
            yield PolyLine(np.array([[self.left, y], [self.right, y]]), FAINT, 0.8)
            yield TextShape(self.left - 6.0, y + 0.35 * self.size, text, self.size, QUIET, "end")
        x = self.left - 12.0 - CHARACTER * self.size * widest
        yield TextShape(x, (self.top + self.bottom) / 2.0, label, self.size, INK, "middle", turn_deg=90.0)

    def along(self, label: str) -> Iterator[Shape]:
        """The horizontal axis alone."""
        yield PolyLine(np.array([[self.left, self.bottom], [self.right, self.bottom]]), QUIET, 1.0)
        for value in self.x.ticks():
            x = self.x.pixel(value)
            yield PolyLine(np.array([[x, self.bottom], [x, self.bottom + 4.0]]), QUIET, 1.0)
            yield TextShape(x, self.bottom + 6.0 + self.size, number_text(value), self.size, QUIET, "middle")
        place = (self.left + self.right) / 2.0
        yield TextShape(place, self.bottom + 12.0 + 2.0 * self.size, label, self.size, INK, "middle")

    def line(self, x: FloatArray, y: FloatArray, colour: str, width: float = 1.4, dash: tuple[float, ...] = ()) -> None:
        """A series as a line; NaN parts it."""
        points = np.column_stack([self.x.pixels(x), np.clip(self.y.pixels(y), self.top - 2.0, self.bottom + 2.0)])
        self.shapes.append(PolyLine(points, colour, width, dash))

    def level(self, y: float, colour: str, dash: tuple[float, ...] = (6.0, 4.0)) -> None:
        """A number of the vertical axis, all the way across."""
        at = self.y.pixel(y)
        self.shapes.append(PolyLine(np.array([[self.left, at], [self.right, at]]), colour, 1.2, dash))


def legend(
    x: float, y: float, entries: Sequence[tuple[str, str]], size: float, most: float
) -> tuple[list[Shape], float]:
    """Coloured squares with names, in lines no longer than ``most``; returns them, and the height of them all."""
    shapes: list[Shape] = []
    at, line = x, y
    for name, colour in entries:
        width = 1.4 * size + CHARACTER * size * len(name) + 16.0
        if at + width > x + most and at > x:
            at, line = x, line + 1.6 * size
        shapes.append(Boxes(np.array([[at, line - 0.8 * size, 0.9 * size, 0.9 * size]]), colour))
        shapes.append(TextShape(at + 1.4 * size, line, name, size, INK))
        at += width
    return shapes, line - y + 1.6 * size


def colour_bar(
    scale: ColourScale, left: float, top: float, length: float, label: str, size: float, *, is_upright: bool
) -> list[Shape]:
    """A scale beside a map (upright) or below it, with numbers and what they are."""
    palette, thick = scale.palette(), 12.0
    edges = np.linspace(0.0, length, LEVELS + 1)
    shapes: list[Shape] = []
    for colour, start, end in zip(palette, edges[:-1], edges[1:], strict=True):
        box = [left, top + length - end, thick, end - start] if is_upright else [left + start, top, end - start, thick]
        shapes.append(Boxes(np.array([box]), colour))
    start, end = (top + length, top) if is_upright else (left, left + length)
    axis = PlotAxis(scale.low, scale.high, start, end)
    widest = 0
    for value in axis.ticks():
        at, text = axis.pixel(value), number_text(value)
        widest = max(widest, len(text))
        if is_upright:
            shapes.append(TextShape(left + thick + 5.0, at + 0.35 * size, text, size, QUIET))
        else:
            shapes.append(TextShape(at, top + thick + 4.0 + size, text, size, QUIET, "middle"))
    if is_upright:
        beside = left + thick + 16.0 + size + CHARACTER * size * widest
        shapes.append(TextShape(beside, top + length / 2.0, label, size, INK, "middle", turn_deg=90.0))
    else:
        shapes.append(TextShape(left + length / 2.0, top + thick + 10.0 + 2.0 * size, label, size, INK, "middle"))
    return shapes


FONT = "system-ui, 'Segoe UI', 'DejaVu Sans', Helvetica, Arial, sans-serif"


def svg_of(picture: Drawing, *, is_file: bool = False) -> str:
    """The picture as an ``svg`` element that shrinks with its page; with ``is_file``, as a file of its own.

    Args:
        is_file: a document of its own has a size and names its language.
    """
    name = escape(picture.title, quote=True)
    width, height = _number(picture.width), _number(picture.height)
    size = f' width="{width}" height="{height}" xmlns="http://www.w3.org/2000/svg"' if is_file else ""
    head = (
        f'<svg{size} viewBox="0 0 {width} {height}" role="img" aria-label="{name}" font-family="{FONT}" '
        'stroke-linejoin="round">'
    )
    paper = f'<rect width="{width}" height="{height}" fill="#fff"/>' if is_file else ""
    return f"{head}{paper}{''.join(_shape(shape) for shape in picture.shapes)}</svg>"


def _shape(shape: Shape) -> str:
    if isinstance(shape, PolyLine):
        return _line(shape)
    if isinstance(shape, Area):
        inside, outline = shape.fill or "none", _stroke(shape.colour, shape.width)
        path = f"M{_pairs(shape.points)}Z"
        return f'<path d="{path}" fill="{inside}"{outline}{_opacity(shape.opacity)}/>'
    if isinstance(shape, Boxes):
        return _boxes(shape)
    if isinstance(shape, Dots):
        return "".join(_dots(shape))
    return _text(shape)


def _line(line: PolyLine) -> str:
    pieces = "".join(f"M{_pairs(piece)}" for piece in _pieces(line.points))
    if not pieces:
        return ""
    dash = f' stroke-dasharray="{" ".join(map(_number, line.dash))}"' if line.dash else ""
    stroke = _stroke(line.colour, line.width)
    return f'<path d="{pieces}" fill="none"{stroke}{dash}{_opacity(line.opacity)}/>'


def _pieces(points: FloatArray) -> Iterator[FloatArray]:
    gaps = np.flatnonzero(np.isnan(points).any(axis=1)).tolist()
    start = 0
    for end in [*gaps, len(points)]:
        if end - start > 1:
            yield points[start:end]
        start = end + 1


def _boxes(boxes: Boxes) -> str:
    if not len(boxes.corners):
        return ""
    path = "".join(
        f"M{_number(x)} {_number(y)}h{_number(w)}v{_number(h)}h{_number(-w)}z" for x, y, w, h in boxes.corners.tolist()
    )
    # Touching boxes that are smoothed at their borders let the paper shine through.
    outline = ' shape-rendering="crispEdges"' if boxes.outline is None else _stroke(boxes.outline, boxes.width)
    inside = boxes.fill or "none"
    return f'<path d="{path}" fill="{inside}"{outline}/>'


def _dots(dots: Dots) -> Iterator[str]:
    if not len(dots.places):
        return
    if dots.mark == "disc":
        edge = _stroke(dots.edge, 0.7) if dots.edge else ""
        look = f'fill="{dots.colour}"{edge}'
    else:
        inside = "#fff" if dots.mark == "ring" else "none"
        look = f'fill="{inside}"{_stroke(dots.colour, 1.4)}'
    yield f"<g {look}>"
    titles = dots.titles or ("",) * len(dots.places)
    for (x, y), title in zip(dots.places.tolist(), titles, strict=True):
        yield _mark(dots, x, y, f"<title>{escape(title)}</title>" if title else "")
    yield "</g>"


def _mark(dots: Dots, x: float, y: float, title: str) -> str:
    r = dots.radius
    if dots.mark == "cross":
        a, b, c, d = (_number(value) for value in (x - r, y - r, x + r, y + r))
        element, rest = "path", f'd="M{a} {b}L{c} {d}M{a} {d}L{c} {b}"'
    else:
        element, rest = "circle", f'cx="{_number(x)}" cy="{_number(y)}" r="{_number(r)}"'
    return f"<{element} {rest}>{title}</{element}>" if title else f"<{element} {rest}/>"


def _text(text: TextShape) -> str:
    x, y = _number(text.x), _number(text.y)
    turn = f' transform="rotate({_number(-text.turn_deg)} {x} {y})"' if text.turn_deg else ""
    anchor = f' text-anchor="{text.anchor}"' if text.anchor != "start" else ""
    weight = ' font-weight="600"' if text.is_bold else ""
    look = f'font-size="{_number(text.size)}" fill="{text.colour}"{anchor}{weight}{turn}'
    return f'<text x="{x}" y="{y}" {look}>{escape(text.text)}</text>'


def _pairs(points: FloatArray) -> str:
    return "L".join(f"{_number(x)} {_number(y)}" for x, y in points.tolist())


def _stroke(colour: str, width: float) -> str:
    return f' stroke="{colour}" stroke-width="{_number(width)}"' if width else ""


def _opacity(opacity: float) -> str:
    return f' opacity="{_number(opacity)}"' if opacity < 1.0 else ""


def _number(value: float) -> str:
    """A tenth of a pixel is finer than anybody sees."""
    text = f"{value:.1f}" if abs(value) >= 1.0 or value == 0.0 else f"{value:.2f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def thinned(points: FloatArray, tolerance: float) -> FloatArray:
    """A line with fewer points that stays within ``tolerance`` of the given one (Ramer, Douglas and Peucker).

    Args:
        points: shape (k, 2); rows of NaN part the line, and stay.
        tolerance: in the unit of the points.
    """
    if not len(points):
        return points
    gap = np.isnan(points).any(axis=1)
    pieces: list[FloatArray] = []
    start = 0
    for end in [*np.flatnonzero(gap).tolist(), len(points)]:
        if end > start:
            pieces += [_thinned_piece(points[start:end], tolerance), np.full((1, 2), np.nan)]
        start = end + 1
    return np.concatenate(pieces[:-1]) if pieces else points[:0]


def _thinned_piece(points: FloatArray, tolerance: float) -> FloatArray:
    points = _without_standing(points, 0.5 * tolerance)
    keep = np.zeros(len(points), dtype=np.bool_)
    keep[[0, -1]] = True
    open_spans = [(0, len(points) - 1)]
    while open_spans:
        first, last = open_spans.pop()
        if last - first < 2:
            continue
        distances = _distances(points[first + 1 : last], points[first], points[last])
        worst = int(np.argmax(distances))
        if distances[worst] > 0.5 * tolerance:
            keep[first + 1 + worst] = True
            open_spans += [(first, first + 1 + worst), (first + 1 + worst, last)]
    return points[keep]


def _without_standing(points: FloatArray, step: float) -> FloatArray:
    """Leave out what hardly differs from the point kept before it."""
    rounded = np.floor(points / step)
    is_new = np.ones(len(points), dtype=np.bool_)
    is_new[1:] = (rounded[1:] != rounded[:-1]).any(axis=1)
    is_new[-1] = True
    return points[is_new]


def _distances(points: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """From the straight piece between two points, shape (k,)."""
    along = end - start
    length2 = float(along @ along)
    offset = points - start
    if length2 > 0.0:
        offset = offset - np.clip(offset @ along / length2, 0.0, 1.0)[:, None] * along
    return np.asarray(np.hypot(offset[:, 0], offset[:, 1]))


class Envelope(NamedTuple):
    """Least and largest value in each interval that has any: centres x, least y, largest y, mean y; shape (k,)."""

    x: FloatArray
    low: FloatArray
    high: FloatArray
    mean: FloatArray


def envelope(x: FloatArray, y: FloatArray, intervals: int) -> Envelope:
    """A series as so many intervals of equal length show it; values that are not finite are left out.

    Args:
        x: shape (k,), in any order.
        y: shape (k,).
        intervals: at least 1.
    """
    is_good = np.isfinite(x) & np.isfinite(y)
    x, y = x[is_good], y[is_good]
    if not len(x):
        empty = np.empty(0)
        return Envelope(empty, empty, empty, empty)
    low, high = float(x.min()), float(x.max())
    width = (high - low) / intervals or 1.0
    index = np.minimum(((x - low) / width).astype(np.int64), intervals - 1)
    order = np.argsort(index, kind="stable")
    found, starts, counts = np.unique(index[order], return_index=True, return_counts=True)
    sorted_y = y[order]
    return Envelope(
        low + (found + 0.5) * width,
        np.minimum.reduceat(sorted_y, starts),
        np.maximum.reduceat(sorted_y, starts),
        np.add.reduceat(sorted_y, starts) / counts,
    )
