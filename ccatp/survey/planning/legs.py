"""Which straight legs and turns keep the clearance from the rim, and the way around a stepped corner.

A course is a direction in the deck plane; a heading is the angle in the tangent plane that projects on it.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from math import atan2, ceil, cos, floor, hypot, inf, pi, sin, tau
from typing import NamedTuple

import numpy as np

from ccatp.config.models import MissionConfig, RobotConfig
from ccatp.core import DeckPose, FloatArray, PanelId
from ccatp.errors import CcatpError, ExitStatus
from ccatp.kinematics import bearing, difference
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.rim import Rim, to_segment_m

_BINS = 360
_BIN_RAD = tau / _BINS
# Between two bins a sensor at 0.13 m is at most 0.13 (1 - cos(0.5 deg)) = 5 um further out than at them.
_BETWEEN_BINS_M = 1e-5
# A turn this near to half a turn may go either way, depending on the noise of the heading.
_AMBIGUOUS_RAD = 0.1
# Added to the depth that turning needs, so that a place on one grid remains a place to turn after rounding.
_SPARE_M = 0.001
# On a shorter leg the error of the position dominates the steering: 1 mm on 20 mm is the 0.05 rad that needs no turn.
# The turn before the leg adds an error proportional to the friction lever of the tyres.
_SHORTEST_MOVE_M = 0.02
_SHORTEST_MOVE_TYRES = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class LegPlace:
    """A place on the deck and, near the rim, the courses that the robot can face there.

    ``blocked``: cumulative count, over four turns of 360 courses, of those on which a sensor does not keep its
    clearance; the number in an arc is one difference. ``None`` where the robot can turn freely.
    """

    x_m: float
    y_m: float
    depth_m: float
    blocked: list[int] | None = None

    def can_face(self, course_rad: float) -> bool:
        """Whether the robot can face a course here."""
        return self._is_free(course_rad % tau + tau, 0.0)

    def can_turn(self, from_rad: float, to_rad: float) -> bool:
        """Whether the robot can turn in place the short way between two courses; near half a turn, both ways."""
        start = from_rad % tau + tau
        angle = difference(to_rad, from_rad)
        if not self._is_free(start, angle):
            return False
        if pi - abs(angle) > _AMBIGUOUS_RAD:
            return True
        return self._is_free(start, angle - tau if angle > 0.0 else angle + tau)

    def _is_free(self, start_rad: float, angle_rad: float) -> bool:
        if self.blocked is None:
            return True
        low, high = sorted((start_rad, start_rad + angle_rad))
        first, last = floor(low / _BIN_RAD), ceil(high / _BIN_RAD)
        return self.blocked[last + 1] == self.blocked[first]


class Footprint(NamedTuple):
    """The edge sensors in the robot frame, (4, 2), the distance of the furthest, and the clearances, m.

    ``shortest_move_m``: least length of the leg from the place of the turn to a point at the rim.
    """

    sensors_m: FloatArray
    reach_m: float
    leg_clearance_m: float
    turn_clearance_m: float
    shortest_move_m: float

    @property
    def turning_depth_m(self) -> float:
        """Distance from the rim at which the robot may stand and turn freely."""
        return max(self.reach_m + self.turn_clearance_m, self.leg_clearance_m) + _SPARE_M


def build_body(robot: RobotConfig, mission: MissionConfig) -> Footprint:
    """The robot's body and clearances from the configuration."""
    reach_m = max(hypot(x, y) for x, y in robot.edge_sensors_m)
    shortest_m = max(_SHORTEST_MOVE_M, _SHORTEST_MOVE_TYRES * robot.tyre_m)
    sensors_m = np.array(robot.edge_sensors_m)
    return Footprint(sensors_m, reach_m, mission.leg_clearance_m, mission.turn_clearance_m, shortest_m)


def sensor_depths(
    mirror: Mirror, body: Footprint, xs: FloatArray, ys: FloatArray, courses_rad: FloatArray
) -> FloatArray:
    """Distance to the rim of the sensor nearest to it, m (< 0 beyond), of a robot at (x, y) facing a course.

    The arrays are broadcast. The robot lies in the tangent plane, and its sensors are projected on the deck: with the
    course u = (c, s) and the rise g = fx c + fy s along it, ``h = (c, s, g)/sqrt(1 + g^2)`` and ``l = n x h``.
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


def build_places(mirror: Mirror, body: Footprint, xs: FloatArray, ys: FloatArray) -> list[LegPlace]:
    """Places at deck coordinates of shape (n,), m, with the blocked courses of those near the rim."""
    depths = mirror.rim.signed_distances_m(xs, ys)
    near = np.flatnonzero(depths < body.turning_depth_m)
    courses: FloatArray = np.arange(_BINS, dtype=np.float64) * _BIN_RAD
    clearances = sensor_depths(mirror, body, xs[near, None], ys[near, None], courses)
    is_blocked = np.tile(clearances < body.turn_clearance_m + _BETWEEN_BINS_M, 4)
    blocked = {int(k): [0, *np.cumsum(row).tolist()] for k, row in zip(near, is_blocked, strict=True)}
    return [
        LegPlace(x, y, depth, blocked.get(k))
        for k, (x, y, depth) in enumerate(zip(xs.tolist(), ys.tolist(), depths.tolist(), strict=True))
    ]


_ROUNDING_M = 1e-9
# Sine of the angle between track and seam (30 deg) above which a sensor crosses a seam as the danger rules expect.
_STEEP = 0.5
# A track at least this far from a seam's border passes beside the seam in spite of errors.
_BESIDE_M = 0.008
# A track at 60 deg from the seam's normal is in the gap for twice its width. Longer crossings are avoided, because the
# danger rules may take them for the mirror's edge.
_LONGEST_CROSSING = 2.0


class Grazing(IntEnum):
    """How a leg lies to the seams that are oblique to it; a higher value is worse."""

    NONE = 0
    BESIDE = 1  # a sensor passes so near that errors may carry it over the gap
    ALONG = 2  # a sensor runs along within the gap: it cannot be distinguished from an edge


_GRAZING_M = (0.0, 0.4, 4.0)  # accepted detour to avoid each


class LegRules:
    """Decides which straight legs the robot may drive."""

    def __init__(self, mirror: Mirror, body: Footprint) -> None:
        self._rim, self._body = mirror.rim, body
        self._sensors: list[list[float]] = body.sensors_m.tolist()
        self._corners, self._nodes = _reentrant_corners(mirror, body)
        self._seams = _seam_lines(mirror)
        self._half_gap_m = 0.5 * mirror.gap_m
        self._explained_m = _LONGEST_CROSSING * mirror.gap_m
        self._beside_m = self._half_gap_m + _BESIDE_M

    def clearance_m(self, a: LegPlace, b: LegPlace) -> float:
        """Clearance of the leg from ``a`` to ``b``, m: exact, or a lower bound that is enough for every rule."""
        # The distance from the rim changes by at most the distance driven.
        at_least = 0.5 * (a.depth_m + b.depth_m - hypot(b.x_m - a.x_m, b.y_m - a.y_m))
        if at_least >= self._body.turning_depth_m:
            return at_least
        return self._rim.segment_clearance_m(a.x_m, a.y_m, b.x_m, b.y_m)

    def is_enough(self, clearance_m: float) -> bool:
        """Whether the robot's origin may pass the rim at this distance."""
        return clearance_m >= self._body.leg_clearance_m - _ROUNDING_M

    def is_clear(self, a: LegPlace, b: LegPlace) -> bool:
        """Whether the robot's origin keeps the clearance of a leg from ``a`` to ``b``."""
        return self.is_enough(self.clearance_m(a, b))

    def are_sensors_clear(self, a: LegPlace, b: LegPlace, course_rad: float, clearance_m: float) -> bool:
        """Whether all sensors keep ``turn_clearance_m`` between the ends of a leg on which the robot faces a course.

        Away from re-entrant corners the mirror is convex. There a sensor is nearest to the rim at an end of its
        straight track, which the places check. ``clearance_m``: of the robot's origin.
        """
        body = self._body
        if clearance_m >= body.reach_m + body.turn_clearance_m:
            return True
        if self._corner_distance_m(a, b) >= body.reach_m + body.turn_clearance_m:
            return True
        c, s = cos(course_rad), sin(course_rad)
        return all(
            self._rim.segment_clearance_m(
                a.x_m + c * ox - s * oy, a.y_m + s * ox + c * oy, b.x_m + c * ox - s * oy, b.y_m + s * ox + c * oy
            )
            >= body.turn_clearance_m
            for ox, oy in self._sensors
        )

    def grazing(self, a: LegPlace, b: LegPlace, course_rad: float) -> Grazing:
        """Whether a sensor may run along a seam on the leg from ``a`` to ``b``, which looks like the mirror's edge."""
        dx, dy = b.x_m - a.x_m, b.y_m - a.y_m
        length = hypot(dx, dy)
        c, s = cos(course_rad), sin(course_rad)
        found = Grazing.NONE
        for start, way, lines, (p, q) in zip((a.x_m, a.y_m), (dx, dy), self._seams, ((c, -s), (s, c)), strict=True):
            if abs(way) >= _STEEP * length:
                continue
            for ox, oy in self._sensors:
                low = start + p * ox + q * oy
                high = low + way
                if low > high:
                    low, high = high, low
                first, last = bisect_right(lines, low - self._beside_m), bisect_left(lines, high + self._beside_m)
                for line in lines[first:last]:
                    if self._runs_along(low, high, line, length):
                        return Grazing.ALONG
                    found = Grazing.BESIDE
        return found

    def _runs_along(self, low: float, high: float, line: float, length: float) -> bool:
        """Whether a track of ``length`` between two places across a seam lies in its gap for long."""
        overlap = min(high, line + self._half_gap_m) - max(low, line - self._half_gap_m)
        if overlap < 0.0:
            return False
        across = high - low
        within = length if across == 0.0 else overlap / across * length
        return within > self._explained_m

    def way_around(self, a: LegPlace, b: LegPlace) -> tuple[LegPlace, ...]:
        """Best chain of places from ``a`` around stepped corners to ``b``, without the ends.

        Dijkstra's algorithm on the visibility graph of the corners, inset by the clearance, and of the two elbows,
        which are joined to both ends along the panels' rows and columns: on such legs no sensor runs along a seam.
        Empty if the straight leg is good, and if there is no way.
        """
        if self._is_good(a, b):
            return ()
        places = [a, *self._nodes, *self._elbows(a, b), b]
        cost = {0: 0.0}
        before: dict[int, int] = {}
        open_places = set(range(len(places)))
        while open_places:
            k = min(open_places, key=lambda i: cost.get(i, inf))
            if k not in cost:
                return ()
            if k == len(places) - 1:
                break
            open_places.remove(k)
            for i in open_places:
                total = cost[k] + hypot(places[i].x_m - places[k].x_m, places[i].y_m - places[k].y_m)
                if total < cost.get(i, inf) and self.is_clear(places[k], places[i]):
                    total += _GRAZING_M[self._grazing_facing(places[k], places[i])]
                    if total < cost.get(i, inf):
                        cost[i], before[i] = total, k
        chain = []
        k = len(places) - 1
        while (k := before[k]) != 0:
            chain.append(places[k])
        return tuple(reversed(chain))

    def elbows(self, sources: Iterable[LegPlace], targets: Sequence[LegPlace]) -> list[LegPlace]:
        """Elbows between all places of two groups that no good straight leg joins."""
        return [elbow for a in sources for b in targets if not self._is_good(a, b) for elbow in self._elbows(a, b)]

    def _is_good(self, a: LegPlace, b: LegPlace) -> bool:
        return self.is_clear(a, b) and not self._grazing_facing(a, b)

    def _grazing_facing(self, a: LegPlace, b: LegPlace) -> Grazing:
        return self.grazing(a, b, atan2(b.y_m - a.y_m, b.x_m - a.x_m))

    def _elbows(self, a: LegPlace, b: LegPlace) -> list[LegPlace]:
        places = []
        for x, y in ((a.x_m, b.y_m), (b.x_m, a.y_m)):
            depth = self._rim.signed_distance_m(x, y)
            if depth >= self._body.turning_depth_m:
                places.append(LegPlace(x, y, depth))
        return places

    def _corner_distance_m(self, a: LegPlace, b: LegPlace) -> float:
        ends = (a.x_m, a.y_m), (b.x_m, b.y_m)
        return min((to_segment_m(corner, *ends) for corner in self._corners), default=inf)


def _seam_lines(mirror: Mirror) -> tuple[list[float], list[float]]:
    """The deck x of the seams between columns, the deck y of those between rows."""
    xs, ys = set(), set()
    half_gap = 0.5 * mirror.gap_m
    for panel in mirror.panels.values():
        row, col = panel.id
        if PanelId(row, col + 1) in mirror.panels:
            xs.add(round(panel.x_m + panel.half_x_m + half_gap, 6))
        if PanelId(row + 1, col) in mirror.panels:
            ys.add(round(panel.y_m + panel.half_y_m + half_gap, 6))
    return sorted(xs), sorted(ys)


def _reentrant_corners(mirror: Mirror, body: Footprint) -> tuple[list[tuple[float, float]], list[LegPlace]]:
    """Corners of the rim at which the mirror has 270 degrees, and for each the place inset by the clearance."""
    vertices = [(float(x), float(y)) for x, y in mirror.rim.vertices]
    corners, nodes = [], []
    for (x0, y0), (x1, y1), (x2, y2) in zip(
        vertices[-1:] + vertices[:-1], vertices, vertices[1:] + vertices[:1], strict=True
    ):
        if (x1 - x0) * (y2 - y1) - (y1 - y0) * (x2 - x1) >= 0.0:
            continue
        corners.append((x1, y1))
        # The direction of the edge before plus the reverse direction of the edge after points to the inside.
        before, after = atan2(y1 - y0, x1 - x0), atan2(y1 - y2, x1 - x2)
        inset = max(body.leg_clearance_m, body.turning_depth_m / 2**0.5) + _ROUNDING_M
        x, y = x1 + inset * (cos(before) + cos(after)), y1 + inset * (sin(before) + sin(after))
        depth = mirror.rim.signed_distance_m(x, y)
        if depth >= body.turning_depth_m:
            nodes.append(LegPlace(x, y, depth))
    return corners, nodes


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


class PlanError(CcatpError):
    """Base of every refusal of a planner."""


class OutsideMirrorError(PlanError):
    """The start of a path is not on the mirror."""


class UnreachablePointError(PlanError):
    """No sequence of turns and straight legs with the configured clearances leads to the place."""

    exit_status = ExitStatus.USAGE


def room_m(
    rim: Rim,
    deck: DeckPose,
    way: tuple[float, float],
    wanted_m: float,
    step_m: float,
    clearance_m: float,
    *,
    spread: float = 0.0,
    leaving: float = inf,
) -> float:
    """Length of a leg along the unit vector ``way`` in the deck plane at whose end the robot can turn, <= ``wanted_m``.

    The required clearance grows by ``spread`` per metre. It is not required while at least the part ``leaving`` of a
    step leads away from the rim.
    """
    way_m, depth_m = 0.0, rim.signed_distance_m(deck.x_m, deck.y_m)
    while way_m < wanted_m:
        end_m = min(way_m + step_m, wanted_m)
        before_m, depth_m = depth_m, rim.signed_distance_m(deck.x_m + end_m * way[0], deck.y_m + end_m * way[1])
        is_leaving = depth_m - before_m > leaving * (end_m - way_m)
        if depth_m < clearance_m + spread * end_m and not is_leaving:
            break
        way_m = end_m
    return way_m
