"""Pure. Round obstacles: whether they stand in a line of sight, how far the distance sensors see, whom they touch."""

from collections.abc import Iterable
from math import cos, hypot, inf, sin, sqrt

from ccatp.config.radio_models import SimObstacleConfig
from ccatp.sim.radio.frame import TruePose

Point = tuple[float, float]


def count_between(a_m: Point, b_m: Point, obstacles: Iterable[SimObstacleConfig]) -> int:
    """How many obstacles the segment from one place to another passes through."""
    return sum(_distance_to_segment((o.x_m, o.y_m), a_m, b_m) < o.radius_m for o in obstacles)


def seen_m(pose: TruePose, direction_rad: float, obstacles: Iterable[SimObstacleConfig]) -> float:
    """Distance from the vehicle to the first obstacle in a direction left of the heading, m; infinite without one."""
    return min((_along_ray(pose, pose.heading_rad + direction_rad, o) for o in obstacles), default=inf)


def clearance_m(pose: TruePose, obstacles: Iterable[SimObstacleConfig]) -> float:
    """Distance from the vehicle's origin to the nearest obstacle's surface, m; infinite without one."""
    return min((hypot(o.x_m - pose.x_m, o.y_m - pose.y_m) - o.radius_m for o in obstacles), default=inf)


def _along_ray(pose: TruePose, course_rad: float, obstacle: SimObstacleConfig) -> float:
    dx_m, dy_m = obstacle.x_m - pose.x_m, obstacle.y_m - pose.y_m
    along_m = dx_m * cos(course_rad) + dy_m * sin(course_rad)
    beside_m = dy_m * cos(course_rad) - dx_m * sin(course_rad)
    if abs(beside_m) >= obstacle.radius_m:
        return inf
    half_chord_m = sqrt(obstacle.radius_m**2 - beside_m**2)
    if along_m + half_chord_m < 0.0:
        return inf
    return max(along_m - half_chord_m, 0.0)


def _distance_to_segment(point: Point, a: Point, b: Point) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    square = dx * dx + dy * dy
    share = 0.0 if square == 0.0 else ((point[0] - a[0]) * dx + (point[1] - a[1]) * dy) / square
    share = max(0.0, min(1.0, share))
    return hypot(point[0] - a[0] - share * dx, point[1] - a[1] - share * dy)
