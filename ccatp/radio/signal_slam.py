"""Pure. EKF-SLAM among radios of which levels and bearings are heard: static shadowing on the map, one that moves."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import cos, hypot, sin, sqrt

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import Columns, EkfSlam, Update, columns_of
from ccatp.radio.motion import POSE, MotionModel, Odometry, Pose
from ccatp.radio.moving_radio import MovingRadio
from ccatp.radio.path_loss import PathLoss
from ccatp.radio.readings import BeaconId, RssiReading
from ccatp.radio.shadowing_map import ShadowingMap
from ccatp.radio.signal_newcomers import Guess, Newcomers, PoseKey, Record
from ccatp.radio.signal_rows import PLACE, Rows, Sight, rows_of
from ccatp.radio.slam import BeaconEstimate, Learned

_ITERATIONS = 4
_FIRST_ITERATIONS = 10
_WIDE = 10.0  # spread of a radio before its first reading, in ranges of that reading
_NEAREST_M = 0.02  # nearer than that a distance has no derivative worth the name
_PLACED = 0.15  # of the range: a place that is this sure bends the model by about 1 % (second order)
_MOST_WAITING = 16  # scans; each keeps three states until the radio joins


@dataclass(frozen=True, slots=True)
class SignalSettings:
    """What ``SignalSlam`` is told.

    Attributes:
        motion: the vehicle.
        path_loss: of each radio that has a calibration of its own; ``sigma_db`` is the white noise.
        default: of all others.
        bearing_sigma_rad: noise and steps of a bearing.
        shadowing_sigma_db: standard deviation of static shadowing; 0: none.
        shadowing: its map, for static radios; None: what there is of it counts as white noise.
        moving: the radio that moves; None without one.
        gates: largest normalised innovation squared that is used, of one row and of two.
    """

    motion: MotionModel
    path_loss: Mapping[BeaconId, PathLoss]
    default: PathLoss
    bearing_sigma_rad: float
    shadowing_sigma_db: float
    shadowing: ShadowingMap | None
    moving: MovingRadio | None
    gates: tuple[float, float]


class SignalSlam:
    """EKF-SLAM of a vehicle among radios, by ``EkfSlam``; levels are used as they are, in dB.

    A level is z = P_ref - 10 eta log10(r) + b + noise with b the static shadowing, a bearing
    beta = atan2(dy, dx) - heading + noise (Auth and Hovey 2018, eqs 2.3 and 2.9). States of a static radio:
    x_m, y_m, and those of its shadowing where there is a map of it; of the moving one: x_m, y_m, its velocity, and its
    shadowing where there is any. Updates are iterated (Gauss-Newton on the posterior), because an error of 18 degrees
    is too large for one linearisation.

    Args:
        settings: vehicle and radios.
        pose0: where the vehicle begins; it defines the frame of the map.
        P0: covariance of that, shape (3, 3).
    """

    def __init__(self, settings: SignalSettings, pose0: Pose | Sequence[float], P0: FloatArray) -> None:
        self.settings = settings
        sigmas = np.array(settings.motion.prior_sigmas)
        v = POSE + sigmas.size
        mean, P = np.zeros(v), np.zeros((v, v))
        mean[:POSE], P[:POSE, :POSE] = pose0, P0
        P[range(POSE, v), range(POSE, v)] = sigmas**2
        self.engine = EkfSlam(mean, P)
        self.learned: list[Learned] = []
        self.newcomers = Newcomers(self.engine)
        self._guesses: dict[BeaconId, BeaconEstimate] = {}

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
        """The map: places alone, x_m and y_m."""
        return {**self._guesses, **{beacon: self._place(beacon) for beacon in self._names()}}

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
        self.engine.predict(*step)
        moving = self.settings.moving
        if moving is not None and moving.beacon in self.engine:
            travel_m = hypot(step.mean[0] - before[0], step.mean[1] - before[1])
            moving.predict(self.engine, odometry.interval_s, travel_m)

    def observe(self, readings: Iterable[RssiReading]) -> list[Learned]:
        """Take readings of any radios, one after the other; new ones are placed when their readings suffice.

        A new radio of which no bearing is known is not used: a level alone is a circle.
        """
        self.learned = []
        waiting = []
        for reading in readings:
            if reading.beacon in self.engine:
                found = self._update(reading)
                self.learned.append(Learned(reading.beacon, found.residual, found.nis, found.size, found.accepted))
            elif not self._is_moving(reading.beacon):
                waiting.append(reading)
            elif reading.bearing_rad is not None:
                self._meet(reading, reading.bearing_rad)
        self._wait(waiting)
        return self.learned

    def remove(self, beacon: BeaconId) -> None:
        """Forget a radio; one that is heard again begins anew.

        Raises:
            BlockError: it is not on the map.
        """
        if beacon in self._guesses:
            self.newcomers.drop(beacon)
            del self._guesses[beacon]
            return
        self.engine.remove(beacon)

    def distance(self, beacon: BeaconId) -> tuple[float, float]:
        """Between the vehicle and a radio, m, and its standard deviation.

        Raises:
            BlockError: it is not on the map.
        """
        start = self.engine.block(beacon).start
        columns = columns_of(range(PLACE), range(start, start + PLACE))
        x, y, bx, by = self.engine.mean.take(columns).tolist()
        r = max(hypot(bx - x, by - y), _NEAREST_M)
        ux, uy = (bx - x) / r, (by - y) / r
        return r, sqrt(max(self.engine.spread(columns, np.array((-ux, -uy, ux, uy))), 0.0))

    def path_loss_of(self, beacon: BeaconId) -> PathLoss:
        """The calibration of a radio."""
        return self.settings.path_loss.get(beacon, self.settings.default)

    def _names(self) -> list[BeaconId]:
        return [block for block in self.engine.blocks if isinstance(block, int | str)]

    def _place(self, beacon: BeaconId) -> BeaconEstimate:
        start = self.engine.block(beacon).start
        place = slice(start, start + PLACE)
        return BeaconEstimate(self.engine.mean[place].copy(), self.engine.covariance[place, place].copy())

    def _is_moving(self, beacon: BeaconId) -> bool:
        return self.settings.moving is not None and beacon == self.settings.moving.beacon

    def _prior(self, reading: RssiReading, bearing_rad: float, pose: Sequence[float]) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviations of a radio at a range and bearing, spread so widely that readings place it."""
        settings = self.settings
        range_m = self.path_loss_of(reading.beacon).median_range_m(reading.rssi_dbm)
        way_rad = pose[2] + bearing_rad
        spread = [_WIDE * range_m] * PLACE
        if self._is_moving(reading.beacon) and settings.moving is not None:
            spread += settings.moving.prior_sigmas
        elif settings.shadowing is not None:
            spread += [1.0] * settings.shadowing.size
        mean = np.zeros(len(spread))
        mean[:PLACE] = pose[0] + range_m * cos(way_rad), pose[1] + range_m * sin(way_rad)
        return mean, np.array(spread)

    def _augment(self, beacon: BeaconId, mean: FloatArray, spread: FloatArray) -> None:
        none: Columns = np.empty(0, dtype=np.intp)
        covariance = np.diag(spread**2)
        self.engine.augment(beacon, mean, none, np.zeros((mean.size, 0)), np.eye(mean.size), covariance)

    def _meet(self, reading: RssiReading, bearing_rad: float) -> None:
        """The radio that moves joins at once: it would be elsewhere later."""
        self._augment(reading.beacon, *self._prior(reading, bearing_rad, self.pose))
        rows = self._rows([self._sight(reading, 0)], reading.beacon, self.engine.block(reading.beacon))
        self.engine.update_iterated(rows.columns, rows.linearise, rows.variances, _FIRST_ITERATIONS)

    def _wait(self, readings: list[RssiReading]) -> None:
        """Readings of static radios that are not on the map yet."""
        if not readings:
            return
        pose = self.newcomers.keep_pose()
        for reading in readings:
            self.newcomers.add(reading, pose)
        for reading in readings:
            records = self.newcomers.records(reading.beacon)
            first = next((record for record in records if record.reading.bearing_rad is not None), None)
            if first is None:
                continue  # a level alone is a circle
            start, spread = self._start(first)
            guess = self.newcomers.guess(reading.beacon, start, spread, self._rows_at)
            self._guesses[reading.beacon] = BeaconEstimate(guess.mean[:PLACE], guess.covariance[:PLACE, :PLACE])
            if len(records) >= _MOST_WAITING or self._is_placed(reading.beacon):
                self._settle(reading.beacon, start, spread, guess)

    def _start(self, first: Record) -> tuple[FloatArray, FloatArray]:
        bearing_rad = first.reading.bearing_rad or 0.0
        return self._prior(first.reading, bearing_rad, self.engine.mean[self.engine.block(first.pose)].tolist())

    def _is_placed(self, beacon: BeaconId) -> bool:
        """Whether the place is so sure that its error does not bend the model."""
        estimate, pose = self._guesses[beacon], self.pose
        range_m = hypot(estimate.mean[0] - pose.x_m, estimate.mean[1] - pose.y_m)
        return float(np.linalg.eigvalsh(estimate.covariance)[-1]) < (_PLACED * range_m) ** 2

    def _settle(self, beacon: BeaconId, start: FloatArray, spread: FloatArray, guess: Guess) -> None:
        """A radio joins the map with all that waits of it; the rest of the state learns from it, too.

        The model is linearised at the guess: from the prior the way there is long, and not safe without its damping.
        """
        self._augment(beacon, start, spread)
        rows = self._rows_at(
            self.newcomers.records(beacon), lambda key: self.engine.block(key).start, self.engine.block(beacon)
        )
        prior, x = self.engine.mean, self.engine.mean.copy()
        x[guess.poses], x[self.engine.block(beacon)] = guess.poses_mean, guess.mean
        residual, H = rows.linearise(x)
        self.engine.update(rows.columns, H, residual + H @ (x - prior)[rows.columns], rows.variances)
        self.newcomers.drop(beacon)
        del self._guesses[beacon]

    def _update(self, reading: RssiReading) -> Update:
        rows = self._rows([self._sight(reading, 0)], reading.beacon, self.engine.block(reading.beacon))
        gate = self.settings.gates[rows.variances.size - 1]
        return self.engine.update_iterated(rows.columns, rows.linearise, rows.variances, _ITERATIONS, gate)

    def _rows_at(self, records: list[Record], pose_at: Callable[[PoseKey], int], radio: slice) -> Rows:
        sights = []
        for record in records:
            place = self.engine.block(record.pose).start
            sights.append(self._sight(record.reading, place)._replace(pose=pose_at(record.pose)))
        return self._rows(sights, records[0].reading.beacon, radio)

    def _rows(self, sights: list[Sight], beacon: BeaconId, radio: slice) -> Rows:
        return rows_of(sights, radio, self.path_loss_of(beacon), self.settings.bearing_sigma_rad)

    def _sight(self, reading: RssiReading, pose: int) -> Sight:
        """A reading taken at the pose that begins at a column."""
        x_m, y_m = self.engine.mean[pose : pose + PLACE].tolist()
        shadow, rest_db2 = self._shadow(reading.beacon, x_m, y_m)
        return Sight(reading, pose, shadow, self.path_loss_of(reading.beacon).sigma_db ** 2 + rest_db2)

    def _shadow(self, beacon: BeaconId, x_m: float, y_m: float) -> tuple[FloatArray, float]:
        """Derivatives of a level by the shadowing states, which end a radio's block, and the variance of the rest."""
        settings = self.settings
        if self._is_moving(beacon) and settings.moving is not None:
            return settings.moving.shadowing_row, 0.0
        if settings.shadowing is None:
            return np.empty(0), settings.shadowing_sigma_db**2
        return settings.shadowing.row(x_m, y_m)
