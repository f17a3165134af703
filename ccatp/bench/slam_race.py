"""Range EKF-SLAM as a race: ``EkfSlam`` against the same filter by whole matrices."""

from dataclasses import dataclass
from math import cos, hypot, sin, tau

import numpy as np

from ccatp.bench.contenders import Contender
from ccatp.core import FloatArray
from ccatp.filters.ekf_slam import Columns, EkfSlam, columns_of

BEACONS = (4, 50, 200)
DENSE_BEACONS = 50
"""Beyond as many beacons whole matrices take n^3 too long to race against."""
_VEHICLE, _SHARED, _BLOCK = 3, 2, 2  # pose; scale and offset of ranges; place of a beacon
_SIGMA_M, _STEP_M, _TURN_RAD = 0.1, 0.05, 0.02
_VEHICLE_SIGMA, _SHARED_SIGMA, _BEACON_SIGMA_M = (0.05, 0.05, 0.02), (0.05, 0.1), 0.3


@dataclass(frozen=True, slots=True)
class SlamProblem:
    """A vehicle on an arc that hears one beacon a step.

    Attributes:
        mean: of pose, range scale and offset, and beacons, shape (n,).
        covariance: shape (n, n).
        Q: process noise of the pose, shape (3, 3).
        ranges_m: one a step, of beacon ``step % beacons``, shape (steps,).
    """

    mean: FloatArray
    covariance: FloatArray
    Q: FloatArray
    ranges_m: FloatArray

    @property
    def beacons(self) -> int:
        """How many there are."""
        return (self.mean.size - _VEHICLE - _SHARED) // _BLOCK


def slam_problem(beacons: int, steps: int, seed: int) -> SlamProblem:
    """Beacons about the vehicle at 3 to 8 m, known to 0.3 m."""
    rng = np.random.default_rng((seed, beacons))
    angles, radii = tau * np.arange(beacons) / beacons, rng.uniform(3.0, 8.0, beacons)
    places = np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])
    mean = np.concatenate([np.zeros(_VEHICLE + _SHARED), places.ravel()])
    sigmas = np.array((*_VEHICLE_SIGMA, *_SHARED_SIGMA, *[_BEACON_SIGMA_M] * (_BLOCK * beacons)))
    true = mean + sigmas * rng.normal(size=sigmas.size)
    ranges = np.empty(steps)
    for i in range(steps):
        true[:_VEHICLE] = _moved(true[:_VEHICLE])[0]
        at = _VEHICLE + _SHARED + _BLOCK * (i % beacons)
        distance = hypot(true[at] - true[0], true[at + 1] - true[1])
        ranges[i] = (1.0 + true[3]) * distance + true[4] + _SIGMA_M * rng.normal()
    return SlamProblem(mean, np.diag(sigmas**2), np.diag((1e-4, 1e-4, 1e-5)), ranges)


def our_slam(problem: SlamProblem) -> Contender:
    """Blocks and sparse rows."""
    ours: EkfSlam
    columns: list[Columns] = []
    shared = slice(_VEHICLE, _VEHICLE + _SHARED)

    def reset() -> None:
        nonlocal ours
        x, P = problem.mean, problem.covariance
        ours = EkfSlam(x[:_VEHICLE], P[:_VEHICLE, :_VEHICLE], x[shared], P[shared, shared])
        columns.clear()
        none = np.empty(0, dtype=np.intp)
        for beacon in range(problem.beacons):
            at = slice(shared.stop + _BLOCK * beacon, shared.stop + _BLOCK * (beacon + 1))
            ours.augment(beacon, x[at], none, np.zeros((_BLOCK, 0)), np.eye(_BLOCK), P[at, at])
            columns.append(columns_of(range(_VEHICLE), shared, at))

    def step(i: int) -> None:
        new, F = _moved(ours.mean[:_VEHICLE])
        ours.predict(new, F, problem.Q)
        heard = columns[i % problem.beacons]
        expected, h = _range(ours.mean.take(heard).tolist())
        ours.update_row(heard, np.array(h), problem.ranges_m[i] - expected, _SIGMA_M**2)

    return Contender(reset, step, lambda: (ours.mean.copy(), ours.covariance.copy()))


def dense_slam(problem: SlamProblem) -> Contender:
    """The same by F P F^T + Q and (I - K H) P of the whole state, in bare numpy."""
    x, P = problem.mean, problem.covariance
    n = x.size
    identity, Q = np.eye(n), np.zeros((n, n))
    Q[:_VEHICLE, :_VEHICLE] = problem.Q

    def reset() -> None:
        nonlocal x, P
        x, P = problem.mean.copy(), problem.covariance

    def step(i: int) -> None:
        nonlocal x, P
        F = np.eye(n)
        x[:_VEHICLE], F[:_VEHICLE, :_VEHICLE] = _moved(x[:_VEHICLE])
        P = F @ P @ F.T + Q
        at = _VEHICLE + _SHARED + _BLOCK * (i % problem.beacons)
        heard = [*range(_VEHICLE + _SHARED), at, at + 1]
        expected, h = _range(x[heard].tolist())
        H = np.zeros(n)
        H[heard] = h
        K = P @ H / (H @ P @ H + _SIGMA_M**2)
        x += K * (problem.ranges_m[i] - expected)
        P = (identity - np.outer(K, H)) @ P

    return Contender(reset, step, lambda: (x, P))


def _moved(pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The pose a step on, and its Jacobian."""
    x, y, heading = pose.tolist()
    dx, dy = _STEP_M * cos(heading), _STEP_M * sin(heading)
    F = np.array(((1.0, 0.0, -dy), (0.0, 1.0, dx), (0.0, 0.0, 1.0)))
    return np.array((x + dx, y + dy, heading + _TURN_RAD)), F


def _range(states: list[float]) -> tuple[float, list[float]]:
    """(1 + scale) r + offset, and its derivatives by pose, scale, offset and place."""
    x, y, _, scale, offset, bx, by = states
    dx, dy = bx - x, by - y
    r = hypot(dx, dy)
    ux, uy = (1.0 + scale) * dx / r, (1.0 + scale) * dy / r
    return (1.0 + scale) * r + offset, [-ux, -uy, 0.0, r, 1.0, ux, uy]
