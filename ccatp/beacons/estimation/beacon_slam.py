"""EKF-SLAM: estimates the pose of a vehicle and a map of the beacons from odometry and readings."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import partial
from math import inf, log, sqrt
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from ccatp.beacons.config.models import OdometryNoiseConfig, RecordingConfig, SlamFilterConfig
from ccatp.beacons.estimation.beacon_map import (
    FURTHEST,
    HEADING,
    AddedPoseNoise,
    BeaconMap,
    GaussMarkovBias,
    HeadingTransport,
    LearnedNoise,
    MapEntry,
    NoiseLevel,
    RadioErrors,
)
from ccatp.beacons.estimation.landmark_init import (
    AGAIN,
    LEAST,
    LINEARISATIONS,
    PLACE,
    TRIAL,
    Candidate,
    PendingLandmark,
    ReadingRecord,
    StackedRows,
)
from ccatp.beacons.estimation.measurement_models import (
    ANTENNA,
    HEIGHT_M2,
    MeasurementModels,
    MeasurementRows,
    is_direction,
    recorded_models,
    scalars_of,
)
from ccatp.beacons.estimation.motion import (
    POSE,
    CarriedOdometry,
    DeadReckoning,
    DifferentialDrive,
    Increment,
    Odometry,
    RadioPose,
    SlippingVehicle,
    VehiclePose,
    estimated,
)
from ccatp.beacons.estimation.recording import BeaconEstimate, BeaconId, KnownMap, Radio, Reading
from ccatp.beacons.filters.ekf_slam import BlockError, Columns, EkfSlam, RowUpdate, columns_of
from ccatp.core import FloatArray
from ccatp.kinematics import wrap_pi

DELAY = "odometry_delay_s"
NOTHING: Mapping[Any, float] = MappingProxyType({})
UNITS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class BeaconInnovation(msgspec.Struct, frozen=True, gc=False):
    """Innovation of one reading."""

    beacon: BeaconId
    nis: float  # nu^T S^-1 nu, with the increased noise if the reading was beyond the knee
    size: int  # number of scalars processed (bearing, range, strength); one if the bearing was refused
    accepted: bool  # False: refused; the state is then unchanged, or was updated by the bearing only
    surprise: float = 0.0  # minus twice its log-likelihood, up to a constant: sum of nis + ln S
    radio: Radio | None = None


class BeaconSlam:
    """EKF-SLAM of a vehicle among beacons, by ``EkfSlam``; docs/measurements/slam.md has the models.

    Args:
        motion: motion model of the vehicle.
        models: measurement models by kind of reading.
        how: outlier limits, noise learning and limits for doubt of pose and beacons.
        pose0: initial pose; it defines the frame of the map.
        P0: covariance of the initial pose, shape (3, 3).
        gate: largest normalised innovation squared that is accepted.
        delay_sigma_s: prior standard deviation of the vehicle's delay behind its odometry; 0: it is not estimated.
        correlation_s: correlation time of the errors of a beacon's readings; 0: they are independent.
        iterations: linearisations of each update; one is enough if bearings are exact.
        antenna_sigmas_m: prior standard deviations of the place of the antenna, by ``ANTENNA``; 0: not estimated.
        height_sigmas_m2: those of the squares of the heights of beacons over the antenna; others are at its height.

    Attributes:
        engine: the state: vehicle | calibration | beacons, wandering errors and poses whose readings wait.
        learned: innovations of the last ``observe``.
        waiting: beacons with readings that are not on the map yet, with the candidates for their places.
        levels: factor on the configured noise variance of each sensor and of the motion.
        unplaced: number of readings with a bearing alone of a beacon that was not on the map: they are not used.
        moved: beacons that were removed to be placed again, each with the time_s of the reading that caused it.
        left: the same beacons, each with the time_s of the last reading that was used, and the estimate then.
        walks_m2_s: beacons that move at random, each with the variance that its place gains in a second.
    """

    flat = 100.0  # standard deviation of a beacon's place before its readings, relative to its distance
    linearisations = LINEARISATIONS  # of all waiting readings when a beacon joins, the first at the best candidate

    def __init__(
        self, motion: DifferentialDrive | SlippingVehicle, models: MeasurementModels, how: SlamFilterConfig,
        pose0: VehiclePose | Sequence[float], P0: FloatArray, *, gate: float, delay_sigma_s: float = 0.0,
        correlation_s: float = 0.0, iterations: int = 1, antenna_sigmas_m: Mapping[str, float] = NOTHING,
        height_sigmas_m2: Mapping[BeaconId, float] = NOTHING,
    ) -> None:  # fmt: skip
        self._motion, self._models, self._how = motion, models, how
        delay_names, delay_sigmas = estimated({DELAY: delay_sigma_s})
        antenna_names, antenna_sigmas = estimated(antenna_sigmas_m)
        own, shared = motion.prior_sigmas, (*models.prior_sigmas, *delay_sigmas, *antenna_sigmas)
        v, self._ranges = POSE + len(own), len(models.names)
        mean, P = np.zeros(v), np.zeros((v, v))
        mean[:POSE], P[:POSE, :POSE] = pose0, P0
        P[range(POSE, v), range(POSE, v)] = np.square(own)
        self.engine = EkfSlam(mean, P, np.zeros(len(shared)), np.diag(np.square(shared)))
        self._shared = slice(v, v + len(shared))
        self._delay = v + len(models.names) if delay_names else -1
        self._of_place = slice(v + len(models.names), v + len(shared))  # on what the place of a reading depends, too
        self._axes, self._raised = tuple(map(ANTENNA.index, antenna_names)), dict(height_sigmas_m2)
        self._shown = POSE + len(shared)  # columns of a row before the beacon: pose, delay, calibration of the readings
        self._names = (*motion.names, *models.names, *delay_names, *antenna_names)
        self._wander = None
        if correlation_s > 0.0:
            self._wander = GaussMarkovBias(how.wander_share, how.wander_length_m, correlation_s)
        self._clock = DeadReckoning(is_delayed=bool(delay_names))
        ranges = range(v, v + self._ranges)
        self._map = BeaconMap(self.engine, (*range(POSE), *range(ranges.stop, self._shared.stop), *ranges))
        self._transport = HeadingTransport(self.engine) if how.transports else None
        # Innovations show only the new part of a persistent error: no noise is learned below the configured one.
        least = dict.fromkeys(models.by_kind, 1.0) if correlation_s > 0.0 else {}
        self.levels = {
            kind: NoiseLevel(how.learn_prior, how.learn_memory, least.get(kind, 1.0 / FURTHEST))
            for kind in (*models.by_kind, "motion")
        }
        self._learns = how.learn_memory > 0.0
        self._fresh = AddedPoseNoise()
        self._gate, self._knee, self._iterations = gate, how.knee_sigmas, iterations
        self.refused_in_a_row, self.jumps, self.unplaced = 0, 0, 0
        self.moved: list[tuple[BeaconId, float]] = []
        self.left: list[tuple[BeaconId, float, BeaconEstimate]] = []
        self.walks_m2_s: dict[BeaconId, float] = {}
        self._way_m = 0.0
        self.waiting: dict[BeaconId, PendingLandmark] = {}
        self.learned: list[BeaconInnovation] = []

    @property
    def pose(self) -> VehiclePose:
        """Pose after the last odometry that is due; the heading does not wrap."""
        return VehiclePose(*self.engine.mean[:POSE].tolist())

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance of x_m, y_m, heading_rad, shape (3, 3)."""
        return self.engine.covariance[:POSE, :POSE].copy()

    def error_covariance(self, columns: slice | Columns, excess: Mapping[str, tuple[float, float]]) -> FloatArray:
        """Covariance of the errors of states, (k, k), if calibrations vary more than their priors assume.

        ``excess``: assumed and actual prior variance of calibrations by name: see ``Factored.spread_by``.
        """
        P = self.engine.covariance[columns][:, columns].copy()
        heights = [(self.place(b).stop - 1, HEIGHT_M2) for b in self._map if b in self._raised]
        for i, name in (*enumerate(self._names, POSE), *heights):
            assumed, actual = excess.get(name, (1.0, 0.0))
            if actual > assumed:
                by_mean = self.engine.covariance[columns, i] / assumed
                P += (actual - assumed) * (by_mean[:, None] * by_mean)
        return P

    @property
    def beacons(self) -> dict[BeaconId, BeaconEstimate]:
        """The map."""
        x, P, place = self.engine.mean, self.engine.covariance, self.engine.block
        return {b: BeaconEstimate(x[place(b)].copy(), P[place(b), place(b)].copy()) for b in self._map}

    @property
    def calibration(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation of each estimated calibration parameter, by name."""
        mean, variances = self.engine.mean.tolist(), self.engine.covariance.diagonal().tolist()
        return {name: (mean[POSE + i], sqrt(variances[POSE + i])) for i, name in enumerate(self._names)}

    @property
    def calibration_states(self) -> dict[str, int]:
        """State of each estimated calibration parameter by name, also of the square of the height of each beacon."""
        heights = {f"{HEIGHT_M2} {b}": self.place(b).stop - 1 for b in self._map if b in self._raised}
        return {name: POSE + i for i, name in enumerate(self._names)} | heights

    def predict(self, odometry: Odometry) -> None:
        """Predict the vehicle over the odometry that is due."""
        delay_s = float(self.engine.mean[self._delay]) if self._delay >= 0 else 0.0
        for step in self._clock.due(odometry, delay_s):
            self._step(step)

    def _step(self, odometry: Odometry) -> None:
        engine, motion = self.engine, self._motion
        before = engine.mean[: engine.vehicle_size].copy()
        mean, F, Q = motion.step(before, odometry)
        if self._learns:
            Q *= self.levels["motion"].factor
            self._fresh.step(F, Q)
        if isinstance(odometry, Increment) and odometry.guess_m2 > 0.0:
            # added after the learned noise: a guessed motion has no information about the noise of odometry
            Q[range(POSE), range(POSE)] += odometry.guess_m2, odometry.guess_m2, odometry.guess_rad2
        engine.predict(mean, F, Q)
        self._way_m += self._clock.took(odometry, before, mean)
        if (rest := motion.at_rest(odometry)) is not None:
            column, bias, variance = rest
            self._correct(column, bias - float(engine.mean[column]), variance)

    def observe(self, readings: Iterable[Reading]) -> list[BeaconInnovation]:
        """Process readings one after the other; readings of beacons that are not on the map wait until it can join."""
        self.learned = []
        for reading in readings:
            entry, before = self._map.get(reading.beacon), self.engine.mean.copy()
            if entry is not None:
                self.learned.append(self._update(reading, entry))
                if entry.on_trial and reading.beacon not in self._map and not is_direction(reading):
                    before = self.engine.mean.copy()
                    self._begin(reading)
            elif is_direction(reading):
                self.unplaced += 1  # the beacon may lie anywhere along the bearing
            else:
                self._begin(reading)
            self._follow(before)
        return self.learned

    def _follow(self, before: FloatArray) -> None:
        if self._transport is not None:
            self._transport.follow(before)

    def correct_heading(self, off_rad: float, sigma_rad: float) -> float:
        """Update with a measured heading that differs from the estimate by ``off_rad``; returns its NIS."""
        return self._correct(HEADING, off_rad, sigma_rad**2)

    def _correct(self, column: int, residual: float, variance: float) -> float:
        before = self.engine.mean.copy()
        found = self.engine.update_row(np.array((column,)), np.ones(1), residual, variance)
        self._follow(before)
        return found.nis

    def marginal(
        self, time_s: float, names: Sequence[str], beacons: Sequence[BeaconId]
    ) -> tuple[FloatArray, FloatArray]:
        """Pose at a time, (3,), and the covariance of pose, named calibration and places of beacons, (k, k)."""
        columns = self._columns(names, beacons)
        pose = self._at(time_s).pose
        return np.array(pose), self.engine.covariance[np.ix_(columns, columns)].copy()

    def replace(
        self, time_s: float, names: Sequence[str], beacons: Sequence[BeaconId], mean: FloatArray, covariance: FloatArray
    ) -> None:
        """Replace the estimate of the pose at a time, named calibration and places of beacons, in this order."""
        at, mean = self._at(time_s), mean.copy()
        mean[:POSE] += self.engine.mean[:POSE] - at.pose  # the state is the pose after the odometry that is due
        self.engine.replace(self._columns(names, beacons), mean, covariance)

    def know(self, known: KnownMap, kinds: Mapping[BeaconId, str]) -> None:
        """Put beacons on the map before any reading. ``kinds``: of the readings of each, as in the models."""
        for name, place_m in zip(known.names, known.places_m, strict=True):
            extra = self._extra_prior(name, kinds[name])
            means, sigmas = zip((place_m[0], 1.0), (place_m[1], 1.0), *extra, strict=True)
            self._map.join(name, np.array(means), np.diag(np.square(sigmas)))
        starts = [self.engine.block(name).start for name in known.names]
        columns = columns_of(*((start, start + 1) for start in starts))
        self.engine.replace(columns, known.places_m.ravel(), known.covariance_m2)

    def _extra_prior(self, beacon: BeaconId, kind: str) -> tuple[tuple[float, float], ...]:
        height = ((0.0, self._raised[beacon]),) if beacon in self._raised else ()
        return (*height, *self._models.by_kind[kind].extra_prior)

    def likely(self) -> dict[BeaconId, FloatArray]:
        """Places x_m, y_m of waiting beacons that have one likely place, though readings bend over its width."""
        found = {}
        for name, waiting in self.waiting.items():
            if len(waiting.records) >= LEAST and math.isfinite(waiting.records[-1].reading.range_m):
                candidate = waiting.found(self.engine, AGAIN)
                if candidate is not None:
                    found[name] = candidate.mean[:PLACE]
        return found

    def join(self, beacon: BeaconId, place_m: FloatArray) -> None:
        """Put a waiting beacon on the map, with a flat prior about a place, (2,); its waiting readings are dropped."""
        waiting = self.waiting.pop(beacon)
        self._map.join(beacon, *self._prior_at(waiting, *place_m.tolist()))
        waiting.drop(self.engine)
        self._map.renumber()

    def take_noise(self, beacon: BeaconId, radio: Radio | None, variance: float, share: float, lasts_s: float) -> None:
        """Use a noise of a beacon's ranges by a radio.

        Factor on the configured variance, share that lasts, correlation time.
        """
        if beacon in self._map and (share > 0.0 or self._wander is None):
            self._map[beacon].heard_by(radio).noise = LearnedNoise(variance, GaussMarkovBias(share, inf, lasts_s))

    def take_odometry_noise(self, noise: OdometryNoiseConfig) -> None:
        """Use this noise of the odometry from now on, and learn none."""
        if isinstance(self._motion, DifferentialDrive):
            self._motion.noise = noise
        self.levels["motion"] = NoiseLevel(0.0, 0.0, 1.0)

    def _columns(self, names: Sequence[str], beacons: Sequence[BeaconId]) -> Columns:
        calibration = [POSE + self._names.index(name) for name in names]
        return columns_of(range(POSE), calibration, *map(self.place, beacons))

    def place(self, beacon: BeaconId) -> slice:
        """Columns of a beacon's place, and of the square of its height if that is estimated."""
        start = self.engine.block(beacon).start
        return slice(start, start + PLACE + (beacon in self._raised))

    def remove(self, beacon: BeaconId) -> None:
        """Remove a beacon; its next reading initialises it again. Raises BlockError: there was no reading of it."""
        if (waiting := self.waiting.pop(beacon, None)) is not None:
            waiting.drop(self.engine)
            self._map.renumber()
        elif beacon in self._map:
            self._map.leave(beacon)
        else:
            raise BlockError(beacon, "is not on the map")

    def _begin(self, reading: Reading) -> None:
        """Keep a reading of a new beacon with the pose where it was taken; add the beacon to the map if possible."""
        engine, name = self.engine, reading.beacon
        kind, z = scalars_of(reading)[-1]
        model = self._models.by_kind[kind]
        reach_m, at = model.distance_m(z, name), self._at(reading.time_s)
        there = self._radio_at(at.pose, reading.radio, self.engine.mean[self._of_place].tolist())
        waiting = self.waiting.setdefault(name, PendingLandmark(name))
        record = ReadingRecord(reading, ("place", name, waiting.count), reach_m)
        if reading.bearing_rad is not None:
            waiting.take(engine, record, *self._clone(at, there, POSE))
        elif waiting.is_apart(engine, record, there.pose):
            waiting.take(engine, record, *self._clone(at, there, PLACE))
            waiting.thin(engine)
        else:
            return

        self._place_new(waiting)
        self._map.renumber()

    def _place_new(self, waiting: PendingLandmark) -> None:
        """A reading with a bearing adds the beacon at once, on trial; without bearings several readings must agree."""
        is_pointed = waiting.pointed(self.engine) is not None
        if len(waiting.records) >= LEAST or is_pointed:
            self._look(waiting)
            found = waiting.candidates[0] if is_pointed and waiting.candidates else waiting.found(self.engine)
            if found is not None:
                self._join(waiting, found)
                self._map[waiting.beacon].on_trial = TRIAL if is_pointed else 0

    def _prior_at(self, waiting: PendingLandmark, x_m: float, y_m: float) -> BeaconEstimate:
        last = waiting.records[-1]
        extra = self._extra_prior(waiting.beacon, scalars_of(last.reading)[-1][0])
        sigma_m = self.flat * last.distance_m
        means, sigmas = zip((x_m, sigma_m), (y_m, sigma_m), *extra, strict=True)
        return BeaconEstimate(np.array(means), np.diag(np.square(sigmas)))

    def _look(self, waiting: PendingLandmark) -> None:
        waiting.look(self.engine, self._stacked(waiting), partial(self._prior_at, waiting))

    def _clone(self, at: CarriedOdometry, there: RadioPose, size: int) -> tuple[FloatArray, Columns, FloatArray]:
        """Copy of a radio's pose or place, (size,); the columns it depends on; its derivatives by these, (size, k)."""
        J = [self._by_place(at, there, unit) for unit in UNITS[:size]]
        columns = columns_of(range(POSE), self._of_place)
        return np.array(there.pose[:size]), columns, np.array(J)

    def _stacked(self, waiting: PendingLandmark) -> StackedRows:
        def rows_of(kind: str, poses: FloatArray, calibration: list[float], beacons: FloatArray) -> MeasurementRows:
            rows = self._models.by_kind[kind].rows(poses, calibration[: self._ranges], beacons, waiting.beacon)
            return rows._replace(variance=rows.variance * self.levels[kind].factor)

        walk_m2_s = self.walks_m2_s.get(waiting.beacon, 0.0)
        return StackedRows(self.engine, waiting.records, self._shared, rows_of, walk_m2_s)

    def _join(self, waiting: PendingLandmark, found: Candidate) -> None:
        """Add a beacon to the map: an iterated update of the whole state with all of its waiting readings."""
        engine, rows = self.engine, self._stacked(waiting)
        centre = waiting.pointed(engine) or found.mean[:PLACE].tolist()
        self._map.join(waiting.beacon, *self._prior_at(waiting, *centre))
        block = engine.block(waiting.beacon)

        def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            H, G, residual, _ = rows.at(x, x[block].tolist())
            return residual, np.hstack([H, G])

        start = engine.mean.copy()
        start[block] = found.mean
        columns = columns_of(rows.columns.tolist(), block)
        engine.update_iterated(columns, linearise, found.variances, self.linearisations, start=start)
        entry = self._map[waiting.beacon]
        entry.walked_s = entry.used_s = waiting.records[-1].reading.time_s
        waiting.drop(engine)
        del self.waiting[waiting.beacon]
        self._map.renumber()

    def _at(self, time_s: float) -> CarriedOdometry:
        """Pose at a time."""
        x = self.engine.mean
        return self._clock.at(x[:POSE].tolist(), time_s, float(x[self._delay]) if self._delay >= 0 else 0.0)

    def _update(self, reading: Reading, entry: MapEntry) -> BeaconInnovation:
        """Process the bearing first; if it is refused, the rest of the reading is refused, too."""
        if reading.beacon in self.walks_m2_s:
            self._map.walk_to(reading.beacon, self.walks_m2_s[reading.beacon], reading.time_s)
        heard = entry.heard_by(reading.radio)
        bias = self._wander if heard.noise is None else heard.noise.bias
        if bias is not None and (bias.share > 0.0 or heard.wander >= 0) and not is_direction(reading):
            self._map.wander_to(reading.beacon, reading.radio, bias, self._way_m, reading.time_s)
        nis, spread, size, accepted = 0.0, 1.0, 0, True
        for kind, z in scalars_of(reading):
            if accepted:
                found = self._take(reading, entry.size, heard, kind, z)
                nis, spread, size, accepted = nis + found.nis, spread * found.spread, size + 1, found.accepted
        if self._learns:
            self._fresh.clear()
        if accepted:
            entry.used_s = reading.time_s
        self._judge(reading, entry, accepted=accepted)
        return BeaconInnovation(reading.beacon, nis, size, accepted, nis + log(spread), reading.radio)

    def _take(self, reading: Reading, size: int, heard: RadioErrors, kind: str, z: float) -> RowUpdate:
        engine, columns = self.engine, heard.columns
        prior = engine.mean[columns]
        h, residual, r, own = self._linearised(reading, size, heard, kind, z, prior.tolist())
        if self._iterations > 1:
            P = engine.covariance[np.ix_(columns, columns)]
            for _ in range(self._iterations - 1):
                Ph = P.dot(h)
                x = prior + Ph * (residual / (float(Ph.dot(h)) + r))
                h, residual, r, own = self._linearised(reading, size, heard, kind, z, x.tolist())
                residual += float((x - prior).dot(h))
        found = engine.update_row(columns, np.array(h), residual, r, self._gate, self._knee)
        if found.accepted and self._learns:
            self.levels[kind].learn(found.nis, own / found.spread)
            self.levels["motion"].learn(found.nis, self._fresh.seen(*h[:POSE]) / found.spread)
        return found

    def _linearised(
        self, reading: Reading, size: int, heard: RadioErrors, kind: str, z: float, x: list[float]
    ) -> tuple[list[float], float, float, float]:
        """Derivatives by the columns of ``heard``, residual, variance of the white noise, and of all noise.

        The last one includes the part of the wandering error that is new since the previous reading.
        """
        is_delayed, shown = self._delay >= 0, self._shown
        at = self._clock.at(x, reading.time_s, x[POSE] if is_delayed else 0.0)
        calibration, beacon = x[shown - self._ranges : shown], x[shown : shown + size]
        there = self._radio_at(at.pose, reading.radio, x[POSE : shown - self._ranges])
        row = self._models.by_kind[kind].row(there.pose, calibration, beacon, reading.beacon)
        h = [*self._by_place(at, there, row.pose), *row.calibration, *row.beacon]
        expected = row.expected
        is_learned = heard.noise is not None and kind == "range"
        bias = heard.noise.bias if heard.noise is not None and is_learned else self._wander
        level = heard.noise.variance if heard.noise is not None and is_learned else self.levels[kind].factor
        r = own = row.variance * level
        if heard.wander >= 0:
            share = 0.0 if bias is None or kind == "bearing" else bias.share
            by_wander = sqrt(share * r)
            h.append(by_wander)
            expected += by_wander * x[-1]
            r *= 1.0 - share
            own = r + heard.fresh * by_wander * by_wander
        residual = wrap_pi(z - expected) if kind == "bearing" else z - expected
        return h, residual, r, own

    def _radio_at(self, pose: list[float], radio: Radio | None, values: list[float]) -> RadioPose:
        """A radio on the vehicle at a pose. ``values``: of the states of ``_of_place``."""
        if not self._axes:
            return RadioPose.at(pose, radio)
        found = dict(zip(self._axes, values[-len(self._axes) :], strict=True))
        return RadioPose.at(pose, radio, (found.get(0, 0.0), found.get(1, 0.0)))

    def _by_place(self, at: CarriedOdometry, there: RadioPose, by: tuple[float, float, float]) -> list[float]:
        """Derivatives by the pose and the states of ``_of_place``, from those by x, y and heading of the radio."""
        by_antenna = there.by_place(*by[:2]) if self._axes else ()
        own = at.derivatives(*there.turned(*by), delayed=self._delay >= 0)
        return own + [by_antenna[axis] for axis in self._axes]

    def _judge(self, reading: Reading, entry: MapEntry, *, accepted: bool) -> None:
        if accepted:
            entry.refused = self.refused_in_a_row = 0
            if entry.on_trial:
                entry.on_trial -= 1
            return
        if entry.on_trial:
            self._map.leave(reading.beacon)
            return
        entry.refused += 1
        self.refused_in_a_row += 1
        if self.refused_in_a_row >= self._how.doubt_pose_after:
            self.refused_in_a_row = 0
            v = self.engine.vehicle_size
            jump = np.zeros(v)
            jump[:POSE] = self._how.jump_m, self._how.jump_m, self._how.jump_rad
            self.engine.predict(self.engine.mean[:v].copy(), np.eye(v), np.diag(jump**2))
            self.jumps += 1
        if entry.refused >= self._how.doubt_beacon_after:
            self.left.append((reading.beacon, entry.used_s, self.beacons[reading.beacon]))
            self._map.leave(reading.beacon)
            self.moved.append((reading.beacon, reading.time_s))


def recorded_slam(
    cfg: RecordingConfig, how: SlamFilterConfig, pose0: VehiclePose | Sequence[float], P0: FloatArray,
    raised: Collection[BeaconId] | None = None,
) -> BeaconSlam:  # fmt: skip
    """The filter for recorded runs.

    ``raised``: beacons whose heights are estimated, and with them the place of the antenna; None: neither is.
    """
    antenna = {} if raised is None else {name: getattr(cfg.priors, name) for name in ANTENNA}
    return BeaconSlam(
        DifferentialDrive(cfg.odometry, cfg.priors, how), recorded_models(cfg.radio, cfg.priors), how, pose0, P0,
        gate=cfg.radio.gate_sigmas**2, delay_sigma_s=cfg.priors.odometry_delay_s, correlation_s=cfg.radio.correlation_s,
        antenna_sigmas_m=antenna, height_sigmas_m2=dict.fromkeys(raised or (), cfg.priors.beacon_height_m2),
    )  # fmt: skip
