"""Measurement models with their derivatives: ranges, bearings, signal strengths.

``range_row``, ``bearing_row`` and ``level_row`` compute one reading with ``math``, or all readings of a run with
``numpy``.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ccatp.beacons.config.models import PriorsConfig, RadioNoiseConfig
from ccatp.beacons.estimation.level_fix import grid_points
from ccatp.beacons.estimation.motion import estimated
from ccatp.beacons.estimation.path_loss import PathLoss
from ccatp.beacons.estimation.recording import BeaconId, Reading
from ccatp.core import FloatArray

ANTENNA, HEIGHT_M2 = ("antenna_ahead_m", "antenna_left_m"), "beacon_height_m2"  # calibration of the installation
DB = 10.0 / math.log(10.0)
RAISED = 3  # states of a beacon placed by ranges, with the square of its height
LOWEST = 0.25  # smallest share of the squared distance in the plane that a negative square of a height leaves
NEAREST_M2 = 1e-6  # added to squared distances: at a beacon a range has no direction


def range_row(xp: ModuleType, dx: Any, dy: Any, scale: Any, height_m2: Any = 0.0) -> tuple[Any, Any, Any, Any, Any]:
    """(1 + e) r to a beacon, r^2 = dx^2 + dy^2 + v, and its derivatives by dx, dy, v and e.

    ``scale``: 1 + e. ``height_m2``: v, the square of the beacon's height over the antenna. Errors may make its estimate
    negative: r is at least half the distance in the plane.
    """
    flat = dx * dx + dy * dy + NEAREST_M2
    square, least = flat + height_m2, LOWEST * flat
    is_least = 1.0 * (square < least)
    r = xp.sqrt(square + is_least * (least - square))
    along = scale * (1.0 - (1.0 - LOWEST) * is_least)
    return scale * r, along * dx / r, along * dy / r, 0.5 * scale / r * (1.0 - is_least), r


def bearing_row(xp: ModuleType, dx: Any, dy: Any) -> tuple[Any, Any, Any]:
    """Direction of (dx, dy) in the frame of the map, and its derivatives."""
    q = dx * dx + dy * dy + NEAREST_M2
    return xp.atan2(dy, dx), -dy / q, dx / q


def level_row(xp: ModuleType, dx: Any, dy: Any, reference: Any, exponent: Any) -> tuple[Any, Any, Any, Any]:
    """P_ref - 10 eta log10(r / 1 m), its derivatives by dx, dy and eta (Hevrdejs and Knoll 2017, eq. 4)."""
    q = dx * dx + dy * dy + NEAREST_M2
    by_exponent, slope = -5.0 * xp.log10(q), -DB * exponent / q
    return reference + exponent * by_exponent, slope * dx, slope * dy, by_exponent


def range_variance(radio: RadioNoiseConfig, range_m: Any) -> Any:
    """Variance of a range, m^2: sigma^2 + sigma_per_m^2 r^2."""
    return radio.range_sigma_m**2 + radio.range_sigma_per_m**2 * range_m * range_m


class MeasurementRow(msgspec.Struct, gc=False):
    """One scalar of a reading."""

    expected: float  # h(x), in the reading's unit
    pose: tuple[float, float, float]  # derivatives of h by x_m, y_m and heading_rad of the vehicle
    calibration: tuple[float, ...]  # derivatives by the estimated calibration that all readings share
    beacon: tuple[float, ...]  # derivatives by the states of the beacon
    variance: float


class MeasurementRows(NamedTuple):
    """One scalar of each of m readings: the fields of ``MeasurementRow``, stacked."""

    expected: FloatArray  # shape (m,)
    pose: FloatArray  # shape (m, 3)
    calibration: FloatArray  # shape (m, c)
    beacon: FloatArray  # shape (m, b)
    variance: FloatArray  # shape (m,)


class MeasurementModel(ABC):
    """One kind of reading. ``extra_prior``: mean and standard deviation of a beacon's states after x and y."""

    extra_prior: tuple[tuple[float, float], ...] = ()

    @abstractmethod
    def row(self, pose: list[float], calibration: list[float], beacon: list[float], name: BeaconId) -> MeasurementRow:
        """Expected value, derivatives and noise variance at a state."""

    def rows(self, poses: FloatArray, calibration: list[float], beacons: FloatArray, name: BeaconId) -> MeasurementRows:
        """As ``row``, of readings of one beacon at m poses, (m, 3), and m states of the beacon, (m, b)."""
        states = zip(poses.tolist(), beacons.tolist(), strict=True)
        found = [self.row(pose, calibration, beacon, name) for pose, beacon in states]
        columns = ([getattr(row, name) for row in found] for name in MeasurementRows._fields)
        return MeasurementRows(*map(np.array, columns))

    def distance_m(self, z: float, _name: BeaconId) -> float:
        """Distance that corresponds to a reading."""
        return max(z, 1e-3)


class RangeModel(MeasurementModel):
    """z = (1 + e) r + o, with scale e and offset o shared by all beacons, each estimated if its prior is not zero.

    A third state of a beacon is the square of its height over the antenna.
    """

    def __init__(self, radio: RadioNoiseConfig, priors: PriorsConfig) -> None:
        self._radio = radio
        self._has_scale, self._has_offset = priors.range_scale > 0.0, priors.range_offset_m > 0.0
        calibrated = {"range_scale": priors.range_scale, "range_offset_m": priors.range_offset_m}
        self.names, self.prior_sigmas = estimated(calibrated)

    def row(self, pose: list[float], calibration: list[float], beacon: list[float], name: BeaconId) -> MeasurementRow:
        """The range."""
        x_m, y_m, *height_m2 = beacon[: RAISED if len(beacon) == RAISED else 2]
        scale, offset = self._calibrated(calibration)
        expected, ux, uy, by_height, r = range_row(math, x_m - pose[0], y_m - pose[1], scale, *height_m2)
        by = (r,) * self._has_scale + (1.0,) * self._has_offset
        by_beacon = (ux, uy, *(by_height,) * len(height_m2))
        return MeasurementRow(expected + offset, (-ux, -uy, 0.0), by, by_beacon, range_variance(self._radio, r))

    def rows(self, poses: FloatArray, calibration: list[float], beacons: FloatArray, name: BeaconId) -> MeasurementRows:
        """The ranges, all at once. Roots and the four operations give the same bits in NumPy as in ``math``."""
        scale, offset = self._calibrated(calibration)
        states = RAISED if beacons.shape[1] == RAISED else 2
        x_m, y_m, *height_m2 = beacons.T[:states]
        expected, *by_beacon, r = range_row(np, x_m - poses[:, 0], y_m - poses[:, 1], scale, *height_m2)
        towards, by_pose = np.empty((r.size, states)), np.zeros((r.size, 3))
        for state, slope in enumerate(by_beacon[:states]):
            towards[:, state] = slope
        by_pose[:, :2] = -towards[:, :2]
        by = np.ones((r.size, self._has_scale + self._has_offset))
        if self._has_scale:
            by[:, 0] = r
        return MeasurementRows(expected + offset, by_pose, by, towards, range_variance(self._radio, r))

    def _calibrated(self, calibration: list[float]) -> tuple[float, float]:
        """1 + e and o."""
        return 1.0 + calibration[0] if self._has_scale else 1.0, calibration[-1] if self._has_offset else 0.0


class BearingModel(MeasurementModel):
    """beta = atan2(dy, dx) - heading."""

    def __init__(self, sigma_rad: float, shared: int) -> None:
        self._variance, self._shared = sigma_rad**2, (0.0,) * shared

    def row(self, pose: list[float], calibration: list[float], beacon: list[float], name: BeaconId) -> MeasurementRow:
        """The bearing."""
        direction, gx, gy = bearing_row(math, beacon[0] - pose[0], beacon[1] - pose[1])
        by_beacon = (gx, gy, *(0.0,) * (len(beacon) - 2))
        return MeasurementRow(direction - pose[2], (-gx, -gy, -1.0), self._shared, by_beacon, self._variance)


class LevelModel(MeasurementModel):
    """z = P_ref - 10 eta log10(r / 1 m) + b (Hevrdejs and Knoll 2017, eq. 4; Auth and Hovey 2018, eq. 2.3).

    States of each beacon after x and y: P_ref and eta, each if its prior is not zero, and the states of the
    static shadowing b, if there is a map of it.
    """

    def __init__(
        self, loss_of: Callable[[BeaconId], PathLoss], reference_sigma_db: float = 0.0, exponent_sigma: float = 0.0,
        shadowing: "ShadowingMap | None" = None, shared: int = 0,
    ) -> None:  # fmt: skip
        self._loss_of, self._shadowing, self._shared = loss_of, shadowing, (0.0,) * shared
        self._has_reference, self._has_exponent = reference_sigma_db > 0.0, exponent_sigma > 0.0
        loss = loss_of("")
        states = ((loss.reference_dbm, reference_sigma_db), (loss.exponent, exponent_sigma))
        self.extra_prior = tuple((mean, sigma) for mean, sigma in states if sigma > 0.0)
        if shadowing is not None:
            self.extra_prior += ((0.0, 1.0),) * shadowing.size

    def row(self, pose: list[float], calibration: list[float], beacon: list[float], name: BeaconId) -> MeasurementRow:
        """The signal strength."""
        reference, exponent, sigma_db = self._loss_of(name)
        at = 2
        if self._has_reference:
            reference, at = beacon[at], at + 1
        if self._has_exponent:
            exponent, at = beacon[at], at + 1
        expected, gx, gy, by_exponent = level_row(math, beacon[0] - pose[0], beacon[1] - pose[1], reference, exponent)
        tail, variance = (1.0,) * self._has_reference + (by_exponent,) * self._has_exponent, sigma_db**2
        if self._shadowing is not None:
            field, rest_db2 = self._shadowing.row(pose[0], pose[1])
            expected += float(field.dot(beacon[at:]))
            tail += tuple(field.tolist())
            variance += rest_db2
        return MeasurementRow(expected, (-gx, -gy, 0.0), self._shared, (gx, gy, *tail), variance)

    def distance_m(self, z: float, name: BeaconId) -> float:
        """Median distance for a level: half of such distances are too long."""
        return self._loss_of(name).median_range_m(z)


class ShadowingMap:
    """Kriging of a Gaussian field with covariance sigma^2 exp(-d / L) (Gudmundson 1991) from its values at grid points.

    The field at a place is k^T C^-1 f + rest, with f the values at the points, C their covariance, and k the
    covariances between place and points. The rest has the variance sigma^2 - k^T C^-1 k and is treated as white noise.
    The states are w = R^-1 f with C = R R^T, so their prior covariance is the identity, and the row of a place is
    k^T R^-T. ``spacing_m``: between grid points; the outermost ones lie on the walls. ``sigma_db``: sigma.
    ``length_m``: L.
    """

    def __init__(self, size_m: tuple[float, float], spacing_m: float, sigma_db: float, length_m: float) -> None:
        self._points = grid_points((0.0, 0.0), size_m, spacing_m)
        self._variance, self._length_m = sigma_db**2, length_m
        offsets = self._points[:, None] - self._points[None, :]
        root = np.linalg.cholesky(self._covariance(np.hypot(offsets[..., 0], offsets[..., 1])))
        self._inverse_root: FloatArray = np.linalg.inv(root)

    @property
    def size(self) -> int:
        """Number of states."""
        return len(self._points)

    def row(self, x_m: float, y_m: float) -> tuple[FloatArray, float]:
        """Derivatives of the field at a place by the states, shape (size,), and variance of the rest, dB^2."""
        row = self._inverse_root @ self._covariance(np.hypot(*(self._points - (x_m, y_m)).T))
        return row, max(self._variance - float(row @ row), 0.0)

    def _covariance(self, distance_m: FloatArray) -> FloatArray:
        return np.asarray(self._variance * np.exp(-distance_m / self._length_m))


class MeasurementModels(NamedTuple):
    """The models by kind of reading, and their shared calibration."""

    by_kind: Mapping[str, MeasurementModel]
    names: tuple[str, ...] = ()  # of the estimated calibration
    prior_sigmas: tuple[float, ...] = ()


def recorded_models(radio: RadioNoiseConfig, priors: PriorsConfig) -> MeasurementModels:
    """Models for a recorded run; P_ref and exponent are estimated for each beacon if their priors are not zero."""
    ranges = RangeModel(radio, priors)
    shared = len(ranges.names)
    loss = PathLoss(radio.rssi_reference_dbm, radio.rssi_exponent, radio.rssi_sigma_db)
    reference_sigma_db = math.hypot(priors.rssi_reference_db, priors.beacon_reference_db)
    levels = LevelModel(lambda _: loss, reference_sigma_db, priors.rssi_exponent, shared=shared)
    by_kind: dict[str, MeasurementModel] = {
        "range": ranges,
        "bearing": BearingModel(radio.bearing_sigma_rad, shared),
        "rssi": levels,
    }
    return MeasurementModels(by_kind, ranges.names, ranges.prior_sigmas)


def is_direction(reading: Reading) -> bool:
    """Whether the reading has neither range nor signal strength."""
    return math.isnan(reading.range_m) and math.isnan(reading.rssi_dbm)


def scalars_of(reading: Reading) -> list[tuple[str, float]]:
    """Values of a reading, each with its kind: the bearing, then the range, then the signal strength, if present."""
    found = [] if reading.bearing_rad is None else [("bearing", reading.bearing_rad)]
    if not math.isnan(reading.range_m):
        found.append(("range", reading.range_m))
    if not math.isnan(reading.rssi_dbm):
        found.append(("rssi", reading.rssi_dbm))
    return found
