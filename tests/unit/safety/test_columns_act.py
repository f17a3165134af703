"""Each cell of the table of conditions acts: with another value the danger loop or the mission does something else."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from ccatp.beacons.conditions import GROUP as BEACONS
from ccatp.beacons.mission import BeaconRules
from ccatp.beacons.modes import VISITING, Working
from ccatp.conditions import (
    TABLE,
    Action,
    Clear,
    Condition,
    Motion,
    Owner,
)
from ccatp.conditions.mission import NO_VERDICT, STUCK_AT_EDGE, UNATTENDED_FAULT
from ccatp.config.models import Config
from ccatp.core import EmergencyKind, EventCode, Severity, Verdict
from ccatp.daemon.loops.mission_runner import LoopLimits, MissionRunner
from ccatp.daemon.loops.pauses import PauseWatch
from ccatp.daemon.operator.alarms import active_cause
from ccatp.mirror.mirror import Mirror
from ccatp.safety import edge_episode, emergency_latch
from ccatp.safety.emergency_latch import EmergencyLatch
from ccatp.safety.escalation import SeverityEscalation, most_severe, with_findings
from ccatp.survey.engagement import EngagedMission, Engagement
from ccatp.survey.events import EstimateDiverged, Fault, Interrupted, Mode
from ccatp.survey.state import SurveyState
from tests.support.mission_story import Story
from tests.support.rows import DANGER, OTHERS
from tests.support.scenario import config_of, mirror_of
from tests.unit.test_danger import FRONT
from tests.unit.test_danger import Story as EdgeStory

FREE = Verdict.normal(0, 0.0)
LIMITS = {"health.pause_limit_s": 3.0, "health.hold_limit_s": 7.0, "health.lifted_limit_s": 5.0}
HEALTH = config_of("fyst-m2", **{name.replace(".", "__"): value for name, value in LIMITS.items()}).health


def limit_s(row: Condition) -> float:
    return float(getattr(HEALTH, row.limit.removeprefix("health.")))


FOUND = [row for row in DANGER if row.severity and row.group != BEACONS]  # by a monitor


def named(rows: Sequence[Condition]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("row", rows, ids=[row.name for row in rows])


def verdict_of(row: Condition) -> Verdict:
    return with_findings(FREE, [row.found("x", 2.0, 1.0)])


def escalated(row: Condition, t_s: float) -> Verdict:
    """The verdict on a condition that has lasted for ``t_s``."""
    rules = SeverityEscalation(HEALTH)
    rules.escalate(0.0, [row.found("x", 2.0, 1.0)])
    return with_findings(FREE, rules.escalate(t_s, [row.found("x", 2.0, 1.0)]))


def times_until_fault(row: Condition) -> int:
    rules = SeverityEscalation(HEALTH)
    for count in range(1, 10):
        (found,) = rules.escalate(float(count), [row.found("x", 2.0, 1.0)])
        if found.severity is Severity.FAULT:
            return count
        rules.escalate(count + 0.5, [])
    return 10


@named(FOUND)
def test_action_gives_the_severity(row: Condition) -> None:
    other = replace(row, action=Action.SLOW if row.action is not Action.SLOW else Action.RETURN)
    assert verdict_of(row).severity is not verdict_of(other).severity
    assert verdict_of(row).severity is row.severity


@named([*DANGER, *OTHERS])
def test_action_gives_the_colour_of_the_alarm(row: Condition, monkeypatch: pytest.MonkeyPatch) -> None:
    before = active_cause(row.cause()).severity
    other = replace(row, action=Action.SLOW if before is not Severity.SLOW else Action.FAULT)
    monkeypatch.setitem(TABLE, row.name, other)
    assert active_cause(row.cause()).severity is not before


@named(FOUND)
def test_motion_gives_the_permits(row: Condition) -> None:
    other = replace(row, motion=Motion.ANY if row.motion is Motion.NONE else Motion.NONE)
    before, after = verdict_of(row), verdict_of(other)
    assert (before.forward, before.reverse, before.turn) == ((row.motion is not Motion.NONE,) * 3)
    assert (after.forward, after.reverse, after.turn) == ((row.motion is Motion.NONE,) * 3)


@named(FOUND)
def test_full_fans_are_those_of_the_row(row: Condition) -> None:
    assert verdict_of(row).full_fans is row.full_fans
    assert verdict_of(replace(row, full_fans=not row.full_fans)).full_fans is not row.full_fans


@named(FOUND)
def test_precedence_selects_the_cause_of_equal_severity(row: Condition) -> None:
    other = replace(row, name="another", precedence=row.precedence + 1)
    found = row.found("x", 2.0, 1.0), other.found("y", 2.0, 1.0)
    assert most_severe(found) is found[0]
    assert most_severe((found[0], replace(other, precedence=row.precedence - 1).found("y", 2.0, 1.0))) is not found[0]


LASTING = [row for row in FOUND if row.limit]


@named(LASTING)
def test_limit_is_when_the_severity_rises(row: Condition) -> None:
    for name, limit_s in LIMITS.items():
        changed = replace(row, limit=name)
        assert escalated(changed, limit_s - 0.1).severity is row.severity
        assert escalated(changed, limit_s).severity > row.severity


@named(LASTING)
def test_escalates_to_is_what_it_becomes(row: Condition) -> None:
    at_s = limit_s(row)
    assert escalated(row, at_s).severity is row.raised_severity
    assert escalated(replace(row, escalates_to=Action.RETURN), at_s).severity is Severity.RETURN
    assert escalated(replace(row, escalates_to=None), 1e3).severity is row.severity


@named([row for row in FOUND if row.severity is Severity.HOLD])
def test_retries_is_how_often_a_hold_may_repeat(row: Condition) -> None:
    expected = HEALTH.retries if row.retries is None else row.retries
    assert times_until_fault(row) == expected + 2
    assert times_until_fault(replace(row, retries=expected + 1)) == expected + 3


def reacted(config: Config, mirror: Mirror, verdict: Verdict) -> SurveyState:
    """The state of a driving survey after a verdict."""
    story = Story(config, mirror)
    story.until_state(Mode.DRIVING)
    story.frame(verdict)
    return story.state


def what_ends(state: SurveyState) -> tuple[bool, bool]:
    """Whether an operator has to end the hold, and whether a fix comes before the next move."""
    assert state.mode is Mode.HELD
    return state.is_held_by_hand, state.is_lost


ENDS = {Clear.AUTO: (False, False), Clear.AFTER_FIX: (False, True), Clear.OPERATOR: (True, True)}


@named([row for row in FOUND if row.clear is not None and row.action is not Action.LOCATE])
def test_clear_is_what_ends_the_hold(row: Condition, monkeypatch: pytest.MonkeyPatch) -> None:
    config, mirror = config_of("fyst-m2"), mirror_of("fyst-m2")
    for clear, ends in ENDS.items():
        monkeypatch.setitem(TABLE, row.name, replace(row, clear=clear))
        state = reacted(config, mirror, verdict_of(row))
        assert what_ends(state) == ends, clear


@named([row for row in FOUND if Action.LOCATE in (row.action, row.escalates_to)])
def test_a_fault_of_one_edge_sensor_is_looked_at_with_a_fix(row: Condition, monkeypatch: pytest.MonkeyPatch) -> None:
    verdict = verdict_of(row) if row.action is Action.LOCATE else escalated(row, limit_s(row))
    assert verdict.severity is Severity.HOLD
    config, mirror = config_of("fyst-m2"), mirror_of("fyst-m2")
    assert reacted(config, mirror, verdict).located
    changed = replace(row, action=Action.HOLD if row.action is Action.LOCATE else row.action, escalates_to=Action.FAULT)
    changed = replace(changed, escalates_to=Action.HOLD) if row.action is Action.PAUSE else changed
    monkeypatch.setitem(TABLE, row.name, changed)
    assert not reacted(config, mirror, verdict).located


@named([row for row in FOUND if row.clear is Clear.AFTER_FIX])
def test_trusts_wheels_is_whether_odometry_is_used_in_the_hold(row: Condition, monkeypatch: pytest.MonkeyPatch) -> None:
    config, mirror = config_of("fyst-m2"), mirror_of("fyst-m2")
    for trusts in (False, True):
        monkeypatch.setitem(TABLE, row.name, replace(row, action=Action.HOLD, trusts_wheels=trusts))
        assert reacted(config, mirror, verdict_of(row)).rejects_odometry is not trusts


# -- edges, emergencies, and what is near a robot among beacons --------------------------------------------------------


@pytest.mark.parametrize("name", ["RIM_AHEAD", "BEYOND_SEAM", "NO_SEAM", "OFF_WITHOUT_WHEELS"])
def test_motion_and_action_of_an_edge_give_permits_and_code(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    row: Condition = getattr(edge_episode, name)
    cfg, mirror = config_of("fyst-m1"), mirror_of("fyst-m1")
    right = max(mirror.panels.values(), key=lambda panel: (panel.x_m, -abs(panel.y_m)))

    def verdict(**cells: Any) -> Verdict:
        monkeypatch.setattr(edge_episode, "RIM_AHEAD", replace(row, **cells))
        story = EdgeStory(cfg, mirror, (right.x_m + right.half_x_m - 0.091, right.y_m, 0.0))
        return [story.frame(0.1), story.frame(0.1, off=FRONT)][-1]

    assert verdict().code is EventCode.NEAR_EDGE
    assert (verdict().forward, verdict().reverse) == (False, True)
    assert not verdict(motion=Motion.NONE).reverse
    assert verdict(motion=Motion.ANY).forward
    assert verdict(action=Action.ABORT).code is EventCode.ABORTED


@pytest.mark.parametrize("kind", [EmergencyKind.FIRE, EmergencyKind.EARTHQUAKE])
def test_motion_and_action_of_an_emergency_give_permits_and_code(
    kind: EmergencyKind, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "EARTHQUAKE" if kind is EmergencyKind.EARTHQUAKE else "EMERGENCY"
    row: Condition = getattr(emergency_latch, name)
    latch = EmergencyLatch()
    latch.raise_emergency(kind, "a")
    before = latch.verdict(1, 0.0)
    assert before is not None
    assert (before.forward, before.code) == (row.motion is not Motion.NONE, EventCode.ABORTED)
    other = Motion.ANY if row.motion is Motion.NONE else Motion.NONE
    monkeypatch.setattr(emergency_latch, name, replace(row, motion=other, action=Action.RETREAT))
    after = latch.verdict(1, 0.0)
    assert after is not None
    assert (after.forward, after.code) == (not before.forward, EventCode.NEAR_EDGE)


# -- what a mission, its localizer, its fixes, its link or the main loop finds -----------------------------------------

# Commands of an operator act whatever their row says; the fix service waits for the lasers, and reports lengths.
NOT_MET = {"operator", "restarted", "laser_not_ready", "metrology_unreliable"}
MET = [row for row in OTHERS if row.name not in NOT_MET]


# A mission that finds a fault itself knows where it is.
OWN_ENDS = ENDS | {Clear.OPERATOR: (True, False)}


def met(row: Condition, config: Config, mirror: Mirror) -> tuple[SurveyState, SurveyState]:
    """The state of a driving survey, and the one after its own finding, as the owner of the row reports it."""
    story = Story(config, mirror)
    story.until_state(Mode.DRIVING)
    before, cause = story.state, row.cause()
    match row.owner:
        case Owner.FIXES:
            story.mission.handle(Fault(cause))
        case Owner.LOCALIZER:
            story.mission.handle(EstimateDiverged(cause, story.t))
        case Owner.LINK | Owner.MAIN:
            story.mission.handle(Interrupted(cause))
        case Owner.MISSION if row is UNATTENDED_FAULT:  # the loop watches the battery
            story.mission.handle(Interrupted(cause))
        case _:
            return before, story.mission.survey.meet(before, cause)
    return before, story.state


@named(MET)
def test_motion_and_clear_of_an_own_finding_decide_the_hold(row: Condition, monkeypatch: pytest.MonkeyPatch) -> None:
    config, mirror = config_of("fyst-m2"), mirror_of("fyst-m2")
    if row.motion is Motion.NONE:
        assert what_ends(met(row, config, mirror)[1]) == OWN_ENDS[row.clear or Clear.AUTO]
    for clear, ends in OWN_ENDS.items():
        monkeypatch.setitem(TABLE, row.name, replace(row, motion=Motion.NONE, clear=clear))
        assert what_ends(met(row, config, mirror)[1]) == ends, clear
    monkeypatch.setitem(TABLE, row.name, replace(row, motion=Motion.ANY))
    before, after = met(row, config, mirror)
    assert after.phase == before.phase  # it is only reported
    monkeypatch.setitem(TABLE, row.name, replace(row, motion=Motion.RETURN))
    assert met(row, config, mirror)[1].mode is Mode.RETURNING


def test_clear_of_no_verdict_decides_the_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    config, mirror = config_of("fyst-m2"), mirror_of("fyst-m2")
    for clear, ends in OWN_ENDS.items():
        monkeypatch.setitem(TABLE, NO_VERDICT.name, replace(NO_VERDICT, clear=clear))
        story = Story(config, mirror)
        story.until_state(Mode.DRIVING)
        story.frame(None)
        assert what_ends(story.state) == ends


def test_limit_of_a_retreat_that_leads_nowhere_is_when_it_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    config, mirror = config_of("fyst-m2", health__hold_limit_s=7.0, health__lifted_limit_s=5.0), mirror_of("fyst-m2")
    for name, limit_s in (("health.hold_limit_s", 7.0), ("health.lifted_limit_s", 5.0)):
        monkeypatch.setitem(TABLE, STUCK_AT_EDGE.name, replace(STUCK_AT_EDGE, limit=name))
        assert Story(config, mirror).mission.survey.stuck_limit_s == limit_s


def escalated_pause(row: Condition, config: Config) -> list[tuple[str, int]]:
    """What becomes of a pause that only the main loop finds, each with the second in which it does."""
    seen: list[tuple[str, int]] = []
    mission = EngagedMission(BeaconRules(), Engagement(Working(VISITING)))
    now_s = 0
    runner = SimpleNamespace(
        mission=mission,
        on_tracking_gap=lambda: seen.append(("fix", now_s)),
        telemetry=SimpleNamespace(notify_operator=lambda *_: seen.append(("fault", now_s))),
    )
    watch = PauseWatch(cast(MissionRunner, runner), LoopLimits(clock_jump_s=0.1, hold_s=7.0), config)
    watch.interrupt(row)
    for now_s in range(20):
        watch.escalate(float(now_s), counts=True)
    return seen


@named([row for row in MET if row.owner is Owner.MAIN])
def test_limit_and_escalates_to_of_a_pause_of_the_main_loop(row: Condition, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_of("fyst-m2", health__pause_limit_s=3.0, health__hold_limit_s=7.0, health__lifted_limit_s=5.0)
    monkeypatch.setitem(TABLE, row.name, replace(row, limit="health.lifted_limit_s", escalates_to=Action.HOLD))
    assert escalated_pause(row, config) == [("fix", 5), ("fault", 7)]
    monkeypatch.setitem(TABLE, row.name, replace(row, limit="health.pause_limit_s", escalates_to=Action.HOLD))
    assert escalated_pause(row, config) == [("fix", 3), ("fault", 7)]
    monkeypatch.setitem(TABLE, row.name, replace(row, limit="health.pause_limit_s", escalates_to=Action.FAULT))
    assert escalated_pause(row, config) == [("fault", 3)]
    monkeypatch.setitem(TABLE, row.name, replace(row, escalates_to=None))
    assert escalated_pause(row, config) == []
    # A configuration without that key is of a robot that cannot relocalize.
    monkeypatch.setitem(TABLE, row.name, replace(row, limit="health.pause_limit_s", escalates_to=Action.HOLD))
    assert escalated_pause(row, cast(Config, SimpleNamespace())) == [("fault", 7)]
