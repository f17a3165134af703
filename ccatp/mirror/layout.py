"""The grid of panels in the deck plane, each panel's frame, and the numbering of its nine measurement points."""

from dataclasses import dataclass
from math import hypot
from typing import Literal, NamedTuple

from ccatp.config.models import PanelsConfig
from ccatp.core import PanelId, Vector3
from ccatp.mirror.surface import Axes


class Seam(NamedTuple):
    """A seam between two panels near a point; ``axis``: the deck coordinate that is constant along it."""

    axis: Literal["x", "y"]
    position_m: float
    distance_m: float


class PanelGrid:
    """Cells of one pitch by one pitch, each with a panel in its middle, rows centred (deck plane, m).

    Centre of panel (r, c): ``x = (c - (cols+1)/2) pitch_x``, ``y = (r - (rows+1)/2) pitch_y + y_offset``.
    """

    def __init__(self, cfg: PanelsConfig) -> None:
        self.rows, self.cols = len(cfg.panels_per_row), cfg.cols
        self.half_x_m, self.half_y_m = cfg.size_x_mm * 5e-4, cfg.size_y_mm * 5e-4
        self._pitch_x, self._pitch_y = cfg.pitch_x_mm * 1e-3, cfg.pitch_y_mm * 1e-3
        self._per_x, self._per_y = 1.0 / self._pitch_x, 1.0 / self._pitch_y
        self._y_offset = cfg.y_offset_mm * 1e-3
        # Cell coordinates (u, v) count pitches from the lower left corner of the grid: integer part = column, row - 1.
        self._u0, self._v0 = self.cols / 2.0, self.rows / 2.0 - self._y_offset * self._per_y
        self._half_u, self._half_v = self.half_x_m * self._per_x, self.half_y_m * self._per_y
        self._first = tuple((self.cols - n) // 2 for n in cfg.panels_per_row)
        self._end = tuple(f + n for f, n in zip(self._first, cfg.panels_per_row, strict=True))
        self._ids = tuple(tuple(PanelId(r + 1, c + 1) for c in range(self.cols)) for r in range(self.rows))
        self.ids = tuple(self._ids[r][c] for r in range(self.rows) for c in range(self._first[r], self._end[r]))

    def centre(self, panel: PanelId) -> tuple[float, float]:
        """Centre of a cell of the grid, deck plane, m."""
        x = (panel.col - (self.cols + 1) / 2.0) * self._pitch_x
        return x, (panel.row - (self.rows + 1) / 2.0) * self._pitch_y + self._y_offset

    def panel_at(self, x: float, y: float) -> PanelId | None:
        """The panel whose cell (with half of the gaps) contains the point, or None."""
        u, v = x * self._per_x + self._u0, y * self._per_y + self._v0
        if not (0.0 <= u < self.cols and 0.0 <= v < self.rows):  # NaN included
            return None
        r, c = int(v), int(u)
        return self._ids[r][c] if self._first[r] <= c < self._end[r] else None

    def is_on_panel(self, x: float, y: float) -> bool:
        """Whether the point is on a panel, not over a gap."""
        u, v = x * self._per_x + self._u0, y * self._per_y + self._v0
        if not (0.0 <= u < self.cols and 0.0 <= v < self.rows):  # NaN included
            return False
        r, c = int(v), int(u)
        if not self._first[r] <= c < self._end[r]:
            return False
        return abs(u - c - 0.5) <= self._half_u and abs(v - r - 0.5) <= self._half_v

    def nearest_panel(self, x: float, y: float) -> PanelId:
        """The panel whose cell contains the point or is nearest to it."""
        found = self.panel_at(x, y)
        if found is not None:
            return found
        u, v = x * self._per_x + self._u0, y * self._per_y + self._v0
        best, best_m = self.ids[0], float("inf")
        for r in range(self.rows):
            c = int(min(max(self._first[r], u), self._end[r] - 1))
            du, dv = max(c - u, u - c - 1.0, 0.0), max(r - v, v - r - 1.0, 0.0)
            distance = hypot(du * self._pitch_x, dv * self._pitch_y)
            if distance < best_m:
                best, best_m = self._ids[r][c], distance
        return best

    def nearest_seam(self, x: float, y: float) -> Seam | None:
        """The nearest of the interior seams (with panels on both sides) at the nearest cell; None without any."""
        panel = self.nearest_panel(x, y)
        r, c = panel.row - 1, panel.col - 1
        x0, y0 = (c - self._u0) * self._pitch_x, (r - self._v0) * self._pitch_y
        found: Seam | None = None
        for exists, axis, position, distance in (
            (c > self._first[r], "x", x0, x - x0),
            (c + 1 < self._end[r], "x", x0 + self._pitch_x, x - x0 - self._pitch_x),
            (self._has(r - 1, c), "y", y0, y - y0),
            (self._has(r + 1, c), "y", y0 + self._pitch_y, y - y0 - self._pitch_y),
        ):
            if exists and (found is None or abs(distance) < abs(found.distance_m)):
                found = Seam("x" if axis == "x" else "y", position, distance)
        return found

    def row_span(self, row: int) -> tuple[float, float, float]:
        """Half width and the y edges (low, high) of the material of a row counted from 1, deck plane, m."""
        count = self._end[row - 1] - self._first[row - 1]
        y = (row - (self.rows + 1) / 2.0) * self._pitch_y + self._y_offset
        return (count - 1) / 2.0 * self._pitch_x + self.half_x_m, y - self.half_y_m, y + self.half_y_m

    def _has(self, r: int, c: int) -> bool:
        return 0 <= r < self.rows and self._first[r] <= c < self._end[r]


POINTS_PER_PANEL = 9
POINTS_PER_ROW = 3


@dataclass(frozen=True, slots=True)
class Panel:
    """A panel: centre and half sizes in the deck plane, m, and its frame, the tangent frame there (thesis fig. 2.2).

    ``origin``: surface point at the centre, deck frame, m; ``axes``: the panel's x, y, z as unit vectors in the deck
    frame.
    """

    id: PanelId
    x_m: float
    y_m: float
    half_x_m: float
    half_y_m: float
    origin: Vector3
    axes: Axes

    def from_deck(self, p: Vector3) -> Vector3:
        """Panel coordinates of a point given in the deck frame, m."""
        o = self.origin
        return self.rotate_from_deck((p[0] - o[0], p[1] - o[1], p[2] - o[2]))

    def to_deck(self, p: Vector3) -> Vector3:
        """Deck coordinates of a point given in the panel frame, m."""
        vx, vy, vz = self.rotate_to_deck(p)
        o = self.origin
        return vx + o[0], vy + o[1], vz + o[2]

    def rotate_from_deck(self, v: Vector3) -> Vector3:
        """Panel components of a vector given in the deck frame."""
        vx, vy, vz = v
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = self.axes
        return ax * vx + ay * vy + az * vz, bx * vx + by * vy + bz * vz, cx * vx + cy * vy + cz * vz

    def rotate_to_deck(self, v: Vector3) -> Vector3:
        """Deck components of a vector given in the panel frame."""
        vx, vy, vz = v
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = self.axes
        return ax * vx + bx * vy + cx * vz, ay * vx + by * vy + cy * vz, az * vx + bz * vy + cz * vz
