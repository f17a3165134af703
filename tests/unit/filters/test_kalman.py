"""Pure. The Kalman filter's own promises: shapes, refusals, symmetry, the empty update, the innovation."""

import numpy as np
import pytest

from ccatp.core import FloatArray
from ccatp.filters import FILTERS, FilterDiverged, FilterShapeError, KalmanFilter

EYE = np.eye(2)


def make() -> KalmanFilter:
    return KalmanFilter(np.array([1.0, 2.0]), np.array([[2.0, 0.5], [0.5, 1.0]]))


def state(kf: KalmanFilter) -> tuple[FloatArray, FloatArray]:
    return kf.mean.copy(), kf.covariance.copy()


def test_registry() -> None:
    assert isinstance(FILTERS["kf"](np.zeros(2), EYE), KalmanFilter)


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


def test_reset_copies() -> None:
    mean, covariance = np.zeros(2), np.eye(2)
    kf = make()
    kf.reset(mean, covariance)
    mean[0], covariance[0, 0] = 5.0, 5.0
    assert (kf.mean[0], kf.covariance[0, 0]) == (0.0, 1.0)


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


def test_a_poisoned_covariance_is_noticed() -> None:
    kf = make()
    kf.covariance[0, 0] = np.nan
    with pytest.raises(FilterDiverged, match="not finite"):
        kf.update(np.ones(1), np.ones((1, 2)), np.ones(1))
    kf.covariance = np.array([[-1.0, np.nan], [np.nan, 1.0]])
    with pytest.raises(FilterDiverged, match="covariance is not finite"):
        kf.update(np.ones(1), np.ones((1, 2)), np.ones(1))
    kf.covariance = np.diag([1.0, -1.0])
    with pytest.raises(FilterDiverged, match="covariance is not positive semidefinite"):
        kf.update(np.ones(1), np.ones((1, 2)), np.ones(1))


@pytest.mark.parametrize("variance", [0.0, -1.0, np.nan])
def test_noise_without_a_variance_is_refused(variance: float) -> None:
    with pytest.raises(FilterDiverged, match="update is not finite"):
        make().update(np.ones(1), np.ones((1, 2)), np.array([variance]))
    with pytest.raises(FilterDiverged, match=r"R is not positive definite|update is not finite"):
        make().update(np.ones(1), np.ones((1, 2)), np.array([[variance]]))
    with pytest.raises(FilterDiverged, match="R is not positive definite"):
        make().update(np.ones(1), np.ones((1, 2)), np.array([[-1.0]]))


def test_no_measurement_leaves_the_prediction() -> None:
    kf = make()
    kf.predict(np.array([[1.0, 0.1], [0.0, 1.0]]), 0.01 * EYE)
    before = state(kf)
    innovation = kf.update(np.empty(0), np.empty((0, 2)), np.empty(0))
    assert (innovation.residual.shape, innovation.nis, innovation.size) == ((0,), 0.0, 0)
    np.testing.assert_array_equal(kf.mean, before[0])
    np.testing.assert_array_equal(kf.covariance, before[1])


def test_innovation() -> None:
    kf = make()
    H, z, R = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 2.0]]), np.array([1.5, 2.0, 5.0]), np.array([0.5, 0.1, 2.0])
    residual = z - H @ kf.mean
    S = H @ kf.covariance @ H.T + np.diag(R)
    innovation = kf.update(z, H, R)
    np.testing.assert_allclose(innovation.residual, residual, rtol=1e-15)  # the same subtraction
    assert innovation.nis == pytest.approx(residual @ np.linalg.solve(S, residual), rel=1e-13)  # rounding of a 3 x 3
    assert innovation.size == 3


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


def test_prediction_is_symmetric_to_the_last_bit() -> None:
    rng = np.random.default_rng(3)
    F, Q = rng.normal(size=(4, 4)), 0.1 * np.eye(4)
    kf = KalmanFilter(np.zeros(4), np.eye(4))
    for _ in range(10):
        kf.predict(F, Q)
        np.testing.assert_array_equal(kf.covariance, kf.covariance.T)


def test_consistency_of_the_normalised_innovation() -> None:
    # 400 updates of 2 rows: the mean NIS is 2 within 4 sigma = 4 * 2 / sqrt(400).
    rng = np.random.default_rng(7)
    F, Q, H, R = (
        np.array([[1.0, 0.1], [0.0, 1.0]]),
        0.01 * EYE,
        np.array([[1.0, 0.0], [1.0, 1.0]]),
        np.array([0.2, 0.4]),
    )
    kf = KalmanFilter(np.zeros(2), EYE)
    x = rng.normal(size=2)
    nis = []
    for _ in range(400):
        x = F @ x + 0.1 * rng.normal(size=2)
        kf.predict(F, Q)
        nis.append(kf.update(H @ x + np.sqrt(R) * rng.normal(size=2), H, R).nis)
    assert np.mean(nis) == pytest.approx(2.0, abs=0.4)


def test_a_state_known_exactly_stays_so_beside_large_ones() -> None:
    # More rows than states, so that the square root of a singular covariance is taken.
    kf = KalmanFilter(np.zeros(3), np.array([[1e6, 0.0, 1e3], [0.0, 0.0, 0.0], [1e3, 0.0, 1.0]]))
    kf.update(np.ones(4), np.array([[1.0, 1, 0], [0, 1, 1], [1, 1, 1], [0, 1, 0]]), np.ones(4))
    assert kf.mean[1] == 0.0
    assert not kf.covariance[1].any()
    assert not kf.covariance[:, 1].any()
