"""The statechart of a survey: from pose, verdict and events to the next state and a command. Pure."""

from collections.abc import Sequence
from math import hypot

from msgspec.structs import replace

from ccatp import conditions
from ccatp.conditions import text_of
from ccatp.config.models import Config
from ccatp.control.tracker import LegPhase
from ccatp.core import NO_CAUSE, Cause, EventCode, PointId, Stop, StopKind, Verdict
from ccatp.mirror.mirror import Mirror
from ccatp.survey.behaviours import (
    HOLD_POSITION,
    STILL,
    MissionCommand,
    Retreat,
    RetreatStep,
    ReturnHome,
    Settling,
)
from ccatp.survey.budget import BudgetProgress, TimeBudget
from ccatp.survey.events import (
    BACKING_OFF,
    DONE,
    DRIVING,
    HELD,
    IDLE,
    MEASURING,
    RETURNING,
    SETTLING,
    TURNING,
    EmergencyKnown,
    EstimateDiverged,
    FixFailed,
    FixStored,
    MissionEvent,
    PointMissed,
    SurveyInput,
    SurveyOutcome,
    TakenOver,
    TrackingGap,
    next_state,
)
from ccatp.survey.failsafe import ROWS
from ccatp.survey.planning.escape import is_on_drive
from ccatp.survey.planning.legs import PlanError
from ccatp.survey.planning.route import Route, RoutePlanner
from ccatp.survey.route_follower import Leg, LegFollower, StateEstimate
from ccatp.survey.state import FixNeed, Hold, HoldRules, SurveyState

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
    *("abort_cause", "full_fans", "finding", "emergency_epoch", "retried", "is_off_route", "is_review_due"),
    *("corrections", "request", "failures", "was_reverse", "backoffs"),
)

_SURE_SIGMAS = 3.0
_LONG_TURN_S = 1.0  # 0.7 rad; a turn that only corrects the creep of the last one is shorter

Step = tuple[SurveyState, MissionCommand]


class Survey(HoldRules[SurveyState]):
    """The constant parts of a survey, and the transitions from one state to the next."""

    rows = ROWS

    def __init__(self, cfg: Config, mirror: Mirror, route: Route, planner: RoutePlanner) -> None:
        self.cfg, self._route, self.planner = cfg, route, planner
        self._points = tuple(stop.point for stop in route.stops if stop.point is not None)
        self.follower = LegFollower(mirror, cfg)
        self._budget: TimeBudget | None = None
        if cfg.mission.holds_to_budget:
            self._budget = TimeBudget(cfg.run.budget_s, mirror, cfg.limits, cfg.etalon.measuring_time_s)
        self._vague_m = cfg.mission.arrival_tolerance_m / _SURE_SIGMAS
        self._is_steered_bare = not (cfg.control.predicts_delay and cfg.control.compensates_creep)

    def begin(self) -> SurveyState:
        """The state before the first frame."""
        return SurveyState(route=self._route, fix=FixNeed.CONFIRM if self.cfg.mission.fix_at_start else FixNeed.NONE)

    def left_out(self, s: SurveyState) -> dict[PointId, str]:
        """Points that were skipped, or will not be measured any more, with the reason."""
        out = dict(s.failure_causes)
        if s.mode is DONE:
            why, over = text_of(s.cause) or str(s.outcome), {*s.done, *out}
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
        if s.is_found:
            # At an edge, stand until the danger loop has judged the new pose: the edge may have been a seam.
            is_at_edge = verdict is not None and verdict.code is EventCode.NEAR_EDGE and s.fix is FixNeed.NONE
            until_s = motion.t_s + _NOTICED_S if is_at_edge else s.stands_until_s
            s = replace(s, is_found=False, stands_until_s=until_s)
        s = self.react(s, motion, verdict)
        mode, command = s.mode, HOLD_POSITION
        if motion.t_s >= s.stands_until_s:
            if mode is DRIVING or mode is TURNING:
                s, command = self._travel(s, motion)
            elif mode is MEASURING:
                s, command = self._measure(s, motion)
            elif mode is SETTLING:
                s, command = self._settle(s, motion)
            elif mode is RETURNING:
                s, command = self._return(s, motion)
            elif mode is BACKING_OFF and verdict is not None:
                s, command = self._back_off(s, motion, verdict)
        if s.inflates_covariance:
            s, command = replace(s, inflates_covariance=False), replace(command, inflates_covariance=True)
        return s, command

    # -- transitions --------------------------------------------------------------------------------------------------

    def hold(self, s: SurveyState, cause: Cause, *, by_hand: bool, is_fault: bool = False) -> SurveyState:
        """Hold, and drop the current behaviour, which begins again afterwards."""
        return super().hold(replace(s, behaviour=None, is_missed=False), cause, by_hand=by_hand, is_fault=is_fault)

    def fault(self, s: SurveyState, cause: Cause, *, loses_pose: bool = False) -> SurveyState:
        """Hold until an operator resumes; with ``loses_pose`` the robot relocalizes then."""
        if loses_pose and s.fix is FixNeed.NONE and s.mode is not DONE:
            s = self.lose_pose(s)
        return super().fault(s, cause)

    def lose_pose(self, s: SurveyState, *, doubts_odometry: bool = True) -> SurveyState:
        """Relocalize before the next move; ``doubts_odometry`` inflates the covariance."""
        return replace(
            s,
            fix=FixNeed.RELOCALIZE,
            heading_legs_left=MOST_LEGS,
            inflates_covariance=s.inflates_covariance or doubts_odometry,
        )

    def proceed(self, s: SurveyState) -> SurveyState:
        """Change to the next task: relocalize, go home, drive to the next stop, or finish."""
        s = replace(
            s,
            behaviour=None,
            is_missed=False,
            inflates_covariance=s.inflates_covariance or s.rejects_odometry,
            hold=s.hold._replace(is_fault=False),
            # After a hold the robot may be anywhere, so that the route's next turn may not be safe.
            is_off_route=s.is_off_route or s.mode is HELD,
        )
        if s.fix is not FixNeed.NONE:
            return self.apply(s, MissionEvent.FIND)
        if s.abort_cause:
            # The way home is planned again from where the robot is now.
            return self.apply(replace(s, cause=s.abort_cause), MissionEvent.GO_HOME)
        if s.stop is None:
            s = self._begin_second_round(s)
            if not s.due:
                return self.apply(replace(s, outcome=SurveyOutcome.COMPLETE), MissionEvent.FINISHED)
        return self.apply(replace(s, cause=NO_CAUSE), MissionEvent.GO_ON)

    def _begin_second_round(self, s: SurveyState) -> SurveyState:
        """Failed points that were not tried again yet are due; the last first, because the robot is nearest to it."""
        due, retried = s.due, s.retried
        if not due:
            due = tuple(point for point in reversed(tuple(s.failure_causes)) if point not in retried)
            retried = retried.union(due)
        return replace(s, due=due, retried=retried, is_off_route=s.is_off_route or bool(due))

    # -- legs ---------------------------------------------------------------------------------------------------------

    def _travel(self, s: SurveyState, motion: StateEstimate) -> Step:
        if motion.gap_s > 0.0 and self._is_unsupported(s, motion):
            return self._find(s), HOLD_POSITION
        if s.fix is not FixNeed.NONE:
            return self._show_heading(s, motion)
        if s.is_review_due:
            s, goes_on = self._review_time(s, motion)
            if not goes_on:
                return s, HOLD_POSITION
        stop = s.stop
        if stop is not None and (s.is_missed or s.corrected is not None):
            s = self._correct(s, motion, stop)
        if s.is_off_route:
            return self._find_route(s, motion), HOLD_POSITION
        if stop is None:
            return self.proceed(s), HOLD_POSITION
        s, command = self._follow(s, motion, stop)
        if command is not None:
            return s, command
        # Via points lie near the rim, where the turn needs the clearance that the route planned.
        is_vague = stop.kind is StopKind.VIA and motion.sigma_of() > self.cfg.mission.via_sigma_m
        if stop.is_measured or is_vague:
            return self._arrive(s, motion)
        s = self.proceed(replace(s, stop_index=s.stop_index + 1))
        return self._travel(s, motion)

    def _is_unsupported(self, s: SurveyState, motion: StateEstimate) -> bool:
        """Whether a gap of the encoder samples leaves the pose too uncertain for the leg.

        On the way to a point its arrival has to be certain, on the way home the clearance from the rim.
        """
        mission, behaviour = self.cfg.mission, s.behaviour
        stop = behaviour.stop if isinstance(behaviour, Leg) else s.stop
        limit_m, aside_m = mission.arrival_tolerance_m, self.follower.distance_m(stop, motion.pose)
        if s.mode is RETURNING:
            limit_m, aside_m = mission.leg_clearance_m, mission.longest_leg_m
        return _SURE_SIGMAS * hypot(motion.sigma_of(), aside_m * motion.heading_sigma_of()) > limit_m

    def _find(self, s: SurveyState) -> SurveyState:
        """Stand for a fix, which needs no motion."""
        return self.apply(replace(self.lose_pose(s, doubts_odometry=False), behaviour=None), MissionEvent.FIND)

    def _without_way(self, s: SurveyState, cause: Cause) -> SurveyState:
        """No way leads on: the estimate may be wrong, so a fix comes before giving up."""
        if s.is_confirmed:
            return self.fault(replace(s, is_confirmed=False), cause)
        return self._find(replace(s, is_confirmed=True))

    def _follow(self, s: SurveyState, motion: StateEstimate, stop: Stop) -> tuple[SurveyState, MissionCommand | None]:
        """One frame of the leg to a stop; no command when the stop is reached."""
        leg = s.behaviour
        if not isinstance(leg, Leg):
            after = s.route.stops[s.stop_index + 1 : s.stop_index + 2] if stop is s.stop else ()
            leg = self.follower.begin(motion, stop, *after)
        leg, twist = self.follower.follow(leg, motion, is_slow=s.is_slow)
        if motion.t_s > leg.deadline_s:
            return self._overdue(s, stop), HOLD_POSITION
        if leg.motion is None or leg.motion.phase is LegPhase.DONE:
            return s, None
        is_driving, mode = leg.motion.phase is LegPhase.DRIVE, s.mode
        if is_driving and mode is TURNING and self._is_vague(s.behaviour, motion):
            return self._arrive(replace(s, fix=FixNeed.CONFIRM), motion)
        if is_driving is not (mode is DRIVING):
            mode = next_state(mode, MissionEvent.TURNED if is_driving else MissionEvent.REALIGN)
        return replace(s, behaviour=leg, mode=mode), MissionCommand(twist)

    def _is_vague(self, leg: object, motion: StateEstimate) -> bool:
        """Whether a turn needs a fix: creep made the position uncertain, and the leg is long or ends at the rim."""
        if not isinstance(leg, Leg) or leg.stop.point is None or motion.sigma_of() <= self._vague_m:
            return False
        is_long = leg.motion is not None and leg.motion.planned_s > _LONG_TURN_S
        follower, reach_m = self.follower, self.cfg.mission.correction_reach_m
        return is_long and (follower.is_at_rim(leg.stop) or follower.distance_m(leg.stop, motion.pose) > reach_m)

    def _overdue(self, s: SurveyState, stop: Stop) -> SurveyState:
        return self.fault(s, conditions.LEG_OVERDUE.cause(x_m=stop.x_m, y_m=stop.y_m))

    def _arrive(self, s: SurveyState, motion: StateEstimate) -> Step:
        return self._settle(self.apply(replace(s, behaviour=None), MissionEvent.ARRIVED), motion)

    def _show_heading(self, s: SurveyState, motion: StateEstimate) -> Step:
        """A short leg, with a fix at each end, shows the heading."""
        if s.behaviour is None:
            stop = self.follower.heading_leg(motion.deck, motion.heading_sigma_of(), was_reverse=s.was_reverse)
            if stop is None:
                return self._arrive(replace(s, heading_legs_left=0), motion)
            legs_left = s.heading_legs_left - 1
            s = replace(s, heading_legs_left=legs_left, was_reverse=stop.reverse, behaviour=Leg(stop))
        if isinstance(s.behaviour, Leg):
            s, command = self._follow(s, motion, s.behaviour.stop)
            if command is not None:
                return s, command
        return self._arrive(s, motion)

    def _correct(self, s: SurveyState, motion: StateEstimate, stop: Stop) -> SurveyState:
        """Plan a correction after a missed point; after a correction, check that the next turn is safe."""
        if s.is_missed:
            panel = motion.pose.panel
            aim = self.follower.correction(motion.pose, self.follower.target_in(panel, stop))
            if aim is None:
                return replace(s, is_missed=False, is_off_route=True)
            leg = Leg(stop, aim=(panel, aim))
            return replace(s, is_missed=False, behaviour=leg, corrected=stop, corrections=s.corrections + 1)
        if s.corrected is stop:
            return s
        is_safe = self.follower.can_proceed(motion.deck, stop)
        return replace(s, corrected=None, is_off_route=s.is_off_route or not is_safe)

    def _find_route(self, s: SurveyState, motion: StateEstimate) -> SurveyState:
        stop, deck, due = s.stop, motion.deck, s.due[:CHUNK]
        if stop is not None and stop.kind is StopKind.CALIBRATE:
            if is_on_drive(s.route.stops, deck.x_m, deck.y_m):
                # Still on the calibration drive: continue it.
                return replace(s, is_off_route=False)
            s = replace(s, wants_calibration=True)
        try:
            planner, over = self.planner, {*s.done, *s.skipped}
            route = planner.route(deck, due) if due else planner.rejoin(s.route, deck, over)
        except PlanError as error:
            return self._without_way(s, conditions.NO_WAY_ON.cause(why=error))
        return replace(s, route=route, stop_index=0, behaviour=None, is_off_route=False, is_confirmed=False)

    def _review_time(self, s: SurveyState, motion: StateEstimate) -> tuple[SurveyState, bool]:
        """After a point, leave out the points for which there is no time; false if the robot has to go home now."""
        s, budget = replace(s, is_review_due=False), self._budget
        if budget is None:
            return s, True
        rest = s.route.stops[s.stop_index :]
        left: Sequence[PointId] = s.due or [stop.point for stop in rest if stop.point is not None]
        progress = budget.progress(s.budget, motion.deck, left)
        going_on = budget.review(progress, motion.t_s, motion.deck, left)
        s = replace(s, budget=progress)
        if going_on is None:
            cause = s.abort_cause or conditions.TIME_USED_UP.cause(budget_s=budget.budget_s)
            return self.proceed(replace(s, abort_cause=cause)), False
        if going_on is left:
            return s, True
        dropped = set(left).difference(going_on)
        causes = {**s.failure_causes, **{point: "no time for it" for point in left if point in dropped}}
        due = tuple(going_on)
        return replace(s, due=due, failure_causes=causes, retried=s.retried | dropped, is_off_route=True), True

    # -- standing -----------------------------------------------------------------------------------------------------

    def _settle(self, s: SurveyState, motion: StateEstimate) -> Step:
        settling = s.behaviour if isinstance(s.behaviour, Settling) else Settling()
        settling = settling.settle(self.cfg.control, self.cfg.etalon.measuring_time_s, motion)
        if not settling.standstill.is_rest:
            return self._check_rest(s, settling, motion), HOLD_POSITION
        point = s.measuring_point
        arrived = None if point is None or point == s.arrived_at else point
        s = replace(s, behaviour=settling, arrived_at=s.arrived_at if arrived is None else arrived)
        return self.apply(s, MissionEvent.SETTLED), MissionCommand(STILL, at_rest=True, arrived=arrived)

    def _measure(self, s: SurveyState, motion: StateEstimate) -> Step:
        settling = s.behaviour if isinstance(s.behaviour, Settling) else Settling()
        settling, is_due = settling.measure(self.cfg.control, self.cfg.etalon.measuring_time_s, motion)
        if is_due:
            return replace(s, behaviour=settling, request=s.request + 1), MissionCommand(STILL, measure=True)
        return self._check_rest(s, settling, motion), HOLD_POSITION

    def _check_rest(self, s: SurveyState, settling: Settling, motion: StateEstimate) -> SurveyState:
        if settling.is_overdue(motion.t_s):
            return self.fault(s, conditions.NO_REST.cause(v_m_s=motion.speed_m_s, omega_rad_s=motion.rate_rad_s))
        return replace(s, behaviour=settling)

    # -- edge and home ------------------------------------------------------------------------------------------------

    def _back_off(self, s: SurveyState, motion: StateEstimate, verdict: Verdict) -> Step:
        if not isinstance(s.behaviour, Retreat):
            return self.proceed(s), HOLD_POSITION
        mission = self.cfg.mission
        retreat, twist = s.behaviour.update(mission, self.follower.tracker, motion, verdict, is_slow=s.is_slow)
        # After an abort no turn away is needed: the way home is planned from here.
        if retreat.step is RetreatStep.OVER or (retreat.step is RetreatStep.TURN_AWAY and s.abort_cause):
            return self.apply(replace(s, behaviour=None), MissionEvent.FIND), HOLD_POSITION
        if retreat.step is RetreatStep.STUCK:
            s = self.hold(s, conditions.STUCK_AT_EDGE.cause(), by_hand=False)
            return replace(s, stuck_s=motion.t_s), HOLD_POSITION
        return replace(s, behaviour=retreat), MissionCommand(twist)

    def _return(self, s: SurveyState, motion: StateEstimate) -> Step:
        home = s.behaviour
        if motion.gap_s > 0.0 and self._is_unsupported(s, motion):
            return self._find(s), HOLD_POSITION
        if not isinstance(home, ReturnHome):
            try:
                stops = self.planner.home(motion.deck)
            except PlanError as error:
                return self._without_way(s, conditions.NO_WAY_HOME.cause(why=error)), HOLD_POSITION
            return replace(s, behaviour=ReturnHome(stops), is_confirmed=False), HOLD_POSITION
        if home.is_at_base:
            s = self.apply(replace(s, outcome=SurveyOutcome.AT_BASE), MissionEvent.FINISHED)
            return s, MissionCommand(STILL, at_rest=True)
        home, twist = home.update(self.follower, self.cfg.control, motion, is_slow=s.is_slow)
        if home.leg is not None and motion.t_s > home.leg.deadline_s:
            return self._overdue(s, home.leg.stop), HOLD_POSITION
        return replace(s, behaviour=home), MissionCommand(twist)

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
            case TakenOver():
                s = self._take_over(s, event)
            case FixStored():
                s = self._fixed(s, event)
            case FixFailed():
                s = self._not_fixed(s, event)
            case PointMissed():
                is_wanted = s.is_awaiting_fix
                s = replace(self.proceed(s), is_missed=True) if is_wanted else replace(s, is_off_route=True)
            case _:
                return super().handle(s, event)
        return s, None

    def _take_over(self, s: SurveyState, event: TakenOver) -> SurveyState:
        """The state for a new process: without behaviour, times and the last verdict."""
        measured, skipped, elapsed_s, is_new_run = event
        if is_new_run:
            if s.mode is DONE and s.outcome is not SurveyOutcome.STOPPED:
                s = self.begin()
            s = replace(s, failure_causes={}, due=(), retried=frozenset(), failures=0, budget=BudgetProgress())
        # The database is newer than the state.
        failed = {point: "not measured" for point in skipped if point not in s.failure_causes}
        is_held = s.is_held_by_hand
        return SurveyState(
            route=self._route,
            mode=HELD if is_held else IDLE,
            cause=s.cause if is_held else NO_CAUSE,
            hold=Hold(is_held, is_held and s.hold.is_fault and not is_new_run),
            fix=FixNeed.RELOCALIZE,
            heading_legs_left=MOST_LEGS,
            done=measured,
            skipped=skipped,
            failure_causes={p: why for p, why in {**s.failure_causes, **failed}.items() if p not in measured},
            due=tuple(point for point in s.due if point not in failed and point not in measured),
            budget=s.budget._replace(begun_s=None, before_s=elapsed_s),
            **{name: getattr(s, name) for name in _KEPT},
        )

    def _recover(self, s: SurveyState, cause: Cause, t_s: float) -> SurveyState:
        """Hold and relocalize; repeated divergence is a fault."""
        if s.mode is DONE or s.is_held_by_hand:
            return s
        health = self.cfg.health
        times_s = [since_s for since_s in s.recoveries_s if t_s - since_s <= health.retry_window_s]
        if times_s and t_s - times_s[-1] <= health.pause_limit_s:
            times_s.pop()  # still the same divergence, which is reported in every frame
        s = replace(s, recoveries_s=(*times_s, t_s))
        if len(s.recoveries_s) > 1 + health.retries:
            return self.fault(s, cause, loses_pose=True)
        # A frozen filter does not show when the robot stands, so the hold lasts for a fixed time.
        return replace(self.await_recovery(s, cause), resumes_after_s=t_s + health.retry_after_s)

    def _fixed(self, s: SurveyState, event: FixStored) -> SurveyState:
        s, point = replace(s, failures=0), event.point
        if point is not None:
            return self._leave_stop(s, point, event.heading_sigma_rad, is_measured=True)
        if s.fix is FixNeed.NONE:
            return self._leave_pointless(s, event.heading_sigma_rad)
        # The heading has to be certain before the robot drives on.
        legs_left = 0 if event.heading_sigma_rad <= self.cfg.mission.heading_doubt_rad else s.heading_legs_left
        s = replace(s, heading_legs_left=legs_left)
        if legs_left > 0:
            return self.apply(replace(s, behaviour=None, is_missed=False), MissionEvent.GO_ON)
        goes_on = s.is_awaiting_fix
        # After relocalizing, the robot is not on the route. After a confirmation at the start it is.
        s = replace(s, fix=FixNeed.NONE, is_found=True, is_off_route=s.is_lost)
        return self.proceed(s) if goes_on else s

    def _not_fixed(self, s: SurveyState, event: FixFailed) -> SurveyState:
        point, cause, sigma_rad = event
        if point is None and s.fix is FixNeed.NONE:
            return self._leave_pointless(s, sigma_rad)  # the survey does not need this fix
        limit, failures = self.cfg.mission.failed_points_before_hold, s.failures + 1
        s = replace(s, failures=0 if failures >= limit else failures)
        if point is None:
            if failures >= limit:
                return self.fault(s, conditions.NOT_FOUND.cause(why=cause))
            if isinstance(s.behaviour, Settling):  # this fix is needed; the robot may not have stood quite still
                s = replace(s, behaviour=replace(s.behaviour, is_requested=False, is_repeated=True))
            return s
        s = replace(s, failure_causes={**s.failure_causes, point: cause}, due=_without(s.due, point))
        if failures >= limit:
            s = self.fault(s, conditions.MEASUREMENTS_FAILED.cause(count=limit, why=cause))
        return self._leave_stop(s, point, sigma_rad, is_measured=False)

    def _leave_pointless(self, s: SurveyState, heading_sigma_rad: float) -> SurveyState:
        """Continue after a fix, or a failed fix, at a stop without a point."""
        stop = s.stop
        if s.is_awaiting_fix and stop is not None and stop.kind in (StopKind.CALIBRATE, StopKind.VIA):
            s = replace(s, stop_index=s.stop_index + 1, behaviour=None)
            return self.proceed(self._doubt_heading(s, heading_sigma_rad))
        return s

    def _doubt_heading(self, s: SurveyState, heading_sigma_rad: float) -> SurveyState:
        """Determine the heading before the robot drives on, if a fix leaves it too uncertain."""
        if heading_sigma_rad > _LOST * self.cfg.mission.heading_doubt_rad and s.fix is not FixNeed.CONFIRM:
            return replace(s, heading_legs_left=MOST_LEGS, fix=FixNeed.RELOCALIZE)
        return s

    def _leave_stop(
        self, s: SurveyState, point: PointId, heading_sigma_rad: float, *, is_measured: bool
    ) -> SurveyState:
        goes_on, stop = s.is_awaiting_fix, s.stop
        # A pause, and a new route to the point, may come while the fix is being stored. The fix counts all the same.
        is_here = stop is not None and stop.point == point
        if is_here or point not in (s.done if is_measured else s.skipped):
            s = replace(s, skipped=_without(s.skipped, point), is_review_due=self._budget is not None, backoffs=0)
            if is_measured:
                causes = {other: why for other, why in s.failure_causes.items() if other != point}
                s = replace(s, done=(*s.done, point), failure_causes=causes, due=_without(s.due, point))
            else:
                s = replace(s, skipped=(*s.skipped, point))
            if not is_here:
                s = replace(s, is_off_route=True)  # the planned route leads to the point again
            elif isinstance(s.behaviour, Leg) and s.fix is FixNeed.NONE:
                s = replace(s, stop_index=s.stop_index + 1, behaviour=None)
            else:
                s = replace(s, stop_index=s.stop_index + 1)
            s = self._doubt_heading(s, heading_sigma_rad)
            # A robot that was pushed meanwhile waits for another measurement, which is not needed any more.
            goes_on |= s.mode in (SETTLING, MEASURING)
        return self.proceed(s) if goes_on else s


def _without(points: tuple[PointId, ...], point: PointId) -> tuple[PointId, ...]:
    return tuple(other for other in points if other != point) if point in points else points


class Mission:
    """A running survey: its state, shared by the callers that send frames and those that send events."""

    def __init__(self, survey: Survey, state: SurveyState | None = None) -> None:
        self.survey = survey
        self.state = state or survey.begin()

    def step(self, motion: StateEstimate, verdict: Verdict | None) -> MissionCommand:
        """One frame."""
        self.state, command = self.survey.step(self.state, motion, verdict)
        return command

    def handle(self, event: SurveyInput) -> str | None:
        """Apply an event between two frames; returns why it was refused, or ``None``."""
        self.state, refusal = self.survey.handle(self.state, event)
        return refusal
