"""Edge. The alignment of a mirror as a picture: deviations in colour, and the moves of the adjusters in figures.

Imports matplotlib, which takes a second, only when something is drawn.
"""

from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccatp.aligning.displacement import on_grid_m
from ccatp.aligning.moves import adjuster_places
from ccatp.aligning.panel_result import PanelResult
from ccatp.aligning.survey_result import SurveyResult
from ccatp.mirror.mirror import Mirror
from ccatp.pictures.deck_map import add_colour_bar, new_deck_map, write_title
from ccatp.pictures.figures import BAD, INK, QUIET, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap, Normalize

    Colours = tuple[Colormap, Normalize]

WIDTH_PX = 2400
DPI = 200
_CELLS = 12  # along each side of a panel
_COLOURS = ("#5a8fc4", "#a9cbe3", "#f7f7f5", "#f3c08c", "#d5703f")  # below, ideal, above; figures stay legible on each
_MICRO = 1e6


def draw_alignment(mirror: Mirror, result: SurveyResult, out: Path, title: str, subtitle: str = "") -> None:
    """Draw the alignment into an image file.

    Each panel shows its fitted displacement, with its curvatures where they are significant; a dot shows what was
    measured at its place in the same colours, so that it vanishes where the fit agrees with it; a cross is an outlier.

    Args:
        mirror: the mirror.
        result: its alignment.
        out: the file; its suffix tells the format (PNG, PDF, SVG).
        title: first line.
        subtitle: second line.

    Raises:
        PictureError: the file cannot be written.
    """
    figure, axes = new_deck_map(mirror, WIDTH_PX, DPI)
    colours = _colours(result)
    for panel in result.panels:
        _draw_panel(axes, mirror, panel, colours)
    _draw_bar(axes, colours)
    legend = "figures: moves of the vertical adjusters, um, > 0 towards the robot; dots: measured points"
    write_title(axes, title + _half_wavefront(result), "  ·  ".join(filter(None, (subtitle, legend))))
    save_figure(figure, out)


def _half_wavefront(result: SurveyResult) -> str:
    if result.wavefront is None:
        return ""
    before, after = result.wavefront.before_m * _MICRO, result.wavefront.after_m * _MICRO
    return f", half-wavefront error {before:.1f} um rms, {after:.1f} after the moves"


def _colours(result: SurveyResult) -> "Colours":
    from matplotlib.colors import LinearSegmentedColormap, Normalize  # noqa: PLC0415 - see above

    values = [np.abs(p.deviations.values_m[p.is_kept]) for p in result.panels]
    # A single far point must not make all others look alike.
    usual = float(np.percentile(np.concatenate(values), 99)) * _MICRO if values else 1.0
    top = max(1.0, float(ceil(usual)))
    return LinearSegmentedColormap.from_list("deviation", _COLOURS), Normalize(-top, top)


def _draw_panel(axes: "Axes", mirror: Mirror, panel: PanelResult, colours: "Colours") -> None:
    from matplotlib.patches import Rectangle  # noqa: PLC0415 - see above

    body, found, (cmap, norm) = mirror.panel(panel.panel), panel.deviations, colours
    x, y, values = on_grid_m(mirror, panel, _CELLS)
    axes.pcolormesh(x, y, values * _MICRO, cmap=cmap, norm=norm, zorder=2, rasterized=True)
    size = 2.0 * body.half_x_m, 2.0 * body.half_y_m
    axes.add_patch(Rectangle((x[0], y[0]), *size, fill=False, edgecolor=QUIET, linewidth=0.7, zorder=3))
    (dots_x, dots_y), heights = found.deck_m[panel.is_kept].T, found.values_m[panel.is_kept] * _MICRO
    axes.scatter(dots_x, dots_y, c=heights, cmap=cmap, norm=norm, s=22, edgecolors=QUIET, linewidths=0.3, zorder=5)
    crosses_x, crosses_y = found.deck_m[~panel.is_kept].T
    axes.scatter(crosses_x, crosses_y, marker="x", color=BAD, s=36, linewidths=1.6, zorder=6)
    small: dict[str, Any] = {"ha": "center", "va": "top", "fontsize": 5.5, "color": INK, "zorder": 6}
    names, adjusters = adjuster_places(mirror, panel.panel)
    for name, place, move in zip(names, adjusters.tolist(), panel.rigid.moves.values_m, strict=True):
        deck_x, deck_y, _ = body.to_deck((*place, 0.0))
        axes.text(deck_x, deck_y - 0.025, f"{name} {_MICRO * move:+.0f}", **small)


def _draw_bar(axes: "Axes", colours: "Colours") -> None:
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415 - see above

    cmap, norm = colours
    label = "deviation along the normal, um, > 0 towards the robot"
    add_colour_bar(axes, ScalarMappable(norm, cmap), label, extend="both")
