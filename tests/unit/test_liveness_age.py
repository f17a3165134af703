"""How old frames are when they are served."""

import pytest

from ccatp.liveness import FrameAge


@pytest.mark.fault("P6")
def test_frames_that_waited_are_old_until_the_queue_is_empty() -> None:
    age = FrameAge()
    assert [age.age_s(0.01 * k, 100.0 + 0.01 * k) for k in range(100)] == pytest.approx([0.0] * 100, abs=1e-9)
    # Stopped for a second: a hundred frames wait, and are read in a burst.
    ages = [age.age_s(0.01 * k, 101.99 + 1e-4 * (k - 100)) for k in range(100, 201)]
    assert ages[0] == pytest.approx(0.99, abs=0.01)
    assert ages == sorted(ages, reverse=True)
    assert ages[-1] < 0.02


def test_a_robot_whose_clock_is_slow_is_not_taken_for_late() -> None:
    age = FrameAge()
    assert max(age.age_s(0.01 * k * (1.0 - 1e-4), 0.01 * k) for k in range(100_000)) < 1e-6


def test_a_clock_that_counts_anew() -> None:
    age = FrameAge()
    age.age_s(500.0, 1000.0)
    assert age.age_s(0.0, 1000.1) > 400.0
    age.restart()
    assert age.age_s(0.01, 1000.11) == 0.0
