"""Pure. One panel: its place on the mirror and its frame; the nine measurement points' numbering."""

from dataclasses import dataclass

from ccatp.mirror.surface import Axes, Surface
from ccatp.samples import PanelId, Vector3

POINTS_PER_PANEL = 9
POINTS_PER_ROW = 3


@dataclass(frozen=True, slots=True)
class Panel:
    """A panel and its frame (thesis fig. 2.2).

    Attributes:
        id: row and column.
        x_m, y_m: centre in the deck plane.
        half_x_m, half_y_m: half the panel's size in the deck plane.
        origin: surface point at the centre, deck frame, m.
        axes: the panel's x, y, z axes as unit vectors in the deck frame; z is the surface normal at the centre.
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


def build_panel(surface: Surface, panel: PanelId, centre: tuple[float, float], half: tuple[float, float]) -> Panel:
    """Panel whose frame is the tangent frame of the surface at ``centre``.

    Args:
        surface: the mirror's surface.
        panel: row and column.
        centre: (x, y) in the deck plane, m.
        half: half sizes along x and y in the deck plane, m.
    """
    x, y = centre
    return Panel(panel, x, y, half[0], half[1], surface.point(x, y), surface.axes(x, y))
