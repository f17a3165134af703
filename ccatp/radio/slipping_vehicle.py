"""Pure. Motion of a vehicle whose wheels slip and whose heading drifts, both estimated on the way."""

from dataclasses import dataclass
from math import cos, sin
from typing import Literal, NamedTuple

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.radio.motion import POSE, Increment, MotionStep, Odometry, Steering


@dataclass(frozen=True, slots=True)
class WheelNoise:
    """Noise of the odometry, of every interval anew, and priors of its constant errors.

    Attributes:
        speed_sigma_m_s: standard deviation of the speed.
        turn_sigma: of the steering angle (rad), or of the turn rate (rad/s).
        drift_sigma_rad_s: prior of a constant drift of the heading; 0: not estimated.
        slip_sigma: prior of the share of the travel that is lost; 0: not estimated.
    """

    speed_sigma_m_s: float
    turn_sigma: float
    drift_sigma_rad_s: float
    slip_sigma: float


class _Turn(NamedTuple):
    """How an interval turns the vehicle, with derivatives by the reading of steering or turn rate, speed and slip.

    Attributes:
        swing_rad: of the course against the heading at the start.
        turn_rad: of the heading.
        swing_by: the swing by the reading, by the slip and by the drift.
        turn_by: the turn by the reading, by the speed and by the slip.
    """

    swing_rad: float
    turn_rad: float
    swing_by: tuple[float, float, float]
    turn_by: tuple[float, float, float]


class SlippingVehicle:
    """A steered vehicle (Hevrdejs and Knoll 2017, eq. 3) or a differential drive, with slip s and drift b.

    With the way d = T v (1 - s), x <- x + d cos(h + a), y <- y + d sin(h + a), h <- h + w:

    * steered by g: a = g, w = d sin(g) / l + T b
    * differential at the rate omega: w = T omega (1 - s) + T b, a = w / 2

    States behind the pose: heading_drift_rad_s (b) and slip (s), each where its prior is not zero. Wheels that read
    zero stand, and have no noise.

    Args:
        kind: ``ackermann`` takes ``Steering``, ``differential`` takes ``Increment``.
        wheelbase_m: l.
        noise: of the odometry.
    """

    def __init__(self, kind: Literal["ackermann", "differential"], wheelbase_m: float, noise: WheelNoise) -> None:
        self._is_steered = kind == "ackermann"
        self._wheelbase_m = wheelbase_m
        self._noise = noise
        priors = (("heading_drift_rad_s", noise.drift_sigma_rad_s), ("slip", noise.slip_sigma))
        self.names = tuple(name for name, sigma in priors if sigma > 0.0)
        self.prior_sigmas = tuple(sigma for _, sigma in priors if sigma > 0.0)
        self._drift = POSE if noise.drift_sigma_rad_s > 0.0 else None
        self._slip = POSE + (self._drift is not None) if noise.slip_sigma > 0.0 else None
        self.size = POSE + len(self.names)

    def step(self, states: FloatArray, odometry: Odometry) -> MotionStep:
        """See ``MotionModel.step``."""
        T, v, reading = self._read(odometry)
        values: list[float] = states.tolist()
        drift = 0.0 if self._drift is None else values[self._drift]
        slip = 0.0 if self._slip is None else values[self._slip]
        turn = (self._steered if self._is_steered else self._differential)(T, v, reading, drift, slip)
        d = T * v * (1.0 - slip)
        c, s = cos(values[2] + turn.swing_rad), sin(values[2] + turn.swing_rad)
        mean = states.copy()
        mean[:POSE] = values[0] + d * c, values[1] + d * s, values[2] + turn.turn_rad
        F = np.eye(self.size)
        F[0, 2], F[1, 2] = -d * s, d * c
        swing_by_reading, swing_by_slip, swing_by_drift = turn.swing_by
        turn_by_reading, turn_by_speed, turn_by_slip = turn.turn_by
        if self._drift is not None:
            F[:POSE, self._drift] = -d * s * swing_by_drift, d * c * swing_by_drift, T
        if self._slip is not None:
            F[:POSE, self._slip] = -T * v * c - d * s * swing_by_slip, -T * v * s + d * c * swing_by_slip, turn_by_slip
        L = np.zeros((self.size, 2))
        L[:POSE, 0] = T * (1.0 - slip) * c, T * (1.0 - slip) * s, turn_by_speed
        L[:POSE, 1] = -d * s * swing_by_reading, d * c * swing_by_reading, turn_by_reading
        stands = v == 0.0 and (self._is_steered or reading == 0.0)
        L *= (0.0, 0.0) if stands else (self._noise.speed_sigma_m_s, self._noise.turn_sigma)
        return MotionStep(mean, F, L @ L.T)

    def _steered(self, T: float, v: float, steer: float, drift: float, slip: float) -> _Turn:
        curve = T * sin(steer) / self._wheelbase_m
        d_steer = T * v * (1.0 - slip) * cos(steer) / self._wheelbase_m
        w = curve * v * (1.0 - slip) + T * drift
        return _Turn(steer, w, (1.0, 0.0, 0.0), (d_steer, curve * (1.0 - slip), -curve * v))

    @staticmethod
    def _differential(T: float, _v: float, omega: float, drift: float, slip: float) -> _Turn:
        w = T * omega * (1.0 - slip) + T * drift
        by_omega, by_slip = T * (1.0 - slip), -T * omega
        return _Turn(0.5 * w, w, (0.5 * by_omega, 0.5 * by_slip, 0.5 * T), (by_omega, 0.0, by_slip))

    def _read(self, odometry: Odometry) -> tuple[float, float, float]:
        """Interval, speed, and steering angle or turn rate."""
        if self._is_steered:
            if not isinstance(odometry, Steering):
                raise TypeError(f"a steered vehicle takes speed and steering angle, not {type(odometry).__name__}")
            return odometry.interval_s, odometry.speed_m_s, odometry.steer_rad
        if not isinstance(odometry, Increment):
            raise TypeError(f"a differential drive takes increments, not {type(odometry).__name__}")
        T = odometry.interval_s
        return T, odometry.distance_m / T, odometry.turn_rad / T
