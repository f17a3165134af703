"""Wheels that turn though they were told to stand, and those that run down after a stall of the link."""

import pytest

from ccatp.config.loader import load_config
from ccatp.health.look import Moved
from ccatp.health.wheels import WheelMonitor

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
        now = Moved(t_s, ROLLS_M_S * t_s, 0.0, 0.0)
        lately = Moved(over_s, ROLLS_M_S * over_s, 0.0, 0.0)
        monitor.step(now, None, lately, is_free=True, is_late=t_s <= late_until_s, is_sparse=False, samples=())
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
