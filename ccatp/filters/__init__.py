"""Pure. Filters by the name under which ``run.filter`` of the configuration selects them."""

from collections.abc import Callable

import numpy as np

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
from ccatp.filters.four_states import STATES, FourStateFilter
from ccatp.filters.kalman import KalmanFilter
from ccatp.filters.smoother import Smoothed, Smoother, SmootherEmpty
from ccatp.filters.unscented import UnscentedKalmanFilter


def linear_filter(mean: FloatArray, covariance: FloatArray) -> Filter:
    """The linear filter of a mean (n,) and a covariance (n, n): written out for the thesis's four states."""
    return (FourStateFilter if np.size(mean) == STATES else KalmanFilter)(mean, covariance)


FILTERS: dict[str, Callable[[FloatArray, FloatArray], Filter]] = {
    "kf": linear_filter,
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
    "FourStateFilter",
    "Innovation",
    "KalmanFilter",
    "Observation",
    "Smoothed",
    "Smoother",
    "SmootherEmpty",
    "Transition",
    "UnscentedKalmanFilter",
    "linear_filter",
]
