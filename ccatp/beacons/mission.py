"""A mission among beacons: set points from readings and the verdict of the danger loop. Time is an argument."""

from math import isfinite
from typing import NamedTuple

from msgspec.structs import replace

from ccatp.beacons.conditions import MAP_STALLED, MISSION_TOO_LONG, READINGS_REFUSED, TARGET_LOST
from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.modes import FOLLOWING, MAPPING, VISITING, BeaconMode, Deciding, Returning, Working
from ccatp.beacons.navigation import BeaconMeasurements, MoteNavigator, Navigator, PoseBelief, RadioNavigator, Score
from ccatp.beacons.pilot import BeaconPilot, FollowState
from ccatp.beacons.steering import HALT, SteeringCommand
from ccatp.conditions import Action
from ccatp.core import NO_CAUSE, Verdict
from ccatp.errors import ConfigError
from ccatp.links.robot_messages import Hello
from ccatp.survey.engagement import EngagedMission, Engagement, EngagementRules, Event, Reaction, enter
from ccatp.survey.events import (
    DONE,
    HELD,
    IDLE,
    RETURNING,
    SurveyOutcome,
)
from ccatp.survey.failsafe import (
    ON_EARTHQUAKE,
    ON_EMERGENCY,
    ON_FAULT,
    ON_HOLD,
    ON_NO_VERDICT,
    ON_UNKNOWN,
    is_denied,
    stand,
)

# States of such a mission. In idle, held and done the danger loop expects the robot to stand.
MODES = IDLE, MAPPING, VISITING, FOLLOWING, RETURNING, HELD, DONE


class BeaconRules(EngagementRules[Engagement]):
    """A mission among beacons proceeds as soon as any motion is permitted."""

    rows = (
        *(ON_EARTHQUAKE, ON_FAULT, ON_UNKNOWN, ON_HOLD, ON_NO_VERDICT),
        Reaction("nothing is permitted", Action.PAUSE, lambda _, v: is_denied(v), stand),
        ON_EMERGENCY,
    )

    def proceed(self, s: Engagement) -> Engagement:
        """To its start after an abort, else to the task that the next frame shows."""
        if s.abort_cause:
            return enter(replace(s, cause=s.abort_cause), Event.GO_HOME, Returning())
        return enter(replace(s, cause=NO_CAUSE), Event.GO_ON, Deciding())


RULES = BeaconRules()


def permitted(drive: SteeringCommand, verdict: Verdict, back_speed_m_s: float) -> SteeringCommand:
    """The permitted part of a command.

    If forward motion is wanted but denied, the robot moves straight back, if that is permitted: the obstacle ahead does
    not go away, and a vehicle with steered wheels cannot turn on the spot.
    """
    if not all(map(isfinite, drive)):
        return HALT
    if drive.speed_m_s > 0.0 and not verdict.forward:
        return SteeringCommand(-back_speed_m_s, 0.0, 0.0) if verdict.reverse else HALT
    if drive.speed_m_s < 0.0 and not verdict.reverse:
        return HALT
    if not verdict.turn:
        return SteeringCommand(drive.speed_m_s, 0.0, 0.0)
    return drive


_DOUBTED = 40  # readings, of which at most half may be refused


class WaypointArrival(NamedTuple):
    """A reached waypoint."""

    waypoint: int  # its number in the list, from 0
    lap: int  # from 0
    place_m: tuple[float, float]
    belief: PoseBelief


class BeaconMission(EngagedMission[Engagement]):
    """Maps and visits waypoints, or follows a radio; returns to its start when it is aborted.

    Call ``step`` once per frame. The robot must begin at the configured start.
    """

    def __init__(self, cfg: RadioConfig) -> None:
        super().__init__(RULES, Engagement())
        self._cfg = cfg
        self.navigator: Navigator = MoteNavigator(cfg) if cfg.system == "cricket" else RadioNavigator(cfg)
        self.pilot = BeaconPilot(cfg)
        self._homing: BeaconPilot | None = None
        self.arrivals: list[WaypointArrival] = []
        self._begun_s: float | None = None
        self._followed_s = self._lost_s = 0.0  # the second: since the followed radio was lost, or the mission began
        self._scored = Score(0.0, 0, 0, 0)  # up to the first of the readings that are judged together
        self._map_readings, self._stalled_s = 0, 0.0  # of the self-mapping, and the time since the last useful one
        self._is_following = cfg.follow.is_active

    def _work(self, task: BeaconMode) -> None:
        if self.state.mode is not task:
            self._state = enter(self.state, Event.GO_ON, Working(task))

    # -- frames ---------------------------------------------------------------------------------------------------

    @property
    def total(self) -> int:
        """Number of waypoints to reach, or seconds to follow."""
        mission = self._cfg.mission
        return round(mission.follow_s) if self._is_following else mission.laps * len(self._cfg.workspace.waypoints_m)

    @property
    def done(self) -> int:
        """Waypoints reached, or seconds followed."""
        return min(int(self._followed_s), self.total) if self._is_following else len(self.arrivals)

    @property
    def next_waypoint(self) -> int:
        """Number of the current waypoint, -1 for none."""
        is_visiting = not self._is_following and len(self.arrivals) < self.total
        return len(self.arrivals) % len(self._cfg.workspace.waypoints_m) if is_visiting else -1

    def step(self, measurements: BeaconMeasurements, interval_s: float, verdict: Verdict | None) -> SteeringCommand:
        """One frame: process its readings, react to the verdict, and return a command that it permits.

        ``verdict``: the current one of the danger loop; ``None`` if there is no recent one.
        """
        self.navigator.take(measurements)
        t_s = measurements.t_s
        if self._begun_s is None:
            self._begun_s = t_s
        self.react(measurements, verdict)
        if verdict is None or not any(self.state.permits(verdict)):
            return HALT
        if self._is_refused():
            return HALT
        limit_s = self._cfg.mission.time_limit_s
        if t_s - self._begun_s > limit_s and self.state.mode is not IDLE and not self.state.abort_cause:
            self._state = RULES.meet(self.state, MISSION_TOO_LONG.cause(limit_s=limit_s))
            return HALT
        drive = self._wanted(measurements, interval_s)
        return permitted(drive, verdict, self._cfg.avoidance.back_speed_m_s)

    def _is_refused(self) -> bool:
        """Judge readings together: an estimate that most of them contradict is wrong, however sure it is."""
        score, before = self.navigator.score, self._scored
        refused, used = score.refused - before.refused, score.used - before.used
        if refused + used < _DOUBTED:
            return False
        self._scored = score
        if 2 * refused <= _DOUBTED:
            return False
        cause = READINGS_REFUSED.cause(refused=refused, count=refused + used)
        self._state = RULES.meet(self.state, cause)
        return True

    def _wanted(self, measurements: BeaconMeasurements, interval_s: float) -> SteeringCommand:
        if self.navigator.is_mapping:
            if self.state.abort_cause:
                self.finish(SurveyOutcome.AT_BASE)  # it never left
            else:
                self._map(interval_s)
            return HALT
        t_s, avoidance = measurements.t_s, self._cfg.avoidance
        # A frame without readings counts as free space; the pilot remembers earlier obstacles.
        distances_m = measurements.extras.distances or [avoidance.range_max_m] * len(avoidance.sensors_rad)
        if self.state.abort_cause:
            return self._return(t_s, interval_s, distances_m)
        pose, target = self.navigator.belief.pose, self.navigator.target(t_s)
        drive = self.pilot.drive(t_s, interval_s, pose, target, distances_m)
        if not self._is_following:
            self._visit()
        else:
            self._follow(interval_s)
        return HALT if self.state.outcome is not SurveyOutcome.NONE else drive

    def _map(self, interval_s: float) -> None:
        """Wait for the map of the motes, as long as readings for it arrive."""
        self._work(MAPPING)
        readings = self.navigator.map_readings
        self._stalled_s = 0.0 if readings != self._map_readings else self._stalled_s + interval_s
        self._map_readings = readings
        if self._stalled_s > self._cfg.danger.hold_limit_s:
            cause = MAP_STALLED.cause(lacking=self.navigator.map_lacks, stalled_s=round(self._stalled_s))
            self._state, self._stalled_s = RULES.meet(self.state, cause), 0.0

    def _follow(self, interval_s: float) -> None:
        """Count the time in which the radio is received; without it the robot has nothing to follow."""
        self._work(FOLLOWING)
        if self.pilot.follower.state is not FollowState.LOST:
            self._lost_s = 0.0
            self._followed_s += interval_s
            if self._followed_s >= self._cfg.mission.follow_s:
                self.finish(SurveyOutcome.COMPLETE)
            return
        self._lost_s += interval_s
        cfg = self._cfg
        if self._lost_s > cfg.follow.lost_after_s + cfg.danger.hold_limit_s:
            cause = TARGET_LOST.cause(name=cfg.follow.target, lost_s=round(self._lost_s))
            self._state, self._lost_s = RULES.meet(self.state, cause), 0.0

    def _visit(self) -> None:
        self._work(VISITING)
        waypoints = self._cfg.workspace.waypoints_m
        while len(self.arrivals) < min(self.pilot.waypoints.reached, self.total):
            lap, waypoint = divmod(len(self.arrivals), len(waypoints))
            self.arrivals.append(WaypointArrival(waypoint, lap, waypoints[waypoint], self.navigator.belief))
        if len(self.arrivals) >= self.total:
            self.finish(SurveyOutcome.COMPLETE)

    def _return(self, t_s: float, interval_s: float, distances_m: list[float]) -> SteeringCommand:
        if self._homing is None:
            self._homing = BeaconPilot(self._cfg, (self._cfg.start.x_m, self._cfg.start.y_m))
        drive = self._homing.drive(t_s, interval_s, self.navigator.belief.pose, None, distances_m)
        if self._homing.waypoints.current_m is None:
            self.finish(SurveyOutcome.AT_BASE)
            return HALT
        return drive


def wheel_rates(drive: SteeringCommand, cfg: RadioConfig) -> tuple[float, float, float | None]:
    """Rates of the right and the left wheel, rad/s, and the steering angle, rad, ``None`` for a differential drive.

    The mean rate is v / r, the difference omega b / r with the track b; on an Ackermann vehicle both rates are equal.
    """
    radius_m, vehicle = cfg.robot.wheel_radius_m, cfg.vehicle
    rate_rad_s = drive.speed_m_s / radius_m
    if vehicle.kind == "ackermann":
        return rate_rad_s, rate_rad_s, drive.steer_rad
    half_rad_s = 0.5 * vehicle.track_m * drive.turn_rate_rad_s / radius_m
    return rate_rad_s + half_rad_s, rate_rad_s - half_rad_s, None


# Relative difference (rad for angles of sensors) above which the configuration is of another robot. It is not zero,
# because the configuration may be calibrated, while the robot reports nominal values.
TOLERANCE = 0.05
TrackRow = tuple[int, float, float, float, float, float, float, float, float, float, float, float, float]


def track_row(seq: int, t_s: float, navigator: Navigator) -> TrackRow:
    """A row of the topic ``beacon_track``."""
    (x, y, heading), P = navigator.belief
    xx, xy, xh = P[0].tolist()
    _, yy, yh = P[1].tolist()
    return seq, t_s, x, y, heading, xx, xy, yy, xh, yh, float(P[2, 2]), *navigator.reckoned_m


def check_beacon_robot(cfg: RadioConfig, hello: Hello) -> None:
    """Refuse a robot whose own geometry contradicts the configuration. Raises ConfigError: it is another robot."""
    own, vehicle = hello.robot, hello.robot.vehicle
    if vehicle is None:
        raise ConfigError("robot: it says nothing of its vehicle: this is no robot for missions among beacons")
    problems = [
        f"{name} is {ours:g} here and {theirs:g} there"
        for name, ours, theirs in (
            ("robot.wheel_radius_m", cfg.robot.wheel_radius_m, own.wheel_radius_m),
            ("vehicle.track_m", cfg.vehicle.track_m, own.wheel_base_m),
            ("vehicle.wheelbase_m", cfg.vehicle.wheelbase_m, vehicle.axle_distance_m),
        )
        if abs(ours - theirs) > TOLERANCE * theirs
    ]
    if vehicle.kind != cfg.vehicle.kind:
        problems.append(f"vehicle.kind is {cfg.vehicle.kind} here and {vehicle.kind} there")
    ours, theirs = cfg.avoidance.sensors_rad, vehicle.distance_sensors_rad
    if len(ours) != len(theirs) or any(abs(a - b) > TOLERANCE for a, b in zip(ours, theirs, strict=True)):
        problems.append("the distance sensors look elsewhere (avoidance.sensors_rad)")
    if problems:
        raise ConfigError(f"robot: the configuration is not of this robot: {'; '.join(problems)}")
