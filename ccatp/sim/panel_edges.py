"""Pure. Where the panels' edges truly lie: each one shifted along its normal, rigidly, as the panels were mounted.

Only what the edge sensors see is shifted. The rim over which the robot falls stays the ideal one.
"""

import numpy as np

from ccatp.config.models import PanelsConfig
from ccatp.mirror.mirror import Mirror
from ccatp.samples import PanelId

MIN_GAP_M = 2e-4

Rectangle = tuple[float, float, float, float]


class PanelEdges:
    """Material as the edge sensors meet it, deck plane.

    An edge never shifts outwards by more than half the gap less half of ``MIN_GAP_M``: neighbours keep that much
    between them, and every panel stays in its own cell, so that a cell and a rectangle tell what lies at a point.

    Attributes:
        rectangles: (low x, high x, low y, high y) of each panel, m.
    """

    __slots__ = ("_panel_at", "rectangles")

    def __init__(self, mirror: Mirror, panels: PanelsConfig, sigma_m: float, rng: np.random.Generator) -> None:
        """Draw the edges.

        Args:
            mirror: the ideal panels.
            panels: the pitches.
            sigma_m: standard deviation of a shift.
            rng: four draws per panel, in the order of ``mirror.panels``.
        """
        self._panel_at = mirror.panel_at
        self.rectangles: dict[PanelId, Rectangle] = {}
        for pid, (x0, x1, y0, y1) in nominal_rectangles(mirror).items():
            west, east, south, north = (sigma_m * rng.standard_normal(4)).tolist()
            x_out = max(0.0, 5e-4 * (panels.pitch_x_mm - panels.size_x_mm) - 0.5 * MIN_GAP_M)
            y_out = max(0.0, 5e-4 * (panels.pitch_y_mm - panels.size_y_mm) - 0.5 * MIN_GAP_M)
            self.rectangles[pid] = (
                x0 - min(west, x_out), x1 + min(east, x_out), y0 - min(south, y_out), y1 + min(north, y_out),
            )  # fmt: skip

    def is_on_panel(self, x: float, y: float) -> bool:
        """Whether there is material at the point."""
        panel = self._panel_at(x, y)
        if panel is None:
            return False
        x0, x1, y0, y1 = self.rectangles[panel]
        return x0 <= x <= x1 and y0 <= y <= y1


def nominal_rectangles(mirror: Mirror) -> dict[PanelId, Rectangle]:
    """(low x, high x, low y, high y) of the material of each panel as designed, deck plane, m."""
    return {
        pid: (p.x_m - p.half_x_m, p.x_m + p.half_x_m, p.y_m - p.half_y_m, p.y_m + p.half_y_m)
        for pid, p in mirror.panels.items()
    }
