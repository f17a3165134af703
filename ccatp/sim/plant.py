"""Truth of the differential drive on the curved surface, deck frame.

The wheel servos are first order, ``T dw/dt + w = u`` with the set point u constant within a step, so rates, wheel
travel and acceleration are exact at every instant of it. The body moves by one midpoint step on the surface metric;
its error per 10 ms step at 0.2 m/s and 1 rad/s is below 10 nm.
"""

from collections.abc import Sequence
from math import cos, exp, sin, sqrt
from typing import Protocol

from ccatp.core import DeckPose
from ccatp.mirror.surface import Surface, SurfacePatch

# A wheel this slow stands still: the exponential of the servo would never get there, and 1e-9 rad/s is 1 um in 9 h.
_STANDSTILL_RAD_S = 1e-9
_REACH_M = 5e-3  # of one expansion of the surface: its error turns the heading by less than 1e-9 rad on a metre's way

BodyStep = tuple[float, float, float]
"""Displacement along robot x and y, m, and rotation about robot z, rad."""


class Disturbance(Protocol):
    """What pushes the body besides its wheels: creep, vibration."""

    def displace(
        self, plant: "Plant", t_s: float, dt_s: float, forward_m: float, left_m: float, turn_rad: float
    ) -> BodyStep:
        """Body displacement of one step after this disturbance, from the one before it."""


class Plant:
    """State of the robot's body and wheels.

    Attributes:
        x_m, y_m, z_m: robot origin on the surface, deck frame.
        heading_rad: deck heading (see ``DeckPose``), not wrapped.
        are_wheels_still: the wheels did not turn in it.
        hx, hy, lx, ly: deck-plane components of the robot's x and y axes, as ``Mirror.body_axes``.
        right_angle_rad, left_angle_rad: wheel angles at the end of the last step, since boot.
        right_scale, left_scale: travel of the body over travel of the nominal wheel; may be set before a step.
        shake_rate_rad_s, shake_acceleration_m_s2: what vibration adds to the readings of the inertial unit.
    """

    __slots__ = (
        "_decay",
        "_decay_dt_s",
        "_disturbances",
        "_half_base_m",
        "_jet",
        "_left_0",
        "_left_angle_0",
        "_left_set",
        "_radius_m",
        "_right_0",
        "_right_angle_0",
        "_right_set",
        "are_wheels_still",
        "forward_m",
        "fx",
        "fy",
        "heading_rad",
        "hx",
        "hy",
        "is_moving",
        "lag_s",
        "left_angle_rad",
        "left_m",
        "left_rad_s",
        "left_scale",
        "lx",
        "ly",
        "right_angle_rad",
        "right_rad_s",
        "right_scale",
        "shake_acceleration_m_s2",
        "shake_rate_rad_s",
        "turn_rad",
        "x_m",
        "y_m",
        "z_m",
    )

    def __init__(
        self,
        surface: Surface,
        start: DeckPose,
        *,
        wheel_radius_m: float,
        wheel_base_m: float,
        wheel_lag_s: float,
        disturbances: Sequence[Disturbance] = (),
    ) -> None:
        self._jet = SurfacePatch(surface, _REACH_M).jet
        self._radius_m, self._half_base_m = wheel_radius_m, wheel_base_m / 2.0
        self.lag_s = wheel_lag_s
        self._disturbances = tuple(disturbances)
        self.x_m, self.y_m, self.heading_rad = start.x_m, start.y_m, start.heading_rad
        self.z_m, self.fx, self.fy, *_ = surface.jet(start.x_m, start.y_m)
        self.right_rad_s = self.left_rad_s = 0.0
        self._right_set = self._left_set = self._right_0 = self._left_0 = 0.0
        self.right_angle_rad = self.left_angle_rad = self._right_angle_0 = self._left_angle_0 = 0.0
        self.right_scale = self.left_scale = 1.0
        self.shake_rate_rad_s = self.shake_acceleration_m_s2 = 0.0
        self.forward_m = self.left_m = self.turn_rad = 0.0
        self.is_moving, self.are_wheels_still = False, True
        self._decay_dt_s = self._decay = 0.0
        self._turn_axes()

    @property
    def pose(self) -> DeckPose:
        """Pose of the body."""
        return DeckPose(self.x_m, self.y_m, self.heading_rad)

    def step(self, t_s: float, dt_s: float, right_set_rad_s: float, left_set_rad_s: float) -> None:
        """Advance by ``dt_s`` with constant wheel set points.

        Wheel travel is ``u dt + (w - u) T (1 - exp(-dt/T))``. With s the forward displacement and d the rotation,
        the deck displacement is s along ``h = cos(psi_m) e1 + sin(psi_m) e2`` at the middle of the step, and
        ``dpsi = d - fy (fxx dx + fxy dy) / ((1 + fx^2) W)``, the transport of the heading along the surface.
        """
        right, left = self.right_rad_s, self.left_rad_s
        self._right_0, self._left_0 = right, left
        self._right_set, self._left_set = right_set_rad_s, left_set_rad_s
        self._right_angle_0, self._left_angle_0 = self.right_angle_rad, self.left_angle_rad
        self.are_wheels_still = is_still = right == left == right_set_rad_s == left_set_rad_s == 0.0
        forward, sideways, turn = (0.0, 0.0, 0.0) if is_still else self._turn_wheels(dt_s)
        for disturbance in self._disturbances:
            forward, sideways, turn = disturbance.displace(self, t_s, dt_s, forward, sideways, turn)
        self.forward_m, self.left_m, self.turn_rad = forward, sideways, turn
        self.is_moving = is_moving = not forward == sideways == turn == 0.0
        if is_moving:
            self._move(forward, sideways, turn)

    def _turn_wheels(self, dt_s: float) -> BodyStep:
        """Turn the wheels for a step; what the body would move by them alone."""
        if dt_s != self._decay_dt_s:
            self._decay_dt_s, self._decay = dt_s, exp(-dt_s / self.lag_s)
        decay, right_set, left_set = self._decay, self._right_set, self._left_set
        right, left = self._right_0 - right_set, self._left_0 - left_set
        lagging_s = self.lag_s * (1.0 - decay)
        right_rad = right_set * dt_s + right * lagging_s
        left_rad = left_set * dt_s + left * lagging_s
        self.right_angle_rad += right_rad
        self.left_angle_rad += left_rad
        right, left = right_set + right * decay, left_set + left * decay
        if right_set == 0.0 and -_STANDSTILL_RAD_S < right < _STANDSTILL_RAD_S:
            right = 0.0
        if left_set == 0.0 and -_STANDSTILL_RAD_S < left < _STANDSTILL_RAD_S:
            left = 0.0
        self.right_rad_s, self.left_rad_s = right, left
        right_rad, left_rad = self.right_scale * right_rad, self.left_scale * left_rad
        half_radius_m = 0.5 * self._radius_m
        return half_radius_m * (right_rad + left_rad), 0.0, half_radius_m * (right_rad - left_rad) / self._half_base_m

    def _move(self, forward_m: float, left_m: float, turn_rad: float) -> None:
        # Where the middle of the step will be, from the axes at its start: good to second order, which is all a
        # derivative of the surface there needs.
        x, y = self.x_m, self.y_m
        mx = x + 0.5 * (forward_m * self.hx + left_m * self.lx)
        my = y + 0.5 * (forward_m * self.hy + left_m * self.ly)
        f, fx, fy, fxx, fxy, fyy = self._jet(mx, my)
        s2 = 1.0 + fx * fx
        s = sqrt(s2)
        w = sqrt(s2 + fy * fy)
        middle = self.heading_rad + 0.5 * turn_rad
        c, d = cos(middle), sin(middle)
        # The chord of an arc is shorter than the arc by sin(a/2)/(a/2).
        chord = 1.0 - turn_rad * turn_rad / 24.0
        along_1 = chord * (forward_m * c - left_m * d)
        along_2 = chord * (forward_m * d + left_m * c)
        dx = (along_1 - along_2 * fx * fy / w) / s
        dy = along_2 * s / w
        self.x_m, self.y_m = x + dx, y + dy
        self.heading_rad += turn_rad - fy * (fxx * dx + fxy * dy) / (s2 * w)
        ex, ey = self.x_m - mx, self.y_m - my
        self.z_m = f + fx * ex + fy * ey + 0.5 * (fxx * ex * ex + fyy * ey * ey) + fxy * ex * ey
        self.fx, self.fy = fx + fxx * ex + fxy * ey, fy + fxy * ex + fyy * ey
        self._turn_axes()

    def _turn_axes(self) -> None:
        fx, fy = self.fx, self.fy
        s2 = 1.0 + fx * fx
        s = sqrt(s2)
        w = sqrt(s2 + fy * fy)
        c, d = cos(self.heading_rad), sin(self.heading_rad)
        e2x, e2y = -fx * fy / (w * s), s / w
        self.hx, self.hy = c / s + d * e2x, d * e2y
        self.lx, self.ly = c * e2x - d / s, c * e2y

    @property
    def servo(self) -> tuple[float, float, float, float]:
        """(right set point, right lag, left set point, left lag): a rate is ``set point + lag exp(-tau/T)``, rad/s."""
        right_set, left_set = self._right_set, self._left_set
        return right_set, self._right_0 - right_set, left_set, self._left_0 - left_set

    @property
    def start_angles_rad(self) -> tuple[float, float]:
        """(right, left) wheel angles at the start of the last step, since boot."""
        return self._right_angle_0, self._left_angle_0

    def acceleration_at(self, decay: float) -> float:
        """Acceleration along robot x within the last step, where ``exp(-tau/T)`` is ``decay``, m/s^2."""
        r, q = self.right_scale, self.left_scale
        lag = r * self._right_set - r * self._right_0 + q * self._left_set - q * self._left_0
        return 0.5 * self._radius_m * lag * decay / self.lag_s + self.shake_acceleration_m_s2

    def turn_rate_at(self, decay: float) -> float:
        """Angular rate about robot z within the last step, rad/s."""
        r, q = self.right_scale, self.left_scale
        right_set, left_set = r * self._right_set, q * self._left_set
        difference = right_set - left_set + (r * self._right_0 - right_set - q * self._left_0 + left_set) * decay
        return 0.5 * self._radius_m * difference / self._half_base_m + self.shake_rate_rad_s

    def place(self, x_m: float, y_m: float, heading_rad: float) -> None:
        """Put the body elsewhere on the surface, deck frame; the wheels do not turn."""
        self.x_m, self.y_m, self.heading_rad = x_m, y_m, heading_rad
        self.z_m, self.fx, self.fy, *_ = self._jet(x_m, y_m)
        self._turn_axes()

    def block(self, *, right: bool, left: bool) -> bool:
        """Stop wheels at once; whether any of them turned."""
        was = bool((right and self.right_rad_s) or (left and self.left_rad_s))
        self.right_rad_s = 0.0 if right else self.right_rad_s
        self.left_rad_s = 0.0 if left else self.left_rad_s
        return was

    def stop_dead(self) -> None:
        """The wheels stop at once and for good (the robot fell)."""
        self.right_rad_s = self.left_rad_s = self._right_0 = self._left_0 = self._right_set = self._left_set = 0.0
        self._right_angle_0, self._left_angle_0 = self.right_angle_rad, self.left_angle_rad
        self.are_wheels_still = True
        self.shake_rate_rad_s = self.shake_acceleration_m_s2 = 0.0
