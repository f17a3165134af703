"""Pure. The filter of four states against that in arrays, and what it promises beyond: models by value, laziness."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.core import FloatArray
from ccatp.filters import (
    FILTERS,
    FilterDiverged,
    FilterModelError,
    FilterShapeError,
    FourStateFilter,
    KalmanFilter,
    linear_filter,
)
from ccatp.filters.compression import MANY, SPREAD, Rows
from ccatp.filters.four_states import ORDER

EYE = np.eye(4)
F = np.array([[1.0, 0.1, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.1], [0.0, 0.0, 0.0, 1.0]])
Q = F @ np.diag([0.0, 0.3, 0.0, 0.2]) @ F.T


def make(seed: int = 0) -> tuple[FourStateFilter, KalmanFilter]:
    """The same state in both."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 4))
    mean, covariance = rng.normal(size=4), root @ root.T + 0.1 * EYE
    return FourStateFilter(mean, covariance), KalmanFilter(mean, covariance)


def check_alike(four: FourStateFilter, arrays: KalmanFilter) -> None:
    np.testing.assert_allclose(four.mean, arrays.mean, rtol=1e-11, atol=1e-11)  # rounding, condition numbers of 1e3
    np.testing.assert_allclose(four.covariance, arrays.covariance, rtol=1e-11, atol=1e-11)
    np.testing.assert_array_equal(four.covariance, four.covariance.T)


def test_the_registry_takes_it_for_four_states_only() -> None:
    assert isinstance(FILTERS["kf"](np.zeros(4), EYE), FourStateFilter)
    assert isinstance(linear_filter(np.zeros(3), np.eye(3)), KalmanFilter)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    m=st.sampled_from([1, 2, 3, 5, MANY, MANY + 1, 40]),
    zeros=st.sampled_from([(), (2,), (2, 0), (0, 1, 2), (1, 3), (0, 2, 3)]),
    is_chain=st.booleans(),
    is_paired=st.booleans(),
)
def test_every_pattern_of_rows(seed: int, m: int, zeros: tuple[int, ...], is_chain: bool, is_paired: bool) -> None:
    rng = np.random.default_rng(seed)
    four, arrays = make(seed)
    H, R = rng.normal(size=(m, 4)), rng.uniform(0.1, 1.0, m)
    H[:, zeros] = 0.0
    H[rng.random(m) < 0.3, ORDER[0]] = 0.0
    noise = Q if is_paired else Q + 0.1 * np.ones((4, 4))
    for k in range(3):
        A = F if is_chain else rng.normal(size=(4, 4))
        z = rng.normal(size=m)
        innovations = []
        for filter_ in (four, arrays):
            filter_.predict(A, noise)
            np.testing.assert_array_equal(filter_.transition, A)
            before = filter_.mean
            innovations.append(filter_.update(z, H * (k + 1), R))
            assert innovations[-1].residual == pytest.approx(z - (k + 1) * H @ before, abs=1e-9)
        assert innovations[0].nis == pytest.approx(innovations[1].nis, rel=1e-9)
        assert innovations[0].size == m
        check_alike(four, arrays)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), ratio=st.sampled_from([1.0, 1e4, 1e8, 1e12]), m=st.integers(1, 30))
def test_symmetric_positive_and_any_order_at_any_ratio(seed: int, ratio: float, m: int) -> None:
    """Prior variances over those of the noise up to 1e12; rows repeat each other."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 4)) + 2.0 * EYE
    prior = root @ root.T
    H = rng.normal(size=(3, 4))[rng.integers(0, 3, m)]
    R = rng.uniform(0.5, 2.0, m) / ratio
    z = H @ rng.multivariate_normal(np.zeros(4), prior) + np.sqrt(R) * rng.normal(size=m)
    order = rng.permutation(m)
    found = []
    for index in (np.arange(m), order):
        four = FourStateFilter(np.zeros(4), prior)
        nis = four.update(z[index], H[index], R[index]).nis
        least = np.linalg.eigvalsh(four.covariance)[0]
        np.testing.assert_array_equal(four.covariance, four.covariance.T)
        assert least > -1e-15 * np.abs(prior).max()  # what writing P in an array rounds away
        assert nis >= 0.0
        found.append((four.mean, four.covariance))
    sigma = np.sqrt(prior.diagonal())
    # 1e-16 of the prior, times the root of the ratio for the mean: a residual of that many sigmas is weighted.
    np.testing.assert_allclose(found[0][0] / sigma, found[1][0] / sigma, atol=1e-15 * (100.0 + np.sqrt(ratio)))
    np.testing.assert_allclose(found[0][1] / np.outer(sigma, sigma), found[1][1] / np.outer(sigma, sigma), atol=1e-13)


def test_compressed_rows_say_what_all_of_them_say() -> None:
    rng = np.random.default_rng(5)
    wheels_and_acceleration = np.array([[30.0, 0.5, 0.0, 2.0], [30.0, 0.5, 0.0, -2.0], [0.0, 1.0, 0.0, 0.0]])
    H, R = wheels_and_acceleration[rng.integers(0, 3, 40)], rng.uniform(0.5, 2.0, 40)
    z = H @ np.ones(4) + rng.normal(size=40)
    rows = Rows(H, R, ORDER)
    assert len(rows.rows) == 3  # of the states that are measured
    assert rows.compress is not None
    kept = np.array([row[:4] for row in rows.rows])[:, np.argsort(ORDER)]
    np.testing.assert_allclose(kept.T @ kept, (H.T / R) @ H, rtol=1e-13, atol=1e-11)  # rounding of entries of 1e4
    best = np.linalg.lstsq(H / np.sqrt(R)[:, None], z / np.sqrt(R), rcond=None)[0]
    scatter = np.sum((z - H @ best) ** 2 / R)
    assert rows.contradiction(z, z.dot(rows.compress).tolist()) == pytest.approx(scatter, rel=1e-12)  # rounding


def test_rows_of_very_unlike_exactness_are_not_mixed() -> None:
    H, R = np.tile(EYE, (5, 1)), np.ones(20)
    assert Rows(H, R, ORDER).compress is not None
    R[7] = SPREAD**-2 / 2.0
    assert Rows(H, R, ORDER).compress is None
    H[3] = 0.0
    R[7] = 1.0
    assert Rows(H, R, ORDER).compress is None  # a row that measures nothing


def test_a_model_changed_in_place_is_noticed() -> None:
    four, arrays = make()
    A, noise, H, R = F.copy(), Q.copy(), EYE[:2].copy(), np.ones(2)
    for change in (
        lambda: None,
        lambda: A.put(1, 0.2),
        lambda: noise.put(5, 1.0),
        lambda: H.put(3, 0.5),
        lambda: R.put(0, 3.0),
    ):
        change()
        for filter_ in (four, arrays):
            filter_.predict(A, noise)
            filter_.update(np.ones(2), H, R)
        check_alike(four, arrays)


def test_arrays_handed_out_keep_their_numbers() -> None:
    four, _ = make()
    four.predict(F, Q)
    mean, covariance = four.mean, four.covariance
    kept = mean.copy(), covariance.copy()
    assert four.mean is mean
    assert four.covariance is covariance
    z, H = np.ones(1), EYE[:1].copy()
    innovation = four.update(z, H, np.ones(1))
    four.predict(F, Q)
    z[:], H[:] = 9.0, 9.0
    np.testing.assert_array_equal(mean, kept[0])
    np.testing.assert_array_equal(covariance, kept[1])
    assert innovation.residual == pytest.approx([1.0 - kept[0][0]], abs=1e-15)  # the same subtraction


def test_a_state_known_exactly_and_correlated_noise() -> None:
    prior = np.diag([1.0, 0.0, 2.0, 3.0])
    R = np.array([[1.0, 0.5], [0.5, 2.0]])
    both = FourStateFilter(np.zeros(4), prior), KalmanFilter(np.zeros(4), prior)
    for filter_ in both:
        filter_.update(np.ones(2), np.array([[1.0, 1, 0, 0], [0, 1, 1, 0]]), np.ones(2))
        filter_.predict(EYE, np.zeros((4, 4)))
        assert filter_.covariance[1, 1] == 0.0
        filter_.predict(F, Q)
        filter_.update(np.ones(2), EYE[:2], R)
    check_alike(*both)


def test_no_measurement() -> None:
    four, _ = make()
    mean = four.mean
    innovation = four.update(np.empty(0), np.empty((0, 4)), np.empty(0))
    assert (innovation.residual.shape, innovation.nis, innovation.size) == ((0,), 0.0, 0)
    np.testing.assert_array_equal(four.mean, mean)


class Model:
    """Nonlinear, whatever it does."""

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return x, EYE

    def through(self, X: FloatArray) -> FloatArray:
        return X


def test_what_it_refuses() -> None:
    four, _ = make()
    before = four.mean.copy(), four.covariance.copy()
    with pytest.raises(FilterModelError, match="KalmanFilter takes arrays, not the nonlinear Model"):
        four.predict(Model(), Q)
    with pytest.raises(FilterModelError, match="choose ekf or ukf"):
        four.update(np.zeros(4), Model(), np.ones(4))
    with pytest.raises(FilterShapeError, match=r"F has shape \(3, 3\), wanted \(4, 4\)"):
        four.predict(np.eye(3), Q)
    with pytest.raises(FilterShapeError, match=r"Q has shape \(4,\), wanted \(4, 4\)"):
        four.predict(F, np.ones(4))
    with pytest.raises(FilterShapeError, match=r"z has shape \(1, 1\)"):
        four.update(np.ones((1, 1)), EYE[:1], np.ones(1))
    with pytest.raises(FilterShapeError, match=r"H has shape \(1, 2\), wanted \(1, 4\)"):
        four.update(np.ones(1), np.ones((1, 2)), np.ones(1))
    with pytest.raises(FilterShapeError, match=r"R has shape \(2,\), wanted \(1,\) or \(1, 1\)"):
        four.update(np.ones(1), EYE[:1], np.ones(2))
    with pytest.raises(FilterShapeError, match=r"mean has shape \(3,\), wanted \(4,\)"):
        four.reset(np.zeros(3), np.eye(3))
    np.testing.assert_array_equal(four.mean, before[0])
    np.testing.assert_array_equal(four.covariance, before[1])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("m", [1, MANY + 3])
def test_what_is_not_finite_leaves_the_state(bad: float, m: int) -> None:
    four, _ = make()
    before = four.mean.copy(), four.covariance.copy()
    H, R = np.ones((m, 4)), np.ones(m)
    with pytest.raises(FilterDiverged, match="prediction is not finite: F"):
        four.predict(np.full((4, 4), bad), Q)
    with pytest.raises(FilterDiverged, match="prediction is not finite: F"):
        four.predict(F, np.full((4, 4), bad))
    with pytest.raises(FilterDiverged, match=r"update is not finite: (NIS|readings)"):
        four.update(np.full(m, bad), H, R)
    with pytest.raises(FilterDiverged, match=r"update is not finite: variances .* or the measurement matrix"):
        four.update(np.ones(m), np.full((m, 4), bad), R)
    with pytest.raises(FilterDiverged, match=r"update is not finite: variances|least variance"):
        four.update(np.ones(m), H, np.full(m, bad))
    with pytest.raises(FilterDiverged, match=r"least variance 0 of"):
        four.update(np.ones(m), H, 0.0 * R)
    np.testing.assert_array_equal(four.mean, before[0])
    np.testing.assert_array_equal(four.covariance, before[1])
    np.testing.assert_array_equal(four.transition, EYE)


def test_a_noise_that_is_none_is_found_out() -> None:
    four, _ = make()
    four.predict(F, -100.0 * EYE)
    with pytest.raises(FilterDiverged, match="covariance is not positive semidefinite"):
        four.update(np.ones(1), EYE[:1], np.ones(1))
