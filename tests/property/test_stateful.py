"""Whatever happens in whatever order: the invariants I1 to I10 of the fault table, and the step of a survey."""

import random
from collections.abc import Callable
from itertools import product
from math import inf, nan
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule, run_state_machine_as_test
from msgspec.structs import replace

from ccatp.conditions import Action
from ccatp.conditions.danger import (
    BATTERY_LOW,
    EARTHQUAKE,
    EDGE_SENSOR_STAYS_OFF,
    EDGE_STALE,
    FRAMES_LOST,
    GRIP_TOO_LITTLE,
    SAMPLES_TOO_FEW,
    WHEELS_STAND,
)
from ccatp.conditions.mission import (
    FANS_REFUSED,
    FILTER_DIVERGED,
    NO_FRAME_FOR,
    OPERATOR,
)
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import Cause, EmergencyKind, EventCode, Severity, Twist, Verdict
from ccatp.mirror.mirror import Mirror
from ccatp.survey.behaviours import MissionCommand
from ccatp.survey.engagement import NO_FRESH_VERDICT, Earthquake, Held
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
    StopHere,
    SurveyInput,
    TakenOver,
    TrackingGap,
)
from ccatp.survey.failsafe import ROWS
from ccatp.survey.state import SurveyState
from ccatp.survey.statechart import Mission, Survey
from tests.property.stage import Stage
from tests.support.mission_story import ABORT, FREE, FRONT_OFF, Story

WARM_UP_FRAMES = 90  # the fix at base; the first leg begins
kinds = st.sampled_from([str(kind) for kind in EmergencyKind])
numbers = st.integers(0, 2)
frames = st.integers(1, 60)
duties = st.one_of(st.floats(-0.5, 1.5), st.sampled_from([nan, inf, -inf, 0.0, 0.59999, 0.6, 1.0]))
corners = st.tuples(st.booleans(), st.booleans(), st.booleans(), st.booleans())
worst_overrun_m = 0.0
counts = {"frames": 0, "driven": 0, "edges": 0, "runs": 0, "points": 0, "below": 0}


class OnePanel(RuleBasedStateMachine):
    """One panel of a mirror."""

    stage: Stage

    @initialize(mirror=st.sampled_from(["fyst-m1", "fyst-m2"]), seed=st.integers(1, 5), slow_fix=st.integers(0, 40))
    def begin(self, mirror: str, seed: int, slow_fix: int) -> None:
        overrides = {"run.mirror": mirror, "run.world": "hard", "run.filter": "kf", "run.panels": 1, "run.seed": seed}
        self.stage = Stage(load_config(overrides=overrides))
        self.stage.trouble.fix_frames = slow_fix
        self.stage.advance(WARM_UP_FRAMES)

    @rule(n=frames)
    def proceed(self, n: int) -> None:
        self.stage.advance(n)

    @rule(n=st.integers(100, 400))
    def go_on_for_long(self, n: int) -> None:
        self.stage.advance(n)

    @rule(off=corners, n=st.integers(1, 120))
    def sensors_go_off(self, off: tuple[bool, bool, bool, bool], n: int) -> None:
        self.stage.trouble.off, self.stage.trouble.off_frames = off, n
        self.stage.advance(min(n, 40))

    @rule(n=st.integers(1, 40))
    def edge_samples_are_missing(self, n: int) -> None:
        self.stage.trouble.no_edges = n
        self.stage.advance(n)

    @rule(n=st.integers(1, 40))
    def a_wheel_is_silent(self, n: int) -> None:
        self.stage.trouble.no_wheels = n
        self.stage.advance(n)

    @rule(n=st.integers(1, 60))
    def frames_are_lost(self, n: int) -> None:
        self.stage.trouble.lost = n
        self.stage.advance(n + 3)

    @rule(n=st.integers(0, 60))
    def danger_restarts(self, n: int) -> None:
        self.stage.restart_danger(n)
        self.stage.advance(n // 2 + 1)

    @rule(by_s=st.floats(-0.5, 0.5))
    def the_clock_steps(self, by_s: float) -> None:
        self.stage.trouble.clock_s = max(self.stage.trouble.clock_s + by_s, 0.0)
        self.stage.advance(5)

    @rule(kind=kinds, number=numbers)
    def an_emergency(self, kind: str, number: int) -> None:
        self.stage.emergency(kind, number)
        self.stage.advance(2)

    @rule(number=numbers)
    def a_clear(self, number: int) -> None:
        self.stage.clear(number)

    @rule()
    def a_pause(self) -> None:
        self.stage.look_at_hold()
        self.stage.advance(1)
        assert self.stage.robot.sent == (0.0, 0.0), "I9"

    @rule()
    def a_resume(self) -> None:
        self.stage.mission.handle(Resume())
        self.stage.advance(10)

    @precondition(lambda self: self.stage.frames > 400)
    @rule()
    def an_abort(self) -> None:
        self.stage.abort()
        self.stage.advance(20)

    @precondition(lambda self: self.stage.frames > 1500)
    @rule()
    def a_stop(self) -> None:
        self.stage.mission.handle(StopHere())
        self.stage.advance(2)
        assert self.stage.mission.state.mode is DONE
        assert self.stage.robot.sent == (0.0, 0.0)

    @rule(fails=st.booleans(), n=st.integers(0, 60))
    def the_laser(self, fails: bool, n: int) -> None:
        self.stage.trouble.fixes_fail, self.stage.trouble.fix_frames = fails, n

    @rule(left=duties, right=duties)
    def fans(self, left: float, right: float) -> None:
        self.stage.command_fans(left, right)
        self.stage.advance(1)

    @rule(left=duties, right=duties)
    def fans_by_somebody_else(self, left: float, right: float) -> None:
        self.stage.command_fans_past_the_gate(left, right)
        self.stage.advance(1)

    def teardown(self) -> None:
        global worst_overrun_m  # noqa: PLW0603 - hypothesis makes and drops the machines
        if not hasattr(self, "stage"):
            return
        worst_overrun_m = max(worst_overrun_m, self.stage.overrun_m)
        counts["runs"] += 1
        counts["frames"] += self.stage.frames
        counts["driven"] += self.stage.driven
        counts["edges"] += self.stage.edges_seen
        counts["below"] += self.stage.below_floor
        counts["points"] += len(self.stage.acknowledged)


def run(examples: int, steps: int, **kwargs: Any) -> None:
    quiet = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
    chosen = settings(
        max_examples=examples, stateful_step_count=steps, deadline=None, suppress_health_check=quiet, **kwargs
    )
    run_state_machine_as_test(OnePanel, settings=chosen)
    print(f"{counts}, worst overrun {1e3 * worst_overrun_m:.1f} mm")


@pytest.mark.fault("F3")
def test_invariants_in_any_order_of_events(measured: Callable[[str, float], None]) -> None:
    run(5, 30)
    measured("F3", counts["below"])
    assert counts["driven"] > 50


@pytest.mark.slow
@pytest.mark.fault("F3")
def test_invariants_in_very_many_orders_of_events(measured: Callable[[str, float], None]) -> None:
    run(400, 60)
    measured("F3", counts["below"])
    assert counts["points"] > 0
    assert counts["edges"] > 0


# -- the pure step of a survey -----------------------------------------------------------------------------------------

DENIED = replace(FREE, forward=False, reverse=False, turn=False)
SHAKEN = replace(DENIED, code=EventCode.ABORTED, cause=EARTHQUAKE.cause(), raised=1, is_shaking=True)
HOLD = replace(DENIED, severity=Severity.HOLD, cause=WHEELS_STAND.cause(), signal="encoders")
STAYS_OFF = replace(HOLD, cause=EDGE_SENSOR_STAYS_OFF.cause(), signal="front_left", code=EventCode.NEAR_EDGE)
VERDICTS: dict[str, Verdict | None] = {
    "free": FREE,
    "none": None,
    "stale": replace(DENIED, severity=Severity.PAUSE, cause=EDGE_STALE.cause()),
    "edge": FRONT_OFF,
    "edge, data missing": replace(FRONT_OFF, reverse=False),
    "slow": replace(FREE, severity=Severity.SLOW, cause=SAMPLES_TOO_FEW.cause()),
    "hold": HOLD,
    "sensor stays off": STAYS_OFF,
    "low battery": replace(FREE, severity=Severity.RETURN, cause=BATTERY_LOW.cause()),
    "low battery at the edge": replace(FRONT_OFF, severity=Severity.RETURN, cause=BATTERY_LOW.cause()),
    "fault": replace(DENIED, severity=Severity.FAULT, cause=GRIP_TOO_LITTLE.cause()),
    "fire": ABORT,
    "earthquake": SHAKEN,
    "earthquake at the edge": replace(FRONT_OFF, raised=1, is_shaking=True),
    "earthquake and fault": replace(SHAKEN, severity=Severity.FAULT, cause=GRIP_TOO_LITTLE.cause()),
    "of a newer version": replace(FREE, cause=Cause("mirror_on_fire")),
    "earthquake and low battery": replace(SHAKEN, severity=Severity.RETURN, cause=BATTERY_LOW.cause()),
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
                (
                    *(Pause(OPERATOR.cause()), Resume(), Resume(), Abort(OPERATOR.cause())),
                    *(Interrupted(NO_FRAME_FOR.cause(limit_s=1.0)), Fault(FRAMES_LOST.cause())),
                    Fault(FANS_REFUSED.cause(why="y"), loses_pose=True),
                    *(EstimateDiverged(FILTER_DIVERGED.cause(why="z"), t_s), TrackingGap()),
                )
            )
        )
    return found


def check(before: SurveyState, verdict: Verdict | None, s: SurveyState, command: MissionCommand) -> None:
    """The active rows permit the motion; what was measured stays so, once."""
    stands = command.twist == STILL
    for row in ROWS:
        if row.applies(before, verdict or NO_FRESH_VERDICT):
            is_passed = row.action is Action.WAIT and not (isinstance(s.phase, Held) and s.phase.stuck_s is not None)
            is_free = row.action in (Action.SLOW, Action.RETURN, Action.RETREAT)
            assert is_free or stands or is_passed, row.when
            assert row.action is not Action.RETREAT or stands or s.mode is BACKING_OFF
            if row.action not in (Action.SLOW, Action.RETURN) and not is_passed:
                break  # the first such row decides
    if not stands:
        assert s.mode in (TURNING, DRIVING, BACKING_OFF, RETURNING)
    assert s.points.done[: len(before.points.done)] == before.points.done
    assert len(set(s.points.done)) == len(s.points.done)
    assert not set(s.points.done) & set(s.points.skipped)
    assert not command.measure or (s.mode is MEASURING and s.request == before.request + 1)
    assert s.is_faulted <= (s.mode in (HELD, DONE))


def decoded(s: SurveyState) -> SurveyState:
    """The state behind a checkpoint: it is the same."""
    found = msgspec.msgpack.decode(msgspec.msgpack.encode(s), type=SurveyState)
    assert found == s
    assert list(found.points.failed) == list(s.points.failed)
    return found


def killed(survey: Survey, old: SurveyState, s: SurveyState, rng: random.Random) -> SurveyState:
    """Another process goes on with an older state, and with the database as it is now."""
    event = TakenOver(s.points.done, s.points.skipped, 1.0, is_new_run=rng.random() < 0.3)
    after, refusal = survey.handle(old, event)
    assert refusal is None
    assert after.is_lost  # before it moves
    assert after.is_held_by_hand is old.is_held_by_hand
    assert after.points.done == s.points.done
    assert not {*after.points.due, *after.points.failed} & set(s.points.done)
    if not event.is_new_run:
        assert (after.points.skipped, after.abort_cause) == (s.points.skipped, old.abort_cause)
        assert after.is_faulted is (old.mode is HELD and old.is_faulted)
        assert set(s.points.skipped) <= after.points.failed.keys()
        assert all(after.points.failed[p] == f for p, f in old.points.failed.items() if p in s.points.skipped)
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
        story.mission = Mission(survey, after)
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
            assert story.state.earthquake is Earthquake.HELD  # whatever came before, it holds
        if second == "free" and not any(shaken) and first not in ("fault", "hold", "sensor stays off"):
            assert story.state.mode is not HELD
