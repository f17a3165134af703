"""Disturbances of the body (true wheel measures, slip, downhill creep, vibration) and the random numbers of the world.

Choices of the model:

* Each wheel has a radius error of its own; the base and the lag have one each. The robot announces nominal values.
* Slip is lost travel, ``body = (1 - s) wheel``, per wheel: a uniform part drawn for each leg and an
  Ornstein-Uhlenbeck part. A leg begins when the wheels get a set point after ``LEG_PAUSE_S`` of zero set points, so
  the turn and the drive that lead to one stop share their slip.
* Creep goes along gravity's part in the tangent plane with a share of the forward speed that the wheels give; its
  change is too slow for the accelerometer, which does not see it.
* Vibration while the fans thrust is jitter of place and heading, white from frame to frame and of constant size: its
  rates are differences, so their sum never grows. What the accelerometer reads of it is a difference, too.

Each kind of random number has its own stream, a function of the seed alone.
"""

from collections.abc import Callable, Iterator
from itertools import chain, islice
from math import exp, inf, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.config.models import RobotConfig, WorldConfig
from ccatp.core import FloatArray
from ccatp.mirror.mirror import Mirror
from ccatp.sim.plant import Plant

WHOLE = 1.5 * 2.0**52
"""``x + WHOLE - WHOLE`` is ``x`` rounded to a whole number while ``|x| < 2**51``: no call, no integer in between."""

BLOCK = 4096
"""Numbers drawn at a time: plain floats from a list are cheaper than calls to the generator."""

_SAME_STEP_S = 1e-9  # differences of frame times are equal to within rounding


class NoiseStream:
    """Standard normal numbers of one kind: a function of the seed only."""

    __slots__ = ("_numbers", "one")

    def __init__(self, rng: np.random.Generator) -> None:
        blocks: Iterator[list[float]] = iter(lambda: rng.standard_normal(BLOCK).tolist(), None)
        self._numbers = chain.from_iterable(blocks)
        self.one: Callable[[], float] = self._numbers.__next__

    def take(self, count: int) -> list[float]:
        """The next ``count`` numbers."""
        return list(islice(self._numbers, count))


class OrnsteinUhlenbeck:
    """Stationary process with ``cov(x(t), x(t+d)) = sigma^2 exp(-d/T)``, exact at whatever times it is asked for.

    ``x(t+d) = a x(t) + sigma sqrt(1 - a^2) n`` with ``a = exp(-d/T)``; the first value is one of the stationary
    distribution. A time during which nobody asks costs nothing.
    """

    __slots__ = ("_keep", "_kick", "_one", "_sigma", "_step_s", "_t_s", "_time_s", "_value")

    def __init__(self, sigma: float, time_s: float, rng: np.random.Generator) -> None:
        """Draw the value at t = 0.

        Args:
            sigma: stationary standard deviation; 0 gives 0 for ever.
            time_s: correlation time T.
            rng: the process's own generator.
        """
        self._one = NoiseStream(rng).one
        self._sigma, self._time_s = sigma, time_s
        self._value = sigma * self._one()
        self._t_s = 0.0
        self._step_s, self._keep, self._kick = 0.0, 1.0, 0.0

    def at(self, t_s: float) -> float:
        """The value at ``t_s``, which is not before the time asked for last."""
        step_s = t_s - self._t_s
        if step_s <= 0.0 or self._sigma == 0.0:
            return self._value
        if not -_SAME_STEP_S < step_s - self._step_s < _SAME_STEP_S:
            self._step_s, self._keep = step_s, exp(-step_s / self._time_s)
            self._kick = self._sigma * sqrt(1.0 - self._keep * self._keep)
        self._t_s = t_s
        self._value = value = self._keep * self._value + self._kick * self._one()
        return value


class DriftingBias:
    """An offset drawn at boot that walks: ``b_k = b_(k-1) + walk sqrt(dt) n``.

    Args:
        walk: standard deviation of the change within one second; grows with the square root of the time.
    """

    __slots__ = ("_kick", "_rng", "_value")

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


LEG_PAUSE_S = 0.2
LEVEL_SLOPE = 1e-3  # downhill has no direction where the surface is level
_SAME_TIME_S = 1e-6


class TrueWheels(NamedTuple):
    """Measures of the true robot.

    Attributes:
        right_scale, left_scale: true over nominal radius of each wheel.
    """

    radius_m: float
    right_scale: float
    left_scale: float
    base_m: float
    lag_s: float


def draw_wheels(robot: RobotConfig, lag_s: float, world: WorldConfig, rng: np.random.Generator) -> TrueWheels:
    """Measures of the true robot: four draws, whatever is switched off."""
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
    """Slip of both wheels.

    Attributes:
        right, left: share of each wheel's travel that is lost now.
    """

    __slots__ = ("_base", "_least", "_leg_rng", "_ordered_s", "_range", "_walks", "left", "right")

    def __init__(self, world: WorldConfig, rng: np.random.Generator) -> None:
        """Set up.

        Args:
            world: range and walk of the slip.
            rng: parent of the generators of legs and walks.
        """
        self._leg_rng, right, left = rng.spawn(3)
        self._least, self._range = world.slip_min, world.slip_max - world.slip_min
        sigma, time_s = world.slip_walk_sigma, world.slip_walk_time_s
        self._walks = OrnsteinUhlenbeck(sigma, time_s, right), OrnsteinUhlenbeck(sigma, time_s, left)
        self._base = (self._least, self._least)
        self._ordered_s = -inf
        self.right = self.left = 0.0

    def step(self, t_s: float, dt_s: float, is_ordered: bool) -> None:
        """Go on to a frame in which the wheels turn or are told to; frames at rest may be left out.

        Args:
            t_s: time at the start of the frame.
            is_ordered: a set point is not zero.
        """
        if is_ordered:
            if t_s - self._ordered_s >= LEG_PAUSE_S - _SAME_TIME_S:
                right, left = self._leg_rng.random(2).tolist()
                self._base = self._least + self._range * right, self._least + self._range * left
            self._ordered_s = t_s + dt_s
        self.right = self._base[0] + self._walks[0].at(t_s)
        self.left = self._base[1] + self._walks[1].at(t_s)


class Downhill:
    """Where downhill is under the robot."""

    __slots__ = ("_gx", "_gy", "_gz")

    def __init__(self, mirror: Mirror) -> None:
        self._gx, self._gy, self._gz = mirror.rotate_deck_from_world((0.0, 0.0, 1.0))

    def of(self, plant: Plant) -> tuple[float, float, float]:
        """Gravity's part in the tangent plane along robot x and y, and its length: the slope."""
        gx, gy, gz = self._gx, self._gy, self._gz
        hx, hy, lx, ly, fx, fy = plant.hx, plant.hy, plant.lx, plant.ly, plant.fx, plant.fy
        # Both axes are tangents of the surface, so their third component is the slope along them.
        ahead = gx * hx + gy * hy + gz * (fx * hx + fy * hy)
        aside = gx * lx + gy * ly + gz * (fx * lx + fy * ly)
        return ahead, aside, sqrt(ahead * ahead + aside * aside)


class Creep:
    """The body glides downhill while it drives."""

    __slots__ = ("_downhill", "_fraction", "_walk")

    def __init__(self, mirror: Mirror, world: WorldConfig, rng: np.random.Generator) -> None:
        """Set up.

        Args:
            mirror: knows the direction of gravity.
            world: size and walk of the creep.
            rng: generator of the walk.
        """
        self._downhill = Downhill(mirror)
        self._fraction = world.creep_fraction
        self._walk = OrnsteinUhlenbeck(world.creep_walk_fraction, world.creep_walk_time_s, rng)

    def displace(
        self, plant: Plant, t_s: float, dt_s: float, forward_m: float, left_m: float, turn_rad: float
    ) -> tuple[float, float, float]:
        """Add ``creep_fraction |v| (1 + walk) dt`` along the unit vector downhill."""
        if forward_m == 0.0:
            return forward_m, left_m, turn_rad
        ahead, aside, slope = self._downhill.of(plant)
        if slope < LEVEL_SLOPE:
            return forward_m, left_m, turn_rad
        glide = self._fraction * abs(forward_m) * (1.0 + self._walk.at(t_s)) / slope
        return forward_m + glide * ahead, left_m + glide * aside, turn_rad


class Vibration:
    """Jitter of the body while the fans thrust.

    Attributes:
        is_thrusting: the fans thrust in the next frame; to be set before it.
    """

    __slots__ = ("_ahead", "_angle", "_noise", "_push", "_sigma_m", "_sigma_m_s2", "_sigma_rad", "is_thrusting")

    def __init__(self, world: WorldConfig, frame_s: float, rng: np.random.Generator) -> None:
        """Set up. A difference of two independent numbers has twice their variance.

        Args:
            world: standard deviations of the rates, m/s and rad/s, and of the acceleration.
            frame_s: period of the frames.
            rng: parent of the generators of heading, place and acceleration.
        """
        self._noise = [NoiseStream(one) for one in rng.spawn(3)]
        self._sigma_rad = world.vibration_rate_rad_s * frame_s / sqrt(2.0)
        self._sigma_m = world.vibration_speed_m_s * frame_s / sqrt(2.0)
        self._sigma_m_s2 = world.vibration_acceleration_m_s2 / sqrt(2.0)
        self._angle = self._ahead = self._push = 0.0
        self.is_thrusting = False

    def displace(
        self, plant: Plant, t_s: float, dt_s: float, forward_m: float, left_m: float, turn_rad: float
    ) -> tuple[float, float, float]:
        """Replace the jitter of the frame before by this frame's; without thrust it goes back to nothing."""
        angle, ahead, push = self._angle, self._ahead, self._push
        if self.is_thrusting:
            heading, place, acceleration = self._noise
            self._angle = self._sigma_rad * heading.one()
            self._ahead = self._sigma_m * place.one()
            self._push = self._sigma_m_s2 * acceleration.one()
        else:
            self._angle = self._ahead = self._push = 0.0
        turned = self._angle - angle
        plant.shake_rate_rad_s = turned / dt_s
        plant.shake_acceleration_m_s2 = self._push - push
        return forward_m + self._ahead - ahead, left_m, turn_rad + turned
