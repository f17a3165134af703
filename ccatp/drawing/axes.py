"""Pure. Axes: from numbers to pixels, with round numbers beside them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import ceil, floor, log10

import numpy as np

from ccatp.drawing.colours import FAINT, INK, LEVELS, QUIET, ColourScale
from ccatp.drawing.shapes import Boxes, FloatArray, Line, Shape, Text

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
class Axis:
    """One direction of a plot.

    Attributes:
        low, high: numbers at the ends; above 0 where logarithmic.
        start, end: pixels there.
        is_logarithmic: equal ratios are equal lengths.
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
    """A rectangle with two axes, and the shapes on it, in pixels.

    Attributes:
        left, top, right, bottom: of the rectangle.
        x, y: its axes.
        size: of the numbers beside it.
        shapes: what was drawn.
    """

    left: float
    top: float
    right: float
    bottom: float
    x: Axis
    y: Axis
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
            yield Line(np.array([[self.left, y], [self.right, y]]), FAINT, 0.8)
            yield Text(self.left - 6.0, y + 0.35 * self.size, text, self.size, QUIET, "end")
        x = self.left - 12.0 - CHARACTER * self.size * widest
        yield Text(x, (self.top + self.bottom) / 2.0, label, self.size, INK, "middle", turn_deg=90.0)

    def along(self, label: str) -> Iterator[Shape]:
        """The horizontal axis alone."""
        yield Line(np.array([[self.left, self.bottom], [self.right, self.bottom]]), QUIET, 1.0)
        for value in self.x.ticks():
            x = self.x.pixel(value)
            yield Line(np.array([[x, self.bottom], [x, self.bottom + 4.0]]), QUIET, 1.0)
            yield Text(x, self.bottom + 6.0 + self.size, number_text(value), self.size, QUIET, "middle")
        place = (self.left + self.right) / 2.0
        yield Text(place, self.bottom + 12.0 + 2.0 * self.size, label, self.size, INK, "middle")

    def line(self, x: FloatArray, y: FloatArray, colour: str, width: float = 1.4, dash: tuple[float, ...] = ()) -> None:
        """A series as a line; NaN parts it."""
        points = np.column_stack([self.x.pixels(x), np.clip(self.y.pixels(y), self.top - 2.0, self.bottom + 2.0)])
        self.shapes.append(Line(points, colour, width, dash))

    def level(self, y: float, colour: str, dash: tuple[float, ...] = (6.0, 4.0)) -> None:
        """A number of the vertical axis, all the way across."""
        at = self.y.pixel(y)
        self.shapes.append(Line(np.array([[self.left, at], [self.right, at]]), colour, 1.2, dash))


def legend(
    x: float, y: float, entries: Sequence[tuple[str, str]], size: float, most: float
) -> tuple[list[Shape], float]:
    """Coloured squares with names, in lines no longer than ``most``; returns them, and the height of them all.

    Args:
        x, y: left end and baseline of the first line.
        entries: name and colour.
        size: of the type.
        most: pixels in a line.
    """
    shapes: list[Shape] = []
    at, line = x, y
    for name, colour in entries:
        width = 1.4 * size + CHARACTER * size * len(name) + 16.0
        if at + width > x + most and at > x:
            at, line = x, line + 1.6 * size
        shapes.append(Boxes(np.array([[at, line - 0.8 * size, 0.9 * size, 0.9 * size]]), colour))
        shapes.append(Text(at + 1.4 * size, line, name, size, INK))
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
    axis = Axis(scale.low, scale.high, start, end)
    widest = 0
    for value in axis.ticks():
        at, text = axis.pixel(value), number_text(value)
        widest = max(widest, len(text))
        if is_upright:
            shapes.append(Text(left + thick + 5.0, at + 0.35 * size, text, size, QUIET))
        else:
            shapes.append(Text(at, top + thick + 4.0 + size, text, size, QUIET, "middle"))
    if is_upright:
        beside = left + thick + 16.0 + size + CHARACTER * size * widest
        shapes.append(Text(beside, top + length / 2.0, label, size, INK, "middle", turn_deg=90.0))
    else:
        shapes.append(Text(left + length / 2.0, top + thick + 10.0 + 2.0 * size, label, size, INK, "middle"))
    return shapes
