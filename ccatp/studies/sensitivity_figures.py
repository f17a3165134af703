"""Edge. The figure of the study `sensitivity`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ccatp.studies.campaign import CellResult
from ccatp.studies.figures import colour, dress, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FIGURES = (
    ("localization error, mm", ("localization_error_mm", "mean"), ("localization_error_mm", "p99")),
    ("first arrival error, mm", ("arrival_error_mm", "mean"), ("arrival_error_mm", "p99")),
    ("time / bound of the path", ("time_ratio",), None),
)
_BASES = ("none", "all")


def draw_sensitivity(cells: Sequence[CellResult], out: Path) -> None:
    """Mean and 99th percentile of each world, the undisturbed and the fully disturbed one as lines.

    Raises:
        CampaignError: matplotlib is not installed.
    """
    for mirror in dict.fromkeys(str(cell.factors["mirror"]) for cell in cells):
        there = [cell for cell in cells if cell.factors["mirror"] == mirror]
        figure = new_figure(10.5, 0.27 * len(there) + 1.6)
        panels = figure.subplots(1, len(_FIGURES), sharey=True)
        for axes, (label, mean, tail) in zip(panels, _FIGURES, strict=True):
            _draw(axes, there, mean, tail)
            axes.set_xlabel(label)
        panels[0].set_yticks(range(len(there)), [_name(cell) for cell in there])
        panels[0].invert_yaxis()
        for axes in panels[:2]:
            axes.set_xscale("log")
        title = f"What each disturbance costs on {mirror}: mean (dot), 99th percentile (end of the bar)"
        figure.suptitle(title, fontsize=11)
        dress(*panels)
        save(figure, out / f"sensitivity-{mirror}")


def _draw(axes: "Axes", cells: Sequence[CellResult], mean: tuple[str, ...], tail: tuple[str, ...] | None) -> None:
    worlds = list(dict.fromkeys(cell.factors["world"] for cell in cells))
    for place, cell in enumerate(cells):
        value = _value(cell, mean)
        if value is None:
            continue
        is_base = cell.factors["group"] in _BASES
        shade = colour(worlds.index(cell.factors["world"]))
        if is_base:
            axes.axvline(value, color=shade, linewidth=0.9, linestyle="--", alpha=0.7)
        end = _value(cell, tail) if tail else None
        if end is not None:
            axes.plot([value, end], [place, place], color=shade, linewidth=3.0, alpha=0.35, solid_capstyle="butt")
        axes.plot(value, place, "D" if is_base else "o", color=shade, markersize=5)


def _value(cell: CellResult, path: tuple[str, ...]) -> float | None:
    value: Any = cell.values
    for part in path:
        value = value[part]
    return None if value is None else float(value)


def _name(cell: CellResult) -> str:
    group = str(cell.factors["group"])
    return str(cell.factors["world"]) if group in _BASES else group
