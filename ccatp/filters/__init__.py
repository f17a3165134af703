"""Gaussian filters on arrays: Kalman, extended, unscented. ``FILTERS``: by ``run.filter``."""

from collections.abc import Callable

from ccatp.core import FloatArray
from ccatp.filters.base import Filter
from ccatp.filters.kalman import KalmanFilter
from ccatp.filters.unscented import UnscentedKalmanFilter

FILTERS: dict[str, Callable[[FloatArray, FloatArray], Filter]] = {
    "kf": KalmanFilter,
    "ekf": KalmanFilter,
    "ukf": UnscentedKalmanFilter,
}
"""Constructors from (mean (n,), covariance (n, n)). ``kf`` and ``ekf`` are the same class."""
