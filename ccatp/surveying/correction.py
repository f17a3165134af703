"""Pure. The short move that brings a robot standing beside its point onto it, in place of a new route."""

from math import atan2, ceil, cos, hypot, pi, sin
from typing import NamedTuple

import numpy as np

from ccatp.angles import difference
from ccatp.config.models import MissionConfig, RobotConfig
from ccatp.mirror.mirror import Mirror
from ccatp.planning.course import course_of_heading
from ccatp.planning.stance import build_body, sensor_depths
from ccatp.samples import DeckPose, PanelPose, Stop

# A sensor at 0.13 m sweeps 2 mm in a hundredth of a turn's radian; between two such steps it is 0.03 mm further out.
_SWEEP_RAD = 0.04


class Aim(NamedTuple):
    """Where a correction leads, in the frame of the panel on which the robot stands.

    Attributes:
        x_m, y_m: where the robot's origin shall stand.
        reverse: it moves there backwards.
        turn_rad: turn in place before it.
    """

    x_m: float
    y_m: float
    reverse: bool
    turn_rad: float


def plan_aim(pose: tuple[float, float, float], target: tuple[float, float], tolerance_m: float, margin: float) -> Aim:
    """The least motion that brings the robot within the tolerance.

    Straight along the heading, where the part beside it is at most ``margin`` of the tolerance; else by the smaller
    turn that points head or tail at the target.

    Args:
        pose: (x, y, heading), m and rad.
        target: (x, y) in the same plane, m.
        tolerance_m: how near the robot has to come.
        margin: share of it that a straight move may leave.
    """
    x, y, heading = pose
    dx, dy = target[0] - x, target[1] - y
    c, s = cos(heading), sin(heading)
    ahead, beside = c * dx + s * dy, c * dy - s * dx
    if abs(beside) <= margin * tolerance_m:
        return Aim(x + ahead * c, y + ahead * s, ahead < 0.0, 0.0)
    turn = difference(atan2(dy, dx), heading)
    if abs(turn) <= 0.5 * pi:
        return Aim(*target, False, turn)
    return Aim(*target, True, difference(turn, pi))


class Corrector:
    """Says where a correction leads, or that none is to be had; and whether a turn after it is safe.

    Args:
        mirror: gives the rim.
        robot: gives the edge sensors.
        cfg: tolerance, reach and clearances.
    """

    def __init__(self, mirror: Mirror, robot: RobotConfig, cfg: MissionConfig) -> None:
        """Nothing is kept but what is given."""
        self._mirror, self._cfg = mirror, cfg
        self._body = build_body(robot, cfg)

    def aim(self, pose: PanelPose, target: tuple[float, float]) -> Aim | None:
        """The correction from ``pose`` to ``target``; ``None`` where it is too far or a sensor would pass the rim.

        Args:
            pose: where the robot stands.
            target: (x, y) in the frame of its panel, m.
        """
        cfg = self._cfg
        distance_m = hypot(target[0] - pose.x_m, target[1] - pose.y_m)
        if distance_m > cfg.correction_reach_m:
            return None
        aim = plan_aim(
            (pose.x_m, pose.y_m, pose.heading_rad), target, cfg.correction_tolerance_m, cfg.correction_margin
        )
        turned = PanelPose(pose.panel, pose.x_m, pose.y_m, pose.heading_rad + aim.turn_rad)
        there = PanelPose(pose.panel, aim.x_m, aim.y_m, turned.heading_rad)
        start, end = self._mirror.deck_pose(pose), self._mirror.deck_pose(there)
        if not self._is_clear(start, aim.turn_rad):
            return None
        # Between the ends of a few centimetres a sensor is never nearer to the rim than by half of them.
        is_safe = self._is_clear(self._mirror.deck_pose(turned), 0.0) and self._is_clear(end, 0.0)
        return aim if is_safe else None

    def can_go_on(self, pose: DeckPose, stop: Stop) -> bool:
        """Whether the turn towards ``stop`` from where a correction ended keeps every sensor on the mirror."""
        bearing = atan2(stop.y_m - pose.y_m, stop.x_m - pose.x_m) + (pi if stop.reverse else 0.0)
        return self._is_clear(pose, difference(bearing, course_of_heading(self._mirror, pose)))

    def _is_clear(self, pose: DeckPose, turn_rad: float) -> bool:
        body = self._body
        if self._mirror.rim.signed_distance_m(pose.x_m, pose.y_m) >= body.turning_depth_m:
            return True
        course = course_of_heading(self._mirror, pose)
        courses = np.linspace(course, course + turn_rad, 1 + ceil(abs(turn_rad) / _SWEEP_RAD))
        depths = sensor_depths(self._mirror, body, np.array(pose.x_m), np.array(pose.y_m), courses)
        return bool(depths.min() >= body.turn_clearance_m)
