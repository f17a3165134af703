"""Pure. What a picture is made of. Lengths are CSS pixels, x to the right, y downwards; colours are ``#rrggbb``."""

from dataclasses import dataclass
from typing import Literal

from ccatp.samples import FloatArray

Anchor = Literal["start", "middle", "end"]
Mark = Literal["disc", "ring", "cross"]


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """An open line.

    Attributes:
        points: shape (k, 2); rows of NaN part it.
        colour: of the stroke.
        width: of the stroke.
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
        radius: half their size.
        colour: of the inside of a disc, of the stroke of a ring or a cross.
        mark: disc, ring or cross.
        titles: what each says when it is pointed at; empty or k texts.
        edge: colour of a thin line around a disc.
    """

    places: FloatArray
    radius: float
    colour: str
    mark: Mark = "disc"
    titles: tuple[str, ...] = ()
    edge: str | None = None


@dataclass(frozen=True, slots=True)
class Text:
    """One line of text, its baseline at (x, y); ``turn_deg`` counts anticlockwise."""

    x: float
    y: float
    text: str
    size: float = 12.0
    colour: str = "#1f2933"
    anchor: Anchor = "start"
    is_bold: bool = False
    turn_deg: float = 0.0


Shape = Line | Area | Boxes | Dots | Text


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """Shapes, the later above the earlier.

    Attributes:
        width, height: of the whole.
        shapes: what is on it.
        title: what it shows, in one line, for those who cannot see it and for file names.
    """

    width: float
    height: float
    shapes: tuple[Shape, ...]
    title: str
