"""Every filter against the textbook in fifty digits: any subset of measurements, any ratio of prior to noise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.beacons.filters.ekf_slam import BlockError, EkfSlam, columns_of
from ccatp.config.load import load_config
from ccatp.core import FloatArray
from ccatp.estimation.state_model import Affine
from ccatp.filters import FILTERS
from ccatp.filters.base import FilterDiverged, FilterShapeError
from ccatp.studies.bench_cases import survey_problem
from ccatp.studies.smoother import Smoother
from tests.oracle.exact_filter import ExactFilter

Step = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""F, Q, z, H and R (full) of a prediction and an update."""

TOLERANCE = 1e-12  # of the state's scale: what "the textbook answer" is asked to mean
EVERY_FILTER = pytest.mark.parametrize("name", sorted(FILTERS))


def check(
    name: str,
    mean: FloatArray,
    covariance: FloatArray,
    steps: list[Step],
    *,
    vector_R: bool,
    tolerance: float = TOLERANCE,
) -> None:
    """Errors in units of the largest sigma or value that a state has had."""
    filter_, exact = FILTERS[name](mean, covariance), ExactFilter(mean, covariance)
    scale = np.sqrt(np.diag(covariance))
    for F, Q, z, H, R in steps:
        filter_.predict(F, Q)
        exact.predict(F, Q)
        scale = np.maximum(scale, np.sqrt(np.diag(filter_.covariance)))
        nis = filter_.update(z, H, np.diag(R).copy() if vector_R else R).nis
        assert nis == pytest.approx(exact.update(z, H, R), rel=1e-6, abs=1e-9)  # of the residuals' sigmas
        scale = np.maximum(scale, np.abs(filter_.mean))
        np.testing.assert_array_equal(filter_.covariance, filter_.covariance.T)
    assert np.all(np.abs(filter_.mean - exact.mean) <= tolerance * scale)
    assert np.all(np.abs(filter_.covariance - exact.covariance) <= tolerance * np.outer(scale, scale))


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
        steps.append((F, Q, z, H, np.eye(len(rows)) * sigma**2))
    return steps


@EVERY_FILTER
@settings(max_examples=30, deadline=None)
@given(plan=st.lists(steps_taken, min_size=1, max_size=3), seed=st.integers(0, 2**32 - 1), vector_R=st.booleans())
def test_any_subset_of_the_robots_measurements(
    name: str, plan: list[tuple[float, list[int]]], seed: int, vector_R: bool
) -> None:
    # The worst of 5,000 searched plans lost 5e-13; steps rounded only between two calls lose 2e-13.
    check(name, MEAN, COVARIANCE, drive(plan, seed), vector_R=vector_R)


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
        (rng.normal(size=(n, n)), covariance(n), rng.normal(size=m), rng.normal(size=(m, n)), covariance(m))
        for m in sizes
    ]
    check(name, rng.normal(size=n), covariance(n), steps, vector_R=False)


@EVERY_FILTER
@pytest.mark.parametrize("m", [1, 6, 19, 23, 40])
def test_nineteen_states(name: str, m: int) -> None:
    rng = np.random.default_rng(m)
    root = rng.normal(size=(19, 19))
    sigma = 10.0 ** rng.uniform(-3.0, 1.0, 19)
    prior = (root @ root.T + np.eye(19)) * np.outer(sigma, sigma)
    F = np.eye(19) + 0.05 * rng.normal(size=(19, 19)) * np.outer(sigma, 1.0 / sigma)
    H = rng.normal(size=(m, 19)) / sigma
    R = np.diag(rng.uniform(0.1, 10.0, m))
    steps = [(F, np.diag(0.01 * sigma**2), rng.normal(size=m), H, R) for _ in range(2)]
    check(name, sigma * rng.normal(size=19), prior, steps, vector_R=True)


@EVERY_FILTER
@pytest.mark.parametrize("count", [13, 18, 30, 40])
def test_many_samples_in_one_step(name: str, count: int) -> None:
    """Two steps at the thesis's noise, samples of both wheels and both rates."""
    plan = [(0.01, [1, 2] * (count // 2) + [0, 3] + [1] * (count % 2)), (0.01, [2, 3] * (count // 2) + [0])]
    check(name, MEAN, COVARIANCE, drive(plan, count), vector_R=True)


@EVERY_FILTER
def test_a_lost_pose(name: str) -> None:
    """Sigmas of 100 in every state, then all measurements twice: up to 4e13 times the variance of the noise."""
    rows = [1, 2, 1, 2, 3, 0, 4]
    step = (np.eye(4), np.zeros((4, 4)), np.arange(7.0) * 0.1, EVERY_ROW[rows], np.diag(EVERY_SIGMA[rows] ** 2))
    check(name, np.zeros(4), np.diag([1e4, 1e2, 1e4, 1e4]), [step], vector_R=True)


RATIOS = pytest.mark.parametrize("ratio", [1.0, 1e2, 1e4, 1e6, 1e7, 1e8, 1e9, 1e10, 1e12, 1e15, 1e18])
"""Variance of the prior to that of the noise: a first fix, a lost pose, a very small R."""
ROWS = pytest.mark.parametrize("rows", [[1], [3], [4], [1, 2], [0, 3, 4], [1, 2, 0, 3], [1, 1, 2, 4, 4, 0, 1]])


def strong(ratio: float, rows: list[int]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Prior, z, H and R of one update."""
    H = EVERY_ROW[rows]
    prior = np.diag([1.0, 2.0, 3.0, 4.0]) + 0.5
    R = (H @ prior @ H.T).diagonal() / ratio
    z = H @ np.array([0.3, -0.2, 0.1, 0.4]) + np.sqrt(R) * np.resize([0.5, -1.0, 1.5, -0.3], len(rows))
    return prior, z, H, R


@EVERY_FILTER
@RATIOS
@ROWS
def test_one_update_at_any_ratio_of_prior_to_noise(name: str, ratio: float, rows: list[int]) -> None:
    prior, z, H, R = strong(ratio, rows)
    step = (np.eye(4), np.zeros((4, 4)), z, H, np.diag(R))
    # A residual of sqrt(ratio) sigmas, rounded, moves the mean by that many times 1e-16 where rows repeat each other.
    check(name, np.zeros(4), prior, [step], vector_R=True, tolerance=max(TOLERANCE, 2e-16 * np.sqrt(ratio)))


@EVERY_FILTER
@RATIOS
@ROWS
def test_the_posterior_is_right_in_its_own_sigmas(name: str, ratio: float, rows: list[int]) -> None:
    """However small it is beside the prior: of P - W H P no more than four digits would be left at 1e12."""
    prior, z, H, R = strong(ratio, rows)
    filter_, exact = FILTERS[name](np.zeros(4), prior), ExactFilter(np.zeros(4), prior)
    filter_.update(z, H, R)
    exact.update(z, H, R)
    sigma = np.sqrt(exact.covariance.diagonal())
    # 1e-16 of the prior is sqrt(ratio) times as much of the posterior.
    tolerance = 5e-12 + 5e-16 * np.sqrt(ratio)
    assert np.all(np.abs(filter_.mean - exact.mean) <= tolerance * sigma)
    assert np.all(np.abs(filter_.covariance - exact.covariance) <= tolerance * np.outer(sigma, sigma))
    least = np.linalg.eigvalsh(filter_.covariance / np.outer(sigma, sigma))[0]
    # One reading of two states correlates them: at 1e18 the determinant of P is smaller than the rounding of P.
    assert least > (0.0 if ratio < 1e16 else -1e-15)


@pytest.mark.parametrize("ratio", [1e2, 1e5, 1e12])
def test_a_model_is_linearised_once(ratio: float) -> None:
    """However many steps the update has: a model that is a matrix with an offset gives what the matrix gives."""
    prior, z, H, R = strong(ratio, [1, 2, 0, 3])
    start, offset = np.array([0.3, -0.2, 0.1, 0.4]), np.array([3.0, -2.0, 1.0, 0.5])
    filter_, exact = FILTERS["ekf"](start, prior), ExactFilter(start, prior)
    nis = filter_.update(z + offset, Affine(H, offset), R).nis
    assert nis == pytest.approx(exact.update(z, H, np.diag(R)), rel=1e-6)
    sigma = np.sqrt(exact.covariance.diagonal())
    assert np.all(np.abs(filter_.mean - exact.mean) <= (5e-12 + 1e-15 * np.sqrt(ratio)) * sigma)


@EVERY_FILTER
@pytest.mark.parametrize("noise", [1.0, 1e-9])
@pytest.mark.parametrize("m", [1, 4, 40])
def test_a_state_known_exactly_beside_large_ones(name: str, noise: float, m: int) -> None:
    prior = np.array([[1e6, 0.0, 1e3], [0.0, 0.0, 0.0], [1e3, 0.0, 1.0]])  # the third is a thousandth of the first
    H = np.resize([[1.0, 1, 0], [0, 1, 1], [1, 1, 1], [0, 1, 0]], (m, 3))
    step = (np.eye(3), np.zeros((3, 3)), np.ones(m), H, noise * np.eye(m))
    check(name, np.zeros(3), prior, [step], vector_R=True, tolerance=1e-12 + 2e-16 * np.sqrt(1e6 / noise))
    filter_ = FILTERS[name](np.zeros(3), prior)
    filter_.update(np.ones(m), H, np.full(m, noise))
    assert filter_.mean[1] == 0.0
    assert not filter_.covariance[1].any()


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_the_full_state_model(name: str) -> None:
    problem = survey_problem(load_config())
    filter_ = FILTERS[name](problem.mean, problem.covariance)
    exact = ExactFilter(problem.mean, problem.covariance, unscented=name == "ukf")
    scale = np.maximum(np.sqrt(problem.covariance.diagonal()), np.abs(problem.mean))
    for z in problem.readings[:4]:
        filter_.predict(problem.F, problem.Q)
        exact.predict(problem.F, problem.Q)
        filter_.update(z, problem.H, problem.variances)
        exact.update(z, problem.H, problem.variances)
        assert np.all(np.abs(filter_.mean - exact.mean) <= TOLERANCE * scale)
        assert np.all(np.abs(filter_.covariance - exact.covariance) <= TOLERANCE * np.outer(scale, scale))


def test_the_oracle_on_a_case_done_by_hand() -> None:
    # Prior N(1, 4), one reading 3 of variance 4: weights one half each. Sigma points of a line say the same.
    one = np.array([[1.0]])

    class Line:
        def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
            return x, one

        def through(self, X: FloatArray) -> FloatArray:
            return X

    for unscented in (False, True):
        exact = ExactFilter(np.array([1.0]), 4.0 * one, unscented=unscented)
        exact.predict(Line(), 0.0 * one)
        assert exact.update(np.array([3.0]), Line(), np.array([4.0])) == 0.5
        assert (exact.mean[0], exact.covariance[0, 0]) == (2.0, 2.0)


Update = tuple[FloatArray, FloatArray, FloatArray]
Leg = tuple[FloatArray, FloatArray, list[Update]]


def batch(mean: FloatArray, covariance: FloatArray, legs: list[Leg]) -> tuple[FloatArray, FloatArray]:
    """Means (k, n) and covariances (k, n, n) of all states given all readings; states follow each prediction.

    One filter of all of them: a prediction makes the next one out of the last.
    """
    n, k = mean.size, len(legs) + 1
    own = [slice(n * i, n * (i + 1)) for i in range(k)]
    x, P = np.zeros(n * k), np.zeros((n * k, n * k))
    x[own[0]], P[own[0], own[0]] = mean, covariance
    exact = ExactFilter(x, P)
    for before, after, (F, Q, updates) in zip(own, own[1:], legs, strict=False):
        step, noise = np.eye(n * k), np.zeros((n * k, n * k))
        step[after, before], step[after, after], noise[after, after] = F, 0.0, Q
        exact.predict(step, noise)
        for z, H, R in updates:
            rows = np.zeros((len(z), n * k))
            rows[:, after] = H
            exact.update(z, rows, R)
    return exact.mean.reshape(k, n), np.array([exact.covariance[one, one] for one in own])


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


# -- EKF-SLAM ----------------------------------------------------------------------------------------------------------


class Dense:
    """x and P of everything, each step by full matrices."""

    def __init__(self, x: FloatArray, P: FloatArray) -> None:
        self.x, self.P = x.copy(), P.copy()

    def predict(self, vehicle: FloatArray, F: FloatArray, Q: FloatArray) -> None:
        v, n = vehicle.size, self.x.size
        whole, noise = np.eye(n), np.zeros((n, n))
        whole[:v, :v], noise[:v, :v] = F, Q
        self.x[:v] = vehicle
        self.P = whole @ self.P @ whole.T + noise

    def update(self, H: FloatArray, nu: FloatArray, R: FloatArray) -> float:
        S = H @ self.P @ H.T + R
        K = self.P @ H.T @ np.linalg.inv(S)
        rest = np.eye(self.x.size) - K @ H
        self.x = self.x + K @ nu
        self.P = rest @ self.P @ rest.T + K @ R @ K.T
        return float(nu @ np.linalg.inv(S) @ nu)

    def augment(self, mean: FloatArray, J: FloatArray, Jz: FloatArray, R: FloatArray) -> None:
        across = J @ self.P
        own = J @ self.P @ J.T + Jz @ R @ Jz.T
        self.P = np.block([[self.P, across.T], [across, own]])
        self.x = np.concatenate([self.x, mean])

    def remove(self, place: slice) -> None:
        keep = np.r_[0 : place.start, place.stop : self.x.size]
        self.x, self.P = self.x[keep], self.P[np.ix_(keep, keep)]


def spread(rng: np.random.Generator, n: int) -> FloatArray:
    root = rng.normal(size=(n, n))
    P: FloatArray = root @ root.T / n + 0.1 * np.eye(n)
    return P


def a_pair(rng: np.random.Generator) -> tuple[EkfSlam, Dense]:
    x, P = rng.normal(size=4), spread(rng, 4)
    c, C = rng.normal(size=2), spread(rng, 2)
    whole = np.zeros((6, 6))
    whole[:4, :4], whole[4:, 4:] = P, C
    return EkfSlam(x, P, c, C), Dense(np.concatenate([x, c]), whole)


def check_same(ours: EkfSlam, dense: Dense) -> None:
    assert ours.mean == pytest.approx(dense.x, abs=1e-9)
    assert ours.covariance == pytest.approx(dense.P, abs=1e-9)
    assert np.array_equal(ours.covariance, ours.covariance.T)


@pytest.mark.parametrize("seed", range(4))
def test_a_run_of_everything_equals_the_dense_filter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ours, dense = a_pair(rng)
    names: list[int] = []
    for k in range(60):
        F, Q, new = np.eye(4) + 0.3 * rng.normal(size=(4, 4)), spread(rng, 4), rng.normal(size=4)
        ours.predict(new, F, Q)
        dense.predict(new, F, Q)
        if k % 5 == 0:
            b = int(rng.integers(1, 4))
            columns = np.sort(rng.choice(ours.size, 3, replace=False))
            J, Jz, R, mean = rng.normal(size=(b, 3)), rng.normal(size=(b, 2)), spread(rng, 2), rng.normal(size=b)
            whole = np.zeros((b, ours.size))
            whole[:, columns] = J
            dense.augment(mean, whole, Jz, R)
            ours.augment(k, mean, columns, J, Jz, R)
            names.append(k)
        block = ours.block(names[int(rng.integers(len(names)))])
        columns = columns_of(range(3), slice(4, 6), block)
        m = 1 if k % 2 else int(rng.integers(1, 4))
        H, nu, R = rng.normal(size=(m, columns.size)), rng.normal(size=m), spread(rng, m)
        whole = np.zeros((m, ours.size))
        whole[:, columns] = H
        expected = dense.update(whole, nu, R)
        if m == 1 and k % 4 == 1:
            nis = ours.update_row(columns, H[0], float(nu[0]), float(R[0, 0])).nis
        else:
            nis = ours.update(columns, H, nu, R).nis
        assert nis == pytest.approx(expected, rel=1e-9)
        if k % 11 == 10:
            gone = names.pop(int(rng.integers(len(names))))
            dense.remove(ours.block(gone))
            ours.remove(gone)
        check_same(ours, dense)


def test_prediction_is_f_p_ft_and_reaches_the_map() -> None:
    """Fails on F^T P F, and where the cross-covariance with beacons stays behind."""
    rng = np.random.default_rng(5)
    ours, _ = a_pair(rng)
    ours.augment("b", np.zeros(2), np.arange(2), np.eye(2))
    before, F = ours.covariance.copy(), np.array([[1.0, 0, -3, 0], [0, 1, 2, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]])
    ours.predict(np.zeros(4), F, np.eye(4))
    assert ours.covariance[:4, :4] == pytest.approx(F @ before[:4, :4] @ F.T + np.eye(4))
    assert ours.covariance[:4, :4] != pytest.approx(F.T @ before[:4, :4] @ F + np.eye(4))
    assert ours.covariance[:4, 6:] == pytest.approx(F @ before[:4, 6:])
    assert ours.covariance[6:, :4] == pytest.approx((F @ before[:4, 6:]).T)
    assert ours.covariance[4:, 4:] == pytest.approx(before[4:, 4:])


@pytest.mark.parametrize("as_row", [True, False])
def test_a_reading_far_more_exact_than_the_state_leaves_a_covariance(as_row: bool) -> None:
    """P - K S K^T would leave rounding of the prior, 1e-4, where 1e-10 is right."""
    ours = EkfSlam(np.zeros(2), np.diag((3.7e12, 1.0)))
    columns, h = np.arange(2), np.array((1.1, 0.7))
    if as_row:
        ours.update_row(columns, h, 3.0, 1e-10)
    else:
        ours.update(columns, h[None, :], np.array((3.0,)), np.array((1e-10,)))
    assert np.linalg.eigvalsh(ours.covariance)[0] > 0.0
    assert ours.covariance[1, 1] == pytest.approx(1.0)
    assert ours.covariance[0, 0] == pytest.approx((0.7 / 1.1) ** 2, rel=1e-3)


def test_iterated_update_comes_to_rest_at_the_most_likely_state() -> None:
    ours = EkfSlam(np.array((3.0, 1.0)), np.diag((4.0, 4.0)))
    z, R = np.array((5.0, 0.2)), np.array((0.01, 0.001))

    def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        r = float(np.hypot(*x))
        value = np.array((r, np.arctan2(x[1], x[0])))
        return z - value, np.array(((x[0] / r, x[1] / r), (-x[1] / r**2, x[0] / r**2)))

    ours.update_iterated(np.arange(2), linearise, R, 20)
    residual, H = linearise(ours.mean)
    slope = H.T @ (residual / R) - (ours.mean - (3.0, 1.0)) / 4.0
    assert slope == pytest.approx(np.zeros(2), abs=1e-2)  # of terms of about 50
    assert ours.covariance == pytest.approx(np.linalg.inv(H.T @ np.diag(1.0 / R) @ H + np.eye(2) / 4.0), rel=1e-3)


def test_the_gate_leaves_the_state_and_the_knee_weighs_less() -> None:
    columns, h = np.arange(1), np.ones(1)
    refused = EkfSlam(np.zeros(1), np.eye(1))
    found = refused.update_row(columns, h, 10.0, 1.0, gate=9.0)
    assert (found.accepted, found.nis, refused.mean[0], refused.covariance[0, 0]) == (False, 50.0, 0.0, 1.0)
    robust = EkfSlam(np.zeros(1), np.eye(1))
    found = robust.update_row(columns, h, 10.0, 1.0, knee=2.0)
    larger = 2.0 * np.sqrt(50.0) / 2.0  # S, as large as makes its weight that of an innovation at the knee
    assert found.nis == pytest.approx(100.0 / larger)
    assert found.spread == 2.0
    assert robust.mean[0] == pytest.approx(10.0 / larger)
    refused.update(columns, h[None, :], np.array((10.0,)), np.ones(1), gate=9.0)
    assert refused.mean[0] == 0.0


def test_a_state_that_forgets() -> None:
    ours = EkfSlam(np.array((1.0, 2.0)), np.array(((1.0, 0.5), (0.5, 2.0))))
    ours.relax(1, 0.5, 0.75)
    assert ours.mean == pytest.approx((1.0, 1.0))
    assert ours.covariance == pytest.approx(np.array(((1.0, 0.25), (0.25, 0.5 + 0.75))))


def test_a_copy_of_a_state_is_corrected_as_the_state_was() -> None:
    """x1 = x0 + w: with a copy of x0, a reading of x1 is the textbook's smoother of two steps."""
    ours = EkfSlam(np.zeros(1), np.eye(1))
    ours.augment("copy", np.full(1, 9.0), np.arange(0), np.zeros((1, 0)), np.eye(1), np.eye(1))
    ours.copy_states("copy", 0)
    ours.predict(np.zeros(1), np.eye(1), np.eye(1))
    ours.update_row(np.arange(1), np.ones(1), 1.0, 1.0)
    exact = ExactFilter(np.zeros(2), np.array(((2.0, 1.0), (1.0, 1.0))))
    exact.update(np.ones(1), np.array(((1.0, 0.0),)), np.eye(1))
    assert ours.mean == pytest.approx(exact.mean)
    assert ours.covariance == pytest.approx(exact.covariance)


def test_refusals() -> None:
    ours = EkfSlam(np.zeros(3), np.eye(3))
    with pytest.raises(FilterShapeError, match=r"F has shape \(2, 2\)"):
        ours.predict(np.zeros(3), np.eye(2), np.eye(3))
    with pytest.raises(FilterDiverged, match="prediction is not finite"):
        ours.predict(np.full(3, np.nan), np.eye(3), np.eye(3))
    with pytest.raises(FilterShapeError, match="H has shape"):
        ours.update(np.arange(3), np.ones((1, 2)), np.zeros(1), np.ones(1))
    with pytest.raises(FilterShapeError, match="R has shape"):
        ours.update(np.arange(3), np.ones((1, 3)), np.zeros(1), np.ones(2))
    with pytest.raises(FilterDiverged, match="update is not finite"):
        ours.update(np.arange(3), np.ones((1, 3)), np.full(1, np.inf), np.ones(1))
    with pytest.raises(FilterDiverged, match="not positive definite"):
        ours.update(np.arange(3), np.ones((1, 3)), np.zeros(1), np.full(1, -9.0))
    with pytest.raises(FilterDiverged, match="update is not finite"):
        ours.update_row(np.arange(3), np.ones(3), 0.0, -1.0)
    with pytest.raises(FilterShapeError, match="J_state has shape"):
        ours.augment("b", np.zeros(2), np.arange(3), np.zeros((2, 2)))
    with pytest.raises(FilterShapeError, match="J_z has shape"):
        ours.augment("b", np.zeros(2), np.arange(3), np.zeros((2, 3)), np.eye(2), np.eye(3))
    with pytest.raises(FilterDiverged, match="block 'b' is not finite"):
        ours.augment("b", np.full(2, np.nan), np.arange(3), np.zeros((2, 3)))
    ours.augment("b", np.zeros(2), np.arange(3), np.zeros((2, 3)))
    with pytest.raises(BlockError, match="block 'b' is in the state already"):
        ours.augment("b", np.zeros(2), np.arange(3), np.zeros((2, 3)))
    with pytest.raises(BlockError, match="block 'c' is not in the state"):
        ours.remove("c")
    assert "b" in ours
    assert ours.blocks == ("b",)
