"""Recorded runs and readings in SI units and order of time, and the results of the estimators."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ccatp.core import FloatArray, IntArray

BoolArray = npt.NDArray[np.bool_]


class Steps(NamedTuple):
    """Dead reckoning, one step a row: step k carries the vehicle from times_s[k] to times_s[k + 1].

    ``guess_m2``: variance of the end of a step, along and across, if the odometry was missing and the motion is
    guessed, m^2, shape (n,); 0.0: no step is guessed.
    """

    times_s: FloatArray  # times at which steps begin and end, s, shape (n + 1,), rising
    distance_m: FloatArray  # forward travel within a step, m, shape (n,)
    turn_rad: FloatArray  # turn within a step, counter-clockwise, rad, shape (n,)
    lateral_m: FloatArray  # travel to the left within a step, m, shape (n,); zeros for wheels that do not slip
    guess_m2: FloatArray | float = 0.0
    guess_rad2: FloatArray | float = 0.0  # variance of its turn, in the same case, rad^2


class Radio(NamedTuple):
    """One of several radios of a vehicle, a tag."""

    name: str
    ahead_m: float  # of the point whose path is estimated
    left_m: float


class Readings(NamedTuple):
    """Readings of beacons, one a row, in order of time."""

    times_s: FloatArray  # shape (m,), s, rising
    beacon: IntArray  # index into ``RecordedRun.beacon_ids``, shape (m,)
    range_m: FloatArray  # shape (m,), m; NaN where none was measured
    bearing_rad: FloatArray  # from the heading, counter-clockwise, rad, shape (m,); NaN where none was measured
    rssi_dbm: FloatArray  # signal strength, dBm, shape (m,); NaN where none was measured
    # Of a vehicle with several radios (tags), else None: which of ``RecordedRun.tags`` each reading is of, shape (m,),
    # and where that is on the vehicle: ahead and left of the point whose path is estimated, m, shape (m, 2).
    tag: IntArray | None = None
    arm_m: FloatArray | None = None

    def where(self, rows: BoolArray | IntArray) -> "Readings":
        """The readings of a mask or of indices."""
        return Readings(
            self.times_s[rows], self.beacon[rows], self.range_m[rows], self.bearing_rad[rows], self.rssi_dbm[rows],
            None if self.tag is None else self.tag[rows], None if self.arm_m is None else self.arm_m[rows],
        )  # fmt: skip

    def heard(self, beacons: int) -> IntArray:
        """The pair of radio and beacon of each reading as a number, shape (m,): that of the beacon for one radio."""
        return self.beacon if self.tag is None else self.beacon + beacons * self.tag

    def radios_at(self, poses: FloatArray) -> FloatArray:
        """Where the radio of each reading is, x_m, y_m, shape (m, 2), for poses of the vehicle (m, 3)."""
        return np.asarray(poses[:, :2]) if self.arm_m is None else antenna_path(poses, self.arm_m)

    def with_distances(self, camera_field_rad: float) -> "Readings":
        """The readings of a camera that measures ranges by apparent height, with distances instead of depths.

        On a rectified image the height depends on the depth along the axis, r cos(bearing). Ranges are taken as
        calibrated in the mean over the field: r = depth f / cos(bearing), f the mean cosine. ``camera_field_rad``: half
        the field of view; 0: ranges are distances. They are not changed either if most bearings lie outside the field.
        """
        off_axis = np.abs(self.bearing_rad)
        seen = off_axis < 0.5 * np.pi
        if camera_field_rad <= 0.0 or not seen.any() or np.nanmedian(off_axis) > camera_field_rad:
            return self
        mean = np.sin(camera_field_rad) / camera_field_rad  # f, the mean cosine over the field
        distances_m = self.range_m * mean / np.cos(self.bearing_rad, where=seen, out=np.ones(len(seen)))
        return self._replace(range_m=np.where(seen, distances_m, self.range_m))


class ReferencePath(NamedTuple):
    """Ground truth of the path, world frame."""

    times_s: FloatArray  # shape (k,), s, rising
    x_m: FloatArray  # shape (k,), m
    y_m: FloatArray  # shape (k,), m
    heading_rad: FloatArray  # shape (k,), rad, continuous; NaN if the reference measured positions alone


class KnownMap(NamedTuple):
    """Beacons whose places are known before the run, in the frame of the first pose."""

    names: tuple[str, ...]
    places_m: FloatArray  # x_m, y_m, shape (k, 2)
    covariance_m2: FloatArray  # of all x_m, y_m in their order, shape (2 k, 2 k)
    heights_m: FloatArray  # z_m, shape (k,); NaN where it is not known

    def of(self, names: Sequence[str]) -> "KnownMap":
        """The part of it that has some of these beacons, in their order."""
        rows = [self.names.index(name) for name in names if name in self.names]
        at = [2 * row + axis for row in rows for axis in range(2)]
        return KnownMap(
            tuple(self.names[row] for row in rows), self.places_m[rows], self.covariance_m2[np.ix_(at, at)],
            self.heights_m[rows],
        )  # fmt: skip


class Known(NamedTuple):
    """What is known of a run beside its recording."""

    map: KnownMap | None = None
    first_pose: tuple[float, float, float] | None = None  # of the vehicle: x_m, y_m, heading_rad
    moving: tuple[str, ...] = ()  # beacons that move


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """One vehicle's run among beacons.

    ``beacon_truth_m``: surveyed x, y by name, world frame, m; beacons that were not surveyed are missing.
    ``first_pose``: x_m, y_m, heading_rad at the first odometry time, world frame: the only part of the truth that an
    estimator may use; the origin if there is no truth. ``known_map``: of beacons in ``beacon_ids``; the others are
    mapped.
    """

    name: str
    kind: str  # format of the file: plaza, mrclam, labyrinth or csv
    steps: Steps
    readings: Readings
    beacon_ids: tuple[str, ...]
    beacon_truth_m: Mapping[str, tuple[float, float]]
    truth: ReferencePath | None
    first_pose: tuple[float, float, float]
    warnings: tuple[str, ...]
    antenna_m: tuple[float, float] = (0.0, 0.0)  # ahead and left of the vehicle's origin; poses are the antenna's
    known_map: KnownMap | None = None
    tags: tuple[Radio, ...] = ()  # the vehicle's radios, if the readings are of several: poses are the origin's then

    moving: tuple[str, ...] = ()  # of ``beacon_ids``: those that move
    levelled: tuple[str, ...] = ()  # those of known height: their ranges are in the plane of the antenna
    range_step_m: float = 0.0  # in which ranges come; 0: in none

    @property
    def raised(self) -> BoolArray:
        """Whether ranges can determine the heights of beacons over the antenna, shape (b,): not over several."""
        r, found = self.readings, np.array([name not in self.levelled for name in self.beacon_ids], dtype=bool)
        found[r.beacon[np.isnan(r.range_m) & np.isfinite(r.rssi_dbm)]] = False  # placed by levels
        return found & (not self.tags)

    @property
    def radios(self) -> Sequence[Radio | None]:
        """The radios as readings have them: ``None`` for the only one."""
        return self.tags or (None,)


def running_total(amounts: FloatArray) -> FloatArray:
    """Cumulative sums of amounts (n,), beginning with 0, shape (n + 1,)."""
    return np.concatenate([[0.0], np.cumsum(amounts)])


ROUNDING = 1e-3  # of an interval: times since 1970 in s have a resolution of 2e-7 s


def first_of_each(times_s: FloatArray, interval_s: float) -> IntArray:
    """Which of the rising times (n,) is the first one in each interval that has any, counted from the first time.

    A time that rounding puts before the boundary of an interval belongs to it, so the result is the same in any epoch.
    """
    if not times_s.size:
        return np.empty(0, dtype=np.int64)
    _, first = np.unique(np.floor((times_s - times_s[0]) / interval_s + ROUNDING), return_index=True)
    return first


def dead_reckoned(steps: Steps, first_pose: tuple[float, float, float]) -> FloatArray:
    """Poses x_m, y_m, heading_rad at ``steps.times_s`` by odometry alone, shape (n + 1, 3).

    Each step is a straight line at the mean heading: x <- x + d cos(heading + turn / 2), thesis eq. 2.14, corrected.
    """
    x_m, y_m, heading_rad = first_pose
    headings = heading_rad + running_total(steps.turn_rad)
    middle = headings[:-1] + 0.5 * steps.turn_rad
    c, s = np.cos(middle), np.sin(middle)
    dx, dy = steps.distance_m * c - steps.lateral_m * s, steps.distance_m * s + steps.lateral_m * c
    return np.column_stack([x_m + running_total(dx), y_m + running_total(dy), headings])


def antenna_path(poses: FloatArray, antenna_m: tuple[float, float] | FloatArray, sign: float = 1.0) -> FloatArray:
    """Antenna positions at poses of the vehicle, (n, 2); with ``sign`` -1, vehicle positions at poses of the antenna.

    ``poses``: x_m, y_m, heading_rad, shape (n, 3). ``antenna_m``: ahead and left, of one antenna, or shape (n, 2).
    """
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    ahead_m, left_m = np.asarray(antenna_m).T
    lever = np.column_stack([c * ahead_m - s * left_m, s * ahead_m + c * left_m])
    return np.asarray(poses[:, :2] + sign * lever)


class BeaconFix(NamedTuple):
    """A beacon on the map."""

    x_m: float
    y_m: float
    covariance: FloatArray  # of x_m, y_m, shape (2, 2)


class Calibrated(NamedTuple):
    """Estimated calibration parameter."""

    value: float
    sigma: float


class DelayedPath(NamedTuple):
    """Path estimated from readings up to ``lag_s`` later; the last poses from the readings up to the end of the run."""

    lag_s: float
    times_s: FloatArray  # shape (n,), rising
    poses: FloatArray  # x_m, y_m, heading_rad, shape (n, 3)
    covariances: FloatArray  # shape (n, 3, 3)


class ReadingInnovation(NamedTuple):
    """Innovation of one reading of a causal estimator."""

    time_s: float
    beacon: str
    nis: float
    size: int  # degrees of freedom
    is_used: bool
    tag: str = ""  # that read it, if there are several


class BeaconTrack(NamedTuple):
    """Where a beacon was, when it was read."""

    times_s: FloatArray  # shape (n,), rising
    places_m: FloatArray  # x_m, y_m, shape (n, 2)
    covariances_m2: FloatArray  # shape (n, 2, 2)


class EstimatedPath(NamedTuple):
    """An estimate of a run.

    ``nis``: normalised innovations squared of the readings that were used, shape (u,); empty from a smoother.
    ``update_s``: elapsed time of each reading with its prediction, s; for a smoother its whole time divided by the
    number of readings in use. ``scalar_s``: elapsed time of each scalar of a reading of a beacon on the map, s, without
    prediction; empty from a smoother.
    """

    times_s: FloatArray  # shape (n,), rising
    poses: FloatArray  # x_m, y_m, heading_rad, shape (n, 3)
    covariances: FloatArray  # of the poses, shape (n, 3, 3)
    beacons: Mapping[str, BeaconFix]
    calibration: Mapping[str, Calibrated]
    refused: int  # number of readings that were refused, or have a weight below a tenth
    updates: int  # number of the others, which were used
    warnings: tuple[str, ...]
    nis: FloatArray = np.empty(0)
    nis_sizes: FloatArray = np.empty(0)  # their degrees of freedom, shape (u,)
    update_s: FloatArray = np.empty(0)
    predict_s: FloatArray = np.empty(0)  # elapsed time of each prediction, s; empty from a smoother
    scalar_s: FloatArray = np.empty(0)
    delayed: DelayedPath | None = None
    map_covariance: FloatArray = np.empty((0, 0))  # of all beacons' x_m, y_m in their order, shape (2 b, 2 b)
    innovations: tuple[ReadingInnovation, ...] = ()  # of all readings of beacons on the map; empty from a smoother
    # Of beacons that move, which are not in ``beacons``, and of those placed again: where each was until then.
    tracks: Mapping[str, BeaconTrack] = MappingProxyType({})

    def calibrated(self, r: Readings, beacon_ids: Sequence[str]) -> Readings:
        """Readings of beacons by ``beacon_ids``, with calibrated ranges in the plane, from where the antenna is."""
        value = {name: one.value for name, one in self.calibration.items()}
        range_m = (r.range_m - value.get("range_offset_m", 0.0)) / (1.0 + value.get("range_scale", 0.0))
        heights_m2 = np.array([value.get(f"beacon_height_m2 {name}", 0.0) for name in beacon_ids])[r.beacon]
        flat_m = np.sqrt(np.maximum(range_m**2 - heights_m2, 0.0))
        arm_m = np.array((value.get("antenna_ahead_m", 0.0), value.get("antenna_left_m", 0.0)))
        if arm_m.any():
            r = r._replace(arm_m=np.broadcast_to(arm_m, (len(range_m), 2)) + (0.0 if r.arm_m is None else r.arm_m))
        return r._replace(range_m=np.where(heights_m2 == 0.0, range_m, flat_m))

    def poses_at(self, at_s: FloatArray) -> FloatArray:
        """Poses at other times, shape (m, 3), linear between two of its own."""
        return np.column_stack([np.interp(at_s, self.times_s, column) for column in self.poses.T])


BeaconId = int | str


class Reading(NamedTuple):
    """One reading of a beacon: a range or a signal strength, a bearing, or a bearing with one of them."""

    time_s: float
    beacon: BeaconId
    range_m: float = nan  # as measured, with errors of scale and offset
    bearing_rad: float | None = None  # from the vehicle's heading, counter-clockwise; None without a direction
    rssi_dbm: float = nan
    radio: Radio | None = None  # that heard it, of several; None: the only one, which is at the pose


class BeaconEstimate(NamedTuple):
    """Estimate of a beacon on the map, or its prior."""

    mean: FloatArray  # x_m, y_m and further states of the beacon (reference_dbm, exponent, shadowing), shape (b,)
    covariance: FloatArray  # shape (b, b)
