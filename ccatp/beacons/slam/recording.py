"""Recorded runs and readings in the units and the order that estimators want, and what estimators make of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ccatp.core import FloatArray, IntArray

BoolArray = npt.NDArray[np.bool_]


class Steps(NamedTuple):
    """Dead reckoning, one step a row: step k carries the vehicle from times_s[k] to times_s[k + 1].

    ``guess_m2``: variance of the end of a step, along and across, where the odometry was silent and the way is guessed,
    m^2, shape (n,); 0.0: none is.
    """

    times_s: FloatArray  # where steps begin and end, s, shape (n + 1,), rising
    distance_m: FloatArray  # forward travel within a step, m, shape (n,)
    turn_rad: FloatArray  # turn within a step, counter-clockwise, rad, shape (n,)
    lateral_m: FloatArray  # travel to the left within a step, m, shape (n,); zeros for wheels that do not slip
    guess_m2: FloatArray | float = 0.0
    guess_rad2: FloatArray | float = 0.0  # the same of its turn, rad^2


class Readings(NamedTuple):
    """Readings of beacons, one a row, in order of time."""

    times_s: FloatArray  # shape (m,), s, rising
    beacon: IntArray  # index into ``RecordedRun.beacon_ids``, shape (m,)
    range_m: FloatArray  # shape (m,), m; NaN where none was measured
    bearing_rad: FloatArray  # from the heading, counter-clockwise, rad, shape (m,); NaN where none was measured
    rssi_dbm: FloatArray  # signal strength, dBm, shape (m,); NaN where none was measured

    def where(self, rows: BoolArray | IntArray) -> "Readings":
        """Some of the readings."""
        return Readings(
            self.times_s[rows], self.beacon[rows], self.range_m[rows], self.bearing_rad[rows], self.rssi_dbm[rows]
        )

    def with_distances(self, camera_field_rad: float) -> "Readings":
        """The readings of a camera that ranges by apparent height, with distances in place of depths.

        On a rectified image the height falls with the depth along the axis, r cos(bearing). ``camera_field_rad``: half
        the field of view, over which such ranges are right in the mean; 0: ranges are distances, as they are where most
        bearings lie outside the field.
        """
        off_axis = np.abs(self.bearing_rad)
        seen = off_axis < 0.5 * np.pi
        if camera_field_rad <= 0.0 or not seen.any() or np.nanmedian(off_axis) > camera_field_rad:
            return self
        mean = np.sin(camera_field_rad) / camera_field_rad  # of the cosine over the field
        distances_m = self.range_m * mean / np.cos(self.bearing_rad, where=seen, out=np.ones(len(seen)))
        return self._replace(range_m=np.where(seen, distances_m, self.range_m))


class ReferencePath(NamedTuple):
    """Where the vehicle was, world frame."""

    times_s: FloatArray  # shape (k,), s, rising
    x_m: FloatArray  # shape (k,), m
    y_m: FloatArray  # shape (k,), m
    heading_rad: FloatArray  # shape (k,), rad, continuous; NaN where the reference saw positions alone


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """One vehicle's run among beacons.

    ``beacon_truth_m``: surveyed x, y by name, world frame, m; beacons that were not surveyed are missing.
    ``first_pose``: x_m, y_m, heading_rad at the first odometry time, world frame: the one thing that an estimator may
    take from the truth; the origin if there is no truth.
    """

    name: str
    kind: str  # format that it was read from: plaza, mrclam, labyrinth or csv
    steps: Steps
    readings: Readings
    beacon_ids: tuple[str, ...]
    beacon_truth_m: Mapping[str, tuple[float, float]]
    truth: ReferencePath | None
    first_pose: tuple[float, float, float]
    warnings: tuple[str, ...]
    antenna_m: tuple[float, float] = (0.0, 0.0)  # ahead and left of the vehicle's origin; poses are the antenna's


def running_total(amounts: FloatArray) -> FloatArray:
    """0, and the sums of the first amounts (n,), shape (n + 1,)."""
    return np.concatenate([[0.0], np.cumsum(amounts)])


def dead_reckoned(steps: Steps, first_pose: tuple[float, float, float]) -> FloatArray:
    """Poses x_m, y_m, heading_rad at ``steps.times_s`` by odometry alone, shape (n + 1, 3).

    Each step is a chord at the mean heading: x <- x + d cos(heading + turn / 2), thesis eq. 2.14 as it is meant.
    """
    x_m, y_m, heading_rad = first_pose
    headings = heading_rad + running_total(steps.turn_rad)
    middle = headings[:-1] + 0.5 * steps.turn_rad
    c, s = np.cos(middle), np.sin(middle)
    dx, dy = steps.distance_m * c - steps.lateral_m * s, steps.distance_m * s + steps.lateral_m * c
    return np.column_stack([x_m + running_total(dx), y_m + running_total(dy), headings])


def antenna_path(poses: FloatArray, antenna_m: tuple[float, float], sign: float = 1.0) -> FloatArray:
    """Positions of the antenna at poses of the vehicle, (n, 2); with the other sign, of the vehicle at the antenna's.

    ``poses``: x_m, y_m, heading_rad, shape (n, 3).
    """
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    ahead_m, left_m = antenna_m
    lever = np.column_stack([c * ahead_m - s * left_m, s * ahead_m + c * left_m])
    return np.asarray(poses[:, :2] + sign * lever)


class BeaconFix(NamedTuple):
    """A beacon on the map."""

    x_m: float
    y_m: float
    covariance: FloatArray  # of x_m, y_m, shape (2, 2)


class Calibrated(NamedTuple):
    """A quantity found on the way."""

    value: float
    sigma: float


class DelayedPath(NamedTuple):
    """Where the vehicle was, from readings up to ``lag_s`` later; the last poses from those that there were."""

    lag_s: float
    times_s: FloatArray  # shape (n,), rising
    poses: FloatArray  # x_m, y_m, heading_rad, shape (n, 3)
    covariances: FloatArray  # shape (n, 3, 3)


class EstimatedPath(NamedTuple):
    """An estimate of a run.

    ``nis``: normalised innovations squared of the readings that were used, shape (u,); none from a smoother.
    ``update_s``: wall time of each reading, the prediction to it included, s; of a smoother its whole time shared among
    the readings. ``scalar_s``: wall time of each scalar of a reading of a beacon on the map, s, without prediction;
    none from a smoother.
    """

    times_s: FloatArray  # shape (n,), rising
    poses: FloatArray  # x_m, y_m, heading_rad, shape (n, 3)
    covariances: FloatArray  # of the poses, shape (n, 3, 3)
    beacons: Mapping[str, BeaconFix]
    calibration: Mapping[str, Calibrated]
    refused: int  # how many readings were refused, or weigh less than a tenth
    updates: int
    warnings: tuple[str, ...]
    nis: FloatArray = np.empty(0)
    nis_sizes: FloatArray = np.empty(0)  # their degrees of freedom, shape (u,)
    update_s: FloatArray = np.empty(0)
    predict_s: FloatArray = np.empty(0)  # wall time of each prediction, s; none from a smoother
    scalar_s: FloatArray = np.empty(0)
    delayed: DelayedPath | None = None
    map_covariance: FloatArray = np.empty((0, 0))  # of all beacons' x_m, y_m in their order, shape (2 b, 2 b)


BeaconId = int | str


class Reading(NamedTuple):
    """What was measured of a beacon at once: a range or a signal strength, a direction alone, or both."""

    time_s: float
    beacon: BeaconId
    range_m: float = nan  # as it was measured, scale error, offset and all
    bearing_rad: float | None = None  # from the vehicle's heading, counter-clockwise; None without a direction
    rssi_dbm: float = nan


class BeaconEstimate(NamedTuple):
    """A beacon on the map, or what is known of it before its readings."""

    mean: FloatArray  # x_m, y_m and what else is estimated of it (reference_dbm, exponent, shadowing), shape (b,)
    covariance: FloatArray  # shape (b, b)
