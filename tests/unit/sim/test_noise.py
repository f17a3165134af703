"""Random processes of the simulated world against their definitions."""

from math import exp, sqrt

import numpy as np
import pytest

from ccatp.sim.disturbances import WHOLE, DriftingBias, NoiseStream, OrnsteinUhlenbeck

SIGMA, TIME_S, DT_S = 0.3, 2.0, 0.01


def test_one_by_one_is_the_same_stream() -> None:
    whole = NoiseStream(np.random.default_rng(3)).take(5000)
    stream = NoiseStream(np.random.default_rng(3))
    assert [stream.one() for _ in range(4000)] + stream.take(1000) == whole


def test_the_first_value_is_one_of_the_stationary_distribution() -> None:
    firsts = [OrnsteinUhlenbeck(SIGMA, TIME_S, np.random.default_rng(seed)).at(0.0) for seed in range(2000)]
    assert np.std(firsts) == pytest.approx(SIGMA, rel=4.5 / sqrt(2 * 2000))  # 4.5 standard errors
    assert abs(np.mean(firsts)) < 4.5 * SIGMA / sqrt(2000)


def test_sigma_and_autocorrelation() -> None:
    """1600 independent processes at four times: cov(x(0), x(d)) = sigma^2 exp(-d/T)."""
    rows = []
    for seed in range(1600):
        process = OrnsteinUhlenbeck(SIGMA, TIME_S, np.random.default_rng(seed))
        rows.append([process.at(t) for t in (0.0, 0.5, 2.0, 6.0)])
    found = np.corrcoef(np.array(rows).T)[0]
    # A correlation r of n pairs has the standard error (1 - r^2)/sqrt(n); 4.5 of the largest.
    assert found == pytest.approx([1.0, exp(-0.25), exp(-1.0), exp(-3.0)], abs=4.5 / sqrt(1600))
    assert np.array(rows).std(axis=0) == pytest.approx([SIGMA] * 4, rel=4.5 / sqrt(2 * 1600))


def test_small_steps_and_a_large_one_have_the_same_law() -> None:
    ends = []
    for seed in range(1600):
        process = OrnsteinUhlenbeck(SIGMA, TIME_S, np.random.default_rng(seed))
        start = process.at(0.0)
        for k in range(1, 51):
            last = process.at(k * DT_S)
        ends.append((start, last))
    assert np.corrcoef(np.array(ends).T)[0, 1] == pytest.approx(exp(-0.25), abs=4.5 / sqrt(1600))


def test_nothing_moves_without_time_or_without_sigma() -> None:
    process = OrnsteinUhlenbeck(SIGMA, TIME_S, np.random.default_rng(1))
    assert process.at(1.0) == process.at(1.0)
    still = OrnsteinUhlenbeck(0.0, TIME_S, np.random.default_rng(1))
    assert [still.at(float(t)) for t in range(3)] == [0.0, 0.0, 0.0]


def test_a_bias_walks_with_the_root_of_time() -> None:
    ends = [DriftingBias(0.5, 0.02, DT_S, np.random.default_rng(seed)).ahead(900)[-1] for seed in range(400)]
    assert np.std(ends) == pytest.approx(0.02 * 3.0, rel=4.5 / sqrt(2 * 400))  # 9 s
    assert np.mean(ends) == pytest.approx(0.5, abs=4.5 * 0.06 / sqrt(400))
    assert DriftingBias(0.5, 0.0, DT_S, np.random.default_rng(1)).ahead(3).tolist() == [0.5, 0.5, 0.5]


def test_a_bias_walks_on_however_far_it_is_asked_for() -> None:
    whole = DriftingBias(0.5, 0.02, DT_S, np.random.default_rng(1)).ahead(1000).tolist()
    piecewise = DriftingBias(0.5, 0.02, DT_S, np.random.default_rng(1))
    assert whole[0] != 0.5  # it has walked already
    assert [value for count in (1, 99, 900) for value in piecewise.ahead(count).tolist()] == whole


def test_rounding_by_a_large_number_is_that_to_the_nearest_whole_one() -> None:
    numbers = [0.0, 0.49, 0.51, -0.49, -0.51, 1.5e9 + 0.25, -1.5e9 - 0.75, 2.0**50 + 0.25]
    assert [x + WHOLE - WHOLE for x in numbers] == [round(x) for x in numbers]
