"""Pure. EKF-SLAM among radios of which levels and bearings are heard: static shadowing on the map, one that moves."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import cos, hypot, log, log10, sin, sqrt

import numpy as np

from ccatp.angles import wrap_pi
from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import Columns, EkfSlam, Update, columns_of
from ccatp.radio.motion import POSE, MotionModel, Odometry, Pose
from ccatp.radio.moving_radio import MovingRadio
from ccatp.radio.path_loss import PathLoss
from ccatp.radio.readings import BeaconId, RssiReading
from ccatp.radio.shadowing_map import ShadowingMap
from ccatp.radio.slam import BeaconEstimate, Learned

PLACE = 2  # x_m, y_m: the first states of a radio
_ITERATIONS = 4
_FIRST_ITERATIONS = 10
_WIDE = 10.0  # spread of a radio before its first reading, in ranges of that reading
_NEAREST_M = 0.02  # nearer than that neither level nor bearing has a derivative worth the name
_DB_PER_NEPER = 10.0 / log(10.0)

Linearise = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


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
        return {beacon: self._place(beacon) for beacon in self._names()}

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
        """Take readings of any radios, one after the other; new ones join at their first bearing.

        A new radio of which no bearing is known is not used: a level alone is a circle.
        """
        self.learned = []
        for reading in readings:
            if reading.beacon in self.engine:
                found = self._update(reading, _ITERATIONS, gated=True)
                self.learned.append(Learned(reading.beacon, found.residual, found.nis, found.size, found.accepted))
            elif reading.bearing_rad is not None:
                self._join(reading, reading.bearing_rad)
                self._update(reading, _FIRST_ITERATIONS, gated=False)
        return self.learned

    def remove(self, beacon: BeaconId) -> None:
        """Forget a radio; one that is heard again begins anew.

        Raises:
            BlockError: it is not on the map.
        """
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

    def _join(self, reading: RssiReading, bearing_rad: float) -> None:
        """At range and bearing, spread so widely that the reading alone places it."""
        settings, pose = self.settings, self.pose
        range_m = self.path_loss_of(reading.beacon).median_range_m(reading.rssi_dbm)
        way_rad = pose.heading_rad + bearing_rad
        place = [pose.x_m + range_m * cos(way_rad), pose.y_m + range_m * sin(way_rad)]
        spread = [_WIDE * range_m] * PLACE
        if self._is_moving(reading.beacon) and settings.moving is not None:
            spread += settings.moving.prior_sigmas
        elif settings.shadowing is not None:
            spread += [1.0] * settings.shadowing.size
        mean = np.zeros(len(spread))
        mean[:PLACE] = place
        none: Columns = np.empty(0, dtype=np.intp)
        self.engine.augment(
            reading.beacon, mean, none, np.zeros((mean.size, 0)), np.eye(mean.size), np.diag(np.square(spread))
        )

    def _update(self, reading: RssiReading, iterations: int, *, gated: bool) -> Update:
        block = self.engine.block(reading.beacon)
        shadow, rest_db2 = self._shadow(reading.beacon)
        of_radio = range(block.start, block.start + PLACE)
        columns = columns_of(range(POSE), of_radio, range(block.stop - shadow.size, block.stop))
        path_loss = self.path_loss_of(reading.beacon)
        variances = [path_loss.sigma_db**2 + rest_db2]
        if reading.bearing_rad is not None:
            variances.append(self.settings.bearing_sigma_rad**2)
        gate = self.settings.gates[len(variances) - 1] if gated else np.inf
        linearise = _linearised(reading, path_loss, columns, shadow)
        return self.engine.update_iterated(columns, linearise, np.array(variances), iterations, gate)

    def _shadow(self, beacon: BeaconId) -> tuple[FloatArray, float]:
        """Derivatives of a level by the shadowing states, which end a radio's block, and the variance of the rest."""
        settings = self.settings
        if self._is_moving(beacon) and settings.moving is not None:
            return settings.moving.shadowing_row, 0.0
        if settings.shadowing is None:
            return np.empty(0), settings.shadowing_sigma_db**2
        pose = self.pose
        return settings.shadowing.row(pose.x_m, pose.y_m)


def _linearised(reading: RssiReading, path_loss: PathLoss, columns: Columns, shadow: FloatArray) -> Linearise:
    """Residual and Jacobian of a reading over pose, place and shadowing, as functions of the state."""
    slope = _DB_PER_NEPER * path_loss.exponent
    size = columns.size

    def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        values = x.take(columns)
        px, py, heading, bx, by = values[: POSE + PLACE].tolist()
        dx, dy = bx - px, by - py
        r = max(hypot(dx, dy), _NEAREST_M)
        q = r * r
        expected = path_loss.reference_dbm - 10.0 * path_loss.exponent * log10(r)
        expected += float(shadow @ values[POSE + PLACE :])
        H = np.zeros((1 if reading.bearing_rad is None else 2, size))
        H[0, : POSE + PLACE] = slope * dx / q, slope * dy / q, 0.0, -slope * dx / q, -slope * dy / q
        H[0, POSE + PLACE :] = shadow
        if reading.bearing_rad is None:
            return np.array((reading.rssi_dbm - expected,)), H
        H[1, : POSE + PLACE] = dy / q, -dx / q, -1.0, -dy / q, dx / q
        off_rad = wrap_pi(reading.bearing_rad - (np.arctan2(dy, dx) - heading))
        return np.array((reading.rssi_dbm - expected, off_rad)), H

    return linearise
