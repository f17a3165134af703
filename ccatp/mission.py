"""Pure. The survey: from the pose and the danger loop's verdict to the velocity wanted next. Time is an argument."""

from collections.abc import Callable, Collection, Sequence
from math import inf

from ccatp.config.models import Config
from ccatp.control.tracker import DONE, DRIVE
from ccatp.mirror.mirror import Mirror
from ccatp.planning.errors import PlanError
from ccatp.planning.route import Route
from ccatp.samples import Corner, DeckPose, EventCode, PointId, Severity, Stop, StopKind, Verdict
from ccatp.surveying.alignment import Aligner
from ccatp.surveying.budget import TimeBudget
from ccatp.surveying.correction import Corrector
from ccatp.surveying.homing import Homing
from ccatp.surveying.journey import Journey, Motion
from ccatp.surveying.leftovers import Leftovers
from ccatp.surveying.missed_point import MissedPoint
from ccatp.surveying.orders import STAND, Order
from ccatp.surveying.pace import PacedTracker
from ccatp.surveying.recovery import Recovery
from ccatp.surveying.retreat import Retreat, Step
from ccatp.surveying.states import (
    BACKING_OFF,
    DRIVING,
    HELD,
    IDLE,
    MEASURING,
    RETURNING,
    SETTLING,
    TURNING,
    Event,
    Outcome,
    State,
    next_state,
)
from ccatp.surveying.stopover import Stopover

NORMAL, NEAR_EDGE, ABORTED = EventCode
NONE, SLOW, HOLD, RETURN, FAULT = Severity.NONE, Severity.SLOW, Severity.HOLD, Severity.RETURN, Severity.FAULT
_CORNERS = frozenset(Corner)
PlanHome = Callable[[DeckPose], tuple[Stop, ...]]
PlanRest = Callable[[Route, DeckPose, Collection[PointId]], Route]
PlanPoints = Callable[[DeckPose, Sequence[PointId]], Route]
# Nothing moves while the ground shakes.
EARTHQUAKE = "emergency:earthquake"


class Mission:
    """A survey of the points of a route, with retreat from edges and the way home.

    Call ``step`` once per sensors frame. The caller executes the order and reports the measurement it asked for by
    ``fixed`` or ``not_fixed``.

    Args:
        cfg: the configuration.
        mirror: the mirror surveyed.
        route: the route of the survey.
        plan_home: gives the stops from a pose to base.
        plan_rest: gives the way back to a route from a pose, without the points that are done with.
        plan_points: gives a route through points from a pose; without it what failed once is not tried again.
        heading_sigma_of: how well the heading is known, rad; asked after the robot was out of sight.

    Attributes:
        wants_full_fans: something happened after which the robot shall be pressed on with all that the fans have.
    """

    def __init__(
        self,
        cfg: Config,
        mirror: Mirror,
        route: Route,
        plan_home: PlanHome,
        plan_rest: PlanRest,
        plan_points: PlanPoints | None = None,
        heading_sigma_of: Callable[[], float] = float,
    ) -> None:
        """Idle at base."""
        self._cfg, self._mirror, self._plan_home, self._plan_rest = cfg, mirror, plan_home, plan_rest
        self._plan_points = plan_points
        self._points = tuple(stop.point for stop in route.stops if stop.point is not None)
        self._leftovers = Leftovers()
        measuring_s = cfg.etalon.measuring_time_s
        self._budget = (
            TimeBudget(cfg.run.budget_s, mirror, cfg.limits, measuring_s) if cfg.mission.holds_to_budget else None
        )
        self._is_review_due = False
        self._bar = ""
        self.wants_full_fans = False
        self._tracker = PacedTracker(cfg.control, cfg.limits, cfg.health, cfg.robot.wheel_lag_s)
        self._is_steered_bare = not (cfg.control.predicts_delay and cfg.control.compensates_creep)
        self._route = route
        self._is_off_route = False
        self.survey = self._journey(route.stops)
        self._home: Homing | None = None
        self.state = State.IDLE
        self.outcome = Outcome.NONE
        self.cause = ""
        self.done: list[PointId] = []
        self.skipped: list[PointId] = []
        self._abort_cause: str | None = None
        self._is_held_by_hand = False
        self.is_faulted = False
        self._retreat: Retreat | None = None
        self._is_lost = cfg.mission.fix_at_start
        self._is_at_start = cfg.mission.fix_at_start
        self._backoffs = 0
        self._failures = 0
        self._stopover = Stopover(cfg.control, cfg.etalon.measuring_time_s)
        self._missed = MissedPoint(Corrector(mirror, cfg.robot, cfg.mission))
        self._emergency = ""
        self._aligner = Aligner(mirror, cfg.robot, cfg.mission, heading_sigma_of, self._journey)
        self._severity = NONE
        self._recoveries_s: list[float] = []
        self._waits_until_s = -inf
        self._stuck_s: float | None = None
        self.doubts_pose = False
        self._is_hold_deaf = self._is_finding = False

    def _journey(self, stops: Sequence[Stop]) -> Journey:
        return Journey(self._mirror, self._tracker, self._cfg.control.leg_timeout_factor, stops)

    @property
    def is_paused(self) -> bool:
        """Held until somebody resumes, or says that an earthquake is over."""
        return self.state is State.HELD and (self._is_held_by_hand or bool(self._bar))

    @property
    def is_lost(self) -> bool:
        """The pose is known to be wrong, and is to be found again; at the start it is only to be confirmed."""
        return self._is_lost and not self._is_at_start

    @property
    def ignores_motion(self) -> bool:
        """Held because wheels or inertial unit are not to be believed: whatever they say, the robot stands."""
        return self.state is HELD and self._is_hold_deaf

    @property
    def eta_s(self) -> float:
        """Least time that the rest of the survey takes, s."""
        return self._route.remaining_s(self.survey.index)

    @property
    def left_out(self) -> dict[PointId, str]:
        """Points that are skipped, or that will not be measured any more, and why."""
        out = dict(self._leftovers.causes)
        if self.state is State.DONE:
            why, over = self.cause or str(self.outcome), {*self.done, *out}
            out |= {point: why for point in self._points if point not in over}
        return out

    @property
    def corrections(self) -> int:
        """Correction moves begun."""
        return self._missed.corrections

    @property
    def journey(self) -> Journey:
        """The journey being made: the survey, the way home, or a leg that shows the heading."""
        if self._aligner.journey is not None:
            return self._aligner.journey
        return self.survey if self._home is None else self._home.journey

    @property
    def abort_cause(self) -> str:
        """Why the survey was given up, or empty."""
        return self._abort_cause or ""

    # -- beginnings in mid-survey ---------------------------------------------------------------------------------

    def take_over(self, recovery: Recovery) -> None:
        """Go on with what another process began; before the first frame. The robot is found before it moves."""
        self.lose_sight()
        self.skipped += recovery.skipped
        self._abort_cause = recovery.abort_cause or None
        if recovery.held_cause:
            self._hold(recovery.held_cause, by_hand=True)

    def lose_sight(self) -> None:
        """The robot may have moved while nobody looked: it does not drive on before a fix, and a sure heading."""
        self._is_lost, self._is_at_start = True, False
        self._aligner.doubt()

    # -- commands: each returns why it was refused, or None -------------------------------------------------------

    def pause(self, cause: str) -> str | None:
        """Hold until ``resume``."""
        if self.state is State.DONE:
            return "the mission is over"
        self._hold(cause, by_hand=True)
        return None

    def resume(self) -> str | None:
        """Go on after a hold. What holds the robot must be gone."""
        if self.state is not State.HELD:
            return f"the mission is not held but {self.state}"
        if self._bar:
            return f"{self._bar}: nothing moves until that is cleared"
        if self._severity >= HOLD and self._severity is not RETURN:
            return f"the cause persists: {self.cause}"
        self._go_on()
        return None

    def abort(self, cause: str) -> str | None:
        """Return to base and end there."""
        if self.state is State.DONE:
            return "the mission is over"
        is_news = self._abort_cause is None
        self._abort_cause = self._abort_cause or cause
        if self._bar:
            return None  # home, but not before the robot may move
        # An edge outranks an abort: the retreat and its fix come first.
        if self.state is State.HELD or (is_news and self.state is not State.BACKING_OFF and not self._is_lost):
            self._go_on()
        return None

    def stop(self) -> str | None:
        """Hold the wheels and end here."""
        if self.state is State.DONE:
            return "the mission is over"
        self.outcome = Outcome.STOPPED
        self._apply(Event.FINISHED)
        return None

    def fault(self, cause: str, *, is_lost: bool = False) -> None:
        """Hold until an operator resumes, because something is wrong; where the pose is, a fix comes first then."""
        if self.state is State.DONE:
            return
        self._is_lost |= is_lost
        self._hold(cause, by_hand=True)
        self.is_faulted = True

    def recover(self, cause: str, t_s: float) -> None:
        """Hold, and go on with a fix; what comes again and again is a fault.

        Args:
            cause: why.
            t_s: now.
        """
        if self.state is State.DONE or (self.state is HELD and self._is_held_by_hand):
            return
        health = self._cfg.health
        self._recoveries_s = [since_s for since_s in self._recoveries_s if t_s - since_s <= health.retry_window_s]
        if self._recoveries_s and t_s - self._recoveries_s[-1] <= health.pause_limit_s:
            self._recoveries_s.pop()  # still the same: frame by frame it is asked for again
        self._recoveries_s.append(t_s)
        if len(self._recoveries_s) > 1 + health.retries:
            self.fault(cause, is_lost=True)
        else:
            self._await_recovery(cause)
            self._waits_until_s = (
                t_s + health.retry_after_s
            )  # a filter that is frozen cannot tell when the robot stands

    def interrupt(self, cause: str) -> bool:
        """Hold until frames and verdicts are fresh again; returns whether that was news."""
        if self.state in (State.IDLE, State.HELD, State.DONE):
            return False
        self._hold(cause, by_hand=False)
        return True

    # -- measurements ---------------------------------------------------------------------------------------------

    @property
    def request(self) -> int:
        """Number of the measurement that was asked for last."""
        return self._stopover.request

    @property
    def is_awaiting_fix(self) -> bool:
        """Whether the measurement asked for last, number ``request``, is still wanted."""
        return self.state is MEASURING and self._stopover.is_asked

    @property
    def measuring_point(self) -> PointId | None:
        """The point being measured; ``None`` for a fix that only serves to find the robot again."""
        stop = self.survey.current
        return None if self._is_lost or stop is None else stop.point

    def fixed(self, point: PointId | None) -> None:
        """The measurement that was asked for is taken, fused and stored."""
        self._failures = 0
        if point is None and not self._is_lost:
            self._leave_pointless()
            return
        if point is None and self._aligner.wants_leg:
            self._interrupt()
            self._apply(Event.GO_ON)
            return
        if point is None:
            # Found again, the robot stands where the route never led.
            # Unless it never left the start.
            self._is_lost, self._is_off_route, self._is_at_start = False, not self._is_at_start, False
        self._leave_stop(point, self.done)

    def again(self) -> None:
        """The fix shows the robot too far from its point, which has to be approached anew from where it really is."""
        if not self.is_awaiting_fix:
            self._is_off_route = True
            return
        self._go_on()
        self._missed.miss()

    def not_fixed(self, point: PointId | None, cause: str) -> None:
        """The measurement failed for good: the point is skipped; several in a row hold the robot."""
        if point is None and not self._is_lost:
            self._leave_pointless()  # the survey can do without
            return
        limit = self._cfg.mission.failed_points_before_hold
        self._failures += 1
        if point is None:
            if self._failures < limit:
                self._stopover.repeat()  # it may not have stood quite still, and cannot do without
                return
            self._failures = 0
            self.fault(f"the robot cannot be found again: {cause}")
            return
        self._leftovers.failed(point, cause)
        if self._failures < limit:
            self._leave_stop(point, self.skipped)
            return
        self._failures = 0
        self.fault(f"{limit} measurements in a row failed: {cause}")
        self._leave_stop(point, self.skipped)

    def _leave_pointless(self) -> None:
        stop = self.survey.current
        if self.is_awaiting_fix and stop is not None and stop.kind in (StopKind.CALIBRATE, StopKind.VIA):
            self.survey.advance()
            self._go_on()

    def _leave_stop(self, point: PointId | None, record: list[PointId]) -> None:
        goes_on = self.is_awaiting_fix
        stop = self.survey.current
        # A pause may come while the fix is being committed: the point counts all the same.
        if point is not None and stop is not None and stop.point == point:
            if point in self.skipped:
                self.skipped.remove(point)
            record.append(point)
            if record is self.done:
                self._leftovers.measured(point)
            self._is_review_due = self._budget is not None
            self._backoffs = 0
            self.survey.advance()
            # So it does where the robot was pushed meanwhile and waits to be measured anew: there is no need any more.
            goes_on |= self.state in (SETTLING, MEASURING)
        if goes_on:
            self._go_on()

    # -- the frame ------------------------------------------------------------------------------------------------

    def step(self, motion: Motion, verdict: Verdict | None) -> Order:
        """One frame: react to the verdict, then do what the state says.

        Args:
            motion: time, pose and speed of the present frame.
            verdict: the danger loop's verdict in force, ``None`` where there is none fresh enough.
        """
        if self._is_steered_bare:
            control = self._cfg.control
            motion = motion.with_only(ahead=control.predicts_delay, creep=control.compensates_creep)
        if self._budget is not None:
            self._budget.begin(motion.t_s)
        self._react(motion, verdict)
        state = self.state
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
        return STAND

    def _react(self, motion: Motion, verdict: Verdict | None) -> None:
        if verdict is not None and verdict.signal == EARTHQUAKE:
            self._stand_fast(verdict.cause)
            return
        self._bar = ""
        if verdict is not None and (verdict.severity is not NONE or self._severity is not NONE):
            self._severity = verdict.severity
            if self._obey(verdict):
                return
        if self._stuck_s is not None and self._waits_at_edge(motion.t_s, verdict):
            return
        if verdict is None or not (verdict.forward and verdict.reverse and verdict.turn):
            if verdict is not None and verdict.code is NEAR_EDGE:
                self._meet_edge(motion, verdict)
            elif verdict is None:
                self.interrupt("no fresh verdict from the danger loop")
            elif not (self._is_lost and self.state in (SETTLING, MEASURING)):
                # A robot that stands to be found needs no permission, and without a pose gets none before it is.
                self.interrupt(verdict.cause)
            return
        if verdict.code is NEAR_EDGE:
            self._meet_edge(motion, verdict)
            return
        if verdict.code is ABORTED and verdict.cause != self._emergency:
            self._emergency = verdict.cause  # the level is repeated; what counts is that it is new
            self.abort(verdict.cause)
        is_waiting = self.state is HELD and (self._is_held_by_hand or motion.t_s < self._waits_until_s)
        if self.state is IDLE or (self.state is HELD and not is_waiting):
            self._go_on()

    def _stand_fast(self, cause: str) -> None:
        """An earthquake: pressed on, held, and home when it is over; a pose from before is not to be trusted then."""
        self.wants_full_fans = True
        if self._bar or self.state is State.DONE:
            return
        self._bar = self._emergency = cause
        self._abort_cause = self._abort_cause or cause
        self._is_lost, self._is_at_start = True, False
        self._hold(cause, by_hand=self.state is State.HELD and self._is_held_by_hand)

    def _obey(self, verdict: Verdict) -> bool:
        """Do what a finding of the monitors demands; whether that is all for this frame."""
        severity = verdict.severity
        self.wants_full_fans |= verdict.full_fans
        is_denied = not (verdict.forward or verdict.reverse or verdict.turn)
        if severity is FAULT:
            if not (self.state is HELD and self.is_faulted):
                self.fault(verdict.cause, is_lost=True)
            return True
        if is_denied and severity >= HOLD:
            self._await_recovery(verdict.cause, is_pose_doubted=verdict.signal not in _CORNERS)
            return True
        self._pace(is_slow=severity in (SLOW, RETURN))
        if severity is RETURN and verdict.code is not NEAR_EDGE and verdict.cause != self._emergency:
            self._emergency = verdict.cause
            self.abort(verdict.cause)
        return False

    def _await_recovery(self, cause: str, *, is_pose_doubted: bool = False) -> None:
        """Hold until the cause is gone, and then find out where the robot is before moving on."""
        if self.state is State.DONE or (self.state is HELD and self._is_held_by_hand):
            return
        self._is_lost, self._is_at_start = True, False
        was_deaf = self.ignores_motion
        if not self.interrupt(cause):
            self.cause = cause
        self._is_hold_deaf = was_deaf or is_pose_doubted

    def _pace(self, *, is_slow: bool) -> None:
        """Drive at the reduced speed from now on, or at the usual one from the next leg on."""
        if is_slow is self._tracker.is_slow:
            return
        self._tracker.is_slow = is_slow
        if is_slow and self.state in (DRIVING, TURNING, RETURNING):
            (self.survey if self._home is None else self._home).interrupt()

    def _waits_at_edge(self, t_s: float, verdict: Verdict | None) -> bool:
        """After a retreat that led nowhere: whether to go on waiting until no sensor hangs over any more."""
        if self.state is not HELD or self._is_held_by_hand or self._stuck_s is None:
            self._stuck_s = None
            return False
        if verdict is not None and verdict.code is not NEAR_EDGE:
            self._stuck_s = None
            return False
        if t_s - self._stuck_s > self._cfg.health.hold_limit_s:
            self._stuck_s = None
            self.fault(self.cause)
        return True

    def _meet_edge(self, motion: Motion, verdict: Verdict) -> None:
        if self.state in (State.BACKING_OFF, State.DONE):
            return
        if self.ignores_motion:
            self._go_on()  # where the edge is, is not known before a fix; standing still for it is safe anywhere
        if self._is_finding and self.state in (SETTLING, MEASURING):
            return
        if self.state is State.HELD and self._is_held_by_hand:
            return
        limit = self._cfg.mission.max_backoffs_per_stop
        self._backoffs += 1
        if self._backoffs > limit:
            self._backoffs = 0
            self.fault(f"at the edge again after {limit} back-offs: is an edge sensor dirty?")
            return
        # Back at an edge right after a fix of the place: then it is the heading that is wrong.
        self.doubts_pose |= self._backoffs > 1
        self.cause = verdict.cause
        self._interrupt()
        # An edge that the route did not foresee means that the pose is wrong: it is found again before moving on.
        self._is_lost, self._is_at_start = True, False
        self._apply(Event.EDGE)
        self._retreat = Retreat(self._cfg.mission, self._tracker, verdict, motion.pose, motion.rate_rad_s)

    def _apply(self, event: Event) -> None:
        self.state = next_state(self.state, event)

    def _interrupt(self) -> None:
        """Forget where in a leg, a stop or a docking the robot was: it begins anew from where it is."""
        (self.survey if self._home is None else self._home).interrupt()
        self._stopover.interrupt()
        self._missed.interrupt()
        self._aligner.interrupt()

    def _hold(self, cause: str, *, by_hand: bool) -> None:
        self._interrupt()
        self._apply(Event.HOLD)
        self._is_held_by_hand = by_hand
        self._is_hold_deaf = False
        self.cause = cause

    def _go_on(self) -> None:
        self._interrupt()
        self._is_finding = self.ignores_motion
        self.doubts_pose |= self._is_finding
        self.is_faulted = False
        # Wherever a hold left the robot: the route's next turn may not be safe there.
        self._is_off_route |= self.state is State.HELD
        if self._is_lost:
            self._apply(Event.FIND)
        elif self._abort_cause is not None:
            self.cause = self._abort_cause
            self._home = None  # planned anew from where the robot is now
            self._apply(Event.GO_HOME)
        elif self.survey.current is None and not self._has_more():
            self.outcome = Outcome.COMPLETE
            self._apply(Event.FINISHED)
        else:
            self.cause = ""
            self._apply(Event.GO_ON)

    def _has_more(self) -> bool:
        """Whether points are due away from the planned route: those that failed once, or a thinned rest."""
        if self._plan_points is None:
            return False
        self._leftovers.begin_second_round()
        self._is_off_route |= bool(self._leftovers.due)
        return bool(self._leftovers.due)

    # -- moving and measuring -------------------------------------------------------------------------------------

    def _is_overdue(self, motion: Motion) -> bool:
        """Whether the leg takes so long that something must be wrong; that holds the robot."""
        journey = self.journey
        stop = journey.current
        if stop is None or not journey.is_overdue(motion.t_s):
            return False
        self.fault(f"the leg to ({stop.x_m:.3f}, {stop.y_m:.3f}) m is overdue: is a wheel blocked or slipping?")
        return True

    def _travel(self, motion: Motion) -> Order:
        if self._is_lost:
            return self._align(motion)
        if self._is_review_due and self._is_out_of_time(motion):
            return STAND
        survey = self.survey
        stop = survey.current
        if stop is not None and not self._missed.follows_route(motion, stop, survey):
            self._is_off_route = True
        if self._is_off_route:
            return self._find_route(motion)
        if stop is None:
            self._go_on()
            return STAND
        order = self._follow(survey, motion, stop)
        if order is not None:
            return order
        if stop.kind in (StopKind.MEASURE, StopKind.CALIBRATE) or self._is_vague(motion, stop):
            self._apply(Event.ARRIVED)
            return self._settle(motion)
        survey.advance()
        self._go_on()
        return self._travel(motion)

    def _follow(self, journey: Journey, motion: Motion, stop: Stop) -> Order | None:
        """One frame of the leg to a stop; ``None`` when it is reached."""
        twist = journey.follow(motion, stop)
        if self._is_overdue(motion):
            return STAND
        phase = self._tracker.phase
        if phase is DONE:
            return None
        if (phase is DRIVE) is not (self.state is DRIVING):
            self._apply(Event.TURNED if phase is DRIVE else Event.REALIGN)
        return Order(twist)

    def _align(self, motion: Motion) -> Order:
        """One frame of a leg that shows the heading; a fix follows."""
        leg = self._aligner.leg(motion.deck)
        stop = None if leg is None else leg.current
        order = None if leg is None or stop is None else self._follow(leg, motion, stop)
        if order is not None:
            return order
        self._aligner.interrupt()
        self._apply(Event.ARRIVED)
        return self._settle(motion)

    def _is_vague(self, motion: Motion, stop: Stop) -> bool:
        """Whether to measure at a via point: they lie near the rim, and the next turn needs the room the route left."""
        return stop.kind is StopKind.VIA and motion.sigma_of() > self._cfg.mission.via_sigma_m

    def _find_route(self, motion: Motion) -> Order:
        """Plan anew from where the robot is; one frame of standing still, however long that takes."""
        due = self._leftovers.chunk
        try:
            if due and self._plan_points is not None:
                self._route = self._plan_points(motion.deck, due)
            else:
                self._route = self._plan_rest(self._route, motion.deck, {*self.done, *self.skipped})
        except PlanError as error:
            self.fault(f"no way on: {error}")
            return STAND
        self._is_off_route = False
        self.survey = self._journey(self._route.stops)
        return STAND

    def _is_out_of_time(self, motion: Motion) -> bool:
        """Review the budget after a point: whether it is time to go home; what does not fit is left out."""
        self._is_review_due = False
        if self._budget is None:
            return False
        stops = self.survey.stops[self.survey.index :]
        left = self._leftovers.due or [stop.point for stop in stops if stop.point is not None]
        going_on = self._budget.review(motion.t_s, motion.deck, left)
        if going_on is None:
            self._abort_cause = self._abort_cause or f"the time budget of {self._budget.budget_s:g} s is used up"
            self._go_on()
            return True
        if going_on is not left:
            self._leftovers.thin_out(left, going_on, "no time for it")
            self._is_off_route = True
        return False

    def _settle(self, motion: Motion) -> Order:
        stopover = self._stopover
        if stopover.has_settled(motion):
            self._apply(Event.SETTLED)
            return Order(STAND.twist, at_rest=True, arrived=stopover.arrival_at(self.measuring_point))
        self._check_rest(motion)
        return STAND

    def _stand(self, motion: Motion) -> Order:
        if self._stopover.is_due(motion):
            return Order(STAND.twist, measure=True)
        self._check_rest(motion)
        return STAND

    def _check_rest(self, motion: Motion) -> None:
        if self._stopover.is_restless(motion.t_s):
            self.fault(f"the robot does not come to rest: {motion.speed_m_s:.4f} m/s, {motion.rate_rad_s:.4f} rad/s")

    # -- edge and home --------------------------------------------------------------------------------------------

    def _back_off(self, motion: Motion, verdict: Verdict) -> Order:
        retreat = self._retreat
        if retreat is None:
            self._go_on()
            return STAND
        twist = retreat.step(motion, verdict)
        if retreat.step_at is Step.TURN_AWAY and self._abort_cause is not None:
            retreat.step_at = Step.OVER  # there is no route to turn to; the way home begins from here
        if retreat.step_at is Step.STUCK:
            self._hold("stuck at the edge: no motion away from it is permitted, or none helps", by_hand=False)
            self._stuck_s = motion.t_s
            return STAND
        if retreat.step_at is Step.OVER:
            self._apply(Event.FIND)
            return STAND
        return Order(twist)

    def _return(self, motion: Motion) -> Order:
        if self._home is None:
            try:
                self._home = Homing(self._journey(self._plan_home(motion.deck)), self._tracker)
            except PlanError as error:
                self.fault(f"no way home: {error}")
            return STAND
        if self._home.is_at_base:
            self.outcome = Outcome.AT_BASE
            self._apply(Event.FINISHED)
            return Order(STAND.twist, at_rest=True)
        twist = self._home.step(motion, self._stopover.is_quiet(motion))
        return STAND if self._is_overdue(motion) else Order(twist)
