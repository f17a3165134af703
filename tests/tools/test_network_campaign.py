"""A few networks of the campaign: intervals hold, errors are found, and nothing else is."""

import numpy as np
import pytest
from scipy.special import chdtri

from tools.network_campaign import Kind, Outcome, campaign

# By a binomial distribution, fewer have a chance below 1 in 1,000; the values of a network are hardly independent.
LEAST = {"offset": 0.86, "collimator": 0.89, "scale": 0.80, "drift": 0.80, "panel": 0.91}
NETWORKS = 20


@pytest.fixture(scope="module")
def outcomes() -> list[Outcome]:
    return [one for _, one in campaign(NETWORKS, 11, ("fyst-m1", "thesis-m2"))]


@pytest.mark.parametrize("kind", LEAST)
def test_95_percent_intervals_hold(outcomes: list[Outcome], kind: str) -> None:
    hits, count = np.sum([one.covered[kind] for one in outcomes], axis=0)
    assert count >= NETWORKS
    assert hits / count >= LEAST[kind]


def test_chi_squares_are_those_of_their_degrees_of_freedom(outcomes: list[Outcome]) -> None:
    for name in ("chi2", "panel_chi2"):
        chi2, dof = (sum(getattr(one, what) for one in outcomes) for what in (name, name.replace("chi2", "dof")))
        assert chdtri(dof, 0.999) < chi2 < chdtri(dof, 0.001)


def test_what_is_injected_is_found_and_nothing_else(outcomes: list[Outcome]) -> None:
    assert sum(one.false_findings for one in outcomes) == 0
    assert sum(one.missed for one in outcomes) < 0.3 * sum(one.injected for one in outcomes)
    assert np.median([one.after_m for one in outcomes]) < 0.02 * np.median([one.before_m for one in outcomes])


@pytest.mark.parametrize("kind", [Kind.NOISY_CHANNEL, Kind.OSCILLATING_SCALE])
def test_networks_with_an_error_more_have_panels_within_their_intervals(kind: Kind) -> None:
    ((_, found),) = campaign(1, 12, ("thesis-m2",), kind)
    hits, count = found.covered["panel"]
    assert hits / count >= LEAST["panel"]
    assert found.names_the_kind
    assert found.false_findings == 0
