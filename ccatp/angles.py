"""Pure. Angle arithmetic: the only place where angles are wrapped."""

from math import atan2, cos, pi, sin, tau


def wrap_pi(angle_rad: float) -> float:
    """Wrap an angle to [-pi, pi).

    Args:
        angle_rad: any finite angle, rad.

    Returns:
        The same direction in [-pi, pi), rad.
    """
    return (angle_rad + pi) % tau - pi


def difference(a_rad: float, b_rad: float) -> float:
    """Shortest signed rotation that takes ``b_rad`` to ``a_rad``, in [-pi, pi), rad."""
    return (a_rad - b_rad + pi) % tau - pi


def bearing(dx_m: float, dy_m: float) -> float:
    """Direction of the vector (dx, dy), rad from the x axis, counter-clockwise.

    Thesis eq. 3.2 prints ``arctan(x, y)``; the angle from the x axis is ``atan2(y, x)``.
    """
    return atan2(dy_m, dx_m)


def rotate(x_m: float, y_m: float, angle_rad: float) -> tuple[float, float]:
    """Rotate the vector (x, y) counter-clockwise by ``angle_rad``."""
    c, s = cos(angle_rad), sin(angle_rad)
    return c * x_m - s * y_m, s * x_m + c * y_m
