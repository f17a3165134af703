"""Assembles the parts of a main loop from a configuration and a checkpoint."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

import msgspec
from msgspec.structs import replace

from ccatp.config.models import FOUR_STATE, Config, LimitsConfig
from ccatp.control.gate import DriveGate
from ccatp.control.grip_model import GripForecast, GripModel
from ccatp.control.thrust import ThrustControl
from ccatp.core import DeckPose, PointId
from ccatp.errors import ConfigError
from ccatp.estimation.full_state import FullStateLocalizer
from ccatp.estimation.state_model import CT
from ccatp.links.robot_messages import Hello
from ccatp.localizer import Localizer, build_localizer, build_with_uncertainty
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.rest import ALMOST_AT_REST_M_S, ALMOST_AT_REST_RAD_S
from ccatp.survey.events import HELD, IDLE, MEASURING, SETTLING, Mode, TakenOver
from ccatp.survey.fix_gate import FixGate
from ccatp.survey.fix_review import FixReview
from ccatp.survey.laser_follow import LaserFollow
from ccatp.survey.planning.route import ORDERS, Route, RoutePlanner, plan_survey
from ccatp.survey.planning.search import path_time
from ccatp.survey.state import SurveyState
from ccatp.survey.statechart import Mission, Survey

# Largest difference between the configuration (calibrated) and the robot's own values (nominal).
RADIUS_TOLERANCE = 0.05
SENSOR_TOLERANCE_M = 0.005

# Modes in which the robot is commanded to stand.
_STANDING = (IDLE, SETTLING, MEASURING, HELD, Mode.DONE)
# Standard deviations for a robot that stood: it may have crept, or somebody may have touched it.
_STOOD_M, _STOOD_RAD = 0.005, 0.01
# Unobserved motion: the checkpoint is up to 0.1 s old, the last command lasts for 0.25 s, the wheels run down in 0.1 s.
_UNSEEN_S = 0.45
# After the checkpoint the robot may have accelerated for this time.
_BEGUN_S = 0.1
_NO_ROUTE = Route((), (0.0,))


class Checkpoint(msgspec.Struct, frozen=True, array_like=True, tag=5, forbid_unknown_fields=True):
    """What a main loop saves for the next one: the state of the survey and the pose of the robot.

    Route and measured points are left out: the next loop plans the route again and reads the points from the mission's
    database. The tag is the number of the format.
    """

    boot: int
    seq: int
    t_s: float
    elapsed_s: float
    pose: DeckPose
    sigma_m: float
    heading_sigma_rad: float
    speed_m_s: float
    rate_rad_s: float
    state: SurveyState
    run_id: str = ""  # empty in a checkpoint of an older version

    @classmethod
    def of(
        cls,
        localizer: Localizer,
        state: SurveyState,
        seq: int,
        t_s: float,
        elapsed_s: float,
        boot: int = -1,
        run_id: str = "",
    ) -> "Checkpoint":
        """The checkpoint of frame ``seq``. ``boot``: boot number of the robot, whose clock starts at each boot."""
        return cls(
            boot,
            seq,
            t_s,
            elapsed_s,
            localizer.deck_pose,
            localizer.position_sigma_m,
            localizer.heading_sigma_rad,
            localizer.speed_m_s,
            localizer.rate_rad_s,
            replace(state, route=_NO_ROUTE, points=replace(state.points, done=())),
            run_id,
        )

    def sigmas(self, limits: LimitsConfig) -> tuple[float, float]:
        """Standard deviations of position (m) and heading (rad) after a time without observation."""
        v, omega = abs(self.speed_m_s), abs(self.rate_rad_s)
        way_m = turn_rad = 0.0
        if self.state.mode not in _STANDING or v >= ALMOST_AT_REST_M_S or omega >= ALMOST_AT_REST_RAD_S:
            way_m = _UNSEEN_S * (v + _BEGUN_S * limits.a_max_m_s2)
            turn_rad = _UNSEEN_S * (omega + _BEGUN_S * limits.alpha_max_rad_s2)
        return hypot(self.sigma_m, way_m, _STOOD_M), hypot(self.heading_sigma_rad, turn_rad, _STOOD_RAD)


@dataclass(frozen=True, slots=True)
class SurveyParts:
    """The pure parts of a main loop, and the values of the plan for the summary.

    ``start``: pose and its standard deviations (m, rad) from the checkpoint of an earlier loop; ``None``: at base.
    """

    cfg: Config
    mirror: Mirror
    localizer: Localizer
    mission: Mission
    gate: DriveGate
    fix_review: FixReview
    thrust: ThrustControl
    route: Route
    points: tuple[PointId, ...]
    lower_bound_s: float
    start: tuple[DeckPose, tuple[float, float]] | None = None

    def heading_sigma_rad(self) -> float:
        """Standard deviation of the heading; 0 for the four-state localizer, whose heading a fix does not correct."""
        return 0.0 if self.cfg.run.filter in FOUR_STATE else self.localizer.heading_sigma_rad

    def measure_grip(self) -> bool:
        """Measure the grip after a fix, from the creep of the turn before; returns whether there is a new value.

        The four-state localizer does not estimate creep.
        """
        localizer = self.localizer
        if not isinstance(localizer, FullStateLocalizer):
            return False
        return self.thrust.measure_grip(localizer.counts["fixes"], localizer.deck_pose, self.turn_creep_m_rad())

    def turn_creep_m_rad(self) -> float:
        """Downhill creep per radian of a turn, mean over all headings, m; 0 for the four-state localizer."""
        localizer = self.localizer
        return float(localizer.state[0][CT]) if isinstance(localizer, FullStateLocalizer) else 0.0

    @property
    def total_points(self) -> int:
        """Points of the mission, measured or not."""
        return len(self.points)

    def check_robot(self, hello: Hello) -> None:
        """Raises ``ConfigError`` if the robot's own geometry contradicts the configuration."""
        if problems := robot_problems(self.cfg, self.mirror, hello):
            raise ConfigError(f"robot: the configuration is not of this robot: {'; '.join(problems)}")


def assemble(cfg: Config, done: Sequence[PointId] = (), checkpoint: Checkpoint | None = None) -> SurveyParts:
    """All pure parts; the robot is at base, or at the pose of ``checkpoint``.

    Raises ``PlanError``: unreachable point; ``ConfigError``: too little thrust.
    """
    mirror = build_mirror(cfg.mirror)
    grip = GripModel(cfg.robot).forecast(mirror)
    if not grip.is_held:
        raise ConfigError(f"robot.thrust_n: {grip.text}")
    cfg = slowed(cfg, grip)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    route = plan_survey(cfg, mirror, points, done, calibrates=checkpoint is None)
    survey = Survey(cfg, mirror, route, RoutePlanner(mirror, cfg))
    if checkpoint is None:
        start, localizer, mission = None, build_localizer(cfg, mirror), Mission(survey, survey.begin(done))
    else:
        start = checkpoint.pose, checkpoint.sigmas(cfg.limits)
        localizer, mission = build_with_uncertainty(cfg, mirror, *start), Mission(survey, checkpoint.state)
    return SurveyParts(
        cfg=cfg,
        mirror=mirror,
        localizer=localizer,
        mission=mission,
        gate=DriveGate(cfg.limits, cfg.robot, cfg.mission.verdict_timeout_s),
        fix_review=FixReview(FixGate(mirror, cfg), LaserFollow(cfg)),
        thrust=ThrustControl(cfg.robot, mirror),
        route=route,
        points=tuple(points),
        lower_bound_s=path_time(route.stops, mirror.base_pose, cfg.limits, mirror, cfg.etalon.measuring_time_s),
        start=start,
    )


def slowed(cfg: Config, grip: GripForecast) -> Config:
    """The configuration, with the limits of slow motion where there is little grip."""
    if not grip.is_short or not grip.is_held:
        return cfg
    limits, health = cfg.limits, cfg.health
    speed_m_s = min(limits.v_max_m_s, health.slow_speed_m_s, grip.safe_speed_m_s)
    slow = {"v_max_m_s": speed_m_s, "omega_max_rad_s": min(limits.omega_max_rad_s, health.slow_rate_rad_s)}
    return cfg.model_copy(update={"limits": limits.model_copy(update=slow)})


def take_over(cfg: Config, checkpoint: Checkpoint, event: TakenOver) -> SurveyParts:
    """The parts of a main loop that continues where another one ended. Raises as ``assemble``."""
    # The state knows the points that failed and those without time.
    failed = () if event.is_new_run else (*checkpoint.state.points.failed, *event.skipped)
    parts = assemble(cfg, (*event.measured, *failed), checkpoint)
    parts.mission.handle(event)
    return parts


def robot_problems(cfg: Config, mirror: Mirror, hello: Hello) -> list[str]:
    """The contradictions between the robot's own geometry and the configuration."""
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
