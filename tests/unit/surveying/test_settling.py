"""At rest: speeds below the limits, or shaken about a mean of zero."""

from collections.abc import Callable, Iterable
from math import exp

import pytest

from ccatp.config.models import Config
from ccatp.survey.stops import StandstillDetector

DT = 0.01


def first_rest(config: Config, speeds: Iterable[float], rates: Iterable[float]) -> int | None:
    stillness = StandstillDetector(config.control)
    for k, (v, omega) in enumerate(zip(speeds, rates, strict=False)):
        if stillness.is_rest(k * DT, DT, v, omega):
            return k
    return None


def test_at_rest_after_the_settling_time_below_both_limits(config: Config) -> None:
    control = config.control
    speeds = [0.1, 0.02] + [0.9 * control.settle_speed_m_s] * 10
    rates = [0.0, 0.0, 0.0] + [0.9 * control.settle_rate_rad_s] * 10
    assert first_rest(config, speeds, rates) == 2 + round(control.settle_time_s / DT)


@pytest.mark.parametrize("speed", [lambda c: 1.1 * c.settle_speed_m_s, lambda c: -1.1 * c.settle_speed_m_s])
def test_a_robot_that_creeps_never_rests(config: Config, speed: Callable[[object], float]) -> None:
    assert first_rest(config, [speed(config.control)] * 1000, [0.0] * 1000) is None


def test_a_robot_that_goes_on_turning_never_rests(config: Config) -> None:
    assert first_rest(config, [0.0] * 1000, [1.1 * config.control.settle_rate_rad_s] * 1000) is None


def test_fans_that_shake_it_do_not_keep_it_from_resting(config: Config) -> None:
    # A bounded jitter: 0.02 rad/s to and fro, never below the limit and without a mean.
    rates = [0.02 * (-1.0) ** k for k in range(200)]
    rested = first_rest(config, [0.0] * 200, rates)
    assert rested is not None
    assert rested < 50  # half a second


def test_wheels_that_run_down_rest_when_they_are_slow_and_no_earlier(config: Config) -> None:
    speeds = [0.05 * exp(-k * DT / 0.08) for k in range(200)]
    slow = next(k for k, v in enumerate(speeds) if v <= config.control.settle_speed_m_s)
    rested = first_rest(config, speeds, [0.0] * 200)
    assert rested == slow + round(config.control.settle_time_s / DT)
