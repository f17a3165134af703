"""Pure. The mirror with the deviation of its surface, as fitted panel by panel and as measured point by point."""

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

import numpy as np

from ccatp.aligning.displacement import on_grid_m
from ccatp.aligning.panel_result import PanelResult
from ccatp.drawing.colours import BAD, BELOW_TO_ABOVE, LEVELS, QUIET, ColourScale
from ccatp.drawing.shapes import Boxes, Dots, FloatArray, Picture, Shape
from ccatp.mirror.mirror import Mirror
from ccatp.reporting.map_frame import MapFrame

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
) -> Picture:
    """Draw the map: dots show what was measured in the same colours, and vanish where the fit agrees with it.

    Args:
        mirror: the mirror.
        panels: those that could be fitted.
        title: what the picture shows.
        width: of the picture, pixels.
        scaled_as: panels that the colours are to span; those shown if not given.
    """
    frame = MapFrame(mirror, width)
    spanned = panels if scaled_as is None else scaled_as
    scale = _scale([panel.deviations.values_m[panel.is_kept] for panel in spanned])
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


def cells_figure(mirror: Mirror, cells: Sequence[PanelCells], label: str, title: str, width: float) -> Picture:
    """Draw values without measured points; ``label`` is what they are, with their unit, um."""
    frame = MapFrame(mirror, width)
    scale = _scale([one.values_m.ravel() for one in cells])
    _draw_cells(frame, cells, scale)
    return frame.finish(scale, label, [], title)


def _scale(values_m: Sequence[FloatArray]) -> ColourScale:
    usual = float(np.percentile(np.abs(np.concatenate(values_m)), _USUAL_PERCENT)) * _MICRO if values_m else 1.0
    top = max(1.0, float(ceil(usual)))
    return ColourScale(-top, top, BELOW_TO_ABOVE)


def _draw_cells(frame: MapFrame, cells: Sequence[PanelCells], scale: ColourScale) -> None:
    """Panels, their values in colour, seams and rim."""
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
