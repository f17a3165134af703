"""The smoother of recorded runs: path, beacons and calibration that fit all odometry and all readings best.

Levenberg-Marquardt with noise by Student's t; Cholesky of the arrow-shaped system. It starts from ever longer
beginnings of the run, which beacons join as they can be placed.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded, solve_triangular

from ccatp.beacons.slam.batch_problem import (
    BEACON,
    BEARING_OFFSET,
    CALIBRATION,
    SHARED,
    ArrowSystem,
    BatchProblem,
    BatchState,
    Reckoning,
    carried_on,
    chained,
)
from ccatp.beacons.slam.causal import beyond_priors
from ccatp.beacons.slam.recording import BeaconFix, BoolArray, Calibrated, EstimatedPath, RecordedRun
from ccatp.config.beacon_models import RadioNoiseConfig, RecordingConfig
from ccatp.core import FloatArray, IntArray

BLOCK = 3  # x_m, y_m, heading_rad
BAND = 2 * BLOCK - 1
LEAST_DAMPING = 1e-9
MOST_DAMPING = 1e9
CONVERGED = 1e-5  # relative gain below which a cost has converged


class Factored:
    """Cholesky factors of an arrow system: A by bands, then the Schur complement S = C - B^T A^-1 B.

    ``damping``: the diagonal is multiplied by 1 + damping (Levenberg and Marquardt). Raises LinAlgError: not positive
    definite.
    """

    def __init__(self, system: ArrowSystem, damping: float = 0.0) -> None:
        self.system = system
        n, m = len(system.diagonal), len(system.corner)
        band = _banded(system, damping)
        self._factor = cholesky_banded(band, lower=True, check_finite=False)
        right = np.concatenate([system.border.reshape(n * BLOCK, m), system.pose_side.reshape(-1, 1)], axis=1)
        solved = np.asarray(cho_solve_banded((self._factor, True), right, check_finite=False))
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

    def shared_covariance(self) -> FloatArray:
        """Inverse's block of the shared unknowns, shape (m, m)."""
        return np.asarray(cho_solve(self._schur, np.eye(len(self.system.corner)), check_finite=False))

    def pose_covariances(self) -> FloatArray:
        """Inverse's diagonal block of each pose, shape (n, 3, 3): (A^-1)_kk + W_k W_k^T, W = A^-1 B chol(S)^-T."""
        n, m = len(self.system.diagonal), len(self.system.corner)
        root = np.tril(self._schur[0])
        W = solve_triangular(root, self._border_solved.T, lower=True, check_finite=False).T.reshape(n, BLOCK, m)
        return np.asarray(_diagonal_of_inverse(self.system) + W @ W.transpose(0, 2, 1))


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


def _diagonal_of_inverse(system: ArrowSystem) -> FloatArray:
    A, below = system.diagonal, system.below
    n = len(A)
    left, right = A.copy(), A.copy()
    for k in range(1, n):
        left[k] -= below[k - 1] @ np.linalg.solve(left[k - 1], below[k - 1].T)
    for k in range(n - 2, -1, -1):
        right[k] -= below[k].T @ np.linalg.solve(right[k + 1], below[k])
    return np.asarray(np.linalg.inv(left + right - A))


def t_weights(chi2: FloatArray, sizes: FloatArray, freedom: float, softness: FloatArray | float = 1.0) -> FloatArray:
    """Weight of each reading: (nu + p) / (nu + chi2 / softness), the M-estimator of Student's t with p components.

    A softness above one forgives large residuals: it is how a start far off is not mistaken for outliers.
    """
    weights: FloatArray = (freedom + sizes) / (freedom + chi2 / softness)
    return weights


def t_cost(chi2: FloatArray, sizes: FloatArray, freedom: float, softness: FloatArray | float = 1.0) -> float:
    """Negative log likelihood of Student's t without its constants, with the weights above as its gradient's."""
    return float((0.5 * (freedom + sizes) * softness * np.log1p(chi2 / (freedom * softness))).sum())


def descend(
    problem: BatchProblem,
    state: BatchState,
    most: int,
    softness: FloatArray | float = 1.0,
    enough: float = CONVERGED,
) -> tuple[BatchState, bool]:
    """Minimise the negative log posterior, with the softness of each reading's law (m,); whether that converged."""
    damping = 1e-6

    def cost_of(tried: BatchState) -> float:
        r = problem.residuals(tried)
        readings = t_cost(r.chi2, problem.sizes, problem.radio.freedom, softness)
        steps = np.einsum("ki,kij,kj->k", r.odometry, r.odometry_information, r.odometry)
        return problem.prior_cost(tried) + 0.5 * float(steps.sum()) + readings

    residuals, cost = problem.residuals(state), cost_of(state)
    for _ in range(most):
        weights = t_weights(residuals.chi2, problem.sizes, problem.radio.freedom, softness)
        system = problem.normal_equations(state, weights)
        while (tried := _step(problem, state, system, damping)) is None or cost_of(tried) > cost:
            damping = max(damping, LEAST_DAMPING) * 10.0
            if damping > MOST_DAMPING:
                return state, True
        gain, state = cost - cost_of(tried), tried
        residuals, cost = problem.residuals(state), cost - gain
        damping = max(damping * 0.1, LEAST_DAMPING)
        if gain <= enough * max(abs(cost), 1.0):
            return state, True
    return state, False


def _step(problem: BatchProblem, state: BatchState, system: ArrowSystem, damping: float) -> BatchState | None:
    try:
        poses, shared = Factored(system, damping).solution()
    except LinAlgError:
        return None  # not positive definite
    return state.moved(poses, problem.spread(shared))


STARTS = 48  # directions, around the place of a range's reading, from which a beacon is sought
PLACING_ITERATIONS = 20
FREEDOM = 4.0  # of Student's t by which outliers are bounded
MOST_READINGS = 200  # of one beacon; more are thinned, since first places need no more
APART = 0.1  # two minima are different places if they lie further apart than that part of the beacon's distance
FIRST = 40  # instants solved at first
GROWTH = 1.2  # ratio of the instants solved from one time to the next
GROWING_ITERATIONS = 6
ROUGHLY = 1e-3  # relative gain of the cost that is good enough for a beginning of the run
SURE_MARGIN = 8.0  # half a chi-squared by which a beacon's best place must beat the next one before it joins
LEAST_READINGS = 4  # of a beacon that joins without bearings
# Between the places of a beacon's readings without bearings: from a single place it may lie anywhere on a circle.
LEAST_WAY_M = 0.01
SURE_SPREAD = 0.15  # largest standard deviation of a beacon that joins, over its distance
SPACING_S = 0.5  # there is a pose at least that often, with a reading or without
ITERATIONS = 40
WIDENINGS = 8
WIDER = 1.05  # noise is widened where the residuals are larger than it by that factor
NOISY = 4.0  # how many times the noise may have been widened without a warning
LITTLE = 0.1  # a reading that weighs less counts as refused
# Unknowns s that multiply the odometry, d = (1 + s) d_o; shown is what it reads too much, e with d = d_o / (1 + e).
CORRECTING = ("distance_scale", "turn_scale")
SHOWN_AS = {"delay_s": "odometry_delay_s"}


class Placement(NamedTuple):
    """A beacon's first place."""

    x_m: float
    y_m: float
    margin: float  # by how much the next best place costs more (half a chi-squared); infinite if there is none
    spread: float  # largest standard deviation over the distance of the nearest reading


def place_by_distances(poses: FloatArray, distance_m: FloatArray, variance: FloatArray) -> Placement:
    """Best of the minima of the robust cost of distances, sought from all around the nearest reading.

    A straight path leaves two mirror images that cost the same: see ``margin``. ``poses``: of the readings, shape (m,
    3). ``distance_m``: to one beacon, shape (m,). ``variance``: of the distances, m^2, shape (m,).
    """
    thin = max(1, -(-len(distance_m) // MOST_READINGS))
    x, y, distance, information = poses[::thin, 0], poses[::thin, 1], distance_m[::thin], 1.0 / variance[::thin]
    nearest = int(np.argmin(distance))
    angle = 2.0 * np.pi * np.arange(STARTS) / STARTS
    bx = x[nearest] + distance[nearest] * np.cos(angle)
    by = y[nearest] + distance[nearest] * np.sin(angle)
    reach = float(distance.max())
    xx = yy = xy = np.ones(STARTS)
    for _ in range(PLACING_ITERATIONS):
        dx, dy = bx[:, None] - x, by[:, None] - y
        r = np.maximum(np.hypot(dx, dy), 1e-3)
        e, ux, uy = r - distance, dx / r, dy / r
        w = information * (FREEDOM + 1.0) / (FREEDOM + e * e * information)
        xx, yy, xy = (w * ux * ux).sum(1), (w * uy * uy).sum(1), (w * ux * uy).sum(1)
        little = 1e-3 * (xx + yy)  # a straight path that points at the beacon says nothing across
        xx, yy = xx + little, yy + little
        gx, gy = (w * ux * e).sum(1), (w * uy * e).sum(1)
        determinant = xx * yy - xy * xy
        sx, sy = (yy * gx - xy * gy) / determinant, (xx * gy - xy * gx) / determinant
        size = np.hypot(sx, sy)
        short = np.minimum(1.0, 0.3 * reach / np.maximum(size, 1e-12))
        bx, by = bx - short * sx, by - short * sy
    e = np.hypot(bx[:, None] - x, by[:, None] - y) - distance
    cost = (0.5 * (FREEDOM + 1.0) * np.log1p(e * e * information / FREEDOM)).sum(1)
    best = int(np.argmin(cost))
    others = np.hypot(bx - bx[best], by - by[best]) > APART * reach
    margin = float(cost[others].min() - cost[best]) if others.any() else np.inf
    half_trace, d = 0.5 * (xx[best] + yy[best]), xx[best] * yy[best] - xy[best] ** 2
    least = half_trace - np.sqrt(max(half_trace**2 - d, 0.0))
    spread = float(1.0 / np.sqrt(max(least, 1e-12)) / distance[nearest])
    return Placement(float(bx[best]), float(by[best]), margin, spread)


class Start(NamedTuple):
    """Where the smoother begins."""

    state: BatchState
    used: BoolArray  # which beacons have been placed, shape (b,)
    doubtful: BoolArray  # those whose mirror image fits nearly as well, shape (b,)


def grown(run: RecordedRun, times_s: FloatArray, settings: RecordingConfig) -> Start:
    """Solve ever longer beginnings of the run.

    ``times_s``: instants of the poses, shape (n,): the readings' and the first of all.
    """
    steps, readings, beacons = run.steps, run.readings, len(run.beacon_ids)
    used, doubtful = np.zeros(beacons, dtype=bool), np.zeros(beacons, dtype=bool)
    state = BatchState(np.array([run.first_pose]), np.zeros(len(SHARED)), np.zeros((beacons, BEACON)))
    at = np.searchsorted(times_s, readings.times_s)
    whole = Reckoning(steps, times_s, delayed=False)
    n, known = len(times_s), 1
    while known < n:
        n_now = min(n, max(FIRST, int(known * GROWTH) + 1))
        now = readings.where(at < n_now)
        motion = whole.increments(state.shared[: len(CALIBRATION)], settings.odometry)[0][known - 1 : n_now - 1]
        state = BatchState(
            np.concatenate([state.poses[:-1], chained(state.poses[-1], motion)]), state.shared, state.beacons
        )
        for _ in range(2):  # what is on the map draws the new poses right, then new beacons are placed by them
            problem = BatchProblem(steps, now, times_s[:n_now], run.first_pose, settings, used)
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
        state, _ = descend(problem, state, GROWING_ITERATIONS, softness, enough=ROUGHLY)
    return state


def _join(
    problem: BatchProblem,
    state: BatchState,
    used: BoolArray,
    doubtful: BoolArray,
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
                way = poses[:, 2] + bearing - state.shared[BEARING_OFFSET]
                pointed_at = poses[:, 0] + distance * np.cos(way), poses[:, 1] + distance * np.sin(way)
                state.beacons[beacon, :2] = np.median(pointed_at[0]), np.median(pointed_at[1])
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


def smooth(run: RecordedRun, settings: RecordingConfig, clock_s: Callable[[], float]) -> EstimatedPath:
    """Estimate a whole run at once.

    Minimises the negative log posterior of poses at the instants of the readings, beacons and calibration by
    Levenberg-Marquardt; noise of the readings by Student's t; its width grows if the residuals are wider. Nothing of
    the truth is used but the first pose.
    """
    begin_s, first_radio = clock_s(), settings.radio
    heard_s = np.union1d(run.readings.times_s, run.steps.times_s[:1])
    start = grown(run, heard_s, settings)
    steps_s = run.steps.times_s  # there is a pose at each reading, and at an odometry step now and then between them
    _, first = np.unique(np.floor((steps_s - steps_s[0]) / SPACING_S), return_index=True)
    times_s = np.union1d(run.readings.times_s, steps_s[first])
    problem = BatchProblem(run.steps, run.readings, times_s, run.first_pose, settings, start.used)
    filled = _filled(problem, _anchored(start.state, run.first_pose), np.searchsorted(times_s, heard_s))
    state, converged = descend(problem, filled, ITERATIONS)
    for _ in range(WIDENINGS):
        radio = _widened(problem, state)
        if radio == problem.radio:
            break
        settings = settings.model_copy(update={"radio": radio})
        problem = BatchProblem(run.steps, run.readings, times_s, run.first_pose, settings, start.used)
        state, converged = descend(problem, state, ITERATIONS)
    took_s = clock_s() - begin_s
    weights = t_weights(problem.residuals(state).chi2, problem.sizes, problem.radio.freedom)
    factored = Factored(problem.normal_equations(state, weights))
    size = problem.free.size
    covariance = np.zeros((size, size))
    covariance[np.ix_(problem.free, problem.free)] = factored.shared_covariance()
    counted = problem.sizes > 0
    updates = int(counted.sum())
    beacons = {}
    for k in np.flatnonzero(start.used).tolist():
        place = slice(len(SHARED) + BEACON * k, len(SHARED) + BEACON * k + 2)
        x_m, y_m = state.beacons[k, :2].tolist()
        beacons[run.beacon_ids[k]] = BeaconFix(x_m, y_m, covariance[place, place])
    calibration = _calibration(problem, state, np.sqrt(np.diag(covariance)))
    priors = {SHOWN_AS.get(name, name): getattr(problem.priors, name) for name in SHARED}
    warnings = [*_warnings(run, start, converged), *beyond_priors(calibration, priors, run.kind)]
    for what, name in (("range", "range_sigma_m"), ("bearing", "bearing_sigma_rad"), ("rssi", "rssi_sigma_db")):
        if (ratio := getattr(problem.radio, name) / getattr(first_radio, name)) > NOISY:
            much = f"{ratio:.1f} times as noisy as assumed"
            warnings.append(f"{what} readings are {much}: beacons exchanged or moved on the way?")
    return EstimatedPath(
        times_s=times_s,
        poses=state.poses,
        covariances=factored.pose_covariances(),
        beacons=beacons,
        calibration=calibration,
        refused=int((weights[counted] < LITTLE).sum()),
        update_s=np.array([took_s / max(updates, 1)]),
        updates=updates,
        warnings=tuple(warnings),
    )


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


def _filled(problem: BatchProblem, state: BatchState, known: IntArray) -> BatchState:
    motion = problem.reckoning.increments(state.shared[: len(CALIBRATION)], problem.odometry)[0]
    poses = np.empty((len(motion) + 1, 3))
    poses[known] = state.poses
    is_known = np.zeros(len(poses), dtype=bool)
    is_known[known] = True
    for k in np.flatnonzero(~is_known).tolist():
        poses[k] = carried_on(poses[k - 1], motion[k - 1])
    return BatchState(poses, state.shared, state.beacons)


def _widened(problem: BatchProblem, state: BatchState) -> RadioNoiseConfig:
    """Noise of the readings, wider where the weighted residuals ask for it.

    The maximum-likelihood scale of Student's t is that of sum w e^2 / sigma^2 = number of readings.
    """
    residuals, radio = problem.residuals(state), problem.radio
    weights = t_weights(residuals.chi2, problem.sizes, radio.freedom)
    squares = weights[:, None] * residuals.readings**2 * residuals.information
    counts = problem.there.sum(axis=0)
    factors = np.sqrt(squares.sum(axis=0) / np.maximum(counts, 1))
    by_range, by_bearing, by_rssi = np.where((factors > WIDER) & (counts > 0), factors, 1.0).tolist()
    wider = {
        "range_sigma_m": radio.range_sigma_m * by_range,
        "range_sigma_per_m": radio.range_sigma_per_m * by_range,
        "bearing_sigma_rad": radio.bearing_sigma_rad * by_bearing,
        "rssi_sigma_db": radio.rssi_sigma_db * by_rssi,
    }
    return radio.model_copy(update=wider)


def _calibration(problem: BatchProblem, state: BatchState, sigmas: FloatArray) -> dict[str, Calibrated]:
    ranged, pointed, heard = (bool(problem.there[:, k].any()) for k in range(3))
    shown = {"range_scale": ranged, "range_offset_m": ranged, "bearing_offset_rad": pointed}
    shown |= {"rssi_reference_db": heard, "rssi_exponent": heard}
    found = {}
    for k, name in enumerate(SHARED):
        if problem.free[k] and shown.get(name, True):
            value, sigma = float(state.shared[k]), float(sigmas[k])
            if name in CORRECTING:
                scale = 1.0 + value
                value, sigma = 1.0 / scale - 1.0, sigma / scale**2
            found[SHOWN_AS.get(name, name)] = Calibrated(value, sigma)
    return found


def _warnings(run: RecordedRun, start: Start, converged: bool) -> Iterator[str]:
    for k, name in enumerate(run.beacon_ids):
        if not start.used[k]:
            yield f"beacon {name} could not be placed: too few readings of it, or all from one place"
        elif start.doubtful[k]:
            yield f"beacon {name} may lie at its mirror image: the path tells too little of its side"
    if not converged:
        yield f"the smoother stopped after {ITERATIONS} iterations before it had converged"
