"""Glue. The full-state filter in whole missions of every world: whether it knows how wrong it is.

Per world 50 missions of one panel, that is nine stops each; before each fix stands the error of the pose, and the
covariance that the filter gives it. Stops of one mission share constants of the robot, so they are not independent; the
seeds are. So each stop has a sum of its own over the seeds, chi-squared if the filter is right, and the band of each is
such that in 95 % of the campaigns of a consistent filter all nine are within theirs.
"""

from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from ccatp.config.loader import load_config
from ccatp.filters.base import FloatArray
from ccatp.studies.rehearsal import rehearse
from ccatp.studies.rehearsal_result import StopRow

pytestmark = pytest.mark.slow

SEEDS, STOPS = 50, 9
ALPHA = 0.05 / STOPS
ROUGH = pytest.mark.parametrize("world", ["hard", "extreme"])
ALL = pytest.mark.parametrize("world", ["thesis", "thesis-x2", "hard", "extreme"])
POSE, POSITION = 3, 2  # degrees of freedom


@cache
def stops(world: str) -> list[list[StopRow]]:
    """First arrivals of each mission, in their order."""
    found = []
    for seed in range(1, SEEDS + 1):
        overrides = {"run.world": world, "run.filter": "ekf", "run.panels": 1, "run.seed": seed}
        result = rehearse(load_config(overrides=overrides))
        assert result.outcome == "complete", (seed, result.cause)
        found.append([stop for stop in result.stops if stop.approach == 1])
    return found


def nees(world: str, states: int) -> FloatArray:
    """Mean over the seeds, for each stop, shape (9,); of the first ``states`` of x, y, heading."""
    values = np.array(
        [
            [
                np.array(s.error)[:states] @ np.linalg.solve(s.covariance[:states, :states], s.error[:states])
                for s in row
            ]
            for row in stops(world)
        ]
    )
    assert values.shape == (SEEDS, STOPS)
    mean: FloatArray = values.mean(axis=0)
    return mean


def nis(world: str) -> FloatArray:
    """Mean over the seeds of the fixes' normalised innovations, for each stop, shape (9,)."""
    mean: FloatArray = np.nanmean([[s.nis for s in row] for row in stops(world)], axis=0)
    return mean


def band(freedom: int) -> tuple[float, float]:
    """Two-sided, of the mean over the seeds."""
    total = SEEDS * freedom
    return float(chi2.ppf(0.5 * ALPHA, total)) / SEEDS, float(chi2.ppf(1.0 - 0.5 * ALPHA, total)) / SEEDS


@ALL
@pytest.mark.parametrize("states", [POSE, POSITION])
def test_errors_are_not_larger_than_said(world: str, states: int) -> None:
    """Nowhere overconfident."""
    found = nees(world, states)
    print(world, states, np.round(found, 2), band(states))
    assert (found < band(states)[1]).all()


@ROUGH
@pytest.mark.parametrize("states", [POSE, POSITION])
def test_errors_are_not_smaller_than_said(world: str, states: int) -> None:
    """Constants are those of a rough world, and the same for every world: a quiet one does better than it is told."""
    found = nees(world, states)
    print(world, states, np.round(found, 2), band(states))
    assert (found > band(states)[0]).all()


@ALL
def test_fixes_are_not_further_off_than_expected(world: str) -> None:
    found = nis(world)
    print(world, np.round(found, 2), band(POSITION))
    assert (found < band(POSITION)[1]).all()
