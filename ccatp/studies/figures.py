"""Edge. The look of the studies' figures. Needs the extra ``plots`` (matplotlib), imported when something is drawn."""

from pathlib import Path
from typing import TYPE_CHECKING

from ccatp.pictures import figures
from ccatp.pictures.figures import GRID, INK, QUIET, dress
from ccatp.studies.campaign import CampaignError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["CYCLE", "GRID", "INK", "LIMIT", "QUIET", "colour", "dress", "new_figure", "save"]

LIMIT = "#c0392b"
# Told apart by people with any colour vision, and in print by their lightness.
CYCLE = ("#0b3c5d", "#d08c00", "#1d9a8a", "#b5478a", "#6b7785", "#7a3e00")


def colour(index: int) -> str:
    """A colour of the cycle."""
    return CYCLE[index % len(CYCLE)]


def new_figure(width_in: float, height_in: float) -> "Figure":
    """As ``ccatp.pictures.figures.new_figure``.

    Raises:
        CampaignError: matplotlib is not installed.
    """
    try:
        return figures.new_figure(width_in, height_in)
    except figures.PictureError as error:
        raise CampaignError(f"{error}, or add --no-figures") from error


def save(figure: "Figure", stem: Path) -> None:
    """As PNG and as PDF.

    Raises:
        PictureError: a file cannot be written.
    """
    for suffix in (".png", ".pdf"):
        figures.save_figure(figure, stem.with_suffix(suffix))
