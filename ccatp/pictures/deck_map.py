"""Edge. The mirror as the ground of a figure, deck frame: panels, rim, base, a colour bar beside it."""

from math import cos, sin
from typing import TYPE_CHECKING, Any

from ccatp.drawing.colours import PANEL, SEAM
from ccatp.mirror.mirror import Mirror
from ccatp.pictures.figures import INK, QUIET, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colorbar import Colorbar
    from matplotlib.figure import Figure

_MARGIN_M = 0.25  # around the mirror
_LEFT_IN, _BOTTOM_IN, _BESIDE_IN, _ABOVE_AND_BELOW_IN = 0.75, 0.85, 1.6, 1.6  # for labels, legend and colour bar


def new_deck_map(mirror: Mirror, width_px: float, dpi: float) -> "tuple[Figure, Axes]":
    """A figure with the panels, their columns and rows, and the rim; both axes in metres, to the same scale.

    Args:
        mirror: what is shown.
        width_px: of the picture; its height follows.
        dpi: pixels an inch.
    """
    low, high = mirror.rim.vertices.min(axis=0) - _MARGIN_M, mirror.rim.vertices.max(axis=0) + _MARGIN_M
    width = width_px / dpi
    map_width = width - _BESIDE_IN
    map_height = map_width * float((high[1] - low[1]) / (high[0] - low[0]))
    height = map_height + _ABOVE_AND_BELOW_IN
    figure = new_figure(width, height, dpi, layout=None)
    axes = figure.add_axes((_LEFT_IN / width, _BOTTOM_IN / height, map_width / width, map_height / height))
    _draw_panels(axes, mirror)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", autoscale_on=False)
    axes.set(xlabel="x, m (deck frame)", ylabel="y, m (deck frame)")
    axes.tick_params(labelsize=8, color=QUIET, labelcolor=INK)
    for side in axes.spines.values():
        side.set_visible(False)
    return figure, axes


def draw_base(axes: "Axes", mirror: Mirror) -> None:
    """Draw where the robot starts, and its heading."""
    base = mirror.base_pose
    ahead = {"dx": 0.18 * cos(base.heading_rad), "dy": 0.18 * sin(base.heading_rad)}
    shape = {"width": 0.035, "head_width": 0.11, "head_length": 0.09, "length_includes_head": True}
    axes.arrow(base.x_m, base.y_m, **ahead, **shape, color=INK, linewidth=0, zorder=6)
    axes.plot(base.x_m, base.y_m, "o", color=INK, markersize=9, zorder=6, linestyle="", label="base")


def write_title(axes: "Axes", title: str, subtitle: str) -> None:
    """Two lines above the map."""
    axes.text(0.0, 1.045, title, transform=axes.transAxes, fontsize=15, color=INK)
    axes.text(0.0, 1.018, subtitle, transform=axes.transAxes, fontsize=9, color=QUIET)


def add_colour_bar(axes: "Axes", drawn: "ScalarMappable", label: str, **look: Any) -> "Colorbar":
    """What the colours of ``drawn`` mean, to the right of the map; ``look`` goes to matplotlib."""
    figure, place = axes.figure, axes.get_position()
    bar_axes = figure.add_axes((place.x1 + 0.006, place.y0 + 0.2 * place.height, 0.013, 0.6 * place.height))
    bar = figure.colorbar(drawn, cax=bar_axes, **look)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, color=QUIET, labelcolor=INK)
    bar.set_label(label, fontsize=9, color=INK)
    return bar


def _draw_panels(axes: "Axes", mirror: Mirror) -> None:
    from matplotlib.collections import PatchCollection  # noqa: PLC0415 - see above
    from matplotlib.patches import Polygon, Rectangle  # noqa: PLC0415

    tiles = [
        Rectangle((p.x_m - p.half_x_m, p.y_m - p.half_y_m), 2 * p.half_x_m, 2 * p.half_y_m)
        for p in mirror.panels.values()
    ]
    axes.add_collection(PatchCollection(tiles, facecolor=PANEL, edgecolor=SEAM, linewidth=0.7, zorder=1))
    axes.add_patch(Polygon(mirror.rim.vertices, closed=True, fill=False, edgecolor=INK, linewidth=1.5, zorder=2))
    small: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7.5, "color": QUIET}
    (low_x, low_y) = mirror.rim.vertices.min(axis=0)
    for col, x in {p.id.col: p.x_m for p in mirror.panels.values()}.items():
        axes.text(x, low_y - 0.12, f"column {col}" if col == 1 else f"{col}", **small)
    for row, y in {p.id.row: p.y_m for p in mirror.panels.values()}.items():
        axes.text(low_x - 0.12, y, f"row {row}" if row == 1 else f"{row}", rotation=90, **small)
