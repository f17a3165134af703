"""When a point is approached again, and that what is left of it is so in truth."""

import numpy as np
import pytest

from ccatp.core import PointId
from ccatp.survey.state import ApproachCounter

HERE, THERE = PointId(1, 2, 3), PointId(1, 2, 4)


def test_a_point_is_approached_again_where_it_may_be_further_off_than_allowed() -> None:
    approaches = ApproachCounter(3e-3, 3)
    assert not approaches.is_too_far(HERE, 2.98e-3, 5e-6)
    assert approaches.is_too_far(THERE, 2.99e-3, 5e-6)  # 3 sigma are 15 um
    assert not approaches.is_too_far(HERE, 2.99e-3, 0.0)


def test_a_laser_system_of_little_precision_takes_a_tenth_of_the_tolerance_at_most() -> None:
    approaches = ApproachCounter(3e-3, 3)
    for sigma_m in (1e-3, float("inf")):
        assert not approaches.is_too_far(HERE, 2.69e-3, sigma_m)
        assert approaches.is_too_far(THERE, 2.71e-3, sigma_m)


def test_the_last_approach_counts_wherever_it_ends_and_each_point_has_its_own() -> None:
    approaches = ApproachCounter(3e-3, 3)
    assert [approaches.is_too_far(HERE, 5e-3, 0.0) for _ in range(3)] == [True, True, False]
    assert approaches.count == 3
    assert approaches.is_too_far(THERE, 5e-3, 0.0)
    assert approaches.count == 1


@pytest.mark.parametrize("sigma_m", [2e-6, 2e-5])
def test_what_counts_as_near_enough_is_so_in_truth(sigma_m: float) -> None:
    # Distances that end just inside and just outside; what lets a puck pass that is outside needs an error of 3 sigma.
    rng = np.random.default_rng(1)
    true_m = 3e-3 + rng.uniform(-2e-4, 2e-4, 20_000)
    measured_m = true_m + sigma_m * rng.standard_normal(true_m.size)
    passed = np.array(
        [not ApproachCounter(3e-3, 3).is_too_far(HERE, error_m, sigma_m) for error_m in measured_m.tolist()]
    )
    assert 0.2 < passed.mean() < 0.5
    assert (true_m[passed] > 3e-3).sum() <= 1e-4 * passed.sum()
    assert true_m[passed].max() < 3e-3 + sigma_m
