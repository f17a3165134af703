"""The gate of the inertial unit: which readings are impossible, and when the unit is used again."""

import pytest

from ccatp.core import ImuSample
from ccatp.sensing.imu_gate import ImuGate
from tests.support.scenario import world_of

CFG = world_of("thesis-m1")[0].health
DT = 0.01


class Unit:
    """Readings of the unit, one a frame."""

    def __init__(self) -> None:
        self.gate, self.t_s = ImuGate(CFG), 0.0

    def is_used(self, ax: float, wz: float, yaw_rad_s: float = 0.0, late_s: float = 0.0) -> bool:
        self.t_s += DT
        samples = [ImuSample(self.t_s, ax, wz)]
        used = self.gate.admit(samples, yaw_rad_s, late_s)
        assert list(used) in ([], samples)
        assert bool(used) is (self.gate.cause == "")
        return bool(used)


@pytest.fixture
def unit() -> Unit:
    """It has shown noise at rest."""
    made = Unit()
    for k in range(2 * CFG.identical_samples):
        assert made.is_used(1e-3 * (k % 7), 1e-4 * (k % 11))
    return made


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_rate_that_no_robot_has_is_impossible_even_if_it_is_reached_slowly(unit: Unit, sign: float) -> None:
    rate = 0.0
    while rate + 0.5 * CFG.imu_jump_rad_s < CFG.imu_largest_rad_s:
        rate += 0.5 * CFG.imu_jump_rad_s
        assert unit.is_used(0.01 * rate, sign * rate, yaw_rad_s=0.0)  # a slow drift is for the monitor of the wheels
    assert not unit.is_used(0.0, sign * (CFG.imu_largest_rad_s + 1e-6), yaw_rad_s=sign * CFG.imu_largest_rad_s)
    assert unit.gate.cause == "the gyroscope's rate is impossible"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_jump_away_from_the_rate_of_the_wheels_is_impossible(unit: Unit, sign: float) -> None:
    jump = sign * max(1.01 * CFG.imu_jump_rad_s, 2.0 * CFG.imu_rate_rad_s)
    follows = Unit()
    assert follows.is_used(0.0, 0.0)
    assert follows.is_used(0.1, jump, yaw_rad_s=jump)  # the wheels show it, too
    assert not unit.is_used(0.0, jump)
    assert unit.gate.out_since_s == unit.t_s


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_largest_acceleration_is_possible_and_a_larger_one_is_not(unit: Unit, sign: float) -> None:
    assert unit.is_used(sign * CFG.imu_acceleration_m_s2, 0.0)
    assert not unit.is_used(sign * (CFG.imu_acceleration_m_s2 + 1e-6), 1e-3)
    assert unit.gate.cause == "the acceleration is impossible"


@pytest.mark.parametrize("which", ["ax", "wz", "both"])
def test_a_unit_with_noise_that_repeats_itself_is_not_used(unit: Unit, which: str) -> None:
    """A reading counts as the first of its repetitions."""
    for k in range(CFG.identical_samples):
        is_used = unit.is_used(
            0.5 if which != "wz" else 0.5 + 1e-3 * (k % 5), 0.01 if which != "ax" else 0.01 + 1e-4 * (k % 5)
        )
        assert is_used is (k < CFG.identical_samples - 1)
    assert unit.gate.cause == "the inertial unit repeats itself"
    assert (unit.gate.value, unit.gate.limit) == (CFG.identical_samples, CFG.identical_samples)


def test_a_unit_that_never_showed_noise_may_repeat_itself() -> None:
    unit = Unit()
    assert all(unit.is_used(0.0, 0.0) for _ in range(5 * CFG.identical_samples))


def test_noise_while_the_robot_turns_or_of_one_of_the_two_readings_is_no_noise_at_rest() -> None:
    turns, one = Unit(), Unit()
    for k in range(5 * CFG.identical_samples):
        assert turns.is_used(1e-3 * (k % 7), 0.5 + 1e-4 * (k % 11), yaw_rad_s=0.5)
        assert one.is_used(1e-3 * (k % 7), 0.0)
    assert all(turns.is_used(0.0, 0.0) for _ in range(5 * CFG.identical_samples))


def test_late_samples_are_not_used(unit: Unit) -> None:
    assert unit.is_used(0.011, 1e-3, late_s=CFG.turn_delay_s)
    assert not unit.is_used(0.012, 2e-3, late_s=CFG.turn_delay_s + 1e-6)
    assert unit.gate.cause == "the inertial unit's samples arrive late"


def test_the_unit_is_used_again_after_the_quarantine(unit: Unit) -> None:
    assert not unit.is_used(2.0 * CFG.imu_acceleration_m_s2, 0.0)
    begun_s, k = unit.t_s, 0
    while not unit.is_used(1e-3 * (k % 7), 1e-4 * (k % 11)):
        k += 1
    assert unit.t_s - begun_s == pytest.approx(CFG.imu_quarantine_s, abs=1.5 * DT)
    assert unit.gate.out_since_s == float("inf")
    unit.gate.reset()
    assert unit.gate.cause == ""
