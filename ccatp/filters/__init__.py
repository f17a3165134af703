"""Gaussian filters on arrays: Kalman, extended, unscented, smoother, EKF-SLAM. ``FILTERS``: by ``run.filter``."""

from collections.abc import Callable

from ccatp.core import FloatArray
from ccatp.filters.base import (
    Filter,
    FilterDiverged,
    FilterError,
    FilterModelError,
    FilterShapeError,
    Innovation,
    Observation,
    Transition,
)
from ccatp.filters.kalman import ExtendedKalmanFilter, KalmanFilter
from ccatp.filters.smoother import Smoothed, Smoother, SmootherEmpty
from ccatp.filters.unscented import UnscentedKalmanFilter

FILTERS: dict[str, Callable[[FloatArray, FloatArray], Filter]] = {
    "kf": KalmanFilter,
    "ekf": ExtendedKalmanFilter,
    "ukf": UnscentedKalmanFilter,
}
"""Constructors of (mean (n,), covariance (n, n))."""

__all__ = [
    "FILTERS",
    "ExtendedKalmanFilter",
    "Filter",
    "FilterDiverged",
    "FilterError",
    "FilterModelError",
    "FilterShapeError",
    "Innovation",
    "KalmanFilter",
    "Observation",
    "Smoothed",
    "Smoother",
    "SmootherEmpty",
    "Transition",
    "UnscentedKalmanFilter",
]
