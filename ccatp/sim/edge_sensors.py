"""Pure. The edge sensors: whether there is panel material under each of them, sample by sample."""

from collections.abc import Sequence
from itertools import repeat
from math import hypot

from ccatp.mirror.mirror import Mirror
from ccatp.sim.panel_edges import PanelEdges, nominal_rectangles
from ccatp.sim.plant import Plant

EdgeTuple = tuple[float, int, int, int, int]

# A sensor is sampled along the chord of its way within a frame; the arc departs from it by microns. A chord whose ends
# lie on one panel lies on it, and one whose ends lie beyond one side of it lies beyond, but for rounding.
_ROUNDING_M = 1e-9
_CHANGING = (-1, 0.0)
# Way of a sensor in the deck plane over that of the body; the curvature turns the body's axes by less than this.
_CURVED = 1.01

Point = tuple[float, float]
_Body = tuple[float, float, float, float, float, float]


class EdgeSensors:
    """Whether there is panel material under each edge sensor.

    While every sensor is known to be further from the edges of its panel than the body has moved since, nothing is
    looked up.
    """

    __slots__ = ("_body", "_is_on", "_material", "_offsets", "_panel_at", "_reach_m", "_slack_m", "_values")

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
        self._material = nominal_rectangles(mirror) if shifted is None else shifted.rectangles
        self._offsets = [(float(x), float(y)) for x, y in offsets_m]
        self._reach_m = max(hypot(x, y) for x, y in self._offsets)
        self._values = (1, 1, 1, 1)
        self._slack_m = 0.0
        self._body: _Body = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def places(self) -> list[tuple[float, float]]:
        """Deck (x, y) of the sensors at the end of the last frame, m."""
        return self._places(self._body)

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
            times_s: when the sensors are read.
            fractions: the same, as fractions of the frame, ascending to at most 1.
        """
        if plant.is_moving:
            before = self._body
            self._body = plant.x_m, plant.y_m, plant.hx, plant.hy, plant.lx, plant.ly
            moved_m = abs(plant.forward_m) + abs(plant.left_m) + self._reach_m * abs(plant.turn_rad)
            self._slack_m -= _CURVED * moved_m
            if self._slack_m <= 0.0:
                return self._look(self._places(before), self.places, times_s, fractions)
        a, b, c, d = self._values
        return list(zip(times_s, repeat(a), repeat(b), repeat(c), repeat(d), strict=False))

    def _places(self, body: _Body) -> list[tuple[float, float]]:
        x, y, hx, hy, lx, ly = body
        return [(x + a * hx + b * lx, y + a * hy + b * ly) for a, b in self._offsets]

    def _look(
        self, before: Sequence[Point], after: Sequence[Point], times_s: Sequence[float], fractions: Sequence[float]
    ) -> list[EdgeTuple]:
        """Readings of a frame in which an edge may be near."""
        found = [self._steady(*ends) for ends in zip(before, after, strict=True)]
        self._slack_m = min(slack_m for _, slack_m in found)
        values = [value for value, _ in found]
        changing = [k for k, value in enumerate(values) if value < 0]
        if changing:
            return self._sample(values, before, after, changing, times_s, fractions)
        self._values = a, b, c, d = values[0], values[1], values[2], values[3]
        return list(zip(times_s, repeat(a), repeat(b), repeat(c), repeat(d), strict=False))

    def _steady(self, before: Point, after: Point) -> tuple[int, float]:
        """What a sensor reads throughout a frame, -1 where that may change, and how far it may go until it does."""
        (u, v), (x, y) = before, after
        panel = self._panel_at(x, y)
        if panel is None or self._panel_at(u, v) != panel:
            return _CHANGING
        x0, x1, y0, y1 = self._material[panel]
        m = _ROUNDING_M
        slack_m = min(x - x0, x1 - x, y - y0, y1 - y) - m
        if slack_m >= 0.0 and min(u - x0, x1 - u, v - y0, y1 - v) >= m:
            return 1, slack_m
        beyond_m = max(min(x0 - x, x0 - u), min(x - x1, u - x1), min(y0 - y, y0 - v), min(y - y1, v - y1))
        return (0, 0.0) if beyond_m > m else _CHANGING

    def _sample(
        self,
        values: list[int],
        before: Sequence[Point],
        after: Sequence[Point],
        changing: Sequence[int],
        times_s: Sequence[float],
        fractions: Sequence[float],
    ) -> list[EdgeTuple]:
        is_on = self._is_on
        lines = [(k, *before[k], *after[k]) for k in changing]
        found: list[EdgeTuple] = []
        for t, f in zip(times_s, fractions, strict=True):
            for k, x0, y0, x1, y1 in lines:
                values[k] = int(is_on(x0 + f * (x1 - x0), y0 + f * (y1 - y0)))
            found.append((t, values[0], values[1], values[2], values[3]))
        for k, _, _, x1, y1 in lines:
            values[k] = int(is_on(x1, y1))
        self._values = values[0], values[1], values[2], values[3]
        return found
