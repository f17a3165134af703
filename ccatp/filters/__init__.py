"""Pure. Filters by the name under which ``run.filter`` of the configuration selects them."""

from collections.abc import Callable

from ccatp.filters.base import (
    Filter,
    FilterDiverged,
    FilterError,
    FilterModelError,
    FilterShapeError,
    FloatArray,
    Innovation,
    Observation,
    Transition,
)
from ccatp.filters.extended import ExtendedKalmanFilter
from ccatp.filters.kalman import KalmanFilter
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
    "FloatArray",
    "Innovation",
    "KalmanFilter",
    "Observation",
    "Smoothed",
    "Smoother",
    "SmootherEmpty",
    "Transition",
    "UnscentedKalmanFilter",
]
