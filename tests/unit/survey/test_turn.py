"""Whose turn it is: who acts next, the next action, and what the daemon would accept, in every state."""

from dataclasses import replace
from typing import Any

import msgspec
import pytest

from ccatp import conditions
from ccatp.conditions import Actor, Clear, Condition, Motion, all_conditions
from ccatp.conditions.danger import EARTHQUAKE, EMERGENCY, ENCODERS_STALE, LIFTED, WHEEL_BLOCKED
from ccatp.conditions.mission import LASER_NOT_READY, NO_FRAME_FOR, OPERATOR
from ccatp.core import NO_CAUSE, Cause, Severity, Verdict
from ccatp.daemon.operator.terminal import status_rows
from ccatp.errors import ExitStatus
from ccatp.links.topics import MissionStatus, Turn
from ccatp.survey.engagement import (
    MOVING,
    Earthquake,
    EngagedMission,
    Engagement,
    Faulted,
    Held,
    Kind,
    Over,
    Paused,
)
from ccatp.survey.events import Pause, Resume, SurveyOutcome
from ccatp.survey.turn import CLEAR, Next, offers_of, turn_of, turn_text
from tests.unit.survey.test_engagement import RULES, USUAL, State, Task, explore

CALLED = OPERATOR.cause(by="eva")
BLOCKED = WHEEL_BLOCKED.cause(side="left")
PERSISTS = msgspec.structs.replace(
    Verdict.normal(0, 0.0), cause=BLOCKED, severity=Severity.FAULT, forward=False, reverse=False, turn=False
)


def status_of(s: Engagement, turn: Turn, **told: Any) -> MissionStatus:
    return MissionStatus(seq=0, t_s=0.0, state=str(s.mode), turn=turn, outcome=str(s.outcome), **told)


def line_of(s: Engagement, verdict: Verdict | None = None, offers: tuple[str, ...] = (), **told: str) -> str:
    return turn_text(status_of(s, turn_of(s, verdict, offers), **told)).line


def test_in_every_state_one_acts_and_only_what_would_be_accepted_is_offered() -> None:
    states, _ = explore(USUAL)
    assert {s.kind for s in states} == set(Kind)
    for s in states:
        mission = EngagedMission(RULES, s)
        offers = offers_of(mission, Verdict.normal(1, 0.01))
        assert set(offers) - set(offers_of(mission, None)) <= {CLEAR}  # danger knows nothing of the state yet
        is_resumed = RULES.handle(s, Resume())[1] is None
        assert ("resume" in offers) is (s.is_held_by_hand and is_resumed)
        assert ("pause" in offers) is (s.kind not in (Kind.PAUSED, Kind.FAULTED, Kind.OVER))
        assert ("stop" in offers) is (s.kind is not Kind.OVER)
        assert s.kind is not Kind.OVER or not offers
        assert mission.state is s, "asking changes nothing"
        for verdict in USUAL:
            turn = turn_of(s, verdict, offers)
            assert turn.next not in (Next.RESUME, Next.CLEAR) or turn.next in offers
            if s.kind in MOVING:
                assert turn.actor is Actor.ROBOT
            if s.is_paused:
                assert turn.actor in (Actor.OPERATOR, Actor.OBSERVATORY)
            text = turn_text(status_of(s, turn))
            assert text.does
            assert text.then
            assert text.request in ("", *offers)


@pytest.mark.parametrize(
    ("s", "verdict", "offers", "line"),
    [
        (Engagement(), None, (),
         "waiting for the robot, its laser system and the danger loop. Next: the robot begins by itself"),
        (State(Task(stands=False)), None, (), "driving to 5-4-7. Next: the robot continues by itself"),
        (Engagement(Paused(), cause=CALLED), None, ("resume",), "paused by eva. Next: an operator: resume"),
        (Engagement(Paused(), cause=CALLED), PERSISTS, (),
         "paused by eva. Next: an operator: look for an obstacle at the wheel; resume is refused while this lasts: the "
         "left wheel is blocked"),
        (Engagement(Faulted(), cause=BLOCKED), None, ("resume",),
         "held by a fault: the left wheel is blocked. Next: an operator: look for an obstacle at the wheel, then "
         "resume"),
        (Engagement(Faulted(), cause=BLOCKED), PERSISTS, (),
         "held by a fault: the left wheel is blocked. Next: an operator: look for an obstacle at the wheel; resume is "
         "refused until this has ended"),
        (Engagement(Held(), cause=NO_FRAME_FOR.cause(limit_s=0.15)), None, (),
         "held: no sensors frame for more than 0.15 s. Next: the robot continues by itself when this has ended"),
        (Engagement(Held(), cause=ENCODERS_STALE.cause()), None, (),
         "held: encoder samples stale. Next: the robot takes a fix when this has ended, then continues by itself"),
        (Engagement(Held(), cause=LIFTED.cause()), None, (),
         "held: all edge sensors off: lifted or fallen. Next: an operator: put the robot back on the mirror; do not "
         "cut the power of its fans; then the robot continues by itself"),
        (Engagement(Held(), cause=EARTHQUAKE.cause(), earthquake=Earthquake.HELD), None, (CLEAR,),
         "held: emergency: earthquake. Next: the observatory: clear the emergency when the earthquake is over"),
        (Engagement(Paused(), cause=CALLED, is_latched=True), None, (CLEAR,),
         "paused by eva. Next: the observatory: clear the emergency; then resume"),
        (Engagement(Over(SurveyOutcome.COMPLETE)), None, (), "complete. Next: nothing is left to do"),
        (Engagement(Over(SurveyOutcome.AT_BASE), cause=CALLED), None, (),
         "returned to base; by eva. Next: an operator: 'ccatp run --resume' measures the remaining points"),
        (Engagement(Over(SurveyOutcome.AT_BASE), cause=EMERGENCY.cause(kind="fire")), None, (),
         "returned to base; by the observatory, emergency: fire. Next: the observatory: 'ccatp run --resume "
         "--start-held', then clear the emergency when its cause is gone, then resume"),
    ],
)  # fmt: skip
def test_the_line(s: Engagement, verdict: Verdict | None, offers: tuple[str, ...], line: str) -> None:
    told = {"condition": s.cause.condition, "cause": conditions.text_of(s.cause), "point": "5-4-7"}
    assert line_of(s, verdict, offers, **told) == line


def test_nobody_is_asked_to_resume_a_mission_that_cannot_be_continued() -> None:
    stopped = Engagement(Over(SurveyOutcome.STOPPED), cause=BLOCKED)
    for s, hands in ((stopped, "look for an obstacle at the wheel; "), (Engagement(Over(SurveyOutcome.STOPPED)), "")):
        turn = turn_of(s, None, (), resumes=False)
        assert turn_text(status_of(s, turn)).then == f"{hands}a new run begins the mission again"
    at_base = Engagement(Over(SurveyOutcome.AT_BASE), cause=EMERGENCY.cause(kind="fire"))
    then = turn_text(status_of(at_base, turn_of(at_base, None, (), resumes=False))).then
    assert then == "clear the emergency when its cause is gone; a new run begins the mission again"
    faulted = Engagement(Faulted(), cause=Cause("unknown"))  # the daemon ended without the end of its mission
    text = turn_text(status_of(faulted, turn_of(faulted, None, (), resumes=False), exit_status=int(ExitStatus.HELD)))
    assert text.then == "a new run begins the mission again"


def test_what_held_the_robot_is_not_why_an_operator_stopped_it() -> None:
    s = Engagement(Over(SurveyOutcome.STOPPED), cause=ENCODERS_STALE.cause())
    line = line_of(s, condition=s.cause.condition, cause="encoder samples stale", stopped_by="eva")
    assert line.startswith("stopped where it was; by eva, held before: encoder samples stale. Next:")


def test_a_daemon_that_has_ended_accepts_nothing_even_if_its_mission_was_held() -> None:
    s = Engagement(Faulted(), cause=BLOCKED)
    turn = turn_of(s, None, ("resume", "abort", "stop"))
    text = turn_text(status_of(s, turn, exit_status=int(ExitStatus.HELD), condition=WHEEL_BLOCKED.name, cause="b"))
    assert text.does == "ended with a fault; b"
    assert (text.who, text.request) == ("an operator:", "")
    assert text.then.startswith("look for an obstacle at the wheel; 'ccatp run --resume'")


def test_what_held_the_robot_is_not_why_it_measures_afterwards() -> None:
    """Until the fix the state keeps the cause; an operator who has resumed is not asked to resume."""
    s = State(Task(stands=True), cause=ENCODERS_STALE.cause())
    status = status_of(s, turn_of(s, None, ()), condition=s.cause.condition, cause="encoder samples stale")
    assert turn_text(status).line == (
        "measuring the next stop, after: encoder samples stale. Next: the robot continues by itself"
    )
    rows = dict(status_rows(msgspec.to_builtins(status)))
    assert rows["cause"] == "encoder samples stale"
    assert (rows.get("what to do", ""), rows.get("severity", ""), rows.get("for", "")) == ("", "", "")


def test_a_robot_that_waits_for_its_laser_says_so_and_continues_by_itself() -> None:
    s = State(Task(stands=True))
    turn = turn_of(s, None, (), LASER_NOT_READY.cause())
    line = turn_text(status_of(s, turn, point="1-2-3")).line
    assert line == (
        "measuring 1-2-3: the laser system is not ready (laserready_0). "
        "Next: the robot continues by itself when this has ended"
    )


def test_a_status_of_an_older_version_says_what_it_does_and_names_nobody() -> None:
    text = turn_text(MissionStatus(seq=0, t_s=0.0, state="held", cause="operator"))
    assert (text.line, text.who, text.request) == ("held: operator", "", "")


# -- the columns act ---------------------------------------------------------------------------------------------------

# Rows that can hold the robot until somebody acts: of themselves, or because they last or repeat.
HOLDING = [row for row in all_conditions() if row.motion is Motion.NONE and row.name != OPERATOR.name]


def with_row(monkeypatch: pytest.MonkeyPatch, row: Condition) -> None:
    monkeypatch.setitem(conditions.TABLE, row.name, row)


@pytest.mark.parametrize("row", HOLDING, ids=lambda row: row.name)
def test_then_is_the_next_action_of_people(row: Condition, monkeypatch: pytest.MonkeyPatch) -> None:
    s = Engagement(Faulted(), cause=Cause(row.name))
    assert row.then
    assert row.then in line_of(s, offers=("resume",))
    with_row(monkeypatch, replace(row, then="sing to it"))
    assert "an operator: sing to it, then resume" in line_of(s, offers=("resume",))
    assert "an operator: sing to it; resume is refused until" in line_of(s)


@pytest.mark.parametrize("row", [row for row in HOLDING if row.clear is not Clear.OPERATOR], ids=lambda row: row.name)
def test_actor_is_who_acts_while_the_condition_holds_the_robot(row: Condition, monkeypatch: pytest.MonkeyPatch) -> None:
    s = Engagement(Held(), cause=Cause(row.name))
    for actor in (Actor.ROBOT, Actor.OPERATOR, Actor.OBSERVATORY):
        with_row(monkeypatch, replace(row, actor=actor))
        assert turn_of(s, None, ()).actor is actor
        assert actor.value in line_of(s).split("Next: ")[1].split()[1]


def test_an_action_of_an_operator_is_offered_with_the_name_of_the_request() -> None:
    mission = EngagedMission(RULES, RULES.handle(State(Task(stands=False)), Pause(CALLED))[0])
    assert offers_of(mission, None) == ("resume", "abort", "stop")
    s = mission.state
    text = turn_text(status_of(s, turn_of(s, None, offers_of(mission, None))))
    assert text.request == "resume"


def test_the_words_do_not_change_the_names() -> None:
    turn = turn_of(Engagement(Held(), cause=BLOCKED), None, ("stop",))
    assert msgspec.json.decode(msgspec.json.encode(turn), type=Turn) == turn
    assert (turn.kind, turn.actor, turn.next, turn.why) == ("held", "robot", "wait_and_fix", BLOCKED)
    assert turn.bars == NO_CAUSE
