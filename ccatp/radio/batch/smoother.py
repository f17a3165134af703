"""Pure. The smoother of recorded runs: path, beacons and calibration that fit all odometry and all readings best."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ccatp.filters.base import FloatArray
from ccatp.radio.batch.arrow import Factored
from ccatp.radio.batch.descent import Descent, descend, t_weights
from ccatp.radio.batch.growing import Start, grown
from ccatp.radio.batch.problem import BEACON, SHARED, BatchProblem, State
from ccatp.radio.batch.reckoning import CALIBRATION, carried_on
from ccatp.radio.batch.settings import BatchSettings, RadioNoise
from ccatp.radio.calibration_doubts import beyond_priors
from ccatp.radio.recording import RecordedRun
from ccatp.radio.track import BeaconFix, Calibrated, Track

SPACING_S = 0.5
"""There is a pose at least that often, whether something was heard or not."""
ITERATIONS = 40
WIDENINGS = 8
WIDER = 1.05
"""Noise is widened where the residuals are larger than it by that factor."""
NOISY = 4.0
"""How many times the noise may have been widened without being told."""
LITTLE = 0.1
"""A reading that weighs less counts as refused."""
CORRECTING = ("distance_scale", "turn_scale")
"""Unknowns that multiply the odometry; what is told is what it reads too much, as the filter does."""
TOLD_AS = {"delay_s": "odometry_delay_s"}


def smooth(run: RecordedRun, settings: BatchSettings, clock_s: Callable[[], float]) -> Track:
    """Estimate a whole run at once.

    Minimises the negative log posterior of poses at the instants of the readings, beacons and calibration by
    Levenberg-Marquardt; noise of the readings by Student's t; its width grows if the residuals are wider. Nothing of
    the truth is used but the first pose.

    Args:
        run: odometry, readings, first pose.
        settings: noise and priors.
        clock_s: tells wall time, s.
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


def _anchored(state: State, first_pose: tuple[float, float, float]) -> State:
    """The state moved as a whole, so that it begins at the first pose: nothing but the prior of that is another."""
    x_m, y_m, heading_rad = state.poses[0].tolist()
    turn = first_pose[2] - heading_rad
    c, s = np.cos(turn), np.sin(turn)

    def moved(points: FloatArray) -> FloatArray:
        dx, dy = points[:, 0] - x_m, points[:, 1] - y_m
        return np.column_stack([first_pose[0] + c * dx - s * dy, first_pose[1] + s * dx + c * dy])

    poses = np.column_stack([moved(state.poses), state.poses[:, 2] + turn])
    return State(poses, state.shared, np.column_stack([moved(state.beacons), state.beacons[:, 2:]]))


def _filled(problem: BatchProblem, state: State, known: npt.NDArray[np.int64]) -> State:
    """The state with a pose at each instant of the problem: those between the known ones by odometry."""
    motion = problem.reckoning.increments(state.shared[: len(CALIBRATION)], problem.odometry).motion
    poses = np.empty((len(motion) + 1, 3))
    poses[known] = state.poses
    is_known = np.zeros(len(poses), dtype=bool)
    is_known[known] = True
    for k in np.flatnonzero(~is_known).tolist():
        poses[k] = carried_on(poses[k - 1], motion[k - 1])
    return State(poses, state.shared, state.beacons)


def _widened(problem: BatchProblem, state: State) -> RadioNoise:
    """Noise of the readings, wider where the weighted residuals ask for it.

    The maximum-likelihood scale of Student's t is that of sum w e^2 / sigma^2 = number of readings.
    """
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
) -> Track:
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
    return Track(
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


def _beacons(run: RecordedRun, state: State, start: Start, covariance: FloatArray) -> dict[str, BeaconFix]:
    found = {}
    for k, name in enumerate(run.beacon_ids):
        if start.used[k]:
            place = slice(len(SHARED) + BEACON * k, len(SHARED) + BEACON * k + 2)
            x_m, y_m = state.beacons[k, :2].tolist()
            found[name] = BeaconFix(x_m, y_m, covariance[place, place])
    return found


def _calibration(problem: BatchProblem, state: State, covariance: FloatArray) -> dict[str, Calibrated]:
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
    """What the odometry reads too much, e with d = d_o / (1 + e), of a correction s with d = (1 + s) d_o."""
    scale = 1.0 + correction.value
    return Calibrated(1.0 / scale - 1.0, correction.sigma / scale**2)


def _noisy(radio: RadioNoise, first: RadioNoise) -> Iterator[str]:
    """Noise that had to be widened beyond what is told of such radios."""
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
