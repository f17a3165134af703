"""Fixes of the puck: the robot's position with its covariance, and the measurement model for the full state."""

from math import isfinite
from typing import NamedTuple

import numpy as np

from ccatp.core import Fix, FloatArray
from ccatp.estimation.odometry import Slope, axes_on
from ccatp.estimation.state_model import ANGLES, POSE, POSITION, PSI, SPEEDS, STATES, TILT, TX, TY, V, W, X, Y
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.surface import MirrorError

_WORLD_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class FixRefused(ValueError):
    """A fix cannot be used; the pose is unchanged. The message has the numbers."""


class FixGated(FixRefused):
    """A fix contradicts the estimate; further measurements may confirm it."""


class DeckFoot(NamedTuple):
    """Place of the robot's origin at a fix, deck frame; covariance (2, 2); deviation from the height of the puck."""

    x_m: float
    y_m: float
    covariance_m2: FloatArray
    deviation_m: float


def check_fix(fix: Fix, oldest_s: float, newest_s: float) -> None:
    """Raises ``FixRefused`` if a fix is not finite, or its time is outside the stored path of the robot."""
    if not all(isfinite(v) for v in (fix.t_s, *fix.position_m, *fix.covariance_m2)):
        raise FixRefused(f"fix is not finite: {fix.position_m} m at {fix.t_s} s")
    if not oldest_s <= fix.t_s <= newest_s:
        raise FixRefused(f"fix of {fix.t_s:.3f} s is outside the known path, {oldest_s:.3f} s to {newest_s:.3f} s")


def deck_foot(mirror: Mirror, fix: Fix, puck_height_m: float) -> DeckFoot:
    """Foot of the puck on the surface, deck frame, with its covariance along the surface.

    An error along the normal does not move the foot, so the fix's covariance is projected along the normal on the deck
    plane: ``J = [[1, 0, -nx/nz], [0, 1, -ny/nz]]``, ``J R^T C R J^T``. Raises ``FixRefused`` far from the mirror, or if
    this is not positive definite.
    """
    try:
        x, y, deviation = mirror.foot_of_puck(fix.position_m, puck_height_m)
    except MirrorError as error:
        raise FixRefused(f"fix at {fix.position_m} m has no foot on the mirror: {error}") from error
    fx, fy = mirror.surface.gradient(x, y)
    # The normal is along (-fx, -fy, 1).
    J = np.array([[1.0, 0.0, fx], [0.0, 1.0, fy]])
    rotation = np.array([mirror.rotate_deck_from_world(axis) for axis in _WORLD_AXES]).T
    onto = J.dot(rotation)
    covariance: FloatArray = onto.dot(np.array(fix.covariance_m2, dtype=np.float64).reshape(3, 3)).dot(onto.T)
    if not (covariance[0, 0] > 0.0 and np.linalg.det(covariance) > 0.0):
        raise FixRefused(f"fix has the covariance {covariance.ravel().tolist()} m^2 along the surface")
    return DeckFoot(x, y, covariance, deviation)


_UNKNOWN_SPEEDS = 0.1**2, 0.5**2, 1.0**2  # variances of v, a, w when they are not known


def fix_row(z: FloatArray, mean: FloatArray, slope: Slope, late_s: float) -> tuple[FloatArray, FloatArray]:
    """Residual (2,) and H (2, n) of a deck position ``z`` (2,), m, for a state ``late_s`` later; V and W constant."""
    H = np.zeros((2, STATES))
    H[0, X] = H[1, Y] = H[0, TX] = H[1, TY] = 1.0
    residual = z - mean[POSITION] - mean[TILT]
    if late_s == 0.0:
        return residual, H
    v, w = float(mean[V]), float(mean[W])
    hx, hy, lx, ly = axes_on(slope, float(mean[PSI]) - 0.5 * w * late_s)
    way = v * late_s
    H[:, PSI] = -way * lx, -way * ly
    H[:, V] = -late_s * hx, -late_s * hy
    H[:, W] = -0.5 * late_s * H[:, PSI]
    return residual + way * np.array((hx, hy)), H


def relocated(
    mean: FloatArray,
    covariance: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
    tilt_variance_m2: float,
    heading_variance_rad2: float,
    *,
    is_lost: bool,
) -> tuple[FloatArray, FloatArray]:
    """Mean (n,) and covariance (n, n) after the correction of a wrong position; the wheel angles begin at zero.

    The heading keeps its value, with a larger variance. ``residual`` (2,) and ``variance`` (2, 2), m^2: of the
    position; ``tilt_variance_m2``: of the puck's place by the panel's tilt; ``is_lost``: reset the speeds, too.
    """
    x, P = mean.copy(), covariance.copy()
    heading_rad2 = float(P[PSI, PSI]) + heading_variance_rad2
    for states in (POSE, ANGLES, TILT, *([SPEEDS] if is_lost else [])):
        P[states, :] = P[:, states] = 0.0
    P[POSITION, POSITION], P[PSI, PSI] = variance, heading_rad2
    P[[X, Y, TX, TY], [X, Y, TX, TY]] += tilt_variance_m2
    P[[X, Y, TX, TY], [TX, TY, X, Y]] -= tilt_variance_m2
    x[POSITION] += residual + x[TILT]
    x[ANGLES] = x[TILT] = 0.0
    if is_lost:
        x[SPEEDS] = 0.0
        P[SPEEDS, SPEEDS] = np.diag(_UNKNOWN_SPEEDS)
    return x, P
