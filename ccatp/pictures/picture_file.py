"""Edge. Pictures as files: SVG by our own writer, PNG and PDF by matplotlib, shape by shape the same.

Imports matplotlib, which takes a second, only when something is drawn.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccatp.drawing.shapes import Area, Boxes, Dots, Line, Picture, Shape, Text
from ccatp.drawing.svg import svg_of
from ccatp.pictures.figures import PictureError, new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import Collection
    from matplotlib.figure import Figure

DPI = 96.0  # a CSS pixel is a 96th of an inch
_PNG_SCALE = 2.0
_POINTS = 72.0 / DPI
_ANCHORS = {"start": "left", "middle": "center", "end": "right"}


def write_svg(picture: Picture, path: Path) -> None:
    """Write a picture as SVG.

    Raises:
        PictureError: the file cannot be written.
    """
    try:
        path.write_text(svg_of(picture, is_file=True) + "\n", encoding="utf-8")
    except OSError as error:
        raise PictureError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_figures(picture: Picture, stem: Path) -> list[Path]:
    """Write a picture as ``stem.png``, at twice its size, and as ``stem.pdf``; returns the files.

    Raises:
        PictureError: a file cannot be written.
    """
    figure = _figure(picture)
    paths = [stem.with_name(stem.name + suffix) for suffix in (".png", ".pdf")]
    for path in paths:
        save_figure(figure, path, DPI * _PNG_SCALE)
    return paths


def _figure(picture: Picture) -> "Figure":
    figure = new_figure(picture.width / DPI, picture.height / DPI, DPI, layout=None)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, picture.width), ylim=(picture.height, 0.0))
    axes.axis("off")
    for order, shape in enumerate(picture.shapes):
        if isinstance(shape, Text):
            _add_text(axes, shape, order)
        elif isinstance(shape, Line):
            _add_line(axes, shape, order)
        else:
            for collection in _collections(axes, shape):
                collection.set_zorder(order)
                axes.add_collection(collection, autolim=False)
    return figure


def _add_text(axes: "Axes", text: Text, order: int) -> None:
    axes.text(
        text.x,
        text.y,
        text.text.replace("$", r"\$"),
        fontsize=text.size * _POINTS,
        color=text.colour,
        ha=_ANCHORS[text.anchor],
        va="baseline",
        fontweight="semibold" if text.is_bold else "normal",
        rotation=text.turn_deg,
        rotation_mode="anchor",
        zorder=order,
    )


def _add_line(axes: "Axes", line: Line, order: int) -> None:
    width = line.width * _POINTS
    # Matplotlib counts dashes in line widths.
    dash: Any = (0.0, [length / line.width for length in line.dash]) if line.dash else "solid"
    axes.plot(*line.points.T, color=line.colour, linewidth=width, linestyle=dash, alpha=line.opacity, zorder=order)


def _collections(axes: "Axes", shape: Shape) -> "Iterator[Collection]":
    from matplotlib.collections import CircleCollection, LineCollection, PolyCollection  # noqa: PLC0415 - see above

    if isinstance(shape, Area):
        edge = shape.colour if shape.width else "none"
        look: dict[str, Any] = {"facecolor": shape.fill or "none", "edgecolor": edge, "alpha": shape.opacity}
        yield PolyCollection([shape.points], linewidth=shape.width * _POINTS, **look)
    elif isinstance(shape, Boxes):
        x, y, w, h = shape.corners.T
        outlines = np.stack([np.column_stack(p) for p in ((x, y), (x + w, y), (x + w, y + h), (x, y + h))], axis=1)
        is_plain = shape.outline is None
        look = {"facecolor": shape.fill or "none", "edgecolor": shape.outline or "none", "antialiased": not is_plain}
        yield PolyCollection(list(outlines), linewidth=shape.width * _POINTS, **look)
    elif isinstance(shape, Dots) and shape.mark == "cross":
        r = shape.radius
        arms = [np.array([(x - r, y + s * r), (x + r, y - s * r)]) for x, y in shape.places for s in (1.0, -1.0)]
        yield LineCollection(arms, colors=shape.colour, linewidths=1.4 * _POINTS)
    elif isinstance(shape, Dots):
        is_disc = shape.mark == "disc"
        area = np.pi * (shape.radius * _POINTS) ** 2
        yield CircleCollection(
            [area],
            offsets=shape.places,
            offset_transform=axes.transData,
            facecolor=shape.colour if is_disc else "white",
            edgecolor=(shape.edge or "none") if is_disc else shape.colour,
            linewidth=(0.7 if is_disc else 1.4) * _POINTS,
        )
