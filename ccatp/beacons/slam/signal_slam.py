"""EKF-SLAM by levels and bearings of radios: static shadowing on the map, one radio that moves."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import cos, hypot, sin, sqrt

import numpy as np

from ccatp.beacons.slam.motion import POSE, Odometry, SlippingVehicle, VehiclePose
from ccatp.beacons.slam.path_loss import PathLoss
from ccatp.beacons.slam.range_slam import BeaconInnovation
from ccatp.beacons.slam.recording import BeaconEstimate, BeaconId, RssiReading
from ccatp.beacons.slam.signal_landmarks import (
    PLACE,
    MovingRadio,
    PoseKey,
    RadioModel,
    ShadowingMap,
    SignalLandmarkInitializer,
    SignalPrior,
    SignalRecord,
    SignalRows,
    rows_of,
)
from ccatp.core import FloatArray
from ccatp.filters.ekf_slam import EkfSlam, Update, columns_of

_POSE_COLUMNS = columns_of(range(POSE))
_ITERATIONS = 4
_WIDE = 10.0  # spread of a radio before its first reading, in ranges of that reading
_NEAREST_M = 0.02  # nearer than that a distance has no derivative worth the name


@dataclass(frozen=True, slots=True)
class SignalSettings:
    """What ``SignalSlam`` is told.

    Attributes:
        path_loss: of each radio that has a calibration of its own; ``sigma_db`` is the white noise.
        shadowing_sigma_db: standard deviation of static shadowing; 0: none.
        shadowing: its map, for static radios; None: what there is of it counts as white noise.
        moving: the radio that moves; None without one.
        placed_share: a new static radio joins when its place is this sure, as a share of its range ...
        waiting_scans: ... or when as many readings wait; each scan keeps three states until then.
        gates: largest normalised innovation squared that is used, of one row and of two.
    """

    motion: SlippingVehicle
    path_loss: Mapping[BeaconId, PathLoss]
    default: PathLoss
    bearing_sigma_rad: float
    shadowing_sigma_db: float
    shadowing: ShadowingMap | None
    moving: MovingRadio | None
    placed_share: float
    waiting_scans: int
    gates: tuple[float, float]


class SignalSlam:
    """EKF-SLAM of a vehicle among radios, by ``EkfSlam``; levels are used as they are, in dB.

    A level is z = P_ref - 10 eta log10(r) + b + noise with b the static shadowing, a bearing
    beta = atan2(dy, dx) - heading + noise (Auth and Hovey 2018, eqs 2.3 and 2.9). States of a static radio:
    x_m, y_m, and those of its shadowing where there is a map of it; of the moving one: x_m, y_m, its velocity, and its
    shadowing where there is any. Updates are iterated (Gauss-Newton on the posterior), because an error of 18 degrees
    is too large for one linearisation.

    Args:
        pose0: where the vehicle begins; it defines the frame of the map.
        P0: covariance of that, shape (3, 3).
    """

    def __init__(self, settings: SignalSettings, pose0: VehiclePose | Sequence[float], P0: FloatArray) -> None:
        self.settings = settings
        sigmas = np.array(settings.motion.prior_sigmas)
        v = POSE + sigmas.size
        mean, P = np.zeros(v), np.zeros((v, v))
        mean[:POSE], P[:POSE, :POSE] = pose0, P0
        P[range(POSE, v), range(POSE, v)] = sigmas**2
        self.engine = EkfSlam(mean, P)
        self.learned: list[BeaconInnovation] = []
        self.waiting = SignalLandmarkInitializer(self.engine)

    @property
    def pose(self) -> VehiclePose:
        """The vehicle; the heading does not wrap."""
        return VehiclePose(*self.waiting.conditioned(_POSE_COLUMNS)[0].tolist())

    @property
    def pose_covariance(self) -> FloatArray:
        """Of x_m, y_m, heading_rad, shape (3, 3)."""
        return self.waiting.conditioned(_POSE_COLUMNS)[1]

    @property
    def beacons(self) -> dict[BeaconId, BeaconEstimate]:
        """The map: places alone, x_m and y_m."""
        found: dict[BeaconId, BeaconEstimate] = {
            beacon: BeaconEstimate(guess.mean[:PLACE], guess.covariance[:PLACE, :PLACE])
            for beacon, guess in self.waiting.guesses.items()
        }
        for beacon in self.engine.blocks:
            if isinstance(beacon, int | str):
                start = self.engine.block(beacon).start
                found[beacon] = BeaconEstimate(*self.waiting.conditioned(columns_of(range(start, start + PLACE))))
        return found

    @property
    def calibration(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation of the vehicle's calibration states, by name."""
        mean, variances = self.engine.mean.tolist(), self.engine.covariance.diagonal().tolist()
        names = self.settings.motion.names
        return {name: (mean[POSE + i], sqrt(variances[POSE + i])) for i, name in enumerate(names)}

    def predict(self, odometry: Odometry) -> None:
        """Carry the vehicle and the moving radio on."""
        before = self.engine.mean[:PLACE].tolist()
        step = self.settings.motion.step(self.engine.mean[: self.engine.vehicle_size], odometry)
        self.engine.predict(step.mean, step.F, step.Q)
        moving = self.settings.moving
        if moving is not None and moving.beacon in self.engine:
            travel_m = hypot(step.mean[0] - before[0], step.mean[1] - before[1])
            moving.predict(self.engine, odometry.interval_s, travel_m)

    def observe(self, readings: Iterable[RssiReading]) -> list[BeaconInnovation]:
        """Take readings of any radios, one after the other; new ones are placed when their readings suffice.

        A new radio of which no bearing is known is not used: a level alone is a circle.
        """
        self.learned = []
        waiting = []
        for reading in readings:
            is_known = reading.beacon in self.engine
            if is_known or self._is_moving(reading.beacon):
                found = self._update_moving(reading) if self._is_moving(reading.beacon) else self._update(reading)
                if found is not None and is_known:
                    self.learned.append(
                        BeaconInnovation(reading.beacon, found.residual, found.nis, found.size, found.accepted)
                    )
            else:
                waiting.append(reading)
        self._wait(waiting)
        return self.learned

    def remove(self, beacon: BeaconId) -> None:
        """Forget a radio; one that is heard again begins anew.

        Raises:
            BlockError: it is not on the map.
        """
        if beacon in self.waiting.records:
            self.waiting.drop(beacon)
            return
        self.engine.remove(beacon)

    def distance(self, beacon: BeaconId) -> tuple[float, float]:
        """Between the vehicle and a radio, m, and its standard deviation.

        Raises:
            BlockError: it is not on the map.
        """
        start = self.engine.block(beacon).start
        columns = columns_of(range(PLACE), range(start, start + PLACE))
        mean, covariance = self.waiting.conditioned(columns)
        x, y, bx, by = mean.tolist()
        r = max(hypot(bx - x, by - y), _NEAREST_M)
        h = np.array((x - bx, y - by, bx - x, by - y)) / r
        return r, sqrt(max(float(h @ covariance @ h), 0.0))

    @property
    def moving_velocity_m_s(self) -> tuple[float, float]:
        """Of the radio that moves; 0 before it was heard."""
        moving = self.settings.moving
        if moving is None or moving.beacon not in self.engine:
            return 0.0, 0.0
        start = self.engine.block(moving.beacon).start + PLACE
        vx, vy = self.engine.mean[start : start + PLACE].tolist()
        return vx, vy

    def joint(self, beacons: Sequence[BeaconId]) -> tuple[FloatArray, FloatArray]:
        """Pose and the places of some radios on the map together: mean (3 + 2 k,) and covariance.

        Raises:
            BlockError: one is not on the map.
        """
        starts = [self.engine.block(beacon).start for beacon in beacons]
        columns = columns_of(range(POSE), *(range(start, start + PLACE) for start in starts))
        return self.waiting.conditioned(columns)

    def path_loss_of(self, beacon: BeaconId) -> PathLoss:
        """The calibration of a radio."""
        return self.settings.path_loss.get(beacon, self.settings.default)

    def _is_moving(self, beacon: BeaconId) -> bool:
        return self.settings.moving is not None and beacon == self.settings.moving.beacon

    def _prior(self, reading: RssiReading, bearing_rad: float, pose: Sequence[float]) -> SignalPrior:
        settings = self.settings
        range_m = self.path_loss_of(reading.beacon).median_range_m(reading.rssi_dbm)
        way_rad = pose[2] + bearing_rad
        spread = [_WIDE * range_m] * PLACE
        if settings.shadowing is not None:
            spread += [1.0] * settings.shadowing.size
        mean = np.zeros(len(spread))
        mean[:PLACE] = pose[0] + range_m * cos(way_rad), pose[1] + range_m * sin(way_rad)
        return SignalPrior(mean, np.array(spread))

    def _wait(self, readings: list[RssiReading]) -> None:
        if not readings:
            return
        pose = self.waiting.keep_pose()
        for reading in readings:
            self.waiting.records.setdefault(reading.beacon, []).append(SignalRecord(reading, pose))
        priors = {}
        for beacon in self.waiting.records:
            with_bearing = (r for r in self.waiting.records[beacon] if r.reading.bearing_rad is not None)
            if first := next(with_bearing, None):  # a level alone is a circle
                at = self.engine.mean[self.engine.block(first.pose)].tolist()
                priors[beacon] = self._prior(first.reading, first.reading.bearing_rad or 0.0, at)
        if not priors:
            return
        self.waiting.solve(priors, self._rows_at)
        ready = [beacon for beacon in priors if self._is_ready(beacon)]
        for beacon in ready:
            self._settle(beacon, priors[beacon])
        if left := {beacon: prior for beacon, prior in priors.items() if beacon not in ready and ready}:
            self.waiting.solve(left, self._rows_at)

    def _is_ready(self, beacon: BeaconId) -> bool:
        if len(self.waiting.records[beacon]) >= self.settings.waiting_scans:
            return True
        guess, pose = self.waiting.guesses[beacon], self.engine.mean
        range_m = hypot(guess.mean[0] - pose[0], guess.mean[1] - pose[1])
        largest = float(np.linalg.eigvalsh(guess.covariance[:PLACE, :PLACE])[-1])
        return largest < (self.settings.placed_share * range_m) ** 2

    def _settle(self, beacon: BeaconId, prior: SignalPrior) -> None:
        none, size = np.empty(0, dtype=np.intp), prior.mean.size
        self.engine.augment(beacon, prior.mean, none, np.zeros((size, 0)), np.eye(size), np.diag(prior.sigmas**2))
        rows = self._rows_at(
            self.waiting.records[beacon], lambda key: self.engine.block(key).start, self.engine.block(beacon)
        )
        x = self.waiting.linearisation(beacon)
        residual, H = rows.linearise(x)
        off = residual + H @ (x - self.engine.mean)[rows.columns]
        self.engine.update(rows.columns, H, off, rows.variances)
        self.waiting.drop(beacon)

    def _update(self, reading: RssiReading) -> Update:
        radio, path_loss = self.engine.block(reading.beacon), self.path_loss_of(reading.beacon)
        rows = rows_of([self._sight(reading, 0)], radio, path_loss, self.settings.bearing_sigma_rad)
        gate = self.settings.gates[rows.variances.size - 1]
        return self.engine.update_iterated(rows.columns, rows.linearise, rows.variances, _ITERATIONS, gate)

    def _update_moving(self, reading: RssiReading) -> Update | None:
        """The radio that moves joins at its first bearing: it would be elsewhere later."""
        settings, moving = self.settings, self.settings.moving
        if moving is None:
            return None
        if reading.beacon not in self.engine:
            if reading.bearing_rad is None:
                return None
            moving.join(self.engine, reading.bearing_rad)
        path_loss = self.path_loss_of(reading.beacon)
        return moving.update(self.engine, reading, path_loss, settings.bearing_sigma_rad, settings.gates)

    def _rows_at(self, records: list[SignalRecord], pose_at: Callable[[PoseKey], int], radio: slice) -> SignalRows:
        sights = []
        for record in records:
            place = self.engine.block(record.pose).start
            sights.append(self._sight(record.reading, place)._replace(pose=pose_at(record.pose)))
        path_loss = self.path_loss_of(records[0].reading.beacon)
        return rows_of(sights, radio, path_loss, self.settings.bearing_sigma_rad)

    def _sight(self, reading: RssiReading, pose: int) -> RadioModel:
        x_m, y_m = self.engine.mean[pose : pose + PLACE].tolist()
        shadow, rest_db2 = np.empty(0), self.settings.shadowing_sigma_db**2
        if self.settings.shadowing is not None:
            shadow, rest_db2 = self.settings.shadowing.row(x_m, y_m)
        return RadioModel(reading, pose, shadow, self.path_loss_of(reading.beacon).sigma_db ** 2 + rest_db2)
