"""Pure. The smoother against batch least squares: every state of the record at once, in exact rational arithmetic.

The unknowns are all states; prior, transitions and readings are equations among them. The joint covariance of states
and readings is written from the independent noises and conditioned with fractions: no recursion, no gain, no inverse of
a predicted covariance.
"""

from fractions import Fraction

import numpy as np
import pytest

from ccatp.core import FloatArray
from ccatp.filters import FILTERS, Smoother

Matrix = list[list[Fraction]]
Update = tuple[FloatArray, FloatArray, FloatArray]
Leg = tuple[FloatArray, FloatArray, list[Update]]


def exact(a: FloatArray) -> Matrix:
    return [[Fraction(float(v)) for v in row] for row in np.atleast_2d(a)]


def times(a: Matrix, b: Matrix) -> Matrix:
    columns = list(zip(*b, strict=True))
    return [[sum((x * y for x, y in zip(r, c, strict=True) if x and y), Fraction()) for c in columns] for r in a]


def transposed(a: Matrix) -> Matrix:
    return [list(c) for c in zip(*a, strict=True)]


def solved(a: Matrix, b: Matrix) -> Matrix:
    rows = [[*left, *right] for left, right in zip(a, b, strict=True)]
    n = len(rows)
    for i in range(n):
        pivot = next(k for k in range(i, n) if rows[k][i])
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [v / rows[i][i] for v in rows[i]]
        for k in range(n):
            if k != i and rows[k][i]:
                factor = rows[k][i]
                rows[k] = [v - factor * u for v, u in zip(rows[k], rows[i], strict=True)]
    return [row[n:] for row in rows]


def batch(mean: FloatArray, covariance: FloatArray, legs: list[Leg]) -> tuple[FloatArray, FloatArray]:
    """Means (k, n) and covariances (k, n, n) of all states given all readings; states follow each prediction."""
    n = mean.size
    noises = [covariance, *(Q for _, Q, _ in legs)]
    size = n * len(noises)
    spread = [[Fraction()] * size for _ in range(size)]
    for i, Q in enumerate(noises):
        for r, row in enumerate(exact(Q)):
            spread[n * i + r][n * i : n * (i + 1)] = row
    state = [[Fraction(int(r == c)) for c in range(size)] for r in range(n)]
    mu = transposed(exact(mean))
    states, means, rows, nu, R = list(state), list(mu), [], [], []
    for i, (F, _, updates) in enumerate(legs, 1):
        state = times(exact(F), state)
        for r in range(n):
            state[r][n * i + r] += 1
        mu = times(exact(F), mu)
        states, means = states + state, means + mu
        for z, H, variance in updates:
            rows += times(exact(H), state)
            nu += [[Fraction(float(a)) - b[0]] for a, b in zip(z, times(exact(H), mu), strict=True)]
            R += [Fraction(float(v)) for v in variance]
    prior = times(times(states, spread), transposed(states))
    cross = times(times(states, spread), transposed(rows))
    S = times(times(rows, spread), transposed(rows))
    for i, v in enumerate(R):
        S[i][i] += v
    gain = transposed(solved(S, transposed(cross)))
    x = np.array([float(a[0] + b[0]) for a, b in zip(means, times(gain, nu), strict=True)]).reshape(-1, n)
    less = times(gain, transposed(cross))
    k = len(x)
    P = np.array([[float(a - b) for a, b in zip(p, q, strict=True)] for p, q in zip(prior, less, strict=True)])
    return x, np.array([P[n * i : n * (i + 1), n * i : n * (i + 1)] for i in range(k)])


def legs_of(kind: str, rng: np.random.Generator, n: int = 3) -> tuple[FloatArray, FloatArray, list[Leg]]:
    """A record of seven predictions with none to two updates after each."""
    root = rng.normal(size=(n, n))
    covariance = root @ root.T
    legs: list[Leg] = []
    for i in range(7):
        F = np.eye(n) + 0.3 * rng.normal(size=(n, n))
        Q = np.diag(rng.uniform(0.1, 1.0, n))
        if kind == "noiseless_states":
            F[1:] = np.eye(n)[1:]
            Q[1:, 1:] = 0.0
        elif kind == "impulses":
            Q *= float(i == 3)
        elif kind == "redrawn_state":
            F[2] = 0.0
        updates = [
            (rng.normal(size=m), rng.normal(size=(m, n)), rng.uniform(0.1, 1.0, m))
            for m in rng.integers(1, 5, size=i % 3)
        ]
        legs.append((F, Q, updates))
    if kind == "known_state":
        covariance[1] = covariance[:, 1] = 0.0
        legs = [(np.eye(n), np.diag([0.2, 0.0, 0.1]), updates) for _, _, updates in legs]
    return rng.normal(size=n), covariance, legs


@pytest.mark.parametrize("kind", ["any", "noiseless_states", "impulses", "redrawn_state", "known_state"])
@pytest.mark.parametrize("seed", range(3))
def test_every_state_of_the_record(kind: str, seed: int) -> None:
    mean, covariance, legs = legs_of(kind, np.random.default_rng(seed))
    x, P = batch(mean, covariance, legs)
    for build in FILTERS.values():
        filter_, smoother = build(mean, covariance), Smoother(mean.size)
        for F, Q, updates in legs:
            smoother.predict(filter_, F, Q)
            for z, H, R in updates:
                filter_.update(z, H, R)
        found = smoother.smooth(filter_)
        # 1e-10: seven steps back through predicted covariances with a condition number of up to 1e5.
        np.testing.assert_allclose(found.means, x, atol=1e-10 * np.abs(x).max())
        np.testing.assert_allclose(found.covariances, P, atol=1e-10 * np.abs(P).max())
        for smoothed in found.covariances:
            np.testing.assert_array_equal(smoothed, smoothed.T)
            assert np.linalg.eigvalsh(smoothed)[0] >= -1e-13 * np.abs(P).max()  # rounding


def test_the_batch_on_a_case_done_by_hand() -> None:
    # Two states of a random walk, prior N(0, 1), step of variance 1, second one read as 3 with variance 1: S = 3.
    one = np.ones((1, 1))
    x, P = batch(np.zeros(1), one, [(one, one, [(np.array([3.0]), one, np.ones(1))])])
    assert x.ravel().tolist() == [1.0, 2.0]
    assert P.ravel() == pytest.approx([2.0 / 3.0, 2.0 / 3.0], rel=1e-15)  # the last rounding to float
