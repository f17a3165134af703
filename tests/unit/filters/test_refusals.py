"""Pure. What the nonlinear filters and the smoother refuse, and that a refusal leaves the state in force."""

import numpy as np
import pytest

from ccatp.core import FloatArray
from ccatp.filters import (
    FILTERS,
    Filter,
    FilterDiverged,
    FilterModelError,
    FilterShapeError,
    KalmanFilter,
    Smoother,
    SmootherEmpty,
)

BOTH = pytest.mark.parametrize("name", ["ekf", "ukf"])
EYE = np.eye(2)


class Bent:
    """A model with images and Jacobian of any shape, scaled."""

    def __init__(self, rows: int, columns: int = 2, scale: float = 1.0) -> None:
        self.shape, self.scale = (rows, columns), scale

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.scale * np.ones(self.shape[0]), self.scale * np.ones(self.shape)

    def through(self, X: FloatArray) -> FloatArray:
        return self.scale * np.hstack([X, X])[:, : self.shape[0]]


def make(name: str) -> Filter:
    return FILTERS[name](np.array([1.0, 2.0]), np.array([[2.0, 0.5], [0.5, 1.0]]))


def test_the_linear_filter_takes_no_model() -> None:
    with pytest.raises(FilterModelError, match="KalmanFilter takes arrays, not the nonlinear Bent"):
        make("kf").predict(Bent(2), EYE)
    with pytest.raises(FilterModelError, match="choose ekf or ukf"):
        make("kf").update(np.zeros(1), Bent(1), np.ones(1))


@BOTH
def test_shapes_of_models(name: str) -> None:
    filter_ = make(name)
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
        make("ekf").predict(Bent(2, 3), EYE)
    with pytest.raises(FilterShapeError, match=r"dh/dx has shape \(1, 3\), wanted \(1, 2\)"):
        make("ekf").update(np.zeros(1), Bent(1, 3), np.ones(1))


@BOTH
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_what_is_not_finite_leaves_the_state(name: str, bad: float) -> None:
    filter_ = make(name)
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
        make(name).update(np.zeros(1), Bent(1), R)


@BOTH
def test_no_measurement(name: str) -> None:
    filter_ = make(name)
    innovation = filter_.update(np.empty(0), Bent(0), np.empty(0))
    assert (innovation.nis, innovation.size) == (0.0, 0)


@BOTH
def test_work_space_is_neither_kept_nor_changed(name: str) -> None:
    filter_ = make(name)
    f, F = np.array([3.0, 4.0]), np.array([[1.0, 0.5], [0.0, 1.0]])

    class Reused(Bent):
        def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
            return f, F

    filter_.predict(Reused(2), EYE)
    mean, transition = filter_.mean.copy(), filter_.transition.copy()
    f[:], F[:] = 9.0, 9.0
    np.testing.assert_array_equal(filter_.mean, mean)
    np.testing.assert_array_equal(filter_.transition, transition)


def test_smoother_refuses() -> None:
    smoother, kf = Smoother(2), KalmanFilter(np.zeros(2), EYE)
    with pytest.raises(SmootherEmpty, match="step 0 of 0 recorded"):
        smoother.smooth(kf)
    with pytest.raises(FilterShapeError, match=r"predicted has shape \(3,\), wanted \(2,\)"):
        smoother.record(np.zeros(2), EYE, EYE, np.zeros(3), EYE)
    smoother.predict(kf, EYE, EYE)
    assert len(smoother) == 1
    with pytest.raises(SmootherEmpty, match="step 1 of 1 recorded"):
        smoother.smooth(kf, first=1)
    smoother.record(np.full(2, np.nan), EYE, EYE, np.zeros(2), EYE)
    with pytest.raises(FilterDiverged, match="smoothed states are not finite among 2 steps"):
        smoother.smooth(kf)


def test_smoother_in_blocks_and_in_part() -> None:
    kf, smoother = KalmanFilter(np.zeros(1), np.ones((1, 1))), Smoother(1, np.float32)
    one = np.ones((1, 1))
    for i in range(5000):  # more than a block
        smoother.predict(kf, one, 0.01 * one)
        kf.update(np.array([np.sin(0.01 * i)]), one, np.ones(1))
    whole, part = smoother.smooth(kf), smoother.smooth(kf, first=4990)
    assert whole.means.shape == (5001, 1)
    np.testing.assert_array_equal(whole.means[4990:], part.means)
    np.testing.assert_array_equal(whole.covariances[4990:], part.covariances)
