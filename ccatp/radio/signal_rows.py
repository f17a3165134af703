"""Pure. What levels and bearings should be, with their derivatives by pose, place of the radio and shadowing."""

from collections.abc import Callable, Sequence
from math import atan2, hypot, log, log10
from typing import NamedTuple

import numpy as np

from ccatp.angles import wrap_pi
from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import Columns, columns_of
from ccatp.radio.motion import POSE
from ccatp.radio.path_loss import PathLoss
from ccatp.radio.readings import RssiReading

PLACE = 2  # x_m, y_m: the first states of a radio
_NEAREST_M = 0.02  # nearer than that neither level nor bearing has a derivative worth the name
_DB_PER_NEPER = 10.0 / log(10.0)

Linearise = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


class Sight(NamedTuple):
    """One reading, and where its states stand.

    Attributes:
        reading: level, and bearing where there is one.
        pose: first column of the pose it was taken at.
        shadow: derivatives of the level by the shadowing states, which end the radio's block, shape (k,).
        level_variance: of the level, dB^2.
    """

    reading: RssiReading
    pose: int
    shadow: FloatArray
    level_variance: float


class Rows(NamedTuple):
    """Rows of an update.

    Attributes:
        columns: of the state that they touch.
        linearise: state (n,) to residuals (m,) and derivatives (m, k).
        variances: of the noise, shape (m,).
    """

    columns: Columns
    linearise: Linearise
    variances: FloatArray


def rows_of(sights: Sequence[Sight], radio: slice, path_loss: PathLoss, bearing_sigma_rad: float) -> Rows:
    """The rows of readings of one radio, taken at one pose or several.

    z = P_ref - 10 eta log10(r) + b,  beta = atan2(dy, dx) - heading (Auth and Hovey 2018, eqs 2.3 and 2.9).

    Args:
        sights: the readings.
        radio: its block in the state.
        path_loss: its calibration.
        bearing_sigma_rad: noise and steps of a bearing.
    """
    poses = sorted({sight.pose for sight in sights})
    at = {pose: POSE * i for i, pose in enumerate(poses)}
    columns = columns_of(*(range(pose, pose + POSE) for pose in poses), radio)
    variances: list[float] = []
    for sight in sights:
        variances.append(sight.level_variance)
        if sight.reading.bearing_rad is not None:
            variances.append(bearing_sigma_rad**2)
    first = POSE * len(poses)

    def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        values = x.take(columns)
        residuals, H = np.zeros(len(variances)), np.zeros((len(variances), columns.size))
        row = 0
        for sight in sights:
            row = _fill(sight, values, at[sight.pose], first, path_loss, residuals, H, row)
        return residuals, H

    return Rows(columns, linearise, np.array(variances))


def _fill(
    sight: Sight, values: FloatArray, pose: int, radio: int, path_loss: PathLoss, residuals: FloatArray, H: FloatArray,
    row: int,
) -> int:  # fmt: skip
    """Residual and derivatives of one reading from a row on; the next free row."""
    x, y, heading = values[pose : pose + POSE].tolist()
    dx, dy = (values[radio : radio + PLACE] - (x, y)).tolist()
    r = max(hypot(dx, dy), _NEAREST_M)
    q = r * r
    shadow = sight.shadow
    states = values[values.size - shadow.size :]
    expected = path_loss.reference_dbm - 10.0 * path_loss.exponent * log10(r) + float(shadow @ states)
    residuals[row] = sight.reading.rssi_dbm - expected
    slope = _DB_PER_NEPER * path_loss.exponent / q
    H[row, pose : pose + PLACE] = slope * dx, slope * dy
    H[row, radio : radio + PLACE] = -slope * dx, -slope * dy
    H[row, H.shape[1] - shadow.size :] = shadow
    bearing_rad = sight.reading.bearing_rad
    if bearing_rad is None:
        return row + 1
    residuals[row + 1] = wrap_pi(bearing_rad - (atan2(dy, dx) - heading))
    H[row + 1, pose : pose + POSE] = dy / q, -dx / q, -1.0
    H[row + 1, radio : radio + PLACE] = -dy / q, dx / q
    return row + 2
