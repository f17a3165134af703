"""Pure. Assembles the parts of a main loop from a configuration, for the daemon and for rehearsals alike."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import hypot

from ccatp.config.models import Config
from ccatp.control.gate import DriveGate
from ccatp.errors import ConfigError
from ccatp.localizer import FOUR_STATE, Localizer, build_doubting, build_localizer
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.mission import Mission, PlanHome, PlanPoints, PlanRest
from ccatp.planning.bound import path_time
from ccatp.planning.calibration import plan_calibration
from ccatp.planning.route import Route, plan_rejoin, plan_route, with_prelude
from ccatp.planning.traversal import ORDERS
from ccatp.planning.way_home import plan_way_home
from ccatp.samples import DeckPose, PointId, Stop
from ccatp.surveying.recovery import Recovery
from ccatp.wire.robot import Hello

# The configuration may be calibrated, the robot's own figures are nominal: this much apart they describe two robots.
RADIUS_TOLERANCE = 0.05
SENSOR_TOLERANCE_M = 0.005


@dataclass(frozen=True, slots=True)
class Parts:
    """The pure parts of a main loop, and what a summary needs to know of the plan."""

    cfg: Config
    mirror: Mirror
    localizer: Localizer
    mission: Mission
    gate: DriveGate
    route: Route
    points: tuple[PointId, ...]
    already_done: int
    lower_bound_s: float
    elapsed_s: float = 0.0
    recovery: Recovery | None = None

    @property
    def total_points(self) -> int:
        """Points of the mission, measured or not."""
        return len(self.points)

    def check_robot(self, hello: Hello) -> None:
        """Refuse a robot whose own geometry contradicts the configuration."""
        problems = robot_problems(self.cfg, self.mirror, hello)
        if problems:
            raise ConfigError(f"robot: the configuration is not of this robot: {'; '.join(problems)}")


def assemble(cfg: Config, done: Collection[PointId] = (), recovery: Recovery | None = None) -> Parts:
    """All pure parts of a main loop, the robot standing at base or where another main loop left it.

    Args:
        cfg: the configuration.
        done: points that are measured already.
        recovery: what the other one left, if there was one.

    Raises:
        PlanError: a point cannot be reached.
    """
    mirror = build_mirror(cfg.mirror)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    route = plan_survey(cfg, mirror, points, done, calibrates=recovery is None)
    localizer = _build_localizer(cfg, mirror, recovery)
    # No drive shows the four states their heading: the fix does not reach it.
    heading_sigma_of = float if cfg.run.filter in FOUR_STATE else lambda: localizer.heading_sigma_rad
    planners = _home_planner(cfg, mirror), _rest_planner(cfg, mirror), _points_planner(cfg, mirror)
    mission = Mission(cfg, mirror, route, *planners, heading_sigma_of)
    if recovery is not None:
        mission.take_over(recovery)
    return Parts(
        cfg=cfg,
        mirror=mirror,
        localizer=localizer,
        mission=mission,
        gate=build_gate(cfg),
        route=route,
        points=tuple(points),
        already_done=len(set(done)),
        elapsed_s=0.0 if recovery is None else recovery.elapsed_s,
        recovery=recovery,
        lower_bound_s=path_time(route.stops, mirror.base_pose, cfg.limits, mirror, cfg.etalon.measuring_time_s),
    )


def plan_survey(
    cfg: Config,
    mirror: Mirror,
    points: Sequence[PointId],
    done: Collection[PointId] = (),
    out_of_reach: list[PointId] | None = None,
    *,
    calibrates: bool = True,
) -> Route:
    """The route of a survey from base, with the calibration drive before it.

    Args:
        cfg: the configuration.
        mirror: its mirror.
        points: in the order of measuring.
        done: points that are measured already.
        out_of_reach: takes the points that cannot be reached, and the route goes without them.
        calibrates: drive a calibration first, where the localizer has a use for it.

    Raises:
        PlanError: a point cannot be reached and there is no ``out_of_reach``, or base is not on the mirror.
    """
    limits, start, measuring_s = cfg.limits, mirror.base_pose, cfg.etalon.measuring_time_s
    route = plan_route(mirror, points, cfg.robot, limits, cfg.mission, start, done, measuring_s, out_of_reach)
    if not calibrates or cfg.run.filter in FOUR_STATE:  # they have no states that the drive could calibrate
        return route
    drive = plan_calibration(mirror, cfg.robot, cfg.mission, start)
    return with_prelude(mirror, route, drive, limits, start, measuring_s)


def build_gate(cfg: Config) -> DriveGate:
    """The last gate before the wheels."""
    robot = cfg.robot
    return DriveGate(
        cfg.limits,
        robot.wheel_radius_m,
        robot.wheel_base_m,
        robot.max_wheel_rad_s,
        robot.wheel_lag_s,
        cfg.mission.verdict_timeout_s,
        robot.sensors_timeout_s,
    )


def robot_problems(cfg: Config, mirror: Mirror, hello: Hello) -> list[str]:
    """In what the robot's own geometry contradicts the configuration; empty where it does not."""
    robot, own = cfg.robot, hello.robot
    problems = [
        f"{name} is {ours} here and {theirs} there"
        for name, ours, theirs in (
            ("wheel_radius_m", robot.wheel_radius_m, own.wheel_radius_m),
            ("wheel_base_m", robot.wheel_base_m, own.wheel_base_m),
        )
        if abs(ours - theirs) > RADIUS_TOLERANCE * theirs
    ]
    for ours, theirs in zip(robot.edge_sensors_m, own.edge_sensors_m, strict=True):
        if hypot(ours[0] - theirs[0], ours[1] - theirs[1]) > SENSOR_TOLERANCE_M:
            problems.append(f"an edge sensor is at {ours} here and at {tuple(theirs)} there")
    puck = own.puck_m
    if hypot(puck[0], puck[1], puck[2] - robot.puck_height_m) > SENSOR_TOLERANCE_M:
        problems.append(f"the puck is at (0, 0, {robot.puck_height_m}) here and at {tuple(puck)} there")
    if mirror.overhang and own.fan_floor <= 0.0:
        problems.append("the mirror overhangs and the robot has no fan floor")
    return problems


def _build_localizer(cfg: Config, mirror: Mirror, recovery: Recovery | None) -> Localizer:
    if recovery is None:
        return build_localizer(cfg, mirror)
    return build_doubting(cfg, mirror, recovery.pose, (recovery.position_sigma_m, recovery.heading_sigma_rad))


def _rest_planner(cfg: Config, mirror: Mirror) -> PlanRest:
    def plan(route: Route, start: DeckPose, skip: Collection[PointId]) -> Route:
        measuring_s = cfg.etalon.measuring_time_s
        return plan_rejoin(mirror, route, cfg.robot, cfg.limits, cfg.mission, start, skip, measuring_s)

    return plan


def _points_planner(cfg: Config, mirror: Mirror) -> PlanPoints:
    def plan(start: DeckPose, points: Sequence[PointId]) -> Route:
        measuring_s = cfg.etalon.measuring_time_s
        return plan_route(mirror, points, cfg.robot, cfg.limits, cfg.mission, start, (), measuring_s)

    return plan


def _home_planner(cfg: Config, mirror: Mirror) -> PlanHome:
    def plan(start: DeckPose) -> tuple[Stop, ...]:
        return plan_way_home(mirror, start, mirror.base_pose, cfg.robot, cfg.limits, cfg.mission)

    return plan
