"""Pure. The radio that moves: how its place, its velocity and its shadowing go on between two readings."""

from math import exp, sqrt

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import EkfSlam
from ccatp.radio.readings import BeaconId

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
    """

    def __init__(
        self,
        beacon: BeaconId,
        speed_sigma_m_s: float,
        course_time_s: float,
        shadowing_sigma_db: float,
        shadowing_length_m: float,
    ) -> None:
        self.beacon = beacon
        self._speed_sigma_m_s = speed_sigma_m_s
        self._course_time_s = course_time_s
        self._shadowing_sigma_db = shadowing_sigma_db
        self._shadowing_length_m = shadowing_length_m

    @property
    def prior_sigmas(self) -> list[float]:
        """Of the states behind the place."""
        shadowing = [self._shadowing_sigma_db] if self._shadowing_sigma_db > 0.0 else []
        return [self._speed_sigma_m_s, self._speed_sigma_m_s, *shadowing]

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
