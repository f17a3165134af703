"""Pure. The panel under the robot, and poses in its frame."""

from math import atan2, cos, sin, sqrt

from ccatp.localization.terrain import Slope
from ccatp.mirror.mirror import Mirror
from ccatp.samples import PanelId, PanelPose

_NEAR_BORDER = 0.95  # part of a panel's half size beyond which the cell under the robot is looked up


class PanelFrame:
    """The panel under the robot, and poses in its frame.

    Args:
        mirror: the mirror.
        panel: where the robot is first.
    """

    def __init__(self, mirror: Mirror, panel: PanelId) -> None:
        self._mirror = mirror
        self.enter(panel)

    def enter(self, panel: PanelId) -> None:
        """Give poses in the frame of ``panel`` from now on."""
        found = self._mirror.panel(panel)
        self.panel = panel
        self._origin = found.origin
        (self._ax, self._ay, self._az), (self._bx, self._by, self._bz) = found.axes[:2]
        self._cx, self._cy = found.x_m, found.y_m
        self._near_x, self._near_y = _NEAR_BORDER * found.half_x_m, _NEAR_BORDER * found.half_y_m

    def hand_over(self, x: float, y: float) -> None:
        """The robot is at this deck point."""
        if abs(x - self._cx) > self._near_x or abs(y - self._cy) > self._near_y:
            panel = self._mirror.panel_at(x, y)
            if panel is not None and panel != self.panel:
                self.enter(panel)

    def pose(self, deck: tuple[float, float, float], height_m: float, slope: Slope) -> PanelPose:
        """A deck pose (x, y, heading) on a surface of this height and slope, as ``Mirror.panel_pose``."""
        x, y, psi = deck
        ox, oy, oz = self._origin
        px, py, pz = x - ox, y - oy, height_m - oz
        fx, fy = slope[0], slope[1]
        s2 = 1.0 + fx * fx
        s, norm = sqrt(s2), sqrt(s2 + fy * fy)
        c, d = cos(psi), sin(psi)
        hx, hy = c / s - d * fx * fy / (norm * s), d * s / norm
        along, across = self.along(hx, hy, fx * hx + fy * hy)
        return PanelPose(self.panel, *self.along(px, py, pz), atan2(across, along))

    def along(self, dx: float, dy: float, dz: float) -> tuple[float, float]:
        """Components of a deck vector along the panel's axes."""
        return self._ax * dx + self._ay * dy + self._az * dz, self._bx * dx + self._by * dy + self._bz * dz
