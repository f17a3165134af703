"""What slows, pauses, holds, returns or stops a survey, frame by frame: one table, and what each action does.

The first row that applies decides; a row whose action lets the survey go on is followed by the rows after it.
"""

from collections.abc import Callable
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

from msgspec.structs import replace

from ccatp.conditions import BACK_OFFS, EARTHQUAKE, NO_VERDICT, Clear, Motion
from ccatp.core import Corner, EventCode, Severity, Verdict
from ccatp.survey.behaviours import Retreat, ReturnHome
from ccatp.survey.route_follower import StateEstimate
from ccatp.survey.state import (
    BACKING_OFF,
    DONE,
    DRIVING,
    HELD,
    IDLE,
    TURNING,
    FixNeed,
    MissionEvent,
    SurveyState,
)

if TYPE_CHECKING:
    from ccatp.survey.statechart import Survey

NEAR_EDGE, ABORTED = EventCode.NEAR_EDGE, EventCode.ABORTED
NONE, SLOW, HOLD, RETURN, FAULT = Severity.NONE, Severity.SLOW, Severity.HOLD, Severity.RETURN, Severity.FAULT
_CORNERS = frozenset(Corner)
# So long after a fix found the robot the danger loop has received where it is: a pose in five frames, and a verdict.
_NOTICED_S = 0.2

Reaction = tuple[SurveyState, bool]  # the state, and whether that is all for this frame
Frame = tuple[StateEstimate, Verdict | None]


class Action(Enum):
    """What a row does."""

    SHAKEN = "hold: nothing moves, then home"
    FAULT = "fault: held until an operator resumes"
    LOCATE = "one fix at rest, then hold"
    HOLD = "hold: wheels held, a fix, then on by itself"
    SLOW = "half the speed"
    RETURN = "home"
    WAIT_AT_EDGE = "hold until no sensor hangs over"
    RETREAT = "back off"
    PAUSE = "pause: wheels held, goes on by itself"


class Row(NamedTuple):
    """One row: what is wrong, and what follows.

    Attributes:
        motion: what the robot may still do.
        clear: what ends the reaction, once the condition is over.
    """

    name: str
    applies: Callable[[SurveyState, Verdict | None], bool]
    action: Action
    motion: Motion
    clear: Clear


def _is_denied(v: Verdict) -> bool:
    return not (v.forward or v.reverse or v.turn)


def _is_hold(v: Verdict | None) -> bool:
    return v is not None and v.severity >= HOLD and _is_denied(v)


def _is_clear(v: Verdict) -> bool:
    """No row applies to such a verdict."""
    is_normal = v.severity is NONE and v.code is EventCode.NORMAL and not v.is_shaking
    return is_normal and v.forward and v.reverse and v.turn


ROWS = (
    Row(
        "earthquake",
        lambda _, v: v is not None and v.is_shaking and v.code is not NEAR_EDGE,
        *(Action.SHAKEN, Motion.NONE, Clear.OPERATOR),
    ),
    Row("fault", lambda _, v: v is not None and v.severity is FAULT, Action.FAULT, Motion.NONE, Clear.OPERATOR),
    Row(
        "sensor stays off",
        lambda _, v: v is not None and _may_locate(v),
        *(Action.LOCATE, Motion.NONE, Clear.AFTER_FIX),
    ),
    Row("hold", lambda _, v: _is_hold(v), Action.HOLD, Motion.NONE, Clear.AFTER_FIX),
    Row(
        "slow",
        lambda s, v: v is not None and s.is_slow is not (v.severity in (SLOW, RETURN)),
        *(Action.SLOW, Motion.ANY, Clear.AUTO),
    ),
    Row(
        "return",
        lambda s, v: v is not None and v.severity is RETURN and v.code is not NEAR_EDGE and v.cause != s.finding,
        *(Action.RETURN, Motion.RETURN, Clear.OPERATOR),
    ),
    Row("stuck", lambda s, _: s.stuck_s is not None, Action.WAIT_AT_EDGE, Motion.NONE, Clear.AUTO),
    Row(
        "edge",
        lambda _, v: v is not None and v.code is NEAR_EDGE,
        *(Action.RETREAT, Motion.RETREAT, Clear.AFTER_FIX),
    ),
    Row("no verdict", lambda _, v: v is None, Action.PAUSE, Motion.NONE, Clear.AUTO),
    Row(
        "not permitted",
        lambda _, v: v is not None and not (v.forward and v.reverse and v.turn),
        *(Action.PAUSE, Motion.NONE, Clear.AUTO),
    ),
    Row(
        "emergency",
        lambda s, v: v is not None and v.code is ABORTED and v.raised != s.emergency_epoch,
        *(Action.RETURN, Motion.RETURN, Clear.OPERATOR),
    ),
)


def _may_locate(v: Verdict) -> bool:
    return v.severity is HOLD and v.signal in _CORNERS and _is_denied(v)


def react(survey: "Survey", s: SurveyState, motion: StateEstimate, verdict: Verdict | None) -> SurveyState:
    """Do what the verdict in force demands (``None``: none fresh enough), before anything moves."""
    s = _take_levels(s, motion.t_s, verdict)
    if verdict is None or not _is_clear(verdict) or s.is_slow or s.stuck_s is not None:
        for row in ROWS:
            if row.applies(s, verdict):
                s, is_over = _ACTIONS[row.action](survey, s, motion, verdict)
                if is_over:
                    return s
    is_waiting = s.mode is HELD and (s.hold.by_hand or motion.t_s < s.resumes_after_s)
    if s.mode is IDLE or (s.mode is HELD and not is_waiting):
        return survey.proceed(s)
    return s


def _take_levels(s: SurveyState, t_s: float, v: Verdict | None) -> SurveyState:
    """What the verdict says that is remembered."""
    is_lost = s.fix is not FixNeed.NONE
    if v is None:
        return s if s.was_lost is is_lost else replace(s, was_lost=is_lost)
    interlock = s.interlock if v.is_shaking else ""
    has_looked = s.has_looked and v.severity >= HOLD
    # Found at an edge, the robot stands until the danger loop knows where: what it met may have been a seam.
    is_found = s.was_lost and not is_lost and v.code is NEAR_EDGE
    levels = v.raised > 0, v.is_shaking, v.severity, is_lost, has_looked, interlock
    known = s.is_latched, s.is_shaking, s.severity, s.was_lost, s.has_looked, s.interlock
    if levels == known and s.emergency_epoch is not None and not is_found and not v.is_shaking and not v.full_fans:
        return s
    return replace(
        s,
        is_latched=v.raised > 0,
        is_shaking=v.is_shaking,
        severity=v.severity,
        was_lost=is_lost,
        has_looked=has_looked,
        interlock=interlock,
        emergency_epoch=v.raised if s.emergency_epoch is None else s.emergency_epoch,
        full_fans=s.full_fans or v.full_fans or v.is_shaking,
        stands_until_s=t_s + _NOTICED_S if is_found else s.stands_until_s,
    )


def _cause(v: Verdict | None) -> str:
    return NO_VERDICT.message if v is None else v.cause


def _shaken(survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict | None) -> Reaction:
    """Nothing moves while the ground shakes; home when it is over, and a pose from before is not to be trusted then."""
    s = replace(s, emergency_epoch=0 if v is None else v.raised)
    if not s.interlock and s.mode is not DONE:
        s = replace(
            s, interlock=EARTHQUAKE.message, abort_cause=s.abort_cause or EARTHQUAKE.message, fix=FixNeed.RELOCALIZE
        )
        s = survey.hold(s, EARTHQUAKE.message, by_hand=s.is_held_by_hand)
    # A fault has to be looked after by an operator, too.
    return s, v is not None and v.severity is not FAULT


def _fault(survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict | None) -> Reaction:
    if s.mode is HELD and s.is_faulted:
        return s, True
    return survey.fault(s, _cause(v), loses_pose=True), True


def _locate(survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict | None) -> Reaction:
    """A sensor that stays off may be over a seam or the rim where the pose is wrong: one fix, at rest, tells."""
    if s.mode is DONE or s.is_held_by_hand:
        return s, False
    if not s.has_looked:
        s = survey.await_recovery(replace(s, has_looked=True), _cause(v))
        s = survey.proceed(s)
    return s, s.stands_for_fix


def _hold(survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict | None) -> Reaction:
    is_pose_doubted = v is None or v.signal not in _CORNERS
    return survey.await_recovery(s, _cause(v), rejects_odometry=is_pose_doubted), True


def _slow(_survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict | None) -> Reaction:
    """Drive at the reduced speed from now on, or at the usual one from the next leg on."""
    s = replace(s, is_slow=v is not None and v.severity in (SLOW, RETURN))
    if s.is_slow and s.mode in (DRIVING, TURNING) and s.fix is FixNeed.NONE:
        s = replace(s, behaviour=None)
    elif s.is_slow and isinstance(s.behaviour, ReturnHome):
        s = replace(s, behaviour=s.behaviour.interrupted())
    return s, False


def _return(survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict | None) -> Reaction:
    """Once for each finding and each emergency: the level is repeated in each verdict."""
    if v is None:
        return s, False
    if v.severity is RETURN and v.cause != s.finding:
        s = replace(s, finding=v.cause)
    else:
        s = replace(s, emergency_epoch=v.raised)
    return survey.abort(s, v.cause), False


def _wait_at_edge(survey: "Survey", s: SurveyState, motion: StateEstimate, v: Verdict | None) -> Reaction:
    """After a retreat that led nowhere."""
    is_over = s.mode is not HELD or s.hold.by_hand or (v is not None and v.code is not NEAR_EDGE)
    if s.stuck_s is None or is_over:
        return replace(s, stuck_s=None), False
    if motion.t_s - s.stuck_s > survey.cfg.health.hold_limit_s:
        return survey.fault(replace(s, stuck_s=None), s.cause), True
    return s, True


def _pause(survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict | None) -> Reaction:
    # A robot that stands to be found needs no permission, and without a pose gets none before it is.
    if v is not None and s.stands_for_fix:
        return s, True
    return survey.interrupt(s, _cause(v)), True


def _retreat(survey: "Survey", s: SurveyState, motion: StateEstimate, v: Verdict | None) -> Reaction:
    if v is None or s.mode in (BACKING_OFF, DONE):
        return s, True
    if s.rejects_odometry:
        s = survey.proceed(s)  # where the edge is, is not known before a fix; standing still for it is safe anywhere
    # It stands, and a rim on the map is a matter of the pose that is being found.
    if s.stands_for_fix or s.is_held_by_hand or motion.t_s < s.stands_until_s:
        return s, True
    mission, backoffs = survey.cfg.mission, s.backoffs + 1
    if backoffs > mission.max_backoffs_per_stop:
        cause = BACK_OFFS.text(count=mission.max_backoffs_per_stop)
        return survey.fault(replace(s, backoffs=0), cause), True
    s = replace(
        s,
        backoffs=backoffs,
        # Back at an edge right after a fix of the place: then it is the heading that is wrong.
        inflates_covariance=s.inflates_covariance or backoffs > 1,
        cause=v.cause,
        is_missed=False,
        # An edge that the route did not foresee means that the pose is wrong: it is found again before moving on.
        fix=FixNeed.RELOCALIZE,
        behaviour=Retreat.begin(mission, v, motion.pose, motion.rate_rad_s),
    )
    return survey.apply(s, MissionEvent.EDGE), True


_ACTIONS: dict[Action, Callable[["Survey", SurveyState, StateEstimate, Verdict | None], Reaction]] = {
    Action.SHAKEN: _shaken,
    Action.FAULT: _fault,
    Action.LOCATE: _locate,
    Action.HOLD: _hold,
    Action.SLOW: _slow,
    Action.RETURN: _return,
    Action.WAIT_AT_EDGE: _wait_at_edge,
    Action.RETREAT: _retreat,
    Action.PAUSE: _pause,
}
