"""Pure. Figures of two runs beside each other."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ccatp.aligning.displacement import on_grid_m
from ccatp.aligning.panel_result import PanelResult
from ccatp.drawing.axes import Axis, Plot, legend
from ccatp.drawing.colours import INK, SERIES
from ccatp.drawing.shapes import Dots, FloatArray, Line, Picture, Shape
from ccatp.drawing.thinning import envelope, thinned
from ccatp.mirror.mirror import Mirror
from ccatp.reporting.errors import ErrorSeries
from ccatp.reporting.map_frame import MapFrame
from ccatp.reporting.path_figure import driven_path_m
from ccatp.reporting.record import RunRecord
from ccatp.reporting.surface_figure import PanelCells, cells_figure

_COLOURS = (SERIES[0], SERIES[1])
_LEAST_MM = 1e-3
_DASH = (4.0, 3.0)
_TOLERANCE_PX = 0.6
_KEY_LINE = np.array([(-9.0, 0.0), (9.0, 0.0)])
Draw = Callable[[float], Picture]
_CELLS = 8


def distribution_figure(values: Mapping[str, FloatArray], label: str, width: float) -> Picture:
    """Share of the values below each number, for each run, on a logarithmic axis.

    Args:
        values: by the name of the run, none of them empty.
        label: what they are, with their unit.
        width: of the picture, pixels.
    """
    is_wide = width > 500.0
    left, top, right, bottom = 62.0, 12.0, width - 12.0, 240.0
    everything = np.maximum(np.concatenate(list(values.values())), _LEAST_MM)
    low, high = 10.0 ** np.floor(np.log10(everything.min())), 10.0 ** np.ceil(np.log10(everything.max() * 1.001))
    x = Axis(float(low), float(high), left, right, is_logarithmic=True)
    plot = Plot(left, top, right, bottom, x, Axis(0.0, 100.0, bottom, top), 11.5 if is_wide else 10.5)
    plot.frame(label, "% of them below")
    for (_, some), colour in zip(values.items(), _COLOURS, strict=False):
        ordered = np.sort(np.maximum(some, _LEAST_MM))
        share = 100.0 * np.arange(1, len(ordered) + 1) / len(ordered)
        # A step at each value.
        plot.line(np.repeat(ordered, 2)[1:], np.repeat(share, 2)[:-1], colour, 1.8)
    return _with_legend(plot, list(values), width, f"distribution of {label}")


def errors_figure(series: Mapping[str, ErrorSeries], width: float) -> Picture:
    """The largest localization error of each time, for each run, and three sigma of the estimate, dashed."""
    is_wide = width > 500.0
    left, top, right, bottom = 62.0, 10.0, width - 12.0, 280.0
    shown = {name: _known(found) for name, found in series.items()}
    everything = np.concatenate([*(values for _, values in shown.values()), *(f.sigma3_mm for f in series.values())])
    largest = max(float(everything.max()), 0.01)
    end = max(float(found.t_s[-1]) for found in series.values()) / 60.0
    y = Axis(_LEAST_MM, 1.5 * largest, bottom, top, is_logarithmic=True)
    plot = Plot(left, top, right, bottom, Axis(0.0, max(end, 0.1), left, right), y, 11.5 if is_wide else 10.5)
    plot.frame("robot time, min", "mm")
    intervals = max(1, int((right - left) / 2.0))
    for found, (t_s, values), colour in zip(series.values(), shown.values(), _COLOURS, strict=False):
        sigma, errors = envelope(found.t_s, found.sigma3_mm, intervals), envelope(t_s, values, intervals)
        places = np.column_stack([plot.x.pixels(sigma.x / 60.0), plot.y.pixels(sigma.high)])
        plot.shapes.append(Line(places, colour, 0.9, _DASH, 0.7))
        plot.line(errors.x / 60.0, errors.high, colour, 1.4)
    names = [name if np.isfinite(found.error_mm).any() else f"{name} (3 \u03c3)" for name, found in series.items()]
    return _with_legend(plot, names, width, "largest localization error over time")


def _known(series: ErrorSeries) -> tuple[FloatArray, FloatArray]:
    is_known = np.isfinite(series.error_mm)
    if is_known.any():
        return series.t_s[is_known], series.error_mm[is_known]
    return series.t_s, series.sigma3_mm


def _with_legend(plot: Plot, names: Sequence[str], width: float, title: str) -> Picture:
    entries = list(zip(names, _COLOURS, strict=False))
    shapes, height = legend(12.0, plot.bottom + 56.0, entries, plot.size, width - 24.0)
    return Picture(width, plot.bottom + 48.0 + height, (*plot.shapes, *shapes), title)


def paths_figure(mirror: Mirror, records: Mapping[str, RunRecord], width: float) -> Picture:
    """The mirror with the paths of both runs, the later one above the earlier one."""
    frame = MapFrame(mirror, width)
    frame.draw_panels()
    frame.draw_rim()
    keys: list[tuple[str, Shape]] = []
    for (name, record), colour, thick in zip(records.items(), _COLOURS, (2.6, 0.9), strict=False):
        path = driven_path_m(record)
        if len(path):
            frame.shapes.append(Line(thinned(frame.pixels(path), _TOLERANCE_PX), colour, thick))
            keys.append((name, Line(_KEY_LINE, colour, thick)))
    frame.draw_base()
    keys.append(("base", Dots(np.zeros((1, 2)), 4.0, INK)))
    return frame.finish(None, "", keys, f"{mirror.name}: both paths")


def change_figure(mirror: Mirror, before: Sequence[PanelResult], after: Sequence[PanelResult], width: float) -> Picture:
    """The mirror with what the later survey shows less the earlier one."""
    earlier = {panel.panel: panel for panel in before}
    cells = []
    for panel in after:
        if panel.panel in earlier:
            x, y, later = on_grid_m(mirror, panel, _CELLS)
            cells.append(PanelCells(x, y, later - on_grid_m(mirror, earlier[panel.panel], _CELLS)[2]))
    label = "change along the normal, \u00b5m (> 0 towards the robot)"
    return cells_figure(mirror, cells, label, f"{mirror.name}: change of the surface", width)
