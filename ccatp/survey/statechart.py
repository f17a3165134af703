"""The statechart of a survey: from pose, verdict and events to the next state and a command. Pure."""

from collections.abc import Sequence
from math import hypot

from msgspec.structs import replace

from ccatp.conditions import Clear, find_condition, text_of
from ccatp.conditions import mission as conditions
from ccatp.config.models import Config
from ccatp.control.tracker import LegPhase
from ccatp.core import NO_CAUSE, Cause, EventCode, PointId, Stop, StopKind, Verdict
from ccatp.mirror.mirror import Mirror
from ccatp.safety.escalation import limit_s
from ccatp.survey.behaviours import (
    HOLD_POSITION,
    STILL,
    Measuring,
    MissionCommand,
    RequestState,
    Retreat,
    RetreatStep,
    ReturnHome,
    Settling,
)
from ccatp.survey.budget import BudgetProgress, TimeBudget
from ccatp.survey.engagement import (
    Earthquake,
    EngagedMission,
    EngagementRules,
    Event,
    Faulted,
    Kind,
    Paused,
    Ready,
    enter,
)
from ccatp.survey.events import (
    EmergencyKnown,
    EmergencyLatched,
    EstimateDiverged,
    FixFailed,
    FixStored,
    PointMissed,
    SurveyInput,
    SurveyOutcome,
    TakenOver,
    TrackingGap,
)
from ccatp.survey.failsafe import ROWS
from ccatp.survey.planning.escape import is_on_drive
from ccatp.survey.planning.legs import PlanError
from ccatp.survey.planning.route import Route, RoutePlanner
from ccatp.survey.points import PointLog
from ccatp.survey.route_follower import Leg, LegFollower, StateEstimate
from ccatp.survey.state import (
    Corrected,
    Found,
    Located,
    Lost,
    Missed,
    OffRoute,
    OnLeg,
    OnRoute,
    Returning,
    ShowHeading,
    SurveyPhase,
    SurveyState,
    Travel,
    Unconfirmed,
)

# Time after a fix until the danger loop has judged the new pose: a pose every five frames, and a verdict.
_NOTICED_S = 0.2
# Number of points planned at once; planning a route through more would take too long within a frame.
CHUNK = 12
# Legs that show the heading: forth and back, twice. A heading that is far off needs more than one pair.
MOST_LEGS = 4
# Multiple of ``heading_doubt_rad`` beyond which the heading is determined before the next leg.
_LOST = 2.0

# Fields of the state that another process keeps unchanged.
_KEPT = (
    *("abort_cause", "full_fans", "finding", "emergency_epoch", "corrections", "request", "failures"),
    *("was_reverse", "backoffs"),
)

_SURE_SIGMAS = 3.0
_LONG_TURN_S = 1.0  # 0.7 rad; a turn that only corrects the creep of the last one is shorter

Step = tuple[SurveyState, MissionCommand]


class Survey(EngagementRules[SurveyState]):
    """The constant parts of a survey, and the transitions from one state to the next."""

    rows = ROWS

    def __init__(self, cfg: Config, mirror: Mirror, route: Route, planner: RoutePlanner) -> None:
        self.cfg, self._route, self.planner = cfg, route, planner
        self._points = tuple(stop.point for stop in route.stops if stop.point is not None)
        self.follower = LegFollower(mirror, cfg)
        row = conditions.STUCK_AT_EDGE
        self.stuck_limit_s = limit_s(find_condition(row.name) or row, cfg.health)
        self._budget: TimeBudget | None = None
        if cfg.mission.holds_to_budget:
            self._budget = TimeBudget(cfg.run.budget_s, mirror, cfg.limits, cfg.etalon.measuring_time_s)
        self._vague_m = cfg.mission.arrival_tolerance_m / _SURE_SIGMAS
        self._is_steered_bare = not (cfg.control.predicts_delay and cfg.control.compensates_creep)

    def begin(self, done: Sequence[PointId] = ()) -> SurveyState:
        """The state before the first frame; ``done``: points measured in earlier runs."""
        pose = Unconfirmed() if self.cfg.mission.fix_at_start else Located()
        return SurveyState(route=self._route, pose=pose, points=PointLog(tuple(done)))

    def left_out(self, s: SurveyState) -> dict[PointId, str]:
        """Points that were skipped, or will not be measured any more, with the reason."""
        out = s.points.causes
        if s.kind is Kind.OVER:
            # What held the robot when an operator stopped it is not why the mission ended.
            why, over = text_of(s.cause) or str(s.outcome), {*s.points.done, *out}
            if s.outcome is SurveyOutcome.STOPPED:
                why = "stopped by an operator"
            elif s.cause.condition == conditions.OPERATOR.name:
                why = "aborted by an operator"
            out |= {point: why for point in self._points if point not in over}
        return out

    # -- frames -----------------------------------------------------------------------------------------------------

    def step(self, s: SurveyState, motion: StateEstimate, verdict: Verdict | None) -> Step:
        """One frame: react to the verdict in force (``None``: none is fresh enough), then act by the mode."""
        if self._is_steered_bare:
            control = self.cfg.control
            motion = replace(
                motion,
                creep=motion.creep if control.compensates_creep else (0.0, 0.0),
                ahead=motion.ahead if control.predicts_delay else None,
            )
        if s.budget.begun_s is None:
            s = replace(s, budget=s.budget._replace(begun_s=motion.t_s))
        if isinstance(s.pose, Found):
            # At an edge, stand until the danger loop has judged the new pose: the edge may have been a seam.
            is_at_edge = verdict is not None and verdict.code is EventCode.NEAR_EDGE
            s = replace(s, pose=Located(motion.t_s + _NOTICED_S) if is_at_edge else Located())
        s = self.react(s, motion, verdict)
        # Also a mission that is ready, held, paused or over stands.
        s, command = self._act(s, motion, verdict) if motion.t_s >= s.stands_until_s else (s, HOLD_POSITION)
        if command.twist is not STILL and not any(s.permits(verdict)):
            command = replace(command, twist=STILL)
        if s.inflates_covariance:
            s, command = replace(s, inflates_covariance=False), replace(command, inflates_covariance=True)
        return s, command

    def _act(self, s: SurveyState, motion: StateEstimate, verdict: Verdict | None) -> Step:
        match s.phase:
            case Travel():
                return self._travel(s, motion)
            case ShowHeading():
                return self._show_heading(s, motion)
            case Measuring() as measuring:
                return self._measure(s, measuring, motion)
            case Settling() as settling:
                return self._settle(s, settling, motion)
            case Returning(way):
                return self._return(s, way, motion)
            case Retreat() as retreat if verdict is not None:
                return self._back_off(s, retreat, motion, verdict)
        return s, HOLD_POSITION

    # -- transitions --------------------------------------------------------------------------------------------------

    def lose_pose(self, s: SurveyState, *, doubts_odometry: bool = True) -> SurveyState:
        """Relocalize before the next move; ``doubts_odometry`` inflates the covariance."""
        return replace(s, pose=Lost(MOST_LEGS), inflates_covariance=s.inflates_covariance or doubts_odometry)

    def proceed(self, s: SurveyState) -> SurveyState:
        """Change to the next task: relocalize, go home, drive to the next stop, or finish."""
        s = replace(
            s,
            inflates_covariance=s.inflates_covariance or s.rejects_odometry,
            # After a hold the robot may be anywhere, so that the route's next turn may not be safe.
            course=OffRoute() if s.is_held else s.course,
        )
        if s.needs_fix:
            return enter(s, Event.GO_ON, Settling())
        if s.abort_cause:
            # The way home is planned again from where the robot is now.
            return enter(replace(s, cause=s.abort_cause), Event.GO_HOME, Returning())
        if s.stop is None:
            points = s.points if s.points.due else s.points.begin_second_round()
            if not points.due:
                return self.finish(s, SurveyOutcome.COMPLETE)
            s = replace(s, points=points, course=OffRoute())
        return enter(replace(s, cause=NO_CAUSE), Event.GO_ON, Travel())

    def change_speed(self, s: SurveyState, *, is_slow: bool) -> SurveyState:
        """Reduce the speed now, or return to the usual speed with the next leg."""
        s = replace(s, is_slow=is_slow)
        if is_slow and isinstance(s.phase, Travel):
            return replace(s, phase=Travel())
        if is_slow and isinstance(s.phase, Returning) and s.phase.way is not None:
            return replace(s, phase=Returning(s.phase.way.interrupted()))
        return s

    def retreat(self, s: SurveyState, frame: StateEstimate, verdict: Verdict) -> SurveyState:
        """Back off; at the same edge again and again it is a fault."""
        if frame.t_s < s.stands_until_s:
            return s
        mission, backoffs = self.cfg.mission, s.backoffs + 1
        if backoffs > mission.max_backoffs_per_stop:
            cause = conditions.BACK_OFFS.cause(count=mission.max_backoffs_per_stop)
            return self.meet(replace(s, backoffs=0), cause)
        s = replace(
            s,
            backoffs=backoffs,
            # At an edge again after a fix of the position: the heading must be wrong.
            inflates_covariance=s.inflates_covariance or backoffs > 1,
            cause=verdict.cause,
            # The route avoids edges, so the pose is wrong: relocalize before moving on.
            pose=s.pose if isinstance(s.pose, Lost) else Lost(),
        )
        return enter(s, Event.EDGE, Retreat.begin(mission, verdict, frame.pose, frame.rate_rad_s))

    # -- legs ---------------------------------------------------------------------------------------------------------

    def _travel(self, s: SurveyState, motion: StateEstimate) -> Step:
        if motion.gap_s > 0.0 and self._is_unsupported(s, motion):
            return self._find(s), HOLD_POSITION
        if s.needs_fix:
            return enter(s, Event.GO_ON, Settling()), HOLD_POSITION
        if s.budget.is_review_due:
            s, goes_on = self._review_time(s, motion)
            if not goes_on:
                return s, HOLD_POSITION
        stop = s.stop
        if stop is not None:
            s = self._correct(s, motion, stop)
        if isinstance(s.course, OffRoute):
            return self._find_route(s, motion)
        if stop is None:
            return self.proceed(s), HOLD_POSITION
        s, command = self._follow(s, motion, stop)
        if command is not None:
            return s, command
        # Via points lie near the rim, where the turn needs the clearance that the route planned.
        is_vague = stop.kind is StopKind.VIA and motion.sigma_m > self.cfg.mission.via_sigma_m
        if stop.is_measured or is_vague:
            return self._arrive(s, motion)
        s = self.proceed(replace(s, stop_index=s.stop_index + 1))
        return self._travel(s, motion) if isinstance(s.phase, Travel) else (s, HOLD_POSITION)

    def _is_unsupported(self, s: SurveyState, motion: StateEstimate) -> bool:
        """Whether a gap of the encoder samples leaves the pose too uncertain for the leg.

        On the way to a point its arrival has to be certain, on the way home the clearance from the rim.
        """
        mission, leg = self.cfg.mission, _leg_of(s.phase)
        limit_m = mission.arrival_tolerance_m
        aside_m = self.follower.distance_m(s.stop if leg is None else leg.stop, motion.pose)
        if s.kind is Kind.HOME:
            limit_m, aside_m = mission.leg_clearance_m, mission.longest_leg_m
        return _SURE_SIGMAS * hypot(motion.sigma_m, aside_m * motion.heading_sigma_rad) > limit_m

    def _find(self, s: SurveyState) -> SurveyState:
        """Stand for a fix, which needs no motion."""
        return enter(self.lose_pose(s, doubts_odometry=False), Event.GO_ON, Settling())

    def _without_way(self, s: SurveyState, cause: Cause) -> SurveyState:
        """No way leads on: the estimate may be wrong, so a fix comes before giving up."""
        if s.is_confirmed:
            return self.meet(replace(s, is_confirmed=False), cause)
        return self._find(replace(s, is_confirmed=True))

    def _follow(self, s: SurveyState, motion: StateEstimate, stop: Stop) -> tuple[SurveyState, MissionCommand | None]:
        """One frame of the leg to a stop; no command when the stop is reached."""
        before = leg = _leg_of(s.phase)
        if leg is None:
            after = s.route.stops[s.stop_index + 1 : s.stop_index + 2] if stop is s.stop else ()
            leg = self.follower.begin(motion, stop, *after)
        leg, twist = self.follower.follow(leg, motion, is_slow=s.is_slow)
        if motion.t_s > leg.deadline_s:
            return self._overdue(s, stop), HOLD_POSITION
        if leg.motion is None or leg.motion.phase is LegPhase.DONE:
            return s, None
        if leg.motion.phase is LegPhase.DRIVE and self._is_vague(before, motion):
            return self._arrive(replace(s, pose=Unconfirmed()), motion)
        return _on_leg(s, leg), MissionCommand(twist)

    def _is_vague(self, leg: Leg | None, motion: StateEstimate) -> bool:
        """Whether the turn of a leg, now over, needs a fix before the robot drives.

        Creep made the position uncertain, and the leg is long or ends at the rim.
        """
        if leg is None or leg.motion is None or leg.motion.phase is not LegPhase.TURN:
            return False
        if leg.stop.point is None or motion.sigma_m <= self._vague_m:
            return False
        is_long = leg.motion.planned_s > _LONG_TURN_S
        follower, reach_m = self.follower, self.cfg.mission.correction_reach_m
        return is_long and (follower.is_at_rim(leg.stop) or follower.distance_m(leg.stop, motion.pose) > reach_m)

    def _overdue(self, s: SurveyState, stop: Stop) -> SurveyState:
        return self.meet(s, conditions.LEG_OVERDUE.cause(x_m=stop.x_m, y_m=stop.y_m))

    def _arrive(self, s: SurveyState, motion: StateEstimate) -> Step:
        settling = Settling()
        return self._settle(replace(s, phase=settling), settling, motion)

    def _show_heading(self, s: SurveyState, motion: StateEstimate) -> Step:
        if motion.gap_s > 0.0 and self._is_unsupported(s, motion):
            return self._find(s), HOLD_POSITION
        leg = _leg_of(s.phase)
        if leg is None:
            deck = self.follower.deck_pose(motion)
            stop = self.follower.heading_leg(deck, motion.heading_sigma_rad, was_reverse=s.was_reverse)
            legs_left = s.pose.legs_left - 1 if isinstance(s.pose, Lost) and stop is not None else 0
            pose = Lost(max(legs_left, 0)) if isinstance(s.pose, Lost) else s.pose
            if stop is None:
                return self._arrive(replace(s, pose=pose), motion)
            leg = Leg(stop)
            s = replace(s, pose=pose, was_reverse=stop.reverse, phase=ShowHeading(leg))
        s, command = self._follow(s, motion, leg.stop)
        return self._arrive(s, motion) if command is None else (s, command)

    def _correct(self, s: SurveyState, motion: StateEstimate, stop: Stop) -> SurveyState:
        """Plan a correction after a missed point; after a correction, check that the next turn is safe."""
        if isinstance(s.course, Missed):
            panel = motion.pose.panel
            aim = self.follower.correction(motion.pose, self.follower.target_in(panel, stop))
            if aim is None:
                return replace(s, course=OffRoute())
            leg = Leg(stop, aim=(panel, aim))
            return replace(s, course=Corrected(stop), phase=Travel(leg), corrections=s.corrections + 1)
        if not isinstance(s.course, Corrected) or s.course.stop is stop:
            return s
        is_safe = self.follower.can_proceed(self.follower.deck_pose(motion), stop)
        return replace(s, course=OnRoute() if is_safe else OffRoute())

    def _find_route(self, s: SurveyState, motion: StateEstimate) -> Step:
        stop, deck, due, command = s.stop, self.follower.deck_pose(motion), s.points.due[:CHUNK], HOLD_POSITION
        if stop is not None and stop.kind is StopKind.CALIBRATE:
            if is_on_drive(s.route.stops, deck.x_m, deck.y_m):
                # Still on the calibration drive: continue it.
                return replace(s, course=OnRoute()), command
            command = replace(command, skips_calibration=True)
        try:
            planner, over = self.planner, {*s.points.done, *s.points.skipped}
            route = planner.route(deck, due) if due else planner.rejoin(s.route, deck, over)
        except PlanError as error:
            return self._without_way(s, conditions.NO_WAY_ON.cause(why=error)), command
        s = replace(s, route=route, stop_index=0, phase=Travel(), course=OnRoute(), is_confirmed=False)
        return s, command

    def _review_time(self, s: SurveyState, motion: StateEstimate) -> tuple[SurveyState, bool]:
        """After a point, leave out the points for which there is no time; false if the robot has to go home now."""
        budget = self._budget
        s = replace(s, budget=s.budget._replace(is_review_due=False))
        if budget is None:
            return s, True
        rest = s.route.stops[s.stop_index :]
        left: Sequence[PointId] = s.points.due or [stop.point for stop in rest if stop.point is not None]
        deck = self.follower.deck_pose(motion)
        progress = budget.progress(s.budget, deck, left)
        going_on = budget.review(progress, motion.t_s, deck, left)
        s = replace(s, budget=progress)
        if going_on is None:
            s = self.meet(s, conditions.TIME_USED_UP.cause(budget_s=budget.budget_s))
            return s, isinstance(s.phase, Travel)
        if going_on is left:
            return s, True
        dropped = set(left).difference(going_on)
        points = s.points.give_up([point for point in left if point in dropped], "no time for it", going_on)
        return replace(s, points=points, course=OffRoute()), True

    # -- standing -----------------------------------------------------------------------------------------------------

    def _settle(self, s: SurveyState, settling: Settling, motion: StateEstimate) -> Step:
        settling = settling.update(self.cfg.control, motion)
        if not settling.standstill.is_rest:
            return self._check_rest(s, settling, motion), HOLD_POSITION
        point = s.measuring_point
        arrived = None if point is None or point == s.arrived_at else point
        measuring = Measuring.begin(settling, motion.t_s, self.cfg.etalon.measuring_time_s)
        s = replace(s, phase=measuring, arrived_at=s.arrived_at if arrived is None else arrived)
        return s, MissionCommand(STILL, at_rest=True, arrived=arrived)

    def _measure(self, s: SurveyState, measuring: Measuring, motion: StateEstimate) -> Step:
        measuring, is_due = measuring.update(self.cfg.control, self.cfg.etalon.measuring_time_s, motion)
        if is_due:
            return replace(s, phase=measuring, request=s.request + 1), MissionCommand(STILL, measure=True)
        return self._check_rest(s, measuring, motion), HOLD_POSITION

    def _check_rest(self, s: SurveyState, standing: Settling | Measuring, motion: StateEstimate) -> SurveyState:
        if standing.rest_by_s is not None and motion.t_s > standing.rest_by_s:
            return self.meet(s, conditions.NO_REST.cause(v_m_s=motion.speed_m_s, omega_rad_s=motion.rate_rad_s))
        return replace(s, phase=standing)

    # -- edge and home ------------------------------------------------------------------------------------------------

    def _back_off(self, s: SurveyState, retreat: Retreat, motion: StateEstimate, verdict: Verdict) -> Step:
        mission = self.cfg.mission
        retreat, twist = retreat.update(mission, self.follower.tracker, motion, verdict, is_slow=s.is_slow)
        # After an abort no turn away is needed: the way home is planned from here.
        if retreat.step is RetreatStep.OVER or (retreat.step is RetreatStep.TURN_AWAY and s.abort_cause):
            return enter(s, Event.GO_ON, Settling()), HOLD_POSITION
        if retreat.step is RetreatStep.STUCK:
            return self.meet(s, conditions.STUCK_AT_EDGE.cause(), stuck_s=motion.t_s), HOLD_POSITION
        return replace(s, phase=retreat), MissionCommand(twist)

    def _return(self, s: SurveyState, way: ReturnHome | None, motion: StateEstimate) -> Step:
        if motion.gap_s > 0.0 and self._is_unsupported(s, motion):
            return self._find(s), HOLD_POSITION
        if way is None:
            try:
                stops = self.planner.home(self.follower.deck_pose(motion))
            except PlanError as error:
                return self._without_way(s, conditions.NO_WAY_HOME.cause(why=error)), HOLD_POSITION
            return replace(s, phase=Returning(ReturnHome(stops)), is_confirmed=False), HOLD_POSITION
        if way.is_at_base:
            return self.finish(s, SurveyOutcome.AT_BASE), MissionCommand(STILL, at_rest=True)
        way, twist = way.update(self.follower, self.cfg.control, motion, is_slow=s.is_slow)
        if way.leg is not None and motion.t_s > way.leg.deadline_s:
            return self._overdue(s, way.leg.stop), HOLD_POSITION
        return replace(s, phase=Returning(way)), MissionCommand(twist)

    # -- events between two frames ------------------------------------------------------------------------------------

    def handle(self, s: SurveyState, event: SurveyInput) -> tuple[SurveyState, str | None]:
        """The state after an event between two frames, and why it was refused, or ``None``."""
        match event:
            case EstimateDiverged(cause, t_s):
                s = self._recover(s, cause, t_s)
            case TrackingGap():
                s = self.lose_pose(s, doubts_odometry=False)
            case EmergencyKnown():
                s = replace(s, emergency_epoch=None)
            case EmergencyLatched(is_shaking):
                s = replace(s, is_latched=True, earthquake=Earthquake.LATCHED if is_shaking else Earthquake.NONE)
            case TakenOver():
                s = self._take_over(s, event)
            case FixStored():
                s = self._fixed(s, event)
            case FixFailed():
                s = self._not_fixed(s, event)
            case PointMissed():
                is_wanted = s.is_awaiting_fix
                s = self.proceed(s) if is_wanted else s
                s = replace(s, course=Missed() if is_wanted and not isinstance(s.course, OffRoute) else OffRoute())
            case _:
                return super().handle(s, event)
        return s, None

    def _take_over(self, s: SurveyState, event: TakenOver) -> SurveyState:
        """The state for a new process: without behaviour, times and the last verdict."""
        measured, skipped, elapsed_s, is_new_run = event
        if is_new_run:
            if s.kind is Kind.OVER and s.outcome is not SurveyOutcome.STOPPED:
                s = self.begin()
            budget = BudgetProgress(is_review_due=s.budget.is_review_due)
            s = replace(s, points=PointLog(), failures=0, budget=budget)
        held = Faulted() if s.is_faulted and not is_new_run else Paused()
        return SurveyState(
            route=self._route,
            phase=held if s.is_held_by_hand else Ready(),
            cause=s.cause if s.is_held_by_hand else NO_CAUSE,
            pose=Lost(MOST_LEGS),
            points=s.points.take_over(measured, skipped),
            budget=s.budget._replace(begun_s=None, before_s=elapsed_s),
            **{name: getattr(s, name) for name in _KEPT},
        )

    def _recover(self, s: SurveyState, cause: Cause, t_s: float) -> SurveyState:
        """Hold and relocalize; repeated divergence is a fault."""
        if s.kind is Kind.OVER or s.is_held_by_hand:
            return s
        health = self.cfg.health
        times_s = [since_s for since_s in s.recoveries_s if t_s - since_s <= health.retry_window_s]
        if times_s and t_s - times_s[-1] <= health.pause_limit_s:
            times_s.pop()  # still the same divergence, which is reported in every frame
        s = replace(s, recoveries_s=(*times_s, t_s))
        row = find_condition(cause.condition)
        retries = health.retries if row is None or row.retries is None else row.retries
        if len(s.recoveries_s) > 1 + retries:
            return self.fault(s, cause, loses_pose=True)
        # A frozen filter does not show when the robot stands, so the hold lasts for a fixed time.
        return self.meet(s, cause, usual=Clear.AFTER_FIX, until_s=t_s + health.retry_after_s)

    def _fixed(self, s: SurveyState, event: FixStored) -> SurveyState:
        s, point = replace(s, failures=0), event.point
        if point is not None:
            is_new = point not in s.points.done
            return self._leave_stop(
                replace(s, points=s.points.measure(point)), point, event.heading_sigma_rad, is_new=is_new
            )
        if not s.needs_fix:
            return self._leave_pointless(s, event.heading_sigma_rad)
        # The heading has to be certain before the robot drives on.
        is_certain = event.heading_sigma_rad <= self.cfg.mission.heading_doubt_rad
        if isinstance(s.pose, Lost) and s.pose.legs_left > 0 and not is_certain:
            return enter(s, Event.GO_ON, ShowHeading()) if s.is_awaiting_fix else s
        # After relocalizing, the robot is not on the route. After a confirmation it is.
        kept = s.course if isinstance(s.course, Corrected) else OnRoute()
        goes_on, s = s.is_awaiting_fix, replace(s, pose=Found(), course=OffRoute() if s.is_lost else kept)
        return self.proceed(s) if goes_on else s

    def _not_fixed(self, s: SurveyState, event: FixFailed) -> SurveyState:
        point, cause, sigma_rad = event
        if point is None and not s.needs_fix:
            return self._leave_pointless(s, sigma_rad)  # the survey does not need this fix
        limit, failures = self.cfg.mission.failed_points_before_hold, s.failures + 1
        s = replace(s, failures=0 if failures >= limit else failures)
        if point is None:
            if failures >= limit:
                return self.meet(s, conditions.NOT_FOUND.cause(why=cause))
            if isinstance(s.phase, Measuring):  # this fix is needed; the robot may not have stood quite still
                s = replace(s, phase=replace(s.phase, request=RequestState.FAILED))
            return s
        is_new, s = point not in s.points.skipped, replace(s, points=s.points.fail(point, cause))
        if failures >= limit:
            s = self.meet(s, conditions.MEASUREMENTS_FAILED.cause(count=limit, why=cause))
        return self._leave_stop(s, point, sigma_rad, is_new=is_new)

    def _leave_pointless(self, s: SurveyState, heading_sigma_rad: float) -> SurveyState:
        """Continue after a fix, or a failed fix, at a stop without a point."""
        stop = s.stop
        if s.is_awaiting_fix and stop is not None and stop.kind in (StopKind.CALIBRATE, StopKind.VIA):
            s = replace(s, stop_index=s.stop_index + 1)
            return self.proceed(self._doubt_heading(s, heading_sigma_rad))
        return s

    def _doubt_heading(self, s: SurveyState, heading_sigma_rad: float) -> SurveyState:
        """Determine the heading before the robot drives on, if a fix leaves it too uncertain."""
        if heading_sigma_rad > _LOST * self.cfg.mission.heading_doubt_rad and not isinstance(s.pose, Unconfirmed):
            phase = ShowHeading() if isinstance(s.phase, Travel) else s.phase
            return replace(s, pose=Lost(MOST_LEGS), phase=phase)
        return s

    def _leave_stop(self, s: SurveyState, point: PointId, heading_sigma_rad: float, *, is_new: bool) -> SurveyState:
        """Continue after a point is measured, or failed; ``is_new``: it was not so before."""
        goes_on, stop = s.is_awaiting_fix, s.stop
        # A pause, and a new route to the point, may come while the fix is being stored. The fix counts all the same.
        is_here = stop is not None and stop.point == point
        if is_here or is_new:
            s = replace(s, backoffs=0, budget=s.budget._replace(is_review_due=self._budget is not None))
            if not is_here:
                s = replace(s, course=OffRoute())  # the planned route leads to the point again
            elif isinstance(s.phase, Travel):
                s = replace(s, stop_index=s.stop_index + 1, phase=Travel())
            else:
                s = replace(s, stop_index=s.stop_index + 1)
            s = self._doubt_heading(s, heading_sigma_rad)
            # A robot that was pushed meanwhile waits for another measurement, which is not needed any more.
            goes_on |= isinstance(s.phase, Settling | Measuring)
        return self.proceed(s) if goes_on else s


def _leg_of(phase: SurveyPhase) -> Leg | None:
    return phase.leg if isinstance(phase, OnLeg) else None


def _on_leg(s: SurveyState, leg: Leg) -> SurveyState:
    return replace(s, phase=replace(s.phase, leg=leg)) if isinstance(s.phase, OnLeg) else s


class Mission(EngagedMission[SurveyState]):
    """A running survey."""

    def __init__(self, survey: Survey, state: SurveyState | None = None) -> None:
        super().__init__(survey, state or survey.begin())
        self.survey = survey

    def step(self, motion: StateEstimate, verdict: Verdict | None) -> MissionCommand:
        """One frame."""
        self._state, command = self.survey.step(self._state, motion, verdict)
        return command
