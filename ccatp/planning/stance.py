"""Pure. Where the robot can stand and which way it can face and turn there without a sensor passing the rim."""

from dataclasses import dataclass
from itertools import accumulate
from math import ceil, floor, hypot, pi, tau
from typing import NamedTuple

import numpy as np

from ccatp.angles import difference
from ccatp.config.models import MissionConfig, RobotConfig
from ccatp.mirror.mirror import Mirror
from ccatp.samples import BoolArray, FloatArray

_BINS = 360
_BIN_RAD = tau / _BINS
# Half way between two bins a sensor at 0.13 m is at most 0.13 (1 - cos(0.5 deg)) = 5 um further out than in them.
_BETWEEN_BINS_M = 1e-5
# A turn this near to half a turn may go either way round: the noise of the heading decides.
_AMBIGUOUS_RAD = 0.1
# Beyond what turning needs, so that a place found on one grid is still a place to turn after rounding.
_SPARE_M = 0.001


class Stance:
    """Courses that the robot can face at one place near the rim, 360 of them, and turns between them."""

    __slots__ = ("_blocked",)

    def __init__(self, free: BoolArray) -> None:
        """Keep the running number of blocked courses over four turns: any arc is one difference.

        Args:
            free: whether all sensors keep their clearance on the course of k degrees, shape (360,).
        """
        self._blocked: list[int] = [0, *accumulate(np.tile(~free, 4).astype(int).tolist())]

    def can_face(self, course_rad: float) -> bool:
        """Whether the robot can face a course."""
        return self._is_free(course_rad % tau + tau, 0.0)

    def can_turn(self, from_rad: float, to_rad: float) -> bool:
        """Whether it can turn in place the short way from one course to another; near half a turn, either way."""
        start = from_rad % tau + tau
        angle = difference(to_rad, from_rad)
        if not self._is_free(start, angle):
            return False
        if pi - abs(angle) > _AMBIGUOUS_RAD:
            return True
        return self._is_free(start, angle - tau if angle > 0.0 else angle + tau)

    def _is_free(self, start_rad: float, angle_rad: float) -> bool:
        low, high = sorted((start_rad, start_rad + angle_rad))
        first, last = floor(low / _BIN_RAD), ceil(high / _BIN_RAD)
        return self._blocked[last + 1] == self._blocked[first]


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A place on the deck.

    Attributes:
        x_m, y_m: deck coordinates.
        depth_m: distance to the rim.
        stance: what the robot can do there; ``None`` where it can turn as it likes.
    """

    x_m: float
    y_m: float
    depth_m: float
    stance: Stance | None = None

    def can_face(self, course_rad: float) -> bool:
        """Whether the robot can face a course here."""
        return self.stance is None or self.stance.can_face(course_rad)

    def can_turn(self, from_rad: float, to_rad: float) -> bool:
        """Whether the robot can turn in place here, the short way."""
        return self.stance is None or self.stance.can_turn(from_rad, to_rad)


class Body(NamedTuple):
    """The robot as its edge sensors see it.

    Attributes:
        sensors_m: the sensors in the robot frame, shape (4, 2).
        reach_m: the largest distance of one from the robot's origin.
        leg_clearance_m: what the origin keeps from the rim on a leg.
        turn_clearance_m: what each sensor keeps from it, always.
    """

    sensors_m: FloatArray
    reach_m: float
    leg_clearance_m: float
    turn_clearance_m: float

    @property
    def turning_depth_m(self) -> float:
        """Distance from the rim at which the robot may stand and turn as it likes."""
        return max(self.reach_m + self.turn_clearance_m, self.leg_clearance_m) + _SPARE_M


def build_body(robot: RobotConfig, mission: MissionConfig) -> Body:
    """The robot's body and its clearances out of the configuration."""
    reach_m = max(hypot(x, y) for x, y in robot.edge_sensors_m)
    return Body(np.array(robot.edge_sensors_m), reach_m, mission.leg_clearance_m, mission.turn_clearance_m)


def sensor_depths(mirror: Mirror, body: Body, xs: FloatArray, ys: FloatArray, courses_rad: FloatArray) -> FloatArray:
    """Distance to the rim of the sensor nearest to it, of a robot that stands at (x, y) facing a course.

    The robot lies in the tangent plane; its sensors are projected on the deck: with the course u = (c, s) and the rise
    g = fx c + fy s along it, ``h = (c, s, g)/sqrt(1 + g^2)`` and ``l = n x h``.

    Args:
        mirror: the mirror.
        body: the robot.
        xs, ys, courses_rad: arrays that broadcast against each other, m and rad.

    Returns:
        The common shape, m; negative where a sensor is beyond the rim.
    """
    x, y, course = np.broadcast_arrays(xs, ys, courses_rad)
    fx, fy = mirror.surface.gradients(x, y)
    c, s = np.cos(course), np.sin(course)
    g = fx * c + fy * s
    h = np.sqrt(1.0 + g * g)
    w = h * np.sqrt(1.0 + fx * fx + fy * fy)
    ox, oy = body.sensors_m[:, 0], body.sensors_m[:, 1]
    px = x[..., None] + ox * (c / h)[..., None] - oy * ((s + fy * g) / w)[..., None]
    py = y[..., None] + ox * (s / h)[..., None] + oy * ((c + fx * g) / w)[..., None]
    return np.asarray(mirror.rim.signed_distances_m(px, py).min(axis=-1), dtype=np.float64)


def build_places(mirror: Mirror, body: Body, xs: FloatArray, ys: FloatArray) -> list[Place]:
    """Places at deck coordinates of shape (n,), m, each with its stance where it is near the rim."""
    depths = mirror.rim.signed_distances_m(xs, ys)
    near = np.flatnonzero(depths < body.turning_depth_m)
    courses: FloatArray = np.arange(_BINS, dtype=np.float64) * _BIN_RAD
    free = (
        sensor_depths(mirror, body, xs[near, None], ys[near, None], courses) >= body.turn_clearance_m + _BETWEEN_BINS_M
    )
    stances = {int(k): Stance(row) for k, row in zip(near, free, strict=True)}
    return [
        Place(x, y, depth, stances.get(k))
        for k, (x, y, depth) in enumerate(zip(xs.tolist(), ys.tolist(), depths.tolist(), strict=True))
    ]
