"""Pure. What an estimator says of a recorded run: the path, the map, the calibration, each with its uncertainty."""

from collections.abc import Mapping
from typing import NamedTuple

from ccatp.filters.base import FloatArray


class BeaconFix(NamedTuple):
    """A beacon on the map.

    Attributes:
        x_m: place.
        y_m: place.
        covariance: of x_m, y_m, shape (2, 2).
    """

    x_m: float
    y_m: float
    covariance: FloatArray


class Calibrated(NamedTuple):
    """A quantity found on the way.

    Attributes:
        value: positive where the sensor reads too much.
        sigma: its standard deviation.
    """

    value: float
    sigma: float


class Track(NamedTuple):
    """An estimate of a run.

    Attributes:
        times_s: shape (n,), rising.
        poses: x_m, y_m, heading_rad, shape (n, 3).
        covariances: of the poses, shape (n, 3, 3).
        beacons: the map, by name.
        calibration: what was calibrated on the way, by name.
        nis: normalised innovations squared of the readings that were used, shape (u,); none from a smoother.
        nis_sizes: their degrees of freedom, shape (u,).
        refused: how many readings were refused, or weigh less than a tenth.
        update_s: wall time of each reading, the prediction to it included, s; of a smoother its whole time shared among
            the readings.
        predict_s: wall time of each prediction, s; none from a smoother.
        scalar_s: wall time of each scalar of a reading of a beacon on the map, s, without prediction; none from a
            smoother.
        updates: how many readings were used.
        warnings: what is doubtful, a line each.
    """

    times_s: FloatArray
    poses: FloatArray
    covariances: FloatArray
    beacons: Mapping[str, BeaconFix]
    calibration: Mapping[str, Calibrated]
    nis: FloatArray
    nis_sizes: FloatArray
    refused: int
    update_s: FloatArray
    predict_s: FloatArray
    scalar_s: FloatArray
    updates: int
    warnings: tuple[str, ...]
