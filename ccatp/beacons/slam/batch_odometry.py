"""Odometry between the instants of readings: the increment, what calibration does to it, its noise."""

from typing import NamedTuple

import numpy as np

from ccatp.beacons.slam.recording import Steps, running_total
from ccatp.config.beacon_models import OdometryNoiseConfig
from ccatp.core import FloatArray

# What odometry is calibrated by: d = (1 + distance_scale) d_o, w = (1 + turn_scale) w_o + turn_per_m d_o - bias t.
# Scales are what corrects, not what the odometry reads too much; ``turn_per_m`` is what wheels of unequal size do;
# ``delay_s`` is by how much the vehicle does later what its odometry says (commands that are taken for odometry).
CALIBRATION = ("distance_scale", "turn_scale", "turn_per_m", "turn_bias_rad_s", "delay_s")
STILL_M = 1e-4  # standard deviation of what happens in any interval, even at rest: keeps the covariance regular
STILL_RAD = 1e-4
DELAY_STEP_S = 0.05
# Steps shorter than that are put together: within it a vehicle turns so little that the chord is the arc.
FINEST_S = 0.1


class Increments(NamedTuple):
    """Motion from one instant to the next, in the vehicle's frame at the first."""

    motion: FloatArray  # x_m, y_m, heading_rad, shape (n, 3)
    by_calibration: FloatArray  # derivatives by ``CALIBRATION``, shape (n, 3, 5)
    covariance: FloatArray  # shape (n, 3, 3)


class Reckoning:
    """Steps of odometry, cut at given instants and put together between them.

    Args:
        times_s: the instants, shape (n + 1,), rising, within the steps.
    """

    def __init__(self, steps: Steps, times_s: FloatArray, *, delayed: bool = True) -> None:
        self._delayed = delayed
        inside = (steps.times_s > times_s[0]) & (steps.times_s < times_s[-1])
        inner_s = steps.times_s[inside]
        _, first = np.unique(np.floor(inner_s / FINEST_S), return_index=True)
        fine_s = np.union1d(inner_s[first], times_s)
        self._starts = np.searchsorted(fine_s, times_s)[:-1]
        self._lengths = np.diff(np.append(self._starts, fine_s.size - 1))
        self.interval_s = np.diff(fine_s)

        self._fine_s, self._steps_s = fine_s, steps.times_s
        guesses = (np.broadcast_to(guess, steps.distance_m.shape) for guess in (steps.guess_m2, steps.guess_rad2))
        amounts = (steps.distance_m, steps.turn_rad, steps.lateral_m, *guesses)
        self._totals = [running_total(amount) for amount in amounts]
        self._cut(0.0)

    def _cut(self, delay_s: float) -> None:
        self._delay_s = delay_s
        shares = (self._shares(total, delay_s) for total in self._totals)
        self.distance_m, self.turn_rad, self.lateral_m, self._guess_m2, self._guess_rad2 = shares

    def _shares(self, total: FloatArray, delay_s: float) -> FloatArray:
        shares: FloatArray = np.diff(np.interp(self._fine_s - delay_s, self._steps_s, total))
        return shares

    def _by_delay(self, total: FloatArray) -> FloatArray:
        later, sooner = (self._shares(total, self._delay_s + sign * DELAY_STEP_S) for sign in (1.0, -1.0))
        return (later - sooner) / (2.0 * DELAY_STEP_S)

    def increments(self, calibration: FloatArray, noise: OdometryNoiseConfig) -> Increments:
        """Motion of each interval, with the lever by which each of its steps moves the interval's end.

        A turn error e at a step swings the rest of the interval: d(x, y) = e (-(y_end - y), x_end - x).

        Args:
            calibration: by ``CALIBRATION``, shape (5,).
        """
        if calibration[4] != self._delay_s:
            self._cut(float(calibration[4]))
        way, side = (1.0 + calibration[0]) * self.distance_m, self.lateral_m
        turn = (
            (1.0 + calibration[1]) * self.turn_rad + calibration[2] * self.distance_m - calibration[3] * self.interval_s
        )
        before = running_total(turn)
        heading = before[:-1] + 0.5 * turn - np.repeat(before[self._starts], self._lengths)
        c, s = np.cos(heading), np.sin(heading)
        dx, dy = way * c - side * s, way * s + side * c
        end_x, end_y = self._sum(dx), self._sum(dy)
        x, y = np.cumsum(dx) - 0.5 * dx, np.cumsum(dy) - 0.5 * dy  # middles of the steps
        start_x = running_total(dx)[self._starts]
        start_y = running_total(dy)[self._starts]
        lever_x = -(np.repeat(end_y + start_y, self._lengths) - y)
        lever_y = np.repeat(end_x + start_x, self._lengths) - x
        motion = np.stack([end_x, end_y, self._sum(turn)], axis=1)
        by = np.zeros((len(motion), 3, len(CALIBRATION)))
        by[:, 0, 0], by[:, 1, 0] = self._sum(self.distance_m * c), self._sum(self.distance_m * s)
        for k, amount in enumerate((self.turn_rad, self.distance_m, -self.interval_s), 1):
            by[:, 0, k] = self._sum(lever_x * amount)
            by[:, 1, k] = self._sum(lever_y * amount)
            by[:, 2, k] = self._sum(amount)
        if self._delayed:
            way_by, turn_by, side_by = (self._by_delay(total) for total in self._totals[:3])
            turn_by = (1.0 + calibration[1]) * turn_by + calibration[2] * way_by
            way_by = (1.0 + calibration[0]) * way_by
            by[:, 0, 4] = self._sum(way_by * c - side_by * s + lever_x * turn_by)
            by[:, 1, 4] = self._sum(way_by * s + side_by * c + lever_y * turn_by)
            by[:, 2, 4] = self._sum(turn_by)
        return Increments(motion, by, self._covariance(noise, (c, s), (lever_x, lever_y)))

    def _covariance(
        self, noise: OdometryNoiseConfig, direction: tuple[FloatArray, FloatArray], lever: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        way, turned = np.hypot(self.distance_m, self.lateral_m), np.abs(self.turn_rad)
        var_way = noise.distance_per_sqrt_m**2 * way + noise.distance_per_sqrt_rad**2 * turned
        var_turn = (
            noise.turn_per_sqrt_m**2 * way
            + noise.turn_per_sqrt_rad**2 * turned
            + noise.turn_per_sqrt_s**2 * self.interval_s
            + self._guess_rad2
        )
        var_way = var_way + self._guess_m2
        var_side = noise.lateral_per_sqrt_m**2 * way + self._guess_m2
        (c, s), (lx, ly) = direction, lever
        Q = np.empty((self._starts.size, 3, 3))
        Q[:, 0, 0] = self._sum(lx * lx * var_turn + c * c * var_way + s * s * var_side) + STILL_M**2
        Q[:, 1, 1] = self._sum(ly * ly * var_turn + s * s * var_way + c * c * var_side) + STILL_M**2
        Q[:, 0, 1] = Q[:, 1, 0] = self._sum(lx * ly * var_turn + c * s * (var_way - var_side))
        Q[:, 0, 2] = Q[:, 2, 0] = self._sum(lx * var_turn)
        Q[:, 1, 2] = Q[:, 2, 1] = self._sum(ly * var_turn)
        Q[:, 2, 2] = self._sum(var_turn) + STILL_RAD**2
        return Q

    def _sum(self, amounts: FloatArray) -> FloatArray:
        total: FloatArray = np.add.reduceat(amounts, self._starts)
        return total


def carried_on(pose: FloatArray, motion: FloatArray) -> FloatArray:
    """Poses after one increment each, shape (..., 3)."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + c * motion[..., 0] - s * motion[..., 1]
    y = pose[..., 1] + s * motion[..., 0] + c * motion[..., 1]
    return np.stack([x, y, pose[..., 2] + motion[..., 2]], axis=-1)


def chained(first: FloatArray, motion: FloatArray) -> FloatArray:
    """Poses from the first one on, shape (n + 1, 3), by increments (n, 3)."""
    heading = first[2] + running_total(motion[:, 2])
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    x = first[0] + running_total(c * motion[:, 0] - s * motion[:, 1])
    y = first[1] + running_total(s * motion[:, 0] + c * motion[:, 1])
    return np.column_stack([x, y, heading])
