"""State of a mission, one frozen value, and the rules from one state to the next that hold for every mission."""

from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from math import inf
from typing import Any, Generic, NamedTuple, TypeVar

import msgspec
from msgspec.structs import replace

from ccatp.conditions import EARTHQUAKE, NO_VERDICT, Action
from ccatp.control.gate import Purpose
from ccatp.core import EventCode, PointId, Severity, Stop, Verdict
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
    MissionState,
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
    """Whether a fix comes before the next move."""

    NONE = "none"
    CONFIRM = "confirm"  # at the start: the pose is not confirmed yet
    RELOCALIZE = "relocalize"  # the pose is known to be wrong


class Hold(NamedTuple):
    """How the robot is held."""

    by_hand: bool = False  # until an operator resumes
    is_fault: bool = False  # an operator has to look after it
    rejects_odometry: bool = False  # whatever wheels and inertial unit say, the robot stands


class HoldState(msgspec.Struct, frozen=True):
    """What every mission knows at one time: what it is at, how it is held, and why; times are robot time, s."""

    mode: MissionState = IDLE
    outcome: SurveyOutcome = SurveyOutcome.NONE
    cause: str = ""
    hold: Hold = Hold()
    abort_cause: str = ""  # why the mission was given up
    interlock: str = ""  # why nothing may move: an earthquake
    is_latched: bool = False  # of the newest verdict: an emergency, an earthquake, the gravest finding
    is_shaking: bool = False
    severity: Severity = Severity.NONE
    is_slow: bool = False
    full_fans: bool = False  # the robot shall be pressed on with full fans, from now on
    has_looked: bool = False  # a sensor that stays off was looked at with a fix
    finding: str = ""  # the cause for which the robot was sent home last
    emergency_epoch: int | None = 0  # the newest emergency acted on; None: what the first verdict has is not new
    stuck_s: float | None = None  # since when a retreat led nowhere
    resumes_after_s: float = -inf  # a hold that goes on by itself lasts at least until then

    @property
    def rejects_odometry(self) -> bool:
        """Held because wheels or inertial unit are not to be believed."""
        return self.mode is HELD and self.hold.rejects_odometry

    @property
    def is_faulted(self) -> bool:
        """An operator has to look after it."""
        return self.hold.is_fault

    @property
    def is_held_by_hand(self) -> bool:
        """Held until an operator resumes."""
        return self.mode is HELD and self.hold.by_hand

    @property
    def is_paused(self) -> bool:
        """Held until an operator resumes, or reports that an earthquake is over."""
        return self.mode is HELD and (self.hold.by_hand or bool(self.interlock))

    @property
    def stands_for_fix(self) -> bool:
        """It stands so that a fix shows where it is."""
        return False

    @property
    def is_recovering(self) -> bool:
        """It leaves an edge, or has to be found, before it may go home."""
        return False


class SurveyState(HoldState, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """All that a survey knows at one time."""

    route: Route
    stop_index: int = 0  # of the stop driven to, or measured at
    behaviour: Leg | Settling | Retreat | ReturnHome | None = None  # made on entry into a mode, dropped on leaving it
    fix: FixNeed = FixNeed.NONE
    done: tuple[PointId, ...] = ()  # points measured, in order
    skipped: tuple[PointId, ...] = ()  # points whose measurement failed
    failure_causes: Mapping[PointId, str] = msgspec.field(default_factory=dict)  # of those not measured since
    due: tuple[PointId, ...] = ()  # points to be measured next, in this order, away from the planned route
    retried: frozenset[PointId] = frozenset()  # points that failed and were due once more
    is_off_route: bool = False
    is_review_due: bool = False
    inflates_covariance: bool = False  # the localizer shall widen its covariance; the next command says so once
    wants_calibration: bool = False  # the calibration drive was given up, too far from where it leads
    is_missed: bool = False  # the last fix shows the robot too far from its point
    corrected: Stop | None = None  # the stop of the last correction
    corrections: int = 0
    request: int = 0  # number of the measurement that was asked for last
    arrived_at: PointId | None = None  # the last point with an arrival
    failures: int = 0  # failed measurements in a row
    heading_legs_left: int = 0  # of the search for the heading
    was_reverse: bool = True
    budget: BudgetProgress = BudgetProgress()
    is_found: bool = False  # a fix has just found the robot
    backoffs: int = 0
    stands_until_s: float = -inf  # nothing moves before then
    recoveries_s: tuple[float, ...] = ()  # when the estimate broke down lately

    @property
    def stop(self) -> Stop | None:
        """The stop of the route that is driven to, or measured at; ``None`` behind the last."""
        stops = self.route.stops
        return stops[self.stop_index] if self.stop_index < len(stops) else None

    @property
    def stops(self) -> Sequence[Stop]:
        """What is being driven along: the route, the way home, or a leg that shows the heading."""
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
        """The point being measured; ``None`` for a fix that only serves to find the robot again."""
        stop = self.stop
        return None if self.fix is not FixNeed.NONE or stop is None else stop.point

    @property
    def purpose(self) -> Purpose:
        """What the last gate lets the robot move for: legs that show the heading may be part of the way home."""
        if self.abort_cause and self.fix is not FixNeed.NONE and self.mode in (TURNING, DRIVING):
            return Purpose.HOMEWARD
        return PURPOSES[self.mode]

    @property
    def is_lost(self) -> bool:
        """The pose is known to be wrong, and is to be found again; at the start it is only to be confirmed."""
        return self.fix is FixNeed.RELOCALIZE

    @property
    def stands_for_fix(self) -> bool:
        """It stands so that a fix shows where it is."""
        return self.fix is not FixNeed.NONE and self.mode in (SETTLING, MEASURING)

    @property
    def is_recovering(self) -> bool:
        """It leaves an edge, or has to be found, before it may go home."""
        return self.mode is BACKING_OFF or self.fix is not FixNeed.NONE

    @property
    def is_awaiting_fix(self) -> bool:
        """Whether the measurement asked for last, number ``request``, is still wanted."""
        behaviour = self.behaviour
        return self.mode is MEASURING and isinstance(behaviour, Settling) and behaviour.is_requested

    @property
    def eta_s(self) -> float:
        """Least time that the rest of the survey takes, s; nothing is left of one that was given up or is over."""
        return 0.0 if self.abort_cause or self.mode is DONE else self.route.remaining_s(self.stop_index)


def by_reason(causes: Mapping[PointId, str]) -> dict[str, list[str]]:
    """Points, as people name them, by why they were left out."""
    named: dict[str, list[str]] = {}
    for point, why in causes.items():
        named.setdefault(why, []).append(f"{point.row}-{point.col}-{point.point}")
    return named


NEAR_EDGE, ABORTED = EventCode.NEAR_EDGE, EventCode.ABORTED
NONE, HOLD, RETURN, FAULT = Severity.NONE, Severity.HOLD, Severity.RETURN, Severity.FAULT
S = TypeVar("S", bound=HoldState)
# In place of a verdict where none is fresh enough.
NO_FRESH_VERDICT = NO_VERDICT.found("verdict", 0.0, 0.0).verdict(-1, 0.0, EventCode.NORMAL)


class Row(NamedTuple):
    """What a mission does about a verdict: one row.

    ``applies`` to a state and the verdict in force; ``when`` says so in words. ``react`` takes the rules, a state, the
    frame and the verdict, and returns the state, and whether that is all for this frame; otherwise the rows below count
    as well.
    """

    when: str
    action: Action
    applies: Callable[[Any, Verdict], bool]
    react: Callable[[Any, Any, Any, Verdict], tuple[Any, bool]]


class HoldRules(Generic[S]):
    """From one state to the next where a mission is held, goes on, or goes home.

    Attributes:
        rows: in the order of precedence.
    """

    rows: tuple[Row, ...]

    # -- transitions --------------------------------------------------------------------------------------------------

    def apply(self, s: S, event: MissionEvent) -> S:
        """The mode changes as the table says."""
        mode = next_state(s.mode, event)
        return s if mode is s.mode else replace(s, mode=mode)

    def hold(self, s: S, cause: str, *, by_hand: bool, is_fault: bool = False) -> S:
        """Hold, until somebody resumes or until the cause is gone; what was begun begins again afterwards."""
        return self.apply(replace(s, hold=Hold(by_hand, is_fault or s.hold.is_fault), cause=cause), MissionEvent.HOLD)

    def interrupt(self, s: S, cause: str) -> S:
        """Hold until frames and verdicts are fresh again; no effect where it stands anyway."""
        return s if s.mode in (IDLE, HELD, DONE) else self.hold(s, cause, by_hand=False)

    def fault(self, s: S, cause: str, *, loses_pose: bool = False) -> S:
        """Hold until an operator resumes, because something is wrong; without a pose, a fix comes first then."""
        return s if s.mode is DONE else self.hold(s, cause, by_hand=True, is_fault=True)

    def await_recovery(self, s: S, cause: str, *, rejects_odometry: bool = False) -> S:
        """Hold until the cause is gone, and then find out where the robot is before moving on."""
        if s.mode is DONE or s.is_held_by_hand:
            return s
        rejects_odometry |= s.rejects_odometry
        s = self.lose_pose(replace(self.interrupt(s, cause), cause=cause), doubts_odometry=False)
        return replace(s, hold=s.hold._replace(rejects_odometry=rejects_odometry))

    def abort(self, s: S, cause: str) -> S:
        """Return to base and end there."""
        if s.mode is DONE:
            return s
        is_new = not s.abort_cause
        s = replace(s, abort_cause=s.abort_cause or cause)
        if s.interlock:
            return s  # home, but not before the robot may move
        return self.proceed(s) if s.mode is HELD or (is_new and not s.is_recovering) else s

    def proceed(self, s: S) -> S:
        """To what is next."""
        raise NotImplementedError

    def lose_pose(self, s: S, *, doubts_odometry: bool = True) -> S:
        """The pose is not to be trusted, nor what odometry has made of it where that is doubted."""
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
        """Do what the verdict in force demands (``None``: none fresh enough) in a frame at ``frame.t_s``."""
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
        return f"{s.interlock or EARTHQUAKE.message}: nothing moves until that is cleared"
    if s.is_latched and not s.abort_cause:
        return "an emergency of before is latched: 'ccatp clear' it first"
    if s.severity >= HOLD and s.severity is not RETURN:
        return f"the cause persists: {s.cause}"
    return None


def _is_routine(s: HoldState, v: Verdict) -> bool:
    """No row applies to such a verdict in such a state, and it says nothing that has to be remembered."""
    is_normal = v.severity is NONE and v.code is EventCode.NORMAL and not (v.is_shaking or v.raised or v.full_fans)
    was_normal = s.severity is NONE and not (s.is_latched or s.is_shaking or s.interlock or s.has_looked or s.is_slow)
    is_known = s.emergency_epoch is not None and s.stuck_s is None
    return is_normal and was_normal and is_known and v.forward and v.reverse and v.turn


def _with_levels(s: S, v: Verdict) -> S:
    """What the verdict says that is remembered."""
    epoch, full_fans = s.emergency_epoch, s.full_fans or v.full_fans or v.is_shaking
    has_looked, interlock = s.has_looked and v.severity >= HOLD, s.interlock if v.is_shaking else ""
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
