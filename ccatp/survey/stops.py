"""Standing at a stop until the measurement, the way home, and what the mission wants of a frame."""

from enum import StrEnum
from math import copysign, hypot

import msgspec

from ccatp.config.models import ControlConfig, MissionConfig
from ccatp.control.tracker import LegPhase, LegTracker
from ccatp.core import EventCode, PanelPose, PointId, Stop, StopKind, Twist, Verdict, difference
from ccatp.safety.edge_detector import Cause
from ccatp.survey.route_follower import RouteFollower, StateEstimate

# Sums of frame periods are not exact: half a nanosecond must not cost a frame.
TIME_EPSILON_S = 5e-10


class StandstillDetector:
    """At rest: both speeds, or both of their running means, have been below the limits for the settling time.

    Fans shake the body with a mean of zero; wheels that run down, or that creep, move the mean as well.
    """

    __slots__ = ("_cfg", "_mean_rate_rad_s", "_mean_speed_m_s", "_since_s")

    def __init__(self, cfg: ControlConfig) -> None:
        self._cfg = cfg
        self.reset()

    def reset(self) -> None:
        """The robot moves, or may have moved."""
        self._since_s: float | None = None
        self._mean_speed_m_s: float | None = None
        self._mean_rate_rad_s = 0.0

    def is_rest(self, t_s: float, dt_s: float, speed_m_s: float, rate_rad_s: float) -> bool:
        """Take the speeds of a frame, ``dt_s`` after the one before; whether the robot is at rest."""
        cfg = self._cfg
        if self._mean_speed_m_s is None:
            self._mean_speed_m_s, self._mean_rate_rad_s = speed_m_s, rate_rad_s
        share = dt_s / (cfg.settle_mean_time_s + dt_s)
        self._mean_speed_m_s += share * (speed_m_s - self._mean_speed_m_s)
        self._mean_rate_rad_s += share * (rate_rad_s - self._mean_rate_rad_s)
        is_slow = self._is_slow(speed_m_s, rate_rad_s) or self._is_slow(self._mean_speed_m_s, self._mean_rate_rad_s)
        if not is_slow:
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = t_s
        return t_s - self._since_s >= cfg.settle_time_s - TIME_EPSILON_S

    def _is_slow(self, speed_m_s: float, rate_rad_s: float) -> bool:
        return abs(speed_m_s) <= self._cfg.settle_speed_m_s and abs(rate_rad_s) <= self._cfg.settle_rate_rad_s


# Wheels stop within half a second: a robot that is not at rest after this long creeps, or its sensors say so.
SETTLE_LIMIT_S = 10.0


class SettleAndMeasure:
    """From the end of a leg to the request for a measurement, after standing for ``measuring_time_s``."""

    def __init__(self, control: ControlConfig, measuring_time_s: float) -> None:
        self._stillness = StandstillDetector(control)
        self._measuring_time_s = measuring_time_s
        self._rest_by_s: float | None = None
        self._measure_at_s = 0.0
        self._arrived_at: PointId | None = None
        self._is_anew = False
        self.request = 0
        self.is_requested = False

    def interrupt(self) -> None:
        """The robot moves, or may have moved: the stop begins again."""
        self.is_requested = self._is_anew = False
        self._stillness.reset()
        self._rest_by_s = None

    def is_quiet(self, motion: StateEstimate) -> bool:
        """Take the speeds of a frame; whether the robot has been at rest for the settling time."""
        return self._stillness.is_rest(motion.t_s, motion.dt_s, motion.speed_m_s, motion.rate_rad_s)

    def has_settled(self, motion: StateEstimate) -> bool:
        """One frame of coming to rest; whether that is over, and the measuring time begins."""
        if self._rest_by_s is None:
            self._rest_by_s = motion.t_s + SETTLE_LIMIT_S
        if not self.is_quiet(motion):
            return False
        self._begin(motion.t_s)
        return True

    def _begin(self, t_s: float) -> None:
        self._measure_at_s = t_s + self._measuring_time_s - TIME_EPSILON_S
        self._rest_by_s = t_s + SETTLE_LIMIT_S

    def is_settle_overdue(self, t_s: float) -> bool:
        """Whether coming to rest, or standing still for a measurement, takes far longer than it should."""
        return self._rest_by_s is not None and t_s > self._rest_by_s

    def arrival_at(self, point: PointId | None) -> PointId | None:
        """The point, where the robot has come to rest there for the first time."""
        if point is None or point == self._arrived_at:
            return None
        self._arrived_at = point
        return point

    def repeat(self) -> None:
        """The measurement failed: it is asked for once more, after another measuring time."""
        self.is_requested, self._is_anew = False, True

    def is_due(self, motion: StateEstimate) -> bool:
        """Take a frame of the measuring time; whether to ask for the measurement now. True once at each stop.

        Motion spoils the measurement, also one in progress: the time begins again, and what was asked for is dropped.
        """
        t_s = motion.t_s
        if self._is_anew:
            self._is_anew = False
            self._begin(t_s)
        if not self.is_quiet(motion):
            if self.is_requested:
                self.is_requested = False
                self._begin(t_s)
            self._measure_at_s = t_s + self._measuring_time_s - TIME_EPSILON_S
        if self.is_requested or t_s < self._measure_at_s:
            return False
        self._rest_by_s = None
        self.is_requested = True
        self.request += 1
        return True


STILL = Twist(0.0, 0.0)


class ReturnToBase:
    """Drives a route whose last stop is base; ``follower`` is exhausted once the robot stands there."""

    def __init__(self, follower: RouteFollower, tracker: LegTracker) -> None:
        self.follower, self._tracker = follower, tracker
        self._is_docking = False

    @property
    def is_at_base(self) -> bool:
        """Whether the robot stands at base, turned as it should be."""
        return self.follower.current is None

    def interrupt(self) -> None:
        """The robot stopped on the way: the leg begins again."""
        self._is_docking = False
        self.follower.interrupt()

    def step(self, motion: StateEstimate, is_quiet: bool) -> Twist:
        """One frame of the way home; ``is_quiet``: the robot has been at rest for the settling time."""
        stop = self.follower.current
        if stop is None:
            return STILL
        if self._is_docking:
            return self._dock(motion, stop, is_quiet)
        twist = self.follower.follow(motion, stop)
        if self._tracker.phase is not LegPhase.DONE:
            return twist
        if stop.kind is not StopKind.BASE:
            self.follower.advance()
            return STILL
        self._is_docking = True
        if stop.heading_rad is not None:
            self._tracker.begin_turn(difference(stop.heading_rad, motion.deck.heading_rad))
        return STILL

    def _dock(self, motion: StateEstimate, stop: Stop, is_quiet: bool) -> Twist:
        if stop.heading_rad is not None and self._tracker.phase is LegPhase.TURN:
            remaining = difference(stop.heading_rad, motion.deck.heading_rad + motion.lead_rad)
            return self._tracker.step_turn(remaining, motion.dt_s, motion.steered.omega_rad_s)
        if is_quiet:
            self.follower.advance()
        return STILL


class MissionCommand(msgspec.Struct, frozen=True):
    """What the mission wants of the present frame.

    Attributes:
        twist: the velocity wanted until the next frame.
        at_rest: the robot has come to rest in this frame.
        arrived: the measurement point at which it did so for the first time; corrections are no arrivals.
        measure: have the laser system measure now (of a point, or after a back-off to find itself again).
    """

    twist: Twist
    at_rest: bool = False
    arrived: PointId | None = None
    measure: bool = False


HOLD_POSITION = MissionCommand(STILL)


# A turn that met the rim is undone by at most this; more would sweep the next corner.
UNTURN_LIMIT_RAD = 0.8
# 60 mm at 0.05 m/s and a turn take three seconds: after this long a wheel is blocked, or nothing is permitted.
TIME_LIMIT_S = 15.0


class RetreatStep(StrEnum):
    """What the retreat is at."""

    BACK = "back"
    UNTURN = "unturn"
    TURN_AWAY = "turn away"
    OVER = "over"
    STUCK = "stuck"


class EdgeRetreat:
    """One back-off along the track just driven, then a turn away from the side that hung over.

    A robot that met the edge backwards faces away from it, and does not turn.
    """

    def __init__(
        self, cfg: MissionConfig, tracker: LegTracker, verdict: Verdict, pose: PanelPose, rate_rad_s: float
    ) -> None:
        self._cfg, self._tracker = cfg, tracker
        self._last = pose
        self._time_s = 0.0
        self._travel_m = self._turned_rad = 0.0
        self._away_rad: float | None = None
        self._has_turned_away = False
        front_left, front_right, rear_left, rear_right = verdict.off
        front, rear = front_left or front_right, rear_left or rear_right
        left, right = front_left or rear_left, front_right or rear_right
        # Turning is to the side that stands on the mirror; where both or none do, to the left.
        self._away = -cfg.turn_away_rad if left and not right else cfg.turn_away_rad
        self._direction = -1.0 if front else 1.0
        self._after_back = RetreatStep.TURN_AWAY if front else RetreatStep.OVER
        self._unturn = -copysign(1.0, rate_rad_s)
        if verdict.turn and not (front and rear):
            self.step_at = RetreatStep.UNTURN
        elif front != rear:
            self.step_at = RetreatStep.BACK
        else:
            self.step_at = RetreatStep.STUCK

    def step(self, motion: StateEstimate, verdict: Verdict) -> Twist:
        """The twist until the next frame; ``step_at`` tells what it is at."""
        pose = motion.pose
        if pose.panel == self._last.panel:
            self._travel_m += hypot(pose.x_m - self._last.x_m, pose.y_m - self._last.y_m)
            self._turned_rad += abs(difference(pose.heading_rad, self._last.heading_rad))
        self._last = pose
        self._time_s += motion.dt_s
        if self._time_s > TIME_LIMIT_S and self.step_at is not RetreatStep.OVER:
            self.step_at = RetreatStep.STUCK
        if not (verdict.forward or verdict.reverse or verdict.turn):
            return STILL  # data are missing, which passes by itself
        is_clear = verdict.code is not EventCode.NEAR_EDGE
        if self.step_at is RetreatStep.BACK:
            return self._back(is_clear, verdict)
        if self.step_at is RetreatStep.UNTURN:
            return self._undo_turn(is_clear, verdict)
        if self.step_at is RetreatStep.TURN_AWAY:
            return self._turn_away(motion, is_clear, verdict)
        return STILL

    def _back(self, is_clear: bool, verdict: Verdict) -> Twist:
        if self._travel_m >= self._cfg.backoff_m or (is_clear and self._travel_m >= 0.5 * self._cfg.backoff_m):
            self.step_at = self._after_back if is_clear else RetreatStep.STUCK
            return STILL
        if not (verdict.reverse if self._direction < 0.0 else verdict.forward):
            self.step_at = RetreatStep.STUCK
            return STILL
        return Twist(self._direction * self._cfg.backoff_speed_m_s, 0.0)

    def _undo_turn(self, is_clear: bool, verdict: Verdict) -> Twist:
        if is_clear:
            self.step_at = RetreatStep.OVER
            return STILL
        if self._turned_rad >= UNTURN_LIMIT_RAD or not verdict.turn:
            self.step_at = RetreatStep.OVER if self._has_turned_away else RetreatStep.BACK
            return STILL
        return Twist(0.0, self._unturn * self._cfg.turn_away_rad)

    def _turn_away(self, motion: StateEstimate, is_clear: bool, verdict: Verdict) -> Twist:
        if not is_clear:
            # The turn sweeps a corner off the panels. Off the rim, back; off what may be a seam, the fix tells.
            self._has_turned_away = True
            self._unturn, self._turned_rad = -copysign(1.0, self._away), 0.0
            self.step_at = RetreatStep.UNTURN if verdict.cause.startswith(Cause.RIM) else RetreatStep.OVER
            return STILL
        if self._away_rad is None:
            self._away_rad = motion.pose.heading_rad + self._away
            self._tracker.begin_turn(self._away)
        state = motion.steered
        remaining = difference(self._away_rad, state.pose[2])
        twist = self._tracker.step_turn(remaining, motion.dt_s, state.omega_rad_s)
        if self._tracker.phase is LegPhase.DONE:
            self.step_at = RetreatStep.OVER
        return twist
