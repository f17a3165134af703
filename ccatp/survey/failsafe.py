"""What slows, pauses, holds, returns or stops a survey, frame by frame: one table, and what each action does.

The first row that applies decides; a row whose action lets the survey go on is followed by the rows after it.
"""

from typing import TYPE_CHECKING

from msgspec.structs import replace

from ccatp.conditions import BACK_OFFS, Action
from ccatp.core import Severity, Verdict
from ccatp.survey.behaviours import Retreat, ReturnHome
from ccatp.survey.holding import (
    CORNERS,
    HOLD,
    NEAR_EDGE,
    ON_EARTHQUAKE,
    ON_EMERGENCY,
    ON_FAULT,
    ON_HOLD,
    ON_NO_VERDICT,
    RETURN,
    Row,
    cause_of,
    is_denied,
    pause,
)
from ccatp.survey.route_follower import StateEstimate
from ccatp.survey.state import BACKING_OFF, DONE, DRIVING, HELD, TURNING, FixNeed, MissionEvent, SurveyState

if TYPE_CHECKING:
    from ccatp.survey.statechart import Survey

REDUCED = (Severity.SLOW, RETURN)
Reaction = tuple[SurveyState, bool]  # the state, and whether that is all for this frame


def _locate(survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict | None) -> Reaction:
    """A sensor that stays off may be over a seam or the rim where the pose is wrong: one fix, at rest, tells."""
    if s.mode is DONE or s.is_held_by_hand:
        return s, False
    if not s.has_looked:
        s = survey.await_recovery(replace(s, has_looked=True), cause_of(v))
        s = survey.proceed(s)
    return s, s.stands_for_fix


def _slow(_survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict | None) -> Reaction:
    """Drive at the reduced speed from now on, or at the usual one from the next leg on."""
    s = replace(s, is_slow=v is not None and v.severity in REDUCED)
    if s.is_slow and s.mode in (DRIVING, TURNING) and s.fix is FixNeed.NONE:
        s = replace(s, behaviour=None)
    elif s.is_slow and isinstance(s.behaviour, ReturnHome):
        s = replace(s, behaviour=s.behaviour.interrupted())
    return s, False


def _return(survey: "Survey", s: SurveyState, _motion: StateEstimate, v: Verdict | None) -> Reaction:
    """Once for each finding: it is repeated in each verdict."""
    cause = cause_of(v)
    return survey.abort(replace(s, finding=cause), cause), False


def _wait_at_edge(survey: "Survey", s: SurveyState, motion: StateEstimate, v: Verdict | None) -> Reaction:
    """After a retreat that led nowhere."""
    is_over = s.mode is not HELD or s.hold.by_hand or (v is not None and v.code is not NEAR_EDGE)
    if s.stuck_s is None or is_over:
        return replace(s, stuck_s=None), False
    if motion.t_s - s.stuck_s > survey.cfg.health.hold_limit_s:
        return survey.fault(replace(s, stuck_s=None), s.cause), True
    return s, True


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
        lambda _, v: v is not None and v.severity is HOLD and v.signal in CORNERS and is_denied(v),
        _locate,
    ),
    ON_HOLD,
    Row(
        "the severity begins or ceases to be slow or return",
        Action.SLOW,
        lambda s, v: v is not None and s.is_slow is not (v.severity in REDUCED),
        _slow,
    ),
    Row(
        "the severity is return for a new cause, and no edge is to be left",
        Action.RETURN,
        lambda s, v: v is not None and v.severity is RETURN and v.code is not NEAR_EDGE and v.cause != s.finding,
        _return,
    ),
    Row("a retreat led nowhere", Action.WAIT, lambda s, _: s.stuck_s is not None, _wait_at_edge),
    Row("an edge is declared (code 1)", Action.RETREAT, lambda _, v: v is not None and v.code is NEAR_EDGE, _retreat),
    ON_NO_VERDICT,
    Row(
        "some motion is not permitted",
        Action.PAUSE,
        lambda _, v: v is not None and not (v.forward and v.reverse and v.turn),
        pause,
    ),
    ON_EMERGENCY,
)
