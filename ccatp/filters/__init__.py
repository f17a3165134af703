"""Pure. Filters by the name under which ``run.filter`` of the configuration selects them."""

from collections.abc import Callable

from ccatp.filters.base import Filter, FilterDiverged, FilterError, FilterShapeError, FloatArray, Innovation
from ccatp.filters.kalman import KalmanFilter

FILTERS: dict[str, Callable[[FloatArray, FloatArray], Filter]] = {"kf": KalmanFilter}
"""Constructors of (mean (n,), covariance (n, n))."""

__all__ = [
    "FILTERS",
    "Filter",
    "FilterDiverged",
    "FilterError",
    "FilterShapeError",
    "FloatArray",
    "Innovation",
    "KalmanFilter",
]
