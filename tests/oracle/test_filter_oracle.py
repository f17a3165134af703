"""Pure. One oracle for every linear filter: batch conditioning of the joint Gaussian in exact rational arithmetic.

The oracle knows nothing of recursion, gains or factorisations. It writes the last state and all measurements as linear
functions of the independent noises, forms their joint covariance, and conditions one on the other with fractions, so
that it has no rounding at all. A filter that later joins ``FILTERS`` is tested by the same lines.
"""

from fractions import Fraction
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.core import FloatArray
from ccatp.filters import FILTERS

Row = list[Fraction]
Matrix = list[Row]

TOLERANCE = 1e-12  # of the state's scale: what "the textbook answer" is asked to mean
EVERY_FILTER = pytest.mark.parametrize("name", sorted(FILTERS))


class Step(NamedTuple):
    """One predict with F, Q and one update with z, H, R (full)."""

    F: FloatArray
    Q: FloatArray
    z: FloatArray
    H: FloatArray
    R: FloatArray


def exact(a: FloatArray) -> Matrix:
    return [[Fraction(float(v)) for v in row] for row in np.atleast_2d(a)]


def times(a: Matrix, b: Matrix) -> Matrix:
    columns = list(zip(*b, strict=True))
    return [[sum((x * y for x, y in zip(row, c, strict=True)), Fraction()) for c in columns] for row in a]


def transposed(a: Matrix) -> Matrix:
    return [list(column) for column in zip(*a, strict=True)]


def solved(a: Matrix, b: Matrix) -> Matrix:
    """a^-1 b by Gauss and Jordan with exact pivots."""
    rows = [[*left, *right] for left, right in zip(a, b, strict=True)]
    n = len(rows)
    for i in range(n):
        pivot = next(k for k in range(i, n) if rows[k][i] != 0)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        head = rows[i][i]
        rows[i] = [v / head for v in rows[i]]
        for k in range(n):
            if k != i and rows[k][i] != 0:
                factor = rows[k][i]
                rows[k] = [v - factor * u for v, u in zip(rows[k], rows[i], strict=True)]
    return [row[n:] for row in rows]


def textbook(mean: FloatArray, covariance: FloatArray, steps: list[Step]) -> tuple[FloatArray, FloatArray]:
    """Mean (n,) and covariance (n, n) of the last state given all measurements: N(mu_x + C S^-1 nu, P - C S^-1 C^T)."""
    blocks = [exact(covariance)]  # covariances of the independent noises
    state = [[Fraction(int(i == j)) for j in range(mean.size)] for i in range(mean.size)]  # x as a map of the noises
    mu = transposed(exact(mean))
    seen: Matrix = []  # measurements as maps of the noises
    left_over: Matrix = []  # z minus its expectation
    for step in steps:
        F = exact(step.F)
        state, mu = times(F, state), times(F, mu)
        state = [row + [Fraction(int(i == j)) for j in range(mean.size)] for i, row in enumerate(state)]
        blocks.append(exact(step.Q))
        if step.z.size:
            H = exact(step.H)
            rows = times(H, state)
            seen += [row + [Fraction(int(i == j)) for j in range(step.z.size)] for i, row in enumerate(rows)]
            left_over += [[Fraction(float(z)) - m[0]] for z, m in zip(step.z, times(H, mu), strict=True)]
            blocks.append(exact(step.R))
            state = [row + [Fraction()] * step.z.size for row in state]
    size = sum(len(b) for b in blocks)
    noise = [[Fraction()] * size for _ in range(size)]
    at = 0
    for block in blocks:
        for i, row in enumerate(block):
            noise[at + i][at : at + len(row)] = row
        at += len(block)
    seen = [row + [Fraction()] * (size - len(row)) for row in seen]
    P = times(times(state, noise), transposed(state))
    if seen:
        C = times(times(state, noise), transposed(seen))
        S = times(times(seen, noise), transposed(seen))
        gain = transposed(solved(S, transposed(C)))
        mu = [[a[0] + b[0]] for a, b in zip(mu, times(gain, left_over), strict=True)]
        less = times(gain, transposed(C))
        P = [[a - b for a, b in zip(r, q, strict=True)] for r, q in zip(P, less, strict=True)]
    return np.array([float(row[0]) for row in mu]), np.array([[float(v) for v in row] for row in P])


def check(
    name: str,
    mean: FloatArray,
    covariance: FloatArray,
    steps: list[Step],
    vector_R: bool,
    tolerance: float = TOLERANCE,
) -> None:
    filter_ = FILTERS[name](mean, covariance)
    scale = np.sqrt(np.diag(covariance))
    for step in steps:
        filter_.predict(step.F, step.Q)
        scale = np.maximum(scale, np.sqrt(np.diag(filter_.covariance)))
        filter_.update(step.z, step.H, np.diag(step.R).copy() if vector_R else step.R)
        scale = np.maximum(scale, np.abs(filter_.mean))
    x, P = textbook(mean, covariance, steps)
    assert np.all(np.abs(filter_.mean - x) <= tolerance * scale)
    assert np.all(np.abs(filter_.covariance - P) <= tolerance * np.outer(scale, scale))


WHEEL_RADIUS_M, WHEEL_BASE_M = 0.03, 0.15
# Thesis eq. 2.12, and a heading as a crossing gives it.
EVERY_ROW = np.array(
    [
        [0.0, 1.0, 0.0, 0.0],
        [1.0 / WHEEL_RADIUS_M, 0.0, 0.0, 0.5 * WHEEL_BASE_M / WHEEL_RADIUS_M],
        [1.0 / WHEEL_RADIUS_M, 0.0, 0.0, -0.5 * WHEEL_BASE_M / WHEEL_RADIUS_M],
        [0.0, 0.0, 0.0, 1.0],
        [0.0, 0.0, 1.0, 0.0],
    ]
)
EVERY_SIGMA = np.array([0.0059, 0.001, 0.001, 0.0087, 0.0003])
MEAN, COVARIANCE = np.array([0.0, 0.0, 0.5, 0.0]), np.diag([1e-8, 1e-6, 1e-4, 1e-8])
steps_taken = st.tuples(
    st.sampled_from([0.01, 0.001, 0.02, 0.0]),  # frames of 100 Hz and around, s
    st.lists(st.integers(0, 4), max_size=6),  # which rows arrived: any subset, any number of each
)


def drive(plan: list[tuple[float, list[int]]], seed: int) -> list[Step]:
    """Steps with readings that a robot drawn from the prior would give, up to some ten sigmas off.

    Readings that contradict each other by thousands of sigmas make the problem itself ill-conditioned: a relative
    change of 1e-16 of the prior then moves the exact answer by more than 1e-12.
    """
    rng = np.random.default_rng(seed)
    x = MEAN + np.sqrt(np.diag(COVARIANCE)) * rng.normal(size=4)
    steps = []
    for dt, rows in plan:
        F = np.eye(4)
        F[0, 1] = F[2, 3] = dt
        impulse = np.array([0.0, 1.0, 0.0, 2.0]) * np.sqrt(dt)
        Q = F @ np.diag(impulse**2) @ F.T
        x = F @ (x + impulse * rng.normal(size=4))
        index = np.array(rows, dtype=np.intp)
        H, sigma = EVERY_ROW[index], EVERY_SIGMA[index]
        z = H @ x + 3.0 * sigma * rng.normal(size=len(rows))
        steps.append(Step(F, Q, z, H, np.eye(len(rows)) * sigma**2))
    return steps


@EVERY_FILTER
@settings(max_examples=30, deadline=None)
@given(plan=st.lists(steps_taken, min_size=1, max_size=3), seed=st.integers(0, 2**32 - 1), vector_R=st.booleans())
def test_any_subset_of_the_robots_measurements(
    name: str, plan: list[tuple[float, list[int]]], seed: int, vector_R: bool
) -> None:
    # A wheel knows the speed's variance several thousand times better than the prediction, with which the acceleration
    # is correlated (0.99): a filter that carries a covariance, not its root, loses those digits in P - K S K^T. The
    # worst of 10,000 searched plans lost to 8e-12.
    check(name, MEAN, COVARIANCE, drive(plan, seed), vector_R, tolerance=1e-10)


@EVERY_FILTER
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 5), sizes=st.lists(st.integers(0, 6), min_size=1, max_size=2))
def test_any_linear_gaussian_system_with_correlated_noise(name: str, seed: int, n: int, sizes: list[int]) -> None:
    rng = np.random.default_rng(seed)

    def covariance(k: int) -> FloatArray:
        root = rng.normal(size=(k, k))
        product: FloatArray = root @ root.T + 0.1 * np.eye(k)
        return product

    steps = [
        Step(rng.normal(size=(n, n)), covariance(n), rng.normal(size=m), rng.normal(size=(m, n)), covariance(m))
        for m in sizes
    ]
    check(name, rng.normal(size=n), covariance(n), steps, vector_R=False)


@EVERY_FILTER
def test_a_prior_far_wider_than_the_measurement_costs_no_digits(name: str) -> None:
    rows = [1, 2, 1, 2, 3, 0]
    step = Step(np.eye(4), np.zeros((4, 4)), np.arange(6.0) * 0.1, EVERY_ROW[rows], np.diag(EVERY_SIGMA[rows] ** 2))
    check(name, np.zeros(4), np.diag([1e4, 1e2, 1e4, 1e4]), [step], vector_R=True)


@EVERY_FILTER
@pytest.mark.parametrize("count", [13, 18])
def test_many_samples_in_one_step(name: str, count: int) -> None:
    """More rows than are taken one by one: two steps at the thesis's noise, samples of both wheels and both rates."""
    plan = [(0.01, [1, 2] * (count // 2) + [0, 3] + [1] * (count % 2)), (0.01, [2, 3] * (count // 2) + [0])]
    check(name, MEAN, COVARIANCE, drive(plan, count), vector_R=True)


@EVERY_FILTER
@pytest.mark.parametrize("ratio", [1e4, 1e6, 1e8, 1e12])
@pytest.mark.parametrize("rows", [[1], [3], [1, 2], [1, 2, 0, 3]])
def test_one_step_at_any_ratio_of_prior_to_noise(name: str, ratio: float, rows: list[int]) -> None:
    H = EVERY_ROW[rows]
    prior = np.diag([1.0, 2.0, 3.0, 4.0]) + 0.5
    R = (H @ prior @ H.T).diagonal() / ratio
    z = H @ np.array([0.3, -0.2, 0.1, 0.4]) + np.sqrt(R) * np.array([0.5, -1.0, 1.5, -0.3])[: len(rows)]
    step = Step(np.eye(4), np.zeros((4, 4)), z, H, np.diag(R))
    # Row after row, a zero in a row stays one. In the factorisation of all of them, whitened, it becomes 1e-16 of the
    # largest entry, which is the root of the ratio: that much the states that no row measures are taken along.
    tolerance = TOLERANCE if name == "kf" else max(TOLERANCE, 1e-16 * np.sqrt(ratio))
    check(name, np.zeros(4), prior, [step], vector_R=True, tolerance=tolerance)


def test_the_oracle_on_a_case_done_by_hand() -> None:
    # Prior N(1, 4), one reading 3 of variance 4: weights one half each.
    one = np.array([[1.0]])
    x, P = textbook(np.array([1.0]), 4.0 * one, [Step(one, 0.0 * one, np.array([3.0]), one, 4.0 * one)])
    assert (x[0], P[0, 0]) == (2.0, 2.0)
