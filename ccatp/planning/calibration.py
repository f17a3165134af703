"""Pure. The calibration drive: back and forth at base with a fix at each end, before the survey begins."""

from collections.abc import Sequence
from math import cos, hypot, sin

from ccatp.config.models import MissionConfig, RobotConfig
from ccatp.mirror.mirror import Mirror
from ccatp.planning.course import course_of_heading
from ccatp.planning.stance import build_body
from ccatp.samples import DeckPose, Stop, StopKind

_SHORTEST_M = 0.08  # a leg shorter than this teaches less than it costs
_STEP_M = 0.02
_BESIDE_M = 0.03  # so far beside its line a drive can still go on


def plan_calibration(mirror: Mirror, robot: RobotConfig, mission: MissionConfig, base: DeckPose) -> tuple[Stop, ...]:
    """Rounds of four legs between base and a place behind or before it; they end at base with the heading of the start.

    There and back along one line, once driven with the same heading and once with the opposite one: a wrong heading
    shifts the two ends against each other, creep shifts both downhill, slip shortens both legs, and two half turns tell
    a wrong wheel base from a wrong gyroscope. So the first leg of the survey is driven with errors that are known. A
    second round shows whether slip and creep are the same again.

    Args:
        mirror: the mirror.
        robot: where the sensors are.
        mission: clearances, the length wanted (0 = no calibration), and how many rounds.
        base: where the robot stands.

    Returns:
        The stops; none where there is no room.
    """
    depth_m = max(build_body(robot, mission).turning_depth_m, mission.leg_clearance_m)
    course = course_of_heading(mirror, base)
    if mirror.rim.signed_distance_m(base.x_m, base.y_m) < depth_m:
        return ()
    for is_reverse in (True, False):
        sign = -1.0 if is_reverse else 1.0
        way_m = _room_m(mirror, base, sign * cos(course), sign * sin(course), depth_m, mission.calibration_length_m)
        if way_m >= _SHORTEST_M:
            away = base.x_m + sign * way_m * cos(course), base.y_m + sign * way_m * sin(course)
            home = base.x_m, base.y_m
            drive = (
                Stop(*away, StopKind.CALIBRATE, reverse=is_reverse),
                Stop(*home, StopKind.CALIBRATE, reverse=not is_reverse),
                Stop(*away, StopKind.CALIBRATE, reverse=not is_reverse),
                Stop(*home, StopKind.CALIBRATE, reverse=not is_reverse),
            )
            return drive * mission.calibration_rounds
    return ()


def _room_m(mirror: Mirror, base: DeckPose, cx: float, cy: float, depth_m: float, wanted_m: float) -> float:
    """How far the robot can go from base in a direction of the deck plane and still turn there, up to ``wanted_m``."""
    way_m = 0.0
    while way_m < wanted_m:
        step_m = min(way_m + _STEP_M, wanted_m)
        if mirror.rim.signed_distance_m(base.x_m + step_m * cx, base.y_m + step_m * cy) < depth_m:
            break
        way_m = step_m
    return way_m


def is_on_drive(stops: Sequence[Stop], x_m: float, y_m: float) -> bool:
    """Whether a calibration drive can go on from a place: it lies on its line, where the robot may turn anywhere.

    Args:
        stops: a route with the drive's stops.
        x_m, y_m: the place, deck frame.
    """
    ends = dict.fromkeys((stop.x_m, stop.y_m) for stop in stops if stop.kind is StopKind.CALIBRATE)
    if len(ends) != 2:
        return False
    (ax, ay), (bx, by) = ends
    dx, dy = bx - ax, by - ay
    share = min(max(((x_m - ax) * dx + (y_m - ay) * dy) / (dx * dx + dy * dy), 0.0), 1.0)
    return hypot(x_m - ax - share * dx, y_m - ay - share * dy) <= _BESIDE_M
