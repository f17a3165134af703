"""Pure. A beacon that has just joined, conditioned on what was heard of it, at the places where that was heard."""

import numpy as np

from ccatp.angles import wrap_pi
from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import Columns, EkfSlam, Update, columns_of
from ccatp.radio.dead_reckoning import Carried
from ccatp.radio.joining import Record, RowOf
from ccatp.radio.motion import POSE
from ccatp.radio.sightings import Row, strength_of

LINEARISATIONS = 8
"""At most; Gauss-Newton on readings that a beacon joined by comes to rest within five."""


def settle_by_places(
    engine: EkfSlam, records: list[Record], row_of: RowOf, shared: slice, block: slice, variances: FloatArray
) -> Update:
    """Condition a beacon, the places where it was heard, the calibration and all else on the readings, iterated.

    Args:
        engine: holds the places, and the beacon with an all but flat prior at its candidate.
        records: readings and their places.
        row_of: what a reading should be.
        shared: the calibration's place in the state.
        block: the beacon's.
        variances: of the readings, shape (m,).
    """
    places = [engine.block(record.place) for record in records]
    columns = columns_of(*places, shared, block)
    z = [strength_of(record.reading) for record in records]
    m, c = len(z), shared.stop - shared.start

    def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        residual, H = np.zeros(m), np.zeros((m, columns.size))
        calibration, beacon = x[shared].tolist(), x[block].tolist()
        for i, (record, place) in enumerate(zip(records, places, strict=True)):
            row = row_of(record.reading, [*x[place].tolist(), 0.0], calibration, beacon)
            residual[i] = z[i] - row.expected
            H[i, 2 * i : 2 * i + 2] = row.pose[:2]
            H[i, 2 * m : 2 * m + len(row.calibration)] = row.calibration
            H[i, 2 * m + c :] = row.beacon
        return residual, H

    return engine.update_iterated(columns, linearise, variances, LINEARISATIONS)


def derivatives(row: Row, at: Carried, *, delayed: bool) -> list[float]:
    """Dh by the pose and the calibration of the state: a row at the pose that was carried to a reading's time."""
    hx, hy, turned = row.pose
    if not delayed and at.back_s == 0.0:
        return [hx, hy, turned, *row.calibration]
    vx, vy, turn = at.velocity
    by_heading = at.back_s * (hx * vy - hy * vx)
    found = [hx, hy, turned + by_heading, *row.calibration]
    if delayed:  # the heading turns at ``turn``, too
        found.append(-hx * vx - hy * vy - turn * (turned + by_heading))
    return found


def wrapped(z: float, expected: float, *, is_angle: bool) -> float:
    """Residual z - h(x), the short way round for angles."""
    return wrap_pi(z - expected) if is_angle else z - expected


def pose_columns(shared: slice, block: slice) -> Columns:
    """Columns of pose, calibration and a beacon."""
    return columns_of(slice(0, POSE), shared, block)
