"""Mean wheel rates of a frame: of the samples that are possible, each wheel by itself where one is not."""

import pytest

from ccatp.core import WheelSample
from ccatp.sensing.wheel_means import WheelMeans, as_standing, largest_rate_rad_s
from tests.support.scenario import world_of

ROBOT = world_of("thesis-m1")[0].robot
LIMIT = largest_rate_rad_s(ROBOT)


def means_of(*rates: tuple[float | None, float | None]) -> WheelMeans:
    means = WheelMeans(ROBOT)
    means.take([WheelSample(0.01 * k, right, left) for k, (right, left) in enumerate(rates)], 0.01)
    return means


def test_both_wheels_have_the_mean_of_their_samples() -> None:
    means = means_of((1.0, 2.0), (3.0, -2.0))
    assert (means.right_rad_s, means.left_rad_s) == (2.0, 0.0)
    assert means.mean_yaw_rad_s == pytest.approx(2.0 * ROBOT.wheel_radius_m / ROBOT.wheel_base_m)


def test_a_frame_without_samples_has_no_means() -> None:
    means = means_of((1.0, 1.0))
    means.take([], 0.01)
    assert (means.right_rad_s, means.left_rad_s, means.mean_yaw_rad_s) == (None, None, None)


@pytest.mark.parametrize("other", [None, 1.01 * LIMIT, -1.01 * LIMIT, float("inf"), float("nan")])
def test_a_wheel_with_an_impossible_sample_has_the_mean_of_the_others(other: float | None) -> None:
    right, left = means_of((1.0, 5.0), (other, 7.0)), means_of((5.0, 1.0), (7.0, other))
    assert (right.right_rad_s, right.left_rad_s) == (left.left_rad_s, left.right_rad_s) == (1.0, 6.0)
    nothing = means_of((other, 5.0))
    assert (nothing.right_rad_s, nothing.left_rad_s, nothing.mean_yaw_rad_s) == (None, 5.0, None)


def test_the_largest_rates_are_possible() -> None:
    means = means_of((LIMIT, -LIMIT))
    assert (means.right_rad_s, means.left_rad_s) == (LIMIT, -LIMIT)
    assert means.yaw_rad_s > 0.0  # such a mean is smoothed, too


def test_the_smoothed_yaw_rate_follows_the_wheels_and_not_impossible_samples() -> None:
    means = means_of((0.0, 0.0))
    for _ in range(100):
        means.take([WheelSample(0.0, 2.0, 1.0)], 0.01)
    yaw_rad_s = means.yaw_rad_s
    assert yaw_rad_s == pytest.approx(ROBOT.wheel_radius_m / ROBOT.wheel_base_m, rel=1e-6)
    means.take([WheelSample(0.0, None, 1.0)], 0.01)
    assert means.yaw_rad_s == yaw_rad_s


def test_a_held_robot_has_standing_wheels() -> None:
    assert as_standing([WheelSample(0.5, 3.0, None)]) == [WheelSample(0.5, 0.0, 0.0)]
