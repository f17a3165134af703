"""Faults of wheels, link and battery: injected, real at the robot, answered in time."""

from collections.abc import Callable
from itertools import pairwise

import pytest

from ccatp.config.models import Config
from ccatp.core import Severity
from ccatp.survey.state import MissionState, SurveyOutcome
from tests.faults.campaign import Seen, short_survey, was_real, watched

Measured = Callable[[str, float], None]

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
    assert was_real(run.injected[0])
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
    assert was_real(run.injected[0])
    assert not run.mission.is_faulted
    assert len(run.mission.done) >= 3


@pytest.mark.fault("F10")
def test_a_robot_that_is_snagged_holds(measured: Measured) -> None:
    fault = "\n\n".join(f'signal = "{side}_wheel"\ntype = "blocked"\nat_s = {DRIVING_S}' for side in ("right", "left"))
    run = watched(fault, HARD, held)
    assert all(map(was_real, run.injected))
    time_s = run.time_to_zero_s(DRIVING_S)
    assert time_s <= 0.3
    measured("F10", 1e3 * time_s)


@pytest.mark.fault("F9")
@pytest.mark.parametrize("rate", [8.0, -8.0])
@pytest.mark.parametrize("at_s", [DRIVING_S, TURNING_S, STANDING_S])
def test_a_wheel_that_runs_away(rate: float, at_s: float, measured: Measured) -> None:
    fault = f'signal = "left_wheel"\ntype = "runaway"\nat_s = {at_s}\nfor_s = 0.4\nrate_rad_s = {rate}'
    run = watched(fault, HARD, lambda one: one.t_s > at_s + 0.3)
    assert was_real(run.injected[0])
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
    assert all(map(was_real, run.injected))
    assert run.time_to_zero_s(DRIVING_S) <= 0.15  # two faults at once: not the 0.1 s of one
    assert run.first(DRIVING_S, held).verdict.signal in {"left_wheel", "encoder_left"}


@pytest.mark.fault("S7")
@pytest.mark.parametrize("speed_m_s", [0.002, 0.005, 0.02])
def test_wheels_that_creep_while_they_are_held(speed_m_s: float, measured: Measured) -> None:
    """The part of it that encoders see; a robot that glides on locked wheels shows at the next fix."""
    fault = f'signal = "right_wheel"\ntype = "runaway"\nat_s = {STANDING_S}\nrate_rad_s = {speed_m_s / 0.03}'
    run = watched(fault, HARD, lambda one: one.verdict.severity is Severity.FAULT)
    assert was_real(run.injected[0])
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
    assert was_real(run.injected[0])
    home = run.first(3.0, lambda one: one.state is MissionState.RETURNING)
    assert home.t_s - 3.0 < 5.5
    assert run.mission.outcome is SurveyOutcome.AT_BASE
    # The stand-in's charge stays what it was, so this is what is left at base, too.
    measured("F6", 100.0 * (0.2 if "soc" in fault else 1.0))


def test_a_battery_that_seems_low_for_a_moment_does_not() -> None:
    run = watched(
        'signal = "soc"\ntype = "stuck"\nat_s = 3.0\nfor_s = 2.0\nvalue = 0.0', HARD, lambda one: one.t_s > 10.0
    )
    assert was_real(run.injected[0])
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
