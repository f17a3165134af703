"""Pure. The mirror as a picture's ground: panels, rim, numbers of rows and columns, a colour bar beside or below."""

from dataclasses import dataclass, field
from math import cos, sin

import numpy as np

from ccatp.drawing.axes import CHARACTER, colour_bar
from ccatp.drawing.colours import INK, PANEL, PAPER, QUIET, SEAM, ColourScale
from ccatp.drawing.shapes import Area, Boxes, Dots, FloatArray, Line, Picture, Shape, Text
from ccatp.mirror.mirror import Mirror
from ccatp.reporting.html import NARROW

_MARGIN_M = 0.04  # around the rim


@dataclass(slots=True)
class MapFrame:
    """A map of a mirror, deck frame: x to the right, y up.

    Attributes:
        mirror: what is shown.
        width: of the picture, pixels.
        shapes: what was drawn.
    """

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
            self.shapes.append(Text(x, self.bottom + 4.0 + self.size, str(col), self.size, QUIET, "middle"))
        for row, y_m in {p.id.row: p.y_m for p in panels}.items():
            ((_, y),) = self.pixels(np.array([(0.0, y_m)])).tolist()
            self.shapes.append(Text(self._left - 5.0, y + 0.35 * self.size, str(row), self.size, QUIET, "end"))

    def draw_base(self) -> None:
        """Where the robot starts, and its heading."""
        base = self.mirror.base_pose
        here = np.array([(base.x_m, base.y_m)])
        ahead = here + 0.2 * np.array([(cos(base.heading_rad), sin(base.heading_rad))])
        self.shapes.append(Line(self.pixels(np.concatenate([here, ahead])), INK, 2.4))
        self.shapes.append(Dots(self.pixels(here), 4.5 if self.is_wide else 3.0, INK, titles=("base",)))

    def finish(self, scale: ColourScale | None, label: str, keys: list[tuple[str, Shape]], title: str) -> Picture:
        """Colour bar and legend; then it is a picture.

        Args:
            scale: of the colours, and ``label`` what they mean; None where they mean nothing.
            keys: names, each with a shape drawn around the origin.
            title: what the picture shows.
        """
        y = self.bottom + 2.2 * self.size + 12.0
        if scale is None:
            return Picture(self.width, self._legend(keys, y) + 8.0, tuple(self.shapes), title)
        if self.is_wide:
            length = min(420.0, 0.7 * self.bottom)
            top = (self.bottom - length) / 2.0
            self.shapes += colour_bar(scale, self.width - 80.0, top, length, label, self.size, is_upright=True)
        else:
            self.shapes += colour_bar(scale, 30.0, y - 8.0, self.width - 60.0, label, self.size, is_upright=False)
            y += 58.0
        return Picture(self.width, self._legend(keys, y) + 8.0, tuple(self.shapes), title)

    def _legend(self, keys: list[tuple[str, Shape]], y: float) -> float:
        x = self._left
        for name, shape in keys:
            width = 30.0 + CHARACTER * self.size * len(name) + 14.0
            if x + width > self.width and x > self._left:
                x, y = self._left, y + 1.7 * self.size
            self.shapes.append(_moved(shape, x + 10.0, y - 0.35 * self.size))
            self.shapes.append(Text(x + 26.0, y, name, self.size, INK))
            x += width
        return y


def _moved(shape: Shape, x: float, y: float) -> Shape:
    if isinstance(shape, Dots):
        return Dots(shape.places + np.array((x, y)), shape.radius, shape.colour, shape.mark, (), shape.edge)
    if isinstance(shape, Line):
        return Line(shape.points + np.array((x, y)), shape.colour, shape.width, shape.dash)
    raise TypeError(f"a legend shows dots and lines, no {type(shape).__name__}")
