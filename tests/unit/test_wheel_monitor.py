"""Wheels that turn though they were told to stand, and those that run down after a stall of the link."""

import pytest

from ccatp.config.load import load_config
from ccatp.control.motion_checks import MotionSum
from ccatp.safety.wheel_monitors import WheelMonitor

FRAME_S = 0.01
ROLLS_M_S = 0.0054  # just above what a standing wheel may show


def first_found_s(late_until_s: float) -> float | None:
    """When a wheel that rolls, told to stand from the beginning, is found; the link stalls until then."""
    cfg = load_config()
    monitor = WheelMonitor(cfg.health, cfg.robot)
    over_s = cfg.health.stall_time_s
    for k in range(1, 200):
        t_s = k * FRAME_S
        monitor.commands.push(t_s, (0.0, 0.0, 0.0, 0.0))
        monitor.learn(t_s)
        now = MotionSum(t_s, ROLLS_M_S * t_s, 0.0, 0.0)
        lately = MotionSum(over_s, ROLLS_M_S * over_s, 0.0, 0.0)
        monitor.step(
            now, None, lately, is_free=True, is_held=False, is_late=t_s <= late_until_s, is_sparse=False, samples=()
        )
        if monitor.alarm.finding is not None:
            return t_s
    return None


def test_a_wheel_that_rolls_on_is_found() -> None:
    found_s = first_found_s(0.0)
    assert found_s is not None
    assert found_s < 0.5


@pytest.mark.parametrize("stalled_s", [0.4, 0.9])
def test_after_a_stall_of_the_link_a_wheel_has_time_to_run_down(stalled_s: float) -> None:
    found_s = first_found_s(stalled_s)
    assert found_s is not None
    assert stalled_s + 0.55 < found_s < stalled_s + 0.7


@pytest.mark.parametrize(("is_held", "expected_s"), [(True, 1.4), (False, None)])
def test_where_main_is_silent_only_a_robot_that_holds_its_wheels_shall_stand(
    is_held: bool, expected_s: float | None
) -> None:
    """A robot that is permitted one direction of motion, as after an edge, may well be told to go there."""
    cfg = load_config()
    monitor = WheelMonitor(cfg.health, cfg.robot)
    over_s = cfg.health.stall_time_s
    stands, rolls = MotionSum(over_s, 0.0, 0.0, 0.0), MotionSum(over_s, ROLLS_M_S * over_s, 0.0, 0.0)
    rolled_m = 0.0
    for k in range(1, 300):
        t_s = k * FRAME_S
        is_silent = t_s > 1.0
        if not is_silent:
            monitor.commands.push(t_s, (0.0, 0.0, 0.0, 0.0))
            monitor.learn(t_s)
        is_rolling = t_s > 1.11
        rolled_m += ROLLS_M_S * FRAME_S * is_rolling
        monitor.step(
            MotionSum(t_s, rolled_m, 0.0, 0.0),
            None,
            rolls if is_rolling else stands,
            is_free=not is_silent,
            is_held=is_held and is_silent,
            is_late=False,
            is_sparse=False,
            samples=(),
        )
        if monitor.alarm.finding is not None:
            break
    found_s = t_s if monitor.alarm.finding is not None else None
    assert found_s == (None if expected_s is None else pytest.approx(expected_s, abs=0.05))
