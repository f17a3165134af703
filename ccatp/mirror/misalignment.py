"""Rigid misalignment of panels, piston + tilt x + tip y along the panel's normal, and the puck on such a panel."""

from dataclasses import dataclass
from math import sqrt

from ccatp.core import DeckPose, PanelId, Vector3
from ccatp.mirror.mirror import Mirror


@dataclass(frozen=True, slots=True)
class PanelMisalignment:
    """Rigid misalignment of a panel relative to the ideal surface, in the panel frame.

    ``piston_m`` > 0 towards the robot; ``tip_rad`` and ``tilt_rad``: slope of the displacement along y and along x.
    """

    piston_m: float
    tip_rad: float
    tilt_rad: float

    def displacement_m(self, x_p: float, y_p: float) -> float:
        """Displacement along the panel's normal at the panel coordinates (x_p, y_p), m."""
        return self.piston_m + self.tilt_rad * x_p + self.tip_rad * y_p


def misaligned_puck_world(
    mirror: Mirror, panel: PanelId, misalignment: PanelMisalignment, p: DeckPose, height_m: float
) -> Vector3:
    """World position of the puck's centre when the robot stands on a misaligned panel; ``p``: pose on the ideal one.

    The surface normal turns with the panel, to first order. Raises ``UnknownPanelError``.
    """
    body = mirror.panel(panel)
    point = mirror.surface.point(p.x_m, p.y_m)
    x_p, y_p, _ = body.from_deck(point)
    d = misalignment.displacement_m(x_p, y_p)
    nx, ny, nz = body.rotate_from_deck(mirror.surface.normal(p.x_m, p.y_m))
    # The rotation vector of the panel is (tip, -tilt, 0); its cross product with n is the change of the normal.
    tip, tilt = misalignment.tip_rad, misalignment.tilt_rad
    mx, my, mz = nx - tilt * nz, ny - tip * nz, nz + tip * ny + tilt * nx
    scale = height_m / sqrt(mx * mx + my * my + mz * mz)
    ox, oy, oz = body.rotate_to_deck((scale * mx, scale * my, scale * mz + d))
    return mirror.world_from_deck((point[0] + ox, point[1] + oy, point[2] + oz))
