"""What the smoother of recorded runs promises and refuses."""

import numpy as np
import pytest

from ccatp.filters.base import FilterDiverged, FilterShapeError
from ccatp.filters.kalman import KalmanFilter
from ccatp.studies.smoother import Smoother, SmootherEmpty

EYE = np.eye(2)


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
