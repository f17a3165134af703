"""Pure. Colours: of ink and paper, of series, and scales from numbers to colours."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccatp.drawing.shapes import FloatArray

INK, QUIET, FAINT, PAPER = "#1f2933", "#5f6c7b", "#d5dce4", "#ffffff"
PANEL, SEAM, PATH, BAD, GOOD = "#f1f4f7", "#c5ced8", "#8fa3b8", "#c93f3f", "#1d7a55"
# Told apart by lightness as well, for those who do not see colours, and for printers.
SERIES = ("#123f6d", "#e0902f", "#1d8a99", "#a8577e", "#8a96a3", "#5b7f2b")
SMALL_TO_LARGE = ("#123f6d", "#1d8a99", "#f0b429")
BELOW_TO_ABOVE = ("#2f6aa5", "#a9cbe3", "#f7f7f5", "#f3c08c", "#c25a28")
LEVELS = 64  # of a scale; more are not told apart


@dataclass(frozen=True, slots=True)
class ColourScale:
    """Numbers to colours, in ``LEVELS`` steps; what lies beyond the ends has their colours.

    Attributes:
        low, high: numbers at the ends, low < high.
        stops: colours at equal distances.
    """

    low: float
    high: float
    stops: Sequence[str]

    def levels(self, values: FloatArray) -> "np.ndarray[tuple[int, ...], np.dtype[np.int64]]":
        """Index of the colour of each value, 0 to ``LEVELS`` - 1."""
        part = (np.asarray(values) - self.low) / (self.high - self.low)
        return np.clip(np.floor(part * LEVELS), 0, LEVELS - 1).astype(np.int64)

    def palette(self) -> list[str]:
        """The colours of all levels."""
        stops = np.array([_channels(stop) for stop in self.stops], dtype=np.float64)
        at = np.linspace(0.0, len(stops) - 1.0, LEVELS)
        mixed = np.column_stack([np.interp(at, np.arange(len(stops)), channel) for channel in stops.T])
        return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in np.rint(mixed).astype(int).tolist()]

    def colour(self, value: float) -> str:
        """The colour of one value."""
        return self.palette()[int(self.levels(np.array([value]))[0])]


def _channels(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
