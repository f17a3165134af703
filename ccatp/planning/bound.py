"""Pure. Bang-bang times: the least time that a path takes under the motion limits, turning in place at every stop."""

from collections.abc import Sequence
from itertools import pairwise
from math import dist, pi, sqrt

from ccatp.angles import bearing, difference
from ccatp.config.models import LimitsConfig
from ccatp.mirror.mirror import Mirror
from ccatp.planning.course import heading_of_course
from ccatp.samples import DeckPose, Stop, StopKind

# A leg that begins within this of the heading is steered for on the way and needs no turn in place, by
# control.straight_tolerance_rad; the points of a row, dropped on the curved surface, lie on a straight line to 10 mrad.
STRAIGHT_RAD = 0.05


def bang_bang_time(distance: float, v_max: float, a_max: float) -> float:
    """Least time from rest to rest under bounded speed and acceleration, s.

    ``2 sqrt(d/a)`` while the peak stays below v (d < v^2/a), else ``d/v + v/a``.

    Args:
        distance: m or rad, sign ignored.
        v_max: speed limit, m/s or rad/s.
        a_max: acceleration limit, m/s^2 or rad/s^2.

    Raises:
        ValueError: if a limit is not positive.
    """
    if v_max <= 0.0 or a_max <= 0.0:
        raise ValueError(f"limits must be positive, got v_max={v_max}, a_max={a_max}")
    length = abs(distance)
    if length * a_max < v_max * v_max:
        return 2.0 * sqrt(length / a_max)
    return length / v_max + v_max / a_max


def leg_time(length_m: float, limits: LimitsConfig) -> float:
    """Bang-bang time of a straight leg, s."""
    return bang_bang_time(length_m, limits.v_max_m_s, limits.a_max_m_s2)


def turn_time(angle_rad: float, limits: LimitsConfig, straight_rad: float = STRAIGHT_RAD) -> float:
    """Bang-bang time of a turn in place, s; 0 for less than ``straight_rad``, which is steered on the way."""
    if abs(angle_rad) <= straight_rad:
        return 0.0
    return bang_bang_time(angle_rad, limits.omega_max_rad_s, limits.alpha_max_rad_s2)


def stop_times(stops: Sequence[Stop], start: DeckPose, limits: LimitsConfig, mirror: Mirror) -> list[float]:
    """Bang-bang time from each stop's predecessor (``start`` for the first) until the robot stands on the stop, s.

    Turns are measured in the tangent plane where the robot stands, and go the short way.
    """
    times = []
    x, y, heading = start.x_m, start.y_m, start.heading_rad
    for stop, length_m in zip(stops, leg_lengths(stops, start, mirror), strict=True):
        time_s = leg_time(length_m, limits)
        if length_m > 0.0:
            course = bearing(stop.x_m - x, stop.y_m - y) + (pi if stop.reverse else 0.0)
            time_s += turn_time(difference(heading_of_course(mirror, x, y, course), heading), limits)
            heading = heading_of_course(mirror, stop.x_m, stop.y_m, course)
        x, y = stop.x_m, stop.y_m
        if stop.heading_rad is not None:
            time_s += turn_time(difference(stop.heading_rad, heading), limits)
            heading = stop.heading_rad
        times.append(time_s)
    return times


def path_time(
    stops: Sequence[Stop], start: DeckPose, limits: LimitsConfig, mirror: Mirror, measuring_time_s: float
) -> float:
    """Least time to drive a path from rest to rest and to measure at its measurement points, s.

    Args:
        stops: the path.
        start: pose before the first leg, deck frame.
        limits: motion limits.
        mirror: gives the surface on which the legs lie.
        measuring_time_s: standstill at each measurement point.
    """
    measurements = sum(stop.kind in (StopKind.MEASURE, StopKind.CALIBRATE) for stop in stops)
    return sum(stop_times(stops, start, limits, mirror)) + measurements * measuring_time_s


def leg_lengths(stops: Sequence[Stop], start: DeckPose, mirror: Mirror) -> list[float]:
    """Length of the leg to each stop on the surface, m.

    It is the chord between the surface points, which falls short of the arc by less than 0.1 mm in a metre.
    """
    first = mirror.surface_point(start.x_m, start.y_m)
    points = [first, *(mirror.surface_point(stop.x_m, stop.y_m) for stop in stops)]
    return [dist(a, b) for a, b in pairwise(points)]


def path_length(stops: Sequence[Stop], start: DeckPose, mirror: Mirror) -> float:
    """Length of a path on the surface, m."""
    return sum(leg_lengths(stops, start, mirror))
