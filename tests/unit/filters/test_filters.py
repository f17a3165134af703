"""What filters promise and refuse: shapes, symmetry, the empty update, the innovation, models."""

from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.core import FloatArray
from ccatp.filters import FILTERS
from ccatp.filters.base import Filter, FilterDiverged, FilterShapeError, square_root
from ccatp.filters.kalman import KalmanFilter

EYE = np.eye(2)


def make() -> KalmanFilter:
    return KalmanFilter(np.array([1.0, 2.0]), np.array([[2.0, 0.5], [0.5, 1.0]]))


def state(kf: KalmanFilter) -> tuple[FloatArray, FloatArray]:
    return kf.mean.copy(), kf.covariance.copy()


@pytest.mark.parametrize(
    ("mean", "covariance", "message"),
    [
        (np.zeros((2, 1)), EYE, r"mean has shape \(2, 1\)"),
        (np.zeros(0), np.zeros((0, 0)), r"mean has shape \(0,\)"),
        (np.zeros(2), np.eye(3), r"covariance has shape \(3, 3\), wanted \(2, 2\)"),
    ],
)
def test_construction_refuses_shapes(mean: FloatArray, covariance: FloatArray, message: str) -> None:
    with pytest.raises(FilterShapeError, match=message):
        KalmanFilter(mean, covariance)


@pytest.mark.parametrize(
    ("mean", "covariance", "message"),
    [
        (np.array([np.nan, 0.0]), EYE, "not finite"),
        (np.zeros(2), np.diag([np.inf, 1.0]), "not finite"),
        (np.zeros(2), np.array([[1.0, 0.5], [0.0, 1.0]]), "not symmetric"),
        (np.zeros(2), np.diag([1.0, -0.1]), "not positive semidefinite"),
    ],
)
def test_construction_and_reset_refuse_what_is_no_gaussian(
    mean: FloatArray, covariance: FloatArray, message: str
) -> None:
    with pytest.raises(FilterDiverged, match=message):
        KalmanFilter(mean, covariance)
    kf = make()
    before = state(kf)
    with pytest.raises(FilterDiverged, match=message):
        kf.reset(mean, covariance)
    np.testing.assert_array_equal(kf.mean, before[0])


def test_reset_keeps_the_number_of_states() -> None:
    with pytest.raises(FilterShapeError, match=r"mean has shape \(3,\), wanted \(2,\)"):
        make().reset(np.zeros(3), np.eye(3))


def test_predict_and_update_refuse_shapes() -> None:
    kf = make()
    with pytest.raises(FilterShapeError, match=r"F has shape \(3, 3\)"):
        kf.predict(np.eye(3), EYE)
    with pytest.raises(FilterShapeError, match=r"Q has shape \(2,\)"):
        kf.predict(EYE, np.ones(2))
    with pytest.raises(FilterShapeError, match=r"z has shape \(1, 1\)"):
        kf.update(np.ones((1, 1)), np.ones((1, 2)), np.ones(1))
    with pytest.raises(FilterShapeError, match=r"H has shape \(2, 1\), wanted \(1, 2\)"):
        kf.update(np.ones(1), np.ones((2, 1)), np.ones(1))
    with pytest.raises(FilterShapeError, match=r"R has shape \(2,\), wanted \(1,\) or \(1, 1\)"):
        kf.update(np.ones(1), np.ones((1, 2)), np.ones(2))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_what_is_not_finite_is_refused_and_leaves_the_state(bad: float) -> None:
    kf = make()
    before = state(kf)
    with pytest.raises(FilterDiverged, match="update is not finite"):
        kf.update(np.array([bad]), np.ones((1, 2)), np.ones(1))
    with pytest.raises(FilterDiverged, match="prediction is not finite"):
        kf.predict(np.diag([bad, bad]), EYE)
    np.testing.assert_array_equal(kf.mean, before[0])
    np.testing.assert_array_equal(kf.covariance, before[1])


@pytest.mark.parametrize(
    "Q",
    [
        np.diag([0.0, -1.5]),
        np.diag([0.0, -1e9]),
        np.array([[0.0, 2.0], [2.0, 0.0]]),
        np.array([[0.0, 0.92], [0.92, 0.0]]),
    ],
)
def test_a_noise_that_is_no_covariance_is_refused_where_it_is_added(Q: FloatArray) -> None:
    kf = make()  # the last one misses the limit, the root of 2 less 0.5, by 0.006
    before = state(kf)
    with pytest.raises(FilterDiverged, match="covariance is not positive semidefinite: least eigenvalue -"):
        kf.predict(EYE, Q)
    np.testing.assert_array_equal(kf.mean, before[0])
    np.testing.assert_array_equal(kf.covariance, before[1])
    kf.predict(EYE, np.array([[0.0, 0.91], [0.91, 0.0]]))


@pytest.mark.parametrize("rank", range(5))
def test_the_root_of_a_singular_covariance(rank: int) -> None:
    rng = np.random.default_rng(rank)
    sigma = np.array([1e-6, 1.0, 0.0, 1e3, 1e-3])
    factor = rng.normal(size=(5, rank)) * sigma[:, None]
    P = factor @ factor.T
    L = square_root(P)
    np.testing.assert_allclose(L @ L.T, P, atol=0.0, rtol=1e-13)  # rounding, in the units of each state
    assert not L[2].any()


@pytest.mark.parametrize("variance", [0.0, -1.0, np.nan])
def test_noise_without_a_variance_is_refused(variance: float) -> None:
    kf = make()
    before = state(kf)
    for R in (np.array([variance]), np.array([[variance]])):
        with pytest.raises(FilterDiverged, match=r"R is not positive definite|update is not finite"):
            kf.update(np.ones(1), np.ones((1, 2)), R)
    np.testing.assert_array_equal(kf.mean, before[0])
    np.testing.assert_array_equal(kf.covariance, before[1])


def test_no_measurement_leaves_the_prediction() -> None:
    kf = make()
    kf.predict(np.array([[1.0, 0.1], [0.0, 1.0]]), 0.01 * EYE)
    before = state(kf)
    innovation = kf.update(np.empty(0), np.empty((0, 2)), np.empty(0))
    assert (innovation.residual.shape, innovation.nis, innovation.size) == ((0,), 0.0, 0)
    np.testing.assert_array_equal(kf.mean, before[0])
    np.testing.assert_array_equal(kf.covariance, before[1])


def test_a_semidefinite_prior() -> None:
    # One state known exactly: the update must not touch it, and the other is a scalar average.
    kf = KalmanFilter(np.array([1.0, 0.0]), np.diag([0.0, 1.0]))
    kf.update(np.array([3.0]), np.array([[1.0, 1.0]]), np.array([1.0]))
    assert kf.mean == pytest.approx([1.0, 1.0], abs=1e-15)  # rounding
    assert kf.covariance.ravel() == pytest.approx([0.0, 0.0, 0.0, 0.5], abs=1e-15)


def test_covariance_stays_symmetric_positive_definite_where_the_printed_form_does_not() -> None:
    # A prior of 1 beside readings of 1e-9: the printed 2.10 subtracts nearly equal numbers.
    H = np.array([[1.0, 1.0, 0.0], [1.0, 0.999, 1e-3], [0.0, 1.0, 1.0]])
    R = np.full(3, 1e-18)
    kf = KalmanFilter(np.zeros(3), np.eye(3))
    printed = np.eye(3)
    for _ in range(20):
        kf.update(np.zeros(3), H, R)
        W = printed @ H.T @ np.linalg.inv(H @ printed @ H.T + np.diag(R))
        printed = (np.eye(3) - W @ H) @ printed
        np.testing.assert_array_equal(kf.covariance, kf.covariance.T)
        assert np.linalg.eigvalsh(kf.covariance)[0] > 0.0
    assert not np.array_equal(printed, printed.T) or np.linalg.eigvalsh(printed)[0] <= 0.0


def shipped(n: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Covariance, F, Q, H and R: the thesis's four states; or as many, some of which no noise drives."""
    if n == 4:
        F = np.eye(4)
        F[0, 1] = F[2, 3] = 0.01
        Q = F @ np.diag([0.0, 0.01, 0.0, 0.02]) @ F.T
        H = np.array([[0.0, 1, 0, 0], [33.3, 0, 0, 2.5], [33.3, 0, 0, -2.5], [0, 0, 0, 1]])
        return np.diag([1e-4, 1e-2, 1e-4, 1e-2]), F, Q, H, np.array([3.5e-5, 1e-6, 1e-6, 7.6e-5])
    rng = np.random.default_rng(n)
    F = np.eye(n)
    F[: n // 2, n // 2 :] = 0.01 * rng.normal(size=(n // 2, n - n // 2))
    Q = np.diag(np.where(np.arange(n) % 3, 0.0, 1e-6))
    # With the rates of the second half these rows observe every state. The variance of a state that nothing observes
    # grows without end, until no P in doubles holds it beside the others.
    m = n // 2 + 1
    return np.diag(10.0 ** rng.uniform(-6.0, 0.0, n)), F, Q, rng.normal(size=(m, n)), np.full(m, 1e-4)


def check_a_long_run(n: int, steps: int) -> None:
    """Any subset of the rows arrives; now and then the pose is lost and found."""
    covariance, F, Q, H, R = shipped(n)
    rng = np.random.default_rng(n)
    subsets = [rng.permutation(len(R))[: rng.integers(1, len(R) + 1)] for _ in range(50)]
    rows = [(rng.normal(size=s.size) * np.sqrt(R[s]), H[s], R[s]) for s in subsets]
    kf, lost = KalmanFilter(np.zeros(n), covariance), np.diag(np.full(n, 1e4))
    for k in range(steps):
        kf.predict(F, lost if k % 1009 == 1008 else Q)
        kf.update(*rows[k % 50])
        if k % 97 == 0:
            P = kf.covariance
            np.testing.assert_array_equal(P, P.T)
            sigma = np.sqrt(P.diagonal())
            assert np.linalg.eigvalsh(P / np.outer(sigma, sigma))[0] > 0.0
    assert np.isfinite(kf.mean).all()


@pytest.mark.parametrize("n", [4, 19])
def test_covariance_stays_symmetric_positive_definite(n: int) -> None:
    check_a_long_run(n, 5000)


@pytest.mark.slow
@pytest.mark.parametrize("n", [4, 19])
def test_covariance_stays_symmetric_positive_definite_over_a_million_steps(n: int) -> None:
    check_a_long_run(n, 1_000_000)


def test_what_was_handed_out_keeps_its_numbers() -> None:
    kf = make()
    kf.predict(np.array([[1.0, 0.1], [0.0, 1.0]]), 0.01 * EYE)
    mean, covariance, transition = kf.mean, kf.covariance, kf.transition
    assert (kf.mean is mean, kf.covariance is covariance) == (True, True)
    kept = mean.copy(), covariance.copy(), transition.copy()
    z, H, R = np.array([1.0, 2.0]), np.array([[1.0, 0.0], [0.5, 1.0]]), np.ones(2)
    innovation = kf.update(z, H, R)
    residual = z - H @ kept[0]
    for array in (z, H, R):
        array[:] = 9.0
    kf.predict(2.0 * EYE, EYE)
    kf.update(np.zeros(2), EYE, np.ones(2))
    for now, then in zip((mean, covariance, transition), kept, strict=True):
        np.testing.assert_array_equal(now, then)
    assert innovation.residual == pytest.approx(residual, abs=1e-15)  # the same subtraction


@pytest.mark.parametrize("order", ["C", "F"])
def test_any_layout_and_type_of_arrays(order: Literal["C", "F"]) -> None:
    covariance, F, Q, H, R = shipped(4)
    one, other = KalmanFilter(np.zeros(4), covariance), KalmanFilter(np.zeros(4), covariance)
    z, H = np.array([1.0, 2.0, 3.0, 4.0]), np.rint(H)
    one.predict(F, Q)
    other.predict(np.array(F, order=order), np.array(Q, order=order))
    one.update(z, H, R)
    whole: Any = np.array(H, order=order).astype(np.int64)
    other.update(np.repeat(z, 2).astype(np.float32)[::2].astype(np.float64), whole, np.repeat(R, 3)[::3])
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.covariance, other.covariance)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), ratio=st.sampled_from([1.0, 1e4, 1e8, 1e12]), m=st.integers(1, 40))
def test_symmetric_positive_and_any_order_at_any_ratio(seed: int, ratio: float, m: int) -> None:
    """Rows repeat each other, so that their order would count if it could."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 4)) + 2.0 * np.eye(4)
    prior = root @ root.T
    H = rng.normal(size=(3, 4))[rng.integers(0, 3, m)]
    R = rng.uniform(0.5, 2.0, m) / ratio
    z = H @ rng.multivariate_normal(np.zeros(4), prior) + np.sqrt(R) * rng.normal(size=m)
    order = rng.permutation(m)
    found = []
    for index in (np.arange(m), order):
        kf = KalmanFilter(np.zeros(4), prior)
        assert kf.update(z[index], H[index], R[index]).nis >= 0.0
        np.testing.assert_array_equal(kf.covariance, kf.covariance.T)
        assert np.linalg.eigvalsh(kf.covariance)[0] > -1e-15 * np.abs(prior).max()  # what writing P rounds away
        found.append((kf.mean, kf.covariance))
    sigma = np.sqrt(prior.diagonal())
    # 1e-16 of the prior, times the root of the ratio for the mean: a residual of that many sigmas is weighted.
    np.testing.assert_allclose(found[0][0] / sigma, found[1][0] / sigma, atol=1e-14 * (100.0 + np.sqrt(ratio)))
    np.testing.assert_allclose(found[0][1] / np.outer(sigma, sigma), found[1][1] / np.outer(sigma, sigma), atol=1e-13)


# -- models, and what they may not be ---------------------------------------------------------------------------------

BOTH = pytest.mark.parametrize("name", ["ekf", "ukf"])


class Bent:
    """A model with images and Jacobian of any shape, scaled."""

    def __init__(self, rows: int, columns: int = 2, scale: float = 1.0) -> None:
        self.shape, self.scale = (rows, columns), scale

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.scale * np.ones(self.shape[0]), self.scale * np.ones(self.shape)

    def through(self, X: FloatArray) -> FloatArray:
        return self.scale * np.hstack([X, X])[:, : self.shape[0]]


def build(name: str) -> Filter:
    return FILTERS[name](np.array([1.0, 2.0]), np.array([[2.0, 0.5], [0.5, 1.0]]))


@BOTH
def test_shapes_of_models(name: str) -> None:
    filter_ = build(name)
    with pytest.raises(FilterShapeError, match=r"f\((x|X)\) has shape"):
        filter_.predict(Bent(3), EYE)
    with pytest.raises(FilterShapeError, match=r"Q has shape \(3, 3\)"):
        filter_.predict(Bent(2), np.eye(3))
    with pytest.raises(FilterShapeError, match=r"(z|h\(X\)) has shape"):
        filter_.update(np.zeros(2), Bent(1), np.ones(2))
    with pytest.raises(FilterShapeError, match=r"R has shape \(3,\)"):
        filter_.update(np.zeros(1), Bent(1), np.ones(3))


def test_shapes_of_jacobians() -> None:
    with pytest.raises(FilterShapeError, match=r"df/dx has shape \(2, 3\), wanted \(2, 2\)"):
        build("ekf").predict(Bent(2, 3), EYE)
    with pytest.raises(FilterShapeError, match=r"H has shape \(1, 3\), wanted \(1, 2\)"):
        build("ekf").update(np.zeros(1), Bent(1, 3), np.ones(1))


@BOTH
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_images_that_are_not_finite_leave_the_state(name: str, bad: float) -> None:
    filter_ = build(name)
    mean, covariance = filter_.mean, filter_.covariance
    with pytest.raises(FilterDiverged, match="prediction is not finite"):
        filter_.predict(Bent(2, 2, bad), EYE)
    with pytest.raises(FilterDiverged, match="update is not finite"):
        filter_.update(np.array([bad]), Bent(1), np.ones(1))
    assert filter_.mean is mean
    np.testing.assert_array_equal(filter_.covariance, covariance)


@BOTH
@pytest.mark.parametrize("R", [np.zeros(1), np.array([-1.0]), np.array([[-1.0]])])
def test_noise_without_a_variance(name: str, R: FloatArray) -> None:
    with pytest.raises(FilterDiverged, match=r"least variance|R is not positive definite"):
        build(name).update(np.zeros(1), Bent(1), R)


@BOTH
def test_no_measurement_of_a_model(name: str) -> None:
    filter_ = build(name)
    innovation = filter_.update(np.empty(0), Bent(0), np.empty(0))
    assert (innovation.nis, innovation.size) == (0.0, 0)
