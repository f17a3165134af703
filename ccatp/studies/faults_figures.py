"""Edge. The figure of the study `faults`: what faults that pass by cost in time."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ccatp.studies.campaign import CellResult
from ccatp.studies.figures import LIMIT, colour, dress, new_figure, save

_SPREAD = 0.3  # dots of a row lie beside each other


def draw_faults(cells: Sequence[CellResult], out: Path) -> None:
    """Figure ``faults``: every mission a dot, those that were not completed marked."""
    figure = new_figure(7.0, 1.0 + 0.55 * len(cells))
    axes = figure.add_subplot()
    kinds = list(dict.fromkeys(cell.factors["faults"] for cell in cells))
    for k, cell in enumerate(cells):
        ratios, is_complete = cell.arrays["time_ratio"], cell.arrays["is_complete"].astype(bool)
        rows = k + _SPREAD * np.linspace(-1.0, 1.0, len(ratios)) if len(ratios) > 1 else np.array([float(k)])
        shade = colour(kinds.index(cell.factors["faults"]))
        axes.plot(ratios[is_complete], rows[is_complete], ".", color=shade, markersize=5)
        axes.plot(ratios[~is_complete], rows[~is_complete], "x", color=LIMIT, markersize=6)
    axes.set_yticks(range(len(cells)), [f"{c.factors['mirror']}, faults: {c.factors['faults']}" for c in cells])
    axes.invert_yaxis()
    axes.set_xlabel("mission time over its bound; a cross: not completed")
    dress(axes)
    save(figure, out / "faults")
