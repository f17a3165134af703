"""Edge. Figures of the study `cricket`, as PNG and PDF."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ccatp.studies.campaign import CellResult
from ccatp.studies.figures import INK, LIMIT, QUIET, colour, dress, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_POOR = ("zigzag-printed", "zigzag-p0-99", "zigzag-pooled")
_FULL = ("adjacent-printed", "all-printed", "all-p0-99", "all-pooled")
_MAPS = (("zigzag-printed", "figures 9, 10: five pairs"), ("all-printed", "figure 13: fifteen pairs"))
_CLOUD = 200  # runs shown as dots


def draw_cricket(cells: Sequence[CellResult], out: Path) -> None:
    """Traces (figures 11, 12, 14), clouds of maps (9, 10, 13), all ways beside each other."""
    found = {str(cell.factors["case"]): cell for cell in cells}
    for stem, names, title, goal_m in (
        ("figure_11_12", _POOR, "Few measurements: five pairs in a zigzag", 0.15),
        ("figure_14", _FULL, "Many measurements: nine adjacent pairs, or all fifteen", 0.005),
    ):
        shown = [name for name in names if name in found]
        if shown:
            _draw_traces(found, shown, title, goal_m, out / stem)
    maps = [(name, title) for name, title in _MAPS if name in found]
    if maps:
        _draw_maps(found, maps, out / "figure_9_10_13")
    _draw_ways(cells, out / "ways")


def _draw_traces(found: Mapping[str, CellResult], names: Sequence[str], title: str, goal_m: float, stem: Path) -> None:
    figure = new_figure(8.5, 5.2)
    axes = figure.subplots()
    for number, name in enumerate(names):
        low, middle, high = found[name].arrays["trace_m"]
        updates, shade = np.arange(len(middle)), colour(number)
        axes.fill_between(updates, low, high, color=shade, alpha=0.13, linewidth=0)
        axes.plot(updates, middle, color=shade, linewidth=1.7, label=name)
        axes.plot(updates, found[name].arrays["expected_trace_m"], color=shade, linewidth=1.0, linestyle="--")
    axes.axhline(goal_m, color=LIMIT, linewidth=0.9, linestyle=":", label=f"published: {1e3 * goal_m:g} mm")
    axes.set_yscale("log")
    axes.set(xlabel="updates", ylabel="root mean square error of a place, m")
    axes.set_title(f"{title}\nmedian, 10 to 90 %; dashed: what the filter expects", color=INK)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, frameon=False, fontsize=8)
    dress(axes)
    save(figure, stem)


def _draw_maps(found: Mapping[str, CellResult], maps: Sequence[tuple[str, str]], stem: Path) -> None:
    figure = new_figure(4.6 * len(maps), 6.4)
    panels = figure.subplots(1, len(maps), squeeze=False)[0]
    for axes, (name, title) in zip(panels, maps, strict=True):
        cell = found[name]
        true, places = cell.arrays["true_m"], cell.arrays["positions_m"][:_CLOUD]
        for mote in range(len(true)):
            axes.plot(*places[:, mote].T, ".", color=colour(0), markersize=2.5, alpha=0.35)
        axes.plot(*true.T, "o", color=colour(1), markersize=8, fillstyle="none", label="true")
        axes.plot([], [], ".", color=colour(0), label=f"mapped, {len(places)} runs")
        axes.set_title(title, color=INK)
        axes.set(xlabel="x, m", ylabel="y, m", aspect="equal", xlim=(-1.2, 6.2), ylim=(-0.2, 9.2))
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=2, frameon=False, fontsize=8)
    dress(*panels)
    save(figure, stem)


def _draw_ways(cells: Sequence[CellResult], stem: Path) -> None:
    figure = new_figure(8.5, 0.36 * len(cells) + 1.7)
    axes = figure.subplots()
    for row, cell in enumerate(cells):
        _draw_way(axes, row, cell)
    axes.set_yticks(range(len(cells)), [str(cell.factors["case"]) for cell in cells])
    axes.set_ylim(len(cells) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.set_xlabel("root mean square error of a place, m: median (dot), 10 to 90 % (bar), Cramér-Rao bound (line)")
    dress(axes)
    save(figure, stem)


def _draw_way(axes: "Axes", row: int, cell: CellResult) -> None:
    rms, bound_m = cell.values["rms_m"], cell.values["bound_m"]
    shade = colour(0 if cell.values["method"] == "ekf" else 2)
    axes.plot([rms["p10"], rms["p90"]], [row, row], color=shade, linewidth=4.0, alpha=0.35, solid_capstyle="butt")
    axes.plot(rms["p50"], row, "o", color=shade, markersize=5)
    if bound_m is not None:
        axes.plot([bound_m, bound_m], [row - 0.3, row + 0.3], color=QUIET, linewidth=1.4)
