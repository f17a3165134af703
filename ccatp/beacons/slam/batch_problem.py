"""The least-squares problem of a run: residuals, Jacobians, normal equations of odometry and readings.

Normal equations of a chain of poses that all see a few shared unknowns: block tridiagonal with an arrow.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve, cholesky_banded, solve_triangular

from ccatp.beacons.slam.batch_odometry import CALIBRATION, BatchPriors, BatchSettings, RadioNoise, Reckoning
from ccatp.beacons.slam.recording import Readings, Steps
from ccatp.core import FloatArray, IntArray

BLOCK = 3  # x_m, y_m, heading_rad
BAND = 2 * BLOCK - 1


@dataclass(slots=True)
class ArrowSystem:
    """The symmetric positive definite matrix [[A, B], [B^T, C]] and the right-hand side (a, c).

    Attributes:
        diagonal: of A, shape (n, 3, 3).
        below: blocks (k + 1, k) of A, shape (n - 1, 3, 3).
        border: B by pose, shape (n, 3, m).
        corner: C, shape (m, m).
        pose_side: a, shape (n, 3).
        shared_side: c, shape (m,).
    """

    diagonal: FloatArray
    below: FloatArray
    border: FloatArray
    corner: FloatArray
    pose_side: FloatArray
    shared_side: FloatArray


class Factored:
    """Cholesky factors of an arrow system: A by bands, then the Schur complement S = C - B^T A^-1 B.

    Args:
        damping: the diagonal is multiplied by 1 + damping (Levenberg and Marquardt).

    Raises:
        LinAlgError: not positive definite.
    """

    def __init__(self, system: ArrowSystem, damping: float = 0.0) -> None:
        self.system = system
        n, m = len(system.diagonal), len(system.corner)
        band = _banded(system, damping)
        self._factor = cholesky_banded(band, lower=True, check_finite=False)
        right = np.concatenate([system.border.reshape(n * BLOCK, m), system.pose_side.reshape(-1, 1)], axis=1)
        solved = _band_solve(self._factor, right)
        self._border_solved, self._pose_solved = solved[:, :m], solved[:, m]
        corner = system.corner + damping * np.diag(np.diag(system.corner))
        S = corner - system.border.reshape(n * BLOCK, m).T @ self._border_solved
        self._schur = cho_factor(0.5 * (S + S.T), lower=True, check_finite=False)

    def solution(self) -> tuple[FloatArray, FloatArray]:
        """Unknowns of the poses (n, 3) and the shared ones (m,)."""
        system = self.system
        n, m = len(system.diagonal), len(system.corner)
        side = system.shared_side - system.border.reshape(n * BLOCK, m).T @ self._pose_solved
        shared = cho_solve(self._schur, side, check_finite=False)
        return (self._pose_solved - self._border_solved @ shared).reshape(n, BLOCK), shared

    def log_determinant(self) -> float:
        """Of the whole matrix."""
        return float(2.0 * (np.log(self._factor[0]).sum() + np.log(np.diag(self._schur[0])).sum()))

    def shared_covariance(self) -> FloatArray:
        """Inverse's block of the shared unknowns, shape (m, m)."""
        return np.asarray(cho_solve(self._schur, np.eye(len(self.system.corner)), check_finite=False))

    def pose_covariances(self) -> FloatArray:
        """Inverse's diagonal block of each pose, shape (n, 3, 3): (A^-1)_kk + W_k W_k^T, W = A^-1 B chol(S)^-T."""
        n, m = len(self.system.diagonal), len(self.system.corner)
        root = np.tril(self._schur[0])
        W = solve_triangular(root, self._border_solved.T, lower=True, check_finite=False).T.reshape(n, BLOCK, m)
        return _diagonal_of_inverse(self.system) + W @ W.transpose(0, 2, 1)


def _banded(system: ArrowSystem, damping: float) -> FloatArray:
    n = len(system.diagonal)
    band = np.zeros((BAND + 1, n, BLOCK))
    for column in range(BLOCK):
        for row in range(column, BLOCK):
            band[row - column, :, column] = system.diagonal[:, row, column]
        band[0, :, column] *= 1.0 + damping
        for row in range(BLOCK):
            band[BLOCK + row - column, :-1, column] = system.below[:, row, column]
    return band.reshape(BAND + 1, n * BLOCK)


def _band_solve(factor: FloatArray, right: FloatArray) -> FloatArray:
    from scipy.linalg import cho_solve_banded  # noqa: PLC0415

    return np.asarray(cho_solve_banded((factor, True), right, check_finite=False))


def _diagonal_of_inverse(system: ArrowSystem) -> FloatArray:
    A, below = system.diagonal, system.below
    n = len(A)
    left, right = A.copy(), A.copy()
    for k in range(1, n):
        left[k] -= below[k - 1] @ np.linalg.solve(left[k - 1], below[k - 1].T)
    for k in range(n - 2, -1, -1):
        right[k] -= below[k].T @ np.linalg.solve(right[k + 1], below[k])
    return np.asarray(np.linalg.inv(left + right - A))


OF_READINGS = ("range_scale", "range_offset_m", "bearing_offset_rad", "rssi_reference_db", "rssi_exponent")
# Unknowns that are neither pose nor beacon, in the order of the state: corrections, zero where all is as it should.
SHARED = (*CALIBRATION, *OF_READINGS)
RANGE_SCALE, RANGE_OFFSET, BEARING_OFFSET, RSSI_REFERENCE, RSSI_EXPONENT = (SHARED.index(name) for name in OF_READINGS)
BEACON = 4  # x_m, y_m, the offset of its ranges, m, and of its P_ref, dB
LEAST_RANGE_M = 1e-3
DB = 10.0 / np.log(10.0)


@dataclass(slots=True)
class BatchState:
    """What is estimated.

    Attributes:
        poses: x_m, y_m, heading_rad at each instant, shape (n, 3).
        shared: by ``SHARED``, shape (10,).
        beacons: x_m, y_m, range_offset_m, reference_db by beacon, shape (b, 4).
    """

    poses: FloatArray
    shared: FloatArray
    beacons: FloatArray

    def moved(self, poses: FloatArray, shared: FloatArray) -> "BatchState":
        """The state after a step, the shared part of it shape (10 + 4 b,)."""
        split = len(SHARED)
        beacons = self.beacons + shared[split:].reshape(-1, BEACON)
        return BatchState(self.poses + poses, self.shared + shared[:split], beacons)


@dataclass(slots=True)
class Residuals:
    """What remains at a state; readings as rows of (range, bearing, signal strength), zero where there is none.

    Attributes:
        odometry: shape (n - 1, 3).
        odometry_information: shape (n - 1, 3, 3).
        readings: predicted less read, shape (m, 3).
        information: of each, zero where there is no reading, shape (m, 3).
    """

    odometry: FloatArray
    odometry_information: FloatArray
    readings: FloatArray
    information: FloatArray

    @property
    def chi2(self) -> FloatArray:
        """Of each reading, shape (m,)."""
        total: FloatArray = (self.readings**2 * self.information).sum(axis=1)
        return total


class BatchProblem:
    """Odometry and readings of a run up to an instant.

    Args:
        readings: those whose time is one of ``times_s``.
        times_s: instants of the poses, the first one the first odometry time, shape (n,).
        used: which beacons take part, shape (b,); readings of others count nothing.
    """

    def __init__(
        self,
        steps: Steps,
        readings: Readings,
        times_s: FloatArray,
        first_pose: tuple[float, float, float],
        settings: BatchSettings,
        used: npt.NDArray[np.bool_],
    ) -> None:
        self.reckoning = Reckoning(steps, times_s, delayed=settings.priors.delay_s > 0.0)
        self.readings = readings
        self.at: IntArray = np.searchsorted(times_s, readings.times_s)
        self.first_pose = np.array(first_pose)
        self.settings = settings
        self.radio: RadioNoise = settings.radio
        self.odometry = settings.odometry
        self.used = used
        read = np.column_stack([readings.range_m, readings.bearing_rad, readings.rssi_dbm])
        self.there = np.isfinite(read) & used[readings.beacon][:, None]
        self.sizes: FloatArray = self.there.sum(axis=1).astype(np.float64)
        self._read = np.where(self.there, read, 0.0)
        self.repeats = repeats(readings, settings.radio.correlation_s)
        sigmas = _prior_sigmas(settings.priors, used)
        self.free = sigmas > 0.0
        self.prior_information = np.where(self.free, 1.0 / np.where(self.free, sigmas, 1.0) ** 2, 0.0)
        self.prior_information[np.isinf(sigmas)] = 0.0
        p = settings.priors
        self._last: tuple[BatchState, tuple[Any, ...]] | None = None
        self.first_information = np.array((p.pose_m**-2, p.pose_m**-2, p.heading_rad**-2))

    def residuals(self, state: BatchState) -> Residuals:
        """At a state."""
        return self._evaluated(state)[0]

    def range_variance(self, range_m: FloatArray) -> FloatArray:
        """Of ranges, m^2."""
        variance: FloatArray = self.radio.range_sigma_m**2 + (self.radio.range_sigma_per_m * range_m) ** 2
        return variance

    def distances(self, state: BatchState, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """What readings say of the distance, m, and its variance, m^2: by the range, or by the signal strength.

        Args:
            rows: readings, each with a range or a signal strength.
        """
        read, beacon = self.readings, state.beacons[self.readings.beacon[rows]]
        scale, exponent = 1.0 + state.shared[RANGE_SCALE], self.radio.rssi_exponent + state.shared[RSSI_EXPONENT]
        reference = self.radio.rssi_reference_dbm + state.shared[RSSI_REFERENCE] + beacon[:, 3]
        by_range = (read.range_m[rows] - state.shared[RANGE_OFFSET] - beacon[:, 2]) / scale
        by_rssi = 10.0 ** ((reference - read.rssi_dbm[rows]) / (10.0 * exponent))
        ranged = np.isfinite(read.range_m[rows])
        distance = np.maximum(np.where(ranged, by_range, by_rssi), LEAST_RANGE_M)
        range_variance = self.range_variance(np.where(ranged, read.range_m[rows], 0.0)) / scale**2
        rssi_variance = (distance * self.radio.rssi_sigma_db / (DB * exponent)) ** 2
        return distance, np.where(ranged, range_variance, rssi_variance)

    def prior_cost(self, state: BatchState) -> float:
        """Half the sum of squares of the priors."""
        shared = np.concatenate([state.shared, state.beacons.ravel()])
        first = state.poses[0] - self.first_pose
        return float(0.5 * (shared**2 @ self.prior_information + first**2 @ self.first_information))

    def normal_equations(self, state: BatchState, weights: FloatArray, odometry_weights: FloatArray) -> ArrowSystem:
        """Gauss-Newton at a state, readings and steps weighted, for the free unknowns.

        Args:
            weights: of each reading, shape (m,).
            odometry_weights: of each step, shape (n - 1,).
        """
        residuals, by_pose, by_shared, by_beacon, increments = self._evaluated(state)
        n, size = len(state.poses), self.free.size
        system = ArrowSystem(
            np.zeros((n, 3, 3)), np.zeros((n - 1, 3, 3)), np.zeros((n, 3, size)), np.zeros((size, size)),
            np.zeros((n, 3)), np.zeros(size),
        )  # fmt: skip
        self._add_odometry(system, state, residuals, increments, odometry_weights)
        self._add_readings(system, residuals, (by_pose, by_shared, by_beacon), weights)
        shared = np.concatenate([state.shared, state.beacons.ravel()])
        system.corner[range(size), range(size)] += self.prior_information
        system.shared_side -= self.prior_information * shared
        system.diagonal[0] += np.diag(self.first_information)
        system.pose_side[0] -= self.first_information * (state.poses[0] - self.first_pose)
        free = np.flatnonzero(self.free)
        system.border = system.border[:, :, free]
        system.corner = system.corner[np.ix_(free, free)]
        system.shared_side = system.shared_side[free]
        return system

    def spread(self, shared: FloatArray) -> FloatArray:
        """A step of the free shared unknowns as one of all, zero for the others."""
        whole = np.zeros(self.free.size)
        whole[self.free] = shared
        return whole

    def _evaluated(
        self, state: BatchState
    ) -> tuple[Residuals, FloatArray, FloatArray, FloatArray, tuple[FloatArray, FloatArray]]:
        if self._last is not None and self._last[0] is state:
            return self._last[1]
        found = self._linearised(state)
        self._last = (state, found)
        return found

    def _linearised(
        self, state: BatchState
    ) -> tuple[Residuals, FloatArray, FloatArray, FloatArray, tuple[FloatArray, FloatArray]]:
        increments = self.reckoning.increments(state.shared[: len(CALIBRATION)], self.odometry)
        a, b = state.poses[:-1], state.poses[1:]
        c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
        dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
        local = np.column_stack([c * dx + s * dy, -s * dx + c * dy, b[:, 2] - a[:, 2]])
        odometry = local - increments.motion
        odometry_information = np.linalg.inv(increments.covariance)

        pose, beacon = state.poses[self.at], state.beacons[self.readings.beacon]
        ux, uy = beacon[:, 0] - pose[:, 0], beacon[:, 1] - pose[:, 1]
        r = np.maximum(np.hypot(ux, uy), LEAST_RANGE_M)
        ux, uy = ux / r, uy / r
        scale, exponent = 1.0 + state.shared[RANGE_SCALE], self.radio.rssi_exponent + state.shared[RSSI_EXPONENT]
        reference = self.radio.rssi_reference_dbm + state.shared[RSSI_REFERENCE]
        decades = np.log10(r)
        errors = np.column_stack(
            [
                scale * r + state.shared[RANGE_OFFSET] + beacon[:, 2],
                np.arctan2(uy, ux) - pose[:, 2] + state.shared[BEARING_OFFSET],
                reference + beacon[:, 3] - 10.0 * exponent * decades,
            ]
        )
        errors = (errors - self._read) * self.there
        errors[:, 1] = (errors[:, 1] + np.pi) % (2.0 * np.pi) - np.pi
        m = len(r)
        by_pose, by_beacon = np.zeros((m, 3, 3)), np.zeros((m, 3, BEACON))
        by_pose[:, 0, 0], by_pose[:, 0, 1] = -scale * ux, -scale * uy
        by_pose[:, 1, 0], by_pose[:, 1, 1], by_pose[:, 1, 2] = uy / r, -ux / r, -1.0
        by_pose[:, 2, 0], by_pose[:, 2, 1] = DB * exponent * ux / r, DB * exponent * uy / r
        by_beacon[:, :, :2] = -by_pose[:, :, :2]
        by_beacon[:, 0, 2] = by_beacon[:, 2, 3] = 1.0
        by_shared = np.zeros((m, 3, len(OF_READINGS)))
        by_shared[:, 0, 0], by_shared[:, 0, 1], by_shared[:, 1, 2] = r, 1.0, 1.0
        by_shared[:, 2, 3], by_shared[:, 2, 4] = 1.0, -10.0 * decades
        # By the range read, not the one predicted: a variance that moves with the state would draw it outwards.
        variances = np.empty_like(errors)
        variances[:, 0] = self.range_variance(self._read[:, 0])
        variances[:, 1:] = self.radio.bearing_sigma_rad**2, self.radio.rssi_sigma_db**2
        information: FloatArray = self.there / (variances * self.repeats[:, None])
        found = Residuals(odometry, np.asarray(odometry_information), errors, information)
        return found, by_pose, by_shared, by_beacon, (local, increments.by_calibration)

    def _add_odometry(
        self,
        system: ArrowSystem,
        state: BatchState,
        residuals: Residuals,
        increments: tuple[FloatArray, FloatArray],
        weights: FloatArray,
    ) -> None:
        local, by_calibration = increments
        n = len(local)
        c, s = np.cos(state.poses[:-1, 2]), np.sin(state.poses[:-1, 2])
        Ja, Jb = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
        Jb[:, 0, 0] = Jb[:, 1, 1] = c
        Jb[:, 0, 1], Jb[:, 1, 0], Jb[:, 2, 2] = s, -s, 1.0
        Ja[:] = -Jb
        Ja[:, 0, 2], Ja[:, 1, 2] = local[:, 1], -local[:, 0]
        W = residuals.odometry_information * weights[:, None, None]
        WJa, WJb, WJc = W @ Ja, W @ Jb, W @ -by_calibration
        We = np.einsum("kij,kj->ki", W, residuals.odometry)
        JaT, JbT, JcT = Ja.transpose(0, 2, 1), Jb.transpose(0, 2, 1), -by_calibration.transpose(0, 2, 1)
        k = len(CALIBRATION)
        system.diagonal[:-1] += JaT @ WJa
        system.diagonal[1:] += JbT @ WJb
        system.below += JbT @ WJa
        system.border[:-1, :, :k] += JaT @ WJc
        system.border[1:, :, :k] += JbT @ WJc
        system.corner[:k, :k] += (JcT @ WJc).sum(axis=0)
        system.pose_side[:-1] -= np.einsum("kij,kj->ki", JaT, We)
        system.pose_side[1:] -= np.einsum("kij,kj->ki", JbT, We)
        system.shared_side[:k] -= np.einsum("kij,kj->i", JcT, We)

    def _add_readings(
        self,
        system: ArrowSystem,
        residuals: Residuals,
        jacobians: tuple[FloatArray, FloatArray, FloatArray],
        weights: FloatArray,
    ) -> None:
        by_pose, by_shared, by_beacon = jacobians
        by_rest = np.concatenate([by_shared, by_beacon], axis=2)  # (m, 3, 5 + 4)
        W = residuals.information * weights[:, None]
        WJp, WJr, We = by_pose * W[:, :, None], by_rest * W[:, :, None], residuals.readings * W
        own = np.arange(len(CALIBRATION), len(SHARED))
        places = len(SHARED) + BEACON * self.readings.beacon[:, None] + np.arange(BEACON)
        columns = np.concatenate([np.broadcast_to(own, (len(places), own.size)), places], axis=1)
        JpT, JrT = by_pose.transpose(0, 2, 1), by_rest.transpose(0, 2, 1)
        three = np.arange(3)
        np.add.at(system.diagonal, self.at, JpT @ WJp)
        np.add.at(system.border, (self.at[:, None, None], three[None, :, None], columns[:, None, :]), JpT @ WJr)
        np.add.at(system.corner, (columns[:, :, None], columns[:, None, :]), JrT @ WJr)
        np.add.at(system.pose_side, self.at, -np.einsum("kij,kj->ki", JpT, We))
        np.add.at(system.shared_side, columns, -np.einsum("kij,kj->ki", JrT, We))


def repeats(readings: Readings, correlation_s: float) -> FloatArray:
    """How many readings of the same beacon lie within ``correlation_s`` round each, itself among them, shape (m,).

    Errors that last (a camera's, a reflection's) do not average out: with its variance times that number each stretch
    of readings weighs as one, whatever the rate.
    """
    counts = np.ones(len(readings.times_s))
    for beacon in np.unique(readings.beacon) if correlation_s > 0.0 else ():
        rows = np.flatnonzero(readings.beacon == beacon)
        t = readings.times_s[rows]
        half = 0.5 * correlation_s
        counts[rows] = np.searchsorted(t, t + half, "right") - np.searchsorted(t, t - half, "left")
    return counts


def _prior_sigmas(priors: BatchPriors, used: npt.NDArray[np.bool_]) -> FloatArray:
    """Of the shared unknowns and the beacons, shape (10 + 4 b,): 0 fixes one, infinity tells nothing of it."""
    p = priors
    shared = (
        p.distance_scale, p.turn_scale, p.turn_per_m, p.turn_bias_rad_s, p.delay_s, p.range_scale, p.range_offset_m,
        p.bearing_offset_rad, p.rssi_reference_db, p.rssi_exponent,
    )  # fmt: skip
    beacons = np.zeros((len(used), BEACON))
    beacons[used] = (np.inf, np.inf, p.beacon_offset_m, p.beacon_reference_db)
    return np.concatenate([shared, beacons.ravel()])
