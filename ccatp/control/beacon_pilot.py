"""Pure. Who decides where a robot among beacons drives next: waypoints or the target, round the obstacles."""

from collections.abc import Sequence
from enum import StrEnum
from math import pi

from ccatp.config.radio_models import RadioConfig
from ccatp.control.avoidance import ObstacleAvoider, Way
from ccatp.control.following import Follower, FollowState, TargetSight
from ccatp.control.retreat import Retreat
from ccatp.control.waypoint_steering import HALT, Aim, Drive, Driver, PlanarPose, WaypointList, aim_at


class PilotState(StrEnum):
    """What the pilot is doing."""

    VISITING = "visiting"  # on the way to a waypoint
    ARRIVED = "arrived"  # all waypoints reached: stands
    FOLLOWING = "following"  # see ``FollowState``
    AVOIDING = "avoiding"  # off its course to get round something
    ESCAPING = "escaping"  # backs off from what stands too near ahead


class BeaconPilot:
    """Turns a pose, a target and the distance sensors into set points, step by step.

    Attributes:
        state: what it is doing.
        waypoints: how far the loop of waypoints is.
        follower: what it does about the target, where one is followed.

    Args:
        cfg: workspace, vehicle, control, follow and avoidance are used.

    Raises:
        FuzzyGapError: the rules leave a gap.
    """

    def __init__(self, cfg: RadioConfig) -> None:
        self._cfg = cfg
        self._driver = Driver(cfg.control, cfg.vehicle)
        self._avoider = ObstacleAvoider(cfg.avoidance, cfg.vehicle.radius_m)
        self._escapes_until_s = 0.0
        self.waypoints = WaypointList(
            cfg.workspace.waypoints_m, cfg.control.arrival_radius_m, loops=cfg.workspace.loops
        )
        self.follower = Follower(cfg.follow, self._driver)
        self._retreat = Retreat(cfg)
        self.state = PilotState.VISITING

    def drive(
        self,
        time_s: float,
        interval_s: float,
        pose: PlanarPose,
        target: TargetSight | None,
        distances_m: Sequence[float],
    ) -> Drive:
        """Set points for the next interval.

        Args:
            time_s: now.
            interval_s: the interval.
            pose: x m, y m, heading rad.
            target: what is believed of the target; None without one.
            distances_m: of the distance sensors.
        """
        aim = self._aim(pose, target)
        if not self._cfg.avoidance.is_active:
            return self._without_obstacles(aim, interval_s)
        self._avoider.see(time_s, pose, distances_m)
        if target is not None and self._cfg.follow.is_active and self.follower.state is FollowState.BACKING:
            self._driver.reset()
            return self._retreat.drive(pose, target.position_m, target.velocity_m_s, self._avoider.points_m())
        if time_s < self._escapes_until_s:
            return self._held(pose, self._escape())
        if aim is None:
            return self._held(pose, self._without_obstacles(aim, interval_s))
        way = self._avoider.way(pose, aim)
        if way.is_blocked or way.speed_factor <= 0.0:
            self._escapes_until_s = time_s + self._cfg.avoidance.back_time_s
            return self._held(pose, self._escape())
        return self._round(aim, way, interval_s)

    def _aim(self, pose: PlanarPose, target: TargetSight | None) -> Aim | None:
        if self._cfg.follow.is_active:
            self.state = PilotState.FOLLOWING
            return self.follower.aim(pose, target)
        reached = self.waypoints.reached
        goal_m = self.waypoints.visit(pose)
        if self.waypoints.reached != reached:
            self._driver.reset()
        self.state = PilotState.ARRIVED if goal_m is None else PilotState.VISITING
        return None if goal_m is None else aim_at(pose, goal_m)

    def _without_obstacles(self, aim: Aim | None, interval_s: float) -> Drive:
        if aim is not None:
            return self._driver.drive(aim, interval_s)
        return self.follower.stay() if self._cfg.follow.is_active else HALT

    def _round(self, aim: Aim, way: Way, interval_s: float) -> Drive:
        if way.aim.error_rad != aim.error_rad:
            self.state = PilotState.AVOIDING
        found = self._driver.drive(way.aim, interval_s)
        return found._replace(speed_m_s=found.speed_m_s * way.speed_factor)

    def _held(self, pose: PlanarPose, drive: Drive) -> Drive:
        """No motion towards something that stands too near in its direction."""
        if not drive.speed_m_s:
            return drive
        clear_m = self._avoider.clear_m(pose, 0.0 if drive.speed_m_s > 0.0 else pi)
        return drive._replace(speed_m_s=0.0) if clear_m < self._cfg.avoidance.stop_m else drive

    def _escape(self) -> Drive:
        self.state = PilotState.ESCAPING
        self._driver.reset()
        return self._driver.away(self._cfg.avoidance.back_speed_m_s, 0.0)
