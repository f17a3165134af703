"""Odometry between given instants: motion, its covariance, and its derivatives by the calibration of the odometry."""

import numpy as np

from ccatp.beacons.config.models import OdometryNoiseConfig
from ccatp.beacons.estimation.motion import resting, step_variances, turned_way
from ccatp.beacons.estimation.recording import Steps, first_of_each, running_total
from ccatp.core import FloatArray

# Calibration of the odometry, as in the filter: d = d_o / (1 + distance_scale) - distance_per_rad |w_o| sign(d_o),
# w = w_o / (1 + turn_scale) + turn_per_m d_o - bias t. ``turn_per_m`` is the effect of wheels of unequal size;
# ``odometry_delay_s`` is the delay of the vehicle behind its odometry (if commands are used as odometry).
CALIBRATION = ("distance_scale", "turn_scale", "turn_per_m", "turn_bias_rad_s", "odometry_delay_s", "distance_per_rad")
BIAS = CALIBRATION.index("turn_bias_rad_s")
STILL_M = 1e-4  # standard deviation added to the motion of each interval, even at rest: keeps the covariance regular
STILL_RAD = 1e-4
DELAY_STEP_S = 0.05
# Steps within an interval of this length are combined: the vehicle turns so little that the chord equals the arc.
FINEST_S = 0.1


class Reckoning:
    """Steps of odometry, cut at given instants and combined between them.

    ``times_s``: the instants, shape (n + 1,), rising, within the steps. ``rest``: limits of speed, m/s, and turn rate,
    rad/s, below which a step is at rest: the turn that is read is the bias of the gyroscope, and the heading is
    constant. ``at_rest``: total time and turn of all such steps that begin within the instants, s and rad.
    """

    def __init__(
        self, steps: Steps, times_s: FloatArray, *, delayed: bool = True, rest: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        self._delayed = delayed
        inside = (steps.times_s > times_s[0]) & (steps.times_s < times_s[-1])
        inner_s = steps.times_s[inside]
        fine_s = np.union1d(inner_s[first_of_each(inner_s, FINEST_S)], times_s)
        self._starts = np.searchsorted(fine_s, times_s)[:-1]
        self._lengths = np.diff(np.append(self._starts, fine_s.size - 1))
        lasts_s = np.diff(steps.times_s)
        rests = resting(steps.times_s, steps.distance_m, steps.turn_rad, rest)
        within = rests & (steps.times_s[:-1] >= times_s[0]) & (steps.times_s[:-1] < times_s[-1])
        self.at_rest = float(lasts_s[within].sum()), float(steps.turn_rad[within].sum())

        self._fine_s, self._steps_s = fine_s, steps.times_s
        guesses = (np.broadcast_to(guess, steps.distance_m.shape) for guess in (steps.guess_m2, steps.guess_rad2))
        # Time and turn are counted only while the vehicle moves: at rest the bias does not turn the heading.
        lost = turned_way(steps.distance_m, steps.turn_rad)
        amounts = (steps.distance_m, steps.turn_rad * ~rests, steps.lateral_m, lasts_s * ~rests, lost, *guesses)
        self._totals = [running_total(amount) for amount in amounts]
        self._cut(0.0)

    def _cut(self, delay_s: float) -> None:
        self._delay_s = delay_s
        shares = (self._shares(total, delay_s) for total in self._totals)
        self.distance_m, self.turn_rad, self.lateral_m, self.interval_s, self._lost, *guesses = shares
        self._guess_m2, self._guess_rad2 = guesses

    def _shares(self, total: FloatArray, delay_s: float) -> FloatArray:
        shares: FloatArray = np.diff(np.interp(self._fine_s - delay_s, self._steps_s, total))
        return shares

    def _by_delay(self, total: FloatArray) -> FloatArray:
        later, sooner = (self._shares(total, self._delay_s + sign * DELAY_STEP_S) for sign in (1.0, -1.0))
        return (later - sooner) / (2.0 * DELAY_STEP_S)

    def increments(
        self, calibration: FloatArray, noise: OdometryNoiseConfig
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Motion x_m, y_m, heading_rad of each interval (n, 3), in the vehicle's frame at its beginning.

        Also its derivatives by ``calibration`` (6,), shape (n, 3, 6), and its covariance, shape (n, 3, 3). A turn error
        e at a step rotates the rest of the interval: d(x, y) = e (-(y_end - y), x_end - x).
        """
        if calibration[4] != self._delay_s:
            self._cut(float(calibration[4]))
        by_scale, by_turn_scale = 1.0 / (1.0 + calibration[0]), 1.0 / (1.0 + calibration[1])
        way = by_scale * self.distance_m - calibration[5] * self._lost
        side, scaled_turn = by_scale * self.lateral_m, by_turn_scale * self.turn_rad
        turn = scaled_turn + calibration[2] * self.distance_m - calibration[3] * self.interval_s
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
        by[:, 0, 5], by[:, 1, 5] = self._sum(-self._lost * c), self._sum(-self._lost * s)
        by[:, :2, 0] = -by_scale * (motion[:, :2] - calibration[5] * by[:, :2, 5])
        for k, amount in enumerate((-by_turn_scale * scaled_turn, self.distance_m, -self.interval_s), 1):
            by[:, 0, k] = self._sum(lever_x * amount)
            by[:, 1, k] = self._sum(lever_y * amount)
            by[:, 2, k] = self._sum(amount)
        if self._delayed:
            way_by, turn_by, side_by, time_by, lost_by = (self._by_delay(total) for total in self._totals[:5])
            turn_by = by_turn_scale * turn_by + calibration[2] * way_by - calibration[3] * time_by
            way_by, side_by = by_scale * way_by - calibration[5] * lost_by, by_scale * side_by
            by[:, 0, 4] = self._sum(way_by * c - side_by * s + lever_x * turn_by)
            by[:, 1, 4] = self._sum(way_by * s + side_by * c + lever_y * turn_by)
            by[:, 2, 4] = self._sum(turn_by)
        return motion, by, self._covariance(noise, (c, s), (lever_x, lever_y))

    def _covariance(
        self, noise: OdometryNoiseConfig, direction: tuple[FloatArray, FloatArray], lever: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        way, turned = np.hypot(self.distance_m, self.lateral_m), np.abs(self.turn_rad)
        variances = step_variances(noise, way, turned, self.interval_s)
        var_way, var_turn, var_side = map(np.add, variances, (self._guess_m2, self._guess_rad2, self._guess_m2))
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
