"""Pure. Rigid transforms between the world, the mirror and the deck frame of one mirror."""

from dataclasses import dataclass
from math import cos, sin

from ccatp.config.models import FrameConfig
from ccatp.samples import Vector3


@dataclass(frozen=True, slots=True)
class MirrorFrames:
    """Where a mirror stands in the world.

    ``p_mirror = R (p_world - origin)`` with ``R = [[1, 0, 0], [0, c, s], [0, -s, c]]``; the deck frame is the mirror
    frame turned by pi about its y axis where ``drive_side`` is -1, and the mirror frame itself where it is +1.

    Attributes:
        origin_m: origin of the mirror frame in the world, m.
        c, s: cosine and sine of the rotation about x.
        drive_side: sign of the mirror frame's z on the robot's side.
    """

    origin_m: Vector3
    c: float
    s: float
    drive_side: int

    def deck_from_mirror(self, p: Vector3) -> Vector3:
        """Deck coordinates of a point given in the mirror frame, m. Its own inverse."""
        return p if self.drive_side > 0 else (-p[0], p[1], -p[2])

    def mirror_from_deck(self, p: Vector3) -> Vector3:
        """Mirror coordinates of a point given in the deck frame, m."""
        return p if self.drive_side > 0 else (-p[0], p[1], -p[2])

    def mirror_from_world(self, p: Vector3) -> Vector3:
        """Mirror coordinates of a point given in the world frame, m."""
        dx, dy, dz = p[0] - self.origin_m[0], p[1] - self.origin_m[1], p[2] - self.origin_m[2]
        return dx, self.c * dy + self.s * dz, self.c * dz - self.s * dy

    def world_from_mirror(self, p: Vector3) -> Vector3:
        """World coordinates of a point given in the mirror frame, m."""
        x, y, z = p
        o = self.origin_m
        return x + o[0], self.c * y - self.s * z + o[1], self.s * y + self.c * z + o[2]

    def world_from_deck(self, p: Vector3) -> Vector3:
        """World coordinates of a point given in the deck frame, m."""
        return self.world_from_mirror(self.mirror_from_deck(p))

    def deck_from_world(self, p: Vector3) -> Vector3:
        """Deck coordinates of a point given in the world frame, m."""
        return self.deck_from_mirror(self.mirror_from_world(p))

    def rotate_world_from_deck(self, v: Vector3) -> Vector3:
        """World components of a vector given in the deck frame."""
        x, y, z = self.mirror_from_deck(v)
        return x, self.c * y - self.s * z, self.s * y + self.c * z

    def rotate_deck_from_world(self, v: Vector3) -> Vector3:
        """Deck components of a vector given in the world frame."""
        x, y, z = v
        return self.deck_from_mirror((x, self.c * y + self.s * z, self.c * z - self.s * y))


def build_frames(cfg: FrameConfig) -> MirrorFrames:
    """Frames of a mirror from its configuration (mm and rad)."""
    x, y, z = cfg.origin_world_mm
    angle = cfg.rotation_about_x_rad
    return MirrorFrames((x * 1e-3, y * 1e-3, z * 1e-3), cos(angle), sin(angle), cfg.reflecting_side_sign)
