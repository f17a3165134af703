"""Edge. The look of the studies' figures. Needs the extra ``plots`` (matplotlib), imported when something is drawn."""

from pathlib import Path
from typing import TYPE_CHECKING

from ccatp.studies.campaign import CampaignError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, QUIET, GRID = "#1f2933", "#6b7785", "#e3e8ed"
LIMIT = "#c0392b"
# Told apart by people with any colour vision, and in print by their lightness.
CYCLE = ("#0b3c5d", "#d08c00", "#1d9a8a", "#b5478a", "#6b7785", "#7a3e00")


def colour(index: int) -> str:
    """A colour of the cycle."""
    return CYCLE[index % len(CYCLE)]


def new_figure(width_in: float, height_in: float) -> "Figure":
    """A figure that no window shows.

    Raises:
        CampaignError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415 - takes a second, and belongs to an extra
    except ImportError as error:
        raise CampaignError("drawing needs matplotlib: install ccatp[plots], or add --no-figures") from error
    return Figure(figsize=(width_in, height_in), dpi=160, facecolor="white", layout="constrained")


def dress(*panels: "Axes") -> None:
    """Grid behind the data, quiet frames, small labels."""
    for axes in panels:
        axes.grid(True, which="major", color=GRID, linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(which="both", labelsize=8, color=QUIET, labelcolor=INK)
        axes.title.set_fontsize(9)
        for label in (axes.xaxis.label, axes.yaxis.label):
            label.set_fontsize(9)
        for side in axes.spines.values():
            side.set_color(GRID)


def save(figure: "Figure", stem: Path) -> None:
    """As PNG and as PDF; the same result gives the same bytes."""
    figure.savefig(stem.with_suffix(".png"))
    figure.savefig(stem.with_suffix(".pdf"), metadata={"CreationDate": None})
