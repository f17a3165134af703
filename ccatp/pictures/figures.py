"""Edge. Figures by matplotlib: made without a window, dressed alike, saved, with one clear error where that cannot be.

Imports matplotlib, which takes a second, only when something is drawn.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ccatp.drawing.colours import BAD, INK, QUIET
from ccatp.errors import CcatpError, ExitStatus

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["BAD", "GRID", "INK", "QUIET", "PictureError", "dress", "new_figure", "save_figure"]

GRID = "#e3e8ed"


class PictureError(CcatpError):
    """A picture that cannot be drawn or written."""

    exit_status = ExitStatus.USAGE


def new_figure(
    width_in: float, height_in: float, dpi: float = 160.0, layout: Literal["constrained"] | None = "constrained"
) -> "Figure":
    """A figure that no window shows.

    Args:
        width_in, height_in: its size, inches.
        dpi: pixels an inch.
        layout: how matplotlib places what is in it; None where every place is given.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - takes a second

    return Figure(figsize=(width_in, height_in), dpi=dpi, facecolor="white", layout=layout)


def dress(*panels: "Axes", grid: Literal["major", "both"] = "major") -> None:
    """Grid behind the data, quiet frames, small labels."""
    for axes in panels:
        axes.grid(True, which=grid, color=GRID, linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(which="both", labelsize=8, color=QUIET, labelcolor=INK)
        axes.title.set_fontsize(9)
        for label in (axes.xaxis.label, axes.yaxis.label):
            label.set_fontsize(9)
        for side in axes.spines.values():
            side.set_color(GRID)


def save_figure(figure: "Figure", path: Path, dpi: float | None = None) -> None:
    """Write a figure; the same figure gives the same bytes on every day.

    Args:
        figure: the figure.
        path: its suffix tells the format (PNG, PDF, SVG).
        dpi: pixels an inch, if not the figure's own.

    Raises:
        PictureError: the file cannot be written, or no such format is known.
    """
    undated: dict[str, dict[str, Any]] = {
        ".png": {"Software": None},
        ".pdf": {"CreationDate": None},
        ".svg": {"Date": None},
    }
    try:
        figure.savefig(path, dpi=dpi or "figure", metadata=undated.get(path.suffix.lower()))
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise PictureError(f"{path}: cannot be written: {why}") from error
