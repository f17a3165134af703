"""The least-squares problem of a run: odometry between the instants of readings, residuals, normal equations."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ccatp.beacons.config.models import OdometryNoiseConfig, PriorsConfig, RecordingConfig
from ccatp.beacons.estimation.measurement_models import ANTENNA, bearing_row, level_row, range_row, range_variance
from ccatp.beacons.estimation.motion import POSE, resting, step_variances, turned_way
from ccatp.beacons.estimation.recording import (
    BeaconId,
    BoolArray,
    Readings,
    RecordedRun,
    Steps,
    antenna_path,
    first_of_each,
    running_total,
)
from ccatp.core import FloatArray, IntArray
from ccatp.filters.metrics import wrapped

# Calibration of the odometry, as in the filter: d = d_o / (1 + distance_scale) - distance_per_rad |w_o| sign(d_o),
# w = w_o / (1 + turn_scale) + turn_per_m d_o - bias t. ``turn_per_m`` is the effect of wheels of unequal size;
# ``odometry_delay_s`` is the delay of the vehicle behind its odometry (if commands are used as odometry).
CALIBRATION = ("distance_scale", "turn_scale", "turn_per_m", "turn_bias_rad_s", "odometry_delay_s", "distance_per_rad")
BIAS = CALIBRATION.index("turn_bias_rad_s")
STILL_M = 1e-4  # standard deviation added to the motion of each interval, even at rest: keeps the covariance regular
STILL_RAD = 1e-4
DELAY_STEP_S = 0.05
TINY_RAD = 1e-6  # smallest angle random walk that is assumed for a gyroscope, rad/sqrt(s)
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


OF_READINGS = (
    "range_scale", "range_offset_m", "bearing_offset_rad", "rssi_reference_db", "rssi_exponent", *ANTENNA,
)  # fmt: skip
# Unknowns that are neither pose nor beacon, in the order of the state; all are zero for perfectly calibrated sensors.
SHARED = (*CALIBRATION, *OF_READINGS)
RANGE_SCALE, RANGE_OFFSET, BEARING_OFFSET, RSSI_REFERENCE, RSSI_EXPONENT, *ARM = (
    SHARED.index(name) for name in OF_READINGS
)
# States of a beacon: x_m, y_m, offset of its ranges, m, and of its P_ref, dB, its height over the antenna squared, m^2.
BEACON, HEIGHT = 5, 4


@dataclass(slots=True)
class ArrowSystem:
    """Normal equations: a matrix [[A, B], [B^T, C]], with A of the chain of poses, and the right-hand side (a, c).

    N = 3 n for n poses.
    """

    band: FloatArray  # diagonals of A from the main one down to the fifth, each padded at its end, shape (6, N)
    border: FloatArray  # B, shape (N, m)
    corner: FloatArray  # C, shape (m, m)
    pose_side: FloatArray  # a, shape (N,)
    shared_side: FloatArray  # c, shape (m,)


@dataclass(slots=True)
class BatchState:
    """Values of all unknowns."""

    poses: FloatArray  # x_m, y_m, heading_rad at each instant, shape (n, 3)
    shared: FloatArray  # by ``SHARED``, shape (13,)
    beacons: FloatArray  # x_m, y_m, range_offset_m, reference_db, height_m2 by beacon, shape (b, 5)

    def moved(self, poses: FloatArray, shared: FloatArray) -> "BatchState":
        """The state after a step: ``poses`` (n, 3); ``shared`` with the beacons behind, shape (13 + 5 b,)."""
        split = len(SHARED)
        beacons = self.beacons + shared[split:].reshape(-1, BEACON)
        return BatchState(self.poses + poses, self.shared + shared[:split], beacons)


QUARTER_TURN = np.array(((0.0, -1.0), (1.0, 0.0)))


@dataclass(frozen=True, slots=True)
class MarginalPrior:
    """What readings before a window tell of its first pose, of the shared unknowns and of the beacons, without priors.

    A quadratic form z^T L z / 2 - g^T z of the deviation z from the values at which it was made. In z all places are
    turned back with the heading, z_p = R(heading_0 - heading) p - p_0, so a rotation of the whole map changes the
    heading's part alone, wherever it is linearised: the form never gains information about the rotation that no
    reading gave (as the errors of the invariant EKF: Barrau and Bonnabel 2015).
    """

    pose: FloatArray  # shape (3,)
    shared: FloatArray  # by ``SHARED``, shape (13,)
    beacons: FloatArray  # shape (b, 5)
    known: BoolArray  # beacons that it contains, shape (b,); the rows of others are zero
    information: FloatArray  # L, of z: pose, shared, beacons, shape (16 + 5 b, 16 + 5 b)
    side: FloatArray  # g, shape (16 + 5 b,)

    @classmethod
    def made(
        cls, state: BatchState, last: int, known: BoolArray, information: FloatArray, side: FloatArray
    ) -> "MarginalPrior":
        """From information and right-hand side of the deviations of pose ``last``, shared unknowns and beacons."""
        pose, shared, beacons = state.poses[last].copy(), state.shared.copy(), state.beacons.copy()
        nothing = cls(pose, shared, beacons, known, information, side)
        back = np.linalg.inv(nothing._deviation(pose, shared, beacons)[1])
        return cls(pose, shared, beacons, known, back.T @ information @ back, back.T @ side)

    def cost(self, state: BatchState) -> float:
        """The form at a state whose first pose is the prior's."""
        z = self._deviation(state.poses[0], state.shared, state.beacons)[0]
        return float(z @ (0.5 * (self.information @ z) - self.side))

    def normal_equations(self, state: BatchState) -> tuple[FloatArray, FloatArray]:
        """J^T L J and J^T (g - L z)."""
        z, J = self._deviation(state.poses[0], state.shared, state.beacons)
        return J.T @ self.information @ J, J.T @ (self.side - self.information @ z)

    def _deviation(self, pose: FloatArray, shared: FloatArray, beacons: FloatArray) -> tuple[FloatArray, FloatArray]:
        """z, and its derivatives by pose, shared unknowns and beacons."""
        turned = float(pose[2] - self.pose[2])
        c, s = np.cos(turned), np.sin(turned)
        back = np.array(((c, s), (-s, c)))
        size = POSE + shared.size + beacons.size
        z, J = np.empty(size), np.eye(size)
        z[2], z[POSE : POSE + shared.size] = turned, shared - self.shared
        z[POSE + shared.size :] = (beacons - self.beacons).ravel()
        starts = POSE + shared.size + BEACON * np.arange(len(beacons))
        for start, place, origin in (
            (0, pose[:2], self.pose[:2]), *zip(starts.tolist(), beacons[:, :2], self.beacons[:, :2], strict=True),
        ):  # fmt: skip
            rows = slice(start, start + 2)
            z[rows], J[rows, rows] = back @ place - origin, back
            J[rows, 2] = -QUARTER_TURN @ (back @ place)
        return z, J


class BeaconNoise(NamedTuple):
    """Noise of ranges by beacon and radio, as estimated from residuals; indices are those of ``Readings.heard``."""

    variance: FloatArray  # factor on the configured variance, shape (t b,) for t radios
    repeats: FloatArray  # number of readings that count as one, because errors last, shape (t b,)
    share: FloatArray  # of the variance that lasts, shape (t b,)
    lasts_s: FloatArray  # its correlation time, s, shape (t b,)

    @classmethod
    def configured(cls, count: int) -> "BeaconNoise":
        """White noise of the configured variance."""
        return cls(np.ones(count), np.ones(count), np.zeros(count), np.ones(count))


class PlacePrior(NamedTuple):
    """What is known of the places of beacons before the run: a Gaussian of the unknowns that are no poses."""

    mean: FloatArray  # by ``SHARED`` and beacons, shape (13 + 5 b,)
    information: FloatArray  # zero but for the places of known beacons, shape (13 + 5 b, 13 + 5 b)

    @classmethod
    def of_run(cls, run: RecordedRun, names: Collection[BeaconId]) -> "PlacePrior":
        """The prior by the known map of a run, of those of its beacons that have ``names``."""
        size = len(SHARED) + BEACON * len(run.beacon_ids)
        mean, information = np.zeros(size), np.zeros((size, size))
        if run.known_map is not None and (known := run.known_map.of([str(name) for name in names])).names:
            starts = [len(SHARED) + BEACON * run.beacon_ids.index(name) for name in known.names]
            rows = np.array([(start, start + 1) for start in starts]).ravel()
            mean[rows], information[np.ix_(rows, rows)] = known.places_m.ravel(), np.linalg.inv(known.covariance_m2)
        return cls(mean, information)


@dataclass(slots=True)
class Residuals:
    """Residuals at a state, and their derivatives.

    Readings are rows of (range, bearing, signal strength), zero where there is none.
    """

    odometry: FloatArray  # motion of the poses minus that of the odometry, in the vehicle's frame, shape (n - 1, 3)
    odometry_information: FloatArray  # shape (n - 1, 3, 3)
    by_steps: FloatArray  # of the odometry by first pose, second pose and ``CALIBRATION``, shape (n - 1, 3, 3 + 3 + 6)
    readings: FloatArray  # predicted minus measured, shape (m, 3)
    information: FloatArray  # of each, zero where there is no reading, shape (m, 3)
    by_unknowns: FloatArray  # of the readings by the pose, ``OF_READINGS`` and the beacon, shape (m, 3, 3 + 7 + 5)

    @property
    def chi2(self) -> FloatArray:
        """Chi-squared of each reading, shape (m,)."""
        total: FloatArray = (self.readings**2 * self.information).sum(axis=1)
        return total


class BatchProblem:
    """Odometry and readings of a run as a least-squares problem.

    ``times_s``: instants of the poses, beginning with the first odometry time, shape (n,). ``used``: mask of the
    beacons that are estimated, shape (b,); readings of others are ignored. ``marginal``: replaces the prior of the
    first pose. ``noise``: of the ranges. ``places``: what is known of them before the run. ``raised``: beacons whose
    heights may be estimated, (b,); None: none.
    """

    def __init__(
        self, steps: Steps, readings: Readings, times_s: FloatArray, first_pose: tuple[float, float, float],
        settings: RecordingConfig, used: BoolArray, rest: tuple[float, float] = (0.0, 0.0),
        marginal: MarginalPrior | None = None, noise: BeaconNoise | None = None, places: PlacePrior | None = None,
        raised: BoolArray | None = None,
    ) -> None:  # fmt: skip
        priors, self._places = settings.priors, places
        rest = rest if priors.turn_bias_rad_s > 0.0 else (0.0, 0.0)
        self.reckoning = Reckoning(steps, times_s, delayed=priors.odometry_delay_s > 0.0, rest=rest)
        self.times_s, self.readings = times_s, readings
        self.at: IntArray = np.searchsorted(times_s, readings.times_s)
        self.first_pose = np.array(first_pose)
        self.radio, self.odometry, self.priors = settings.radio, settings.odometry, priors
        self.used = used
        read = np.column_stack([readings.range_m, readings.bearing_rad, readings.rssi_dbm])
        self.there = np.isfinite(read) & used[readings.beacon][:, None]
        self.sizes: FloatArray = self.there.sum(axis=1).astype(np.float64)
        self._read = np.where(self.there, read, 0.0)
        self.heard = readings.heard(used.size)
        self.repeats = repeats(readings.times_s, self.heard, settings.radio.correlation_s)
        # Readings whose errors last are counted less, but their outliers are recognized by their own noise.
        self.power = np.ones(len(readings.times_s)) if noise is None else 1.0 / noise.repeats[self.heard]
        self._range_factor = 1.0 if noise is None else noise.variance[self.heard]
        self.free, self.prior_information = of_priors(priors, used, raised)
        self.marginal = marginal
        rest_s, rest_rad = self.reckoning.at_rest
        self.assumed_information = self.prior_information.copy()  # without what is measured at rest
        self._prior_mean = np.zeros(self.free.size)
        if rest_s > 0.0:  # a measurement of the bias with the angle random walk of the gyroscope
            information = rest_s / max(self.odometry.turn_per_sqrt_s, TINY_RAD) ** 2
            self.prior_information[BIAS] += information
            self._prior_mean[BIAS] = rest_rad / rest_s * information / self.prior_information[BIAS]
        self._last: tuple[BatchState, Residuals] | None = None
        self.first_information = np.array((self.priors.pose_m**-2, self.priors.pose_m**-2, self.priors.heading_rad**-2))

    def residuals(self, state: BatchState) -> Residuals:
        """Residuals at a state; the last result is cached."""
        if self._last is None or self._last[0] is not state:
            self._last = (state, self._linearised(state))
        return self._last[1]

    def prior_cost(self, state: BatchState) -> float:
        """Minus the logarithm of the priors, up to a constant."""
        shared = np.concatenate([state.shared, state.beacons.ravel()]) - self._prior_mean
        own = 0.5 * float(shared**2 @ self.prior_information)
        if self._places is not None:
            off = np.concatenate([state.shared, state.beacons.ravel()]) - self._places.mean
            own += 0.5 * float(off @ self._places.information @ off)
        if self.marginal is not None:
            return own + self.marginal.cost(state)
        return own + 0.5 * float((state.poses[0] - self.first_pose) ** 2 @ self.first_information)

    def normal_equations(self, state: BatchState, weights: FloatArray) -> ArrowSystem:
        """Normal equations of Gauss-Newton for the free unknowns; ``weights`` of the readings, shape (m,)."""
        r, at, beacon, k = self.residuals(state), self.at, self.readings.beacon, len(CALIBRATION)
        n, b, own, free = len(state.poses), len(state.beacons), len(OF_READINGS), np.flatnonzero(self.free)
        # Squares of the rows of odometry (first pose, second pose, calibration) and of readings (pose, own, beacon).
        H, g = _squares(r.by_steps, r.odometry_information @ r.by_steps, r.odometry)
        G, h = _squares(r.by_unknowns, (r.information * weights[:, None])[:, :, None] * r.by_unknowns, r.readings)
        blocks, below = np.zeros((n, POSE, POSE)), H[:, POSE : 2 * POSE, :POSE]
        border, corner = np.zeros((n, POSE, self.free.size)), np.zeros((self.free.size, self.free.size))
        poses, shared = np.zeros((n, POSE)), np.zeros(self.free.size)
        for first, which in ((0, slice(None, -1)), (POSE, slice(1, None))):
            rows = slice(first, first + POSE)
            blocks[which] += H[:, rows, rows]
            border[which, :, :k] += H[:, rows, 2 * POSE :]
            poses[which] += g[:, rows]
        corner[:k, :k], shared[:k] = H[:, 2 * POSE :, 2 * POSE :].sum(axis=0), g[:, 2 * POSE :].sum(axis=0)
        np.add.at(blocks, at, G[:, :POSE, :POSE])
        np.add.at(poses, at, h[:, :POSE])
        np.add.at(border[:, :, k : k + own], at, G[:, :POSE, POSE:-BEACON])
        of_beacons = border[:, :, len(SHARED) :].reshape(n, POSE, b, BEACON)
        np.add.at(of_beacons.transpose(0, 2, 1, 3), (at, beacon), G[:, :POSE, -BEACON:])
        corner[k : k + own, k : k + own] = G[:, POSE:-BEACON, POSE:-BEACON].sum(axis=0)
        shared[k : k + own] = h[:, POSE:-BEACON].sum(axis=0)
        across, within, sides = np.zeros((b, own, BEACON)), np.zeros((b, BEACON, BEACON)), np.zeros((b, BEACON))
        np.add.at(across, beacon, G[:, POSE:-BEACON, -BEACON:])
        np.add.at(within, beacon, G[:, -BEACON:, -BEACON:])
        np.add.at(sides, beacon, h[:, -BEACON:])
        corner[k : k + own, len(SHARED) :] = across.transpose(1, 0, 2).reshape(own, -1)
        corner[len(SHARED) :, k : k + own] = corner[k : k + own, len(SHARED) :].T
        for one in range(b):
            place = slice(len(SHARED) + BEACON * one, len(SHARED) + BEACON * (one + 1))
            corner[place, place] = within[one]
        shared[len(SHARED) :] = sides.ravel()

        self._add_priors(state, (blocks[0], border[0], corner), (poses[0], shared))
        band = _banded(blocks, below)
        # A Fortran copy: NumPy multiplies by a slice of the array twenty times more slowly.
        narrow = np.asfortranarray(border.reshape(POSE * n, -1)[:, free])
        return ArrowSystem(band, narrow, corner[np.ix_(free, free)], poses.ravel(), shared[free])

    def _add_priors(
        self,
        state: BatchState,
        squares: tuple[FloatArray, FloatArray, FloatArray],
        sides: tuple[FloatArray, FloatArray],
    ) -> None:
        """Add the priors to the blocks of first pose, border and corner, and to their right-hand sides."""
        block, border, corner = squares
        values = np.concatenate([state.shared, state.beacons.ravel()])
        corner += np.diag(self.prior_information)
        sides[1][:] -= self.prior_information * (values - self._prior_mean)
        if self._places is not None:
            corner += self._places.information
            sides[1][:] -= self._places.information @ (values - self._places.mean)
        if self.marginal is None:
            block += np.diag(self.first_information)
            sides[0][:] -= self.first_information * (state.poses[0] - self.first_pose)
            return
        L, side = self.marginal.normal_equations(state)
        block += L[:POSE, :POSE]
        border += L[:POSE, POSE:]
        corner += L[POSE:, POSE:]
        sides[0][:] += side[:POSE]
        sides[1][:] += side[POSE:]

    def assumed(self, shared: FloatArray, beacons: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information (k, k) of the priors of the free unknowns but poses, and its pull on their deviations, (k,).

        Without what is measured at rest.
        """
        values, information = np.concatenate([shared, beacons.ravel()]), np.diag(self.assumed_information)
        pull = self.assumed_information * values
        if self._places is not None:
            information += self._places.information
            pull += self._places.information @ (values - self._places.mean)
        return information[np.ix_(self.free, self.free)], pull[self.free]

    def spread(self, shared: FloatArray) -> FloatArray:
        """A step of the free shared unknowns as a step of all, (13 + 5 b,), zero for the fixed ones."""
        whole = np.zeros(self.free.size)
        whole[self.free] = shared
        return whole

    def _linearised(self, state: BatchState) -> Residuals:
        motion, by_calibration, covariance = self.reckoning.increments(state.shared[: len(CALIBRATION)], self.odometry)
        a, b = state.poses[:-1], state.poses[1:]
        c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
        dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
        local = np.column_stack([c * dx + s * dy, -s * dx + c * dy, b[:, 2] - a[:, 2]])
        by_poses = np.zeros((len(c), POSE, 2 * POSE))
        by_poses[:, 0, 3] = by_poses[:, 1, 4] = c
        by_poses[:, 0, 4], by_poses[:, 1, 3], by_poses[:, 2, 5] = s, -s, 1.0
        by_poses[:, :, :POSE] = -by_poses[:, :, POSE:]
        by_poses[:, 0, 2], by_poses[:, 1, 2] = local[:, 1], -local[:, 0]
        by_steps = np.concatenate([by_poses, -by_calibration], axis=2)

        pose, beacon = state.poses[self.at], state.beacons[self.readings.beacon]
        shared, radio = state.shared, self.radio
        arm_m = shared[ARM] + (0.0 if self.readings.arm_m is None else self.readings.arm_m)
        at_m = antenna_path(pose, arm_m)
        dx, dy = beacon[:, 0] - at_m[:, 0], beacon[:, 1] - at_m[:, 1]
        m = len(dx)
        reference_dbm = radio.rssi_reference_dbm + shared[RSSI_REFERENCE] + beacon[:, 3]
        exponent = radio.rssi_exponent + shared[RSSI_EXPONENT]
        range_m, *by_range, by_height, r = range_row(np, dx, dy, 1.0 + shared[RANGE_SCALE], beacon[:, HEIGHT])
        direction, *by_bearing = bearing_row(np, dx, dy)
        level_dbm, *by_level, by_exponent = level_row(np, dx, dy, reference_dbm, exponent)
        expected = (
            range_m + shared[RANGE_OFFSET] + beacon[:, 2], direction - pose[:, 2] + shared[BEARING_OFFSET], level_dbm
        )  # fmt: skip
        errors = (np.column_stack(expected) - self._read) * self.there
        errors[:, 1] = wrapped(errors[:, 1])
        by_pose, by_beacon = np.zeros((m, 3, 3)), np.zeros((m, 3, BEACON))
        by_beacon[:, :, :2] = np.array((by_range, by_bearing, by_level)).transpose(2, 0, 1)
        by_beacon[:, 0, 2] = by_beacon[:, 2, 3] = 1.0
        by_pose[:, :, :2], by_pose[:, 1, 2] = -by_beacon[:, :, :2], -1.0
        by_beacon[:, 0, HEIGHT] = by_height
        # The radio moves by (-y, x) of its lever arm when the vehicle turns.
        x_m, y_m = (at_m - pose[:, :2]).T
        by_pose[:, :, 2] += by_beacon[:, :, 0] * y_m[:, None] - by_beacon[:, :, 1] * x_m[:, None]
        c, s = np.cos(pose[:, 2])[:, None], np.sin(pose[:, 2])[:, None]
        by_shared = np.zeros((m, 3, len(OF_READINGS)))
        by_shared[:, 0, 0], by_shared[:, 0, 1], by_shared[:, 1, 2] = r, 1.0, 1.0
        by_shared[:, 2, 3], by_shared[:, 2, 4] = 1.0, by_exponent
        by_shared[:, :, 5] = -c * by_beacon[:, :, 0] - s * by_beacon[:, :, 1]
        by_shared[:, :, 6] = s * by_beacon[:, :, 0] - c * by_beacon[:, :, 1]
        # By the measured range, not the predicted one: a variance that depends on the state would bias it outwards.
        variances = np.empty_like(errors)
        variances[:, 0] = range_variance(radio, self._read[:, 0]) * self._range_factor
        variances[:, 1:] = radio.bearing_sigma_rad**2, radio.rssi_sigma_db**2
        information: FloatArray = self.there / (variances * self.repeats[:, None])
        by_unknowns = np.concatenate([by_pose, by_shared, by_beacon], axis=2)
        return Residuals(
            local - motion, np.asarray(np.linalg.inv(covariance)), by_steps, errors, information, by_unknowns
        )


def _banded(blocks: FloatArray, below: FloatArray) -> FloatArray:
    """The band of a matrix with diagonal blocks (n, 3, 3) and the blocks below these, (n - 1, 3, 3)."""
    n = len(blocks)
    band = np.zeros((2 * POSE, POSE * n))
    for column in range(POSE):
        for row in range(column, POSE):
            band[row - column, column::POSE] = blocks[:, row, column]
        for row in range(POSE):
            band[POSE + row - column, column : POSE * (n - 1) : POSE] = below[:, row, column]
    return band


def of_priors(priors: PriorsConfig, used: BoolArray, raised: BoolArray | None) -> tuple[BoolArray, FloatArray]:
    """Which shared unknowns and states of the beacons are estimated, and the information of their priors, (13 + 5 b,).

    A standard deviation of 0 fixes an unknown; places have no prior. ``raised``: as for ``BatchProblem``.
    """
    beacons = np.zeros((len(used), BEACON))
    beacons[used, :HEIGHT] = np.inf, np.inf, priors.beacon_offset_m, priors.beacon_reference_db
    if raised is not None:
        beacons[used & raised, HEIGHT] = priors.beacon_height_m2
    sigmas = np.concatenate([[getattr(priors, name) for name in SHARED], beacons.ravel()])
    free = sigmas > 0.0
    return free, np.where(free, 1.0 / np.where(free, sigmas, 1.0) ** 2, 0.0)


def _squares(J: FloatArray, WJ: FloatArray, e: FloatArray) -> tuple[FloatArray, FloatArray]:
    """J^T W J (k, c, c) and -J^T W e (k, c) of blocks of rows: J and W J (k, r, c), residuals e (k, r)."""
    return J.transpose(0, 2, 1) @ WJ, -np.einsum("krc,kr->kc", WJ, e)


def repeats(times_s: FloatArray, heard: IntArray, correlation_s: float) -> FloatArray:
    """Number of readings in the interval ``correlation_s`` centred on each reading, shape (m,).

    Counted are those of the same beacon by the same radio, as ``heard`` (m,) tells.

    Persistent errors (of a camera, of a reflection) do not average out. If the variance of each reading is multiplied
    by this number, all readings of such an interval together have the weight of one, at any rate.
    """
    counts = np.ones(len(times_s))
    for one in np.unique(heard) if correlation_s > 0.0 else ():
        rows = np.flatnonzero(heard == one)
        t = times_s[rows]
        half = 0.5 * correlation_s
        counts[rows] = np.searchsorted(t, t + half, "right") - np.searchsorted(t, t - half, "left")
    return counts
