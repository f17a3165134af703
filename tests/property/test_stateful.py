"""Whatever happens in whatever order, the invariants I1 to I10 of the fault table hold."""

from collections.abc import Callable
from math import inf, nan
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule, run_state_machine_as_test

from ccatp.config.load import load_config
from ccatp.core import EmergencyKind
from ccatp.survey.events import DONE, Resume, StopHere
from tests.property.stage import Stage

WARM_UP_FRAMES = 90  # the fix at base; the first leg begins
kinds = st.sampled_from([str(kind) for kind in EmergencyKind])
numbers = st.integers(0, 2)
frames = st.integers(1, 60)
duties = st.one_of(st.floats(-0.5, 1.5), st.sampled_from([nan, inf, -inf, 0.0, 0.59999, 0.6, 1.0]))
corners = st.tuples(st.booleans(), st.booleans(), st.booleans(), st.booleans())
worst_overrun_m = 0.0
counts = {"frames": 0, "driven": 0, "edges": 0, "runs": 0, "points": 0, "below": 0}


class Survey(RuleBasedStateMachine):
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
    run_state_machine_as_test(Survey, settings=chosen)
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
