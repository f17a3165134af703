"""EKF-SLAM by levels and bearings of radios, one of which moves; from packets of a turning reflector to a bearing."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin, sqrt, tau
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

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
from ccatp.config.beacon_models import RadioConfig, ScanConfig
from ccatp.core import FloatArray, wrap_pi
from ccatp.filters.ekf_slam import EkfSlam, Update, columns_of

_POSE_COLUMNS = columns_of(range(POSE))
_ITERATIONS = 4
_WIDE = 10.0  # spread of a radio before its first reading, in ranges of that reading
_NEAREST_M = 0.02  # nearer than that a distance has no derivative worth the name


_APART_RAD = pi / 2.0  # strongest readings further apart than this are two directions, not one


class ScanResult(NamedTuple):
    """Level and bearing of one radio after a turn of the reflector."""

    beacon: str
    rssi_dbm: float
    readings: int
    bearing_rad: float | None  # left of the heading; None where the scan has none
    bearing_sigma_rad: float
    heard: float


@dataclass(frozen=True, slots=True)
class ReflectorScan:
    """How scans are taken and read: 40 readings of one turn are steps of 9 degrees (Hevrdejs and Knoll 2017)."""

    cfg: ScanConfig

    @property
    def step_rad(self) -> float:
        """Between two readings."""
        return tau / self.cfg.readings

    @property
    def sigma_rad(self) -> float:
        """Of a bearing: noise, and a direction that may lie anywhere within a step (variance step^2 / 12)."""
        return hypot(self.cfg.bearing_sigma_rad, self.step_rad / 12.0**0.5)

    def results(self, packets: Iterable[tuple[str, float, float]]) -> list[ScanResult]:
        """One result for each radio, in the order of their first packets.

        ``packets``: radio, direction of the reflector left of the heading (rad), level (dBm).
        """
        by_beacon: dict[str, list[tuple[float, float]]] = {}
        for beacon, direction_rad, level_dbm in packets:
            by_beacon.setdefault(beacon, []).append((direction_rad, level_dbm))
        return [self._result(beacon, readings) for beacon, readings in by_beacon.items()]

    def _result(self, beacon: str, readings: Sequence[tuple[float, float]]) -> ScanResult:
        heard = len(readings) / self.cfg.readings
        bearing_rad = self._bearing(readings)
        if bearing_rad is None or heard < 1.0 - self.cfg.loss_tolerance:
            levels = [level_dbm for _, level_dbm in readings]
            return ScanResult(beacon, max(levels), 1, None, self.sigma_rad, heard)
        levels = [z for direction, z in readings if abs(wrap_pi(direction - bearing_rad)) <= 1.01 * self.step_rad]
        levels = levels or [max(level_dbm for _, level_dbm in readings)]
        return ScanResult(beacon, sum(levels) / len(levels), len(levels), bearing_rad, self.sigma_rad, heard)

    def _bearing(self, readings: Sequence[tuple[float, float]]) -> float | None:
        """Direction of the strongest reading, 2017 eq. 5; the middle of equals that lie together, else None."""
        strongest_dbm = max(level_dbm for _, level_dbm in readings)
        tied = [direction for direction, level_dbm in readings if level_dbm == strongest_dbm]
        c, s = sum(map(cos, tied)), sum(map(sin, tied))
        if hypot(c, s) < 1e-9 * len(tied):
            return None
        middle_rad = atan2(s, c)
        is_one = all(abs(wrap_pi(direction - middle_rad)) <= _APART_RAD / 2.0 for direction in tied)
        return middle_rad if is_one else None


class SignalSlam:
    """EKF-SLAM of a vehicle among radios, by ``EkfSlam``; levels are used as they are, in dB.

    A level is z = P_ref - 10 eta log10(r) + b + noise with b the static shadowing, a bearing
    beta = atan2(dy, dx) - heading + noise (Auth and Hovey 2018, eqs 2.3 and 2.9). States of a static radio:
    x_m, y_m, and those of its shadowing where there is a map of it; of the moving one: x_m, y_m, its velocity, and its
    shadowing where there is any. Updates are iterated (Gauss-Newton on the posterior), because an error of 18 degrees
    is too large for one linearisation.

    The vehicle begins at the believed start of the configuration, which defines the frame of the map.
    """

    def __init__(self, cfg: RadioConfig) -> None:
        start, loss, estimator, room_m = cfg.start, cfg.path_loss, cfg.estimator, cfg.workspace.size_m
        self._motion = SlippingVehicle(cfg.vehicle, cfg.odometry)
        v = self._motion.size
        mean, sigmas = np.zeros(v), np.zeros(v)
        mean[:POSE] = start.x_m, start.y_m, start.heading_rad
        sigmas[:POSE] = start.position_sigma_m, start.position_sigma_m, start.heading_sigma_rad
        sigmas[POSE:] = self._motion.prior_sigmas
        self.engine = EkfSlam(mean, np.diag(sigmas**2))
        self.learned: list[BeaconInnovation] = []
        self.waiting = SignalLandmarkInitializer(self.engine)
        self._default = PathLoss(loss.reference_dbm, loss.exponent, loss.white_sigma_db)
        self._path_loss = {
            name: PathLoss(reference_dbm, loss.exponent, loss.white_sigma_db)
            for name, reference_dbm in loss.reference_dbm_of.items()
        }
        # Static shadowing without a map of it counts as white noise.
        sigma_db, length_m = loss.shadowing_sigma_db, loss.shadowing_length_m
        self._sigma_db = sigma_db = sigma_db if estimator.shadowing != "none" else 0.0
        self._shadowing: ShadowingMap | None = None
        if estimator.shadowing == "map" and sigma_db > 0.0:
            self._shadowing = ShadowingMap(room_m, estimator.shadowing_grid_m, sigma_db, length_m)
        # In a room without a radio that moves, its name is never received.
        speed_m_s, course_time_s = estimator.target_speed_sigma_m_s, estimator.target_course_time_s
        self._moving = MovingRadio(cfg.follow.target, speed_m_s, course_time_s, sigma_db, length_m, room_m)
        self._bearing_sigma_rad = ReflectorScan(cfg.scan).sigma_rad
        self._placed_share, self._waiting_scans = estimator.placed_share, estimator.waiting_scans
        # Largest normalised innovation squared that is used, of one row and of two.
        self._gates = tuple(float(chdtri(rows, 1.0 - estimator.gate_probability)) for rows in (1, 2))

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
        return {name: (mean[POSE + i], sqrt(variances[POSE + i])) for i, name in enumerate(self._motion.names)}

    def predict(self, odometry: Odometry) -> None:
        """Carry the vehicle and the moving radio on."""
        before = self.engine.mean[:PLACE].tolist()
        step = self._motion.step(self.engine.mean[: self.engine.vehicle_size], odometry)
        self.engine.predict(step.mean, step.F, step.Q)
        if self._moving.beacon in self.engine:
            travel_m = hypot(step.mean[0] - before[0], step.mean[1] - before[1])
            self._moving.predict(self.engine, odometry.interval_s, travel_m)

    def observe(self, readings: Iterable[RssiReading]) -> list[BeaconInnovation]:
        """Take readings of any radios, one after the other; new ones are placed when their readings suffice.

        A new radio of which no bearing is known is not used: a level alone is a circle.
        """
        self.learned = []
        waiting = []
        for reading in readings:
            is_known, is_moving = reading.beacon in self.engine, reading.beacon == self._moving.beacon
            if is_known or is_moving:
                found = self._update_moving(reading) if is_moving else self._update(reading)
                if found is not None and is_known:
                    self.learned.append(
                        BeaconInnovation(reading.beacon, found.residual, found.nis, found.size, found.accepted)
                    )
            else:
                waiting.append(reading)
        self._wait(waiting)
        return self.learned

    def distance(self, beacon: BeaconId) -> tuple[float, float]:
        """Between the vehicle and a radio, m, and its standard deviation. Raises BlockError: it is not on the map."""
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
        if self._moving.beacon not in self.engine:
            return 0.0, 0.0
        start = self.engine.block(self._moving.beacon).start + PLACE
        vx, vy = self.engine.mean[start : start + PLACE].tolist()
        return vx, vy

    def joint(self, beacons: Sequence[BeaconId]) -> tuple[FloatArray, FloatArray]:
        """Pose and the places of some radios on the map together: mean (3 + 2 k,) and covariance.

        Raises BlockError: one is not on the map.
        """
        starts = [self.engine.block(beacon).start for beacon in beacons]
        columns = columns_of(range(POSE), *(range(start, start + PLACE) for start in starts))
        return self.waiting.conditioned(columns)

    def path_loss_of(self, beacon: BeaconId) -> PathLoss:
        """The calibration of a radio."""
        return self._path_loss.get(str(beacon), self._default)

    def _prior(self, reading: RssiReading, bearing_rad: float, pose: Sequence[float]) -> SignalPrior:
        range_m = self.path_loss_of(reading.beacon).median_range_m(reading.rssi_dbm)
        way_rad = pose[2] + bearing_rad
        spread = [_WIDE * range_m] * PLACE
        if self._shadowing is not None:
            spread += [1.0] * self._shadowing.size
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
        if len(self.waiting.records[beacon]) >= self._waiting_scans:
            return True
        guess, pose = self.waiting.guesses[beacon], self.engine.mean
        range_m = hypot(guess.mean[0] - pose[0], guess.mean[1] - pose[1])
        largest = float(np.linalg.eigvalsh(guess.covariance[:PLACE, :PLACE])[-1])
        return largest < (self._placed_share * range_m) ** 2

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
        rows = rows_of([self._sight(reading, 0)], radio, path_loss, self._bearing_sigma_rad)
        gate = self._gates[rows.variances.size - 1]
        return self.engine.update_iterated(rows.columns, rows.linearise, rows.variances, _ITERATIONS, gate)

    def _update_moving(self, reading: RssiReading) -> Update | None:
        """The radio that moves joins at its first bearing: it would be elsewhere later."""
        if reading.beacon not in self.engine:
            if reading.bearing_rad is None:
                return None
            self._moving.join(self.engine, reading.bearing_rad)
        path_loss = self.path_loss_of(reading.beacon)
        return self._moving.update(self.engine, reading, path_loss, self._bearing_sigma_rad, self._gates)

    def _rows_at(self, records: list[SignalRecord], pose_at: Callable[[PoseKey], int], radio: slice) -> SignalRows:
        sights = []
        for record in records:
            place = self.engine.block(record.pose).start
            sights.append(self._sight(record.reading, place)._replace(pose=pose_at(record.pose)))
        path_loss = self.path_loss_of(records[0].reading.beacon)
        return rows_of(sights, radio, path_loss, self._bearing_sigma_rad)

    def _sight(self, reading: RssiReading, pose: int) -> RadioModel:
        x_m, y_m = self.engine.mean[pose : pose + PLACE].tolist()
        shadow, rest_db2 = np.empty(0), self._sigma_db**2
        if self._shadowing is not None:
            shadow, rest_db2 = self._shadowing.row(x_m, y_m)
        return RadioModel(reading, pose, shadow, self.path_loss_of(reading.beacon).sigma_db ** 2 + rest_db2)
