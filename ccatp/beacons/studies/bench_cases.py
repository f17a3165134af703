"""The case of range SLAM in the benchmarks: a vehicle on an arc receives one beacon per step."""

from collections.abc import Iterator
from functools import partial
from math import cos, hypot, sin, tau
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from ccatp.beacons.filters.ekf_slam import EkfSlam, columns_of
from ccatp.core import FloatArray
from ccatp.studies.bench_cases import SEED, STEPS, Race, Solution

_VEHICLE, _SHARED, _BLOCK = 3, 2, 2  # pose; scale and offset of ranges; place of a beacon
_RANGE_SIGMA_M, _STEP_M, _TURN_RAD = 0.1, 0.05, 0.02
_SLAM_NOISE = np.diag((1e-4, 1e-4, 1e-5))


def races() -> Iterator[Race]:
    """Steps of range SLAM: a prediction and a scalar update."""
    for beacons in (4, 50, 200):
        slam = slam_problem(beacons)
        name, ours = f"ekf-slam, {beacons} beacons, n = {slam.mean.size}", partial(our_slam, slam)
        if beacons < 200:
            yield Race(name, ours, {"whole matrices in numpy": partial(dense_slam, slam)}, is_dense=True)
        else:
            note = f"ekf-slam: whole matrices take n^3, too long to race against with {beacons} beacons"
            yield Race(name, ours, {}, note=note)


class SlamProblem(NamedTuple):
    """Pose, range scale and offset, beacons: mean (n,), covariance (n, n); one range per step, to each in turn."""

    mean: FloatArray
    covariance: FloatArray
    ranges_m: FloatArray
    touched: list[list[int]]  # states on which a range to each beacon depends


def slam_problem(beacons: int) -> SlamProblem:
    """Beacons at 3 to 8 m about the vehicle, with a standard deviation of 0.3 m per coordinate."""
    rng = np.random.default_rng((SEED, beacons))
    angles, radii = tau * np.arange(beacons) / beacons, rng.uniform(3.0, 8.0, beacons)
    places = np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])
    mean = np.concatenate([np.zeros(_VEHICLE + _SHARED), places.ravel()])
    sigmas = np.array((0.05, 0.05, 0.02, 0.05, 0.1, *[0.3] * (_BLOCK * beacons)))
    first = _VEHICLE + _SHARED
    touched = [[*range(first), at, at + 1] for at in range(first, mean.size, _BLOCK)]
    true, ranges = mean + sigmas * rng.normal(size=sigmas.size), np.empty(STEPS)
    for i in range(STEPS):
        true[:_VEHICLE] = _moved(true[:_VEHICLE])[0]
        ranges[i] = _range(true[touched[i % beacons]].tolist())[0] + _RANGE_SIGMA_M * rng.normal()
    return SlamProblem(mean, np.diag(sigmas**2), ranges, touched)


def our_slam(problem: SlamProblem) -> Solution:
    """``EkfSlam``, with blocks and sparse rows."""
    x, P, ranges_m, touched = problem
    shared = slice(_VEHICLE, _VEHICLE + _SHARED)
    ours = EkfSlam(x[:_VEHICLE], P[:_VEHICLE, :_VEHICLE], x[shared], P[shared, shared])
    for beacon, states in enumerate(touched):
        at, none = slice(states[-2], states[-1] + 1), np.empty(0, dtype=np.intp)
        ours.augment(beacon, x[at], none, np.zeros((_BLOCK, 0)), np.eye(_BLOCK), P[at, at])
    columns = [columns_of(states) for states in touched]
    yield attrgetter("mean", "covariance")
    for i in range(STEPS):
        new, F = _moved(ours.mean[:_VEHICLE])
        ours.predict(new, F, _SLAM_NOISE)
        seen = columns[i % len(columns)]
        expected, h = _range(ours.mean.take(seen).tolist())
        ours.update_row(seen, np.array(h), ranges_m[i] - expected, _RANGE_SIGMA_M**2)
        yield ours


def dense_slam(problem: SlamProblem) -> Solution:
    """The same by F P F^T + Q and (I - K H) P of the whole state, in numpy."""
    x, P, ranges_m, touched = problem
    x, n = x.copy(), x.size
    identity, Q = np.eye(n), np.zeros((n, n))
    Q[:_VEHICLE, :_VEHICLE] = _SLAM_NOISE
    yield tuple
    for i in range(STEPS):
        F, H = np.eye(n), np.zeros(n)
        x[:_VEHICLE], F[:_VEHICLE, :_VEHICLE] = _moved(x[:_VEHICLE])
        P = F @ P @ F.T + Q
        states = touched[i % len(touched)]
        expected, H[states] = _range(x[states].tolist())
        K = P @ H / (H @ P @ H + _RANGE_SIGMA_M**2)
        x += K * (ranges_m[i] - expected)
        P = (identity - np.outer(K, H)) @ P
        yield x, P


def _moved(pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The pose after a step, and its Jacobian."""
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
