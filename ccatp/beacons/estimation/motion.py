"""Motion models of a vehicle with Jacobian and noise; its pose at the time of a reading."""

from collections import deque
from collections.abc import Mapping, Sequence
from math import copysign, cos, hypot, nan, sin, sqrt
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ccatp.beacons.config.models import (
    OdometryConfig,
    OdometryNoiseConfig,
    PriorsConfig,
    SlamFilterConfig,
    VehicleConfig,
)
from ccatp.beacons.estimation.recording import BoolArray, Radio, running_total
from ccatp.core import FloatArray

REST_S = 0.1  # over which a motion is slow or not: a step of 5 ms between two ticks of an encoder is no rest
TINY_S = 1e-6
POSE = 3  # x_m, y_m, heading_rad: the first states of a vehicle
SMALL_RAD = 1e-3  # half a turn below which sin(a) / a is 1 - a^2 / 6 to the last digit


class VehiclePose(NamedTuple):
    """Pose of a vehicle; the heading is continuous, it does not wrap."""

    x_m: float
    y_m: float
    heading_rad: float


class Increment(NamedTuple):
    """Odometry of an interval, by wheels or by wheels and gyroscope."""

    time_s: float
    interval_s: float
    distance_m: float
    turn_rad: float
    lateral_m: float = 0.0  # to the left; zero for wheels that do not slip
    guess_m2: float = 0.0  # variance of x and of y at its end, if the odometry was missing and the motion is guessed
    guess_rad2: float = 0.0  # variance of the heading, in the same case


class Steering(NamedTuple):
    """Odometry of a steered vehicle over an interval."""

    time_s: float
    interval_s: float
    speed_m_s: float
    steer_rad: float


Odometry = Increment | Steering


class MotionStep(NamedTuple):
    """A prediction of the vehicle's states."""

    mean: FloatArray  # shape (v,)
    F: FloatArray  # d(mean)/d(previous states), shape (v, v); the next step may overwrite F and Q
    Q: FloatArray  # covariance of the motion noise, shape (v, v)


def estimated(priors: Mapping[str, float]) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Names and prior standard deviations of the quantities whose prior is not zero."""
    kept = {name: sigma for name, sigma in priors.items() if sigma > 0.0}
    return tuple(kept), tuple(kept.values())


def turned_way(distance_m: Any, turn_rad: Any) -> Any:
    """|w_o| sign(d_o), rad, of one step or of arrays (n,): the factor of ``distance_per_rad``."""
    return abs(turn_rad) * (1.0 * (distance_m > 0.0) - (distance_m < 0.0))


def step_variances(noise: OdometryNoiseConfig, way_m: Any, turned_rad: Any, interval_s: Any) -> tuple[Any, Any, Any]:
    """Variances of distance, turn and lateral distance of one step or of arrays (n,)."""
    var_turn = noise.turn_per_sqrt_m**2 * way_m + noise.turn_per_sqrt_rad**2 * turned_rad
    return (
        noise.distance_per_sqrt_m**2 * way_m + noise.distance_per_sqrt_rad**2 * turned_rad,
        var_turn + noise.turn_per_sqrt_s**2 * interval_s,
        noise.lateral_per_sqrt_m**2 * way_m,
    )


def resting(
    times_s: FloatArray, distance_m: FloatArray, turn_rad: FloatArray, limits: tuple[float, float]
) -> BoolArray:
    """Whether each step is at rest, shape (n,): slower than ``limits``, m/s and rad/s, as are the last ``REST_S``.

    ``times_s``: at which the steps begin and end, shape (n + 1,).
    """
    ends = np.arange(1, times_s.size)
    begins = np.searchsorted(times_s, times_s[1:] - REST_S + TINY_S, side="right") - 1
    found = np.ones(ends.size, dtype=np.bool_)
    for limit, total in zip(limits, (running_total(distance_m), running_total(turn_rad)), strict=True):
        for first in (ends - 1, np.clip(begins, 0, ends - 1)):
            found &= np.abs(total[ends] - total[first]) < limit * (times_s[ends] - times_s[first])
    return found


def scaled_noise(noise: OdometryNoiseConfig, variances: Mapping[str, float]) -> OdometryNoiseConfig:
    """The noise with the variances of ``distance``, ``turn`` and ``lateral`` multiplied by factors."""
    keys = {name: name.split("_per_")[0] for name in OdometryNoiseConfig.model_fields}
    return noise.model_copy(update={name: getattr(noise, name) * sqrt(variances[of]) for name, of in keys.items()})


def _increment(odometry: Odometry) -> Increment:
    if not isinstance(odometry, Increment):
        raise TypeError(f"a differential drive takes increments, not {type(odometry).__name__}")
    return odometry


class DifferentialDrive:
    """Odometry by increments: the chord of a circular arc (thesis eq. 2.14, corrected).

    With the corrected distance d = d_o / (1 + e_d) - l_w |w_o| sign(d_o), lateral distance l = l_o / (1 + e_d) and turn
    w = w_o / (1 + e_w) - b dt, m = heading + w / 2 and c = sin(w / 2) / (w / 2):

        x <- x + c d cos(m) - l sin(m),  y <- y + c d sin(m) + l cos(m),  heading <- heading + w

    States after the pose, each if its prior is not zero: turn_bias_rad_s (b), turn_scale (e_w), distance_scale (e_d),
    distance_per_rad (l_w). They are positive if the odometry reads too much; l_w is the distance that a vehicle loses
    by turning while it drives, if commands are used as odometry. At rest, below ``rest_speed_m_s`` and
    ``rest_turn_rad_s``, the measured turn is only the bias, and the heading is constant (if a bias is estimated). All
    noise is a random walk, so variances grow with distance, turn and time.
    """

    def __init__(self, noise: OdometryNoiseConfig, priors: PriorsConfig, how: SlamFilterConfig) -> None:
        self.noise, self._how = noise, how
        calibrated = ("turn_bias_rad_s", "turn_scale", "distance_scale", "distance_per_rad")
        self.names, self.prior_sigmas = estimated({name: getattr(priors, name) for name in calibrated})
        place = {name: POSE + i for i, name in enumerate(self.names)}
        self._bias, self._turn_scale, self._way_scale, self._lost = (place.get(name, -1) for name in calibrated)
        size = POSE + len(self.names)
        self._is_at_rest, self._recent = False, deque[Increment]()
        self._F, self._Q = np.eye(size), np.zeros((size, size))

    def step(self, states: FloatArray, odometry: Odometry) -> MotionStep:
        """Predict the states, shape (v,). Raises TypeError: the odometry is of a steered vehicle."""
        odometry = _increment(odometry)
        values: list[float] = states.tolist()
        scaled = 1.0 + values[self._way_scale] if self._way_scale >= 0 else 1.0
        scaled_way, side = odometry.distance_m / scaled, odometry.lateral_m / scaled
        lost = turned_way(odometry.distance_m, odometry.turn_rad) if self._lost >= 0 else 0.0
        way = scaled_way - lost * values[self._lost]
        self._is_at_rest = is_at_rest = self._bias >= 0 and self._rests(odometry)
        turn, by_bias, by_scale = (0.0, 0.0, 0.0) if is_at_rest else self._turn(values, odometry)
        half = 0.5 * turn
        chord = 1.0 - half * half / 6.0 if abs(half) < SMALL_RAD else sin(half) / half
        d_chord = -half / 3.0 if abs(half) < SMALL_RAD else (cos(half) - chord) / half
        c, s = cos(values[2] + half), sin(values[2] + half)
        dx, dy = chord * way * c - side * s, chord * way * s + side * c
        # derivatives of the position by the turn: through the mean heading (half the turn) and the chord
        x_turn, y_turn = 0.5 * (d_chord * way * c - dy), 0.5 * (d_chord * way * s + dx)
        mean, F = states.copy(), self._F
        mean[0], mean[1], mean[2] = values[0] + dx, values[1] + dy, values[2] + turn
        F[0, 2], F[1, 2] = -dy, dx
        for place, by in ((self._bias, by_bias), (self._turn_scale, by_scale)):
            if place >= 0:
                F[0, place], F[1, place], F[2, place] = x_turn * by, y_turn * by, by
        if self._way_scale >= 0:
            F[0, self._way_scale] = (side * s - chord * scaled_way * c) / scaled
            F[1, self._way_scale] = -(chord * scaled_way * s + side * c) / scaled
        if self._lost >= 0:
            F[0, self._lost], F[1, self._lost] = -chord * lost * c, -chord * lost * s
        Q = self._spread(odometry, (c, s), (x_turn, y_turn), chord, 0.0 if is_at_rest else 1.0)
        return MotionStep(mean, F, Q)

    def at_rest(self, odometry: Odometry) -> tuple[int, float, float] | None:
        """Column, value and variance of a measurement of the bias by the turn of the last step; None if it drives.

        The noise is the gyroscope's angle random walk.
        """
        if not self._is_at_rest or not isinstance(odometry, Increment):
            return None
        dt = odometry.interval_s
        return self._bias, odometry.turn_rad / dt, self.noise.turn_per_sqrt_s**2 / dt

    def _rests(self, odometry: Increment) -> bool:
        """As ``resting``, of the newest step."""
        recent, how = self._recent, self._how
        recent.append(odometry)
        dt = sum(one.interval_s for one in recent)
        while len(recent) > 1 and dt - recent[0].interval_s > REST_S - TINY_S:
            dt -= recent.popleft().interval_s
        way = abs(sum(one.distance_m for one in recent)), abs(odometry.distance_m)
        turn = abs(sum(one.turn_rad for one in recent)), abs(odometry.turn_rad)
        return (
            way[0] < how.rest_speed_m_s * dt
            and turn[0] < how.rest_turn_rad_s * dt
            and way[1] < how.rest_speed_m_s * odometry.interval_s
            and turn[1] < how.rest_turn_rad_s * odometry.interval_s
        )

    def _turn(self, values: list[float], odometry: Increment) -> tuple[float, float, float]:
        scaled = 1.0 + values[self._turn_scale] if self._turn_scale >= 0 else 1.0
        turn, dt = odometry.turn_rad / scaled, odometry.interval_s
        bias = values[self._bias] if self._bias >= 0 else 0.0
        return turn - bias * dt, -dt, -turn / scaled

    def _spread(
        self, odometry: Increment, direction: tuple[float, float], by_turn: tuple[float, float], chord: float,
        turning: float,
    ) -> FloatArray:  # fmt: skip
        way, dt = hypot(odometry.distance_m, odometry.lateral_m), odometry.interval_s
        var_way, var_turn, var_side = step_variances(self.noise, way, abs(odometry.turn_rad), dt)
        var_turn *= turning
        (c, s), (tx, ty) = direction, by_turn
        ax, ay = chord * c, chord * s
        Q = self._Q
        Q[0, 0] = ax * ax * var_way + tx * tx * var_turn + s * s * var_side
        Q[1, 1] = ay * ay * var_way + ty * ty * var_turn + c * c * var_side
        Q[0, 1] = Q[1, 0] = ax * ay * var_way + tx * ty * var_turn - s * c * var_side
        Q[0, 2] = Q[2, 0] = tx * var_turn
        Q[1, 2] = Q[2, 1] = ty * var_turn
        Q[2, 2] = var_turn
        if self._bias >= 0:
            Q[self._bias, self._bias] = self._how.turn_bias_walk_rad_s_sqrt_s**2 * dt
        return Q


class SlippingVehicle:
    """A steered vehicle (Hevrdejs and Knoll 2017, eq. 3) or a differential drive, with slip s and drift b.

    With the distance d = T v (1 - s), x <- x + d cos(h + a), y <- y + d sin(h + a), h <- h + w:

    * steered by the angle g, wheelbase l: a = g, w = d sin(g) / l + T b
    * differential at the turn rate omega: w = T omega (1 - s) + T b, a = w / 2

    States after the pose: heading_drift_rad_s (b) and slip (s), each if its prior is not zero. If the wheels read zero,
    the vehicle stands, without noise.

    An ``ackermann`` vehicle takes ``Steering``, a ``differential`` one ``Increment``.
    """

    def __init__(self, vehicle: VehicleConfig, noise: OdometryConfig) -> None:
        self._is_steered = vehicle.kind == "ackermann"
        self._wheelbase_m = vehicle.wheelbase_m
        turn_sigma = noise.steer_sigma_rad if self._is_steered else noise.turn_rate_sigma_rad_s
        self._sigmas = noise.speed_sigma_m_s, turn_sigma
        self.names, self.prior_sigmas = estimated(
            {"heading_drift_rad_s": noise.heading_drift_sigma_rad_s, "slip": noise.slip_sigma}
        )
        self._drift = POSE if noise.heading_drift_sigma_rad_s > 0.0 else None
        self._slip = POSE + (self._drift is not None) if noise.slip_sigma > 0.0 else None
        self.size = POSE + len(self.names)

    def step(self, states: FloatArray, odometry: Odometry) -> MotionStep:
        """Predict the states, shape (v,). Raises TypeError: the odometry is of the other kind of vehicle."""
        T, v, reading = self._read(odometry)
        values: list[float] = states.tolist()
        drift = 0.0 if self._drift is None else values[self._drift]
        slip = 0.0 if self._slip is None else values[self._slip]
        # ``reading``: steering angle or turn rate. ``swing``: angle from the old heading to the direction of motion.
        if self._is_steered:
            curve = T * sin(reading) / self._wheelbase_m
            swing, turn = reading, curve * v * (1.0 - slip) + T * drift
            swing_by_reading, swing_by_slip, swing_by_drift = 1.0, 0.0, 0.0
            turn_by_reading = T * v * (1.0 - slip) * cos(reading) / self._wheelbase_m
            turn_by_speed, turn_by_slip = curve * (1.0 - slip), -curve * v
        else:
            turn = T * reading * (1.0 - slip) + T * drift
            swing = 0.5 * turn
            turn_by_reading, turn_by_speed, turn_by_slip = T * (1.0 - slip), 0.0, -T * reading
            swing_by_reading, swing_by_slip, swing_by_drift = 0.5 * turn_by_reading, 0.5 * turn_by_slip, 0.5 * T
        d = T * v * (1.0 - slip)
        c, s = cos(values[2] + swing), sin(values[2] + swing)
        mean = states.copy()
        mean[:POSE] = values[0] + d * c, values[1] + d * s, values[2] + turn
        F = np.eye(self.size)
        F[0, 2], F[1, 2] = -d * s, d * c
        if self._drift is not None:
            F[:POSE, self._drift] = -d * s * swing_by_drift, d * c * swing_by_drift, T
        if self._slip is not None:
            F[:POSE, self._slip] = -T * v * c - d * s * swing_by_slip, -T * v * s + d * c * swing_by_slip, turn_by_slip
        L = np.zeros((self.size, 2))
        L[:POSE, 0] = T * (1.0 - slip) * c, T * (1.0 - slip) * s, turn_by_speed
        L[:POSE, 1] = -d * s * swing_by_reading, d * c * swing_by_reading, turn_by_reading
        stands = v == 0.0 and (self._is_steered or reading == 0.0)
        L *= (0.0, 0.0) if stands else self._sigmas
        return MotionStep(mean, F, L @ L.T)

    def at_rest(self, _odometry: Odometry) -> None:
        """None: rest gives no information about drift or slip."""

    def _read(self, odometry: Odometry) -> tuple[float, float, float]:
        if self._is_steered:
            if not isinstance(odometry, Steering):
                raise TypeError(f"a steered vehicle takes speed and steering angle, not {type(odometry).__name__}")
            return odometry.interval_s, odometry.speed_m_s, odometry.steer_rad
        odometry, T = _increment(odometry), odometry.interval_s
        return T, odometry.distance_m / T, odometry.turn_rad / T


SLIVER = 0.2  # a step is not divided into a part shorter than this share: the pose is extrapolated instead


class CarriedOdometry(msgspec.Struct, frozen=True, gc=False):
    """The pose at a reading's time: pose(t) = pose - back_s (vx, vy, turn)."""

    pose: list[float]
    velocity: tuple[float, float, float]  # vx_m_s, vy_m_s in the frame of the map, turn_rad_s
    back_s: float  # time by which the pose was extrapolated backwards; negative: forwards

    def derivatives(self, hx: float, hy: float, turned: float, *, delayed: bool) -> list[float]:
        """Derivatives by the state's pose, and by the delay if ``delayed``, from those by the extrapolated pose."""
        if not delayed and self.back_s == 0.0:
            return [hx, hy, turned]
        vx, vy, turn = self.velocity
        turned += self.back_s * (hx * vy - hy * vx)
        # the delay changes the heading at the rate ``turn``, too
        return [hx, hy, turned, -hx * vx - hy * vy - turn * turned] if delayed else [hx, hy, turned]


class RadioPose(NamedTuple):
    """A radio on the vehicle: its place and the vehicle's heading, and how the place depends on the heading."""

    pose: list[float]  # x_m, y_m of the radio, heading_rad
    by_heading: tuple[float, float]  # derivatives of its x_m and y_m by the heading
    ahead: tuple[float, float] = (1.0, 0.0)  # direction of the heading

    @classmethod
    def at(cls, pose: list[float], radio: Radio | None, off_m: tuple[float, float] | None = None) -> "RadioPose":
        """Of a vehicle at a pose. ``radio``: None: it is at the pose. ``off_m``: from there, ahead and left."""
        if radio is None and off_m is None:
            return cls(pose, (0.0, 0.0))
        ahead_m, left_m = off_m or (0.0, 0.0)
        if radio is not None:
            ahead_m, left_m = ahead_m + radio.ahead_m, left_m + radio.left_m
        c, s = cos(pose[2]), sin(pose[2])
        x, y = c * ahead_m - s * left_m, s * ahead_m + c * left_m
        return cls([pose[0] + x, pose[1] + y, pose[2]], (-y, x), (c, s))

    def by_place(self, hx: float, hy: float) -> tuple[float, float]:
        """Derivatives by the place of the radio ahead and left, from those by its x and y."""
        c, s = self.ahead
        return hx * c + hy * s, hy * c - hx * s

    def turned(self, hx: float, hy: float, turned: float) -> tuple[float, float, float]:
        """Derivatives by the vehicle's x, y and heading, from those by the radio's."""
        dx, dy = self.by_heading
        return hx, hy, turned + hx * dx + hy * dy


class DeadReckoning:
    """Odometry that the vehicle follows after a delay, which may be estimated.

    Commanded speeds are ahead of the wheels, and stamps of readings may be late or early. Steps wait until they are
    due: the state is the pose at t - delay by the clock of the odometry, which is the pose at t by that of the
    readings. A negative delay (late odometry) is compensated by at most one interval. Over the rest, less than an
    interval, the pose is extrapolated at constant speed, and the derivative by the delay is that speed (Li and Mourikis
    2014). So readings between two steps are processed at their own time, even if no delay is estimated.
    """

    def __init__(self, *, is_delayed: bool) -> None:
        self._is_delayed = is_delayed
        self._steps: deque[Increment] = deque()
        self._until_s, self._interval_s = nan, 0.0
        self._rates = (0.0, 0.0, 0.0)  # forwards, to the left, turn

    def due(self, odometry: Odometry, delay_s: float) -> Sequence[Odometry]:
        """The steps, or parts of one, that are due when ``odometry`` arrives."""
        if not self._is_delayed or not isinstance(odometry, Increment):
            return (odometry,)
        steps, found = self._steps, list[Increment]()
        steps.append(odometry)
        until_s = odometry.time_s - delay_s
        while steps and steps[0].time_s <= until_s:
            found.append(steps.popleft())
        if steps:
            first = steps[0]
            begin_s = first.time_s - first.interval_s
            part = (until_s - begin_s) / first.interval_s if first.interval_s > 0.0 else 0.0
            if SLIVER < part < 1.0 - SLIVER:
                found.append(_part(first, part, begin_s + part * first.interval_s))
                steps[0] = _part(first, 1.0 - part, first.time_s)
        return found

    def took(self, odometry: Odometry, before: FloatArray, after: FloatArray) -> float:
        """Record the speed of a step from one state to another; returns its length, m."""
        self._until_s, self._interval_s = odometry.time_s, odometry.interval_s
        x, y, heading = before[:POSE].tolist()
        new_x, new_y, new_heading = after[:POSE].tolist()
        dx, dy, turn, dt = new_x - x, new_y - y, new_heading - heading, odometry.interval_s
        if dt > 0.0:
            c, s = cos(heading + 0.5 * turn), sin(heading + 0.5 * turn)
            self._rates = ((dx * c + dy * s) / dt, (dy * c - dx * s) / dt, turn / dt)
        return hypot(dx, dy)

    def at(self, pose: list[float], time_s: float, delay_s: float) -> CarriedOdometry:
        """Pose at a reading's time, extrapolated by at most one interval; ``pose``: states that begin with the pose."""
        back_s = self._until_s + delay_s - time_s
        if not abs(back_s) <= self._interval_s:  # also if back_s is NaN: there was no odometry yet
            back_s = copysign(self._interval_s, back_s)
        if back_s == 0.0 and not self._is_delayed:
            return CarriedOdometry(pose[:POSE], (0.0, 0.0, 0.0), 0.0)  # the speed is not used
        ahead, side, turn = self._rates
        heading = pose[2] - back_s * turn
        c, s = cos(heading), sin(heading)
        vx, vy = ahead * c - side * s, ahead * s + side * c
        return CarriedOdometry([pose[0] - back_s * vx, pose[1] - back_s * vy, heading], (vx, vy, turn), back_s)


def _part(step: Increment, part: float, end_s: float) -> Increment:
    return Increment(end_s, *[part * amount for amount in step[1:]])
