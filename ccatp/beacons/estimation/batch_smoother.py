"""The smoother of recorded runs: path, beacons and calibration with the best fit to all odometry and readings.

Levenberg-Marquardt with Student's t for the readings; Cholesky of the arrow-shaped system. The initial values are those
of the filter.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError

from ccatp.beacons.config.models import (
    FixedLagConfig,
    OdometryNoiseConfig,
    RadioNoiseConfig,
    RecordingConfig,
    SlamFilterConfig,
)
from ccatp.beacons.estimation.batch_problem import BatchProblem
from ccatp.beacons.estimation.batch_unknowns import BEACON, HEIGHT, RSSI_REFERENCE, SHARED, BatchState, PlacePrior
from ccatp.beacons.estimation.causal import Followed, beyond_priors, follow
from ccatp.beacons.estimation.evaluation import aligned_beacons
from ccatp.beacons.estimation.landmark_init import LEAST
from ccatp.beacons.estimation.least_squares import WELL_CONVERGED, Factored, descend, t_weights
from ccatp.beacons.estimation.measurement_models import HEIGHT_M2
from ccatp.beacons.estimation.odometry_noise import OdometryNoise, odometry_noise
from ccatp.beacons.estimation.recording import (
    BeaconFix,
    BoolArray,
    Calibrated,
    EstimatedPath,
    RecordedRun,
    Steps,
    first_of_each,
)
from ccatp.beacons.estimation.window import spread_by_priors
from ccatp.beacons.filters.ekf_slam import columns_of
from ccatp.beacons.rigid_motion import best_motion
from ccatp.core import FloatArray
from ccatp.errors import counted

SPACING_S = 0.5  # longest interval between poses without readings
FAR_OFF = 4.0  # median of the squared normalised residuals above which it is used as softness of the first iterations
ROUGH_ITERATIONS, ROUGHLY = 6, 1e-3
ITERATIONS = 40
ESTIMATES = 8  # of the noise
WIDER = 1.05  # the noise is increased if the residuals exceed it by this factor
CLOSE = 0.1  # relative change of the variances of the odometry at which they have converged
NOISY = 4.0  # largest increase of the noise without a warning
LITTLE = 0.1  # a reading with a smaller weight counts as refused


class Start(NamedTuple):
    """Initial values of the smoother."""

    state: BatchState
    used: BoolArray  # beacons that have a place, shape (b,)
    doubtful: BoolArray  # beacons that have not joined the filter's map: the mirror image may fit as well, shape (b,)


def _started(run: RecordedRun, settings: RecordingConfig, found: Followed, times_s: FloatArray) -> Start:
    """Path, map and calibration of the filter; a beacon that still waits begins at its best candidate."""
    slam, poses = found.slam, _poses_at(found.path, times_s)
    priors, shared, raised = settings.priors, np.zeros(len(SHARED)), run.raised
    for name, (value, _) in slam.calibration.items():
        shared[SHARED.index(name)] = value
    count = len(run.beacon_ids)
    beacons, used, doubtful = np.zeros((count, BEACON)), np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    levels_db = []
    for k, name in enumerate(run.beacon_ids):
        waiting = slam.waiting.get(name)
        if name in slam.beacons:
            mean = slam.beacons[name].mean
        elif waiting is not None and waiting.candidates and (run.readings.beacon == k).any():
            mean, doubtful[k] = waiting.candidates[0].mean, True
        else:
            continue
        if name in run.moving:
            continue
        beacons[k, :2], used[k] = mean[:2], True
        if raised[k]:
            beacons[k, HEIGHT] = mean[2] if mean.size > 2 else 0.0  # the filter alone has none
        elif mean.size > 2 and priors.rssi_reference_db > 0.0:
            levels_db.append(mean[2] - settings.radio.rssi_reference_dbm)
    if levels_db:
        shared[RSSI_REFERENCE] = np.mean(levels_db)
    return Start(BatchState(poses, shared, beacons), used, doubtful)


def _poses_at(path: EstimatedPath, times_s: FloatArray) -> FloatArray:
    return np.column_stack([np.interp(times_s, path.times_s, column) for column in path.poses.T])


def _ends(poses: FloatArray) -> FloatArray:
    """The positions and points one metre ahead, (2 n, 2): they define a frame even if all positions are the same."""
    ahead = np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    return np.concatenate([poses[:, :2], poses[:, :2] + ahead])


def lagged_run(
    run: RecordedRun, cfg: RecordingConfig, how: SlamFilterConfig, clock_s: Callable[[], float], lag: FixedLagConfig
) -> EstimatedPath:
    """The fixed-lag smoother over a recording.

    Its map is that of the smoother over the last ``map_s``, with the noise and the priors that were learnt, moved to
    the frame of the causal path. If these data do not determine all beacons, the map is that of the window.
    """
    found = follow(run, cfg, how, clock_s, lag=lag)
    path = found.path
    steps, readings = run.steps, run.readings
    first = int(np.searchsorted(steps.times_s, steps.times_s[-1] - lag.map_s))
    rows = (np.broadcast_to(row, steps.distance_m.shape)[first:] for row in steps[1:])
    kept = Steps(steps.times_s[first:], *rows)
    # A beacon that is not on the map may lie at its mirror image, and would bend path and map.
    placed = np.isin(readings.beacon, [k for k, name in enumerate(run.beacon_ids) if name in path.beacons])
    recent = replace(run, steps=kept, readings=readings.where(placed & (readings.times_s >= kept.times_s[0])))
    if first:
        x_m, y_m, heading_rad = _poses_at(path, kept.times_s[:1])[0].tolist()
        recent = replace(recent, first_pose=(x_m, y_m, heading_rad))
        heard = Counter(run.beacon_ids[k] for k in recent.readings.beacon.tolist())
        if any(heard[name] < LEAST for name in path.beacons):
            return path
    try:
        whole = smooth(recent, cfg, how, clock_s, found)
    except LinAlgError:
        return path
    if run.known_map is not None:  # the smoother's map is in the frame of the known one
        beacons = {name: fix for name, fix in whole.beacons.items() if name in path.beacons}
        return path._replace(beacons=beacons, map_covariance=_part_of_map(whole, beacons))
    motion = best_motion(_ends(whole.poses), _ends(_poses_at(path, whole.times_s)))
    beacons = {name: fix for name, fix in aligned_beacons(whole, motion).items() if name in path.beacons}
    return path._replace(beacons=beacons, map_covariance=motion.turned_map(_part_of_map(whole, beacons)))


def _part_of_map(track: EstimatedPath, names: Collection[str]) -> FloatArray:
    at = columns_of(*((2 * k, 2 * k + 1) for k, name in enumerate(track.beacons) if name in names))
    return np.asarray(track.map_covariance[np.ix_(at, at)])


def smooth(
    run: RecordedRun, settings: RecordingConfig, how: SlamFilterConfig, clock_s: Callable[[], float],
    found: Followed | None = None,
) -> EstimatedPath:  # fmt: skip
    """Estimate a whole run at once.

    Minimises the negative log posterior of poses at the instants of the readings, beacons and calibration by
    Levenberg-Marquardt. The readings have Student's t, whose width is increased if the residuals are wider. The first
    pose is the only part of the ground truth that is used. ``found``: a causal estimate of the run, if there is one.
    Raises LinAlgError: the normal equations of the result are not positive definite.
    """
    begin_s = clock_s()
    steps_s = run.steps.times_s  # poses are at all readings, and every SPACING_S at a step of the odometry
    readings = run.readings.with_distances(settings.radio.camera_field_rad)
    times_s = np.union1d(readings.times_s, steps_s[first_of_each(steps_s, SPACING_S)])
    found = found or follow(run, settings, how, lambda: 0.0, SPACING_S)
    start, rest = _started(run, found.settings, found, times_s), (how.rest_speed_m_s, how.rest_turn_rad_s)
    removed = {str(name) for name, _ in found.slam.moved}
    places = None
    if run.known_map is not None:
        places = PlacePrior.of_run(run, [name for name in run.beacon_ids if name not in removed])

    def problem_of(settings: RecordingConfig) -> BatchProblem:
        return BatchProblem(
            run.steps, readings, times_s, run.first_pose, settings, start.used, rest, noise=found.noise, places=places,
            raised=run.raised,
        )  # fmt: skip

    fit = _fitted(problem_of, start.state, found, settings.odometry)
    problem, state = fit.problem, fit.state
    counted = problem.sizes > 0
    took_s = clock_s() - begin_s
    weights = t_weights(problem.residuals(state).chi2, problem.sizes, problem.radio.freedom)
    factored = spread_by_priors(fit.factored, problem, settings.priors)
    size = problem.free.size
    covariance = np.zeros((size, size))
    covariance[np.ix_(problem.free, problem.free)] = factored.shared_covariance()
    refused = int((weights[counted] < LITTLE).sum())
    updates = int(counted.sum()) - refused
    beacons, of_map = {}, list[int]()
    for k in np.flatnonzero(start.used).tolist():
        place = slice(len(SHARED) + BEACON * k, len(SHARED) + BEACON * k + 2)
        x_m, y_m = state.beacons[k, :2].tolist()
        beacons[run.beacon_ids[k]] = BeaconFix(x_m, y_m, covariance[place, place])
        of_map += range(place.start, place.stop)
    calibration = _calibration(problem, state, np.sqrt(np.diag(covariance)), run.beacon_ids)
    priors = {name: getattr(problem.priors, name) for name in (*SHARED, HEIGHT_M2)}
    warnings = [*_warnings(run, start, fit.converged), *beyond_priors(calibration, priors, run.kind)]
    for what, name in (("range", "range_sigma_m"), ("bearing", "bearing_sigma_rad"), ("rssi", "rssi_sigma_db")):
        if (ratio := getattr(problem.radio, name) / getattr(settings.radio, name)) > NOISY:
            much = f"{ratio:.1f} times as noisy as assumed"
            warnings.append(f"{what} readings are {much}: beacons exchanged or moved on the way?")
    return EstimatedPath(
        times_s, state.poses, factored.pose_covariances(), beacons, calibration, updates=updates,
        refused=refused, update_s=np.array([took_s / max(updates, 1)]),
        warnings=tuple(warnings), map_covariance=covariance[np.ix_(of_map, of_map)],
    )  # fmt: skip


class _Fit(NamedTuple):
    """The least squares, with the noise that was estimated."""

    problem: BatchProblem
    state: BatchState
    factored: Factored
    converged: bool


def _fitted(
    problem_of: Callable[[RecordingConfig], BatchProblem], state: BatchState, found: Followed,
    configured: OdometryNoiseConfig,
) -> _Fit:  # fmt: skip
    """Solve with the noise that is known, estimate the noise from the residuals, and solve again until it is stable."""
    settings, odometry = found.settings, found.odometry
    problem = problem_of(settings)
    counted = problem.sizes > 0
    off = problem.residuals(state).chi2[counted] / problem.sizes[counted]
    if counted.any() and (softness := float(np.median(off))) > FAR_OFF:
        state, _ = descend(problem, state, ROUGH_ITERATIONS, softness, enough=ROUGHLY)
    state, converged = descend(problem, state, ITERATIONS, enough=WELL_CONVERGED)
    for _ in range(ESTIMATES):
        factored, before = _factored(problem, state), odometry
        odometry = odometry_noise(problem, state, factored, configured, odometry, OdometryNoise())
        radio = _widened(problem, state)
        if radio == problem.radio and np.allclose(before, odometry, rtol=CLOSE, atol=0.0):
            break
        settings = settings.model_copy(update={"radio": radio, "odometry": odometry.of(configured)})
        problem = problem_of(settings)
        state, converged = descend(problem, state, ITERATIONS)
    return _Fit(problem, state, _factored(problem, state), converged)


def _factored(problem: BatchProblem, state: BatchState) -> Factored:
    weights = t_weights(problem.residuals(state).chi2, problem.sizes, problem.radio.freedom)
    return Factored(problem.normal_equations(state, weights * problem.power))


def _widened(problem: BatchProblem, state: BatchState) -> RadioNoiseConfig:
    """Noise of the readings, increased where the weighted residuals are wider.

    The maximum-likelihood scale sigma of Student's t satisfies sum w e^2 / sigma^2 = number of readings.
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


def _calibration(
    problem: BatchProblem, state: BatchState, sigmas: FloatArray, names: Sequence[str]
) -> dict[str, Calibrated]:
    has_ranges, has_bearings, has_levels = (bool(problem.there[:, k].any()) for k in range(3))
    shown = {"range_scale": has_ranges, "range_offset_m": has_ranges, "bearing_offset_rad": has_bearings}
    shown |= {"rssi_reference_db": has_levels, "rssi_exponent": has_levels}
    found = {}
    for k, name in enumerate(SHARED):
        if problem.free[k] and shown.get(name, True):
            found[name] = Calibrated(float(state.shared[k]), float(sigmas[k]))
    for k, name in enumerate(names):
        if problem.free[at := len(SHARED) + BEACON * k + HEIGHT]:
            found[f"{HEIGHT_M2} {name}"] = Calibrated(float(state.beacons[k, HEIGHT]), float(sigmas[at]))
    return found


def _warnings(run: RecordedRun, start: Start, converged: bool) -> Iterator[str]:
    doubts = dict[str, list[str]]()
    for k, name in enumerate(run.beacon_ids):
        seen = run.readings.where(run.readings.beacon == k)
        if not start.used[k] and np.isnan(seen.range_m).all() and np.isnan(seen.rssi_dbm).all():
            why = "could not be placed: bearings alone do not place a beacon, a range or level is needed"
        elif not start.used[k]:
            why = "could not be placed: too few readings, or all from one place"
        elif start.doubtful[k]:
            why = "may lie at the mirror image: the path determines the side too little"
        else:
            continue
        doubts.setdefault(why, []).append(name)
    yield from (f"{counted('beacon', names)} {why}" for why, names in doubts.items())
    if not converged:
        yield f"the smoother stopped after {ITERATIONS} iterations before it had converged"
