"""Whose turn it is: what the robot does and why, who acts next, and the one next action. Pure.

``turn_of`` decides with names: the phase of the mission, the row of the condition, the requests that the daemon would
accept now. ``turn_text`` makes the words for people, at the edge.
"""

from collections.abc import Callable, Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Any, NamedTuple

from msgspec.structs import replace

from ccatp.conditions import Actor, Clear, find_condition, text_of
from ccatp.conditions.danger import EARTHQUAKE, EMERGENCY
from ccatp.conditions.mission import OPERATOR
from ccatp.core import NO_CAUSE, Cause, Severity, Verdict
from ccatp.errors import ExitStatus
from ccatp.links.channels import OperatorCommand
from ccatp.links.topics import MissionStatus, Turn
from ccatp.safety.emergency_latch import AT_BASE_OR_HELD
from ccatp.survey.ending import end_text, ending_of
from ccatp.survey.engagement import MOVING, Earthquake, EngagedMission, Engagement, Kind
from ccatp.survey.events import (
    BACKING_OFF,
    DRIVING,
    IDLE,
    MEASURING,
    RETURNING,
    SETTLING,
    TURNING,
    Abort,
    Pause,
    Resume,
    StopHere,
    SurveyOutcome,
)

# The event of each command of an operator with this name.
REQUESTS: Mapping[OperatorCommand, Callable[[str], Pause | Resume | Abort | StopHere]] = MappingProxyType(
    {
        OperatorCommand.PAUSE: lambda by: Pause(OPERATOR.cause(by=by)),
        OperatorCommand.RESUME: lambda _: Resume(),
        OperatorCommand.ABORT: lambda by: Abort(OPERATOR.cause(by=by)),
        OperatorCommand.STOP: lambda _: StopHere(),
    }
)
CLEAR = "clear"  # the request of the observatory that ends an emergency


class Next(StrEnum):
    """The next action."""

    GO_ON = "go_on"  # none: the robot works
    WAIT = "wait"  # none: the robot continues by itself when the condition has ended
    WAIT_AND_FIX = "wait_and_fix"  # the same, after a fix
    HANDS = "hands"  # what the row of the condition says
    RESUME = "resume"
    CLEAR = "clear"
    RESUME_RUN = "resume_run"  # the daemon has ended, and points remain
    NOTHING = "nothing"


def offers_of(mission: EngagedMission[Any], verdict: Verdict | None) -> tuple[str, ...]:
    """The requests that would be accepted now, and that would change something; ``verdict``: the newest one."""
    s, made = mission.state, []
    if s.kind is Kind.OVER:
        return ()
    for name, event_by in REQUESTS.items():
        after = mission.after(event_by(""))
        # A hold that ends by itself is not for an operator to end.
        is_needed = name is not OperatorCommand.RESUME or s.is_held_by_hand
        if after is not None and is_needed and (after.phase != s.phase or after.abort_cause != s.abort_cause):
            made.append(str(name))
    # The danger loop clears only what main has reported to it as held, so not before its first verdict.
    if verdict is not None and s.is_latched and str(s.mode) in AT_BASE_OR_HELD:
        made.append(CLEAR)
    return tuple(made)


def turn_of(
    s: Engagement, verdict: Verdict | None, offers: tuple[str, ...], waits: Cause = NO_CAUSE, *, resumes: bool = True
) -> Turn:
    """Whose turn it is; ``waits``: why a robot that works stands, beside the causes in its state.

    ``resumes``: another daemon can continue the mission after its end.
    """
    found = NO_CAUSE if verdict is None else verdict.cause

    def turn(actor: Actor, action: Next, why: Cause, bars: Cause = NO_CAUSE) -> Turn:
        return Turn(kind=s.kind, actor=actor, next=action, why=why, bars=bars, offers=offers, resumes=resumes)

    is_shaking = s.earthquake is not Earthquake.NONE
    why = s.cause or waits or found
    match s.kind:
        case Kind.OVER:
            return turn(*_of_end(s), s.cause)
        case Kind.HELD | Kind.PAUSED | Kind.FAULTED if is_shaking:
            return turn(Actor.OBSERVATORY, Next.CLEAR, s.cause)
        case Kind.PAUSED | Kind.FAULTED:
            actor, action = _of_operator(s, offers)
            return turn(actor, action, s.cause, bars=found or s.cause if action is Next.HANDS else NO_CAUSE)
        case Kind.HELD | Kind.READY:
            return turn(*_of_hold(s, why, offers), why)
    is_slow = verdict is not None and verdict.severity >= Severity.SLOW
    return turn(Actor.ROBOT, Next.WAIT if waits else Next.GO_ON, why if s.cause or waits or is_slow else NO_CAUSE)


def _of_end(s: Engagement) -> tuple[Actor, Next]:
    """What remains to do after the end of a mission."""
    row = find_condition(s.cause.condition)
    if s.outcome is SurveyOutcome.COMPLETE:
        return Actor.NOBODY, Next.NOTHING
    is_observatory = row is not None and row.actor is Actor.OBSERVATORY
    action = Next.HANDS if row is not None and row.then else Next.RESUME_RUN
    return Actor.OBSERVATORY if is_observatory else Actor.OPERATOR, action


def _of_operator(s: Engagement, offers: tuple[str, ...]) -> tuple[Actor, Next]:
    """What ends a hold that an operator has to end."""
    if OperatorCommand.RESUME in offers:
        return Actor.OPERATOR, Next.RESUME
    is_latched = s.is_latched and not s.abort_cause
    return (Actor.OBSERVATORY, Next.CLEAR) if is_latched else (Actor.OPERATOR, Next.HANDS)


def _of_hold(s: Engagement, cause: Cause, offers: tuple[str, ...]) -> tuple[Actor, Next]:
    """Who ends a hold that ends with its condition, and how."""
    row = find_condition(cause.condition)
    if row is not None and row.actor is Actor.OPERATOR:
        return Actor.OPERATOR, Next.HANDS
    if row is not None and row.actor is Actor.OBSERVATORY:
        return Actor.OBSERVATORY, Next.CLEAR if CLEAR in offers else Next.WAIT
    needs_fix = s.needs_fix or (row is not None and row.clear is Clear.AFTER_FIX)
    return Actor.ROBOT, Next.WAIT_AND_FIX if needs_fix else Next.WAIT


# -- words ------------------------------------------------------------------------------------------------------------

_STANDS = {
    Kind.READY: "waiting for the robot, its laser system and the danger loop",
    Kind.HELD: "held",
    Kind.PAUSED: "paused",
    Kind.FAULTED: "held by a fault",
}
_MOVES: Mapping[str, str] = {
    TURNING: "turning towards {}",
    DRIVING: "driving to {}",
    SETTLING: "coming to rest at {}",
    MEASURING: "measuring {}",
    BACKING_OFF: "backing off from an edge",
    IDLE: "about to continue",
    RETURNING: "driving home",
}
_THEN = {
    Next.GO_ON: "continues by itself",
    Next.WAIT: "continues by itself when this has ended",
    Next.WAIT_AND_FIX: "takes a fix when this has ended, then continues by itself",
    Next.RESUME: "resume",
    Next.RESUME_RUN: "'ccatp run --resume' measures the remaining points",
    Next.NOTHING: "nothing is left to do",
}
_ANEW = "a new run begins the mission again"  # for RESUME_RUN of a mission that cannot be continued
_BEGINS = {Next.GO_ON: "begins by itself", Next.WAIT: "begins by itself when this has ended"}
_WHO = {
    Actor.ROBOT: "the robot",
    Actor.OPERATOR: "an operator:",
    Actor.OBSERVATORY: "the observatory:",
    Actor.NOBODY: "",
}


class TurnText(NamedTuple):
    """Words: what the robot does and why, who acts next, the next action; the request that is this action, or empty."""

    does: str
    who: str
    then: str
    request: str

    @property
    def line(self) -> str:
        """All of it in one line."""
        return f"{self.does}. Next: {f'{self.who} {self.then}'.strip()}" if self.then else self.does


def turn_text(status: MissionStatus) -> TurnText:
    """The words about a status; of an older version, without its turn, only what it does."""
    turn = status.turn
    if not turn.actor:
        return TurnText(f"{status.state}{f': {status.cause}' if status.cause else ''}", "", "", "")
    if status.exit_status >= 0 and turn.kind != Kind.OVER:  # the daemon has ended, with the robot where it is
        action = Next.HANDS if _hands(turn.why) else Next.RESUME_RUN
        turn = replace(turn, kind=Kind.OVER, actor=Actor.OPERATOR, next=action, offers=())
    request = turn.next if turn.next in turn.offers else ""
    return TurnText(_does(status, turn), _WHO[Actor(turn.actor)], _then(turn), request)


def is_under_way(status: MissionStatus) -> bool:
    """Whether the mission makes progress, so that its remaining time means something."""
    return not status.outcome and status.exit_status < 0 and (not status.turn.kind or status.turn.kind in MOVING)


def _does(status: MissionStatus, turn: Turn) -> str:
    if turn.kind == Kind.OVER:
        return end_text(ending_of(status, ExitStatus(max(status.exit_status, ExitStatus.COMPLETE))))
    move = _MOVES.get(status.state, status.state).format(status.point or "the next stop")
    does = _STANDS.get(Kind(turn.kind), move)
    if turn.why.condition == OPERATOR.name:
        return f"{does}{', called' if turn.kind in MOVING else ''} by {turn.why.values.get('by') or 'an operator'}"
    how = ", after" if is_after_hold(status) else ""
    return f"{does}{how}: {text_of(turn.why)}" if turn.why else does


def is_after_hold(status: MissionStatus) -> bool:
    """Whether the cause is that of a hold that has ended: the robot takes a fix before it continues its task."""
    turn = status.turn
    return turn.kind == Kind.WORK and turn.next == Next.GO_ON and turn.why.condition == status.condition != ""


def _hands(cause: Cause) -> str:
    row = find_condition(cause.condition)
    return "" if row is None else row.then


def _after_end(turn: Turn, hands: str, *, is_emergency: bool) -> str:
    if is_emergency and turn.resumes:  # a run that did not begin held would go home again
        return f"'ccatp run --resume --start-held', then {hands}, then resume"
    rest = _THEN[Next.RESUME_RUN] if turn.resumes else _ANEW
    return f"{hands}; {rest}" if turn.next == Next.HANDS else rest


def _then(turn: Turn) -> str:
    hands, action = _hands(turn.bars or turn.why), Next(turn.next)
    is_emergency = turn.why.condition in (EARTHQUAKE.name, EMERGENCY.name)
    match action:
        case Next.HANDS | Next.RESUME_RUN if turn.kind == Kind.OVER:
            return _after_end(turn, hands, is_emergency=is_emergency)
        case Next.HANDS if turn.bars:
            what = "until this has ended" if turn.bars == turn.why else f"while this lasts: {text_of(turn.bars)}"
            return f"{hands or 'wait'}; resume is refused {what}"
        case Next.HANDS:
            return f"{hands}; then the robot continues by itself"
        case Next.RESUME if hands and turn.kind == Kind.FAULTED:
            return f"{hands}, then resume"
        case Next.CLEAR:
            return hands if is_emergency else "clear the emergency; then resume"
        case Next.GO_ON if turn.kind == Kind.HOME:
            return "drives to its base, where the run ends"
        case Next.GO_ON | Next.WAIT if turn.kind == Kind.READY:
            return _BEGINS[action if turn.why else Next.GO_ON]
    return _THEN[action]
