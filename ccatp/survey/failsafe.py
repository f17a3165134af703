"""What slows, pauses, holds, returns or stops a mission: the rules of every kind of mission, and the table of a survey.

The first row that applies decides; a row whose action lets the mission go on is followed by the rows after it.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

from msgspec.structs import replace

from ccatp.conditions import BACK_OFFS, EARTHQUAKE, NO_VERDICT, Action
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
    Abort,
    Fault,
    FixNeed,
    Hold,
    HoldState,
    Interrupted,
    MissionEvent,
    Pause,
    Resume,
    StopHere,
    SurveyInput,
    SurveyOutcome,
    SurveyState,
    next_state,
)

if TYPE_CHECKING:
    from ccatp.survey.statechart import Survey

NEAR_EDGE, ABORTED = EventCode.NEAR_EDGE, EventCode.ABORTED
NONE, HOLD, RETURN, FAULT = Severity.NONE, Severity.HOLD, Severity.RETURN, Severity.FAULT
REDUCED = Severity.SLOW, RETURN
CORNERS = frozenset(Corner)
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
        s = self.lose_pose(replace(self.interrupt(s, cause), cause=cause))
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

    def lose_pose(self, s: S) -> S:
        """The pose is not to be trusted."""
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


def is_denied(v: Verdict) -> bool:
    """No motion is permitted."""
    return not (v.forward or v.reverse or v.turn)


# -- rows of every mission --------------------------------------------------------------------------------------------


def _stand_in_earthquake(rules: HoldRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    """Nothing moves while the ground shakes; home when it is over, and a pose from before is not to be trusted then."""
    s = replace(s, emergency_epoch=v.raised)
    if not s.interlock and s.mode is not DONE:
        why = EARTHQUAKE.message
        s = rules.lose_pose(replace(s, interlock=why, abort_cause=s.abort_cause or why))
        s = rules.hold(s, why, by_hand=s.is_held_by_hand)
    # A fault has to be looked after by an operator, too.
    return s, v.severity is not FAULT


def _fault(rules: HoldRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    if s.mode is HELD and s.is_faulted:
        return s, True
    return rules.fault(s, v.cause, loses_pose=True), True


def _hold(rules: HoldRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    return rules.await_recovery(s, v.cause, rejects_odometry=v.signal not in CORNERS), True


def pause(rules: HoldRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    """Hold until it is over."""
    # A robot that stands to be found needs no permission, and without a pose gets none before it is.
    if s.stands_for_fix and v is not NO_FRESH_VERDICT:
        return s, True
    return rules.interrupt(s, v.cause), True


def _go_home(rules: HoldRules[S], s: S, _frame: object, v: Verdict) -> tuple[S, bool]:
    """Once for each emergency: the level is repeated in each verdict."""
    return rules.abort(replace(s, emergency_epoch=v.raised), v.cause), False


ON_EARTHQUAKE = Row(
    "an earthquake is latched, and no edge is to be left",
    Action.EARTHQUAKE,
    lambda _, v: v.is_shaking and v.code is not NEAR_EDGE,
    _stand_in_earthquake,
)
ON_FAULT = Row("the severity is fault", Action.FAULT, lambda _, v: v.severity is FAULT, _fault)
ON_HOLD = Row(
    "the severity is hold or above, and nothing is permitted",
    Action.HOLD,
    lambda _, v: v.severity >= HOLD and is_denied(v),
    _hold,
)
ON_NO_VERDICT = Row("no verdict is fresh enough", Action.PAUSE, lambda _, v: v is NO_FRESH_VERDICT, pause)
ON_EMERGENCY = Row(
    "an emergency is new",
    Action.RETURN,
    lambda s, v: v.code is ABORTED and v.raised != s.emergency_epoch,
    _go_home,
)


# -- rows of a survey -------------------------------------------------------------------------------------------------

Reaction = tuple[SurveyState, bool]  # the state, and whether that is all for this frame


def _locate(survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict) -> Reaction:
    """A sensor that stays off may be over a seam or the rim where the pose is wrong: one fix, at rest, decides."""
    if s.mode is DONE or s.is_held_by_hand:
        return s, False
    if not s.has_looked:
        s = survey.await_recovery(replace(s, has_looked=True), v.cause)
        s = survey.proceed(s)
    return s, s.stands_for_fix


def _slow(_survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict) -> Reaction:
    """Drive at the reduced speed from now on, or at the usual one from the next leg on."""
    s = replace(s, is_slow=v.severity in REDUCED)
    if s.is_slow and s.mode in (DRIVING, TURNING) and s.fix is FixNeed.NONE:
        s = replace(s, behaviour=None)
    elif s.is_slow and isinstance(s.behaviour, ReturnHome):
        s = replace(s, behaviour=s.behaviour.interrupted())
    return s, False


def _return(survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict) -> Reaction:
    """Once for each finding: it is repeated in each verdict."""
    return survey.abort(replace(s, finding=v.cause), v.cause), False


def _wait_at_edge(survey: "Survey", s: SurveyState, motion: StateEstimate, v: Verdict) -> Reaction:
    """After a retreat that led nowhere."""
    is_over = s.mode is not HELD or s.hold.by_hand or (v.code is not NEAR_EDGE and v is not NO_FRESH_VERDICT)
    if s.stuck_s is None or is_over:
        return replace(s, stuck_s=None), False
    if motion.t_s - s.stuck_s > survey.cfg.health.hold_limit_s:
        return survey.fault(replace(s, stuck_s=None), s.cause), True
    return s, True


def _retreat(survey: "Survey", s: SurveyState, motion: StateEstimate, v: Verdict) -> Reaction:
    if s.mode in (BACKING_OFF, DONE):
        return s, True
    if s.rejects_odometry:
        s = survey.proceed(s)  # where the edge is, is not known before a fix; standing still for it is safe anywhere
    # It stands, and a rim on the map is a matter of the pose that is being found.
    if s.stands_for_fix or s.is_held_by_hand or motion.t_s < s.stands_until_s:
        return s, True
    mission, backoffs = survey.cfg.mission, s.backoffs + 1
    if backoffs > mission.max_backoffs_per_stop:
        return survey.fault(replace(s, backoffs=0), BACK_OFFS.text(count=mission.max_backoffs_per_stop)), True
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


ROWS = (
    ON_EARTHQUAKE,
    ON_FAULT,
    Row(
        "one edge sensor stays off: hold for its signal, and nothing is permitted",
        Action.LOCATE,
        lambda _, v: v.severity is HOLD and v.signal in CORNERS and is_denied(v),
        _locate,
    ),
    ON_HOLD,
    Row(
        "the severity begins or ceases to be slow or return",
        Action.SLOW,
        lambda s, v: s.is_slow is not (v.severity in REDUCED) and v is not NO_FRESH_VERDICT,
        _slow,
    ),
    Row(
        "the severity is return for a new cause, and no edge is to be left",
        Action.RETURN,
        lambda s, v: v.severity is RETURN and v.code is not NEAR_EDGE and v.cause != s.finding,
        _return,
    ),
    Row("a retreat led nowhere", Action.WAIT, lambda s, _: s.stuck_s is not None, _wait_at_edge),
    Row("an edge is declared (code 1)", Action.RETREAT, lambda _, v: v.code is NEAR_EDGE, _retreat),
    ON_NO_VERDICT,
    Row(
        "some motion is not permitted",
        Action.PAUSE,
        lambda _, v: not (v.forward and v.reverse and v.turn),
        pause,
    ),
    ON_EMERGENCY,
)
