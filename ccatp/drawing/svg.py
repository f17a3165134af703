"""Pure. A picture as SVG text that needs nothing from outside: no fonts, no scripts, no references."""

from collections.abc import Iterator
from html import escape

import numpy as np

from ccatp.drawing.shapes import Area, Boxes, Dots, FloatArray, Line, Picture, Shape, Text

FONT = "system-ui, 'Segoe UI', 'DejaVu Sans', Helvetica, Arial, sans-serif"


def svg_of(picture: Picture, *, is_file: bool = False) -> str:
    """The picture as an ``svg`` element that shrinks with its page; with ``is_file``, as a file of its own.

    Args:
        picture: what to write.
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
    if isinstance(shape, Line):
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


def _line(line: Line) -> str:
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


def _text(text: Text) -> str:
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
