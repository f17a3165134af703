"""Seam crossings: heading from a pair of edge sensors (thesis 2.1.5), and each transition as a position measurement."""

from collections.abc import Sequence
from math import atan2, hypot, inf, pi, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.config.models import FourStateConfig, RobotConfig
from ccatp.core import DeckPose, EdgeSample, FloatArray, PanelId, PanelPose
from ccatp.estimation.localizer_base import EdgeScanner, SensorTransition
from ccatp.estimation.odometry import Odometer, OdometryPose, Slope, axes_on
from ccatp.estimation.state_model import E0, E1, PSI, STATES, A, V, W, X
from ccatp.kinematics import rotate
from ccatp.mirror.layout import Seam
from ccatp.mirror.mirror import Mirror

_PAIRS = ((0, 1), (2, 3))  # front, rear: (left, right) in the order of EdgeSample
# A transition is assigned to a seam within this part of a panel's size from the sensor's expected place. Other edges
# (the rim, the next seam) are at least ten times further away.
_REACH = 0.05
_UNIFORM = 1.0 / 12.0  # variance of a uniform distribution over one interval


class PairHeading(NamedTuple):
    """Heading by two sensors of a pair at the right sensor's crossing, rad, modulo pi.

    ``length_m``: of the vector u between their crossings; ``across_m``: its component across the robot.
    """

    heading_rad: float
    length_m: float
    across_m: float


def heading_from_pair(
    left: OdometryPose,
    right: OdometryPose,
    left_xy: tuple[float, float],
    right_xy: tuple[float, float],
    normal_rad: float,
) -> PairHeading:
    """Heading of the robot from two of its sensors (robot frame, m) that have crossed the same straight line.

    Both sensors were on the line, so the vector between the two crossings, with the sensors' own offset, lies along it.
    In the robot frame at the right sensor's crossing this vector is
    ``u = R(turn) left_xy - right_xy + displacement``, and with the line's normal at angle phi::

        theta + atan2(u_y, u_x) = phi + pi/2   (mod pi)

    In pure translation u = (s_left - s_right, w) and this is ``theta = phi + atan((s_left - s_right)/w)``, thesis eq.
    2.15 and 2.16 with a sign: positive travel is forward, so one formula holds for every edge, driven forward or in
    reverse, with either sensor first. A turn between the two crossings is taken from the odometer. The heading is in
    the frame of ``normal_rad``.
    """
    turn = left.heading_rad - right.heading_rad
    dx, dy = rotate(left.x_m - right.x_m, left.y_m - right.y_m, -right.heading_rad)
    lx, ly = rotate(*left_xy, turn)
    ux, uy = lx + dx - right_xy[0], ly + dy - right_xy[1]
    return PairHeading(normal_rad + 0.5 * pi - atan2(uy, ux), hypot(ux, uy), abs(uy))


class _Mark(NamedTuple):
    """One sensor's last crossing of an edge of one kind."""

    t_s: float
    interval_s: float
    place: OdometryPose
    seam: Seam
    x_m: float
    y_m: float


class HeadingFix(NamedTuple):
    """A heading measured at a seam: difference from the estimate (rad) and variance (rad^2)."""

    innovation_rad: float
    variance_rad2: float


class CrossingDetector:
    """Computes headings from transitions of the edge sensors.

    Both edges of a gap and both pairs are used: up to four headings per seam. Both sensors of a pair must have crossed
    the same seam in the same sense, with almost pure translation in between.
    """

    def __init__(self, mirror: Mirror, robot: RobotConfig, cfg: FourStateConfig) -> None:
        self._mirror = mirror
        self._sensors = robot.edge_sensors_m
        self._cfg = cfg
        self._scanner = EdgeScanner()
        self._marks: dict[tuple[int, bool], _Mark] = {}
        self._disturbed_s = -inf
        self._reach_m = _REACH * 2.0 * min(mirror.grid.half_x_m, mirror.grid.half_y_m)

    def restart(self) -> None:
        """Drop all crossings, because the robot's clock has jumped."""
        self._scanner.restart()
        self._marks.clear()
        self._disturbed_s = -inf

    def scan(self, t_s: float, v_m_s: float, omega_rad_s: float, edges: Sequence[EdgeSample]) -> list[SensorTransition]:
        """Record the motion at ``t_s``, and return the transitions of the frame, normally none."""
        if abs(omega_rad_s) > self._cfg.crossing_max_rate_rad_s or abs(v_m_s) < self._cfg.crossing_min_speed_m_s:
            self._disturbed_s = t_s
        return self._scanner.scan(edges)

    def headings(
        self, transitions: Sequence[SensorTransition], odometer: Odometer, pose: PanelPose, deck: DeckPose, v_m_s: float
    ) -> list[HeadingFix]:
        """Headings completed by a frame's transitions; odometer and poses are those of this frame."""
        found = []
        for transition in transitions:
            mark = self._mark(transition, odometer, deck)
            if mark is None:
                continue
            self._marks[transition.corner, transition.is_on] = mark
            fix = self._complete(_PAIRS[transition.corner // 2], transition.is_on, odometer.place, pose, v_m_s)
            if fix is not None:
                found.append(fix)
        return found

    def _complete(
        self, pair: tuple[int, int], is_on: bool, now: OdometryPose, pose: PanelPose, v_m_s: float
    ) -> HeadingFix | None:
        left, right = self._marks.get((pair[0], is_on)), self._marks.get((pair[1], is_on))
        if left is None or right is None or min(left.t_s, right.t_s) <= self._disturbed_s:
            return None
        apart_m = abs(left.seam.position_m - right.seam.position_m)
        if left.seam.axis != right.seam.axis or apart_m >= self._reach_m:
            return None
        del self._marks[pair[0], is_on], self._marks[pair[1], is_on]
        x, y = 0.5 * (left.x_m + right.x_m), 0.5 * (left.y_m + right.y_m)
        normal = self._mirror.seam_normal_angle(pose.panel, left.seam.axis, x, y)
        left_xy, right_xy = self._sensors[pair[0]], self._sensors[pair[1]]
        by_pair = heading_from_pair(left.place, right.place, left_xy, right_xy, normal)
        estimate = pose.heading_rad + right.place.heading_rad - now.heading_rad
        innovation = (by_pair.heading_rad - estimate + 0.5 * pi) % pi - 0.5 * pi
        travel = hypot(left.place.x_m - right.place.x_m, left.place.y_m - right.place.y_m)
        timing = self._timing_variance(left) + self._timing_variance(right)
        # An error e of the travel turns u by e * across / |u|^2.
        per_travel = by_pair.across_m / by_pair.length_m**2
        variance = (v_m_s**2 * timing + (self._cfg.slip_fraction * travel) ** 2) * per_travel**2
        return HeadingFix(innovation, variance)

    def _mark(self, transition: SensorTransition, odometer: Odometer, pose: DeckPose) -> _Mark | None:
        x, y = self._mirror.body_offset(pose, *self._sensors[transition.corner])
        seam = self._mirror.nearest_seam(x, y)
        if seam is None or abs(seam.distance_m) > self._reach_m:
            return None
        place = odometer.at(transition.t_s)
        # The point on the seam, for the direction of its tangent. The map gives the coordinate across the seam.
        on_seam = (seam.position_m, y) if seam.axis == "x" else (x, seam.position_m)
        return _Mark(transition.t_s, transition.interval_s, place, seam, *on_seam)

    def _timing_variance(self, mark: _Mark) -> float:
        """Variance of a transition's time, s^2: as configured, but at least that of its sampling interval."""
        return max(self._cfg.crossing_time_sigma_s**2, mark.interval_s**2 * _UNIFORM)


class HeadingGate:
    """Refuses a heading that contradicts the estimate, unless a second one confirms it.

    Two agreeing headings in a row show that the estimate is wrong and its variance too small. Without this rule an
    overconfident filter would refuse every true heading.
    """

    def __init__(self, gate_sigma: float) -> None:
        self._gate_sigma = gate_sigma
        self._refused: HeadingFix | None = None

    def extra_variance(self, seen: HeadingFix, prior_rad2: float) -> float | None:
        """Variance (rad^2) to add to the estimate before it takes ``seen``; None: refused."""
        before, self._refused = self._refused, None
        if self._is_within(seen.innovation_rad, seen.variance_rad2 + prior_rad2):
            return 0.0
        if before is not None:
            apart = seen.innovation_rad - before.innovation_rad
            # The two may also differ by the drift of the estimate between the crossings.
            if self._is_within(apart, seen.variance_rad2 + before.variance_rad2 + prior_rad2):
                return seen.innovation_rad**2
        self._refused = seen
        return None

    def _is_within(self, deviation_rad: float, variance_rad2: float) -> bool:
        return abs(deviation_rad) <= self._gate_sigma * sqrt(variance_rad2)


_TIMING_FLOOR_M2 = 1e-10  # (10 um)^2: the sensor's own repeatability, UNVERIFIED


class Edge(NamedTuple):
    """A panel's edge crossed by a sensor; ``k``: deck axis across it; ``offset``: index of its displacement's state."""

    k: int
    position_m: float
    offset: int
    is_new: bool


class SensorAtEdge(NamedTuple):
    """A sensor at its transition: place, velocity, and along the axis of the edge the robot's axes h, l, and the lever.

    ``lever_m``: how far a radian of turn moves the sensor along that axis.
    """

    place_m: tuple[float, float]
    velocity_m_s: tuple[float, float]
    forward: float
    left: float
    lever_m: float


class EdgeMeasurement(NamedTuple):
    """Residual, m, row (1, n) of the model, and variance, m^2."""

    residual_m: float
    H: FloatArray
    variance_m2: float


class SeamLines:
    """Uses transitions of the edge sensors as measurements of the position along one axis.

    An edge is some tenths of a millimetre off the map, but all four sensors cross the same edge, so its offset is a
    state. Then the sensors *relative to each other* (heading, travel from front to rear) have the precision of the
    timing, and only their common part has that of the map.
    """

    def __init__(self, mirror: Mirror, robot: RobotConfig) -> None:
        self._mirror = mirror
        self._sensors = robot.edge_sensors_m
        self._half = mirror.grid.half_x_m, mirror.grid.half_y_m
        self._reach_m = _REACH * 2.0 * min(self._half)
        self._edges: dict[int, tuple[str, float, PanelId]] = {}

    def forget(self) -> None:
        """Drop the edges after a relocation, because their offsets belong to the old pose."""
        self._edges.clear()

    def edge_of(self, transition: SensorTransition, t_s: float, x: FloatArray, slope: Slope) -> Edge | None:
        """The edge of a transition, by the state x (n,) at ``t_s``; None if no seam is near."""
        sensor = self._sensor(transition, t_s, x, slope)
        seam = self._mirror.nearest_seam(*sensor.place_m)
        if seam is None or abs(seam.distance_m) > self._reach_m:
            return None
        k = 0 if seam.axis == "x" else 1
        speed = sensor.velocity_m_s[k]
        # The edge on the high or low side of the seam's centre line, and its panel.
        is_high = (speed > 0.0) is transition.is_on
        inside = list(sensor.place_m)
        inside[k] = seam.position_m + (self._half[k] if is_high else -self._half[k])
        panel = self._mirror.panels[self._mirror.nearest_panel(*inside)]
        centre_m = (panel.x_m, panel.y_m)[k]
        edge_m = centre_m - self._half[k] if is_high else centre_m + self._half[k]
        state = E1 if transition.is_on else E0
        edge = (seam.axis, edge_m, panel.id)
        is_new = self._edges.get(state) != edge
        self._edges[state] = edge
        return Edge(k, edge_m, state, is_new)

    def line(
        self, edge: Edge, transition: SensorTransition, t_s: float, x: FloatArray, slope: Slope
    ) -> EdgeMeasurement:
        """Measurement by a transition over ``edge``: ``sensor - edge - offset = 0`` along one axis."""
        sensor = self._sensor(transition, t_s, x, slope, edge.k)
        late_s = t_s - transition.t_s
        v = float(x[V]) - float(x[A]) * late_s
        H = np.zeros((1, STATES))
        row = H[0]
        row[X + edge.k] = 1.0
        row[PSI] = sensor.lever_m - v * late_s * sensor.left
        row[V] = -late_s * sensor.forward
        row[A] = late_s * late_s * sensor.forward
        row[W] = -late_s * row[PSI]
        row[edge.offset] = -1.0
        variance = (sensor.velocity_m_s[edge.k] * transition.interval_s) ** 2 * _UNIFORM + _TIMING_FLOOR_M2
        return EdgeMeasurement(edge.position_m + float(x[edge.offset]) - sensor.place_m[edge.k], H, variance)

    def _sensor(
        self, transition: SensorTransition, t_s: float, x: FloatArray, slope: Slope, k: int = 0
    ) -> SensorAtEdge:
        late_s = t_s - transition.t_s
        ox, oy = self._sensors[transition.corner]
        x_m, y_m, psi, v, a, w = x[:6].tolist()
        v -= a * late_s
        hx, hy, lx, ly = axes_on(slope, psi - w * late_s)
        # A point of the body moves with v h plus w times its offset turned by 90 deg.
        turn_x, turn_y = ox * lx - oy * hx, ox * ly - oy * hy
        place = x_m - v * late_s * hx + ox * hx + oy * lx, y_m - v * late_s * hy + ox * hy + oy * ly
        velocity = v * hx + w * turn_x, v * hy + w * turn_y
        return SensorAtEdge(place, velocity, *((hx, lx, turn_x) if k == 0 else (hy, ly, turn_y)))
