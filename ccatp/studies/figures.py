"""The look of the studies' figures.

A figure that compares cells, one below the other: localization, first arrival, time.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ccatp.report.plots import dress, new_figure, save_figure
from ccatp.studies.campaign import CellResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


LIMIT = "#c0392b"
# Told apart by people with any colour vision, and in print by their lightness.
CYCLE = ("#0b3c5d", "#d08c00", "#1d9a8a", "#b5478a", "#6b7785", "#7a3e00")


def colour(index: int) -> str:
    """A colour of the cycle."""
    return CYCLE[index % len(CYCLE)]


def save(figure: "Figure", stem: Path) -> None:
    """As PNG and as PDF.

    Raises:
        PictureError: a file cannot be written.
    """
    for suffix in (".png", ".pdf"):
        save_figure(figure, stem.with_suffix(suffix))


_FIGURES = (
    ("localization error, mm", ("localization_error_mm", "mean"), ("localization_error_mm", "p99")),
    ("first arrival error, mm", ("arrival_error_mm", "mean"), ("arrival_error_mm", "p99")),
    ("time / bound of the path", ("time_ratio",), None),
)


class FigureRow(NamedTuple):
    """A line of the figure.

    Attributes:
        is_base: others are compared with it: its mean is a line through all.
    """

    label: str
    cell: CellResult
    shade: int
    is_base: bool


def draw_ranges(rows: Sequence[FigureRow], title: str, stem: Path) -> None:
    """Mean as a dot, 99th percentile as the end of a bar."""
    figure = new_figure(10.5, 0.27 * len(rows) + 1.6)
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter  # noqa: PLC0415 - as in figures

    panels = figure.subplots(1, len(_FIGURES), sharey=True)
    for axes, (label, mean, tail) in zip(panels, _FIGURES, strict=True):
        _draw(axes, rows, mean, tail)
        axes.set_xlabel(label)
    panels[0].set_yticks(range(len(rows)), [row.label for row in rows])
    panels[0].set_ylim(len(rows) - 0.5, -0.5)  # the first one on top
    for axes in panels[:2]:
        axes.set_xscale("log")
        # 1, 2 and 5 in plain numbers: most cells lie within a decade or two.
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    panels[2].xaxis.set_major_locator(MaxNLocator(5))
    figure.suptitle(f"{title}: mean (dot), 99th percentile (end of the bar)", fontsize=11)
    dress(*panels)
    save(figure, stem)


def _draw(axes: "Axes", rows: Sequence[FigureRow], mean: tuple[str, ...], tail: tuple[str, ...] | None) -> None:
    for place, row in enumerate(rows):
        value = _value(row.cell, mean)
        if value is None:
            continue
        shade = colour(row.shade)
        if row.is_base:
            axes.axvline(value, color=shade, linewidth=0.9, linestyle="--", alpha=0.7)
        end = _value(row.cell, tail) if tail else None
        if end is not None:
            axes.plot([value, end], [place, place], color=shade, linewidth=3.0, alpha=0.35, solid_capstyle="butt")
        axes.plot(value, place, "D" if row.is_base else "o", color=shade, markersize=5)


def _value(cell: CellResult, path: tuple[str, ...]) -> float | None:
    value: Any = cell.values
    for part in path:
        value = value[part]
    return None if value is None else float(value)
