"""The survey: from the pose and the danger loop's verdict to the velocity wanted next. Time is an argument."""

from collections.abc import Callable

from ccatp.config.models import Config
from ccatp.core import PointId, Severity, StopKind, Verdict
from ccatp.mirror.mirror import Mirror
from ccatp.survey.behaviours import Behaviours, TimeBudget
from ccatp.survey.heading_recovery import TakeoverState
from ccatp.survey.planning.route import Route
from ccatp.survey.reactions import EARTHQUAKE, Failsafe
from ccatp.survey.route_follower import StateEstimate
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


class Mission(SurveyState):
    """A survey of the points of a route, with retreat from edges and the way home.

    Call ``step`` once per sensors frame. The caller executes the command and reports the measurement it asked for by
    ``fixed`` (taken, fused and stored), ``again`` (too far off its point) or ``not_fixed`` (failed for good). Planners
    as in ``Behaviours``; without ``plan_points`` what failed once is not tried again.
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
        super().__init__(cfg, mirror, route, heading_sigma_of, has_planner=plan_points is not None)
        self._points = tuple(stop.point for stop in route.stops if stop.point is not None)
        self._budget: TimeBudget | None = None
        if cfg.mission.holds_to_budget:
            self._budget = TimeBudget(cfg.run.budget_s, mirror, cfg.limits, cfg.etalon.measuring_time_s)
        self._is_steered_bare = not (cfg.control.predicts_delay and cfg.control.compensates_creep)
        self._failsafe = Failsafe(self)
        self._behaviours = Behaviours(self, self._budget, plan_home, plan_rest, plan_points)
        self._failures = 0

    def step(self, motion: StateEstimate, verdict: Verdict | None) -> MissionCommand:
        """One frame: react to the verdict in force (``None``: none fresh enough), then do what the state says."""
        if self._is_steered_bare:
            control = self.cfg.control
            motion = motion._replace(
                creep=motion.creep if control.compensates_creep else (0.0, 0.0),
                ahead=motion.ahead if control.predicts_delay else None,
            )
        if self._budget is not None:
            self._budget.begin(motion.t_s)
        self._failsafe.react(motion, verdict)
        return self._behaviours.step(motion, verdict)

    # -- measurements ---------------------------------------------------------------------------------------------

    def fixed(self, point: PointId | None) -> None:
        """The measurement that was asked for is taken, fused and stored."""
        self._failures = 0
        if point is None and not self.needs_fix:
            self._leave_pointless()
            return
        if point is None and self.heading_recovery.wants_leg:
            self.interrupt_parts()
            self.apply(MissionEvent.GO_ON)
            return
        if point is None:
            # Found again, the robot stands where the route never led.
            # Unless it never left the start.
            self.needs_fix, self.is_off_route, self.is_at_start = False, not self.is_at_start, False
        self._leave_stop(point, self.done)

    def again(self) -> None:
        """The fix shows the robot too far from its point, which has to be approached again from where it really is."""
        if not self.is_awaiting_fix:
            self.is_off_route = True
            return
        self.proceed()
        self.missed.miss()

    def not_fixed(self, point: PointId | None, cause: str) -> None:
        """The measurement failed for good: the point is skipped; several in a row hold the robot."""
        if point is None and not self.needs_fix:
            self._leave_pointless()  # the survey can do without
            return
        limit = self.cfg.mission.failed_points_before_hold
        self._failures += 1
        if point is None:
            if self._failures < limit:
                self.settling.repeat()  # it may not have stood quite still, and cannot do without
                return
            self._failures = 0
            self.fault(f"the robot cannot be found again: {cause}")
            return
        self.retries.failed(point, cause)
        if self._failures < limit:
            self._leave_stop(point, self.skipped)
            return
        self._failures = 0
        self.fault(f"{limit} measurements in a row failed: {cause}")
        self._leave_stop(point, self.skipped)

    def _leave_pointless(self) -> None:
        stop = self.survey_route.current
        if self.is_awaiting_fix and stop is not None and stop.kind in (StopKind.CALIBRATE, StopKind.VIA):
            self.survey_route.advance()
            self._doubt_heading()
            self.proceed()

    def _doubt_heading(self) -> None:
        """Where the fix showed that the pose was wrong, the heading is found before the robot drives on."""
        if self.heading_recovery.is_needed and not self.is_at_start:
            self.heading_recovery.doubt()
            self.needs_fix = True

    def _leave_stop(self, point: PointId | None, record: list[PointId]) -> None:
        goes_on = self.is_awaiting_fix
        stop = self.survey_route.current
        # A pause may come while the fix is being committed, and a new way to the point: it counts all the same.
        is_here = stop is not None and stop.point == point
        if point is not None and (is_here or point not in record):
            if point in self.skipped:
                self.skipped.remove(point)
            record.append(point)
            if record is self.done:
                self.retries.measured(point)
            self.is_review_due = self._budget is not None
            self.backoffs = 0
            if is_here:
                self.survey_route.advance()
            self.is_off_route |= not is_here  # the way that was planned leads to it once more
            self._doubt_heading()
            # So it does where the robot was pushed meanwhile and waits to be measured again: there is no need any more.
            goes_on |= self.state in (SETTLING, MEASURING)
        if goes_on:
            self.proceed()

    # -- beginnings in mid-survey ---------------------------------------------------------------------------------

    def take_over(self, recovery: TakeoverState) -> None:
        """Go on with what another process began; before the first frame. The robot is found before it moves."""
        self.on_tracking_gap()
        self.skipped += recovery.skipped
        self.abort_cause = recovery.abort_cause
        if recovery.held_cause:
            self.hold(recovery.held_cause, by_hand=True)
        if recovery.abort_cause:
            self.skip_present_emergency()

    def skip_present_emergency(self) -> None:
        """An emergency that is latched when the first verdict comes is no news."""
        self._failsafe.skip_present_emergency()

    def on_tracking_gap(self) -> None:
        """The robot may have moved while it was not observed: it does not drive on before a fix, and a sure heading."""
        self.invalidate_pose()
        self.heading_recovery.doubt()

    # -- commands: each returns why it was refused, or None -------------------------------------------------------

    def pause(self, cause: str) -> str | None:
        """Hold until ``resume``."""
        if self.state is MissionState.DONE:
            return "the mission is over"
        self.hold(cause, by_hand=True)
        return None

    def resume(self) -> str | None:
        """Go on after a hold. What holds the robot must be gone."""
        if self.state is not MissionState.HELD:
            return f"the mission is not held but {self.state}"
        if self.interlock or self.is_shaking:
            return f"{self.interlock or EARTHQUAKE}: nothing moves until that is cleared"
        if self.is_latched and not self.abort_cause:
            return "an emergency of before is latched: 'ccatp clear' it first"
        if self.severity >= Severity.HOLD and self.severity is not Severity.RETURN:
            return f"the cause persists: {self.cause}"
        self.proceed()
        return None

    def stop(self) -> str | None:
        """Hold the wheels and end here."""
        if self.state is MissionState.DONE:
            return "the mission is over"
        self.outcome = SurveyOutcome.STOPPED
        self.apply(MissionEvent.FINISHED)
        return None

    # -- how it stands --------------------------------------------------------------------------------------------

    @property
    def left_out(self) -> dict[PointId, str]:
        """Points that are skipped, or that will not be measured any more, and why."""
        out = dict(self.retries.causes)
        if self.state is MissionState.DONE:
            why, over = self.cause or str(self.outcome), {*self.done, *out}
            out |= {point: why for point in self._points if point not in over}
        return out

    @property
    def is_paused(self) -> bool:
        """Held until an operator resumes, or reports that an earthquake is over."""
        return self.state is MissionState.HELD and (self.awaits_operator or bool(self.interlock))

    @property
    def request(self) -> int:
        """Number of the measurement that was asked for last."""
        return self.settling.request

    @property
    def measuring_point(self) -> PointId | None:
        """The point being measured; ``None`` for a fix that only serves to find the robot again."""
        return self._behaviours.measuring_point

    @property
    def eta_s(self) -> float:
        """Least time that the rest of the survey takes, s; nothing is left of one that was given up or is over."""
        if self.abort_cause or self.state is MissionState.DONE:
            return 0.0
        return self.route.remaining_s(self.survey_route.index)

    @property
    def corrections(self) -> int:
        """Correction moves begun."""
        return self.missed.corrections
