"""A few pairs of the campaign: intervals hold, nothing is accused falsely, and what was not made is found."""

import numpy as np
import pytest

from tools.compare_campaign import Deed, Outcome, campaign


@pytest.fixture(scope="module")
def outcomes() -> list[Outcome]:
    return [*campaign(8, 0, "fyst-m1", panels=16)]


def test_95_percent_intervals_of_moves_hold(outcomes: list[Outcome]) -> None:
    hits, count = np.sum([(one.covered, one.intervals) for one in outcomes], axis=0)
    # Of some 370 independent values, three of each plane; four sigmas of a binomial distribution.
    assert count > 600
    assert hits / count > 0.905


def test_no_panel_is_accused_falsely_and_the_motion_of_the_mirror_is_found(outcomes: list[Outcome]) -> None:
    assert sum(one.right for one in outcomes) > 100
    assert sum(one.accused for one in outcomes) == 0
    assert all(one.has_motion for one in outcomes)


def test_most_of_what_was_not_made_is_found(outcomes: list[Outcome]) -> None:
    total = sum(sum(one.total.values()) - one.total[Deed.PLANNED] for one in outcomes)
    assert total > 10
    # Adjusters with nearly the same moves may be exchanged without a trace.
    assert sum(sum(one.found.values()) for one in outcomes) >= 0.8 * total
