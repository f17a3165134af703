"""EKF-SLAM by levels and bearings of radios, one of which moves; bearings from packets of a rotating reflector."""

from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from math import atan2, cos, exp, hypot, log, pi, sin, sqrt, tau

import numpy as np
from scipy.special import chdtri

from ccatp.beacons.config.models import RadioConfig, ScanConfig, SlamFilterConfig
from ccatp.beacons.estimation.beacon_slam import BeaconInnovation, BeaconSlam
from ccatp.beacons.estimation.landmark_init import PLACE, PendingLandmark, StackedRows
from ccatp.beacons.estimation.measurement_models import BearingModel, LevelModel, MeasurementModels, ShadowingMap
from ccatp.beacons.estimation.motion import POSE, Odometry, SlippingVehicle, VehiclePose
from ccatp.beacons.estimation.path_loss import PathLoss
from ccatp.beacons.estimation.recording import BeaconEstimate, BeaconId, Reading
from ccatp.beacons.filters.ekf_slam import Columns, EkfSlam, Update, columns_of
from ccatp.core import FloatArray
from ccatp.kinematics import wrap_pi

_ITERATIONS = 4
_NEAREST_M = 0.02  # smallest distance, so that derivatives of the distance exist
# The standard EKF: no robust weights, no learned noise, no check for jumps of the pose or moved radios.
_PLAIN = SlamFilterConfig(
    knee_sigmas=1e3, learn_memory=0.0, learn_prior=1.0, doubt_pose_after=10**9, doubt_beacon_after=10**9,
    beacon_walk_m_sqrt_s=1.0, jump_m=1.0, jump_rad=1.0, transports=False, wander_share=0.0, wander_length_m=1.0,
    rest_speed_m_s=0.0, rest_turn_rad_s=0.0, turn_bias_walk_rad_s_sqrt_s=0.0,
)  # fmt: skip
_APART_RAD = pi / 2.0  # strongest readings further apart than this are two directions, not one


@dataclass(frozen=True, slots=True)
class ReflectorScan:
    """Scans of a rotating reflector: 40 readings of one turn are steps of 9 degrees (Hevrdejs and Knoll 2017)."""

    cfg: ScanConfig

    @property
    def step_rad(self) -> float:
        """Angle between two readings."""
        return tau / self.cfg.readings

    @property
    def sigma_rad(self) -> float:
        """Standard deviation of a bearing: noise and quantisation by a step (variance step^2 / 12)."""
        return hypot(self.cfg.bearing_sigma_rad, self.step_rad / 12.0**0.5)

    def results(self, time_s: float, packets: Iterable[tuple[str, float, float]]) -> list[Reading]:
        """Level and bearing of each radio after a turn of the reflector, in the order of their first packets.

        ``packets``: radio, direction of the reflector from the heading, counter-clockwise (rad), level (dBm).
        """
        by_beacon: dict[str, list[tuple[float, float]]] = {}
        for beacon, direction_rad, level_dbm in packets:
            by_beacon.setdefault(beacon, []).append((direction_rad, level_dbm))
        found = {beacon: self._result(readings) for beacon, readings in by_beacon.items()}
        return [Reading(time_s, beacon, bearing_rad=bearing, rssi_dbm=z) for beacon, (bearing, z) in found.items()]

    def _result(self, readings: Sequence[tuple[float, float]]) -> tuple[float | None, float]:
        """Bearing or None, and level.

        Without a bearing, or with too many lost packets, the bearing is None and the level is the largest one.
        Otherwise the level is the mean of the readings within a step of the bearing.
        """
        bearing_rad = self._bearing(readings)
        strongest_dbm = max(level_dbm for _, level_dbm in readings)
        if bearing_rad is None or len(readings) / self.cfg.readings < 1.0 - self.cfg.loss_tolerance:
            return None, strongest_dbm
        levels = [z for direction, z in readings if abs(wrap_pi(direction - bearing_rad)) <= 1.01 * self.step_rad]
        levels = levels or [strongest_dbm]
        return bearing_rad, sum(levels) / len(levels)

    def _bearing(self, readings: Sequence[tuple[float, float]]) -> float | None:
        """Direction of the strongest reading, 2017 eq. 5; the mean of equally strong ones, or None if far apart."""
        strongest_dbm = max(level_dbm for _, level_dbm in readings)
        tied = [direction for direction, level_dbm in readings if level_dbm == strongest_dbm]
        c, s = sum(map(cos, tied)), sum(map(sin, tied))
        if hypot(c, s) < 1e-9 * len(tied):
            return None
        middle_rad = atan2(s, c)
        is_one = all(abs(wrap_pi(direction - middle_rad)) <= _APART_RAD / 2.0 for direction in tied)
        return middle_rad if is_one else None


class SignalSlam(BeaconSlam):
    """EKF-SLAM of a vehicle among radios with known path loss; levels are measurements in dB.

    A level is z = P_ref - 10 eta log10(r) + b + noise with b the static shadowing, a bearing
    beta = atan2(dy, dx) - heading + noise (Auth and Hovey 2018, eqs 2.3 and 2.9). States of a static radio:
    x_m, y_m, and those of its shadowing if there is a map of it; of the moving one: x_m, y_m, its velocity, and its
    shadowing if there is any.

    Updates are iterated, because an error of 18 degrees is too large for one linearisation. A level with unknown
    shadowing determines the range only up to a factor; an update linearised at that range becomes wrong when bearings
    from other places determine the range. So the readings of a new radio wait until they determine its place. A radio
    without a bearing is not used, because its place may be anywhere on a circle. A static radio lies in the room or
    within a configured distance of it: while its readings wait, a place beyond that costs as much as the same error of
    the wall.

    The vehicle begins at the start of the configuration, which defines the frame of the map.
    """

    def __init__(self, cfg: RadioConfig) -> None:
        start, loss, estimator, room_m = cfg.start, cfg.path_loss, cfg.estimator, cfg.workspace.size_m
        # Static shadowing without a map is treated as white noise.
        sigma_db = loss.shadowing_sigma_db if estimator.shadowing != "none" else 0.0
        length_m, shadowing, white_db = loss.shadowing_length_m, None, hypot(loss.white_sigma_db, sigma_db)
        if estimator.shadowing == "map" and sigma_db > 0.0:
            shadowing = ShadowingMap(room_m, estimator.shadowing_grid_m, sigma_db, length_m)
            white_db = loss.white_sigma_db
        self._loss = PathLoss(loss.reference_dbm, loss.exponent, white_db)
        self._reference_dbm_of = loss.reference_dbm_of
        bearing_sigma_rad = ReflectorScan(cfg.scan).sigma_rad
        models = MeasurementModels(
            {"bearing": BearingModel(bearing_sigma_rad, 0), "rssi": LevelModel(self.path_loss_of, shadowing=shadowing)}
        )
        P0 = np.diag(np.square((start.position_sigma_m, start.position_sigma_m, start.heading_sigma_rad)))
        beyond_m = estimator.radios_beyond_m
        self._within_m = np.array([(-beyond_m, wall_m + beyond_m) for wall_m in room_m]).T
        # The walls are known in the frame of the room, the map has the frame of the configured start.
        self._wall_variance_m2 = start.position_sigma_m**2 + (0.5 * start.heading_sigma_rad * hypot(*room_m)) ** 2
        super().__init__(
            SlippingVehicle(cfg.vehicle, cfg.odometry), models, _PLAIN, (start.x_m, start.y_m, start.heading_rad), P0,
            gate=float(chdtri(1, 1.0 - estimator.gate_probability)), iterations=_ITERATIONS,
        )  # fmt: skip
        self._ahead: SignalSlam | None = None
        # If no radio moves, this name is never received.
        speed_m_s, course_time_s = estimator.target_speed_sigma_m_s, estimator.target_course_time_s
        self._moving = MovingRadio(cfg.follow.target, speed_m_s, course_time_s, sigma_db, length_m, room_m)
        self._moving_variances = loss.white_sigma_db**2, bearing_sigma_rad**2
        self._placed_share, self._waiting_scans = estimator.placed_share, estimator.waiting_scans
        # Largest normalised innovation squared that is accepted from the moving radio, for one row and for two.
        self._gates = tuple(float(chdtri(rows, 1.0 - estimator.gate_probability)) for rows in (1, 2))

    @property
    def _likely(self) -> "SignalSlam":
        """The filter with the waiting radios on the map, at their most likely places."""
        return self if self._ahead is None else self._ahead

    @property
    def pose(self) -> VehiclePose:
        """Pose of the vehicle; the heading does not wrap."""
        return VehiclePose(*self._likely.engine.mean[:POSE].tolist())

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance of x_m, y_m, heading_rad, shape (3, 3)."""
        return self._likely.engine.covariance[:POSE, :POSE].copy()

    @property
    def beacons(self) -> dict[BeaconId, BeaconEstimate]:
        """Places x_m, y_m of all radios on the map, and the most likely places of those that wait."""
        found: dict[BeaconId, BeaconEstimate] = {}
        for beacon in self._likely.engine.blocks:
            if isinstance(beacon, int | str):
                start = self._likely.engine.block(beacon).start
                found[beacon] = BeaconEstimate(*self._of(columns_of(range(start, start + PLACE))))
        return found

    def predict(self, odometry: Odometry) -> None:
        """Predict the vehicle and the moving radio."""
        before_m = self._way_m
        super().predict(odometry)
        if self._moving.beacon in self.engine:
            self._moving.predict(self.engine, odometry.interval_s, self._way_m - before_m)
        if self._ahead is not None:
            self._ahead.predict(odometry)

    def observe(self, readings: Iterable[Reading]) -> list[BeaconInnovation]:
        """Process readings of any radios; a new static radio joins the map when its readings determine its place."""
        readings, moving, of_others, learned = list(readings), self._moving, list[Reading](), list[BeaconInnovation]()
        if self._ahead is not None:
            self._ahead.observe([reading for reading in readings if reading.beacon not in self.waiting])
        for reading in readings:
            if reading.beacon != moving.beacon:
                of_others.append(reading)
            elif moving.beacon in self.engine:
                found = self._update_moving(reading)
                learned.append(BeaconInnovation(reading.beacon, found.nis, found.size, found.accepted))
            elif reading.bearing_rad is not None:  # joins at its first bearing: it moves, so its readings cannot wait
                moving.join(self.engine, reading.bearing_rad)
                self._update_moving(reading)
        self.learned = learned + super().observe(of_others)
        if any(reading.beacon in self.waiting for reading in of_others):
            self._ahead = self._with_all()
            ready = [waiting for waiting in self.waiting.values() if self._is_ready(waiting)]
            for waiting in ready:
                self._place(waiting)
            if ready:
                self._ahead = self._with_all() if self.waiting else None
        return self.learned

    def _with_all(self) -> "SignalSlam":
        """A copy of the filter with all waiting radios on the map, however uncertain."""
        self._ahead = None
        ahead = deepcopy(self)
        for waiting in list(ahead.waiting.values()):
            ahead._place(waiting)
            self.waiting[waiting.beacon].candidates = waiting.candidates
        return ahead

    def _place(self, waiting: PendingLandmark) -> None:
        if waiting.pointed(self.engine) is not None:
            self._look(waiting)
            for likely in waiting.candidates[:1]:
                self._join(waiting, likely)

    def _stacked(self, waiting: PendingLandmark) -> StackedRows:
        return _RowsInRoom(super()._stacked(waiting), self._within_m, self._wall_variance_m2)

    def _place_new(self, waiting: PendingLandmark) -> None:
        """Does nothing: ``observe`` adds radios after it has processed all readings."""

    def _is_ready(self, waiting: PendingLandmark) -> bool:
        if waiting.beacon not in self._likely.engine:
            return False
        if len(waiting.records) >= self._waiting_scans:
            return True
        mean, covariance = self.joint((waiting.beacon,))
        x, y, _, bx, by = mean.tolist()
        if (np.clip((bx, by), *self._within_m) != (bx, by)).any():
            return False  # the walls limit the place, not the readings
        largest = float(np.linalg.eigvalsh(covariance[POSE:, POSE:])[-1])
        return largest < (self._placed_share * hypot(bx - x, by - y)) ** 2

    def distance(self, beacon: BeaconId) -> tuple[float, float]:
        """Distance from vehicle to radio and its standard deviation, m. Raises BlockError: it is not on the map."""
        start = self._likely.engine.block(beacon).start
        mean, covariance = self._of(columns_of(range(PLACE), range(start, start + PLACE)))
        x, y, bx, by = mean.tolist()
        r = max(hypot(bx - x, by - y), _NEAREST_M)
        h = np.array((x - bx, y - by, bx - x, by - y)) / r
        return r, sqrt(max(float(h @ covariance @ h), 0.0))

    @property
    def moving_velocity_m_s(self) -> tuple[float, float]:
        """Velocity of the moving radio; 0 before it was received."""
        if self._moving.beacon not in self.engine:
            return 0.0, 0.0
        start = self.engine.block(self._moving.beacon).start + PLACE
        vx, vy = self.engine.mean[start : start + PLACE].tolist()
        return vx, vy

    def joint(self, beacons: Sequence[BeaconId]) -> tuple[FloatArray, FloatArray]:
        """Joint mean (3 + 2 k,) and covariance of the pose and the places of k radios.

        Raises BlockError: one is not on the map.
        """
        starts = [self._likely.engine.block(beacon).start for beacon in beacons]
        return self._of(columns_of(range(POSE), *(range(start, start + PLACE) for start in starts)))

    def path_loss_of(self, beacon: BeaconId) -> PathLoss:
        """The calibration of a radio."""
        reference_dbm = self._reference_dbm_of.get(str(beacon))
        return self._loss if reference_dbm is None else self._loss._replace(reference_dbm=reference_dbm)

    def _of(self, columns: Columns) -> tuple[FloatArray, FloatArray]:
        engine = self._likely.engine
        return engine.mean.take(columns), engine.covariance[np.ix_(columns, columns)]

    def _update_moving(self, reading: Reading) -> Update:
        loss = self.path_loss_of(reading.beacon)
        return self._moving.update(self.engine, reading, loss, self._moving_variances, self._gates)


class _RowsInRoom(StackedRows):
    """The rows of a radio and of the walls: the distance of a coordinate beyond a wall is an error of the wall."""

    def __init__(self, rows: StackedRows, within_m: FloatArray, variance_m2: float) -> None:
        self._rows, self._within_m, self._variances_m2 = rows, within_m, np.full(PLACE, variance_m2)
        self.blocks, self.columns = rows.blocks, rows.columns

    def at_each(self, x: FloatArray, beacons: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The rows of the readings, followed by one row for each coordinate of the place."""
        H, G, e, R = self._rows.at_each(x, beacons)
        places = beacons[:, :PLACE]
        inwards = np.clip(places, *self._within_m) - places
        walls = np.eye(PLACE, beacons.shape[1]) * (inwards != 0.0)[:, :, None]
        H, variances_m2 = np.pad(H, ((0, 0), (0, PLACE), (0, 0))), np.tile(self._variances_m2, (len(beacons), 1))
        return H, np.hstack([G, walls]), np.hstack([e, inwards]), np.hstack([R, variances_m2])


_TYPICAL = 0.4  # mean distance of two points in a square, over its diagonal: 0.521 / sqrt(2), rounded up
_STATES = 4  # x_m, y_m, and the velocity


@dataclass(frozen=True, slots=True)
class MovingRadio:
    """A point whose velocity is a stationary process: standard deviation s per axis, correlation time T.

    Over t, with a = exp(-t / T): v <- a v, p <- p + T (1 - a) v, and

        var(v) += s^2 (1 - a^2),  cov(p, v) += s^2 T (1 - a)^2,  var(p) += s^2 T (2 t - T (1 - a) (3 - a))

    (Singer 1970 with the velocity instead of the acceleration). The shadowing decorrelates with the distances that both
    ends travel: b <- c b with c = exp(-(d_vehicle + d_radio) / L), d_radio = sqrt(2) s t, and
    var(b) += sigma^2 (1 - c^2).
    """

    beacon: BeaconId
    speed_sigma_m_s: float  # s
    course_time_s: float  # T
    shadowing_sigma_db: float  # sigma; 0: no such state
    shadowing_length_m: float
    room_m: tuple[float, float]  # lengths of its walls; it never leaves the room

    def join(self, engine: EkfSlam, bearing_rad: float) -> None:
        """Add the radio with a vague prior, in the direction of its first bearing; the reading itself must follow.

        The prior is Gaussian in polar coordinates about the vehicle: standard deviations of pi for the direction, and
        of a factor of two for the distance, about 0.4 times the diagonal of the room.
        """
        direction, log_range = float(engine.mean[2]) + bearing_rad, log(_TYPICAL * hypot(*self.room_m))
        behind = [self.speed_sigma_m_s] * 2
        if self.shadowing_sigma_db > 0.0:
            behind.append(self.shadowing_sigma_db)
        spread = np.array([pi, log(2.0), *behind])
        mean = np.zeros(spread.size)
        mean[:PLACE] = direction, log_range
        none: Columns = np.empty(0, dtype=np.intp)
        engine.augment(self.beacon, mean, none, np.zeros((mean.size, 0)), np.eye(mean.size), np.diag(spread**2))
        self._to_plane(engine)

    def update(
        self, engine: EkfSlam, reading: Reading, path_loss: PathLoss, variances: tuple[float, float],
        gates: Sequence[float],
    ) -> Update:  # fmt: skip
        """Update by a reading, in polar coordinates about the vehicle.

        In these coordinates level and bearing are linear: z = P_ref - (10 eta / ln 10) ln r + b, beta = direction -
        heading. In Cartesian coordinates the slope of a level changes with the estimate, so many levels with one
        unknown b would falsely determine the range (modified polar coordinates, Aidala and Hammel 1983).
        """
        self._to_polar(engine)
        slope = 10.0 * path_loss.exponent / log(10.0)
        columns = columns_of((2,), engine.block(self.beacon))
        x = engine.mean.take(columns)
        m = 1 if reading.bearing_rad is None else 2
        H = np.zeros((2, columns.size))
        H[0, 2], H[0, 1 + _STATES :] = -slope, 1.0  # the shadowing state, if there is one
        H[1, 0], H[1, 1] = -1.0, 1.0
        off_rad = wrap_pi((reading.bearing_rad or 0.0) - float(x[1] - x[0]))
        residual = np.array((reading.rssi_dbm - path_loss.reference_dbm - float(H[0] @ x), off_rad))
        found = engine.update(columns, H[:m], residual[:m], np.array(variances[:m]), gates[m - 1])
        self._to_plane(engine)
        return found

    def _to_polar(self, engine: EkfSlam) -> None:
        start = engine.block(self.beacon).start
        dx, dy = (engine.mean[start : start + PLACE] - engine.mean[:PLACE]).tolist()
        r = max(hypot(dx, dy), _NEAREST_M)
        J = np.array(((-dy, dx), (dx, dy))) / (r * r)
        _transformed(engine, start, J, -J, (atan2(dy, dx), log(r)))

    def _to_plane(self, engine: EkfSlam) -> None:
        start = engine.block(self.beacon).start
        direction, log_range = engine.mean[start : start + PLACE].tolist()
        dx, dy = exp(log_range) * cos(direction), exp(log_range) * sin(direction)
        x, y = engine.mean[:PLACE].tolist()
        _transformed(engine, start, np.array(((-dy, dx), (dx, dy))), np.eye(PLACE), (x + dx, y + dy))

    def predict(self, engine: EkfSlam, interval_s: float, travel_m: float) -> None:
        """Predict the radio's block over an interval in which the vehicle travelled ``travel_m``."""
        block = engine.block(self.beacon)
        s2, T = self.speed_sigma_m_s**2, self.course_time_s
        a = exp(-interval_s / T)
        size = block.stop - block.start
        F, Q = np.eye(size), np.zeros((size, size))
        for p, v in ((0, 2), (1, 3)):
            F[p, v], F[v, v] = T * (1.0 - a), a
            Q[v, v] = s2 * (1.0 - a * a)
            Q[p, v] = Q[v, p] = s2 * T * (1.0 - a) ** 2
            Q[p, p] = s2 * T * (2.0 * interval_s - T * (1.0 - a) * (3.0 - a))
        if size > _STATES:
            way_m = travel_m + sqrt(2.0) * self.speed_sigma_m_s * interval_s
            c = exp(-way_m / self.shadowing_length_m)
            F[_STATES, _STATES] = c
            Q[_STATES, _STATES] = self.shadowing_sigma_db**2 * (1.0 - c * c)
        P, x = engine.covariance, engine.mean
        x[block] = F @ x[block]
        P[block] = F @ P[block]
        P[:, block] = P[:, block] @ F.T
        P[block, block] += Q


def _transformed(
    engine: EkfSlam, start: int, by_place: FloatArray, by_vehicle: FloatArray, place: tuple[float, float]
) -> None:
    P, rows = engine.covariance, slice(start, start + PLACE)
    P[rows] = by_place @ P[rows] + by_vehicle @ P[:PLACE]
    P[:, rows] = P[:, rows] @ by_place.T + P[:, :PLACE] @ by_vehicle.T
    engine.mean[rows] = place
