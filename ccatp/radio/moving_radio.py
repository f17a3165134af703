"""Pure. The radio that moves: how its place, its velocity and its shadowing go on between two readings."""

from collections.abc import Sequence
from math import atan2, cos, exp, hypot, log, pi, sin, sqrt

import numpy as np

from ccatp.angles import wrap_pi
from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import Columns, EkfSlam, Update, columns_of
from ccatp.radio.path_loss import PathLoss
from ccatp.radio.readings import BeaconId, RssiReading
from ccatp.radio.signal_rows import PLACE

_TYPICAL = 0.4  # mean distance of two places in a square over its diagonal: 0.521 / sqrt(2)
_NEAREST_M = 0.02  # nearer than that a direction has no derivative worth the name
_STATES = 4  # x_m, y_m, and the velocity


class MovingRadio:
    """A point whose velocity is a stationary process: v has the spread s by axis and forgets it over a time T.

    Over t, with a = exp(-t / T): v <- a v, p <- p + T (1 - a) v, and

        var(v) += s^2 (1 - a^2),  cov(p, v) += s^2 T (1 - a)^2,  var(p) += s^2 T (2 t - T (1 - a) (3 - a))

    (Singer 1970 with the velocity in place of the acceleration). Shadowing at both ends decorrelates with the ways of
    both: b <- c b with c = exp(-(d_vehicle + d_radio) / L), d_radio = sqrt(2) s t, and var(b) += sigma^2 (1 - c^2).

    Args:
        beacon: which radio.
        speed_sigma_m_s: s.
        course_time_s: T.
        shadowing_sigma_db: sigma; 0: no such state.
        shadowing_length_m: L.
        room_m: lengths of its walls; it never leaves the room.
    """

    def __init__(
        self,
        beacon: BeaconId,
        speed_sigma_m_s: float,
        course_time_s: float,
        shadowing_sigma_db: float,
        shadowing_length_m: float,
        room_m: tuple[float, float],
    ) -> None:
        self.beacon = beacon
        self._speed_sigma_m_s = speed_sigma_m_s
        self._course_time_s = course_time_s
        self._shadowing_sigma_db = shadowing_sigma_db
        self._shadowing_length_m = shadowing_length_m
        self._room_m = room_m

    def join(self, engine: EkfSlam, bearing_rad: float) -> None:
        """Begin in the direction of a first bearing, anywhere in the room; the reading itself is to follow.

        In polar coordinates about the vehicle: the direction is spread over the circle, and the distance as between
        two places in the room, by a factor of two about 0.4 of its diagonal.
        """
        direction, log_range = float(engine.mean[2]) + bearing_rad, log(_TYPICAL * hypot(*self._room_m))
        behind = [self._speed_sigma_m_s] * 2
        if self._shadowing_sigma_db > 0.0:
            behind.append(self._shadowing_sigma_db)
        spread = np.array([pi, log(2.0), *behind])
        mean = np.zeros(spread.size)
        mean[:PLACE] = direction, log_range
        none: Columns = np.empty(0, dtype=np.intp)
        engine.augment(self.beacon, mean, none, np.zeros((mean.size, 0)), np.eye(mean.size), np.diag(spread**2))
        self._to_plane(engine)

    def update(
        self,
        engine: EkfSlam,
        reading: RssiReading,
        path_loss: PathLoss,
        bearing_sigma_rad: float,
        gates: Sequence[float],
    ) -> Update:
        """Condition on a reading, in polar coordinates about the vehicle.

        There level and bearing are linear: z = P_ref - (10 eta / ln 10) ln r + b, beta = direction - heading. In the
        plane a level has another slope at each estimate, and many levels with one unknown b would seem to tell the
        range (modified polar coordinates, Aidala and Hammel 1983).

        Args:
            engine: the filter.
            reading: level, and bearing where there is one.
            path_loss: of the radio.
            bearing_sigma_rad: noise and steps of a bearing.
            gates: largest normalised innovation squared that is used, of one row and of two.
        """
        self._to_polar(engine)
        block = engine.block(self.beacon)
        slope = 10.0 * path_loss.exponent / log(10.0)
        columns = columns_of((2,), block)
        x = engine.mean.take(columns)
        H = np.zeros((1 if reading.bearing_rad is None else 2, columns.size))
        H[0, 2], H[0, 1 + _STATES :] = -slope, self.shadowing_row
        residual = np.array([reading.rssi_dbm - path_loss.reference_dbm - float(H[0] @ x)])
        variances = [path_loss.sigma_db**2]
        if reading.bearing_rad is not None:
            H[1, 0], H[1, 1] = -1.0, 1.0
            residual = np.append(residual, wrap_pi(reading.bearing_rad - float(x[1] - x[0])))
            variances.append(bearing_sigma_rad**2)
        found = engine.update(columns, H, residual, np.array(variances), gates[len(variances) - 1])
        self._to_plane(engine)
        return found

    def _to_polar(self, engine: EkfSlam) -> None:
        """Direction and log range from the vehicle in place of x_m and y_m."""
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

    @property
    def shadowing_row(self) -> FloatArray:
        """Derivative of a level by the shadowing state; empty without one."""
        return np.ones(1) if self._shadowing_sigma_db > 0.0 else np.empty(0)

    def predict(self, engine: EkfSlam, interval_s: float, travel_m: float) -> None:
        """Carry the radio's block on over an interval in which the vehicle travelled so far."""
        block = engine.block(self.beacon)
        F, Q = self._step(interval_s, travel_m)
        P, x = engine.covariance, engine.mean
        x[block] = F @ x[block]
        P[block] = F @ P[block]
        P[:, block] = P[:, block] @ F.T
        P[block, block] += Q

    def _step(self, t: float, travel_m: float) -> tuple[FloatArray, FloatArray]:
        s2, T = self._speed_sigma_m_s**2, self._course_time_s
        a = exp(-t / T)
        size = _STATES + self.shadowing_row.size
        F, Q = np.eye(size), np.zeros((size, size))
        for p, v in ((0, 2), (1, 3)):
            F[p, v], F[v, v] = T * (1.0 - a), a
            Q[v, v] = s2 * (1.0 - a * a)
            Q[p, v] = Q[v, p] = s2 * T * (1.0 - a) ** 2
            Q[p, p] = s2 * T * (2.0 * t - T * (1.0 - a) * (3.0 - a))
        if size > _STATES:
            way_m = travel_m + sqrt(2.0) * self._speed_sigma_m_s * t
            c = exp(-way_m / self._shadowing_length_m)
            F[_STATES, _STATES] = c
            Q[_STATES, _STATES] = self._shadowing_sigma_db**2 * (1.0 - c * c)
        return F, Q


def _transformed(
    engine: EkfSlam, start: int, by_place: FloatArray, by_vehicle: FloatArray, place: tuple[float, float]
) -> None:
    """Other coordinates of a radio's place: the state is the same, said otherwise."""
    P, rows = engine.covariance, slice(start, start + PLACE)
    P[rows] = by_place @ P[rows] + by_vehicle @ P[:PLACE]
    P[:, rows] = P[:, rows] @ by_place.T + P[:, :PLACE] @ by_vehicle.T
    engine.mean[rows] = place
