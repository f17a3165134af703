"""Pure. The mirror with the deviation of its surface, as fitted panel by panel and as measured point by point."""

from collections.abc import Sequence
from math import ceil

import numpy as np

from ccatp.aligning.displacement import on_grid_m
from ccatp.aligning.panel_result import PanelResult
from ccatp.drawing.colours import BAD, BELOW_TO_ABOVE, LEVELS, QUIET, ColourScale
from ccatp.drawing.shapes import Boxes, Dots, FloatArray, Picture, Shape
from ccatp.mirror.mirror import Mirror
from ccatp.reporting.map_frame import MapFrame

_CELLS_WIDE, _CELLS_NARROW = 8, 5
_MICRO = 1e6


def surface_figure(mirror: Mirror, panels: Sequence[PanelResult], title: str, width: float) -> Picture:
    """Draw the map: dots show what was measured in the same colours, and vanish where the fit agrees with it.

    Args:
        mirror: the mirror.
        panels: those that could be fitted.
        title: what the picture shows.
        width: of the picture, pixels.
    """
    frame = MapFrame(mirror, width)
    frame.draw_panels()
    scale = _scale(panels)
    cells, levels = _cells(mirror, panels, scale, _CELLS_WIDE if frame.is_wide else _CELLS_NARROW)
    palette = scale.palette()
    for level in range(LEVELS):
        if (levels == level).any():
            frame.shapes.append(Boxes(_whole(frame.boxes(cells[levels == level])), palette[level]))
    frame.draw_seams()
    frame.draw_rim()
    keys: list[tuple[str, Shape]] = []
    if panels:
        _draw_measured(frame, panels, scale)
        keys.append(("measured point", Dots(np.zeros((1, 2)), 3.4, palette[LEVELS // 2], edge=QUIET)))
    outliers = [panel.deviations.deck_m[~panel.is_kept] for panel in panels if not panel.is_kept.all()]
    if outliers:
        frame.shapes.append(Dots(frame.pixels(np.concatenate(outliers)), 4.0, BAD, "cross"))
        keys.append(("outlier, left out", Dots(np.zeros((1, 2)), 4.0, BAD, "cross")))
    return frame.finish(scale, "deviation along the normal, \u00b5m (> 0 towards the robot)", keys, title)


def _scale(panels: Sequence[PanelResult]) -> ColourScale:
    values = [np.abs(panel.deviations.values_m[panel.is_kept]) for panel in panels]
    # A single far point must not make all others look alike.
    usual = float(np.percentile(np.concatenate(values), 99)) * _MICRO if values else 1.0
    top = max(1.0, float(ceil(usual)))
    return ColourScale(-top, top, BELOW_TO_ABOVE)


def _cells(
    mirror: Mirror, panels: Sequence[PanelResult], scale: ColourScale, count: int
) -> tuple[FloatArray, "np.ndarray[tuple[int, ...], np.dtype[np.int64]]"]:
    corners, values = [np.empty((0, 4))], [np.empty(0)]
    for panel in panels:
        x, y, found = on_grid_m(mirror, panel, count)
        left, low = np.meshgrid(x[:-1], y[:-1])
        right, high = np.meshgrid(x[1:], y[1:])
        corners.append(np.column_stack([part.ravel() for part in (left, low, right, high)]))
        values.append(found.ravel() * _MICRO)
    return np.concatenate(corners), scale.levels(np.concatenate(values))


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
