"""Edge. The look of the studies' figures."""

from pathlib import Path
from typing import TYPE_CHECKING

from ccatp.pictures.figures import GRID, INK, QUIET, dress, new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["CYCLE", "GRID", "INK", "LIMIT", "QUIET", "colour", "dress", "new_figure", "save"]

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
