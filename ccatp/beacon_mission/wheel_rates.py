"""Pure. Set points of a vehicle as wheel rates of the robot link, and a steering angle where there is one."""

from typing import NamedTuple

from ccatp.config.radio_models import RadioConfig
from ccatp.control.waypoint_steering import Drive


class WheelRates(NamedTuple):
    """What goes to the robot: wheel rates, rad/s, and the angle of the steered wheel, rad, ``None`` without one."""

    right_rad_s: float
    left_rad_s: float
    steer_rad: float | None


def wheel_rates(drive: Drive, cfg: RadioConfig) -> WheelRates:
    """The rates whose mean is v / r and whose difference is omega b / r (b the track); steered wheels turn alike."""
    radius_m, vehicle = cfg.robot.wheel_radius_m, cfg.vehicle
    rate_rad_s = drive.speed_m_s / radius_m
    if vehicle.kind == "ackermann":
        return WheelRates(rate_rad_s, rate_rad_s, drive.steer_rad)
    half_rad_s = 0.5 * vehicle.track_m * drive.turn_rate_rad_s / radius_m
    return WheelRates(rate_rad_s + half_rad_s, rate_rad_s - half_rad_s, None)
