"""The smoother of recorded runs: path, beacons and calibration that fit all odometry and all readings best.

A start for the smoother: ever longer beginnings of the run, which beacons join as they can be placed.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ccatp.beacons.slam.batch_odometry import CALIBRATION, BatchSettings, RadioNoise, Reckoning, carried_on, chained
from ccatp.beacons.slam.batch_problem import BEACON, SHARED, BatchProblem, BatchState, Factored
from ccatp.beacons.slam.batch_solver import APART, Descent, descend, place_by_bearings, place_by_distances, t_weights
from ccatp.beacons.slam.causal import beyond_priors
from ccatp.beacons.slam.recording import BeaconFix, Calibrated, EstimatedPath, Readings, RecordedRun, Steps
from ccatp.core import FloatArray

FIRST = 40  # instants solved at first
GROWTH = 1.2  # ratio of the instants solved from one time to the next
GROWING_ITERATIONS = 6
ROUGHLY = 1e-3  # relative gain of the cost that is good enough for a beginning of the run
SURE_MARGIN = 8.0  # half a chi-squared by which a beacon's best place must beat the next one before it joins
LEAST_READINGS = 4  # of a beacon that joins without bearings
# Between the places of a beacon's readings without bearings: from a single place it may lie anywhere on a circle.
LEAST_WAY_M = 0.01
SURE_SPREAD = 0.15  # largest standard deviation of a beacon that joins, over its distance


class Start(NamedTuple):
    """Where the smoother begins.

    Attributes:
        used: which beacons have been placed, shape (b,).
        doubtful: those whose mirror image fits nearly as well, shape (b,).
    """

    state: BatchState
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
        times_s: instants of the poses, shape (n,): the readings' and the first of all.
    """
    used, doubtful = np.zeros(beacons, dtype=bool), np.zeros(beacons, dtype=bool)
    state = BatchState(np.array([first_pose]), np.zeros(len(SHARED)), np.zeros((beacons, BEACON)))
    at = np.searchsorted(times_s, readings.times_s)
    whole = Reckoning(steps, times_s, delayed=False)
    n, known = len(times_s), 1
    while known < n:
        n_now = min(n, max(FIRST, int(known * GROWTH) + 1))
        now = readings.where(at < n_now)
        motion = whole.increments(state.shared[: len(CALIBRATION)], settings.odometry).motion[known - 1 : n_now - 1]
        state = BatchState(
            np.concatenate([state.poses[:-1], chained(state.poses[-1], motion)]), state.shared, state.beacons
        )
        for _ in range(2):  # what is on the map draws the new poses right, then new beacons are placed by them
            problem = BatchProblem(steps, now, times_s[:n_now], first_pose, settings, used)
            state = _settled(problem, state, known)
            joined = _join(problem, state, used, doubtful, last=n_now == n)
            if not joined:
                break
        known = n_now
    return Start(state, used, doubtful)


def _settled(problem: BatchProblem, state: BatchState, known: int) -> BatchState:
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
        state = descend(problem, state, GROWING_ITERATIONS, softness, enough=ROUGHLY).state
    return state


def _join(
    problem: BatchProblem,
    state: BatchState,
    used: npt.NDArray[np.bool_],
    doubtful: npt.NDArray[np.bool_],
    *,
    last: bool,
) -> bool:
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


SPACING_S = 0.5  # there is a pose at least that often, whether something was heard or not
ITERATIONS = 40
WIDENINGS = 8
WIDER = 1.05  # noise is widened where the residuals are larger than it by that factor
NOISY = 4.0  # how many times the noise may have been widened without being told
LITTLE = 0.1  # a reading that weighs less counts as refused
# Unknowns that multiply the odometry; what is told is what it reads too much, as the filter does.
CORRECTING = ("distance_scale", "turn_scale")
TOLD_AS = {"delay_s": "odometry_delay_s"}


def smooth(run: RecordedRun, settings: BatchSettings, clock_s: Callable[[], float]) -> EstimatedPath:
    """Estimate a whole run at once.

    Minimises the negative log posterior of poses at the instants of the readings, beacons and calibration by
    Levenberg-Marquardt; noise of the readings by Student's t; its width grows if the residuals are wider. Nothing of
    the truth is used but the first pose.
    """
    begin_s, first_radio = clock_s(), settings.radio
    heard_s = np.union1d(run.readings.times_s, run.steps.times_s[:1])
    start = grown(run.steps, run.readings, heard_s, run.first_pose, settings, len(run.beacon_ids))
    times_s = instants(run)
    problem = BatchProblem(run.steps, run.readings, times_s, run.first_pose, settings, start.used)
    filled = _filled(problem, _anchored(start.state, run.first_pose), np.searchsorted(times_s, heard_s))
    found = descend(problem, filled, ITERATIONS)
    for _ in range(WIDENINGS):
        radio = _widened(problem, found.state)
        if radio == problem.radio:
            break
        settings = replace(settings, radio=radio)
        problem = BatchProblem(run.steps, run.readings, times_s, run.first_pose, settings, start.used)
        found = descend(problem, found.state, ITERATIONS)
    return _track(run, problem, times_s, found, start, first_radio, clock_s() - begin_s)


def instants(run: RecordedRun) -> FloatArray:
    """Times of the poses: of all readings, and of an odometry step now and then between them, s."""
    steps_s = run.steps.times_s
    _, first = np.unique(np.floor((steps_s - steps_s[0]) / SPACING_S), return_index=True)
    return np.union1d(run.readings.times_s, steps_s[first])


def _anchored(state: BatchState, first_pose: tuple[float, float, float]) -> BatchState:
    """The state moved as a whole, so that it begins at the first pose: nothing but the prior of that is another."""
    x_m, y_m, heading_rad = state.poses[0].tolist()
    turn = first_pose[2] - heading_rad
    c, s = np.cos(turn), np.sin(turn)

    def moved(points: FloatArray) -> FloatArray:
        dx, dy = points[:, 0] - x_m, points[:, 1] - y_m
        return np.column_stack([first_pose[0] + c * dx - s * dy, first_pose[1] + s * dx + c * dy])

    poses = np.column_stack([moved(state.poses), state.poses[:, 2] + turn])
    return BatchState(poses, state.shared, np.column_stack([moved(state.beacons), state.beacons[:, 2:]]))


def _filled(problem: BatchProblem, state: BatchState, known: npt.NDArray[np.int64]) -> BatchState:
    motion = problem.reckoning.increments(state.shared[: len(CALIBRATION)], problem.odometry).motion
    poses = np.empty((len(motion) + 1, 3))
    poses[known] = state.poses
    is_known = np.zeros(len(poses), dtype=bool)
    is_known[known] = True
    for k in np.flatnonzero(~is_known).tolist():
        poses[k] = carried_on(poses[k - 1], motion[k - 1])
    return BatchState(poses, state.shared, state.beacons)


def _widened(problem: BatchProblem, state: BatchState) -> RadioNoise:
    residuals, radio = problem.residuals(state), problem.radio
    weights = t_weights(residuals.chi2, problem.sizes, radio.freedom)
    squares = weights[:, None] * residuals.readings**2 * residuals.information
    counts = problem.there.sum(axis=0)
    factors = np.sqrt(squares.sum(axis=0) / np.maximum(counts, 1))
    by_range, by_bearing, by_rssi = np.where((factors > WIDER) & (counts > 0), factors, 1.0).tolist()
    return replace(
        radio,
        range_sigma_m=radio.range_sigma_m * by_range,
        range_sigma_per_m=radio.range_sigma_per_m * by_range,
        bearing_sigma_rad=radio.bearing_sigma_rad * by_bearing,
        rssi_sigma_db=radio.rssi_sigma_db * by_rssi,
    )


def _track(
    run: RecordedRun,
    problem: BatchProblem,
    times_s: FloatArray,
    found: Descent,
    start: Start,
    first_radio: RadioNoise,
    took_s: float,
) -> EstimatedPath:
    state = found.state
    residuals = problem.residuals(state)
    weights = t_weights(residuals.chi2, problem.sizes, problem.radio.freedom)
    factored = Factored(problem.normal_equations(state, weights, np.ones(len(state.poses) - 1)))
    size = problem.free.size
    covariance = np.zeros((size, size))
    covariance[np.ix_(problem.free, problem.free)] = factored.shared_covariance()
    counted = problem.sizes > 0
    updates = int(counted.sum())
    calibration = _calibration(problem, state, covariance)
    priors = {TOLD_AS.get(name, name): getattr(problem.settings.priors, name) for name in SHARED}
    return EstimatedPath(
        times_s=times_s,
        poses=state.poses,
        covariances=factored.pose_covariances(),
        beacons=_beacons(run, state, start, covariance),
        calibration=calibration,
        nis=np.empty(0),
        nis_sizes=np.empty(0),
        refused=int((weights[counted] < LITTLE).sum()),
        update_s=np.array([took_s / max(updates, 1)]),
        predict_s=np.empty(0),
        scalar_s=np.empty(0),
        updates=updates,
        warnings=(
            *_warnings(run, start, found.converged),
            *beyond_priors(calibration, priors, run.kind),
            *_noisy(problem.radio, first_radio),
        ),
    )


def _beacons(run: RecordedRun, state: BatchState, start: Start, covariance: FloatArray) -> dict[str, BeaconFix]:
    found = {}
    for k, name in enumerate(run.beacon_ids):
        if start.used[k]:
            place = slice(len(SHARED) + BEACON * k, len(SHARED) + BEACON * k + 2)
            x_m, y_m = state.beacons[k, :2].tolist()
            found[name] = BeaconFix(x_m, y_m, covariance[place, place])
    return found


def _calibration(problem: BatchProblem, state: BatchState, covariance: FloatArray) -> dict[str, Calibrated]:
    sigmas = np.sqrt(np.diag(covariance))
    ranged, pointed, heard = (bool(problem.there[:, k].any()) for k in range(3))
    told = {"range_scale": ranged, "range_offset_m": ranged, "bearing_offset_rad": pointed}
    told |= {"rssi_reference_db": heard, "rssi_exponent": heard}
    found = {
        name: Calibrated(float(state.shared[k]), float(sigmas[k]))
        for k, name in enumerate(SHARED)
        if problem.free[k] and told.get(name, True)
    }
    return {TOLD_AS.get(name, name): _read(one) if name in CORRECTING else one for name, one in found.items()}


def _read(correction: Calibrated) -> Calibrated:
    scale = 1.0 + correction.value
    return Calibrated(1.0 / scale - 1.0, correction.sigma / scale**2)


def _noisy(radio: RadioNoise, first: RadioNoise) -> Iterator[str]:
    for what in ("range", "bearing", "rssi"):
        name = {"range": "range_sigma_m", "bearing": "bearing_sigma_rad", "rssi": "rssi_sigma_db"}[what]
        ratio = getattr(radio, name) / getattr(first, name)
        if ratio > NOISY:
            yield f"{what} readings are {ratio:.1f} times as noisy as assumed: beacons exchanged or moved on the way?"


def _warnings(run: RecordedRun, start: Start, converged: bool) -> tuple[str, ...]:
    lines = []
    for k, name in enumerate(run.beacon_ids):
        if not start.used[k]:
            lines.append(f"beacon {name} could not be placed: too few readings of it, or all from one place")
        elif start.doubtful[k]:
            lines.append(f"beacon {name} may lie at its mirror image: the path tells too little of its side")
    if not converged:
        lines.append(f"the smoother stopped after {ITERATIONS} iterations before it had converged")
    return tuple(lines)
