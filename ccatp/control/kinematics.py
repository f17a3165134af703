"""Pure. Kinematics of the differential drive, thesis eq. 3.3."""

from ccatp.samples import Twist


def wheel_rates(twist: Twist, wheel_radius_m: float, wheel_base_m: float) -> tuple[float, float]:
    """Inverse kinematics, eq. 3.3: wheel angular rates for a velocity of the robot's origin.

    Args:
        twist: forward speed (m/s) and angular rate (rad/s).
        wheel_radius_m: r.
        wheel_base_m: L, the distance between the wheels.

    Returns:
        (right, left) wheel rates, rad/s.
    """
    half = 0.5 * wheel_base_m * twist.omega_rad_s
    return (twist.v_m_s + half) / wheel_radius_m, (twist.v_m_s - half) / wheel_radius_m


def twist_of(right_rad_s: float, left_rad_s: float, wheel_radius_m: float, wheel_base_m: float) -> Twist:
    """Forward kinematics, the inverse of eq. 3.3."""
    return Twist(
        0.5 * wheel_radius_m * (right_rad_s + left_rad_s), wheel_radius_m * (right_rad_s - left_rad_s) / wheel_base_m
    )
