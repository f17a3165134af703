"""EKF-SLAM over readings: a vehicle among beacons places them on a map while it finds itself on it."""

from collections.abc import Iterable, Mapping, Sequence
from math import cos, log, sin, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.beacons.slam.beacon_map import (
    HEADING,
    BeaconMap,
    GaussMarkovBias,
    HeadingTransport,
    MapEntry,
    NoiseLevel,
)
from ccatp.beacons.slam.landmark_init import (
    FLAT,
    LEAST,
    LINEARISATIONS,
    TRIAL,
    PendingLandmark,
    derivatives,
    stacked_rows,
)
from ccatp.beacons.slam.measurement_models import MeasurementModels, MeasurementRow, is_direction, kind_of, strength_of
from ccatp.beacons.slam.motion import (
    POSE,
    CarriedOdometry,
    DeadReckoning,
    DifferentialDrive,
    Increment,
    VehiclePose,
    estimated,
)
from ccatp.beacons.slam.recording import BeaconEstimate, BeaconId, Reading
from ccatp.config.beacon_models import RecordingConfig, SlamFilterConfig
from ccatp.core import FloatArray, wrap_pi
from ccatp.filters.ekf_slam import BlockError, EkfSlam, RowUpdate, columns_of


class AddedPoseNoise:
    """N <- G N G^T + Q, N symmetric, G = dh(pose)/d(pose): the identity, but for the derivatives by the heading.

    Six numbers in place of an array of nine: an update of so small a one by NumPy takes longer than the rest.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Something was heard."""
        self._xx = self._xy = self._xt = self._yy = self._yt = self._tt = 0.0

    def step(self, F: FloatArray, Q: FloatArray) -> None:
        """The vehicle moves on: Jacobian and noise of its states, each of shape (v, v), the pose first."""
        f, g, tt = F.item(0, 2), F.item(1, 2), self._tt
        xt, yt = self._xt + f * tt, self._yt + g * tt
        self._xx += f * (self._xt + xt) + Q.item(0, 0)
        self._xy += g * self._xt + f * yt + Q.item(0, 1)
        self._yy += g * (self._yt + yt) + Q.item(1, 1)
        self._xt, self._yt, self._tt = xt + Q.item(0, 2), yt + Q.item(1, 2), tt + Q.item(2, 2)

    def seen(self, hx: float, hy: float, ht: float) -> float:
        """H N H^T of a row with these derivatives by the pose."""
        across = hx * (hx * self._xx + 2.0 * (hy * self._xy + ht * self._xt))
        return across + hy * (hy * self._yy + 2.0 * ht * self._yt) + ht * ht * self._tt


DELAY = "odometry_delay_s"


class BeaconInnovation(NamedTuple):
    """What one reading did."""

    beacon: BeaconId
    residual: FloatArray  # z - h(x) of the bearing, if there is one, and of the range or the strength, shape (m,)
    nis: float  # nu^T S^-1 nu, with the larger noise where a reading was beyond the knee
    size: int  # m; a reading whose bearing is refused has its range left out
    accepted: bool  # False where it was refused; the state is then as before, or has taken the bearing alone
    surprise: float = 0.0  # minus twice its log-likelihood, up to a constant: sum of nis + ln S


class BeaconSlam:
    """EKF-SLAM of a vehicle among beacons, by ``EkfSlam``; docs/slam.md has the models.

    Args:
        pose0: where the vehicle begins; it defines the frame of the map.
        P0: covariance of that, shape (3, 3).
        known: beacons with a prior: mean (b,) and covariance (b, b).

    Attributes:
        engine: the state: vehicle | calibration | beacons, wandering errors and places where readings wait.
        learned: what the readings of the last ``observe`` did.
        waiting: beacons with readings that are not on the map yet, with the candidates for their places.
        levels: what the noise of each sensor and of the motion is, relative to the settings, in variance.
        prior_sigmas: standard deviations of ``calibration`` before any reading, in its order.
        unplaced: directions alone, of beacons that were not on the map then: they are not used.
        moved: beacons that had to be placed again, each with the time_s of the reading that decided it.
    """

    def __init__(
        self, cfg: RecordingConfig, how: SlamFilterConfig, pose0: VehiclePose | Sequence[float], P0: FloatArray,
        known: Mapping[BeaconId, BeaconEstimate] | None = None,
    ) -> None:  # fmt: skip
        self._how, radio = how, cfg.radio
        self._motion = DifferentialDrive(cfg.odometry, cfg.priors, how)
        self._sensors = MeasurementModels(radio, cfg.priors)
        delay_names, delay_sigmas = estimated({DELAY: cfg.priors.delay_s})
        own, shared = self._motion.prior_sigmas, (*self._sensors.prior_sigmas, *delay_sigmas)
        v, self._ranges = POSE + len(own), len(self._sensors.names)
        mean, P = np.zeros(v), np.zeros((v, v))
        mean[:POSE], P[:POSE, :POSE] = pose0, P0
        P[range(POSE, v), range(POSE, v)] = np.square(own)
        self.engine = EkfSlam(mean, P, np.zeros(len(shared)), np.diag(np.square(shared)))
        self._shared = slice(v, v + len(shared))
        self._delay = v + len(shared) - 1 if delay_names else -1
        self._shown = POSE + len(shared)  # of the columns of a row, those before the beacon
        self.prior_sigmas = (*own, *shared)
        self._names = (*self._motion.names, *self._sensors.names, *delay_names)
        self._wander = None
        if radio.correlation_s > 0.0:
            self._wander = GaussMarkovBias(how.wander_share, how.wander_length_m, radio.correlation_s)
        self._clock = DeadReckoning(is_delayed=bool(delay_names))
        self._map = BeaconMap(self.engine, self._shared)
        self._transport = HeadingTransport(self.engine) if how.transports else None
        kinds = ("range", "bearing", "rssi", "motion")
        self.levels = {kind: NoiseLevel(how.learn_prior, how.learn_memory) for kind in kinds}
        self._learns = how.learn_memory > 0.0
        self._fresh = AddedPoseNoise()
        self._gate, self._knee = radio.gate_sigmas**2, how.knee_sigmas
        self._refused, self.jumps, self.unplaced = 0, 0, 0
        self.moved: list[tuple[BeaconId, float]] = []
        self._way_m = 0.0
        self.waiting: dict[BeaconId, PendingLandmark] = {}
        self.learned: list[BeaconInnovation] = []
        for beacon, estimate in (known or {}).items():
            self._map.join(beacon, estimate.mean, estimate.covariance)

    @property
    def pose(self) -> VehiclePose:
        """The vehicle after the last odometry; the heading does not wrap."""
        return VehiclePose(*self.engine.mean[:POSE].tolist())

    @property
    def pose_covariance(self) -> FloatArray:
        """Of x_m, y_m, heading_rad, shape (3, 3)."""
        return self.engine.covariance[:POSE, :POSE].copy()

    @property
    def beacons(self) -> dict[BeaconId, BeaconEstimate]:
        """The map."""
        x, P, place = self.engine.mean, self.engine.covariance, self.engine.block
        return {b: BeaconEstimate(x[place(b)].copy(), P[place(b), place(b)].copy()) for b in self._map}

    @property
    def calibration(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation of what is calibrated on the way, by name."""
        mean, variances = self.engine.mean.tolist(), self.engine.covariance.diagonal().tolist()
        return {name: (mean[POSE + i], sqrt(variances[POSE + i])) for i, name in enumerate(self._names)}

    def predict(self, odometry: Increment) -> None:
        """Carry the vehicle on."""
        delay_s = float(self.engine.mean[self._delay]) if self._delay >= 0 else 0.0
        for step in self._clock.due(odometry, delay_s):
            self._step(step)

    def _step(self, odometry: Increment) -> None:
        engine = self.engine
        before = engine.mean[: engine.vehicle_size].copy()
        mean, F, Q = self._motion.step(before, odometry)
        if self._learns:
            Q = Q * self.levels["motion"].factor
            self._fresh.step(F, Q)
        if odometry.guess_m2 > 0.0:  # a guessed way says nothing of the noise of odometry
            Q = Q.copy()
            Q[range(POSE), range(POSE)] += odometry.guess_m2, odometry.guess_m2, odometry.guess_rad2
        engine.predict(mean, F, Q)
        self._way_m += self._clock.took(odometry, before, mean)
        rest = self._motion.at_rest(odometry)
        if rest is not None:
            column, bias, variance = rest
            corrected = engine.mean.copy()
            engine.update_row(np.array((column,)), np.ones(1), bias - float(engine.mean[column]), variance)
            self._follow(corrected)

    def observe(self, readings: Iterable[Reading]) -> list[BeaconInnovation]:
        """Take readings of any beacons, one after the other; those of new ones begin their place on the map."""
        self.learned = []
        for reading in readings:
            entry, before = self._map.get(reading.beacon), self.engine.mean.copy()
            if entry is None and is_direction(reading):
                self.unplaced += 1  # it may lie anywhere along it
            elif entry is None:
                self._begin(reading)
            else:
                self.learned.append(self._update(reading, entry))
                if entry.on_trial and reading.beacon not in self._map and not is_direction(reading):
                    before = self.engine.mean.copy()
                    self._begin(reading)
            self._follow(before)
        return self.learned

    def _follow(self, before: FloatArray) -> None:
        if self._transport is not None:
            self._transport.follow(before)

    def correct_heading(self, off_rad: float, sigma_rad: float) -> float:
        """Take a heading that is ``off_rad`` from the estimated one; returns the NIS of that."""
        before = self.engine.mean.copy()
        found = self.engine.update_row(np.array((HEADING,)), np.ones(1), off_rad, sigma_rad**2)
        self._follow(before)
        return found.nis

    def remove(self, beacon: BeaconId) -> None:
        """Forget a beacon; its next reading begins it again. Raises BlockError: there was no reading of it."""
        if (waiting := self.waiting.pop(beacon, None)) is not None:
            waiting.drop(self.engine)
            self._map.renumber()
        elif beacon in self._map:
            self._map.leave(beacon)
        else:
            raise BlockError(beacon, "is not on the map")

    def _begin(self, reading: Reading) -> None:
        """With a bearing a beacon joins at once, where range and bearing say; without one its readings wait.

        One that joined at once is on trial: if one of its next ``TRIAL`` readings is refused, it begins again with that
        one.
        """
        reach_m = self._sensors.distance_m(reading)
        at = self._carried(self.engine.mean, reading)
        if reading.bearing_rad is not None:
            way = at.pose[2] + reading.bearing_rad
            x_m, y_m = at.pose[0] + reach_m * cos(way), at.pose[1] + reach_m * sin(way)
            entry = self._map.join(reading.beacon, *self._prior(reading, reach_m, x_m, y_m))
            entry.on_trial = TRIAL
            self._settle(reading, reading.bearing_rad)
            return
        # Columns (k,) of the state that the carried place depends on, and its derivatives, shape (2, k).
        (x_heading, y_heading), by = at.by_heading(), at.by_delay()
        columns, J = [0, 1, 2], [[1.0, 0.0, x_heading], [0.0, 1.0, y_heading]]
        if self._delay >= 0:
            columns.append(self._delay)
            J[0].append(by[0])
            J[1].append(by[1])
        waiting = self.waiting.setdefault(reading.beacon, PendingLandmark(reading.beacon))
        by_state = columns_of(columns), np.array(J)
        is_kept = waiting.take(self.engine, reading, np.array(at.pose[:2]), by_state, reach_m)
        if is_kept and len(waiting.records) >= LEAST:

            def prior_at(x_m: float, y_m: float) -> BeaconEstimate:
                return self._prior(reading, reach_m, x_m, y_m)

            waiting.look(self.engine, self._row_of, self._shared, prior_at, reach_m)
            self._join_waiting(reading, waiting, reach_m)
        self._map.renumber()

    def _join_waiting(self, reading: Reading, waiting: PendingLandmark, reach_m: float) -> None:
        """Condition the beacon, the places of its readings, the calibration and all else on them, iterated."""
        engine, shared, found = self.engine, self._shared, waiting.found(self.engine)
        if found is None:
            return
        prior = self._prior(reading, reach_m, *found.mean[:2].tolist())
        prior.mean[:2] = found.mean[:2]
        self._map.join(reading.beacon, *prior)
        block = engine.block(reading.beacon)
        places = [engine.block(record.place) for record in waiting.records]
        readings = [record.reading for record in waiting.records]
        z = [strength_of(one) for one in readings]

        def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            at = [x[place].tolist() for place in places]
            H, G, residual, _ = stacked_rows(readings, z, at, x[shared].tolist(), x[block].tolist(), self._row_of)
            return residual, np.hstack([H, G])

        engine.update_iterated(columns_of(*places, shared, block), linearise, found.variances, LINEARISATIONS)
        waiting.drop(engine)
        del self.waiting[reading.beacon]

    def _settle(self, reading: Reading, bearing_rad: float) -> None:
        # Condition a beacon that has just joined at range and bearing on them.
        engine, shared = self.engine, self._shared
        block = engine.block(reading.beacon)

        def rows_at(x: FloatArray) -> tuple[CarriedOdometry, MeasurementRow, MeasurementRow]:
            at, beacon = self._carried(x, reading), x[block].tolist()
            row = self._row_of(reading, at.pose, x[shared].tolist(), beacon)
            return at, row, self._sensors.bearing(at.pose, beacon)

        def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            at, *rows = rows_at(x)
            residual = strength_of(reading) - rows[0].expected, wrap_pi(bearing_rad - rows[1].expected)
            H = [[*derivatives(row, at, delayed=self._delay >= 0), *row.beacon] for row in rows]
            return np.array(residual), np.array(H)

        _, row, bearing = rows_at(engine.mean)
        R = np.array((row.variance, bearing.variance * self.levels["bearing"].factor))
        engine.update_iterated(columns_of(slice(0, POSE), shared, block), linearise, R, LINEARISATIONS)

    def _carried(self, x: FloatArray, reading: Reading) -> CarriedOdometry:
        """The pose of a state x (n,) at a reading's time."""
        delay_s = float(x[self._delay]) if self._delay >= 0 else 0.0
        return self._clock.at(x[:POSE].tolist(), reading.time_s, delay_s)

    def _row_of(
        self, reading: Reading, pose: list[float], calibration: list[float], beacon: list[float]
    ) -> MeasurementRow:
        row = self._sensors.row(reading, pose, calibration[: self._ranges], beacon)
        return row._replace(variance=row.variance * self.levels[kind_of(reading)].factor)

    def _prior(self, reading: Reading, reach_m: float, x_m: float, y_m: float) -> BeaconEstimate:
        extra = self._sensors.extra_prior(reading)
        sigmas = (FLAT * reach_m, FLAT * reach_m, *(sigma for _, sigma in extra))
        return BeaconEstimate(np.array((x_m, y_m, *(mean for mean, _ in extra))), np.diag(np.square(sigmas)))

    def _update(self, reading: Reading, entry: MapEntry) -> BeaconInnovation:
        model = None if is_direction(reading) else self._wander
        if model is not None:
            self._map.wander_to(reading.beacon, model, self._way_m, reading.time_s)
        bearing = reading.bearing_rad
        residuals, nis, spread, found = [], 0.0, 1.0, None
        if bearing is not None:
            found = self._take(reading, entry, "bearing", bearing, model)
            residuals, nis, spread = [found.residual], found.nis, found.spread
        if found is None or (found.accepted and not is_direction(reading)):
            found = self._take(reading, entry, kind_of(reading), strength_of(reading), model)
            residuals.append(found.residual)
            nis += found.nis
            spread *= found.spread
        if self._learns:
            self._fresh.clear()
        self._judge(reading, entry, accepted=found.accepted)
        return BeaconInnovation(
            reading.beacon, np.array(residuals), nis, len(residuals), found.accepted, nis + log(spread)
        )

    def _take(self, reading: Reading, entry: MapEntry, kind: str, z: float, model: GaussMarkovBias | None) -> RowUpdate:
        engine, level = self.engine, self.levels[kind]
        x: list[float] = engine.mean.take(entry.columns).tolist()
        is_delayed, is_angle, shown = self._delay >= 0, kind == "bearing", self._shown
        beacon = x[shown : shown + entry.size]
        at = self._clock.at(x, reading.time_s, x[shown - 1] if is_delayed else 0.0)
        if is_angle:
            row = self._sensors.bearing(at.pose, beacon)
        else:
            row = self._sensors.row(reading, at.pose, x[POSE : POSE + self._ranges], beacon)
        h = derivatives(row, at, delayed=is_delayed)
        h += row.beacon
        expected, own = row.expected, row.variance * level.factor
        r = own
        if entry.wander >= 0:
            share = 0.0 if model is None or is_angle else model.share
            by_wander = sqrt(share * r)
            h.append(by_wander)
            expected += by_wander * x[-1]
            r *= 1.0 - share
            own = r + entry.fresh * by_wander * by_wander
        residual = wrap_pi(z - expected) if is_angle else z - expected
        found = engine.update_row(entry.columns, np.array(h), residual, r, self._gate, self._knee)
        if found.accepted and self._learns:
            level.learn(found.nis, own / found.spread)
            self.levels["motion"].learn(found.nis, self._fresh.seen(h[0], h[1], h[2]) / found.spread)
        return found

    def _judge(self, reading: Reading, entry: MapEntry, *, accepted: bool) -> None:
        if accepted:
            entry.refused = 0
            entry.on_trial = max(entry.on_trial - 1, 0)
            self._refused = 0
            return
        if entry.on_trial:
            self._map.leave(reading.beacon)
            return
        entry.refused += 1
        self._refused += 1
        if self._refused >= self._how.doubt_pose_after:
            self._refused = 0
            v = self.engine.vehicle_size
            jump = np.zeros(v)
            jump[:POSE] = self._how.jump_m, self._how.jump_m, self._how.jump_rad
            self.engine.predict(self.engine.mean[:v].copy(), np.eye(v), np.diag(jump**2))
            self.jumps += 1
        if entry.refused >= self._how.doubt_beacon_after:
            self._map.leave(reading.beacon)
            self.moved.append((reading.beacon, reading.time_s))
