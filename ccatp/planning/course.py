"""Pure. Courses and headings: a direction in the deck plane, and the angle in the tangent plane that projects on it."""

from math import atan2, cos, sin

from ccatp.angles import bearing
from ccatp.mirror.mirror import Mirror
from ccatp.samples import DeckPose


def heading_of_course(mirror: Mirror, x: float, y: float, course_rad: float) -> float:
    """Deck heading (in the tangent plane) of a robot whose heading projects on a course in the deck plane, rad."""
    (ax, _, az), (bx, by, bz), _ = mirror.surface.axes(x, y)
    fx, fy = mirror.surface.gradient(x, y)
    c, s = cos(course_rad), sin(course_rad)
    rise = fx * c + fy * s
    return atan2(bx * c + by * s + bz * rise, ax * c + az * rise)


def course_of_heading(mirror: Mirror, pose: DeckPose) -> float:
    """Direction in the deck plane on which the robot's heading projects, rad."""
    hx, hy, _, _ = mirror.body_axes(pose)
    return bearing(hx, hy)
