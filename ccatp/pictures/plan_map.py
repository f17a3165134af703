"""Edge. The way of a planned survey as a picture, coloured by the time at which the robot is there.

Needs the extra ``plots`` (matplotlib), imported only when something is drawn.
"""

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccatp.mirror.mirror import Mirror
from ccatp.pictures.run_map import RunMapError, draw_base, draw_panels
from ccatp.samples import StopKind
from ccatp.survey_plan import SurveyPlan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection

WIDTH_PX = 1600
DPI = 160
_INK, _QUIET, _BAD = "#1f2933", "#6b7785", "#d64545"
_COLOURS = ("#123f6d", "#1d8a99", "#f0b429")  # early to late


def draw_plan(mirror: Mirror, plan: SurveyPlan, out: Path) -> None:
    """Draw a plan into an image file.

    Args:
        mirror: where the survey would be.
        plan: its plan.
        out: the file; its suffix tells the format (PNG, PDF, SVG).

    Raises:
        RunMapError: matplotlib is not installed, or the file cannot be written.
    """
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415 - takes a second, and belongs to an extra
    except ImportError as error:
        raise RunMapError("drawing needs matplotlib: install ccatp with its extra, ccatp[plots]") from error
    low, high = mirror.rim.vertices.min(axis=0), mirror.rim.vertices.max(axis=0)
    width = WIDTH_PX / DPI
    height = (width - 1.6) * float((high[1] - low[1] + 0.5) / (high[0] - low[0] + 0.5)) + 1.6
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    axes = figure.add_axes((0.75 / width, 0.85 / height, (width - 1.6) / width, (height - 1.6) / height))
    draw_panels(axes, mirror)
    draw_base(axes, mirror)
    lines, place = _draw_way(axes, mirror, plan), axes.get_position()
    bar_axes = figure.add_axes((place.x1 + 0.006, place.y0 + 0.2 * place.height, 0.013, 0.6 * place.height))
    bar = figure.colorbar(lines, cax=bar_axes)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, color=_QUIET, labelcolor=_INK)
    bar.set_label("time, min", fontsize=9, color=_INK)
    _draw_stops(axes, mirror, plan)
    axes.set(xlim=(low[0] - 0.25, high[0] + 0.25), ylim=(low[1] - 0.25, high[1] + 0.25), aspect="equal")
    axes.set(xlabel="x, m (deck frame)", ylabel="y, m (deck frame)")
    title = f"{mirror.name}: {len(plan.points) - len(plan.out_of_reach)} of {len(plan.points)} points, "
    axes.set_title(title + f"{plan.length_m:.0f} m, {plan.least_s / 60.0:.1f} min at least", color=_INK)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=4, frameon=False, fontsize=8.5)
    for side in axes.spines.values():
        side.set_visible(False)
    try:
        figure.savefig(out)
    except (OSError, ValueError) as error:
        raise RunMapError(f"{out}: cannot be written: {error}") from error


def _draw_way(axes: "Axes", mirror: Mirror, plan: SurveyPlan) -> "LineCollection":
    from matplotlib.collections import LineCollection  # noqa: PLC0415 - see above
    from matplotlib.colors import LinearSegmentedColormap  # noqa: PLC0415

    base = mirror.base_pose
    way = [(base.x_m, base.y_m), *((stop.x_m, stop.y_m) for stop in plan.stops)]
    colours = LinearSegmentedColormap.from_list("time", _COLOURS)
    lines = LineCollection([np.array(leg) for leg in pairwise(way)], cmap=colours, linewidths=1.4, zorder=3)
    lines.set_array(np.array(plan.times_s) / 60.0)
    axes.add_collection(lines)
    return lines


def _draw_stops(axes: "Axes", mirror: Mirror, plan: SurveyPlan) -> None:
    dots: dict[str, Any] = {"s": 14, "color": _INK, "label": "measured"}
    squares: dict[str, Any] = {
        "s": 12, "marker": "s", "facecolors": "white", "edgecolors": _QUIET, "label": "on the way",
    }  # fmt: skip
    crosses: dict[str, Any] = {"s": 36, "marker": "x", "color": _BAD, "label": "out of reach"}
    measured = [(stop.x_m, stop.y_m) for stop in plan.stops if stop.kind is StopKind.MEASURE]
    passed = [(stop.x_m, stop.y_m) for stop in plan.stops if stop.kind is StopKind.VIA]
    lost = [mirror.point_on_deck(point) for point in plan.out_of_reach]
    for places, look in ((measured, dots), (passed, squares), (lost, crosses)):
        if places:
            axes.scatter([x for x, _ in places], [y for _, y in places], zorder=4, **look)
