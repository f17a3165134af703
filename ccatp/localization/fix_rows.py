"""Pure. What a fix of the puck says of the full state, and the state that begins anew from one."""

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.localization.seam_lines import axes_on
from ccatp.localization.survey_model import PL, PR, PSI, STATES, TX, TY, A, V, W, X, Y
from ccatp.localization.terrain import Slope

_UNKNOWN_SPEEDS = 0.1**2, 0.5**2, 1.0**2  # variances of v, a, w of a robot of which nothing is known


def fix_row(z: FloatArray, mean: FloatArray, slope: Slope, late_s: float) -> tuple[FloatArray, FloatArray]:
    """Residual (2,) and row of the measurement model (2, n) of a position.

    Args:
        z: the robot's origin by the puck, deck, m, shape (2,).
        mean: the state, shape (n,).
        slope: the ground under it.
        late_s: by how much the state is later than the position; V and W held meanwhile.
    """
    H = np.zeros((2, STATES))
    H[0, X] = H[1, Y] = H[0, TX] = H[1, TY] = 1.0
    residual = z - mean[[X, Y]] - mean[[TX, TY]]
    if late_s == 0.0:
        return residual, H
    v, w = float(mean[V]), float(mean[W])
    hx, hy, lx, ly = axes_on(slope, float(mean[PSI]) - 0.5 * w * late_s)
    way = v * late_s
    H[:, PSI] = -way * lx, -way * ly
    H[:, V] = -late_s * hx, -late_s * hy
    H[:, W] = -0.5 * late_s * H[:, PSI]
    return residual + way * np.array((hx, hy)), H


def begun_anew(
    mean: FloatArray,
    covariance: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
    tilt_variance_m2: float,
    heading_variance_rad2: float,
    *,
    is_lost: bool,
) -> tuple[FloatArray, FloatArray]:
    """Mean (n,) and covariance (n, n) of a state whose position was wrong; wheel angles count from here.

    The heading loses its certainty, not its value. The way since the position was measured is taken from the estimate
    that was wrong: wrong about where it began, not about what the wheels did.

    Args:
        mean: the wrong state, shape (n,).
        covariance: of it, shape (n, n).
        residual: of the position, shape (2,); see ``fix_row``.
        variance: covariance of the position, m^2, shape (2, 2).
        tilt_variance_m2: of what the panel's tilt does to the puck's place, each way.
        heading_variance_rad2: what the heading's variance grows by.
        is_lost: the filter has stood still meanwhile; the speeds are not known either.
    """
    x, P = mean.copy(), covariance.copy()
    heading_rad2 = float(P[PSI, PSI]) + heading_variance_rad2
    new = [X, Y, PSI, PR, PL, TX, TY, *((V, A, W) if is_lost else ())]
    P[new, :] = 0.0
    P[:, new] = 0.0
    P[:2, :2], P[PSI, PSI] = variance, heading_rad2
    P[[X, Y, TX, TY], [X, Y, TX, TY]] += tilt_variance_m2
    P[[X, Y, TX, TY], [TX, TY, X, Y]] -= tilt_variance_m2
    x[:2] += residual + x[[TX, TY]]
    x[[PR, PL, TX, TY]] = 0.0
    if is_lost:
        x[[V, A, W]] = 0.0
        P[V, V], P[A, A], P[W, W] = _UNKNOWN_SPEEDS
    return x, P
