"""Pure. A vehicle among beacons that places them on a map while it finds itself on it: EKF-SLAM over readings."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import cos, sin
from typing import NamedTuple

import numpy as np

from ccatp.angles import wrap_pi
from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import Columns, EkfSlam, Update, columns_of
from ccatp.radio.joining import Waiting, widened
from ccatp.radio.motion import POSE, Odometry, Pose
from ccatp.radio.readings import BeaconId, RangeReading, Reading, RssiReading
from ccatp.radio.sightings import Row, bearing_row, range_row, rssi_row
from ccatp.radio.slam_settings import SlamSettings


@dataclass(frozen=True, slots=True)
class BeaconEstimate:
    """A beacon on the map.

    Attributes:
        mean: x_m, y_m and, where they are estimated, reference_dbm and exponent, shape (b,).
        covariance: shape (b, b).
    """

    mean: FloatArray
    covariance: FloatArray


class Learned(NamedTuple):
    """What one reading did: an ``Innovation`` with the beacon it came from.

    Attributes:
        beacon: which one.
        residual: z - h(x), shape (m,).
        nis: nu^T S^-1 nu.
        size: m.
        accepted: False where the gate refused it.
    """

    beacon: BeaconId
    residual: FloatArray
    nis: float
    size: int
    accepted: bool


class BeaconSlam:
    """EKF-SLAM of a vehicle among beacons, by ``EkfSlam``.

    Args:
        settings: vehicle and radios.
        pose0: where the vehicle begins; it defines the frame of the map.
        P0: covariance of that, shape (3, 3).
        known: beacons with a prior, the covariance that of the prior.
    """

    def __init__(
        self,
        settings: SlamSettings,
        pose0: Pose | Sequence[float],
        P0: FloatArray,
        known: Mapping[BeaconId, BeaconEstimate] | None = None,
    ) -> None:
        self.settings = settings
        motion, ranges = settings.motion, settings.range
        sigmas = np.array(motion.prior_sigmas)
        v = POSE + sigmas.size
        mean, P = np.zeros(v), np.zeros((v, v))
        mean[:POSE], P[:POSE, :POSE] = pose0, P0
        P[range(POSE, v), range(POSE, v)] = sigmas**2
        priors = (
            [] if ranges is None else [("range_scale", ranges.scale_sigma), ("range_offset_m", ranges.offset_sigma_m)]
        )
        self._shared = tuple(name for name, sigma in priors if sigma > 0.0)
        prior = np.diag([sigma**2 for _, sigma in priors if sigma > 0.0])
        self.engine = EkfSlam(mean, P, np.zeros(len(self._shared)), prior)
        self._calibration = slice(v, v + len(self._shared))
        self._columns: dict[BeaconId, Columns] = {}
        self.waiting: dict[BeaconId, Waiting] = {}
        self.learned: list[Learned] = []
        for beacon, estimate in (known or {}).items():
            self._join(beacon, estimate.mean, estimate.covariance)

    @property
    def pose(self) -> Pose:
        """The vehicle; the heading does not wrap."""
        return Pose(*self.engine.mean[:POSE].tolist())

    @property
    def pose_covariance(self) -> FloatArray:
        """Of x_m, y_m, heading_rad, shape (3, 3)."""
        return self.engine.covariance[:POSE, :POSE].copy()

    @property
    def beacons(self) -> dict[BeaconId, BeaconEstimate]:
        """The map."""
        found = {}
        for beacon in self._columns:
            place = self.engine.block(beacon)
            found[beacon] = BeaconEstimate(self.engine.mean[place].copy(), self.engine.covariance[place, place].copy())
        return found

    @property
    def calibration(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation of what is calibrated on the way, by name."""
        names = [*self.settings.motion.names, *self._shared]
        mean, variances = self.engine.mean.tolist(), self.engine.covariance.diagonal().tolist()
        return {name: (mean[POSE + i], variances[POSE + i] ** 0.5) for i, name in enumerate(names)}

    def predict(self, odometry: Odometry) -> None:
        """Carry the vehicle on."""
        step = self.settings.motion.step(self.engine.mean[: self.engine.vehicle_size], odometry)
        self.engine.predict(*step)

    def observe(self, readings: Iterable[Reading]) -> list[Learned]:
        """Take readings of any beacons, one after the other; those of new ones begin their place on the map."""
        self.learned = []
        for reading in readings:
            if reading.beacon in self._columns:
                self.learned.append(self._update(reading))
            else:
                self._meet(reading)
        return self.learned

    def remove(self, beacon: BeaconId) -> None:
        """Forget a beacon; one that is heard again begins anew.

        Raises:
            BlockError: it is not on the map.
        """
        self.engine.remove(beacon)
        del self._columns[beacon]
        self._renumber()

    def _renumber(self) -> None:
        for beacon in self._columns:
            self._columns[beacon] = columns_of(range(POSE), self._calibration, self.engine.block(beacon))

    def _join(self, beacon: BeaconId, mean: FloatArray, covariance: FloatArray) -> None:
        none = np.empty(0, dtype=np.intp)
        self.engine.augment(beacon, mean, none, np.zeros((mean.size, 0)), np.eye(mean.size), covariance)
        self._columns[beacon] = columns_of(range(POSE), self._calibration, self.engine.block(beacon))

    def _rows(self, reading: Reading, pose: list[float], calibration: list[float], beacon: list[float]) -> list[Row]:
        s = self.settings
        if isinstance(reading, RssiReading):
            assert s.rssi is not None
            rows = [rssi_row(pose, calibration, beacon, s.rssi)]
        else:
            assert s.range is not None
            rows = [range_row(pose, calibration, beacon, s.range)]
        if not isinstance(reading, RangeReading) and reading.bearing_rad is not None:
            assert s.bearing is not None
            rows.append(bearing_row(pose, calibration, beacon, s.bearing.sigma_rad))
        return rows

    def _update(self, reading: Reading) -> Learned:
        columns = self._columns[reading.beacon]
        x = self.engine.mean.take(columns).tolist()
        split = POSE + len(self._shared)
        rows = self._rows(reading, x[:POSE], x[POSE:split], x[split:])
        gate = self.settings.gate_sigmas**2
        z = _values(reading)
        if len(rows) == 1:
            row = rows[0]
            h = np.array((*row.pose, *row.calibration, *row.beacon))
            found = self.engine.update_row(columns, h, z[0] - row.expected, row.variance, gate)
        else:
            H = np.array([(*row.pose, *row.calibration, *row.beacon) for row in rows])
            residual = np.array((z[0] - rows[0].expected, wrap_pi(z[1] - rows[1].expected)))
            found = self.engine.update(columns, H, residual, np.array([row.variance for row in rows]), gate)
        return Learned(reading.beacon, found.residual, found.nis, found.size, found.accepted)

    def _meet(self, reading: Reading) -> None:
        """A reading of a beacon that is not on the map yet."""
        bearing = None if isinstance(reading, RangeReading) else reading.bearing_rad
        if bearing is not None:
            start, spread = self._first_guess(reading, bearing)
            self._join(reading.beacon, start, spread)
            self._settle([reading], [None])
            return
        waiting = self.waiting.setdefault(reading.beacon, Waiting())
        waiting.take(self.engine, reading, self._distance(reading))
        self._renumber()
        found = waiting.solve(self.engine, self._rows, self._calibration, self.settings)
        if found is None:
            return
        self._join(reading.beacon, *found)
        self._settle([r.reading for r in waiting.records], [r.place for r in waiting.records])
        for record in waiting.records:
            self.engine.remove(record.place)
        del self.waiting[reading.beacon]
        self._renumber()

    def _distance(self, reading: Reading) -> float:
        """What a reading says of the distance alone."""
        s, z = self.settings, _values(reading)[0]
        if isinstance(reading, RssiReading):
            assert s.rssi is not None
            return float(10.0 ** ((s.rssi.reference_dbm - z) / (10.0 * s.rssi.exponent)))
        return max(z, 0.0)

    def _first_guess(self, reading: Reading, bearing_rad: float) -> tuple[FloatArray, FloatArray]:
        """Beacon at range and bearing, with a spread so wide that the readings alone place it."""
        pose, r = self.pose, self._distance(reading)
        way = pose.heading_rad + bearing_rad
        return widened(self.settings, pose.x_m + r * cos(way), pose.y_m + r * sin(way), r, reading)

    def _settle(self, readings: list[Reading], places: list[object | None]) -> Update:
        """Condition a beacon that has just joined, and all that is correlated with it, on what was heard of it."""
        engine, block = self.engine, self.engine.block(readings[0].beacon)
        poses = [slice(0, POSE) if p is None else engine.block(p) for p in places]
        parts = sorted({(p.start, p.stop) for p in poses})
        columns = columns_of(*(slice(*part) for part in parts), self._calibration, block)
        index = {int(c): i for i, c in enumerate(columns)}
        z = [_values(r) for r in readings]
        m = sum(len(v) for v in z)

        def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            residual, H, i = np.zeros(m), np.zeros((m, columns.size)), 0
            calibration, beacon = x[self._calibration].tolist(), x[block].tolist()
            for reading, place, values in zip(readings, poses, z, strict=True):
                pose = [*x[place].tolist(), 0.0][:POSE]
                for k, row in enumerate(self._rows(reading, pose, calibration, beacon)):
                    residual[i] = values[k] - row.expected if k == 0 else wrap_pi(values[k] - row.expected)
                    at = index[place.start]
                    H[i, at : at + place.stop - place.start] = row.pose[: place.stop - place.start]
                    at = index[self._calibration.start] if self._shared else 0
                    H[i, at : at + len(self._shared)] = row.calibration
                    H[i, index[block.start] :] = row.beacon
                    i += 1
            return residual, H

        x = engine.mean
        variances = []
        for reading, place in zip(readings, poses, strict=True):
            pose = [*x[place].tolist(), 0.0][:POSE]
            rows = self._rows(reading, pose, x[self._calibration].tolist(), x[block].tolist())
            variances += [row.variance for row in rows]
        return engine.update_iterated(columns, linearise, np.array(variances), 6)


def _values(reading: Reading) -> tuple[float, ...]:
    first = reading.rssi_dbm if isinstance(reading, RssiReading) else reading.range_m
    if isinstance(reading, RangeReading) or reading.bearing_rad is None:
        return (first,)
    return (first, reading.bearing_rad)
