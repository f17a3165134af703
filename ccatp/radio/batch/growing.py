"""Pure. A start for the smoother: ever longer beginnings of the run, which beacons join as they can be placed."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ccatp.filters.base import FloatArray
from ccatp.radio.batch.descent import descend
from ccatp.radio.batch.placing import APART, place_by_bearings, place_by_distances
from ccatp.radio.batch.problem import BEACON, SHARED, BatchProblem, State
from ccatp.radio.batch.reckoning import CALIBRATION, Reckoning, chained
from ccatp.radio.batch.settings import BatchSettings
from ccatp.radio.recording import Readings, Steps

FIRST = 40
"""Instants solved at first."""
GROWTH = 1.2
"""Ratio of the instants solved from one time to the next."""
ITERATIONS = 6
ROUGHLY = 1e-3
"""Relative gain of the cost that is good enough for a beginning of the run."""
SURE_MARGIN = 8.0
"""Half a chi-squared by which a beacon's best place must beat the next one before it joins."""
LEAST_READINGS = 4
"""Of a beacon that joins without bearings."""
LEAST_WAY_M = 0.01
"""Between the places of a beacon's readings without bearings: from a single place it may lie anywhere on a circle."""
SURE_SPREAD = 0.15
"""Largest standard deviation of a beacon that joins, over its distance."""


class Start(NamedTuple):
    """Where the smoother begins.

    Attributes:
        state: poses at every instant, calibration, beacons.
        used: which beacons have been placed, shape (b,).
        doubtful: those whose mirror image fits nearly as well, shape (b,).
    """

    state: State
    used: npt.NDArray[np.bool_]
    doubtful: npt.NDArray[np.bool_]


def grown(
    steps: Steps,
    readings: Readings,
    times_s: FloatArray,
    first_pose: tuple[float, float, float],
    settings: BatchSettings,
    beacons: int,
) -> Start:
    """Solve ever longer beginnings of the run.

    Args:
        steps: of dead reckoning.
        readings: in order of time.
        times_s: instants of the poses, shape (n,): the readings' and the first of all.
        first_pose: x_m, y_m, heading_rad.
        settings: priors and noise.
        beacons: how many there are.
    """
    used, doubtful = np.zeros(beacons, dtype=bool), np.zeros(beacons, dtype=bool)
    state = State(np.array([first_pose]), np.zeros(len(SHARED)), np.zeros((beacons, BEACON)))
    at = np.searchsorted(times_s, readings.times_s)
    whole = Reckoning(steps, times_s, delayed=False)
    n, known = len(times_s), 1
    while known < n:
        n_now = min(n, max(FIRST, int(known * GROWTH) + 1))
        now = readings.where(at < n_now)
        motion = whole.increments(state.shared[: len(CALIBRATION)], settings.odometry).motion[known - 1 : n_now - 1]
        state = State(np.concatenate([state.poses[:-1], chained(state.poses[-1], motion)]), state.shared, state.beacons)
        for _ in range(2):  # what is on the map draws the new poses right, then new beacons are placed by them
            problem = BatchProblem(steps, now, times_s[:n_now], first_pose, settings, used)
            state = _settled(problem, state, known)
            joined = _join(problem, state, used, doubtful, last=n_now == n)
            if not joined:
                break
        known = n_now
    return Start(state, used, doubtful)


def _settled(problem: BatchProblem, state: State, known: int) -> State:
    """The state after a few steps, soft with readings along the new poses, which may still be far off."""
    new = problem.at >= known
    counted = new & (problem.sizes > 0)
    for forgiving in (True, False):
        softness = np.ones(len(problem.at))
        if forgiving:
            if not counted.any():
                continue
            chi2 = problem.residuals(state).chi2
            softness[new] = max(1.0, float(np.median(chi2[counted] / problem.sizes[counted])))
            if softness[new].max(initial=1.0) < 4.0:
                continue
        state = descend(problem, state, ITERATIONS, softness, enough=ROUGHLY).state
    return state


def _join(
    problem: BatchProblem,
    state: State,
    used: npt.NDArray[np.bool_],
    doubtful: npt.NDArray[np.bool_],
    *,
    last: bool,
) -> bool:
    """Place what can be placed; also put right what is better placed elsewhere. Whether anything changed."""
    changed = False
    readings = problem.readings
    for beacon in range(len(used)):
        rows = np.flatnonzero(readings.beacon == beacon)
        rows = rows[np.isfinite(readings.range_m[rows]) | np.isfinite(readings.rssi_dbm[rows])]
        pointed = rows[np.isfinite(readings.bearing_rad[rows])]
        if pointed.size:
            if not used[beacon]:
                poses, bearing = state.poses[problem.at[pointed]], readings.bearing_rad[pointed]
                distance, _ = problem.distances(state, pointed)
                state.beacons[beacon, :2] = place_by_bearings(poses, distance, bearing, state.shared)
                used[beacon] = changed = True
            continue
        # one that is surely placed is looked at again at the end, by all readings
        if rows.size < LEAST_READINGS or (used[beacon] and not doubtful[beacon] and not last):
            continue
        if np.ptp(state.poses[problem.at[rows], :2], axis=0).max() < LEAST_WAY_M:
            continue
        distance, variance = problem.distances(state, rows)
        found = place_by_distances(state.poses[problem.at[rows]], distance, variance)
        sure = found.margin > SURE_MARGIN and found.spread < SURE_SPREAD
        doubtful[beacon] = not sure
        if not sure and (used[beacon] or not last):
            continue
        away = np.hypot(found.x_m - state.beacons[beacon, 0], found.y_m - state.beacons[beacon, 1])
        if used[beacon] and away < APART * distance.max():
            continue
        state.beacons[beacon, :2] = found.x_m, found.y_m
        used[beacon] = changed = True
    return changed
