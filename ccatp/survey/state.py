"""State of a survey: states, events and transitions; shared flags; failed and missed points; approaches."""

from collections.abc import Callable, Collection, Mapping, Sequence
from enum import StrEnum
from math import inf
from types import MappingProxyType

from ccatp.config.models import Config
from ccatp.control.gate import Purpose
from ccatp.core import DeckPose, PointId, Severity, Stop
from ccatp.mirror.mirror import Mirror
from ccatp.survey.heading_recovery import HeadingRecovery
from ccatp.survey.planning.route import Route
from ccatp.survey.route_follower import Corrector, RouteFollower, SpeedLimitedTracker, StateEstimate
from ccatp.survey.stops import EdgeRetreat, ReturnToBase, SettleAndMeasure


class MissionState(StrEnum):
    """What the mission is at."""

    IDLE = "idle"
    TURNING = "turning"
    DRIVING = "driving"
    SETTLING = "settling"
    MEASURING = "measuring"
    BACKING_OFF = "backing off"
    RETURNING = "returning"
    HELD = "held"
    DONE = "done"


IDLE, TURNING, DRIVING, SETTLING, MEASURING, BACKING_OFF, RETURNING, HELD, DONE = MissionState


class MissionEvent(StrEnum):
    """What can happen to it. Every event has a meaning in every state; where the table is silent it changes nothing."""

    GO_ON = "go on"  # the survey starts, or goes on to the next leg
    TURNED = "turned"  # the robot points at the stop
    REALIGN = "realign"  # it does not any more
    ARRIVED = "arrived"  # the stop is reached
    SETTLED = "settled"  # the robot is at rest there
    EDGE = "edge"  # code 1: near the mirror's edge
    GO_HOME = "go home"  # code 2, or the operator's abort
    FIND = "find"  # stand still for a fix: the pose is not to be trusted
    HOLD = "hold"  # pause, fault, or no permission to move
    FINISHED = "finished"  # all points done, at base after an abort, or stopped


class SurveyOutcome(StrEnum):
    """How a mission ended."""

    NONE = ""
    COMPLETE = "complete"
    AT_BASE = "aborted, at base"
    STOPPED = "stopped"


_ANYWHERE = {MissionEvent.HOLD: MissionState.HELD, MissionEvent.FINISHED: MissionState.DONE}
_SURVEYING = _ANYWHERE | {
    MissionEvent.EDGE: MissionState.BACKING_OFF,
    MissionEvent.GO_HOME: MissionState.RETURNING,
    MissionEvent.GO_ON: MissionState.TURNING,
}

# (state, event) -> state. An edge outranks an abort: while backing off GO_HOME changes nothing. DONE is final.
TRANSITIONS = MappingProxyType(
    {
        IDLE: _SURVEYING | {MissionEvent.FIND: SETTLING},
        TURNING: _SURVEYING | {MissionEvent.TURNED: DRIVING, MissionEvent.ARRIVED: SETTLING},
        DRIVING: _SURVEYING | {MissionEvent.REALIGN: TURNING, MissionEvent.ARRIVED: SETTLING},
        SETTLING: _SURVEYING | {MissionEvent.SETTLED: MEASURING},
        MEASURING: _SURVEYING,
        BACKING_OFF: _ANYWHERE | {MissionEvent.FIND: SETTLING},
        RETURNING: _ANYWHERE | {MissionEvent.EDGE: BACKING_OFF},
        HELD: _SURVEYING | {MissionEvent.FIND: SETTLING},
        DONE: {},
    }
)


# What the last gate lets a state move for.
PURPOSES = MappingProxyType(
    {
        MissionState.IDLE: Purpose.STAND,
        MissionState.TURNING: Purpose.SURVEY,
        MissionState.DRIVING: Purpose.SURVEY,
        MissionState.SETTLING: Purpose.STAND,
        MissionState.MEASURING: Purpose.STAND,
        MissionState.BACKING_OFF: Purpose.RETREAT,
        MissionState.RETURNING: Purpose.HOMEWARD,
        MissionState.HELD: Purpose.STAND,
        MissionState.DONE: Purpose.STAND,
    }
)


def next_state(state: MissionState, event: MissionEvent) -> MissionState:
    """The state after ``event``; total over all pairs."""
    return TRANSITIONS[state].get(event, state)


# Planned at a time: a way through so many points takes less than the robot's frames may wait.
CHUNK = 12


def by_reason(causes: Mapping[PointId, str]) -> dict[str, list[str]]:
    """Points, as people name them, by why they were left out."""
    named: dict[str, list[str]] = {}
    for point, why in causes.items():
        named.setdefault(why, []).append(f"{point.row}-{point.col}-{point.point}")
    return named


class RetryQueue:
    """Points that are due, in this order, away from the planned route.

    Each failed one once more when the others are done.
    """

    def __init__(self) -> None:
        self.causes: dict[PointId, str] = {}
        self.due: list[PointId] = []
        self._tried_again: set[PointId] = set()

    def failed(self, point: PointId, cause: str) -> None:
        """The measurement of a point failed."""
        self.causes[point] = cause
        self._is_over(point)

    def measured(self, point: PointId) -> None:
        """A point is measured, perhaps after it failed."""
        self.causes.pop(point, None)
        self._is_over(point)

    def _is_over(self, point: PointId) -> None:
        if point in self.due:
            self.due.remove(point)

    def begin_second_round(self) -> None:
        """What failed and was not tried again yet is due; last first, because the robot is nearer to that."""
        if not self.due:
            self.due = [point for point in reversed(self.causes) if point not in self._tried_again]
            self._tried_again.update(self.due)

    def drop_low_priority(self, points: Sequence[PointId], wanted: Sequence[PointId], cause: str) -> None:
        """Of these points only the wanted ones are due; there is no time for the others."""
        self.due = list(wanted)
        dropped = set(points).difference(wanted)
        self.causes |= {point: cause for point in points if point in dropped}
        self._tried_again |= dropped


class MissedPoint:
    """Keeps whether the current stop was missed, and at which one the last correction was made."""

    def __init__(self, corrector: Corrector) -> None:
        self._corrector = corrector
        self._is_missed = False
        self._corrected: Stop | None = None  # until the next leg
        self.corrections = 0

    def miss(self) -> None:
        """The fix shows the robot too far from its point."""
        self._is_missed = True

    def interrupt(self) -> None:
        """The robot stopped, or goes on: wherever it is, it is not where it missed the point."""
        self._is_missed = False

    def follows_route(self, motion: StateEstimate, stop: Stop, follower: RouteFollower) -> bool:
        """Whether the leg to ``stop`` may be driven as planned, or as the correction that begins here."""
        if self._is_missed:
            self._is_missed = False
            return self._correct(motion, stop, follower)
        if self._corrected is None or self._corrected is stop:
            return True
        self._corrected = None
        return self._corrector.can_proceed(motion.deck, stop)

    def _correct(self, motion: StateEstimate, stop: Stop, follower: RouteFollower) -> bool:
        panel = motion.pose.panel
        aim = self._corrector.aim(motion.pose, follower.target_in(panel, stop))
        if aim is None:
            return False
        follower.correct(panel, aim)
        self._corrected = stop
        self.corrections += 1
        return True


PlanHome = Callable[[DeckPose], tuple[Stop, ...]]
PlanRest = Callable[[Route, DeckPose, Collection[PointId]], Route]
PlanPoints = Callable[[DeckPose, Sequence[PointId]], Route]


class SurveyState:
    """State, causes and parts of one survey.

    Attributes:
        done: points measured, in order.
        skipped: points whose measurement failed.
        abort_cause: why the survey was given up, or empty.
        interlock: why nothing may move, an earthquake, or empty.
        is_shaking: there is an earthquake, though the robot may be leaving an edge first.
        is_faulted: an operator has to look after it.
        is_odometry_rejected: held because wheels or inertial unit are not trusted.
        inflates_covariance: the localizer shall widen its covariance; to be set to false when it does.
        needs_fix: a fix comes before the next move: the pose is wrong or (``is_at_start``) not confirmed yet.
        wants_calibration: the calibration drive was given up, too far from where it leads.
        wants_full_fans: the robot shall be pressed on with full fans.
        stuck_s: when a retreat led nowhere, robot time.
        waits_until_s: a hold that goes on by itself lasts at least until then, robot time.
        stands_until_s: nothing moves before then, whatever the state, robot time.
    """

    def __init__(
        self, cfg: Config, mirror: Mirror, route: Route, heading_sigma_of: Callable[[], float], *, has_planner: bool
    ) -> None:
        self.cfg, self.mirror, self.route, self._has_planner = cfg, mirror, route, has_planner
        self.tracker = SpeedLimitedTracker(cfg.control, cfg.limits, cfg.health, cfg.robot.wheel_lag_s)
        self.survey_route = self.follow_stops(route.stops)
        self.home: ReturnToBase | None = None
        self.settling = SettleAndMeasure(cfg.control, cfg.etalon.measuring_time_s)
        self.missed = MissedPoint(Corrector(mirror, cfg.robot, cfg.mission))
        self.heading_recovery = HeadingRecovery(mirror, cfg.robot, cfg.mission, heading_sigma_of, self.follow_stops)
        self.retries = RetryQueue()
        self.state, self.outcome, self.cause = MissionState.IDLE, SurveyOutcome.NONE, ""
        self.done: list[PointId] = []
        self.skipped: list[PointId] = []
        self.abort_cause = ""
        self.interlock = ""
        self.is_latched = self.is_shaking = False
        self.severity = Severity.NONE
        self.awaits_operator = self.is_faulted = self.is_odometry_rejected = False
        self.needs_fix = self.is_at_start = cfg.mission.fix_at_start
        self.is_off_route = self.is_review_due = self.inflates_covariance = self.wants_full_fans = False
        self.wants_calibration = False
        self.retreat: EdgeRetreat | None = None
        self.stuck_s: float | None = None
        self.backoffs = 0
        self.waits_until_s = self.stands_until_s = -inf
        self._recoveries_s: list[float] = []

    def follow_stops(self, stops: Sequence[Stop]) -> RouteFollower:
        """A journey along stops."""
        return RouteFollower(self.mirror, self.tracker, self.cfg.control.leg_timeout_factor, stops)

    @property
    def follower(self) -> RouteFollower:
        """The journey being made: the survey, the way home, or a leg that shows the heading."""
        if self.heading_recovery.follower is not None:
            return self.heading_recovery.follower
        return self.survey_route if self.home is None else self.home.follower

    @property
    def rejects_odometry(self) -> bool:
        """Held because wheels or inertial unit are not to be believed: whatever they say, the robot stands."""
        return self.state is HELD and self.is_odometry_rejected

    @property
    def purpose(self) -> Purpose:
        """What the last gate lets the robot move for: legs that show the heading may be part of the way home."""
        if self.needs_fix and self.abort_cause and self.state in (MissionState.TURNING, MissionState.DRIVING):
            return Purpose.HOMEWARD
        return PURPOSES[self.state]

    @property
    def is_held_by_hand(self) -> bool:
        """Held until an operator resumes."""
        return self.state is HELD and self.awaits_operator

    @property
    def is_lost(self) -> bool:
        """The pose is known to be wrong, and is to be found again; at the start it is only to be confirmed."""
        return self.needs_fix and not self.is_at_start

    @property
    def is_awaiting_fix(self) -> bool:
        """Whether the measurement asked for last, number ``request``, is still wanted."""
        return self.state is MissionState.MEASURING and self.settling.is_requested

    def apply(self, event: MissionEvent) -> None:
        """Something happened: the table says what state that makes."""
        self.state = next_state(self.state, event)

    def invalidate_pose(self) -> None:
        """The pose is known to be wrong: a fix comes before the next move."""
        self.needs_fix, self.is_at_start = True, False

    def interrupt_leg(self) -> None:
        """Drive the leg again from where the robot is."""
        (self.survey_route if self.home is None else self.home).interrupt()

    def interrupt_parts(self) -> None:
        """Forget where in a leg, a stop or a docking the robot was: it begins again from where it is."""
        self.interrupt_leg()
        self.settling.interrupt()
        self.missed.interrupt()
        self.heading_recovery.interrupt()

    # -- holding and going on -------------------------------------------------------------------------------------

    def hold(self, cause: str, *, by_hand: bool) -> None:
        """Hold, until somebody resumes or until the cause is gone."""
        self.interrupt_parts()
        self.apply(MissionEvent.HOLD)
        self.awaits_operator = by_hand
        self.is_odometry_rejected = False
        self.cause = cause

    def interrupt(self, cause: str) -> bool:
        """Hold until frames and verdicts are fresh again; returns whether that was news."""
        if self.state in (MissionState.IDLE, MissionState.HELD, MissionState.DONE):
            return False
        self.hold(cause, by_hand=False)
        return True

    def fault(self, cause: str, *, is_lost: bool = False) -> None:
        """Hold until an operator resumes, because something is wrong; where the pose is, a fix comes first then."""
        if self.state is MissionState.DONE:
            return
        self.needs_fix |= is_lost
        self.hold(cause, by_hand=True)
        self.is_faulted = True

    def await_recovery(self, cause: str, *, is_pose_doubted: bool = False) -> None:
        """Hold until the cause is gone, and then find out where the robot is before moving on."""
        if self.state is MissionState.DONE or self.is_held_by_hand:
            return
        self.invalidate_pose()
        was_rejected = self.rejects_odometry
        if not self.interrupt(cause):
            self.cause = cause
        self.is_odometry_rejected = was_rejected or is_pose_doubted

    def recover(self, cause: str, t_s: float) -> None:
        """Hold, and go on with a fix; what comes again and again is a fault."""
        if self.state is MissionState.DONE or self.is_held_by_hand:
            return
        health = self.cfg.health
        self._recoveries_s = [since_s for since_s in self._recoveries_s if t_s - since_s <= health.retry_window_s]
        if self._recoveries_s and t_s - self._recoveries_s[-1] <= health.pause_limit_s:
            self._recoveries_s.pop()  # still the same: frame by frame it is asked for again
        self._recoveries_s.append(t_s)
        if len(self._recoveries_s) > 1 + health.retries:
            self.fault(cause, is_lost=True)
        else:
            self.await_recovery(cause)
            # A filter that is frozen cannot tell when the robot stands.
            self.waits_until_s = t_s + health.retry_after_s

    def abort(self, cause: str) -> str | None:
        """Return to base and end there; why that is refused, or ``None``."""
        if self.state is MissionState.DONE:
            return "the mission is over"
        is_new = not self.abort_cause
        self.abort_cause = self.abort_cause or cause
        if self.interlock:
            return None  # home, but not before the robot may move
        # An edge outranks an abort: the retreat and its fix come first.
        if self.state is HELD or (is_new and self.state is not MissionState.BACKING_OFF and not self.needs_fix):
            self.proceed()
        return None

    def proceed(self) -> None:
        """To what is next: finding the robot, home, the next stop, or the end."""
        self.interrupt_parts()
        self.inflates_covariance |= self.rejects_odometry
        self.is_faulted = False
        # Wherever a hold left the robot: the route's next turn may not be safe there.
        self.is_off_route |= self.state is MissionState.HELD
        if self.needs_fix:
            self.apply(MissionEvent.FIND)
        elif self.abort_cause:
            self.cause = self.abort_cause
            self.home = None  # planned again from where the robot is now
            self.apply(MissionEvent.GO_HOME)
        elif self.survey_route.current is None and not self._has_more():
            self.outcome = SurveyOutcome.COMPLETE
            self.apply(MissionEvent.FINISHED)
        else:
            self.cause = ""
            self.apply(MissionEvent.GO_ON)

    def _has_more(self) -> bool:
        """Whether points are due away from the planned route: those that failed once, or a thinned rest."""
        if not self._has_planner:
            return False
        self.retries.begin_second_round()
        self.is_off_route |= bool(self.retries.due)
        return bool(self.retries.due)


# A puck is within the tolerance when it is so by more than the fix may be wrong (guard band, ISO 14253-1); but a laser
# system of little precision cannot make a robot approach a point again and again.
_GUARD_SIGMAS = 3.0
_MOST_GUARD = 0.1  # of the tolerance


class ApproachCounter:
    """Decides on a correction move after each fix that is further than ``tolerance_m`` from its point.

    After ``limit`` approaches a point is measured wherever the robot stands.
    """

    def __init__(self, tolerance_m: float, limit: int) -> None:
        self._tolerance_m, self._limit = tolerance_m, limit
        self._point: PointId | None = None
        self.count = 0

    def is_too_far(self, point: PointId, error_m: float, sigma_m: float) -> bool:
        """Whether ``point`` has to be approached again; call once for each fix taken there.

        ``sigma_m``: standard deviation of the robot's place after the fix, along its worst direction.
        """
        self.count = self.count + 1 if point == self._point else 1
        self._point = point
        guard_m = min(_GUARD_SIGMAS * sigma_m, _MOST_GUARD * self._tolerance_m)
        return error_m > self._tolerance_m - guard_m and self.count < self._limit
