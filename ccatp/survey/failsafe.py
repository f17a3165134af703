"""Reactions of a mission to verdicts: the rows common to all missions, and the table of a mission with edges.

Rows are tried in order. A row's reaction either ends the frame or leaves it to the rows after it.
"""

from typing import Any

from msgspec.structs import replace

from ccatp.conditions import (
    Action,
    Clear,
    Condition,
    find_condition,
)
from ccatp.conditions.danger import EARTHQUAKE
from ccatp.conditions.mission import STUCK_AT_EDGE
from ccatp.core import Severity, Verdict
from ccatp.survey.engagement import (
    ABORTED,
    FAULT,
    HOLD,
    NEAR_EDGE,
    NO_FRESH_VERDICT,
    RETURN,
    Engagement,
    EngagementRules,
    Held,
    Kind,
    Reaction,
    S,
)

REDUCED = Severity.SLOW, RETURN
# What ends a reaction without motion whose severity was raised, or is that of another row.
RAISED = {HOLD: Clear.AFTER_FIX, RETURN: Clear.AFTER_FIX, FAULT: Clear.OPERATOR}


def is_denied(v: Verdict) -> bool:
    """Whether no motion is permitted."""
    return not (v.forward or v.reverse or v.turn)


def row_of(v: Verdict) -> Condition | None:
    """The row of a verdict's cause; ``None`` without a cause, or for one that is not known here."""
    return find_condition(v.cause.condition)


def action_of(v: Verdict) -> Action | None:
    """The action of the row of a verdict's cause, at the severity of the verdict."""
    row = row_of(v)
    if row is None or v.severity is row.severity:
        return None if row is None else row.action
    return row.escalates_to if v.severity is row.raised_severity else None


def clear_of(v: Verdict) -> Clear:
    """What ends the reaction to a verdict that permits no motion; without a row of its own, by the severity."""
    row = row_of(v)
    own = row.clear if row is not None and v.severity is row.severity else None
    return own or RAISED.get(v.severity, Clear.AUTO)


# -- rows of every mission --------------------------------------------------------------------------------------------


def _stand_in_earthquake(rules: EngagementRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    """No motion in an earthquake. A fault is left to its own row, because it also needs an operator."""
    return rules.shake(replace(s, emergency_epoch=v.raised), EARTHQUAKE.cause()), v.severity is not FAULT


def stand(rules: EngagementRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    """No motion until what the row states: an operator, or the cause is gone, for a hold with a fix after it."""
    clear = clear_of(v)
    if clear is Clear.OPERATOR:
        return s if s.is_faulted else rules.fault(s, v.cause, loses_pose=True), True
    if not is_denied(v) or (clear is Clear.AUTO and v.severity < HOLD):
        return pause(rules, s, _frame, v)
    return _hold(rules, s, _frame, v, relocalizes=clear is Clear.AFTER_FIX)


def _hold(rules: EngagementRules[S], s: S, _frame: object, v: Verdict, *, relocalizes: bool = True) -> tuple[S, bool]:
    row = row_of(v)
    rejects_odometry = row is None or not row.trusts_wheels
    return rules.await_recovery(s, v.cause, rejects_odometry=rejects_odometry, relocalizes=relocalizes), True


def pause(rules: EngagementRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    """Hold until the cause is gone."""
    # A robot that stands for a fix needs no permit, and may not get one before the fix.
    if s.stands_for_fix and v is not NO_FRESH_VERDICT:
        return s, True
    return rules.interrupt(s, v.cause), True


def _meet(rules: EngagementRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    return rules.meet(s, v.cause), True


def _go_home(rules: EngagementRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    """Abort once for each emergency, which every verdict repeats."""
    return rules.abort(replace(s, emergency_epoch=v.raised), v.cause), False


ON_EARTHQUAKE = Reaction(
    "an earthquake is latched, and no edge is to be left",
    Action.EARTHQUAKE,
    lambda _, v: v.is_shaking and v.code is not NEAR_EDGE,
    _stand_in_earthquake,
)
ON_FAULT = Reaction("the severity is fault", Action.FAULT, lambda _, v: v.severity is FAULT, stand)
ON_HOLD = Reaction(
    "the severity is hold or above, and nothing is permitted",
    Action.HOLD,
    lambda _, v: v.severity >= HOLD and is_denied(v),
    stand,
)
ON_UNKNOWN = Reaction(
    "the cause is not known here: the danger loop is of another version",
    Action.HOLD,
    lambda _, v: bool(v.cause) and row_of(v) is None,
    _hold,
)
ON_NO_VERDICT = Reaction("no verdict is fresh enough", Action.PAUSE, lambda _, v: v is NO_FRESH_VERDICT, _meet)
ON_EMERGENCY = Reaction(
    "an emergency is new",
    Action.RETURN,
    lambda s, v: v.code is ABORTED and v.raised != s.emergency_epoch,
    _go_home,
)


# -- rows of a mission with edges -------------------------------------------------------------------------------------


def _locate(rules: EngagementRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    """Take one fix at rest: if the pose is wrong, a sensor that stays off may be over a seam or the rim."""
    if s.kind is Kind.OVER or s.is_held_by_hand:
        return s, False
    if not s.located:
        s = rules.proceed(rules.await_recovery(replace(s, located=v.cause), v.cause))
    return s, s.stands_for_fix


def _change_speed(rules: EngagementRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    return rules.change_speed(s, is_slow=v.severity in REDUCED), False


def _return(rules: EngagementRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    """Abort once for each finding, which every verdict repeats."""
    return rules.abort(replace(s, finding=v.cause), v.cause), False


def _is_stuck(s: Engagement) -> bool:
    return isinstance(s.phase, Held) and s.phase.stuck_s is not None


def _wait_at_edge(rules: EngagementRules[S], s: S, frame: Any, v: Verdict) -> tuple[S, bool]:
    """Wait after a retreat that did not leave the edge; a fault after the limit of the row."""
    held = s.phase
    if not isinstance(held, Held) or held.stuck_s is None:
        return s, False
    if v.code is not NEAR_EDGE and v is not NO_FRESH_VERDICT:
        return replace(s, phase=replace(held, stuck_s=None)), False
    if frame.t_s - held.stuck_s > rules.stuck_limit_s:
        return rules.fault(s, STUCK_AT_EDGE.cause()), True
    return s, True


def _retreat(rules: EngagementRules[S], s: S, frame: object, v: Verdict) -> tuple[S, bool]:
    if s.kind in (Kind.RETREAT, Kind.OVER):
        return s, True
    if s.rejects_odometry:
        s = rules.proceed(s)  # stand for a fix, which is always safe: without it the place of the edge is unknown
    # The robot stands. If the map has the rim there, the pose may be wrong, and a fix is on its way.
    return (s, True) if s.stands_for_fix or s.is_held_by_hand else (rules.retreat(s, frame, v), True)


ROWS = (
    ON_EARTHQUAKE,
    ON_FAULT,
    ON_UNKNOWN,
    Reaction(
        "the severity is hold for a fault of one edge sensor, and nothing is permitted",
        Action.LOCATE,
        lambda _, v: action_of(v) is Action.LOCATE and is_denied(v),
        _locate,
    ),
    ON_HOLD,
    Reaction(
        "the severity begins or ceases to be slow or return",
        Action.SLOW,
        lambda s, v: s.is_slow is not (v.severity in REDUCED) and v is not NO_FRESH_VERDICT,
        _change_speed,
    ),
    Reaction(
        "the severity is return for a new cause, and no edge is to be left",
        Action.RETURN,
        lambda s, v: v.severity is RETURN and v.code is not NEAR_EDGE and v.cause != s.finding,
        _return,
    ),
    Reaction("a retreat led nowhere", Action.WAIT, lambda s, _: _is_stuck(s), _wait_at_edge),
    Reaction("an edge is declared (code 1)", Action.RETREAT, lambda _, v: v.code is NEAR_EDGE, _retreat),
    ON_NO_VERDICT,
    Reaction(
        "some motion is not permitted",
        Action.PAUSE,
        lambda _, v: not (v.forward and v.reverse and v.turn),
        stand,
    ),
    ON_EMERGENCY,
)
