"""Behaviours of a survey as frozen values: settle for a measurement, retreat from an edge, drive home."""

from enum import StrEnum
from math import copysign, hypot

import msgspec
from msgspec.structs import replace

from ccatp.conditions.danger import RIM_AHEAD
from ccatp.config.models import ControlConfig, MissionConfig
from ccatp.control.tracker import LegMotion, LegPhase, LegTracker
from ccatp.core import EventCode, PanelPose, PointId, Stop, StopKind, Twist, Verdict
from ccatp.kinematics import difference
from ccatp.survey.engagement import Kind, Phase
from ccatp.survey.events import BACKING_OFF, MEASURING, SETTLING
from ccatp.survey.route_follower import Leg, LegFollower, StateEstimate

# Tolerance for the rounding of sums of frame periods, which must not cost a frame.
TIME_EPSILON_S = 5e-10
# Wheels stop within half a second. A robot that is not at rest after this time creeps, or its sensors are wrong.
SETTLE_LIMIT_S = 10.0
STILL = Twist(0.0, 0.0)


class MissionCommand(msgspec.Struct, frozen=True):
    """The command of the mission for one frame."""

    twist: Twist
    at_rest: bool = False  # the robot has come to rest in this frame
    arrived: PointId | None = None  # the point, if it came to rest there for the first time (not after a correction)
    measure: bool = False  # request a measurement: of a point, or to relocalize
    inflates_covariance: bool = False
    skips_calibration: bool = False  # the calibration drive is given up, because the robot is too far from it


HOLD_POSITION = MissionCommand(STILL)


class Standstill(msgspec.Struct, frozen=True):
    """Detects rest: both speeds, or both running means, have been below the limits for the settling time.

    The means are used because the fans shake the body with zero mean; wheels that run down or creep move the mean.
    """

    is_rest: bool = False
    since_s: float | None = None
    mean_speed_m_s: float | None = None
    mean_rate_rad_s: float = 0.0

    def update(self, cfg: ControlConfig, motion: StateEstimate) -> "Standstill":
        """Take the speeds of a frame."""
        t_s, dt_s, speed_m_s, rate_rad_s = motion.t_s, motion.dt_s, motion.speed_m_s, motion.rate_rad_s
        since_s, mean_m_s, mean_rad_s = self.since_s, self.mean_speed_m_s, self.mean_rate_rad_s
        if mean_m_s is None:
            mean_m_s, mean_rad_s = speed_m_s, rate_rad_s
        share = dt_s / (cfg.settle_mean_time_s + dt_s)
        mean_m_s += share * (speed_m_s - mean_m_s)
        mean_rad_s += share * (rate_rad_s - mean_rad_s)
        v, omega = cfg.settle_speed_m_s, cfg.settle_rate_rad_s
        is_slow = abs(speed_m_s) <= v and abs(rate_rad_s) <= omega
        if not (is_slow or (abs(mean_m_s) <= v and abs(mean_rad_s) <= omega)):
            return Standstill(False, None, mean_m_s, mean_rad_s)
        if since_s is None:
            since_s = t_s
        return Standstill(t_s - since_s >= cfg.settle_time_s - TIME_EPSILON_S, since_s, mean_m_s, mean_rad_s)


class Settling(Phase, frozen=True, tag=True):
    """At the end of a leg, until the robot is at rest. ``rest_by_s``: deadline for that, from the first frame on."""

    standstill: Standstill = Standstill()
    rest_by_s: float | None = None

    kind, shown = Kind.WORK, SETTLING

    def update(self, cfg: ControlConfig, motion: StateEstimate) -> "Settling":
        """One frame. The phase ends with ``standstill.is_rest``."""
        rest_by_s = motion.t_s + SETTLE_LIMIT_S if self.rest_by_s is None else self.rest_by_s
        return Settling(self.standstill.update(cfg, motion), rest_by_s)


class RequestState(StrEnum):
    """Whether a measurement is requested."""

    DUE = "due"  # at the end of the measuring time
    MADE = "made"  # and its result is still wanted
    FAILED = "failed"  # request it again after another measuring time


class Measuring(Phase, frozen=True, tag=True):
    """From rest to the end of a measurement, which is requested after standing for the measuring time."""

    standstill: Standstill = Standstill()
    rest_by_s: float | None = None  # deadline for standing still
    measure_at_s: float = 0.0  # end of the measuring time
    request: RequestState = RequestState.DUE

    kind, shown = Kind.WORK, MEASURING

    @classmethod
    def begin(cls, settled: Settling, t_s: float, measuring_time_s: float) -> "Measuring":
        """At rest: the measuring time begins."""
        return cls(settled.standstill)._timed(t_s, measuring_time_s)

    def update(self, cfg: ControlConfig, measuring_time_s: float, motion: StateEstimate) -> "tuple[Measuring, bool]":
        """One frame of the measuring time, which any motion restarts; and whether to request the measurement now."""
        t_s = motion.t_s
        measuring = replace(self, standstill=self.standstill.update(cfg, motion))
        is_rest = measuring.standstill.is_rest
        if measuring.request is RequestState.FAILED or (measuring.request is RequestState.MADE and not is_rest):
            measuring = measuring._timed(t_s, measuring_time_s)
        elif not is_rest:
            measuring = replace(measuring, measure_at_s=t_s + measuring_time_s - TIME_EPSILON_S)
        if measuring.request is RequestState.MADE or t_s < measuring.measure_at_s:
            return measuring, False
        return replace(measuring, rest_by_s=None, request=RequestState.MADE), True

    def _timed(self, t_s: float, measuring_time_s: float) -> "Measuring":
        measure_at_s = t_s + measuring_time_s - TIME_EPSILON_S
        return replace(self, measure_at_s=measure_at_s, rest_by_s=t_s + SETTLE_LIMIT_S, request=RequestState.DUE)


class ReturnHome(msgspec.Struct, frozen=True):
    """The way home along ``stops``, of which the last is base; ``stop_index`` is past the last at the end."""

    stops: tuple[Stop, ...]
    stop_index: int = 0
    leg: Leg | None = None
    is_docking: bool = False
    standstill: Standstill = Standstill()

    @property
    def is_at_base(self) -> bool:
        """Whether the robot stands at base, with the heading of base."""
        return self.stop_index >= len(self.stops)

    def interrupted(self) -> "ReturnHome":
        """The same, but the leg begins again from where the robot will be."""
        return replace(self, leg=None, is_docking=False)

    def update(
        self, follower: LegFollower, cfg: ControlConfig, motion: StateEstimate, *, is_slow: bool
    ) -> "tuple[ReturnHome, Twist]":
        """One frame of the way home: the twist until the next frame."""
        home, stop = replace(self, standstill=self.standstill.update(cfg, motion)), self.stops[self.stop_index]
        if home.is_docking and home.leg is not None:
            return home._dock(follower, home.leg, motion)
        leg, twist = follower.follow(home.leg or Leg(stop), motion, is_slow=is_slow)
        if leg.motion is not None and leg.motion.phase is not LegPhase.DONE:
            return replace(home, leg=leg), twist
        if stop.kind is not StopKind.BASE:
            return replace(home, stop_index=home.stop_index + 1, leg=None), STILL
        if stop.heading_rad is not None:
            leg = follower.begin_turn(leg, motion, stop.heading_rad, is_slow=is_slow)
        return replace(home, leg=leg, is_docking=True), STILL

    def _dock(self, follower: LegFollower, leg: Leg, motion: StateEstimate) -> "tuple[ReturnHome, Twist]":
        heading_rad, tracked = leg.stop.heading_rad, leg.motion
        if heading_rad is not None and tracked is not None and tracked.phase is LegPhase.TURN:
            leg, twist = follower.turn(leg, tracked, motion, heading_rad)
            return replace(self, leg=leg), twist
        if self.standstill.is_rest:
            return replace(self, stop_index=self.stop_index + 1, leg=None), STILL
        return self, STILL


# Limit for undoing a turn that led to the rim: a larger turn would bring the next corner over the rim.
UNTURN_LIMIT_RAD = 0.8
# A retreat of 60 mm at 0.05 m/s and a turn take 3 s. After this time a wheel is blocked or no motion is permitted.
TIME_LIMIT_S = 15.0


class RetreatStep(StrEnum):
    """Steps of a retreat."""

    BACK = "back"
    UNTURN = "unturn"
    TURN_AWAY = "turn away"
    OVER = "over"
    STUCK = "stuck"


class Retreat(Phase, frozen=True, tag=True):
    """Backs off along the track just driven, then turns away from the side that hung over the edge.

    A robot that reached the edge in reverse does not turn, because it faces away from the edge.
    """

    step: RetreatStep
    last: PanelPose  # in the last frame
    away_rad: float  # turn away, towards the side that is on the mirror; to the left if both or neither are
    direction: float  # of the back-off, 1: forward, -1: reverse
    after_back: RetreatStep
    unturn: float  # sign of the turn that undoes the last one
    time_s: float = 0.0
    travel_m: float = 0.0
    turned_rad: float = 0.0
    has_turned_away: bool = False
    turn: LegMotion | None = None  # the turn away, once it has begun
    goal_rad: float = 0.0  # heading at the end of the turn away

    kind, shown = Kind.RETREAT, BACKING_OFF

    @classmethod
    def begin(cls, cfg: MissionConfig, verdict: Verdict, pose: PanelPose, rate_rad_s: float) -> "Retreat":
        """The retreat from the edge that a verdict reports."""
        front_left, front_right, rear_left, rear_right = verdict.off
        front, rear = front_left or front_right, rear_left or rear_right
        left, right = front_left or rear_left, front_right or rear_right
        step = RetreatStep.STUCK
        if verdict.turn and not (front and rear):
            step = RetreatStep.UNTURN
        elif front != rear:
            step = RetreatStep.BACK
        return cls(
            step,
            pose,
            away_rad=-cfg.turn_away_rad if left and not right else cfg.turn_away_rad,
            direction=-1.0 if front else 1.0,
            after_back=RetreatStep.TURN_AWAY if front else RetreatStep.OVER,
            unturn=-copysign(1.0, rate_rad_s),
        )

    def update(
        self, cfg: MissionConfig, tracker: LegTracker, motion: StateEstimate, verdict: Verdict, *, is_slow: bool
    ) -> "tuple[Retreat, Twist]":
        """One frame: the twist until the next one."""
        pose, last = motion.pose, self.last
        travel_m, turned_rad, time_s, step = self.travel_m, self.turned_rad, self.time_s + motion.dt_s, self.step
        if pose.panel == last.panel:
            travel_m += hypot(pose.x_m - last.x_m, pose.y_m - last.y_m)
            turned_rad += abs(difference(pose.heading_rad, last.heading_rad))
        if time_s > TIME_LIMIT_S and step is not RetreatStep.OVER:
            step = RetreatStep.STUCK
        now = replace(self, last=pose, travel_m=travel_m, turned_rad=turned_rad, time_s=time_s, step=step)
        if not (verdict.forward or verdict.reverse or verdict.turn):
            return now, STILL  # data are missing; this ends by itself
        is_clear = verdict.code is not EventCode.NEAR_EDGE
        if step is RetreatStep.BACK:
            return now._back(cfg, is_clear, verdict)
        if step is RetreatStep.UNTURN:
            return now._undo_turn(cfg, is_clear, verdict)
        if step is RetreatStep.TURN_AWAY:
            return now._turn_away(tracker, motion, is_clear, verdict, is_slow)
        return now, STILL

    def at(self, step: RetreatStep) -> "Retreat":
        """The same retreat at another step."""
        return replace(self, step=step)

    def _back(self, cfg: MissionConfig, is_clear: bool, verdict: Verdict) -> "tuple[Retreat, Twist]":
        if self.travel_m >= cfg.backoff_m or (is_clear and self.travel_m >= 0.5 * cfg.backoff_m):
            return self.at(self.after_back if is_clear else RetreatStep.STUCK), STILL
        if not (verdict.reverse if self.direction < 0.0 else verdict.forward):
            return self.at(RetreatStep.STUCK), STILL
        return self, Twist(self.direction * cfg.backoff_speed_m_s, 0.0)

    def _undo_turn(self, cfg: MissionConfig, is_clear: bool, verdict: Verdict) -> "tuple[Retreat, Twist]":
        if is_clear:
            return self.at(RetreatStep.OVER), STILL
        if self.turned_rad >= UNTURN_LIMIT_RAD or not verdict.turn:
            return self.at(RetreatStep.OVER if self.has_turned_away else RetreatStep.BACK), STILL
        return self, Twist(0.0, self.unturn * cfg.turn_away_rad)

    def _turn_away(
        self, tracker: LegTracker, motion: StateEstimate, is_clear: bool, verdict: Verdict, is_slow: bool
    ) -> "tuple[Retreat, Twist]":
        if not is_clear:
            # The turn moved a corner sensor off the panels. At the rim, undo the turn; where it may be a seam, a fix
            # decides.
            step = RetreatStep.UNTURN if verdict.cause.condition == RIM_AHEAD.name else RetreatStep.OVER
            unturn = -copysign(1.0, self.away_rad)
            return replace(self, step=step, has_turned_away=True, unturn=unturn, turned_rad=0.0), STILL
        turn, goal_rad = self.turn, self.goal_rad
        if turn is None:
            goal_rad = motion.pose.heading_rad + self.away_rad
            turn = tracker.begin_turn(self.away_rad, is_slow=is_slow)
        state = motion.steered
        remaining = difference(goal_rad, state.pose[2])
        turn, twist = tracker.step_turn(turn, remaining, motion.dt_s, state.omega_rad_s)
        step = RetreatStep.OVER if turn.phase is LegPhase.DONE else RetreatStep.TURN_AWAY
        return replace(self, turn=turn, goal_rad=goal_rad, step=step), twist
