"""State of a mission as one frozen value, and the state transitions that all missions share."""

from collections.abc import Callable, Mapping, Sequence
from enum import Enum, StrEnum
from math import inf
from typing import Any, Generic, NamedTuple, TypeVar

import msgspec
from msgspec.structs import replace

from ccatp.conditions import EARTHQUAKE, NO_VERDICT, Action, text_of
from ccatp.control.gate import Purpose
from ccatp.core import NO_CAUSE, Cause, EventCode, PointId, Severity, Stop, Verdict
from ccatp.survey.behaviours import Retreat, ReturnHome, Settling
from ccatp.survey.budget import BudgetProgress
from ccatp.survey.events import (
    BACKING_OFF,
    DONE,
    DRIVING,
    HELD,
    IDLE,
    MEASURING,
    PURPOSES,
    SETTLING,
    TURNING,
    Abort,
    Fault,
    Interrupted,
    MissionEvent,
    Mode,
    Pause,
    Resume,
    StopHere,
    SurveyInput,
    SurveyOutcome,
    next_state,
)
from ccatp.survey.planning.route import Route
from ccatp.survey.route_follower import Leg


class FixNeed(Enum):
    """Whether the robot needs a fix before it moves."""

    NONE = "none"
    CONFIRM = "confirm"  # the pose is not confirmed yet
    RELOCALIZE = "relocalize"  # the pose is known to be wrong


class Hold(NamedTuple):
    """How the robot is held."""

    by_hand: bool = False  # until an operator resumes
    is_fault: bool = False  # a fault, which needs an operator
    rejects_odometry: bool = False  # the localizer ignores wheels and inertial unit: the robot stands


class HoldState(msgspec.Struct, frozen=True):
    """The part of the state that all missions share: mode, hold and causes. Times are robot time, s."""

    mode: StrEnum = IDLE
    outcome: SurveyOutcome = SurveyOutcome.NONE
    cause: Cause = NO_CAUSE
    hold: Hold = Hold()
    abort_cause: Cause = NO_CAUSE  # why the mission was aborted
    interlock: bool = False  # no motion is allowed: an earthquake
    is_latched: bool = False  # in the newest verdict: an emergency is latched
    is_shaking: bool = False  # likewise: an earthquake
    severity: Severity = Severity.NONE  # of the newest verdict
    is_slow: bool = False
    full_fans: bool = False  # full fans from now on
    has_looked: bool = False  # a fix was taken because a sensor stays off
    finding: Cause = NO_CAUSE  # the cause of the last return home
    emergency_epoch: int | None = 0  # the newest emergency acted on; None: take it from the first verdict
    stuck_s: float | None = None  # when a retreat ended without leaving the edge
    resumes_after_s: float = -inf  # a hold that ends by itself lasts at least until then

    @property
    def rejects_odometry(self) -> bool:
        """Held because wheels or inertial unit are not trusted."""
        return self.mode is HELD and self.hold.rejects_odometry

    @property
    def is_faulted(self) -> bool:
        """A fault holds the robot."""
        return self.hold.is_fault

    @property
    def is_held_by_hand(self) -> bool:
        """Held until an operator resumes."""
        return self.mode is HELD and self.hold.by_hand

    @property
    def is_paused(self) -> bool:
        """Held until an operator resumes, or reports that an earthquake is over."""
        return self.mode is HELD and (self.hold.by_hand or self.interlock)

    @property
    def stands_for_fix(self) -> bool:
        """The robot stands still for a fix that relocalizes it."""
        return False

    @property
    def is_recovering(self) -> bool:
        """The robot leaves an edge or relocalizes, which comes before going home."""
        return False


class SurveyState(HoldState, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """The state of a survey."""

    mode: Mode = IDLE

    route: Route
    stop_index: int = 0  # of the stop driven to, or measured at
    behaviour: Leg | Settling | Retreat | ReturnHome | None = None  # created on entry into a mode, dropped on leaving
    fix: FixNeed = FixNeed.NONE
    done: tuple[PointId, ...] = ()  # points measured, in order
    skipped: tuple[PointId, ...] = ()  # points whose measurement failed
    failure_causes: Mapping[PointId, str] = msgspec.field(default_factory=dict)  # only of points not measured since
    due: tuple[PointId, ...] = ()  # points to measure next, in this order, instead of the planned route
    retried: frozenset[PointId] = frozenset()  # failed points that have had their second try
    is_off_route: bool = False
    is_review_due: bool = False
    inflates_covariance: bool = False  # the next command tells the localizer to inflate its covariance
    wants_calibration: bool = False  # the calibration drive was skipped, because the robot is too far from it
    is_missed: bool = False  # the last fix shows the robot too far from its point
    corrected: Stop | None = None  # the stop of the last correction
    corrections: int = 0
    request: int = 0  # number of the last requested measurement
    arrived_at: PointId | None = None  # the last point with an arrival
    failures: int = 0  # failed measurements in a row
    heading_legs_left: int = 0  # legs left to determine the heading
    was_reverse: bool = True
    budget: BudgetProgress = BudgetProgress()
    is_found: bool = False  # a fix has just relocalized the robot
    backoffs: int = 0
    is_confirmed: bool = False  # a fix was taken since a way was found last
    stands_until_s: float = -inf  # no motion before then
    recoveries_s: tuple[float, ...] = ()  # times of the recent divergences of the estimate

    @property
    def stop(self) -> Stop | None:
        """The stop of the route that is driven to, or measured at; ``None`` after the last."""
        stops = self.route.stops
        return stops[self.stop_index] if self.stop_index < len(stops) else None

    @property
    def stops(self) -> Sequence[Stop]:
        """The stops being driven along: the route, the way home, or a leg that shows the heading."""
        behaviour = self.behaviour
        if isinstance(behaviour, ReturnHome):
            return behaviour.stops
        if isinstance(behaviour, Leg) and self.fix is not FixNeed.NONE:
            return (behaviour.stop,)
        return self.route.stops

    @property
    def next_point(self) -> PointId | None:
        """The point to be measured next, at the current stop or a later one."""
        return next((stop.point for stop in self.route.stops[self.stop_index :] if stop.point is not None), None)

    @property
    def measuring_point(self) -> PointId | None:
        """The point being measured; ``None`` for a fix that only relocalizes."""
        stop = self.stop
        return None if self.fix is not FixNeed.NONE or stop is None else stop.point

    @property
    def purpose(self) -> Purpose:
        """The purpose for the drive gate. After an abort, legs that show the heading belong to the way home."""
        if self.abort_cause and self.fix is not FixNeed.NONE and self.mode in (TURNING, DRIVING):
            return Purpose.HOMEWARD
        return PURPOSES[self.mode]

    @property
    def is_lost(self) -> bool:
        """The pose is known to be wrong. At the start it only has to be confirmed."""
        return self.fix is FixNeed.RELOCALIZE

    @property
    def stands_for_fix(self) -> bool:
        """The robot stands still for a fix that relocalizes it."""
        return self.fix is not FixNeed.NONE and self.mode in (SETTLING, MEASURING)

    @property
    def is_recovering(self) -> bool:
        """The robot leaves an edge or relocalizes, which comes before going home."""
        return self.mode is BACKING_OFF or self.fix is not FixNeed.NONE

    @property
    def is_awaiting_fix(self) -> bool:
        """Whether the last requested measurement, number ``request``, is still wanted."""
        behaviour = self.behaviour
        return self.mode is MEASURING and isinstance(behaviour, Settling) and behaviour.is_requested

    @property
    def eta_s(self) -> float:
        """Least time that the rest of the survey takes, s; nothing is left of one that was given up or is over."""
        return 0.0 if self.abort_cause or self.mode is DONE else self.route.remaining_s(self.stop_index)


def by_reason(causes: Mapping[PointId, str]) -> dict[str, list[str]]:
    """Names of points ("row-column-number") by the reason why they were left out."""
    named: dict[str, list[str]] = {}
    for point, why in causes.items():
        named.setdefault(why, []).append(f"{point.row}-{point.col}-{point.point}")
    return named


NEAR_EDGE, ABORTED = EventCode.NEAR_EDGE, EventCode.ABORTED
NONE, HOLD, RETURN, FAULT = Severity.NONE, Severity.HOLD, Severity.RETURN, Severity.FAULT
S = TypeVar("S", bound=HoldState)
# Used instead of a verdict when none is fresh enough.
NO_FRESH_VERDICT = NO_VERDICT.found("verdict", 0.0, 0.0).verdict(-1, 0.0, EventCode.NORMAL)


class Row(NamedTuple):
    """One reaction of a mission to a verdict.

    ``applies``: whether the row applies to a state and a verdict; ``when`` describes this. ``react``: from the rules, a
    state, the frame and the verdict to the next state, and whether the rows below are skipped in this frame.
    """

    when: str
    action: Action
    applies: Callable[[Any, Verdict], bool]
    react: Callable[[Any, Any, Any, Verdict], tuple[Any, bool]]


class HoldRules(Generic[S]):
    """State transitions for holding, continuing and going home. ``rows``: reactions in the order of precedence."""

    rows: tuple[Row, ...]

    # -- transitions --------------------------------------------------------------------------------------------------

    def apply(self, s: S, event: MissionEvent) -> S:
        """Change the mode by the table of transitions."""
        mode = next_state(s.mode, event)
        return s if mode is s.mode else replace(s, mode=mode)

    def hold(self, s: S, cause: Cause, *, by_hand: bool, is_fault: bool = False) -> S:
        """Hold until an operator resumes (``by_hand``) or the cause is gone."""
        return self.apply(replace(s, hold=Hold(by_hand, is_fault or s.hold.is_fault), cause=cause), MissionEvent.HOLD)

    def interrupt(self, s: S, cause: Cause) -> S:
        """Hold until the cause is gone; no effect in a mode in which the robot stands anyway."""
        return s if s.mode in (IDLE, HELD, DONE) else self.hold(s, cause, by_hand=False)

    def fault(self, s: S, cause: Cause, *, loses_pose: bool = False) -> S:
        """Hold until an operator resumes, because of a fault. With ``loses_pose`` the robot relocalizes then."""
        return s if s.mode is DONE else self.hold(s, cause, by_hand=True, is_fault=True)

    def await_recovery(self, s: S, cause: Cause, *, rejects_odometry: bool = False, relocalizes: bool = True) -> S:
        """Hold until the cause is gone, then relocalize before moving on."""
        if s.mode is DONE or s.is_held_by_hand:
            return s
        rejects_odometry |= s.rejects_odometry
        s = replace(self.interrupt(s, cause), cause=cause)
        s = self.lose_pose(s, doubts_odometry=False) if relocalizes else s
        return replace(s, hold=s.hold._replace(rejects_odometry=rejects_odometry))

    def abort(self, s: S, cause: Cause) -> S:
        """Return to base and end there."""
        if s.mode is DONE:
            return s
        is_new = not s.abort_cause
        s = replace(s, abort_cause=s.abort_cause or cause)
        if s.interlock:
            return s  # it goes home when the interlock is released
        return self.proceed(s) if s.mode is HELD or (is_new and not s.is_recovering) else s

    def proceed(self, s: S) -> S:
        """Change to the next task."""
        raise NotImplementedError

    def lose_pose(self, s: S, *, doubts_odometry: bool = True) -> S:
        """Mark the pose as not trusted; with ``doubts_odometry`` the localizer inflates its covariance."""
        return s

    # -- events between two frames ------------------------------------------------------------------------------------

    def handle(self, s: S, event: SurveyInput) -> tuple[S, str | None]:
        """The state after an event between two frames, and why it was refused, or ``None``."""
        match event:
            case Interrupted(cause):
                return self.interrupt(s, cause), None
            case Fault(cause, loses_pose):
                return self.fault(s, cause, loses_pose=loses_pose), None
            case Resume():
                refusal = _resume_refusal(s)
                return (self.proceed(s), None) if refusal is None else (s, refusal)
            case Pause() | Abort() | StopHere() if s.mode is DONE:
                return s, "the mission is over"
            case Pause(cause):
                return self.hold(s, cause, by_hand=True), None
            case Abort(cause):
                return self.abort(s, cause), None
        return self.apply(replace(s, outcome=SurveyOutcome.STOPPED), MissionEvent.FINISHED), None

    # -- verdicts -----------------------------------------------------------------------------------------------------

    def react(self, s: S, frame: Any, verdict: Verdict | None) -> S:
        """React to the verdict in force (``None``: none is fresh enough) in a frame at ``frame.t_s``."""
        if verdict is None or not _is_routine(s, verdict):
            s = s if verdict is None else _with_levels(s, verdict)
            v = verdict or NO_FRESH_VERDICT
            for row in self.rows:
                if row.applies(s, v):
                    s, is_over = row.react(self, s, frame, v)
                    if is_over:
                        return s
        is_waiting = s.mode is HELD and (s.hold.by_hand or frame.t_s < s.resumes_after_s)
        return self.proceed(s) if s.mode is IDLE or (s.mode is HELD and not is_waiting) else s


def _resume_refusal(s: HoldState) -> str | None:
    if s.mode is not HELD:
        return f"the mission is not held but {s.mode}"
    if s.interlock or s.is_shaking:
        return f"{EARTHQUAKE.message}: nothing moves until that is cleared"
    if s.is_latched and not s.abort_cause:
        return "an emergency of before is latched: 'ccatp clear' it first"
    if s.severity >= HOLD and s.severity is not RETURN:
        return f"the cause persists: {text_of(s.cause)}"
    return None


def _is_routine(s: HoldState, v: Verdict) -> bool:
    """Whether no row applies, and nothing in the verdict has to be stored in the state."""
    is_normal = (
        not v.cause
        and v.severity is NONE
        and v.code is EventCode.NORMAL
        and not (v.is_shaking or v.raised or v.full_fans)
    )
    was_normal = s.severity is NONE and not (s.is_latched or s.is_shaking or s.interlock or s.has_looked or s.is_slow)
    is_known = s.emergency_epoch is not None and s.stuck_s is None
    return is_normal and was_normal and is_known and v.forward and v.reverse and v.turn


def _with_levels(s: S, v: Verdict) -> S:
    """Store the parts of a verdict that later frames need."""
    epoch, full_fans = s.emergency_epoch, s.full_fans or v.full_fans or v.is_shaking
    has_looked, interlock = s.has_looked and v.severity >= HOLD, s.interlock and v.is_shaking
    levels = v.raised > 0, v.is_shaking, v.severity, full_fans, has_looked, interlock
    known = s.is_latched, s.is_shaking, s.severity, s.full_fans, s.has_looked, s.interlock
    if levels == known and epoch is not None:
        return s
    return replace(
        s,
        is_latched=v.raised > 0,
        is_shaking=v.is_shaking,
        severity=v.severity,
        full_fans=full_fans,
        has_looked=has_looked,
        interlock=interlock,
        emergency_epoch=v.raised if epoch is None else epoch,
    )
