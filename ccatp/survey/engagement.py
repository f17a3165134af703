"""Engagement: may the robot move, why is it held, who releases it, does it go home. The same for every mission. Pure.

A mission is always in one phase. ``Ready``, ``Held``, ``Paused``, ``Faulted`` and ``Over`` are phases of every mission.
The phases in which a mission works are its own: each is a value with what has a meaning in it alone, and of one kind.
``TRANSITIONS`` has every change of the kind. What a verdict means is decided by the rows of ``failsafe.py``.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from enum import StrEnum
from functools import partial
from math import inf
from types import MappingProxyType
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import msgspec
from msgspec.structs import replace

from ccatp.conditions import Action, Clear, Motion, Owner, find_condition, text_of
from ccatp.conditions.danger import EARTHQUAKE
from ccatp.conditions.mission import NO_VERDICT, OPERATOR
from ccatp.core import NO_CAUSE, NO_MOTION, Cause, EventCode, Permits, Severity, Verdict
from ccatp.survey.events import (
    DONE,
    HELD,
    IDLE,
    Abort,
    Fault,
    Interrupted,
    Pause,
    Resume,
    StopHere,
    SurveyInput,
    SurveyOutcome,
)


class Kind(StrEnum):
    """Kinds of phases."""

    READY = "ready"  # stands until motion is permitted for the first time
    WORK = "work"  # does its task, or finds the robot's pose again for it
    RETREAT = "retreat"  # leaves an edge
    HOME = "home"  # drives home, to end there
    HELD = "held"  # until the cause is gone
    PAUSED = "paused"  # until an operator resumes
    FAULTED = "faulted"  # the same, because of a fault
    OVER = "over"


class Event(StrEnum):
    """What changes the kind of the phase. An event that the table does not list for a kind has no effect."""

    GO_ON = "go on"  # the mission begins or continues its task, or looks for the pose
    GO_HOME = "go home"
    EDGE = "edge"  # an edge is declared
    INTERRUPT = "interrupt"  # no motion, until the cause is gone
    SHAKE = "shake"  # an earthquake
    PAUSE = "pause"  # by an operator
    FAULT = "fault"
    FINISH = "finish"  # complete, at base after an abort, or stopped by an operator


_STOPS = {Event.PAUSE: Kind.PAUSED, Event.FAULT: Kind.FAULTED, Event.FINISH: Kind.OVER}
_BEGINS = {Event.GO_ON: Kind.WORK, Event.GO_HOME: Kind.HOME}
# Kind and event -> kind. An edge precedes the way home: in a retreat GO_HOME has no effect. OVER is final.
TRANSITIONS: Mapping[Kind, Mapping[Event, Kind]] = MappingProxyType(
    {
        Kind.READY: _STOPS | _BEGINS | {Event.EDGE: Kind.RETREAT, Event.SHAKE: Kind.HELD},
        Kind.WORK: _STOPS | _BEGINS | {Event.EDGE: Kind.RETREAT, Event.SHAKE: Kind.HELD, Event.INTERRUPT: Kind.HELD},
        Kind.RETREAT: _STOPS | {Event.GO_ON: Kind.WORK, Event.SHAKE: Kind.HELD, Event.INTERRUPT: Kind.HELD},
        Kind.HOME: _STOPS
        | {Event.GO_ON: Kind.WORK, Event.EDGE: Kind.RETREAT, Event.SHAKE: Kind.HELD, Event.INTERRUPT: Kind.HELD},
        Kind.HELD: _STOPS | _BEGINS | {Event.EDGE: Kind.RETREAT},
        Kind.PAUSED: _BEGINS | {Event.FAULT: Kind.FAULTED, Event.FINISH: Kind.OVER},
        Kind.FAULTED: _BEGINS | {Event.FINISH: Kind.OVER},
        Kind.OVER: {},
    }
)
MOVING = frozenset((Kind.WORK, Kind.RETREAT, Kind.HOME))


class SummaryState(StrEnum):
    """What an engineer of the observatory knows of every component; the names are those of the Rubin Observatory."""

    OFFLINE = "offline"  # the mission is over, or no daemon runs
    STANDBY = "standby"  # ready; it begins by itself when motion is permitted
    DISABLED = "disabled"  # held by an operator, or until the observatory clears an earthquake
    ENABLED = "enabled"  # at work or on the way home; also while it is held by a cause that ends by itself
    FAULT = "fault"  # held until an operator has looked at the fault


_SUMMARY = MappingProxyType(
    {
        Kind.READY: SummaryState.STANDBY,
        Kind.PAUSED: SummaryState.DISABLED,
        Kind.FAULTED: SummaryState.FAULT,
        Kind.OVER: SummaryState.OFFLINE,
    }
)


class Phase(msgspec.Struct, frozen=True, tag=True):
    """A phase of a mission."""

    kind: ClassVar[Kind]
    shown: ClassVar[StrEnum]  # its public name, in each phase of this class

    @property
    def mode(self) -> StrEnum:
        """Public name of the phase."""
        return self.shown


class Ready(Phase, frozen=True, tag=True):
    """The mission has not begun."""

    kind, shown = Kind.READY, IDLE


class Held(Phase, frozen=True, tag=True):
    """Held until the cause is gone.

    ``rejects_odometry``: the localizer ignores wheels and inertial unit, the robot stands. ``until_s``: the hold lasts
    at least until then. ``stuck_s``: when a retreat ended without leaving the edge, ``None`` for another hold.
    """

    rejects_odometry: bool = False
    until_s: float = -inf
    stuck_s: float | None = None

    kind, shown = Kind.HELD, HELD


class Paused(Phase, frozen=True, tag=True):
    """Held until an operator resumes."""

    kind, shown = Kind.PAUSED, HELD


class Faulted(Phase, frozen=True, tag=True):
    """Held until an operator resumes, because of a fault."""

    kind, shown = Kind.FAULTED, HELD


class Over(Phase, frozen=True, tag=True):
    """The mission has ended."""

    outcome: SurveyOutcome

    kind, shown = Kind.OVER, DONE


class Earthquake(StrEnum):
    """An earthquake that the observatory has not cleared."""

    NONE = "none"
    LATCHED = "latched"  # by the danger loop; the mission still leaves an edge
    HELD = "held"  # it holds the mission; a retreat is still possible


class Engagement(msgspec.Struct, frozen=True):
    """The part of the state that all missions share. Times are robot time, s.

    A verdict repeats in every frame what is acted on once: ``emergency_epoch``, ``finding`` and ``located``.
    """

    phase: Phase = Ready()
    cause: Cause = NO_CAUSE  # why it is held, relocalizes, leaves an edge, goes home or has ended
    abort_cause: Cause = NO_CAUSE  # why it goes home, as soon as it may
    earthquake: Earthquake = Earthquake.NONE
    severity: Severity = Severity.NONE  # of the newest verdict
    is_latched: bool = False  # an emergency is latched, by the newest verdict
    is_slow: bool = False
    full_fans: bool = False  # full fans from now on
    emergency_epoch: int | None = 0  # the newest emergency acted on; None: take it from the first verdict
    finding: Cause = NO_CAUSE  # the cause of the last return home
    located: Cause = NO_CAUSE  # why a fix was taken for a sensor that stays off; until the severity is below hold

    @property
    def kind(self) -> Kind:
        """Kind of the phase."""
        return self.phase.kind

    @property
    def mode(self) -> StrEnum:
        """Public name of the phase."""
        return self.phase.mode

    @property
    def outcome(self) -> SurveyOutcome:
        """Outcome of the mission; NONE before its end."""
        return self.phase.outcome if isinstance(self.phase, Over) else SurveyOutcome.NONE

    @property
    def is_held(self) -> bool:
        """Held, by whatever and whoever."""
        return self.phase.mode is HELD

    @property
    def rejects_odometry(self) -> bool:
        """Held because wheels or inertial unit are not trusted."""
        return isinstance(self.phase, Held) and self.phase.rejects_odometry

    @property
    def is_faulted(self) -> bool:
        """A fault holds the robot."""
        return self.phase.kind is Kind.FAULTED

    @property
    def is_held_by_hand(self) -> bool:
        """Held until an operator resumes."""
        return self.phase.kind in (Kind.PAUSED, Kind.FAULTED)

    @property
    def is_paused(self) -> bool:
        """Held until an operator resumes, or reports that an earthquake is over."""
        return self.is_held_by_hand or self.is_shaken

    @property
    def is_shaken(self) -> bool:
        """Held until the observatory clears an earthquake."""
        return self.earthquake is Earthquake.HELD and self.phase.kind is Kind.HELD

    @property
    def summary_state(self) -> SummaryState:
        """The phase in the words of an observatory."""
        return SummaryState.DISABLED if self.is_shaken else _SUMMARY.get(self.phase.kind, SummaryState.ENABLED)

    @property
    def needs_fix(self) -> bool:
        """The robot needs a fix before it moves on."""
        return False

    @property
    def stands_for_fix(self) -> bool:
        """The robot stands still for a fix that it needs."""
        return False

    @property
    def is_recovering(self) -> bool:
        """The robot leaves an edge or looks for its pose, which comes before going home."""
        return self.phase.kind is Kind.RETREAT or self.needs_fix

    def permits(self, verdict: Verdict | None) -> Permits:
        """The motion that phase and verdict in force permit."""
        kind = self.phase.kind
        if verdict is None or kind not in MOVING:
            return NO_MOTION
        is_barred = verdict.is_shaking and not (kind is Kind.RETREAT and verdict.code is NEAR_EDGE)
        return NO_MOTION if is_barred else verdict.permits


NEAR_EDGE, ABORTED = EventCode.NEAR_EDGE, EventCode.ABORTED
NONE, HOLD, RETURN, FAULT = Severity.NONE, Severity.HOLD, Severity.RETURN, Severity.FAULT
S = TypeVar("S", bound=Engagement)
# Used instead of a verdict when none is fresh enough.
NO_FRESH_VERDICT = NO_VERDICT.found("verdict", 0.0, 0.0).verdict(-1, 0.0, EventCode.NORMAL)


def enter(s: S, event: Event, phase: Phase) -> S:
    """The state in ``phase`` if the table has it for the event in the present phase, else the same state."""
    return replace(s, phase=phase) if TRANSITIONS[s.phase.kind].get(event) is phase.kind else s


class Reaction(NamedTuple):
    """One reaction of a mission to a verdict.

    ``applies``: whether the row applies to a state and a verdict; ``when`` describes this. ``react``: from the rules, a
    state, the frame and the verdict to the next state, and whether the rows below are skipped in this frame.
    """

    when: str
    action: Action
    applies: Callable[[Any, Verdict], bool]
    react: Callable[[Any, Any, Any, Verdict], tuple[Any, bool]]


class EngagementRules(ABC, Generic[S]):
    """Holding, continuing and going home. ``rows``: reactions in the order of precedence.

    A mission says what it does when it may continue, at an edge and at reduced speed, and what follows from a pose that
    is not trusted. ``stuck_limit_s``: how long it waits at an edge that no motion helps to leave.
    """

    rows: tuple[Reaction, ...]
    stuck_limit_s = inf

    # -- transitions --------------------------------------------------------------------------------------------------

    def pause(self, s: S, cause: Cause) -> S:
        """Hold until an operator resumes; a fault remains one."""
        return enter(replace(s, cause=cause), Event.PAUSE, Paused())

    def interrupt(self, s: S, cause: Cause, *, stuck_s: float | None = None) -> S:
        """Hold until the cause is gone; no effect in a phase in which the robot stands anyway."""
        after = enter(s, Event.INTERRUPT, Held(stuck_s=stuck_s))
        return s if after is s else replace(after, cause=cause)

    def fault(self, s: S, cause: Cause, *, loses_pose: bool = False) -> S:
        """Hold until an operator resumes, because of a fault. With ``loses_pose`` the robot relocalizes then."""
        if s.kind is Kind.OVER:
            return s
        s = self.lose_pose(s) if loses_pose and not s.needs_fix else s
        return enter(replace(s, cause=cause), Event.FAULT, Faulted())

    def shake(self, s: S, cause: Cause) -> S:
        """Hold in an earthquake. Afterwards the robot relocalizes, because it may have slipped, and drives home."""
        if s.earthquake is Earthquake.HELD or s.kind is Kind.OVER:
            return s
        s = self.lose_pose(replace(s, earthquake=Earthquake.HELD, cause=cause, abort_cause=s.abort_cause or cause))
        if isinstance(s.phase, Held):
            return replace(s, phase=replace(s.phase, rejects_odometry=False))
        return enter(s, Event.SHAKE, Held())

    def meet(
        self,
        s: S,
        cause: Cause,
        *,
        usual: Clear = Clear.AUTO,
        loses_pose: bool = False,
        until_s: float = -inf,
        stuck_s: float | None = None,
    ) -> S:
        """React to what the mission, its fixes or its loop have found, as motion and clear of its row say.

        ``usual``: what ends the hold for a cause without a row. The others: as in ``fault``, ``await_recovery`` and
        ``interrupt``.
        """
        row = find_condition(cause.condition)
        motion, clear = (Motion.NONE, usual) if row is None else (row.motion, row.clear or Clear.AUTO)
        if motion is Motion.ANY:
            return s
        if motion is not Motion.NONE:
            return self.abort(s, cause)
        if clear is Clear.OPERATOR:
            return self.fault(s, cause, loses_pose=loses_pose)
        if clear is Clear.AFTER_FIX:
            return self.await_recovery(s, cause, until_s=until_s)
        return self.interrupt(s, cause, stuck_s=stuck_s)

    def await_recovery(
        self, s: S, cause: Cause, *, rejects_odometry: bool = False, relocalizes: bool = True, until_s: float = -inf
    ) -> S:
        """Hold until the cause is gone, and not before ``until_s``; then relocalize before moving on."""
        if s.kind is Kind.OVER or s.is_held_by_hand:
            return s
        s = replace(self.interrupt(s, cause), cause=cause)
        s = self.lose_pose(s, doubts_odometry=False) if relocalizes else s
        if not isinstance(s.phase, Held):
            return s
        rejects_odometry |= s.phase.rejects_odometry
        return replace(
            s, phase=replace(s.phase, rejects_odometry=rejects_odometry, until_s=max(s.phase.until_s, until_s))
        )

    def abort(self, s: S, cause: Cause) -> S:
        """Return to base and end there."""
        if s.kind is Kind.OVER:
            return s
        is_new = not s.abort_cause
        s = replace(s, abort_cause=s.abort_cause or cause)
        if s.earthquake is Earthquake.HELD:
            return s  # it goes home when that is cleared
        return self.proceed(s) if s.is_held or (is_new and not s.is_recovering) else s

    def finish(self, s: S, outcome: SurveyOutcome) -> S:
        """End the mission."""
        return enter(s, Event.FINISH, Over(outcome))

    @abstractmethod
    def proceed(self, s: S) -> S:
        """Change to the next task."""

    def lose_pose(self, s: S, *, doubts_odometry: bool = True) -> S:
        """Mark the pose as not trusted; with ``doubts_odometry`` the localizer inflates its covariance."""
        del doubts_odometry
        return s

    def change_speed(self, s: S, *, is_slow: bool) -> S:
        """Reduce the speed now, or return to the usual speed."""
        return replace(s, is_slow=is_slow)

    def retreat(self, s: S, frame: Any, verdict: Verdict) -> S:
        """Leave the edge that a verdict reports; a mission without a retreat holds until the edge is gone."""
        del frame
        return self.interrupt(s, verdict.cause)

    # -- events between two frames ------------------------------------------------------------------------------------

    def handle(self, s: S, event: SurveyInput) -> tuple[S, str | None]:
        """The state after an event between two frames, and why it was refused, or ``None``."""
        match event:
            case Interrupted(cause):
                if s.is_held and cause.condition != s.cause.condition and _is_of_main(s.cause) and _is_of_main(cause):
                    return replace(s, cause=cause), None
                return self.meet(s, cause), None
            case Fault(cause, loses_pose):
                react = self.fault if _is_raised(cause) else partial(self.meet, usual=Clear.OPERATOR)
                return react(s, cause, loses_pose=loses_pose), None
            case Resume():
                refusal = _resume_refusal(s)
                return (self.proceed(s), None) if refusal is None else (s, refusal)
            case Pause() | Abort() | StopHere() if s.kind is Kind.OVER:
                return s, "the mission is over"
            case Pause(cause):
                return self.pause(s, cause), None
            case Abort(cause):
                return self.abort(s, cause), None
            case StopHere():
                return self.finish(s, SurveyOutcome.STOPPED), None
        raise TypeError(f"a mission has no reaction to {event!r}")

    # -- verdicts -----------------------------------------------------------------------------------------------------

    def react(self, s: S, frame: Any, verdict: Verdict | None) -> S:
        """React to the verdict in force (``None``: none is fresh enough) in a frame at ``frame.t_s``."""
        if verdict is None or not _is_routine(s, verdict):
            s = s if verdict is None else _with_verdict(s, verdict)
            v = verdict or NO_FRESH_VERDICT
            for row in self.rows:
                if row.applies(s, v):
                    s, is_over = row.react(self, s, frame, v)
                    if is_over:
                        return s
        phase = s.phase
        is_free = phase.kind is Kind.READY or (isinstance(phase, Held) and frame.t_s >= phase.until_s)
        return self.proceed(s) if is_free else s


def _is_raised(cause: Cause) -> bool:
    """Whether a fault is that of another severity that lasted."""
    row = find_condition(cause.condition)
    return row is not None and row.severity is not FAULT


def _is_of_main(cause: Cause) -> bool:
    """Whether the main loop finds a cause: of several, the newest one counts."""
    row = find_condition(cause.condition)
    return row is not None and row.owner is Owner.MAIN


def _resume_refusal(s: Engagement) -> str | None:
    if not s.is_held:
        return f"the mission is not held but {s.mode}"
    if s.earthquake is not Earthquake.NONE:
        return f"{EARTHQUAKE.message}: nothing moves until that is cleared"
    if s.is_latched and not s.abort_cause:
        return "an emergency of before is latched: 'ccatp clear' it first"
    if s.severity >= HOLD and s.severity is not RETURN:
        is_paused = s.cause.condition == OPERATOR.name  # danger's own finding is not in the state
        what = f"danger has found a {s.severity.name.lower()}; see 'ccatp alarms'" if is_paused else text_of(s.cause)
        return f"the cause persists: {what}"
    return None


def _is_routine(s: Engagement, v: Verdict) -> bool:
    """Whether no row applies, and nothing in the verdict has to be stored in the state."""
    is_normal = (
        not v.cause
        and v.severity is NONE
        and v.code is EventCode.NORMAL
        and not (v.is_shaking or v.raised or v.full_fans)
    )
    was_normal = s.severity is NONE and s.earthquake is Earthquake.NONE
    was_normal = was_normal and not (s.is_latched or s.located or s.is_slow)
    is_known = s.emergency_epoch is not None and not (isinstance(s.phase, Held) and s.phase.stuck_s is not None)
    return is_normal and was_normal and is_known and v.forward and v.reverse and v.turn


def _with_verdict(s: S, v: Verdict) -> S:
    """Store the parts of a verdict that later frames need."""
    epoch, full_fans = s.emergency_epoch, s.full_fans or v.full_fans or v.is_shaking
    is_latched, earthquake = v.raised > 0, Earthquake.NONE
    if v.is_shaking:
        earthquake = Earthquake.HELD if s.earthquake is Earthquake.HELD else Earthquake.LATCHED
    located = s.located if v.severity >= HOLD else NO_CAUSE
    new = v.severity, is_latched, full_fans, located, earthquake
    if epoch is not None and new == (s.severity, s.is_latched, s.full_fans, s.located, s.earthquake):
        return s
    return replace(
        s,
        severity=v.severity,
        is_latched=is_latched,
        full_fans=full_fans,
        located=located,
        earthquake=earthquake,
        emergency_epoch=v.raised if epoch is None else epoch,
    )


class EngagedMission(Generic[S]):
    """The only owner of a mission's state, for the callers that send frames and those that send events."""

    def __init__(self, rules: EngagementRules[S], state: S) -> None:
        self._rules, self._state = rules, state

    @property
    def state(self) -> S:
        """The present state."""
        return self._state

    def handle(self, event: SurveyInput) -> str | None:
        """Apply an event between two frames; returns why it was refused, or ``None``."""
        self._state, refusal = self._rules.handle(self._state, event)
        return refusal

    def after(self, event: SurveyInput) -> S | None:
        """The state after an event if it were applied now, ``None`` if it would be refused; nothing changes."""
        state, refusal = self._rules.handle(self._state, event)
        return state if refusal is None else None

    def react(self, frame: Any, verdict: Verdict | None) -> S:
        """React to the verdict in force in a frame; the state after it."""
        self._state = self._rules.react(self._state, frame, verdict)
        return self._state

    def finish(self, outcome: SurveyOutcome) -> None:
        """End the mission."""
        self._state = self._rules.finish(self._state, outcome)
