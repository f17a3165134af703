"""What the robot does in each state of a survey, and the time budget of the mission."""

from collections.abc import Callable, Sequence
from math import hypot, pi

from ccatp.config.models import LimitsConfig
from ccatp.control.tracker import DONE, DRIVE
from ccatp.core import DeckPose, PointId, Stop, StopKind, Verdict
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.escape import is_on_drive
from ccatp.survey.planning.legs import PlanError
from ccatp.survey.planning.search import leg_time, turn_time
from ccatp.survey.route_follower import RouteFollower, StateEstimate
from ccatp.survey.state import (
    BACKING_OFF,
    CHUNK,
    DRIVING,
    MEASURING,
    RETURNING,
    SETTLING,
    TURNING,
    MissionEvent,
    PlanHome,
    PlanPoints,
    PlanRest,
    SurveyOutcome,
    SurveyState,
)
from ccatp.survey.stops import HOLD_POSITION, MissionCommand, RetreatStep, ReturnToBase

# Points of a panel that are measured when not all can be: corners and centre, then three that determine a plane.
LEVELS = (frozenset((1, 3, 5, 7, 9)), frozenset((1, 3, 8)))
_TURN_RAD = 0.5 * pi  # taken before every leg
_DETOUR = 1.5  # the way home around the rim's steps against the straight line
_DOCKING_S = 15.0  # escape from the rim, turns on the way, the turn at base
_FIRST_S = 60.0  # planned motion before the pace is known
_LARGEST_PACE = 5.0


def home_time_s(base: DeckPose, limits: LimitsConfig, x_m: float, y_m: float) -> float:
    """An upper estimate of the way to ``base`` from a place on the deck, s; no way is planned for it."""
    length_m = _DETOUR * hypot(x_m - base.x_m, y_m - base.y_m)
    stops = 1 + int(length_m)
    return leg_time(length_m, limits) + stops * turn_time(_TURN_RAD, limits) + _DOCKING_S


class TimeBudget:
    """Compares what is left to do with what is left of ``budget_s``, first frame until home or complete."""

    def __init__(self, budget_s: float, mirror: Mirror, limits: LimitsConfig, measuring_time_s: float) -> None:
        self.budget_s = budget_s
        self._limits, self._measuring_s = limits, measuring_time_s
        self._place_of: Callable[[PointId], tuple[float, float]] = mirror.point_on_deck
        self._base = mirror.base_pose
        self._begun_s: float | None = None
        self._planned_s = 0.0
        self._next_s = 0.0

    def begin(self, t_s: float) -> None:
        """The first frame's time; again is harmless."""
        if self._begun_s is None:
            self._begun_s = t_s

    def _home_s(self, point: PointId) -> float:
        return home_time_s(self._base, self._limits, *self._place_of(point))

    def tour_s(self, x_m: float, y_m: float, points: Sequence[PointId]) -> float:
        """An estimate of the time to drive to the points in their order and to measure them."""
        total_s = 0.0
        turn_s = turn_time(_TURN_RAD, self._limits)
        for point in points:
            px, py = self._place_of(point)
            total_s += leg_time(hypot(px - x_m, py - y_m), self._limits) + turn_s + self._measuring_s
            x_m, y_m = px, py
        return total_s

    def review(self, t_s: float, pose: DeckPose, left: Sequence[PointId]) -> Sequence[PointId] | None:
        """After a point: those of the ``left`` ones, in order, to go on with (``left`` itself: all).

        None to go home now.
        """
        elapsed_s = t_s - (self._begun_s if self._begun_s is not None else t_s)
        self._planned_s += self._next_s
        self._next_s = self.tour_s(pose.x_m, pose.y_m, left[:1])
        late = elapsed_s / self._planned_s if self._planned_s > _FIRST_S else 1.0
        pace = min(max(late, 1.0), _LARGEST_PACE)
        left_s = self.budget_s - elapsed_s
        x, y = pose.x_m, pose.y_m
        if not left or pace * self.tour_s(x, y, left) <= left_s:
            return left
        if pace * (self._next_s + self._home_s(left[0])) > left_s:
            return None
        thinned: Sequence[PointId] = left
        for level in LEVELS:
            thinned = [point for point in left if point.point in level]
            if not thinned:
                return None
            if pace * (self.tour_s(x, y, thinned) + self._home_s(thinned[-1])) <= left_s:
                break
        return left if len(thinned) == len(left) else thinned


class Behaviours:
    """One frame of whatever the state says.

    ``plan_rest`` gives the way back to a route from a pose, without the points that are done with; ``plan_points`` a
    route through points from a pose, if there is such a planner.
    """

    def __init__(
        self,
        survey: SurveyState,
        budget: TimeBudget | None,
        plan_home: PlanHome,
        plan_rest: PlanRest,
        plan_points: PlanPoints | None,
    ) -> None:
        self._survey, self._budget = survey, budget
        self._plan_home, self._plan_rest, self._plan_points = plan_home, plan_rest, plan_points

    @property
    def measuring_point(self) -> PointId | None:
        """The point being measured; ``None`` for a fix that only serves to find the robot again."""
        survey = self._survey
        stop = survey.survey_route.current
        return None if survey.needs_fix or stop is None else stop.point

    def step(self, motion: StateEstimate, verdict: Verdict | None) -> MissionCommand:
        """One frame."""
        state = self._survey.state
        if motion.t_s < self._survey.stands_until_s:
            return HOLD_POSITION
        if state is DRIVING or state is TURNING:
            return self._travel(motion)
        if state is MEASURING:
            return self._stand(motion)
        if state is SETTLING:
            return self._settle(motion)
        if state is RETURNING:
            return self._return(motion)
        if state is BACKING_OFF and verdict is not None:
            return self._back_off(motion, verdict)
        return HOLD_POSITION

    # -- legs -----------------------------------------------------------------------------------------------------

    def _is_overdue(self, motion: StateEstimate) -> bool:
        follower = self._survey.follower
        stop = follower.current
        if stop is None or not follower.is_overdue(motion.t_s):
            return False
        where = f"({stop.x_m:.3f}, {stop.y_m:.3f}) m"
        self._survey.fault(f"the leg to {where} is overdue: is a wheel blocked or slipping?")
        return True

    def _travel(self, motion: StateEstimate) -> MissionCommand:
        survey = self._survey
        if survey.needs_fix:
            return self._align(motion)
        if survey.is_review_due and self._is_out_of_time(motion):
            return HOLD_POSITION
        follower = survey.survey_route
        stop = follower.current
        if stop is not None and not survey.missed.follows_route(motion, stop, follower):
            survey.is_off_route = True
        if survey.is_off_route:
            return self._find_route(motion)
        if stop is None:
            survey.proceed()
            return HOLD_POSITION
        order = self._follow(follower, motion, stop)
        if order is not None:
            return order
        if stop.is_measured or self._is_vague(motion, stop):
            survey.apply(MissionEvent.ARRIVED)
            return self._settle(motion)
        follower.advance()
        survey.proceed()
        return self._travel(motion)

    def _follow(self, follower: RouteFollower, motion: StateEstimate, stop: Stop) -> MissionCommand | None:
        survey = self._survey
        twist = follower.follow(motion, stop)
        if self._is_overdue(motion):
            return HOLD_POSITION
        phase = survey.tracker.phase
        if phase is DONE:
            return None
        if (phase is DRIVE) is not (survey.state is DRIVING):
            survey.apply(MissionEvent.TURNED if phase is DRIVE else MissionEvent.REALIGN)
        return MissionCommand(twist)

    def _align(self, motion: StateEstimate) -> MissionCommand:
        heading_recovery = self._survey.heading_recovery
        leg = heading_recovery.leg(motion.deck)
        stop = None if leg is None else leg.current
        order = None if leg is None or stop is None else self._follow(leg, motion, stop)
        if order is not None:
            return order
        heading_recovery.interrupt()
        self._survey.apply(MissionEvent.ARRIVED)
        return self._settle(motion)

    def _is_vague(self, motion: StateEstimate, stop: Stop) -> bool:
        """Whether to measure at a via point: they lie near the rim, and the next turn needs the room the route left."""
        return stop.kind is StopKind.VIA and motion.sigma_of() > self._survey.cfg.mission.via_sigma_m

    def _find_route(self, motion: StateEstimate) -> MissionCommand:
        survey, stop = self._survey, self._survey.survey_route.current
        deck = motion.deck
        if stop is not None and stop.kind is StopKind.CALIBRATE:
            if is_on_drive(survey.survey_route.stops, deck.x_m, deck.y_m):
                survey.is_off_route = False  # what was measured of the drive is not lost, and the rest of it follows
                return HOLD_POSITION
            survey.wants_calibration = True
        due = survey.retries.due[:CHUNK]
        try:
            if due and self._plan_points is not None:
                survey.route = self._plan_points(deck, due)
            else:
                survey.route = self._plan_rest(survey.route, deck, {*survey.done, *survey.skipped})
        except PlanError as error:
            survey.fault(f"no way on: {error}")
            return HOLD_POSITION
        survey.is_off_route = False
        survey.survey_route = survey.follow_stops(survey.route.stops)
        return HOLD_POSITION

    def _is_out_of_time(self, motion: StateEstimate) -> bool:
        survey, budget = self._survey, self._budget
        survey.is_review_due = False
        if budget is None:
            return False
        stops = survey.survey_route.stops[survey.survey_route.index :]
        left = survey.retries.due or [stop.point for stop in stops if stop.point is not None]
        going_on = budget.review(motion.t_s, motion.deck, left)
        if going_on is None:
            survey.abort_cause = survey.abort_cause or f"the time budget of {budget.budget_s:g} s is used up"
            survey.proceed()
            return True
        if going_on is not left:
            survey.retries.drop_low_priority(left, going_on, "no time for it")
            survey.is_off_route = True
        return False

    # -- standing -------------------------------------------------------------------------------------------------

    def _settle(self, motion: StateEstimate) -> MissionCommand:
        survey = self._survey
        if survey.settling.has_settled(motion):
            survey.apply(MissionEvent.SETTLED)
            return MissionCommand(
                HOLD_POSITION.twist, at_rest=True, arrived=survey.settling.arrival_at(self.measuring_point)
            )
        self._check_rest(motion)
        return HOLD_POSITION

    def _stand(self, motion: StateEstimate) -> MissionCommand:
        if self._survey.settling.is_due(motion):
            return MissionCommand(HOLD_POSITION.twist, measure=True)
        self._check_rest(motion)
        return HOLD_POSITION

    def _check_rest(self, motion: StateEstimate) -> None:
        if self._survey.settling.is_settle_overdue(motion.t_s):
            speeds = f"{motion.speed_m_s:.4f} m/s, {motion.rate_rad_s:.4f} rad/s"
            self._survey.fault(f"the robot does not come to rest: {speeds}")

    # -- edge and home --------------------------------------------------------------------------------------------

    def _back_off(self, motion: StateEstimate, verdict: Verdict) -> MissionCommand:
        survey = self._survey
        retreat = survey.retreat
        if retreat is None:
            survey.proceed()
            return HOLD_POSITION
        twist = retreat.step(motion, verdict)
        if retreat.step_at is RetreatStep.TURN_AWAY and survey.abort_cause:
            retreat.step_at = RetreatStep.OVER  # there is no route to turn to; the way home begins from here
        if retreat.step_at is RetreatStep.STUCK:
            survey.hold("stuck at the edge: no motion away from it is permitted, or none helps", by_hand=False)
            survey.stuck_s = motion.t_s
            return HOLD_POSITION
        if retreat.step_at is RetreatStep.OVER:
            survey.apply(MissionEvent.FIND)
            return HOLD_POSITION
        return MissionCommand(twist)

    def _return(self, motion: StateEstimate) -> MissionCommand:
        survey = self._survey
        if survey.home is None:
            try:
                survey.home = ReturnToBase(survey.follow_stops(self._plan_home(motion.deck)), survey.tracker)
            except PlanError as error:
                survey.fault(f"no way home: {error}")
            return HOLD_POSITION
        if survey.home.is_at_base:
            survey.outcome = SurveyOutcome.AT_BASE
            survey.apply(MissionEvent.FINISHED)
            return MissionCommand(HOLD_POSITION.twist, at_rest=True)
        twist = survey.home.step(motion, survey.settling.is_quiet(motion))
        return HOLD_POSITION if self._is_overdue(motion) else MissionCommand(twist)
