"""The edge sensors: whether there is panel material under each of them, sample by sample.

The panels' true edges are shifted along their normals, rigidly, as the panels were mounted. The shift acts on the edge
sensors alone. The rim over which the robot falls stays the ideal one.
"""

from collections.abc import Sequence
from math import hypot, inf

import numpy as np

from ccatp.config.models import PanelsConfig
from ccatp.core import PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.sim.plant import Plant

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


EdgeTuple = tuple[float, int, int, int, int]

# A sensor is sampled along the chord of its way within a frame; the arc departs from it by microns. A chord whose ends
# lie on one panel lies on it, and one whose ends lie beyond one side of it lies beyond, but for rounding.
_ROUNDING_M = 1e-9
# Way of a sensor in the deck plane over that of the body; the curvature turns the body's axes by less than this.
_CURVED = 1.01
_ALL_ON = (1, 1, 1, 1)
_NOWHERE: Rectangle = (inf, -inf, inf, -inf)

_Body = tuple[float, float, float, float, float, float]
_Line = tuple[int, float, float, float, float]


class EdgeSensors:
    """Whether there is panel material under each edge sensor.

    While every sensor is known to be further from the edges of its panel than the body has moved since, nothing is
    looked up.
    """

    __slots__ = ("_body", "_inner", "_is_on", "_offsets", "_panel_at", "_reach_m", "_slack_m", "_under", "_values")

    def __init__(
        self, mirror: Mirror, offsets_m: Sequence[tuple[float, float]], shifted: PanelEdges | None = None
    ) -> None:
        """Set up; ``place`` before the first ``read``.

        Args:
            mirror: the ideal panels.
            offsets_m: places of the sensors, robot frame, shape (4, 2).
            shifted: where the panels' edges truly lie, if not where the mirror says.
        """
        self._panel_at = mirror.panel_at
        self._is_on = mirror.is_on_panel if shifted is None else shifted.is_on_panel
        material = nominal_rectangles(mirror) if shifted is None else shifted.rectangles
        m = _ROUNDING_M
        self._inner = {pid: (x0 + m, x1 - m, y0 + m, y1 - m) for pid, (x0, x1, y0, y1) in material.items()}
        self._under = [_NOWHERE] * len(offsets_m)  # the inner rectangle on which each sensor was seen last
        self._offsets = [(float(x), float(y)) for x, y in offsets_m]
        self._reach_m = _CURVED * max(hypot(x, y) for x, y in self._offsets)
        self._values = _ALL_ON
        self._slack_m = 0.0
        self._body: _Body = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def places(self) -> list[tuple[float, float]]:
        """Deck (x, y) of the sensors at the end of the last frame, m."""
        x, y, hx, hy, lx, ly = self._body
        return [(x + a * hx + b * lx, y + a * hy + b * ly) for a, b in self._offsets]

    def place(self, plant: Plant) -> None:
        """Put the sensors where the plant is."""
        self._body = plant.x_m, plant.y_m, plant.hx, plant.hy, plant.lx, plant.ly
        self._slack_m = 0.0
        a, b, c, d = (int(self._is_on(x, y)) for x, y in self.places)
        self._values = a, b, c, d

    def read(self, plant: Plant, times_s: Sequence[float], fractions: Sequence[float]) -> list[EdgeTuple]:
        """Readings at the times of a frame.

        Args:
            plant: after its step.
            fractions: the same, as fractions of the frame, ascending to at most 1.
        """
        if plant.is_moving:
            before = self._body
            self._body = plant.x_m, plant.y_m, plant.hx, plant.hy, plant.lx, plant.ly
            way_m = _CURVED * (abs(plant.forward_m) + abs(plant.left_m)) + self._reach_m * abs(plant.turn_rad)
            self._slack_m -= way_m
            if self._slack_m <= 0.0:
                changing = self._look(before)
                if changing:
                    return self._sample(changing, times_s, fractions)
        a, b, c, d = self._values
        return [(t, a, b, c, d) for t in times_s]

    def _look(self, before: _Body) -> list[_Line]:
        """Values and slack of a frame in which an edge may be near; the chords of sensors whose value may change."""
        x0, y0, hx0, hy0, lx0, ly0 = before
        x1, y1, hx1, hy1, lx1, ly1 = self._body
        values, changing, slack_m = list(self._values), [], inf
        for k, (a, b) in enumerate(self._offsets):
            u, v = x0 + a * hx0 + b * lx0, y0 + a * hy0 + b * ly0
            x, y = x1 + a * hx1 + b * lx1, y1 + a * hy1 + b * ly1
            west, east, south, north = self._under[k]
            if west <= u <= east and south <= v <= north and west <= x <= east and south <= y <= north:
                values[k] = 1
                slack_m = min(slack_m, x - west, east - x, y - south, north - y)
                continue
            slack_m = 0.0
            if self._is_beside(k, u, v, x, y):
                values[k] = 0
            else:
                changing.append((k, u, v, x, y))
        self._values, self._slack_m = (values[0], values[1], values[2], values[3]), slack_m
        return changing

    def _is_beside(self, k: int, u: float, v: float, x: float, y: float) -> bool:
        """Whether a sensor stays in the gap beside one side of a panel throughout its chord from (u, v) to (x, y)."""
        panel = self._panel_at(x, y)
        if panel is None:
            return False
        self._under[k] = west, east, south, north = self._inner[panel]
        if self._panel_at(u, v) != panel:
            return False
        m = 2.0 * _ROUNDING_M  # from the inner rectangle to beyond the outer one
        return max(x, u) < west - m or min(x, u) > east + m or max(y, v) < south - m or min(y, v) > north + m

    def _sample(
        self, changing: Sequence[_Line], times_s: Sequence[float], fractions: Sequence[float]
    ) -> list[EdgeTuple]:
        is_on, values = self._is_on, list(self._values)
        found: list[EdgeTuple] = []
        for t, f in zip(times_s, fractions, strict=True):
            for k, x0, y0, x1, y1 in changing:
                values[k] = int(is_on(x0 + f * (x1 - x0), y0 + f * (y1 - y0)))
            found.append((t, values[0], values[1], values[2], values[3]))
        for k, _, _, x1, y1 in changing:
            values[k] = int(is_on(x1, y1))
        self._values = values[0], values[1], values[2], values[3]
        return found
