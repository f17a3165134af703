"""Assembles the parts of a main loop from a configuration and a checkpoint; the plan of a survey as text and data."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, groupby
from math import hypot
from typing import Any

import msgspec
from msgspec.structs import replace

from ccatp.config.models import FOUR_STATE, Config, LimitsConfig
from ccatp.control.gate import DriveGate
from ccatp.control.grip_model import GripForecast, GripModel
from ccatp.control.thrust import ThrustControl
from ccatp.core import DeckPose, PointId, Stop, StopKind
from ccatp.errors import ConfigError
from ccatp.estimation.full_state import FullStateLocalizer
from ccatp.estimation.state_model import CT
from ccatp.links.robot_messages import Hello
from ccatp.localizer import Localizer, build_localizer, build_with_uncertainty
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.rest import ALMOST_AT_REST_M_S, ALMOST_AT_REST_RAD_S
from ccatp.survey.events import HELD, IDLE, MEASURING, SETTLING, Mode, TakenOver
from ccatp.survey.planning.route import ORDERS, Route, RoutePlanner
from ccatp.survey.planning.search import leg_lengths, leg_time, path_time, stop_times
from ccatp.survey.planning.tour_bound import tour_bound
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


class Checkpoint(msgspec.Struct, frozen=True, array_like=True, tag=4, forbid_unknown_fields=True):
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
            replace(state, route=_NO_ROUTE, done=()),
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
    cfg = _slowed(cfg, grip)
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
        thrust=ThrustControl(cfg.robot, mirror),
        route=route,
        points=tuple(points),
        lower_bound_s=path_time(route.stops, mirror.base_pose, cfg.limits, mirror, cfg.etalon.measuring_time_s),
        start=start,
    )


def _slowed(cfg: Config, grip: GripForecast) -> Config:
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
    failed = () if event.is_new_run else (*checkpoint.state.failure_causes, *event.skipped)
    parts = assemble(cfg, (*event.measured, *failed), checkpoint)
    parts.mission.handle(event)
    return parts


def plan_survey(
    cfg: Config,
    mirror: Mirror,
    points: Sequence[PointId],
    done: Collection[PointId] = (),
    out_of_reach: list[PointId] | None = None,
    *,
    calibrates: bool = True,
) -> Route:
    """The route of a survey from base, with the calibration drive first if the localizer uses one.

    Points that cannot be reached are added to ``out_of_reach``; without this list they raise ``PlanError``, as does a
    base that is not on the mirror.
    """
    planner = RoutePlanner(mirror, cfg)
    route = planner.route(mirror.base_pose, points, done, out_of_reach)
    # The four-state localizer has no parameters to calibrate.
    return planner.with_calibration(route) if calibrates and cfg.run.filter not in FOUR_STATE else route


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


_SHOWN = 10


@dataclass(frozen=True, slots=True)
class SurveyPlan:
    """The plan of a survey: points in the order of measuring, with those out of reach, and stops.

    ``times_s``: arrival at each stop, from the start. Driving, turning and measuring are least times, rest to rest;
    their sum is the lower bound of the survey's time.
    """

    points: tuple[PointId, ...]
    out_of_reach: tuple[PointId, ...]
    stops: tuple[Stop, ...]
    times_s: tuple[float, ...]
    length_m: float
    driving_s: float
    turning_s: float
    measuring_s: float
    any_order_s: float
    grip: GripForecast

    @property
    def least_s(self) -> float:
        """Lower bound of the survey's time along this route."""
        return self.driving_s + self.turning_s + self.measuring_s


def make_plan(cfg: Config, mirror: Mirror) -> SurveyPlan:
    """Plan a survey as a run would; raises ``PlanError`` if base is not on the mirror or is a dead end."""
    grip = GripModel(cfg.robot).forecast(mirror)
    cfg = _slowed(cfg, grip)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    out_of_reach: list[PointId] = []
    stops = plan_survey(cfg, mirror, points, (), out_of_reach).stops
    lengths_m, times_s = (
        leg_lengths(stops, mirror.base_pose, mirror),
        stop_times(stops, mirror.base_pose, cfg.limits, mirror),
    )
    driving_s = sum(leg_time(length, cfg.limits) for length in lengths_m)
    rests_s = [cfg.etalon.measuring_time_s * stop.is_measured for stop in stops]
    begins_s = accumulate((time_s + rest_s for time_s, rest_s in zip(times_s, rests_s, strict=True)), initial=0.0)
    reached = [point for point in points if point not in set(out_of_reach)]
    return SurveyPlan(
        points=tuple(points),
        out_of_reach=tuple(out_of_reach),
        stops=stops,
        times_s=tuple(begin_s + time_s for begin_s, time_s in zip(begins_s, times_s, strict=False)),
        length_m=sum(lengths_m),
        driving_s=driving_s,
        turning_s=sum(times_s) - driving_s,
        measuring_s=sum(rests_s),
        any_order_s=tour_bound(mirror, reached, cfg.limits, cfg.etalon.measuring_time_s),
        grip=grip,
    )


def plan_data(cfg: Config, plan: SurveyPlan) -> dict[str, Any]:
    """The plan as data: lengths in m, times in s, points as [row, column, number]."""
    kinds = [stop.kind for stop in plan.stops]
    return {
        "mirror": cfg.mirror.name,
        "order": cfg.run.order,
        "filter": cfg.run.filter,
        "points": {"total": len(plan.points), "reached": len(plan.points) - len(plan.out_of_reach)},
        "out_of_reach": [list(point) for point in plan.out_of_reach],
        "length_m": round(plan.length_m, 3),
        "lower_bound_s": round(plan.least_s, 3),
        "driving_s": round(plan.driving_s, 3),
        "turning_s": round(plan.turning_s, 3),
        "measuring_s": round(plan.measuring_s, 3),
        "any_order_bound_s": round(plan.any_order_s, 3),
        "budget_s": cfg.run.budget_s,
        "fits_budget": plan.least_s <= cfg.run.budget_s,
        "thrust": {
            "least_n": round(plan.grip.least_n, 2),
            "needed_n": round(plan.grip.wanted_n, 2),
            "available_n": plan.grip.thrust_n,
            "safe_speed_m_s": round(plan.grip.safe_speed_m_s, 3),
            "is_held": plan.grip.is_held,
            "is_slow": plan.grip.is_short,
        },
        "via_stops": kinds.count(StopKind.VIA),
        "stops": [
            {
                "t_s": round(time_s, 3),
                "x_m": round(stop.x_m, 4),
                "y_m": round(stop.y_m, 4),
                "kind": stop.kind.value,
                "point": None if stop.point is None else list(stop.point),
                "reverse": stop.reverse,
            }
            for stop, time_s in zip(plan.stops, plan.times_s, strict=True)
        ],
    }


def plan_lines(cfg: Config, plan: SurveyPlan) -> Iterator[str]:
    """The plan as lines for a terminal."""
    vias = sum(stop.kind is StopKind.VIA for stop in plan.stops)
    panels = [panel for panel, _ in groupby(point.panel for point in plan.points)]
    limits = _slowed(cfg, plan.grip).limits
    count = len(set(panels))
    of = f"{count} panel{'' if count == 1 else 's'}"
    yield f"{cfg.mirror.name}: {len(plan.points)} points of {of}, order {cfg.run.order}"
    first = " ".join(f"{panel.row}/{panel.col}" for panel in panels[:9])
    yield f"first panels    {first}{' ...' if len(panels) > 9 else ''}"
    yield f"way             {plan.length_m:.1f} m, {len(plan.stops)} stops, {vias} of them only on the way"
    yield (
        f"least time      {_clock(plan.least_s)}: {plan.driving_s:.0f} s driving, {plan.turning_s:.0f} s turning, "
        f"{plan.measuring_s:.0f} s measuring"
    )
    at = f"at {limits.v_max_m_s:g} m/s and {limits.omega_max_rad_s:g} rad/s"
    yield f"                {at}; simulated surveys take 1 to 10 % more"
    yield f"any order       {_clock(plan.any_order_s)} at least, through the points that can be reached"
    word = "within" if plan.least_s <= cfg.run.budget_s else "BEYOND"
    yield f"budget          {_clock(cfg.run.budget_s)}: the least time is {word} it"
    yield f"thrust          {plan.grip.text}"
    lost = " ".join("/".join(map(str, point)) for point in plan.out_of_reach[:_SHOWN])
    more = " ..." if len(plan.out_of_reach) > _SHOWN else ""
    yield f"out of reach    {f'{len(plan.out_of_reach)} points: {lost}{more}' if lost else 'none'}"


def _clock(time_s: float) -> str:
    return f"{int(time_s) // 60} min {int(time_s) % 60:02d} s"
