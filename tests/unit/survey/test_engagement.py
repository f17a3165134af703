"""The engagement of any mission with edges, explored exhaustively: every state, verdict, event and side of a timer.

The mission here has all that engagement knows of a mission and nothing else: whether its pose is trusted, whether it
stands, and what it does next. What the work decides (a fix succeeds, a leg ends, an edge is left) may happen at any
time. Times are relative to the limits of the timers: a frame comes before, at and after them.

A state is the same as another one if no rule can tell them apart: texts of causes, the speed and the fans are left out,
of the newest verdict only what a refusal to resume depends on, and of the number of emergencies only whether it is new.
"""

from collections import deque
from collections.abc import Callable, Iterator
from enum import StrEnum
from itertools import product
from types import MappingProxyType, SimpleNamespace
from typing import NamedTuple

import pytest
from msgspec.structs import replace

from ccatp.conditions.danger import (
    BATTERY_LOW,
    EARTHQUAKE,
    EDGE_SENSOR_STAYS_OFF,
    EDGE_STALE,
    EMERGENCY,
    FRAMES_LOST,
    GRIP_TOO_LITTLE,
    RIM_AHEAD,
    SAMPLES_TOO_FEW,
    UNKNOWN_REPORTED,
    WHEELS_STAND,
)
from ccatp.conditions.mission import (
    FILTER_DIVERGED,
    NO_FRAME_FOR,
    OPERATOR,
    STUCK_AT_EDGE,
)
from ccatp.core import Cause, EventCode, Severity, Verdict
from ccatp.survey import engagement
from ccatp.survey.engagement import (
    TRANSITIONS,
    Earthquake,
    Engagement,
    EngagementRules,
    Event,
    Faulted,
    Held,
    Kind,
    Over,
    Paused,
    Phase,
    SummaryState,
    enter,
)
from ccatp.survey.events import (
    BACKING_OFF,
    DRIVING,
    MEASURING,
    RETURNING,
    Abort,
    Fault,
    Interrupted,
    Pause,
    Resume,
    StopHere,
    SurveyInput,
    SurveyOutcome,
)
from ccatp.survey.failsafe import ROWS, is_denied


class Task(Phase, frozen=True, tag=True):
    """At work; ``stands``: for a measurement."""

    stands: bool

    kind, shown = Kind.WORK, DRIVING

    @property
    def mode(self) -> StrEnum:
        return MEASURING if self.stands else DRIVING


class Leaving(Phase, frozen=True, tag=True):
    kind, shown = Kind.RETREAT, BACKING_OFF


class Homeward(Phase, frozen=True, tag=True):
    kind, shown = Kind.HOME, RETURNING


class State(Engagement, frozen=True):
    is_lost: bool = False

    @property
    def needs_fix(self) -> bool:
        return self.is_lost

    @property
    def stands_for_fix(self) -> bool:
        return self.is_lost and self.stands

    @property
    def stands(self) -> bool:
        return isinstance(self.phase, Task) and self.phase.stands


LIMIT_S = 7.0


class Rules(EngagementRules[State]):
    rows, stuck_limit_s = ROWS, LIMIT_S

    def proceed(self, s: State) -> State:
        if s.is_lost:
            return enter(s, Event.GO_ON, Task(stands=True))
        if s.abort_cause:
            return enter(replace(s, cause=s.abort_cause), Event.GO_HOME, Homeward())
        return enter(replace(s, cause=Cause()), Event.GO_ON, Task(stands=False))

    def lose_pose(self, s: State, *, doubts_odometry: bool = True) -> State:
        del doubts_odometry
        return replace(s, is_lost=True)

    def retreat(self, s: State, frame: object, verdict: Verdict) -> State:
        return enter(replace(s, is_lost=True, cause=verdict.cause), Event.EDGE, Leaving())


RULES = Rules()
BEFORE, AT, AFTER = (SimpleNamespace(t_s=t_s) for t_s in (-1.0, 0.0, 1.0))  # frames; the limits of all timers are at 0

# -- what the work of a mission may do between two frames --------------------------------------------------------------


def found(s: State) -> State:
    """A fix succeeds."""
    return RULES.proceed(replace(s, is_lost=False)) if s.stands else s


def left_open(s: State) -> State:
    """A fix leaves the heading open: a short leg follows."""
    return enter(s, Event.GO_ON, Task(stands=False)) if s.stands_for_fix else s


def ended(s: State) -> State:
    """A leg, a retreat, the task or the way home ends."""
    match s.phase:
        case Task(stands=False) if not s.is_lost:
            return RULES.finish(s, SurveyOutcome.COMPLETE)
        case Task(stands=False) | Leaving():
            return enter(s, Event.GO_ON, Task(stands=True))
        case Homeward():
            return RULES.finish(s, SurveyOutcome.AT_BASE)
    return s


def arrived(s: State) -> State:
    """The robot comes to a point, where it measures."""
    is_on_leg = isinstance(s.phase, Task) and not s.phase.stands
    return enter(s, Event.GO_ON, Task(stands=True)) if is_on_leg else s


def doubted(s: State) -> State:
    """A gap of the encoders leaves the pose too uncertain for the leg."""
    is_moving = isinstance(s.phase, Homeward) or (isinstance(s.phase, Task) and not s.phase.stands)
    return enter(replace(s, is_lost=True), Event.GO_ON, Task(stands=True)) if is_moving else s


def stuck(s: State) -> State:
    """A retreat does not leave the edge; the limit of the wait is at time 0."""
    return RULES.interrupt(s, STUCK_AT_EDGE.cause(), stuck_s=-LIMIT_S) if isinstance(s.phase, Leaving) else s


def diverged(s: State) -> State:
    """The estimate diverges; the hold lasts until time 0."""
    return RULES.await_recovery(s, FILTER_DIVERGED.cause(why="x"), until_s=0.0)


WORK: tuple[Callable[[State], State], ...] = found, left_open, ended, arrived, doubted, stuck, diverged
INPUTS: tuple[SurveyInput, ...] = (
    *(Pause(OPERATOR.cause()), Resume(), Abort(OPERATOR.cause()), StopHere()),
    *(Interrupted(NO_FRAME_FOR.cause(limit_s=1.0)), Fault(FRAMES_LOST.cause()), Fault(FRAMES_LOST.cause(), True)),
)

# -- verdicts ----------------------------------------------------------------------------------------------------------

FREE = Verdict.normal(0, 0.0)
CAUSES = {
    Severity.INFORM: (UNKNOWN_REPORTED,),
    Severity.SLOW: (SAMPLES_TOO_FEW,),
    Severity.PAUSE: (EDGE_STALE,),
    Severity.HOLD: (WHEELS_STAND, EDGE_SENSOR_STAYS_OFF),
    Severity.RETURN: (BATTERY_LOW,),
    Severity.FAULT: (GRIP_TOO_LITTLE,),
}
NEW = 2  # number of a new emergency; that of the last one is 1


def verdicts(permits: tuple[tuple[bool, bool, bool], ...]) -> Iterator[Verdict | None]:
    """The product of severity, code, permits, earthquake and emergency, each with a cause; and no fresh verdict."""
    yield None
    for severity, code, is_shaking, raised, allowed in product(
        Severity, EventCode, (False, True), (0, 1, NEW), permits
    ):
        calls = is_shaking or code is EventCode.ABORTED
        if raised not in ((1, NEW) if calls else (0, 1)):
            continue  # what calls the robot home is latched; else only whether something is latched matters
        if code is EventCode.ABORTED:
            own = EARTHQUAKE.cause() if is_shaking else EMERGENCY.cause(kind="fire")
        else:
            own = RIM_AHEAD.cause() if code is EventCode.NEAR_EDGE else EDGE_STALE.cause()
        for cause in [row.cause() for row in CAUSES.get(severity, ())] or [own]:
            is_free = code is EventCode.NORMAL and severity is Severity.NONE and all(allowed)
            v = Verdict(0, 0.0, code, Cause() if is_free else cause, "x", 0.0, 0.0, *allowed, severity=severity)
            yield replace(v, raised=raised, is_shaking=is_shaking)
    for allowed in permits:
        yield replace(FREE, cause=Cause("of_a_newer_version"), forward=allowed[0], reverse=allowed[1], turn=allowed[2])


# Of three permits the rules ask whether all are given, and whether none is.
SOME_PERMITS = (False, False, False), (False, True, False), (True, True, True)
ALL_PERMITS = tuple((forward, reverse, turn) for forward, reverse, turn in product((False, True), repeat=3))
# One verdict of each kind that the danger loop gives.
DENIED = replace(FREE, forward=False, reverse=False, turn=False)
AT_EDGE = replace(FREE, code=EventCode.NEAR_EDGE, cause=RIM_AHEAD.cause(), forward=False, turn=False)
SHAKEN = replace(DENIED, code=EventCode.ABORTED, cause=EARTHQUAKE.cause(), raised=NEW, is_shaking=True)
USUAL: tuple[Verdict | None, ...] = (
    *(None, FREE, AT_EDGE, SHAKEN, replace(AT_EDGE, raised=NEW, is_shaking=True)),
    replace(FREE, code=EventCode.ABORTED, cause=EMERGENCY.cause(kind="fire"), raised=NEW),
    replace(DENIED, severity=Severity.PAUSE, cause=EDGE_STALE.cause()),
    replace(DENIED, severity=Severity.HOLD, cause=WHEELS_STAND.cause()),
    replace(DENIED, severity=Severity.HOLD, cause=EDGE_SENSOR_STAYS_OFF.cause()),
    replace(DENIED, severity=Severity.FAULT, cause=GRIP_TOO_LITTLE.cause()),
    replace(FREE, severity=Severity.RETURN, cause=BATTERY_LOW.cause()),
)

# -- what has to hold --------------------------------------------------------------------------------------------------

HANDS = Kind.PAUSED, Kind.FAULTED


class Step(NamedTuple):
    """What happens to a state: a frame with a verdict, an event, or something that the work decides."""

    what: Verdict | SurveyInput | Callable[[State], State] | None
    frame: SimpleNamespace | None = None


def after(s: State, step: Step) -> State:
    if step.frame is not None:
        assert step.what is None or isinstance(step.what, Verdict)
        return RULES.react(s, step.frame, step.what)
    return step.what(s) if callable(step.what) else RULES.handle(s, step.what)[0]  # type: ignore[arg-type]


def check(before: State, step: Step, s: State) -> None:
    """The rules of every transition."""
    assert not s.is_held or s.cause, "held without a reason"
    assert s.kind is not Kind.HOME or s.abort_cause
    assert before.kind is not Kind.OVER or s.phase == before.phase
    assert not before.abort_cause or s.abort_cause, "an order to go home is not forgotten"
    if step.frame is not None:
        check_verdict(before, step, s)
    else:
        check_event(before, step, s)


def check_verdict(before: State, step: Step, s: State) -> None:
    v = step.what
    assert v is None or isinstance(v, Verdict)
    moves = any(s.permits(v)) and not s.stands
    is_at_edge = v is not None and v.code is EventCode.NEAR_EDGE
    if moves:
        assert v is not None
        assert not is_denied(v)
        assert v.severity is not Severity.FAULT
        assert v.cause.condition != "of_a_newer_version"
        assert not v.is_shaking or is_at_edge
        assert s.kind is Kind.RETREAT if is_at_edge else all(v.permits), "not all is permitted"
    # Only an operator ends a pause or a fault; the observatory and a low battery call the robot home from it.
    calls_home = v is not None and v.raised == NEW and v.code is EventCode.ABORTED
    calls_home &= before.emergency_epoch is not None  # else it was acted on by an earlier process
    calls_home |= v is not None and v.severity is Severity.RETURN
    if before.kind in HANDS and not calls_home:
        assert s.kind in HANDS
    assert before.kind is not Kind.FAULTED or s.kind is Kind.FAULTED or calls_home
    if before.kind is Kind.OVER or v is None:
        return
    if v.severity is Severity.FAULT:
        assert s.kind is Kind.FAULTED
    elif v.is_shaking and not is_at_edge:
        assert s.is_held or before.earthquake is Earthquake.HELD
        assert s.abort_cause
    is_plain_edge = is_at_edge and v.severity is Severity.NONE and not is_denied(v)
    if is_plain_edge and not (before.is_held or before.stands_for_fix):
        assert s.kind is Kind.RETREAT
    if is_plain_edge and isinstance(before.phase, Held) and before.phase.stuck_s is None:
        assert s.kind is Kind.RETREAT or s.stands_for_fix
    if calls_home and all(v.permits) and not (is_at_edge or v.is_shaking or v.severity is Severity.FAULT):
        assert s.abort_cause


def check_event(before: State, step: Step, s: State) -> None:
    event, is_over = step.what, before.kind is Kind.OVER
    if is_over:
        return
    match event:
        case Pause():
            assert s.kind is (Kind.FAULTED if before.kind is Kind.FAULTED else Kind.PAUSED)
        case Fault():
            assert s.kind is Kind.FAULTED
        case StopHere():
            assert s.outcome is SurveyOutcome.STOPPED
        case Interrupted():
            assert s.is_held or before.kind is Kind.READY
        case Resume():
            is_refused = RULES.handle(before, event)[1] is not None
            assert s == before if is_refused else not s.is_held
        case Abort():
            assert s.abort_cause
            assert not s.is_held or s.earthquake is Earthquake.HELD
            assert before.kind not in (Kind.READY, Kind.WORK) or s.is_lost or before.abort_cause or s.kind is Kind.HOME
        case _:
            assert before.kind not in HANDS or s.kind is before.kind, "the work released a hold"
            if event is diverged and before.kind in engagement.MOVING:
                assert isinstance(s.phase, Held)
            if event is doubted and s is not before:
                assert s.stands_for_fix
    if before.kind in HANDS and not isinstance(event, Resume | Abort | StopHere):
        assert s.kind in HANDS


def check_end(s: State) -> None:
    """From every state the mission ends, or the robot is held for an operator with a reason.

    This needs fairness: frames come, danger finds nothing any more and no emergency is latched, and what the work has
    begun ends: a fix succeeds, a leg, a retreat and the way home end. An operator need not do anything.
    """
    for _ in range(8):
        s = RULES.react(s, AFTER, FREE)
        if s.kind in HANDS:
            assert s.cause
            return
        if s.kind is Kind.OVER:
            assert s.outcome is SurveyOutcome.STOPPED or (s.outcome is SurveyOutcome.AT_BASE) is bool(s.abort_cause)
            return
        s = found(s) if s.stands else ended(s)
    raise AssertionError(f"it neither ends nor waits for an operator: {s}")


# -- exploration -------------------------------------------------------------------------------------------------------


def key(s: State) -> tuple[object, ...]:
    """What the rules can tell apart."""
    blocks = s.severity >= Severity.HOLD and s.severity is not Severity.RETURN
    return (
        *(s.phase, bool(s.abort_cause), s.earthquake, blocks, s.is_latched),
        *(s.emergency_epoch is None, s.finding.condition, bool(s.located), s.is_lost),
    )


def steps(s: State, chosen: tuple[Verdict | None, ...]) -> Iterator[Step]:
    timed = isinstance(s.phase, Held) and (s.phase.stuck_s is not None or s.phase.until_s == 0.0)
    for v, frame in product(chosen, (BEFORE, AT, AFTER) if timed else (AT,)):
        yield Step(v, frame)
    for event in (*INPUTS, *WORK):
        yield Step(event)


def explore(chosen: tuple[Verdict | None, ...]) -> tuple[list[State], int]:
    """All states that can be reached, with every rule checked in every transition; and the number of transitions."""
    begin = [State(emergency_epoch=epoch, is_lost=lost) for epoch, lost in product((1, None), (False, True))]
    seen, count = {key(s) for s in begin}, 0
    waiting, states = deque(begin), list(begin)
    while waiting:
        s = waiting.popleft()
        check_end(s)
        for step in steps(s, chosen):
            new = after(s, step)
            count += 1
            check(s, step, new)
            if new is s or key(new) in seen:
                continue
            seen.add(key(new))
            new = new if new.emergency_epoch is None else replace(new, emergency_epoch=1)
            waiting.append(new)
            states.append(new)
    return states, count


def explored(permits: tuple[tuple[bool, bool, bool], ...]) -> None:
    chosen = tuple(verdicts(permits))
    states, count = explore(chosen)
    print(f"{len(states)} states, {count} transitions, {len(chosen)} verdicts")
    assert {s.kind for s in states} == set(Kind)
    assert {s.summary_state for s in states} == set(SummaryState)


def test_every_state_of_the_engagement_keeps_the_rules() -> None:
    explored(SOME_PERMITS)


@pytest.mark.slow
def test_every_state_of_the_engagement_keeps_the_rules_whatever_is_permitted() -> None:
    explored(ALL_PERMITS)


ENTRIES = [(kind, event) for kind, row in TRANSITIONS.items() for event in row]


@pytest.mark.parametrize(("kind", "event"), ENTRIES, ids=[f"{kind}-{event}" for kind, event in ENTRIES])
def test_each_transition_is_needed(kind: Kind, event: Event, monkeypatch: pytest.MonkeyPatch) -> None:
    row = {other: to for other, to in TRANSITIONS[kind].items() if other is not event}
    monkeypatch.setattr(engagement, "TRANSITIONS", MappingProxyType({**TRANSITIONS, kind: row}))
    with pytest.raises(AssertionError):
        explore(USUAL)


def test_the_usual_verdicts_keep_the_rules() -> None:
    """Without it the test of each transition could fail for another reason."""
    explore(USUAL)


def test_the_summary_state_follows_from_the_phase() -> None:
    task = Task(stands=True)
    shown = {
        SummaryState.STANDBY: State(),
        SummaryState.ENABLED: State(task),
        SummaryState.DISABLED: State(Paused()),
        SummaryState.FAULT: State(Faulted()),
        SummaryState.OFFLINE: State(Over(SurveyOutcome.COMPLETE)),
    }
    assert {state: s.summary_state for state, s in shown.items()} == {state: state for state in shown}
    assert State(Held()).summary_state is SummaryState.ENABLED  # it goes on by itself
    assert State(Held(), earthquake=Earthquake.HELD).summary_state is SummaryState.DISABLED
