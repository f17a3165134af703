"""One motion along its profile."""

import pytest

from ccatp.config.models import Config
from ccatp.control.pid import ProfiledAxis

DT, LAG, V_MAX, A_MAX = 0.01, 0.08, 0.1, 0.2


@pytest.fixture
def axis(config: Config) -> ProfiledAxis:
    gains = config.control.gain_sets["shipped"].forward
    return ProfiledAxis(gains, config.control, V_MAX, A_MAX, LAG)


def driven(axis: ProfiledAxis, lag_share: float) -> float:
    """Along the plan by half of 0.2 m, with wheels of which only a share reaches the ground."""
    axis.begin(0.2)
    travelled = speed = output = 0.0
    for _ in range(120):
        output = axis.step(0.2 - travelled, DT, speed)
        speed += (output * lag_share - speed) * DT / LAG
        travelled += speed * DT
    return output


def test_on_its_plan_it_asks_for_the_plan_and_the_servos_lag(axis: ProfiledAxis) -> None:
    axis.begin(0.2)
    # T a on top of the speed, and half a frame of acceleration: (1 - exp(-dt/T))^-1 = T/dt + 1/2 + ...
    assert axis.step(0.2, DT, 0.0) == pytest.approx(A_MAX * (LAG + 0.5 * DT), rel=1e-2)


def test_behind_the_plan_or_slower_than_it_asks_for_more(axis: ProfiledAxis, config: Config) -> None:
    gains = config.control.gain_sets["shipped"].forward
    outputs = []
    for remaining, speed in ((0.2, 0.0), (0.201, 0.0), (0.2, -0.01)):
        axis.begin(0.2)
        outputs.append(axis.step(remaining, DT, speed))
    assert outputs[1] - outputs[0] == pytest.approx(gains.kp * 0.001)
    assert outputs[2] - outputs[0] == pytest.approx(gains.kd * 0.01)


def test_it_learns_the_share_that_is_lost(axis: ProfiledAxis) -> None:
    assert driven(axis, 1.0) == pytest.approx(V_MAX, rel=0.01)
    # Within 1.2 s the body comes nearly up to speed; the rest is feedback.
    assert driven(axis, 0.95) == pytest.approx(V_MAX / 0.95, rel=0.015)


def test_the_end_counts_what_the_wheels_still_run(axis: ProfiledAxis) -> None:
    axis.begin(0.0)
    assert axis.is_over(0.0008, 0.0002, 0.01)  # 10 mm/s for 80 ms
    assert not axis.is_over(0.0, 0.0002, 0.01)
    assert axis.is_over(0.0001, 0.0002, None)


def test_an_end_far_off_is_followed_by_another_motion(axis: ProfiledAxis) -> None:
    axis.begin(0.0)
    axis.renew_if_far(0.001)
    assert axis.duration_s == 0.0
    axis.renew_if_far(-0.02)
    assert axis.duration_s == pytest.approx(2.0 * (0.02 / A_MAX) ** 0.5)
    axis.renew_if_far(0.05)  # not while one is under way
    assert axis.duration_s == pytest.approx(2.0 * (0.02 / A_MAX) ** 0.5)
