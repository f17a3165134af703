"""Faults of wheels, link, battery, fans and body: injected, real at the robot, answered in time."""

import random
from itertools import pairwise
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccatp.config.models import Config
from ccatp.control.gate import FanGate
from ccatp.core import Severity
from ccatp.studies.faults_study import FaultySilRun
from ccatp.survey.state import MissionState, SurveyOutcome
from tests.faults.linking import Measured
from tests.support.sim_survey import Seen, short_survey, single, was_real, watched

DRIVING_S, TURNING_S, STANDING_S = 7.5, 3.5, 9.6
HARD = short_survey()


def held(one: Seen) -> bool:
    return one.verdict.severity >= Severity.HOLD and one.t_s > 1.0


def holds(seen: list[Seen]) -> int:
    return sum(a.state is not MissionState.HELD and b.state is MissionState.HELD for a, b in pairwise(seen))


@pytest.mark.fault("F8")
@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("at_s", [DRIVING_S, TURNING_S])
def test_a_blocked_wheel_gets_one_retry(side: str, at_s: float, measured: Measured) -> None:
    run = watched(f'signal = "{side}_wheel"\ntype = "blocked"\nat_s = {at_s}', HARD, lambda _: False)
    time_s = run.time_to_zero_s(at_s)
    assert time_s <= 0.3
    assert run.mission.is_faulted
    assert 2 <= holds(run.seen) <= 3
    assert not run.robot.world.is_fallen
    measured("F8", 1e3 * time_s)


@pytest.mark.fault("F8")
def test_a_wheel_that_is_free_again_after_a_while_goes_on() -> None:
    run = watched(f'signal = "right_wheel"\ntype = "blocked"\nat_s = {DRIVING_S}\nfor_s = 1.5', HARD,
                  lambda one: one.t_s > 20.0)  # fmt: skip
    assert not run.mission.is_faulted
    assert len(run.mission.done) >= 3


@pytest.mark.fault("F10")
def test_a_robot_that_is_snagged_holds(measured: Measured) -> None:
    fault = "\n\n".join(f'signal = "{side}_wheel"\ntype = "blocked"\nat_s = {DRIVING_S}' for side in ("right", "left"))
    run = watched(fault, HARD, held)
    time_s = run.time_to_zero_s(DRIVING_S)
    assert time_s <= 0.3
    measured("F10", 1e3 * time_s)


@pytest.mark.fault("F9")
@pytest.mark.parametrize("rate", [8.0, -8.0])
@pytest.mark.parametrize("at_s", [DRIVING_S, TURNING_S, STANDING_S])
def test_a_wheel_that_runs_away(rate: float, at_s: float, measured: Measured) -> None:
    fault = f'signal = "left_wheel"\ntype = "runaway"\nat_s = {at_s}\nfor_s = 0.4\nrate_rad_s = {rate}'
    run = watched(fault, HARD, lambda one: one.t_s > at_s + 0.3)
    time_s = run.time_to_zero_s(at_s)
    assert time_s <= 0.1
    assert run.first(at_s, held).verdict.signal in {"left_wheel", "encoder_left"}
    measured("F9", 1e3 * time_s)


@pytest.mark.parametrize("rate", [8.0, -8.0])
def test_a_wheel_that_runs_away_while_its_encoder_is_slow(rate: float) -> None:
    slow = "\n\n".join(
        f'signal = "encoder_{side}"\ntype = "slow"\nat_s = {DRIVING_S - 1.0}\nevery = 3' for side in ("left", "right")
    )
    fault = f'signal = "left_wheel"\ntype = "runaway"\nat_s = {DRIVING_S}\nfor_s = 0.4\nrate_rad_s = {rate}'
    run = watched(f"{slow}\n\n{fault}", HARD, lambda one: one.t_s > DRIVING_S + 0.6)
    assert run.time_to_zero_s(DRIVING_S) <= 0.15  # two faults at once: not the 0.1 s of one
    assert run.first(DRIVING_S, held).verdict.signal in {"left_wheel", "encoder_left"}


@pytest.mark.fault("S7")
@pytest.mark.parametrize("speed_m_s", [0.002, 0.005, 0.02])
def test_wheels_that_creep_while_they_are_held(speed_m_s: float, measured: Measured) -> None:
    """The part of it that encoders see; a robot that glides on locked wheels shows at the next fix."""
    fault = f'signal = "right_wheel"\ntype = "runaway"\nat_s = {STANDING_S}\nrate_rad_s = {speed_m_s / 0.03}'
    run = watched(fault, HARD, lambda one: one.verdict.severity is Severity.FAULT)
    moved_2_mm_s = STANDING_S + 0.002 / speed_m_s
    first = run.first(STANDING_S, held)
    assert first.t_s - moved_2_mm_s <= 0.5
    assert run.seen[-1].verdict.cause == "the right wheel turns while it is held"
    assert run.mission.wants_full_fans
    assert run.mission.is_faulted
    measured("S7", 1e3 * max(first.t_s - moved_2_mm_s, 0.0))


@pytest.mark.fault("F6")
@pytest.mark.parametrize(
    "fault", ['"soc"\ntype = "stuck"\nvalue = 0.2', '"faults"\ntype = "raise"\nnames = ["battery_low"]']
)
def test_a_low_battery_sends_the_robot_home(fault: str, measured: Measured) -> None:
    run = watched(f"signal = {fault}\nat_s = 3.0", HARD, lambda _: False)
    home = run.first(3.0, lambda one: one.state is MissionState.RETURNING)
    assert home.t_s - 3.0 < 5.5
    assert run.mission.outcome is SurveyOutcome.AT_BASE
    # The stand-in's charge stays what it was, so this is what is left at base, too.
    measured("F6", 100.0 * (0.2 if "soc" in fault else 1.0))


def test_a_battery_that_seems_low_for_a_moment_does_not() -> None:
    run = watched(
        'signal = "soc"\ntype = "stuck"\nat_s = 3.0\nfor_s = 2.0\nvalue = 0.0', HARD, lambda one: one.t_s > 10.0
    )
    assert not any(one.verdict.severity for one in run.since(1.0))


def late(delay_s: float) -> Config:
    cfg = HARD
    world = cfg.world.model_copy(update={"sensors_delay_s": delay_s, "commands_delay_s": delay_s})
    return cfg.model_copy(update={"world": world})


@pytest.mark.fault("L13")
@pytest.mark.parametrize(("delay_s", "severity"), [(0.02, 0), (0.06, Severity.SLOW), (0.12, Severity.PAUSE)])
def test_a_late_link_slows_the_robot_and_then_holds_it(delay_s: float, severity: int, measured: Measured) -> None:
    run = watched("", late(delay_s), lambda one: one.t_s > 4.0)
    worst = max(one.verdict.severity for one in run.since(0.5))
    assert worst >= severity
    assert (worst == 0) == (severity == 0)
    fastest = max(0.015 * abs(sum(one.drive)) for one in run.since(0.8))
    if severity:
        assert fastest <= 0.07
    # What it still drives while nobody knows yet, and while the wheels run down.
    way_mm = 1e3 * fastest * (2.0 * delay_s + HARD.sim.robot.wheel_lag_s)
    assert way_mm <= 20.0
    measured("L13", way_mm)


# -- fans on an overhanging mirror -------------------------------------------------------------------------------------

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
    assert run.seen[-1].state is MissionState.RETURNING
    assert run.robot.fans.duty == (1.0, 1.0)
    margin = 0.91 * OVERHANG.robot.fan_duty[0] / OVERHANG.sim.robot.fan_floor
    measured("F2", margin)


def test_where_nothing_hangs_a_weak_fan_is_only_told() -> None:
    run = watched(f'signal = "faults"\ntype = "raise"\nat_s = {AT_S}\nnames = ["fan_left"]', UPRIGHT, a_little_later)
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


# -- a robot that is not where it takes itself to be -------------------------------------------------------------------

# The first panel lies at a corner. These meet the rim, some more than once; most others find themselves before.
SEEDS = (0, 10, 22, 52, 62, 69)


def carried_off(seed: int) -> FaultySilRun:
    """A survey of the corner panel; somewhere on the way the robot is put elsewhere and turned."""
    rng = random.Random(seed)
    at_s, dx_m, dy_m, turn_rad = (
        rng.uniform(3, 40),
        rng.uniform(-0.1, 0.1),
        rng.uniform(-0.1, 0.1),
        rng.uniform(-0.8, 0.8),
    )
    plan = single(
        f'signal = "body"\ntype = "kidnap"\nat_s = {at_s:.2f}\ndx_m = {dx_m:.3f}\ndy_m = {dy_m:.3f}\n'
        f"dheading_rad = {turn_rad:.3f}\n"
    )
    return FaultySilRun(short_survey(run__filter="ekf", run__seed=seed), plan)


@pytest.mark.fault("S23")
def test_no_retreat_falls_at_a_corner(measured: Measured) -> None:
    edges = 0
    for seed in SEEDS:
        rehearsal = carried_off(seed)
        result = rehearsal.run()
        assert was_real(rehearsal.injected[0])
        danger = result.summary["danger"]
        measured("S23", danger["falls"])
        edges += danger["true_edges"]
        assert result.outcome == "complete" or result.cause  # held, and it is said why
    assert edges >= 4
