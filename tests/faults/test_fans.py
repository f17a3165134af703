"""Faults of the fans on an overhanging mirror: what the echo shows, what the robot reports, and the floor."""

from collections.abc import Callable
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccatp.control.gate import FanGate
from ccatp.core import Severity
from ccatp.survey.state import MissionState
from tests.faults.campaign import Seen, short_survey, was_real, watched

Measured = Callable[[str, float], None]

OVERHANG = short_survey(run__mirror="fyst-m2")
UPRIGHT = short_survey()
AT_S = 4.0


def faulted(one: Seen) -> bool:
    return one.verdict.severity is Severity.FAULT


def a_little_later(one: Seen) -> bool:
    return one.t_s > AT_S + 1.0


@pytest.mark.fault("F1", "F5")
@pytest.mark.parametrize(
    "fault",
    [
        '"fans"\ntype = "stuck"\nvalue = 0.3',
        '"fans"\ntype = "wrong"\nfactor = 0.7',
        '"faults"\ntype = "raise"\nnames = ["fan_left"]',
        '"faults"\ntype = "raise"\nnames = ["fan_right"]',
    ],
)
def test_a_fan_that_gives_too_little_holds_with_full_fans(fault: str, measured: Measured) -> None:
    run = watched(f"signal = {fault}\nat_s = {AT_S}", OVERHANG, a_little_later)
    assert was_real(run.injected[0])
    first = run.first(AT_S, faulted)
    assert first.is_zero
    assert run.mission.is_faulted
    assert "fan" in run.mission.cause
    assert run.mission.wants_full_fans
    assert run._has_full_fans  # sent; the rehearsal of a faulted mission ends before it arrives
    # The echo has to be low for 0.1 s; what counts is how long after that the wheels get their zero.
    seen_s = 0.1 if "faults" not in fault else 0.0
    late_s = first.t_s - AT_S - seen_s
    assert late_s <= 0.1
    for row in ("F1", "F5"):
        measured(row, 1e3 * late_s)


@pytest.mark.fault("F2")
def test_fans_that_get_weaker_send_the_robot_home_in_time(measured: Measured) -> None:
    run = watched(f'signal = "fans"\ntype = "wrong"\nat_s = {AT_S}\nfactor = 0.91', OVERHANG, a_little_later)
    assert was_real(run.injected[0])
    assert run.seen[-1].state is MissionState.RETURNING
    assert run.robot.fans.duty == (1.0, 1.0)
    margin = 0.91 * OVERHANG.robot.fan_duty[0] / OVERHANG.sim.robot.fan_floor
    measured("F2", margin)


def test_where_nothing_hangs_a_weak_fan_is_only_told() -> None:
    run = watched(f'signal = "faults"\ntype = "raise"\nat_s = {AT_S}\nnames = ["fan_left"]', UPRIGHT, a_little_later)
    assert was_real(run.injected[0])
    assert run.seen[-1].verdict.severity is Severity.INFORM
    assert run.seen[-1].verdict.forward
    assert not run.mission.is_faulted


@pytest.mark.fault("F3")
@given(st.lists(st.tuples(st.floats(), st.floats()) | st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0))))
def test_no_sequence_of_commands_undercuts_the_floor(commands: list[tuple[float, float]]) -> None:
    gate, duty = FanGate(0.6), (0.6, 0.6)
    for command in commands:
        duty = command if gate.refusal(*command) is None else duty
        assert 0.6 <= min(duty) <= max(duty) <= 1.0


@pytest.mark.parametrize("duty", [(nan, 0.8), (0.8, inf), (0.59, 0.8), (0.8, 1.01), (-1.0, 0.8)])
def test_a_refused_command_is_counted(duty: tuple[float, float]) -> None:
    gate = FanGate(0.6)
    assert gate.refusal(*duty)
    assert gate.refused == 1
    assert gate.refusal(0.6, 1.0) is None
    assert gate.refused == 1
