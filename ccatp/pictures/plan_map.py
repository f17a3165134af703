"""Edge. The way of a planned survey as a picture, coloured by the time at which the robot is there.

Imports matplotlib, which takes a second, only when something is drawn.
"""

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccatp.drawing.colours import SMALL_TO_LARGE
from ccatp.mirror.mirror import Mirror
from ccatp.pictures.deck_map import add_colour_bar, draw_base, new_deck_map
from ccatp.pictures.figures import BAD, INK, QUIET, save_figure
from ccatp.samples import StopKind
from ccatp.survey_plan import SurveyPlan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection

WIDTH_PX = 1600
DPI = 160


def draw_plan(mirror: Mirror, plan: SurveyPlan, out: Path) -> None:
    """Draw a plan into an image file.

    Args:
        mirror: where the survey would be.
        plan: its plan.
        out: the file; its suffix tells the format (PNG, PDF, SVG).

    Raises:
        PictureError: the file cannot be written.
    """
    figure, axes = new_deck_map(mirror, WIDTH_PX, DPI)
    draw_base(axes, mirror)
    add_colour_bar(axes, _draw_way(axes, mirror, plan), "time, min")
    _draw_stops(axes, mirror, plan)
    title = f"{mirror.name}: {len(plan.points) - len(plan.out_of_reach)} of {len(plan.points)} points, "
    axes.set_title(title + f"{plan.length_m:.0f} m, {plan.least_s / 60.0:.1f} min at least", color=INK)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=4, frameon=False, fontsize=8.5)
    save_figure(figure, out)


def _draw_way(axes: "Axes", mirror: Mirror, plan: SurveyPlan) -> "LineCollection":
    from matplotlib.collections import LineCollection  # noqa: PLC0415 - see above
    from matplotlib.colors import LinearSegmentedColormap  # noqa: PLC0415

    base = mirror.base_pose
    way = [(base.x_m, base.y_m), *((stop.x_m, stop.y_m) for stop in plan.stops)]
    colours = LinearSegmentedColormap.from_list("time", SMALL_TO_LARGE)
    lines = LineCollection([np.array(leg) for leg in pairwise(way)], cmap=colours, linewidths=1.4, zorder=3)
    lines.set_array(np.array(plan.times_s) / 60.0)
    axes.add_collection(lines)
    return lines


def _draw_stops(axes: "Axes", mirror: Mirror, plan: SurveyPlan) -> None:
    dots: dict[str, Any] = {"s": 14, "color": INK, "label": "measured"}
    squares: dict[str, Any] = {
        "s": 12, "marker": "s", "facecolors": "white", "edgecolors": QUIET, "label": "on the way",
    }  # fmt: skip
    crosses: dict[str, Any] = {"s": 36, "marker": "x", "color": BAD, "label": "out of reach"}
    measured = [(stop.x_m, stop.y_m) for stop in plan.stops if stop.kind is StopKind.MEASURE]
    passed = [(stop.x_m, stop.y_m) for stop in plan.stops if stop.kind is StopKind.VIA]
    lost = [mirror.point_on_deck(point) for point in plan.out_of_reach]
    for places, look in ((measured, dots), (passed, squares), (lost, crosses)):
        if places:
            axes.scatter([x for x, _ in places], [y for _, y in places], zorder=4, **look)
