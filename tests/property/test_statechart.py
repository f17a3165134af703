"""The pure step of a survey: no order of verdicts, events and kills makes it move against a row, or forget a point."""

import random
from itertools import product

import msgspec
import pytest
from msgspec.structs import replace

from ccatp.conditions import Action
from ccatp.config.models import Config
from ccatp.core import EmergencyKind, EventCode, Severity, Twist, Verdict
from ccatp.mirror.mirror import Mirror
from ccatp.survey.behaviours import MissionCommand
from ccatp.survey.events import (
    BACKING_OFF,
    DONE,
    DRIVING,
    HELD,
    MEASURING,
    RETURNING,
    TURNING,
    Abort,
    EstimateDiverged,
    Fault,
    FixFailed,
    FixStored,
    Interrupted,
    Pause,
    PointMissed,
    Resume,
    SurveyInput,
    TakenOver,
    TrackingGap,
)
from ccatp.survey.failsafe import ROWS
from ccatp.survey.state import NO_FRESH_VERDICT, FixNeed, SurveyState
from ccatp.survey.statechart import Survey
from tests.support.mission_story import ABORT, FREE, FRONT_OFF, Story

DENIED = replace(FREE, forward=False, reverse=False, turn=False)
SHAKEN = replace(
    DENIED, code=EventCode.ABORTED, cause=f"emergency: {EmergencyKind.EARTHQUAKE}", raised=1, is_shaking=True
)
HOLD = replace(DENIED, severity=Severity.HOLD, cause="a wheel is blocked", signal="enc")
STAYS_OFF = replace(HOLD, cause="an edge sensor stays off", signal="front_left", code=EventCode.NEAR_EDGE)
VERDICTS: dict[str, Verdict | None] = {
    "free": FREE,
    "none": None,
    "stale": replace(DENIED, severity=Severity.PAUSE, cause="edge samples stale"),
    "edge": FRONT_OFF,
    "edge, data missing": replace(FRONT_OFF, reverse=False),
    "slow": replace(FREE, severity=Severity.SLOW, cause="one sensor is slow"),
    "hold": HOLD,
    "sensor stays off": STAYS_OFF,
    "low battery": replace(FREE, severity=Severity.RETURN, cause="the battery"),
    "low battery at the edge": replace(FRONT_OFF, severity=Severity.RETURN, cause="the battery"),
    "fault": replace(DENIED, severity=Severity.FAULT, cause="a wheel runs away"),
    "fire": ABORT,
    "earthquake": SHAKEN,
    "earthquake at the edge": replace(FRONT_OFF, raised=1, is_shaking=True),
    "earthquake and fault": replace(SHAKEN, severity=Severity.FAULT, cause="a wheel runs away"),
    "earthquake and low battery": replace(SHAKEN, severity=Severity.RETURN, cause="the battery"),
}
STILL = Twist(0.0, 0.0)


def events(s: SurveyState, t_s: float, rng: random.Random) -> list[SurveyInput]:
    """What may happen between two frames: a measurement that ends, and now and then anything else."""
    found: list[SurveyInput] = []
    if s.is_awaiting_fix and rng.random() < 0.3:
        point = s.measuring_point
        found.append(rng.choice((FixStored(point, 0.0), FixStored(point, 0.0), FixFailed(point, "no answer"))))
        if point is not None and rng.random() < 0.2:
            found[-1] = PointMissed()
    if rng.random() < 0.01:
        found.append(
            rng.choice(
                (Pause("operator"), Resume(), Resume(), Abort("operator"), Interrupted("late"), Fault("x"),
                 Fault("y", loses_pose=True), EstimateDiverged("filter: z", t_s), TrackingGap())
            )
        )  # fmt: skip
    return found


def check(before: SurveyState, verdict: Verdict | None, s: SurveyState, command: MissionCommand) -> None:
    """The active rows permit the motion; what was measured stays so, once."""
    stands = command.twist == STILL
    for row in ROWS:
        if row.applies(before, verdict or NO_FRESH_VERDICT):
            is_passed = row.action is Action.WAIT and s.stuck_s is None
            is_free = row.action in (Action.SLOW, Action.RETURN, Action.RETREAT)
            assert is_free or stands or is_passed, row.when
            assert row.action is not Action.RETREAT or stands or s.mode is BACKING_OFF
            if row.action not in (Action.SLOW, Action.RETURN) and not is_passed:
                break  # the first such row decides
    if not stands:
        assert s.mode in (TURNING, DRIVING, BACKING_OFF, RETURNING)
    assert s.done[: len(before.done)] == before.done
    assert len(set(s.done)) == len(s.done)
    assert not set(s.done) & set(s.skipped)
    assert not command.measure or (s.mode is MEASURING and s.request == before.request + 1)
    assert s.is_faulted <= (s.mode in (HELD, DONE))


def decoded(s: SurveyState) -> SurveyState:
    """The state behind a checkpoint: it is the same."""
    found = msgspec.msgpack.decode(msgspec.msgpack.encode(s), type=SurveyState)
    assert found == s
    assert list(found.failure_causes) == list(s.failure_causes)
    return found


def killed(survey: Survey, old: SurveyState, s: SurveyState, rng: random.Random) -> SurveyState:
    """Another process goes on with an older state, and with the database as it is now."""
    event = TakenOver(s.done, s.skipped, 1.0, is_new_run=rng.random() < 0.3)
    after, refusal = survey.handle(old, event)
    assert refusal is None
    assert after.fix is FixNeed.RELOCALIZE  # before it moves
    assert after.is_held_by_hand is old.is_held_by_hand
    assert after.done == s.done
    assert not {*after.due, *after.failure_causes} & set(s.done)
    if not event.is_new_run:
        assert (after.skipped, after.abort_cause) == (s.skipped, old.abort_cause)
        assert after.is_faulted is (old.mode is HELD and old.is_faulted)
        assert set(s.skipped) <= after.failure_causes.keys()
        assert after.retried == old.retried
    return after


def walk(config: Config, mirror: Mirror, seed: int, steps: int) -> int:
    """Random steps, survey after survey; the number of those that moved the robot."""
    rng, story, moved = random.Random(seed), Story(config, mirror), 0
    names, name = list(VERDICTS), "free"
    old = story.mission.state
    for step in range(steps):
        survey, s = story.mission.survey, story.mission.state
        same = decoded(s)
        old = same if step % 10 == 0 else old
        if rng.random() < 0.001:
            s = killed(survey, old, s, rng)
        if s.mode is DONE:
            story = Story(config, mirror)
            old = story.mission.state
            continue
        for event in events(s, story.t, rng):
            after, refusal = survey.handle(s, event)
            assert refusal is None or after == s
            s = after
        if rng.random() < 0.02:
            name = rng.choice(names) if rng.random() < 0.5 else "free"
        verdict = VERDICTS[name]
        after, command = survey.step(s, story.motion(), verdict)
        assert survey.step(s, story.motion(), verdict) == (after, command)  # of its arguments alone
        check(s, verdict, after, command)
        story.mission.state = after
        story.auto_fix = False
        story.move(command.twist)
        moved += command.twist != STILL
    return moved


def test_no_motion_against_a_row_in_any_order_of_verdicts_and_events(config: Config, mirror: Mirror) -> None:
    assert walk(config, mirror, 1, 20_000) > 1_000  # a tenth is usual; else it was held all the time


@pytest.mark.slow
def test_no_motion_against_a_row_in_a_million_steps(config: Config, mirror: Mirror) -> None:
    assert sum(walk(config, mirror, seed, 100_000) for seed in range(2, 12)) > 50_000  # a tenth is usual


@pytest.mark.parametrize(("first", "second"), list(product(VERDICTS, VERDICTS)))
def test_each_pair_of_verdicts_from_each_mode(config: Config, mirror: Mirror, first: str, second: str) -> None:
    for mode in (DRIVING, MEASURING):
        story = Story(config, mirror)
        story.until_state(mode)
        for verdict in (VERDICTS[first],) * 3 + (VERDICTS[second],) * 30:
            s = story.mission.state
            command = story.frame(verdict)
            check(s, verdict, story.mission.state, command)
        shaken = [name.startswith("earthquake") for name in (first, second)]
        if shaken[1] and "edge" not in second:
            assert story.state.interlock  # whatever came before, it holds
        if second == "free" and not any(shaken) and first not in ("fault", "hold", "sensor stays off"):
            assert story.state.mode is not HELD
