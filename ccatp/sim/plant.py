"""Truth of the differential drive on the curved surface, deck frame; its disturbances; the world's random numbers.

The wheel servos are first order, ``T dw/dt + w = u`` with the set point u constant within a step, so rates, wheel
travel and acceleration are exact at every instant of it. The body moves by one midpoint step on the surface metric;
its error per 10 ms step at 0.2 m/s and 1 rad/s is below 10 nm.

Choices of the disturbances (true wheel measures, slip, downhill creep, vibration):

* Each wheel has its own radius error; base and lag have one error each. The robot reports nominal values.
* Slip is lost travel, ``body = (1 - s) wheel``, per wheel: a uniform part drawn for each leg and an
  Ornstein-Uhlenbeck part. A leg begins when the wheels get a set point after ``LEG_PAUSE_S`` of zero set points, so
  the turn and the drive that lead to one stop share their slip.
* Creep is along gravity's component in the tangent plane, with a share of the forward speed that the wheels give. It
  changes slowly, so the accelerometer does not measure it.
* Vibration while the fans thrust is jitter of position and heading, white noise from frame to frame. Its rates are
  differences of this noise, so their sum is bounded. The acceleration that it adds to the readings is a difference,
  too.

Each kind of random number has its own stream, a function of the seed alone.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from math import cos, exp, inf, sin, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.config.models import RobotConfig, WorldConfig
from ccatp.core import DeckPose, FloatArray, Vector3
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.surface import Surface, SurfacePatch

WHOLE = 1.5 * 2.0**52
"""``x + WHOLE - WHOLE`` is ``x`` rounded to a whole number while ``|x| < 2**51``, without a call."""
BLOCK = 4096
"""Numbers drawn at a time: floats from a list are faster than calls of the generator."""
LEG_PAUSE_S = 0.2
LEVEL_SLOPE = 1e-3  # downhill has no direction where the surface is level
_SAME_STEP_S = 1e-9  # differences of frame times are equal to within rounding
_SAME_TIME_S = 1e-6
# A wheel slower than this is set to rest, which the exponential of the servo never reaches; 1e-9 rad/s is 1 um in 9 h.
_STANDSTILL_RAD_S = 1e-9
_REACH_M = 5e-3  # of one expansion of the surface: the error of the heading is below 1e-9 rad per metre

BodyStep = tuple[float, float, float]
"""Displacement along robot x and y, m, and rotation about robot z, rad."""


Disturbance = Callable[["Plant", float, float, float, float, float], BodyStep]
"""Moves the body besides its wheels: from the plant, time and length of the step (s), and the body's displacement
without this disturbance, it returns the displacement with it."""


class Plant:
    """State of the robot's body and wheels.

    ``x_m``, ``y_m``, ``z_m``: robot origin on the surface, deck frame; ``heading_rad``: as in ``DeckPose``, not
    wrapped; ``hx``, ``hy``, ``lx``, ``ly``: deck-plane components of the robot's x and y axes, as
    ``Mirror.body_axes``. ``right_scale`` and ``left_scale`` may be set before a step.
    """

    def __init__(
        self, surface: Surface, start: DeckPose, *, wheel_radius_m: float, wheel_base_m: float, wheel_lag_s: float,
        disturbances: Sequence[Disturbance] = (),
    ) -> None:  # fmt: skip
        self._jet = SurfacePatch(surface, _REACH_M).jet
        self._radius_m, self._half_base_m = wheel_radius_m, wheel_base_m / 2.0
        self.lag_s = wheel_lag_s
        self._disturbances = tuple(disturbances)
        self.x_m, self.y_m, self.heading_rad = start.x_m, start.y_m, start.heading_rad
        self.z_m, self.fx, self.fy, *_ = surface.jet(start.x_m, start.y_m)
        self.right_rad_s = self.left_rad_s = 0.0
        self._right_set = self._left_set = self._right_0 = self._left_0 = 0.0
        self.right_angle_rad = self.left_angle_rad = self._right_angle_0 = self._left_angle_0 = 0.0  # since boot
        self.right_scale = self.left_scale = 1.0  # travel of the body over travel of the nominal wheel
        self.shake_rate_rad_s = self.shake_acceleration_m_s2 = 0.0  # added to the readings of the inertial unit
        self.forward_m = self.left_m = self.turn_rad = 0.0  # of the last step
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
            forward, sideways, turn = disturbance(self, t_s, dt_s, forward, sideways, turn)
        self.forward_m, self.left_m, self.turn_rad = forward, sideways, turn
        self.is_moving = is_moving = not forward == sideways == turn == 0.0
        if is_moving:
            self._move(forward, sideways, turn)

    def _turn_wheels(self, dt_s: float) -> BodyStep:
        """Turn the wheels for a step; return the displacement of the body by the wheels alone."""
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
        # The middle of the step, from the axes at its start: the error is of second order, which suffices for the
        # derivatives of the surface there.
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

    def lateral_acceleration_at(self, decay: float) -> float:
        """Acceleration along robot y within the last step, m/s^2: turn rate times forward speed, without slip."""
        speed_m_s = 0.5 * self._radius_m * (self.right_rad_s + self.left_rad_s)
        return self.turn_rate_at(decay) * speed_m_s

    def place(self, x_m: float, y_m: float, heading_rad: float) -> None:
        """Set the pose of the body, deck frame, on the surface; the wheels do not turn."""
        self.x_m, self.y_m, self.heading_rad = x_m, y_m, heading_rad
        self.z_m, self.fx, self.fy, *_ = self._jet(x_m, y_m)
        self._turn_axes()

    def block(self, *, right: bool, left: bool) -> bool:
        """Stop wheels at once; return whether any of them turned."""
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


def noise_stream(rng: np.random.Generator, sigma: float = 1.0) -> Iterator[float]:
    """Infinite stream of normal numbers of standard deviation ``sigma``: a function of the seed only."""
    blocks: Iterator[list[float]] = iter(lambda: rng.normal(0.0, sigma, BLOCK).tolist(), None)
    return chain.from_iterable(blocks)


class OrnsteinUhlenbeck:
    """Stationary process with ``cov(x(t), x(t+d)) = sigma^2 exp(-d/T)``, exact at any times.

    ``x(t+d) = a x(t) + sigma sqrt(1 - a^2) n`` with ``a = exp(-d/T)``; the first value, at t = 0, is drawn from the
    stationary distribution. ``time_s`` is the correlation time T. The steps d may have any length.
    """

    def __init__(self, sigma: float, time_s: float, rng: np.random.Generator) -> None:
        self._draw = noise_stream(rng).__next__
        self._sigma, self._time_s = sigma, time_s
        self._value = sigma * self._draw()
        self._t_s = 0.0
        self._step_s, self._keep, self._kick = 0.0, 1.0, 0.0

    def at(self, t_s: float) -> float:
        """The value at ``t_s``, which must not be before the last ``t_s``."""
        step_s = t_s - self._t_s
        if step_s <= 0.0 or self._sigma == 0.0:
            return self._value
        if not -_SAME_STEP_S < step_s - self._step_s < _SAME_STEP_S:
            self._step_s, self._keep = step_s, exp(-step_s / self._time_s)
            self._kick = self._sigma * sqrt(1.0 - self._keep * self._keep)
        self._t_s = t_s
        self._value = value = self._keep * self._value + self._kick * self._draw()
        return value


class DriftingBias:
    """An offset with a random walk: ``b_k = b_(k-1) + walk sqrt(dt) n``, from ``start``.

    ``walk``: standard deviation of the change within one second; it grows with the square root of the time.
    """

    def __init__(self, start: float, walk: float, step_s: float, rng: np.random.Generator) -> None:
        self._value, self._kick, self._rng = start, walk * sqrt(step_s), rng

    def ahead(self, count: int) -> FloatArray:
        """The offset after each of the next ``count`` steps, shape (count,)."""
        if not self._kick:
            return np.full(count, self._value)
        kicks = self._kick * self._rng.standard_normal(count)
        walk: FloatArray = np.cumsum(np.concatenate(([self._value], kicks)))
        self._value = float(walk[-1])
        return walk[1:]


class TrueWheels(NamedTuple):
    """Parameters of the true robot; the scales are true / nominal radius of each wheel."""

    radius_m: float
    right_scale: float
    left_scale: float
    base_m: float
    lag_s: float


def draw_wheels(robot: RobotConfig, lag_s: float, world: WorldConfig, rng: np.random.Generator) -> TrueWheels:
    """Parameters of the true robot; always four draws, also if an error is zero."""
    right, left, base = (float(n) for n in rng.standard_normal(3))
    lag = 2.0 * float(rng.random()) - 1.0
    return TrueWheels(
        robot.wheel_radius_m,
        1.0 + world.wheel_radius_sigma * right,
        1.0 + world.wheel_radius_sigma * left,
        robot.wheel_base_m * (1.0 + world.wheel_base_sigma * base),
        lag_s * (1.0 + world.wheel_lag_spread * lag),
    )


class WheelSlip:
    """Slip of both wheels; ``rng`` is the parent of the generators of legs and walks."""

    def __init__(self, world: WorldConfig, rng: np.random.Generator) -> None:
        self._leg_rng, right, left = rng.spawn(3)
        self._least, self._range = world.slip_min, world.slip_max - world.slip_min
        sigma, time_s = world.slip_walk_sigma, world.slip_walk_time_s
        self._walks = OrnsteinUhlenbeck(sigma, time_s, right), OrnsteinUhlenbeck(sigma, time_s, left)
        self._base = (self._least, self._least)
        self._ordered_s = -inf
        self.right = self.left = 0.0  # share of each wheel's travel that is lost now

    def step(self, t_s: float, dt_s: float, is_ordered: bool) -> None:
        """Advance to a frame in which a wheel turns or has a set point; frames at rest may be left out.

        ``t_s`` is the start of the frame; ``is_ordered``: a set point is not zero.
        """
        if is_ordered:
            if t_s - self._ordered_s >= LEG_PAUSE_S - _SAME_TIME_S:
                right, left = self._leg_rng.random(2).tolist()
                self._base = self._least + self._range * right, self._least + self._range * left
            self._ordered_s = t_s + dt_s
        self.right = self._base[0] + self._walks[0].at(t_s)
        self.left = self._base[1] + self._walks[1].at(t_s)


def downhill(plant: Plant, gravity: Vector3) -> tuple[float, float, float]:
    """Component of ``gravity`` (deck frame) in the tangent plane along robot x and y, and its length: the slope."""
    gx, gy, gz = gravity
    hx, hy, lx, ly, fx, fy = plant.hx, plant.hy, plant.lx, plant.ly, plant.fx, plant.fy
    # Both axes are tangents of the surface, so their third component is the slope along them.
    ahead = gx * hx + gy * hy + gz * (fx * hx + fy * hy)
    aside = gx * lx + gy * ly + gz * (fx * lx + fy * ly)
    return ahead, aside, sqrt(ahead * ahead + aside * aside)


class Creep:
    """The body slides downhill while it drives; ``rng`` draws the Ornstein-Uhlenbeck part."""

    def __init__(self, mirror: Mirror, world: WorldConfig, rng: np.random.Generator) -> None:
        self._gravity = mirror.gravity_deck
        self._fraction = world.creep_fraction
        self._walk = OrnsteinUhlenbeck(world.creep_walk_fraction, world.creep_walk_time_s, rng)

    def displace(
        self, plant: Plant, t_s: float, dt_s: float, forward_m: float, left_m: float, turn_rad: float
    ) -> BodyStep:
        """Add ``creep_fraction |v| (1 + walk) dt`` along the unit vector downhill."""
        if forward_m == 0.0 or self._fraction == 0.0:
            return forward_m, left_m, turn_rad
        ahead, aside, slope = downhill(plant, self._gravity)
        if slope < LEVEL_SLOPE:
            return forward_m, left_m, turn_rad
        glide = self._fraction * abs(forward_m) * (1.0 + self._walk.at(t_s)) / slope
        return forward_m + glide * ahead, left_m + glide * aside, turn_rad


class Vibration:
    """Jitter of the body while the fans thrust; ``rng`` is the parent of the generators."""

    def __init__(self, world: WorldConfig, frame_s: float, rng: np.random.Generator) -> None:
        heading, place, acceleration = rng.spawn(3)
        # A difference of two independent numbers has twice their variance.
        self._angles_rad = noise_stream(heading, world.vibration_rate_rad_s * frame_s / sqrt(2.0))
        self._ways_m = noise_stream(place, world.vibration_speed_m_s * frame_s / sqrt(2.0))
        self._pushes_m_s2 = noise_stream(acceleration, world.vibration_acceleration_m_s2 / sqrt(2.0))
        self._angle = self._ahead = self._push = 0.0
        self.is_thrusting = False  # the fans thrust in the next frame; set it before

    def displace(
        self, plant: Plant, t_s: float, dt_s: float, forward_m: float, left_m: float, turn_rad: float
    ) -> BodyStep:
        """Replace the jitter of the last frame by that of this frame; without thrust it is zero."""
        angle, ahead, push = self._angle, self._ahead, self._push
        if self.is_thrusting:
            self._angle, self._ahead = next(self._angles_rad), next(self._ways_m)
            self._push = next(self._pushes_m_s2)
        else:
            self._angle = self._ahead = self._push = 0.0
        turned = self._angle - angle
        plant.shake_rate_rad_s = turned / dt_s
        plant.shake_acceleration_m_s2 = self._push - push
        return forward_m + self._ahead - ahead, left_m, turn_rad + turned
