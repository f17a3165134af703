"""Pure. The true vehicle: Ackermann or differential drive, wheels that slip, a heading that drifts, noisy odometry."""

from math import cos, sin

import numpy as np

from ccatp.config.radio_models import SimVehicleConfig, VehicleConfig
from ccatp.sim.radio.frame import DriveCommand, TruePose, WheelReading


class TrueVehicle:
    """A vehicle that obeys its commands at once within its limits.

    Ackermann, 2017 eq. 3 (x, y of the front axle): x += T v cos(theta + gamma), y += T v sin(theta + gamma),
    theta += T v sin(gamma) / l. Differential drive: the chord of a circular arc. The body makes (1 - slip) of the
    wheels' travel and turns with the drift besides; the odometry knows of neither and has white noise.

    Args:
        geometry: kind and limits.
        truth: slip, drift and noise.
        pose: at the start.
        rng: of the noise.
    """

    def __init__(
        self, geometry: VehicleConfig, truth: SimVehicleConfig, pose: TruePose, rng: np.random.Generator
    ) -> None:
        self._geometry = geometry
        self._truth = truth
        self._rng = rng
        self.pose = pose

    def step(self, command: DriveCommand, interval_s: float) -> WheelReading:
        """Drive for an interval (s); what the odometry tells of it."""
        limits, truth = self._geometry, self._truth
        speed_m_s = _clamped(command.speed_m_s, limits.speed_max_m_s)
        travel_m = speed_m_s * (1.0 - truth.slip) * interval_s
        drift_rad = truth.heading_drift_rad_s * interval_s
        noise = self._rng.standard_normal(2).tolist()
        read_m_s = speed_m_s + truth.speed_sigma_m_s * noise[0]
        if limits.kind == "ackermann":
            steer_rad = _clamped(command.steer_rad, limits.steer_max_rad)
            self._roll(travel_m, steer_rad, drift_rad)
            return WheelReading(interval_s, read_m_s, steer_rad + truth.steer_sigma_rad * noise[1], 0.0)
        rate_rad_s = _clamped(command.turn_rate_rad_s, limits.turn_rate_max_rad_s)
        self._arc(travel_m, rate_rad_s * (1.0 - truth.slip) * interval_s + drift_rad)
        return WheelReading(interval_s, read_m_s, 0.0, rate_rad_s + truth.turn_rate_sigma_rad_s * noise[1])

    def _roll(self, travel_m: float, steer_rad: float, drift_rad: float) -> None:
        x_m, y_m, heading_rad = self.pose
        course_rad = heading_rad + steer_rad
        turn_rad = travel_m * sin(steer_rad) / self._geometry.wheelbase_m + drift_rad
        self.pose = TruePose(x_m + travel_m * cos(course_rad), y_m + travel_m * sin(course_rad), heading_rad + turn_rad)

    def _arc(self, travel_m: float, turn_rad: float) -> None:
        x_m, y_m, heading_rad = self.pose
        half_rad = 0.5 * turn_rad
        chord_m = travel_m * (sin(half_rad) / half_rad if half_rad else 1.0)
        course_rad = heading_rad + half_rad
        self.pose = TruePose(x_m + chord_m * cos(course_rad), y_m + chord_m * sin(course_rad), heading_rad + turn_rad)


def _clamped(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
