"""Local motion planning of a robot among beacons: visit waypoints, follow a target, avoid obstacles, back off."""

from collections import deque
from collections.abc import Iterator, Sequence
from enum import StrEnum
from math import asin, cos, dist, hypot, inf, pi, sin, tau
from typing import NamedTuple

from ccatp.beacons.config.models import AvoidanceConfig, FollowConfig, RadioConfig
from ccatp.beacons.steering import (
    HALT,
    BearingToPoint,
    PlanarPose,
    Point,
    SteeringCommand,
    WaypointList,
    WaypointSteering,
    aim_at,
)
from ccatp.kinematics import bearing, wrap_pi

_NEAREST_M = 0.02  # lower limit of a distance, below which the direction is meaningless


class FollowState(StrEnum):
    """State of a follower."""

    LOST = "lost"  # target not received for too long, or never: stops
    APPROACHING = "approaching"
    HOLDING = "holding"  # within the band round the safe distance: stops
    BACKING = "backing"  # too near: moves back


class TargetSight(NamedTuple):
    """The estimate of the target."""

    position_m: Point
    sigma_m: float
    age_s: float
    velocity_m_s: Point = (0.0, 0.0)


class Follower:
    """Keeps a safe distance from a moving point.

    The minimum distance grows with the uncertainty of the target along the line of sight, and with the distance by
    which the target will come nearer within ``foresight_s``. If the target is nearer than the minimum, the robot moves
    back until it is one band beyond the minimum. If it is farther than two bands beyond, the robot approaches to one
    band beyond. In between it stops, so that noise does not switch the state.
    """

    def __init__(self, cfg: FollowConfig, driver: WaypointSteering) -> None:
        self._cfg = cfg
        self._driver = driver
        self.state = FollowState.LOST
        self._sight: BearingToPoint | None = None

    def aim(self, pose: PlanarPose, target: TargetSight | None) -> BearingToPoint | None:
        """Update the state; return the remaining distance and heading error, None if there is nothing to approach."""
        self._sight = None
        if target is None or target.age_s > self._cfg.lost_after_s:
            self.state = FollowState.LOST
            return None
        self._sight = aim_at(pose, target.position_m)
        cfg = self._cfg
        dx_m, dy_m = pose[0] - target.position_m[0], pose[1] - target.position_m[1]
        vx, vy = target.velocity_m_s  # only its part towards the robot counts
        closing_m = cfg.foresight_s * max(0.0, (vx * dx_m + vy * dy_m) / max(hypot(dx_m, dy_m), _NEAREST_M))
        # At most the safe distance again: a robot that stays too far away never improves its estimate of the target.
        margin_m = min(cfg.margin_sigmas * target.sigma_m, cfg.safe_distance_m)
        left_m = self._sight.distance_m - cfg.safe_distance_m - margin_m - closing_m
        self.state = self._next_state(left_m)
        if self.state is not FollowState.APPROACHING:
            return None
        return BearingToPoint(max(left_m - cfg.band_m, 0.0), self._sight.error_rad)

    def stay(self) -> SteeringCommand:
        """Set points when there is nothing to approach: back off, turn to the target, or stop."""
        self._driver.reset()
        if self._sight is None:
            return HALT
        if self.state is FollowState.BACKING:
            return self._driver.away(self._cfg.back_speed_m_s, self._sight.error_rad)
        return self._driver.face(self._sight.error_rad)

    def _next_state(self, left_m: float) -> FollowState:
        band_m = self._cfg.band_m
        if left_m > 2.0 * band_m or (left_m > band_m and self.state is FollowState.APPROACHING):
            return FollowState.APPROACHING
        if left_m < 0.0 or (left_m < band_m and self.state is FollowState.BACKING):
            return FollowState.BACKING
        return FollowState.HOLDING


_AHEAD_RAD = pi / 3.0  # obstacles within this angle of the course are in the way of the body


class _Obstacle(NamedTuple):
    time_s: float
    x_m: float
    y_m: float


class ObstacleAvoider:
    """Chooses the free heading nearest to the goal, after the vector field histogram of Borenstein and Koren (1991).

    Echoes are stored as points in the room for a while, because a few sensors miss obstacles between their beams. A
    point at distance d blocks the headings within asin((radius + margin) / d) of its direction. The chosen free heading
    minimises its angle to the goal plus a tenth of its angle to straight ahead, so that it does not change sides.
    """

    def __init__(self, cfg: AvoidanceConfig, radius_m: float) -> None:
        self._cfg = cfg
        self._reach_m = radius_m + cfg.margin_m
        self._echoes: deque[_Obstacle] = deque()

    def see(self, time_s: float, pose: PlanarPose, distances_m: Sequence[float]) -> None:
        """Store the obstacles that the sensors detect, and drop old ones."""
        while self._echoes and time_s - self._echoes[0].time_s > self._cfg.memory_s:
            self._echoes.popleft()
        for direction_rad, distance_m in zip(self._cfg.sensors_rad, distances_m, strict=True):
            if distance_m < min(self._cfg.range_max_m, 2.0 * self._cfg.influence_m):
                course_rad = pose[2] + direction_rad
                self._echoes.append(
                    _Obstacle(time_s, pose[0] + distance_m * cos(course_rad), pose[1] + distance_m * sin(course_rad))
                )

    def way(self, pose: PlanarPose, aim: BearingToPoint) -> tuple[BearingToPoint, float]:
        """The goal with a free heading, and a factor of the speed: 1 far from obstacles, 0 if the robot must stop."""
        # Obstacles behind the goal are not in the way to it.
        near = [echo for echo in self._near(pose) if echo[0] - self._reach_m < aim.distance_m]
        blocked = [(wrap_pi(angle_rad), asin(min(1.0, self._reach_m / max(d, 1e-6)))) for d, angle_rad in near]
        error_rad = self._free_heading(aim.error_rad, blocked)
        if error_rad is None:
            return aim, 0.0
        return BearingToPoint(aim.distance_m, error_rad), self._speed_factor(near)

    def clear_m(self, pose: PlanarPose, direction_rad: float) -> float:
        """Distance to the nearest stored obstacle in the direction of motion, m.

        ``direction_rad``: left of the heading: 0 forwards, pi backwards.
        """
        in_way = (d for d, angle_rad in self._near(pose) if abs(wrap_pi(angle_rad - direction_rad)) < _AHEAD_RAD)
        return min(in_way, default=inf)

    def points_m(self) -> list[Point]:
        """Stored obstacles, in the frame of the room."""
        return [(echo.x_m, echo.y_m) for echo in self._echoes]

    def _near(self, pose: PlanarPose) -> Iterator[tuple[float, float]]:
        for echo in self._echoes:
            dx_m, dy_m = echo.x_m - pose[0], echo.y_m - pose[1]
            distance_m = hypot(dx_m, dy_m)
            if distance_m < self._cfg.influence_m:
                yield distance_m, bearing(dx_m, dy_m) - pose[2]

    def _free_heading(self, wanted_rad: float, blocked: Sequence[tuple[float, float]]) -> float | None:
        def is_free(heading_rad: float) -> bool:
            return all(abs(wrap_pi(heading_rad - at_rad)) >= half_rad for at_rad, half_rad in blocked)

        if is_free(wanted_rad):
            return wanted_rad
        headings = (wrap_pi(k * tau / self._cfg.directions) for k in range(self._cfg.directions))
        nearest_first = sorted(headings, key=lambda h: abs(wrap_pi(h - wanted_rad)) + 0.1 * abs(h))
        return next(filter(is_free, nearest_first), None)

    def _speed_factor(self, near: Sequence[tuple[float, float]]) -> float:
        cfg = self._cfg
        ahead_m = min((d for d, angle_rad in near if abs(wrap_pi(angle_rad)) < _AHEAD_RAD), default=cfg.influence_m)
        return max(0.0, min(1.0, (ahead_m - cfg.stop_m) / (cfg.influence_m - cfg.stop_m)))


_STEPS = 6  # points of an arc at which distances are checked
_CURVES = (0.0, -0.3, 0.3, -0.6, 0.6, -1.0, 1.0)  # fractions of the largest steering angle
_COURSES = 24  # of a vehicle that turns on the spot
_TURN_S = 1.0  # it turns at the remaining angle over this time,
_STRAIGHT_RAD = 0.3  # and drives if the remaining angle is smaller
_KEEPING = 0.03  # bonus, m, for an arc in the same direction, forwards or backwards, as the last one


class BackOff:
    """A dynamic window over arcs forwards and backwards (Fox, Burgard, Thrun 1997).

    A vehicle that turns on the spot uses straight courses instead, each after a turn. A candidate is valid if the
    vehicle stays in the room and keeps ``avoidance.stop_m`` from all detected obstacles, or, if it is already nearer,
    does not come nearer. It takes the valid candidate that ends farthest from the threat, which is assumed to keep its
    velocity. If none increases the distance, it stops.
    """

    def __init__(self, cfg: RadioConfig) -> None:
        self._cfg = cfg
        self._last = 0.0

    def drive(
        self, pose: PlanarPose, threat_m: Point, threat_velocity_m_s: Point, obstacles_m: Sequence[Point]
    ) -> SteeringCommand:
        """Set points for the next interval."""
        horizon_s = self._cfg.follow.retreat_s
        vx, vy = threat_velocity_m_s
        threat_then_m = threat_m[0] + vx * horizon_s, threat_m[1] + vy * horizon_s
        best, gain_m = HALT, dist(pose[:2], threat_then_m)
        for drive, places in self._arcs(pose, horizon_s):
            if not self._is_free(pose[:2], places, obstacles_m):
                continue
            far_m = dist(places[-1], threat_then_m)
            if drive.speed_m_s * self._last > 0.0:
                far_m += _KEEPING
            if far_m > gain_m:
                best, gain_m = drive, far_m
        self._last = best.speed_m_s
        return best

    def _arcs(self, pose: PlanarPose, horizon_s: float) -> Iterator[tuple[SteeringCommand, list[Point]]]:
        speed_m_s = min(self._cfg.follow.back_speed_m_s, self._cfg.vehicle.speed_max_m_s)
        if self._cfg.vehicle.kind == "ackermann":
            for signed_m_s in (-speed_m_s, speed_m_s):
                for curve in _CURVES:
                    drive = SteeringCommand(signed_m_s, curve * self._cfg.vehicle.steer_max_rad, 0.0)
                    yield drive, self._places(pose, drive, horizon_s)
            return
        for k in range(_COURSES):
            yield self._straight(pose, wrap_pi(pi + k * tau / _COURSES), speed_m_s, horizon_s)

    def _places(self, pose: PlanarPose, drive: SteeringCommand, horizon_s: float) -> list[Point]:
        x_m, y_m, heading_rad = pose
        interval_s = horizon_s / _STEPS
        turn_rad = interval_s * drive.speed_m_s * sin(drive.steer_rad) / self._cfg.vehicle.wheelbase_m
        places = []
        for _ in range(_STEPS):
            course_rad = heading_rad + 0.5 * turn_rad + drive.steer_rad
            x_m += interval_s * drive.speed_m_s * cos(course_rad)
            y_m += interval_s * drive.speed_m_s * sin(course_rad)
            heading_rad += turn_rad
            places.append((x_m, y_m))
        return places

    def _straight(
        self, pose: PlanarPose, course_rad: float, speed_m_s: float, horizon_s: float
    ) -> tuple[SteeringCommand, list[Point]]:
        is_back = abs(course_rad) > pi / 2.0
        error_rad = wrap_pi(course_rad - pi) if is_back else course_rad
        most_rad_s = self._cfg.vehicle.turn_rate_max_rad_s
        delay_s = abs(error_rad) / most_rad_s
        rate_rad_s = max(-most_rad_s, min(most_rad_s, error_rad / _TURN_S))
        goes = abs(error_rad) < _STRAIGHT_RAD
        along_rad = pose[2] + course_rad
        times_s = [horizon_s * (k + 1) / _STEPS for k in range(_STEPS)]
        ways_m = [speed_m_s * max(0.0, t_s - delay_s) for t_s in times_s]
        places = [(pose[0] + way_m * cos(along_rad), pose[1] + way_m * sin(along_rad)) for way_m in ways_m]
        return SteeringCommand((-speed_m_s if is_back else speed_m_s) * goes, 0.0, rate_rad_s), places

    def _is_free(self, start_m: Point, places: Sequence[Point], obstacles_m: Sequence[Point]) -> bool:
        margin_m = self._cfg.avoidance.stop_m
        nearest_m = min((dist(start_m, obstacle) for obstacle in obstacles_m), default=inf)
        for place in places:
            if any(dist(place, obstacle) < min(margin_m, nearest_m) for obstacle in obstacles_m):
                return False
        size = self._cfg.workspace.size_m
        return all(min(0.0, start_m[k]) <= places[-1][k] <= max(size[k], start_m[k]) for k in range(2))


class PilotState(StrEnum):
    """State of the pilot."""

    VISITING = "visiting"  # on the way to a waypoint
    ARRIVED = "arrived"  # all waypoints reached: stops
    FOLLOWING = "following"  # see ``FollowState``
    AVOIDING = "avoiding"  # on a detour round an obstacle
    ESCAPING = "escaping"  # moves back from an obstacle too near ahead


class BeaconPilot:
    """Computes set points from a pose, a target and the distance sensors.

    ``home_m``: the only goal, instead of the configured ones. Raises FuzzyGapError: the rules leave a gap.
    """

    def __init__(self, cfg: RadioConfig, home_m: Point | None = None) -> None:
        self._cfg, self._is_following = cfg, cfg.follow.is_active and home_m is None
        self._driver = WaypointSteering(cfg.control, cfg.vehicle)
        self._avoider = ObstacleAvoider(cfg.avoidance, cfg.vehicle.radius_m)
        self._escapes_until_s = 0.0
        waypoints_m = cfg.workspace.waypoints_m if home_m is None else (home_m,)
        loops = cfg.workspace.loops and home_m is None
        self.waypoints = WaypointList(waypoints_m, cfg.control.arrival_radius_m, loops=loops)
        self.follower = Follower(cfg.follow, self._driver)
        self._retreat = BackOff(cfg)
        self.state = PilotState.VISITING

    def drive(
        self, time_s: float, interval_s: float, pose: PlanarPose, target: TargetSight | None,
        distances_m: Sequence[float],
    ) -> SteeringCommand:  # fmt: skip
        """Set points for the next interval."""
        aim = self._aim(pose, target)
        if not self._cfg.avoidance.is_active:
            return self._without_obstacles(aim, interval_s)
        self._avoider.see(time_s, pose, distances_m)
        if target is not None and self._is_following and self.follower.state is FollowState.BACKING:
            self._driver.reset()
            return self._retreat.drive(pose, target.position_m, target.velocity_m_s, self._avoider.points_m())
        if time_s < self._escapes_until_s:
            return self._held(pose, self._escape())
        if aim is None:
            return self._held(pose, self._without_obstacles(aim, interval_s))
        free, speed_factor = self._avoider.way(pose, aim)
        if speed_factor <= 0.0:
            self._escapes_until_s = time_s + self._cfg.avoidance.back_time_s
            return self._held(pose, self._escape())
        if free.error_rad != aim.error_rad:
            self.state = PilotState.AVOIDING
        found = self._driver.drive(free, interval_s)
        return found._replace(speed_m_s=found.speed_m_s * speed_factor)

    def _aim(self, pose: PlanarPose, target: TargetSight | None) -> BearingToPoint | None:
        if self._is_following:
            self.state = PilotState.FOLLOWING
            return self.follower.aim(pose, target)
        reached = self.waypoints.reached
        goal_m = self.waypoints.visit(pose)
        if self.waypoints.reached != reached:
            self._driver.reset()
        self.state = PilotState.ARRIVED if goal_m is None else PilotState.VISITING
        return None if goal_m is None else aim_at(pose, goal_m)

    def _without_obstacles(self, aim: BearingToPoint | None, interval_s: float) -> SteeringCommand:
        if aim is not None:
            return self._driver.drive(aim, interval_s)
        return self.follower.stay() if self._is_following else HALT

    def _held(self, pose: PlanarPose, drive: SteeringCommand) -> SteeringCommand:
        if not drive.speed_m_s:
            return drive
        clear_m = self._avoider.clear_m(pose, 0.0 if drive.speed_m_s > 0.0 else pi)
        return drive._replace(speed_m_s=0.0) if clear_m < self._cfg.avoidance.stop_m else drive

    def _escape(self) -> SteeringCommand:
        self.state = PilotState.ESCAPING
        self._driver.reset()
        return self._driver.away(self._cfg.avoidance.back_speed_m_s, 0.0)
