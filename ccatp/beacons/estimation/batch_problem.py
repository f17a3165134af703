"""The least-squares problem of a run: residuals of odometry and readings, and their normal equations."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ccatp.beacons.config.models import RecordingConfig
from ccatp.beacons.estimation.batch_unknowns import (
    ARM,
    BEACON,
    BEARING_OFFSET,
    HEIGHT,
    OF_READINGS,
    RANGE_OFFSET,
    RANGE_SCALE,
    RSSI_EXPONENT,
    RSSI_REFERENCE,
    SHARED,
    BatchState,
    MarginalPrior,
    PlacePrior,
    of_priors,
)
from ccatp.beacons.estimation.measurement_models import bearing_row, level_row, range_row, range_variance
from ccatp.beacons.estimation.motion import POSE
from ccatp.beacons.estimation.reckoning import BIAS, CALIBRATION, Reckoning
from ccatp.beacons.estimation.recording import BoolArray, Readings, Steps, antenna_path
from ccatp.core import FloatArray, IntArray
from ccatp.filters.metrics import wrapped

TINY_RAD = 1e-6  # smallest angle random walk that is assumed for a gyroscope, rad/sqrt(s)


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
