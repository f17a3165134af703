"""Pure. What the legs teach about slip and creep: the mean, how much legs differ, and what the next one is given."""

from math import sqrt
from typing import NamedTuple

import numpy as np
import pytest

from ccatp.config.models import FullStateConfig
from ccatp.core import FloatArray
from ccatp.estimation.slip_prior import SlipPopulation, SlipPrior
from ccatp.estimation.state_model import SL, SR, STATES, C

DRAWN = [SR, SL, C]
STEP = 2.0**0.5  # from one candidate for the scatter to the next


def population() -> SlipPopulation:
    return SlipPopulation([(0.015, 0.015)], 0.02)


def taught(scatter: float, legs: int, seed: int, sigma: float = 5e-4, mean: float = 0.03) -> SlipPopulation:
    """After legs whose parameter is drawn from N(mean, scatter^2) and measured with ``sigma``."""
    rng, found = np.random.default_rng(seed), population()
    for _ in range(legs):
        found.learn([(mean + scatter * float(rng.normal()) + sigma * float(rng.normal()), sigma**2)])
    return found


def test_before_the_first_leg_it_is_what_was_expected() -> None:
    found = population()
    assert found.means[0] == pytest.approx(0.015, rel=1e-12)
    assert found.mean_variances[0] == pytest.approx(0.015**2, rel=1e-12)
    assert 0.001 < sqrt(found.scatter) < 0.008  # log-uniform: the largest candidates carry it


def test_legs_that_all_slip_alike_shrink_the_scatter() -> None:
    scatters = [sqrt(taught(0.0, legs, 1).scatter) for legs in (0, 3, 10, 40)]
    assert scatters == sorted(scatters, reverse=True)
    assert scatters[-1] < 5e-4 / 2.0  # less than what a single leg can show
    found = taught(0.0, 40, 1)
    assert found.means[0] == pytest.approx(0.03, abs=4.0 * 5e-4 / sqrt(40))
    assert sqrt(found.mean_variances[0]) < 2.0 * 5e-4 / sqrt(40)


@pytest.mark.parametrize("scatter", [0.002, 0.005, 0.012])
def test_legs_that_differ_show_by_how_much(scatter: float) -> None:
    found = [taught(scatter, 60, seed) for seed in range(20)]
    learned = np.array([sqrt(f.scatter) for f in found])
    # Sixty samples give a standard deviation within 1/sqrt(120) = 9 %; the prior pulls by half of that.
    assert learned.mean() == pytest.approx(scatter, rel=0.08)
    assert learned.std() < 0.15 * scatter
    off = np.array([(f.means[0] - 0.03) / sqrt(f.mean_variances[0]) for f in found])
    assert float((off**2).mean()) == pytest.approx(1.0, abs=4.0 * sqrt(2.0 / 20))


def test_a_scatter_beyond_the_largest_is_not_thought_of() -> None:
    assert sqrt(taught(0.1, 60, 1).scatter) <= 0.02


def test_a_world_that_changes_is_noticed() -> None:
    found, rng = taught(0.0, 60, 1), np.random.default_rng(2)
    for _ in range(40):
        found.learn([(0.03 + 0.008 * float(rng.normal()), 25e-8)])
    assert sqrt(found.scatter) > 0.004


def test_a_world_that_calms_down_is_noticed_too() -> None:
    found = taught(0.012, 300, 1)
    for _ in range(300):
        found.learn([(0.03, 25e-8)])
    # Of the last 100 legs, which are remembered, 5 are of the time before: sqrt(0.05) 0.012 = 2.7e-3.
    assert sqrt(found.scatter) < 0.004


def test_a_leg_that_shows_nothing_teaches_nothing() -> None:
    found = population()
    before = found.means[0], found.scatter
    found.learn([(0.5, 1e6)])
    assert (found.means[0], found.scatter) == pytest.approx(before, rel=1e-5)


# -- the book ---------------------------------------------------------------------------------------------------------

TO_PARAMETERS = np.array([[0.5, 0.5, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 1.0]])


def state(mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A filter's state that holds this of (right slip, left slip, creep)."""
    x, P = np.zeros(STATES), np.eye(STATES)
    x[DRAWN], P[np.ix_(DRAWN, DRAWN)] = mean, covariance
    return x, P


def test_the_first_leg_is_what_was_expected(full: FullStateConfig) -> None:
    book = SlipPrior(full)
    mean, P = book.first()
    assert mean == pytest.approx([full.slip_mean, full.slip_mean, 0.0], abs=1e-15)
    means = TO_PARAMETERS.dot(P).dot(TO_PARAMETERS.T)
    slip, creep = book.scatter
    expected = (
        full.slip_sigma**2 + slip**2,
        full.slip_difference_sigma**2 + 4.0 * slip**2,  # of a difference against that of a mean
        full.creep_sigma**2 * (1.0 + full.creep_scatter_share**2),
    )
    np.testing.assert_allclose(means, np.diag(expected), rtol=1e-12, atol=1e-18)
    assert creep == pytest.approx(full.creep_scatter_share * full.creep_sigma)


class Told(NamedTuple):
    """A parameter of the next leg, given what was seen of the legs before: by Bayes, without a recursion."""

    mean: float
    variance: float
    correlation: float  # covariance of the next leg's parameter with that of the last


def by_bayes(mean: float, sigma: float, scatter: float, seen: list[float], noise: float) -> Told:
    """(m, s_1 ... s_k) with s_i = m + d_i; each but the last is measured as ``seen`` with the variance ``noise``."""
    k = len(seen)
    T = np.eye(k + 2)
    T[1:, 0] = 1.0
    P = T @ np.diag([sigma**2] + [scatter] * (k + 1)) @ T.T
    H = np.eye(k + 2)[1:-1]
    K = np.linalg.solve(H @ P @ H.T + noise * np.eye(k), H @ P).T
    x = mean + K @ (np.array(seen) - mean)
    P = P - K @ H @ P
    return Told(float(x[-1]), float(P[-1, -1]), float(P[-1, -2]))


def update(x: FloatArray, P: FloatArray, row: FloatArray, z: float, noise: float) -> tuple[FloatArray, FloatArray]:
    K = P @ row / (row @ P @ row + noise)
    return x + K * (z - row @ x), P - np.outer(K, row @ P)


def test_the_next_leg_is_given_what_bayes_gives_it(full: FullStateConfig) -> None:
    """Over four legs; creep, which scatters by a share of itself, only while that has not been learned."""
    book = SlipPrior(full)
    x, P = state(*book.first())
    scatters = [value**2 for value in (book.scatter[0], 2.0 * book.scatter[0], book.scatter[1])]
    priors = ((full.slip_mean, full.slip_sigma), (0.0, full.slip_difference_sigma), (0.0, full.creep_sigma))
    seen: list[list[float]] = [[], [], []]
    noises = (1e-6, 4e-6, 9e-6)
    for leg, values in enumerate([(0.031, -0.004, 0.012), (0.022, 0.003, 0.02), (0.04, 0.0, 0.01), (0.03, 0.01, 0.0)]):
        for k, (z, noise) in enumerate(zip(values, noises, strict=True)):
            row = np.zeros(STATES)
            row[DRAWN] = TO_PARAMETERS[k]
            x, P = update(x, P, row, z, noise)
            seen[k].append(z)
        redraw = book.begin(x, P)  # no fix has ended the leg: the scatter of the slip is as before
        posterior = P[np.ix_(DRAWN, DRAWN)]
        mean = redraw.mean + redraw.F @ (x[DRAWN] - redraw.found)
        covariance = redraw.F @ posterior @ redraw.F.T + redraw.Q
        found = TO_PARAMETERS @ covariance @ TO_PARAMETERS.T
        across = TO_PARAMETERS @ redraw.F @ posterior @ TO_PARAMETERS.T  # of the next leg's with the last one's
        for k in range(3 if leg == 0 else 2):
            told = by_bayes(*priors[k], scatters[k], seen[k], noises[k])
            assert TO_PARAMETERS[k] @ mean == pytest.approx(told.mean, rel=1e-9)  # rounding
            assert across[k, k] == pytest.approx(told.correlation, rel=1e-9)
            assert found[k, k] == pytest.approx(told.variance, rel=1e-9)
        x[DRAWN], P[np.ix_(DRAWN, DRAWN)] = mean, covariance


def test_a_leg_is_learned_from_without_what_was_expected_of_it(
    full: FullStateConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[list[tuple[float, float]], float]] = []
    monkeypatch.setattr(SlipPopulation, "learn", lambda _, samples, share: told.append((samples, share)))
    book = SlipPrior(full)
    x, P = state(*book.first())
    for slip, z in ((SR, 0.05), (SL, 0.03)):
        x, P = update(x, P, np.eye(STATES)[slip], z, 4e-4)  # as much as the prior: the posterior is half of each
    book.end(x, P)
    (mean, half), share = told[0]
    assert mean == pytest.approx((0.04, 2e-4), rel=1e-9)  # of a mean of two
    assert half == pytest.approx((0.01, 2e-4), rel=1e-9)  # of half their difference
    assert share == 1.0


def test_what_wandered_within_a_leg_is_no_knowledge_lost(
    full: FullStateConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The leg's own variance is that of its measurements; the wander counts with the scatter of which it is a share."""
    told: list[tuple[list[tuple[float, float]], float]] = []
    monkeypatch.setattr(SlipPopulation, "learn", lambda _, samples, share: told.append((samples, share)))
    book = SlipPrior(full)
    x, P = state(*book.first())
    slip, creep = book.wander(2.0)
    P[[SR, SL, C], [SR, SL, C]] += slip, slip, creep
    for wheel, z in ((SR, 0.05), (SL, 0.03)):
        x, P = update(x, P, np.eye(STATES)[wheel], z, 4e-4)
    book.end(x, P)
    (mean, half), share = told[0]
    assert mean == pytest.approx((0.04, 2e-4), rel=1e-9)
    assert half == pytest.approx((0.01, 2e-4), rel=1e-9)
    assert share == pytest.approx(1.0 + full.wander_fraction**2 / full.wander_time_s * 2.0)


def test_the_deviation_from_what_was_expected_passes_through(full: FullStateConfig) -> None:
    """The redraw is affine in the state: the mean that it leaves is the book's whatever state it was made for."""
    book = SlipPrior(full)
    x, P = state(*book.first())
    redraw = book.begin(x + 0.01, P)
    assert redraw.found == pytest.approx(x[DRAWN] + 0.01)
    assert np.abs(redraw.Q - redraw.Q.T).max() < 1e-18
    assert np.linalg.eigvalsh(redraw.Q)[0] > 0.0


def drive(book: SlipPrior, slips: list[tuple[float, float]], noise: float) -> None:
    """Legs of these slips (right, left), each seen with the variance ``noise`` and ended by a fix."""
    rng = np.random.default_rng(3)
    x, P = state(*book.first())
    for k, (right, left) in enumerate(slips):
        if k:
            redraw = book.begin(x, P)
            F, Q = np.eye(STATES), np.zeros((STATES, STATES))
            F[np.ix_(DRAWN, DRAWN)], Q[np.ix_(DRAWN, DRAWN)] = redraw.F, redraw.Q
            x[DRAWN] = redraw.mean + redraw.F @ (x[DRAWN] - redraw.found)
            P = F @ P @ F.T + Q
        for state_, slip in ((SR, right), (SL, left)):
            x, P = update(x, P, np.eye(STATES)[state_], slip + sqrt(noise) * float(rng.normal()), noise)
        book.end(x, P)


def test_a_floor_on_which_all_legs_slip_alike(full: FullStateConfig) -> None:
    book = SlipPrior(full)
    before = book.scatter[0]
    drive(book, [(0.04, 0.03)] * 30, 1e-7)
    assert book.scatter[0] < 0.1 * before


@pytest.mark.parametrize("half_width", [0.01, 0.02])
def test_a_floor_on_which_every_leg_slips_differently(full: FullStateConfig, half_width: float) -> None:
    book, rng = SlipPrior(full), np.random.default_rng(4)
    drive(book, [tuple(rng.uniform(0.03 - half_width, 0.03 + half_width, 2).tolist()) for _ in range(150)], 1e-7)
    # A uniform distribution's sigma is its half width over sqrt(3), the mean of two wheels has 1/sqrt(2) of that. Of
    # the last 100 legs, which are remembered, 7 %.
    assert book.scatter[0] == pytest.approx(half_width / sqrt(6.0), rel=0.2)


def test_wheels_that_slip_unlike_each_other_tell_how_much_legs_differ(full: FullStateConfig) -> None:
    """The mean of the two is the same in every leg, their difference is not."""
    book, rng = SlipPrior(full), np.random.default_rng(5)
    halves = (0.01 / sqrt(2.0) * rng.normal(size=150)).tolist()
    drive(book, [(0.03 + half, 0.03 - half) for half in halves], 1e-7)
    # Half of the samples scatter by 0.01/sqrt(2), half by nothing.
    assert book.scatter[0] == pytest.approx(0.005, rel=0.2)


def test_only_a_leg_that_was_ended_by_a_fix_teaches_its_scatter(full: FullStateConfig) -> None:
    for is_told, is_learned in ((True, False), (False, True)):
        book = SlipPrior(full)
        before = book._slip_scatter.scatter
        x, P = state(*book.first())
        x, P = update(x, P, np.eye(STATES)[SR], 0.05, 1e-8)
        if is_told:
            book.forget_leg()
        book.end(x, P)
        assert (book._slip_scatter.scatter != before) is is_learned
        once = book._slip_scatter.scatter
        book.end(x, P)  # a second fix of the same leg
        assert book._slip_scatter.scatter == once


def test_a_leg_that_showed_nothing_new_does_not_count(full: FullStateConfig) -> None:
    book = SlipPrior(full)
    before = book._slip_scatter.scatter
    book.end(*state(*book.first()))
    assert book._slip_scatter.scatter == before


def test_slip_and_creep_wander_within_a_leg(full: FullStateConfig) -> None:
    book = SlipPrior(full)
    slip, creep = book.wander(0.5)
    share = full.wander_fraction**2 / full.wander_time_s * 0.5
    assert slip == pytest.approx(2.0 * share * book.scatter[0] ** 2)  # of a wheel: twice that of a mean of two
    assert creep == pytest.approx(share * book.scatter[1] ** 2)


def test_what_it_expects_of_the_next_leg_is_what_the_next_leg_shows() -> None:
    """Standardised by the book, a leg's parameter has unit variance over worlds drawn from the book's own prior.

    World by world, because those that are rare weigh most; what the next leg draws is taken by its expectation.
    """
    rng, prior = np.random.default_rng(1), population()
    weights = np.exp(prior._prior)
    weights /= weights.sum()
    expected = variance = 0.0
    for sigma, weight in zip(prior._sigmas, weights.tolist(), strict=True):
        squares = []
        for _ in range(1500 if sigma > 1e-3 else 200):
            book, mean = population(), 0.015 + 0.015 * float(rng.normal())
            for _ in range(3):
                book.learn([(mean + sigma * float(rng.normal()) + 5e-4 * float(rng.normal()), 25e-8)])
            squares.append((sigma * sigma + (mean - book.means[0]) ** 2) / (book.scatter + book.mean_variances[0]))
        expected += weight * float(np.mean(squares))
        variance += weight * weight * float(np.var(squares)) / len(squares)
    assert 4.0 * sqrt(variance) < 0.25
    assert expected == pytest.approx(1.0, abs=4.0 * sqrt(variance))
