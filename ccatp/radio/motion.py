"""Pure. How a vehicle moves between two readings: differential drive and Ackermann, with Jacobian and noise."""

from dataclasses import dataclass
from math import cos, hypot, sin, tan
from typing import Literal, NamedTuple, Protocol

import numpy as np

from ccatp.filters.base import FloatArray

POSE = 3  # x_m, y_m, heading_rad: the first states of a vehicle


class Pose(NamedTuple):
    """Where a vehicle stands; the heading is continuous, it does not wrap."""

    x_m: float
    y_m: float
    heading_rad: float


@dataclass(frozen=True, slots=True)
class Increment:
    """Odometry of an interval: what the wheels, or wheels and gyroscope, say was travelled.

    Attributes:
        time_s: end of the interval.
        interval_s: its length.
        distance_m: along the arc.
        turn_rad: change of heading, counter-clockwise.
        lateral_m: to the left; zero for wheels that do not slip.
    """

    time_s: float
    interval_s: float
    distance_m: float
    turn_rad: float
    lateral_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Steering:
    """Odometry of a steered vehicle over an interval.

    Attributes:
        time_s: end of the interval.
        interval_s: its length.
        speed_m_s: of the wheel that the model refers to.
        steer_rad: angle of the steered wheel, counter-clockwise.
    """

    time_s: float
    interval_s: float
    speed_m_s: float
    steer_rad: float


Odometry = Increment | Steering


class MotionStep(NamedTuple):
    """A prediction of the vehicle's states.

    Attributes:
        mean: shape (v,).
        F: d(mean)/d(states before), shape (v, v).
        Q: covariance of what the odometry does not say, shape (v, v).
    """

    mean: FloatArray
    F: FloatArray
    Q: FloatArray


class MotionModel(Protocol):
    """What ``BeaconSlam`` asks of a vehicle; its states are the pose and the odometry's calibration behind it."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the calibration states."""

    @property
    def prior_sigmas(self) -> tuple[float, ...]:
        """Of the calibration states."""

    def step(self, states: FloatArray, odometry: Odometry) -> MotionStep:
        """The states (v,) after the interval.

        Raises:
            TypeError: the odometry is of another kind of vehicle.
        """


@dataclass(frozen=True, slots=True)
class DifferentialNoise:
    """Noise of odometry by increments; all are random walks, so variances grow with the way and the time.

    Attributes:
        distance_per_sqrt_m: standard deviation of the distance after a metre, m / sqrt(m).
        distance_per_sqrt_rad: of the distance after a radian of turning, m / sqrt(rad).
        turn_per_sqrt_m: of the heading after a metre, rad / sqrt(m).
        turn_per_sqrt_rad: of the heading after a radian, rad / sqrt(rad).
        turn_per_sqrt_s: of the heading after a second, rad / sqrt(s) (a gyroscope's angle random walk).
        lateral_per_sqrt_m: of the way sideways after a metre, m / sqrt(m).
        turn_bias_sigma_rad_s: prior of a constant error of the turn rate; 0: not estimated.
        turn_bias_walk_rad_s_sqrt_s: how it wanders, (rad/s) / sqrt(s).
        turn_scale_sigma: prior of the relative error of turns; 0: not estimated.
        distance_scale_sigma: prior of the relative error of distances; 0: not estimated.
    """

    distance_per_sqrt_m: float
    distance_per_sqrt_rad: float
    turn_per_sqrt_m: float
    turn_per_sqrt_rad: float
    turn_per_sqrt_s: float
    lateral_per_sqrt_m: float
    turn_bias_sigma_rad_s: float = 0.0
    turn_bias_walk_rad_s_sqrt_s: float = 0.0
    turn_scale_sigma: float = 0.0
    distance_scale_sigma: float = 0.0


class DifferentialDrive:
    """Odometry by increments: the chord of a circular arc (thesis eq. 2.14 as it is meant).

    With the corrected way d = d_o / (1 + e_d) and turn w = w_o / (1 + e_w) - b dt, m = heading + w / 2 and
    c = sin(w / 2) / (w / 2):

        x <- x + c d cos(m) - l sin(m),  y <- y + c d sin(m) + l cos(m),  heading <- heading + w

    States behind the pose, each where its prior is not zero: turn_bias_rad_s (b), turn_scale (e_w), distance_scale
    (e_d): positive where the odometry reads too much.

    Args:
        noise: of the odometry, and priors of its calibration.
    """

    def __init__(self, noise: DifferentialNoise) -> None:
        self.noise = noise
        priors = (
            ("turn_bias_rad_s", noise.turn_bias_sigma_rad_s),
            ("turn_scale", noise.turn_scale_sigma),
            ("distance_scale", noise.distance_scale_sigma),
        )
        self.names = tuple(name for name, sigma in priors if sigma > 0.0)
        self.prior_sigmas = tuple(sigma for _, sigma in priors if sigma > 0.0)
        self._place = {name: POSE + i for i, name in enumerate(self.names)}
        self.size = POSE + len(self.names)

    def step(self, states: FloatArray, odometry: Odometry) -> MotionStep:
        """See ``MotionModel.step``; takes an ``Increment``."""
        if not isinstance(odometry, Increment):
            raise TypeError(f"a differential drive takes increments, not {type(odometry).__name__}")
        values: list[float] = states.tolist()
        place, dt = self._place, odometry.interval_s
        bias, turn_scale, way_scale = (self._at(values, n) for n in ("turn_bias_rad_s", "turn_scale", "distance_scale"))
        way, side = odometry.distance_m / (1.0 + way_scale), odometry.lateral_m / (1.0 + way_scale)
        turn = odometry.turn_rad / (1.0 + turn_scale) - bias * dt
        half = 0.5 * turn
        chord = 1.0 - half * half / 6.0 if abs(half) < 1e-3 else sin(half) / half
        d_chord = -half / 3.0 if abs(half) < 1e-3 else (cos(half) - chord) / half  # by half
        c, s = cos(values[2] + half), sin(values[2] + half)
        dx, dy = chord * way * c - side * s, chord * way * s + side * c
        # by the turn: half of what the heading does, and the chord that shrinks
        x_turn, y_turn = 0.5 * (-dy + d_chord * way * c), 0.5 * (dx + d_chord * way * s)
        mean = states.copy()
        mean[0], mean[1], mean[2] = values[0] + dx, values[1] + dy, values[2] + turn
        F = np.eye(self.size)
        F[0, 2], F[1, 2] = -dy, dx
        for name, by in (("turn_bias_rad_s", -dt), ("turn_scale", -odometry.turn_rad / (1.0 + turn_scale) ** 2)):
            if name in place:
                F[0, place[name]], F[1, place[name]], F[2, place[name]] = x_turn * by, y_turn * by, by
        if "distance_scale" in place:
            F[0, place["distance_scale"]], F[1, place["distance_scale"]] = (
                -dx / (1.0 + way_scale),
                -dy / (1.0 + way_scale),
            )
        return MotionStep(mean, F, self._noise(odometry, (c, s), (x_turn, y_turn), chord))

    def _at(self, values: list[float], name: str) -> float:
        place = self._place.get(name)
        return 0.0 if place is None else values[place]

    def _noise(
        self, odometry: Increment, direction: tuple[float, float], by_turn: tuple[float, float], chord: float
    ) -> FloatArray:
        noise, dt = self.noise, odometry.interval_s
        way, turned = hypot(odometry.distance_m, odometry.lateral_m), abs(odometry.turn_rad)
        var_way = noise.distance_per_sqrt_m**2 * way + noise.distance_per_sqrt_rad**2 * turned
        var_turn = noise.turn_per_sqrt_m**2 * way + noise.turn_per_sqrt_rad**2 * turned + noise.turn_per_sqrt_s**2 * dt
        var_side = noise.lateral_per_sqrt_m**2 * way
        (c, s), (tx, ty) = direction, by_turn
        ax, ay = chord * c, chord * s
        Q = np.zeros((self.size, self.size))
        Q[0, 0] = ax * ax * var_way + tx * tx * var_turn + s * s * var_side
        Q[1, 1] = ay * ay * var_way + ty * ty * var_turn + c * c * var_side
        Q[0, 1] = Q[1, 0] = ax * ay * var_way + tx * ty * var_turn - s * c * var_side
        Q[0, 2] = Q[2, 0] = tx * var_turn
        Q[1, 2] = Q[2, 1] = ty * var_turn
        Q[2, 2] = var_turn
        place = self._place.get("turn_bias_rad_s")
        if place is not None:
            Q[place, place] = noise.turn_bias_walk_rad_s_sqrt_s**2 * dt
        return Q


@dataclass(frozen=True, slots=True)
class AckermannNoise:
    """Noise of a steered vehicle's odometry, of every interval anew.

    Attributes:
        speed_sigma_m_s: standard deviation of the speed.
        steer_sigma_rad: of the steered wheel's angle.
    """

    speed_sigma_m_s: float
    steer_sigma_rad: float


class Ackermann:
    """A steered vehicle.

    Reference ``front`` (Hevrdejs and Knoll 2017, eq. 3): x <- x + T v cos(heading + steer),
    y <- y + T v sin(heading + steer), heading <- heading + T v sin(steer) / l.
    Reference ``rear``: the same point on the rear axle, x <- x + T v cos(heading), heading <- heading + T v tan(steer) / l.

    Args:
        wheelbase_m: l.
        noise: of speed and steering angle.
        reference: which axle the pose and the speed belong to.
    """

    names: tuple[str, ...] = ()
    prior_sigmas: tuple[float, ...] = ()

    def __init__(
        self, wheelbase_m: float, noise: AckermannNoise, reference: Literal["front", "rear"] = "front"
    ) -> None:
        self.wheelbase_m = wheelbase_m
        self.noise = noise
        self.reference = reference

    def step(self, states: FloatArray, odometry: Odometry) -> MotionStep:
        """See ``MotionModel.step``; takes a ``Steering``."""
        if not isinstance(odometry, Steering):
            raise TypeError(f"an Ackermann vehicle takes speed and steering angle, not {type(odometry).__name__}")
        x, y, heading = states.tolist()
        t, steer = odometry.interval_s, odometry.steer_rad
        way = t * odometry.speed_m_s
        if self.reference == "front":
            c, s = cos(heading + steer), sin(heading + steer)
            curve, d_curve, swing = sin(steer) / self.wheelbase_m, cos(steer) / self.wheelbase_m, 1.0
        else:
            c, s = cos(heading), sin(heading)
            curve, d_curve, swing = tan(steer) / self.wheelbase_m, (1.0 + tan(steer) ** 2) / self.wheelbase_m, 0.0
        mean = np.array((x + way * c, y + way * s, heading + way * curve))
        F = np.array(((1.0, 0.0, -way * s), (0.0, 1.0, way * c), (0.0, 0.0, 1.0)))
        L = np.array(((t * c, -way * s * swing), (t * s, way * c * swing), (t * curve, way * d_curve)))
        L[:, 0] *= self.noise.speed_sigma_m_s
        L[:, 1] *= self.noise.steer_sigma_rad
        return MotionStep(mean, F, L.dot(L.T))
