"""The survey: from the pose and the danger loop's verdict to the velocity wanted next. Time is an argument."""

from collections.abc import Callable

from ccatp.config.models import Config
from ccatp.control.gate import Purpose
from ccatp.core import PointId, Severity, StopKind, Verdict
from ccatp.mirror.mirror import Mirror
from ccatp.survey import reactions
from ccatp.survey.behaviours import Behaviours, TimeBudget
from ccatp.survey.heading_recovery import TakeoverState
from ccatp.survey.planning.route import Route
from ccatp.survey.reactions import Failsafe
from ccatp.survey.route_follower import RouteFollower, StateEstimate
from ccatp.survey.state import (
    MEASURING,
    SETTLING,
    MissionEvent,
    MissionState,
    PlanHome,
    PlanPoints,
    PlanRest,
    SurveyOutcome,
    SurveyState,
)
from ccatp.survey.stops import MissionCommand


class FixResults:
    """Takes the outcome of each measurement; with ``has_budget`` the time left is reviewed after each point."""

    def __init__(self, standing: SurveyState, *, has_budget: bool) -> None:
        self._standing, self._has_budget = standing, has_budget
        self._failures = 0

    def fixed(self, point: PointId | None) -> None:
        """The measurement that was asked for is taken, fused and stored."""
        standing = self._standing
        self._failures = 0
        if point is None and not standing.is_lost:
            self._leave_pointless()
            return
        if point is None and standing.aligner.wants_leg:
            standing.interrupt_parts()
            standing.apply(MissionEvent.GO_ON)
            return
        if point is None:
            # Found again, the robot stands where the route never led.
            # Unless it never left the start.
            standing.is_lost, standing.is_off_route, standing.is_at_start = False, not standing.is_at_start, False
        self._leave_stop(point, standing.done)

    def again(self) -> None:
        """The fix shows the robot too far from its point, which has to be approached anew from where it really is."""
        standing = self._standing
        if not standing.is_awaiting_fix:
            standing.is_off_route = True
            return
        standing.go_on()
        standing.missed.miss()

    def not_fixed(self, point: PointId | None, cause: str) -> None:
        """The measurement failed for good: the point is skipped; several in a row hold the robot."""
        standing = self._standing
        if point is None and not standing.is_lost:
            self._leave_pointless()  # the survey can do without
            return
        limit = standing.cfg.mission.failed_points_before_hold
        self._failures += 1
        if point is None:
            if self._failures < limit:
                standing.stopover.repeat()  # it may not have stood quite still, and cannot do without
                return
            self._failures = 0
            standing.fault(f"the robot cannot be found again: {cause}")
            return
        standing.leftovers.failed(point, cause)
        if self._failures < limit:
            self._leave_stop(point, standing.skipped)
            return
        self._failures = 0
        standing.fault(f"{limit} measurements in a row failed: {cause}")
        self._leave_stop(point, standing.skipped)

    def _leave_pointless(self) -> None:
        standing = self._standing
        stop = standing.survey.current
        if standing.is_awaiting_fix and stop is not None and stop.kind in (StopKind.CALIBRATE, StopKind.VIA):
            standing.survey.advance()
            self._doubt_heading()
            standing.go_on()

    def _doubt_heading(self) -> None:
        """Where the fix showed that the pose was wrong, the heading is found before the robot drives on."""
        standing = self._standing
        if standing.aligner.is_needed and not standing.is_at_start:
            standing.aligner.doubt()
            standing.is_lost = True

    def _leave_stop(self, point: PointId | None, record: list[PointId]) -> None:
        standing = self._standing
        goes_on = standing.is_awaiting_fix
        stop = standing.survey.current
        # A pause may come while the fix is being committed, and a new way to the point: it counts all the same.
        is_here = stop is not None and stop.point == point
        if point is not None and (is_here or point not in record):
            if point in standing.skipped:
                standing.skipped.remove(point)
            record.append(point)
            if record is standing.done:
                standing.leftovers.measured(point)
            standing.is_review_due = self._has_budget
            standing.backoffs = 0
            if is_here:
                standing.survey.advance()
            standing.is_off_route |= not is_here  # the way that was planned leads to it once more
            self._doubt_heading()
            # So it does where the robot was pushed meanwhile and waits to be measured anew: there is no need any more.
            goes_on |= standing.state in (SETTLING, MEASURING)
        if goes_on:
            standing.go_on()


class Mission:
    """A survey of the points of a route, with retreat from edges and the way home.

    Call ``step`` once per sensors frame. The caller executes the command and reports the measurement it asked for by
    ``fixed`` or ``not_fixed``. Planners as in ``Behaviours``; without ``plan_points`` what failed once is not tried
    again.
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
        self._control = cfg.control
        self._points = tuple(stop.point for stop in route.stops if stop.point is not None)
        self._budget: TimeBudget | None = None
        if cfg.mission.holds_to_budget:
            self._budget = TimeBudget(cfg.run.budget_s, mirror, cfg.limits, cfg.etalon.measuring_time_s)
        self._is_steered_bare = not (cfg.control.predicts_delay and cfg.control.compensates_creep)
        has_planner = plan_points is not None
        self._standing = standing = SurveyState(cfg, mirror, route, heading_sigma_of, has_planner=has_planner)
        self._reactions = Failsafe(standing)
        self._travels = Behaviours(standing, self._budget, plan_home, plan_rest, plan_points)
        self._results = FixResults(standing, has_budget=self._budget is not None)
        # The measurement that was asked for last: taken, fused and stored; too far off its point; failed for good.
        self.fixed, self.again, self.not_fixed = self._results.fixed, self._results.again, self._results.not_fixed
        # Hold until an operator resumes; hold and go on with a fix; hold until frames and verdicts are fresh again.
        self.fault, self.recover, self.interrupt = standing.fault, standing.recover, standing.interrupt

    def step(self, motion: StateEstimate, verdict: Verdict | None) -> MissionCommand:
        """One frame: react to the verdict in force (``None``: none fresh enough), then do what the state says."""
        if self._is_steered_bare:
            control = self._control
            motion = motion.with_only(ahead=control.predicts_delay, creep=control.compensates_creep)
        if self._budget is not None:
            self._budget.begin(motion.t_s)
        self._reactions.react(motion, verdict)
        return self._travels.step(motion, verdict)

    # -- beginnings in mid-survey ---------------------------------------------------------------------------------

    def take_over(self, recovery: TakeoverState) -> None:
        """Go on with what another process began; before the first frame. The robot is found before it moves."""
        self.lose_sight()
        self._standing.skipped += recovery.skipped
        self._standing.abort_cause = recovery.abort_cause or None
        if recovery.held_cause:
            self._standing.hold(recovery.held_cause, by_hand=True)
        if recovery.abort_cause:
            self.know_emergency()

    def know_emergency(self) -> None:
        """An emergency that is latched when the first verdict comes is no news."""
        self._reactions.know_emergency()

    def lose_sight(self) -> None:
        """The robot may have moved while nobody looked: it does not drive on before a fix, and a sure heading."""
        self._standing.lose()
        self._standing.aligner.doubt()

    # -- commands: each returns why it was refused, or None -------------------------------------------------------

    def pause(self, cause: str) -> str | None:
        """Hold until ``resume``."""
        if self.state is MissionState.DONE:
            return "the mission is over"
        self._standing.hold(cause, by_hand=True)
        return None

    def resume(self) -> str | None:
        """Go on after a hold. What holds the robot must be gone."""
        standing = self._standing
        if self.state is not MissionState.HELD:
            return f"the mission is not held but {self.state}"
        if standing.bar or standing.is_shaking:
            return f"{standing.bar or reactions.EARTHQUAKE}: nothing moves until that is cleared"
        if standing.is_latched and standing.abort_cause is None:
            return "an emergency of before is latched: 'ccatp clear' it first"
        if standing.severity >= Severity.HOLD and standing.severity is not Severity.RETURN:
            return f"the cause persists: {self.cause}"
        standing.go_on()
        return None

    def abort(self, cause: str) -> str | None:
        """Return to base and end there."""
        return reactions.abort(self._standing, cause)

    def stop(self) -> str | None:
        """Hold the wheels and end here."""
        if self.state is MissionState.DONE:
            return "the mission is over"
        self._standing.outcome = SurveyOutcome.STOPPED
        self._standing.apply(MissionEvent.FINISHED)
        return None

    # -- how it stands --------------------------------------------------------------------------------------------

    @property
    def state(self) -> MissionState:
        """What the mission is at."""
        return self._standing.state

    @property
    def outcome(self) -> SurveyOutcome:
        """How it ended."""
        return self._standing.outcome

    @property
    def cause(self) -> str:
        """Why it is held or on its way home."""
        return self._standing.cause

    @property
    def abort_cause(self) -> str:
        """Why the survey was given up, or empty."""
        return self._standing.abort_cause or ""

    @property
    def done(self) -> list[PointId]:
        """Points measured, in order."""
        return self._standing.done

    @property
    def skipped(self) -> list[PointId]:
        """Points whose measurement failed."""
        return self._standing.skipped

    @property
    def left_out(self) -> dict[PointId, str]:
        """Points that are skipped, or that will not be measured any more, and why."""
        out = dict(self._standing.leftovers.causes)
        if self.state is MissionState.DONE:
            why, over = self.cause or str(self.outcome), {*self.done, *out}
            out |= {point: why for point in self._points if point not in over}
        return out

    @property
    def is_faulted(self) -> bool:
        """Something is wrong, and it waits for an operator."""
        return self._standing.is_faulted

    @property
    def purpose(self) -> Purpose:
        """What the last gate lets the robot move for."""
        return self._standing.purpose

    @property
    def is_held_by_hand(self) -> bool:
        """Held until somebody resumes."""
        return self.state is MissionState.HELD and self._standing.is_held_by_hand

    @property
    def is_paused(self) -> bool:
        """Held until somebody resumes, or says that an earthquake is over."""
        return self.state is MissionState.HELD and (self._standing.is_held_by_hand or bool(self._standing.bar))

    @property
    def is_lost(self) -> bool:
        """The pose is known to be wrong, and is to be found again; at the start it is only to be confirmed."""
        return self._standing.is_lost and not self._standing.is_at_start

    @property
    def ignores_motion(self) -> bool:
        """Held because wheels or inertial unit are not to be believed: whatever they say, the robot stands."""
        return self._standing.ignores_motion

    @property
    def doubts_pose(self) -> bool:
        """The localizer shall doubt its pose; to be set to false when it does."""
        return self._standing.doubts_pose

    @doubts_pose.setter
    def doubts_pose(self, value: bool) -> None:
        self._standing.doubts_pose = value

    @property
    def wants_calibration(self) -> bool:
        """The calibration drive was given up: the robot was held, and found again elsewhere."""
        return self._standing.wants_calibration

    @property
    def wants_full_fans(self) -> bool:
        """Something happened after which the robot shall be pressed on with all that the fans have."""
        return self._standing.wants_full_fans

    @property
    def request(self) -> int:
        """Number of the measurement that was asked for last."""
        return self._standing.stopover.request

    @property
    def is_awaiting_fix(self) -> bool:
        """Whether the measurement asked for last, number ``request``, is still wanted."""
        return self._standing.is_awaiting_fix

    @property
    def measuring_point(self) -> PointId | None:
        """The point being measured; ``None`` for a fix that only serves to find the robot again."""
        return self._travels.measuring_point

    @property
    def survey(self) -> RouteFollower:
        """The journey along the route."""
        return self._standing.survey

    @property
    def journey(self) -> RouteFollower:
        """The journey being made: the survey, the way home, or a leg that shows the heading."""
        return self._standing.journey

    @property
    def eta_s(self) -> float:
        """Least time that the rest of the survey takes, s; nothing is left of one that was given up or is over."""
        if self.abort_cause or self.state is MissionState.DONE:
            return 0.0
        return self._standing.route.remaining_s(self.survey.index)

    @property
    def corrections(self) -> int:
        """Correction moves begun."""
        return self._standing.missed.corrections
