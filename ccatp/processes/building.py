"""Glue. Builds the pure parts of the main loop from a configuration."""

from collections.abc import Collection
from dataclasses import dataclass
from math import hypot

import numpy as np

from ccatp.config.models import Config
from ccatp.control.gate import DriveGate
from ccatp.errors import CcatpError, ConfigError, ExitStatus
from ccatp.filters import FILTERS
from ccatp.localization.measurements import STATES
from ccatp.localizer import Localizer
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.mission import Mission, PlanHome, PlanRest
from ccatp.planning.bound import path_time
from ccatp.planning.route import Route, plan_rejoin, plan_route
from ccatp.planning.traversal import ORDERS
from ccatp.planning.way_home import plan_way_home
from ccatp.processes.common import ProcessArgs
from ccatp.samples import DeckPose, PointId, Stop
from ccatp.store import MissionStore, PlannedPoint, StoreError
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
    total_points: int
    already_done: int
    lower_bound_s: float

    def check_robot(self, hello: Hello) -> None:
        """Refuse a robot whose own geometry contradicts the configuration."""
        robot, own = self.cfg.robot, hello.robot
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
        if self.mirror.overhang and own.fan_floor <= 0.0:
            problems.append("the mirror overhangs and the robot has no fan floor")
        if problems:
            raise ConfigError(f"robot: the configuration is not of this robot: {'; '.join(problems)}")


def build_parts(args: ProcessArgs) -> tuple[Parts, MissionStore]:
    """All parts of the main loop and the mission's database, new or resumed."""
    cfg = args.config
    mirror = build_mirror(cfg.mirror)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    try:
        store = _open_store(args, mirror, points)
    except StoreError as error:
        raise StoreUnusable(str(error)) from error
    done = store.measured_points()
    measuring_s = cfg.etalon.measuring_time_s
    route = plan_route(mirror, points, cfg.robot, cfg.limits, cfg.mission, mirror.base_pose, done, measuring_s)
    # The localizer re-initialises it at once; what counts is its size.
    filter_ = FILTERS[cfg.run.filter](np.zeros(STATES), np.eye(STATES))
    mission = Mission(cfg, mirror, route, _home_planner(cfg, mirror), _rest_planner(cfg, mirror))
    parts = Parts(
        cfg=cfg,
        mirror=mirror,
        localizer=Localizer(filter_, mirror, cfg.robot, cfg.localizer, mirror.base_panel_pose),
        mission=mission,
        gate=DriveGate(
            cfg.limits,
            cfg.robot.wheel_radius_m,
            cfg.robot.wheel_base_m,
            cfg.robot.max_wheel_rad_s,
            cfg.robot.wheel_lag_s,
        ),
        route=route,
        total_points=len(points),
        already_done=len(done),
        lower_bound_s=path_time(route.stops, mirror.base_pose, cfg.limits, mirror, cfg.etalon.measuring_time_s),
    )
    return parts, store


class StoreUnusable(CcatpError):
    """The mission's database cannot be made or read."""

    exit_status = ExitStatus.USAGE


def _open_store(args: ProcessArgs, mirror: Mirror, points: list[PointId]) -> MissionStore:
    path = args.run_dir / "mission.sqlite"
    if args.is_resuming:
        return MissionStore.open(path, mirror=mirror.name)
    cfg = args.config
    grid = cfg.mirror.panels
    planned = []
    for point in points:
        row, column = divmod(point.point - 1, len(grid.points_x_mm))
        planned.append(PlannedPoint(point, 1e-3 * grid.points_x_mm[column], 1e-3 * grid.points_y_mm[row]))
    text = (args.run_dir / "config.toml").read_text(encoding="utf-8")
    return MissionStore.create(path, mirror=mirror.name, seed=cfg.run.seed, config_toml=text, points=planned)


def _rest_planner(cfg: Config, mirror: Mirror) -> PlanRest:
    def plan(route: Route, start: DeckPose, skip: Collection[PointId]) -> Route:
        measuring_s = cfg.etalon.measuring_time_s
        return plan_rejoin(mirror, route, cfg.robot, cfg.limits, cfg.mission, start, skip, measuring_s)

    return plan


def _home_planner(cfg: Config, mirror: Mirror) -> PlanHome:
    def plan(start: DeckPose) -> tuple[Stop, ...]:
        return plan_way_home(mirror, start, mirror.base_pose, cfg.robot, cfg.limits, cfg.mission)

    return plan
