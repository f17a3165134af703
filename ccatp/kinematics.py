"""Angles in a plane, and the kinematics of a robot with two driven wheels."""

from math import atan2, cos, pi, sin, tau

from ccatp.core import Twist


def wrap_pi(angle_rad: float) -> float:
    """The same direction in [-pi, pi), rad."""
    return (angle_rad + pi) % tau - pi


def difference(a_rad: float, b_rad: float) -> float:
    """Shortest signed rotation that takes ``b_rad`` to ``a_rad``, in [-pi, pi), rad."""
    return (a_rad - b_rad + pi) % tau - pi


def bearing(dx_m: float, dy_m: float) -> float:
    """Direction of (dx, dy), rad from the x axis, left positive. Thesis eq. 3.2 prints ``arctan(x, y)`` for it."""
    return atan2(dy_m, dx_m)


def rotate(x_m: float, y_m: float, angle_rad: float) -> tuple[float, float]:
    """Rotate the vector (x, y) counter-clockwise by ``angle_rad``."""
    c, s = cos(angle_rad), sin(angle_rad)
    return c * x_m - s * y_m, s * x_m + c * y_m


def wheel_rates(twist: Twist, wheel_radius_m: float, wheel_base_m: float) -> tuple[float, float]:
    """Inverse kinematics, eq. 3.3: wheel rates (right, left), rad/s, for a velocity of the robot's origin."""
    half = 0.5 * wheel_base_m * twist.omega_rad_s
    return (twist.v_m_s + half) / wheel_radius_m, (twist.v_m_s - half) / wheel_radius_m


def twist_of(right_rad_s: float, left_rad_s: float, wheel_radius_m: float, wheel_base_m: float) -> Twist:
    """Forward kinematics, the inverse of eq. 3.3."""
    return Twist(
        0.5 * wheel_radius_m * (right_rad_s + left_rad_s), wheel_radius_m * (right_rad_s - left_rad_s) / wheel_base_m
    )
