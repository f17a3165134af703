"""The cases of the benchmarks: problems drawn from a seed, and this project's and the peers' solutions (contenders).

filterpy and Stone Soup belong to the extra ``peers`` and are imported when a race is set up. Models are built before
the clock starts. The race checks that the peers compute the same as this project.
"""

from collections.abc import Callable, Iterator
from functools import partial
from math import sqrt
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from ccatp.config.models import Config
from ccatp.core import DeckPose, FloatArray
from ccatp.estimation import state_model as sm
from ccatp.estimation.odometry import Terrain, WheelAngle
from ccatp.filters import FILTERS
from ccatp.filters.unscented import ALPHA, BETA, KURTOSIS
from ccatp.mirror.mirror import build_mirror
from ccatp.mirror.multilateration import multilaterate
from ccatp.missions import built_in

STEPS, DT_S, SEED = 50, 0.01, 1
MILDER = 1e4
"""Factor on the variances of the readings of the four states. With the configured noise (encoder: 0.001 rad/s) the
readings are so much more exact than the prediction that forms with an inverse or (I - W H) P lose half their digits,
and results could not be compared."""
_SURVEY_START = (0.3, -0.4, 0.5, 0.05, 0.1)  # on the mirror, driving and turning: X, Y, PSI, V, W
_ANGLE_RAD2, _POSITION_M2, _HEADING_RAD2 = 1e-6, 1e-8, 1e-4  # variances of a wheel's angle, a fix, a heading

Solution = Iterator[Any]
"""A generator that solves a problem reading by reading.

The first ``next`` prepares it and yields a function that returns mean (n,) and covariance (n, n) of a state; neither is
timed. Each further ``next`` processes one reading and yields the state.
"""
Contender = Callable[[], Solution]
"""Returns a new ``Solution`` that begins with the first reading."""


class Race(NamedTuple):
    """A case: ours against each peer; ``note``: why there is no peer; ``is_dense``: the peer is slow: fewer rounds."""

    name: str
    ours: Contender
    peers: dict[str, Contender]
    is_dense: bool = False
    note: str = ""


def races(cfg: Config) -> Iterator[Race]:
    """Steps of filters, the races of the kinds of missions, and multilateration."""
    # kf: the inertial unit, with none, one and ten samples of each wheel. ekf: the models as matrices, but for the last
    # case. In the one before, wheel angles are as exact as the localizer assumes for a rate encoder, as mostly.
    problems = [("kf", thesis_problem(cfg, m), "") for m in (2, 4, 22)]
    problems += [("ekf", linearised_problem(cfg, m), "") for m in (4, 6, 23)]
    problems += [("ekf", linearised_problem(cfg, 4, WheelAngle().variance_rad2()), ", angles to 1e-5 rad")]
    problems += [("ekf", survey_problem(cfg), ", its models evaluated"), ("ukf", survey_problem(cfg), "")]
    for filter_name, problem, detail in problems:
        name = f"{filter_name} predict + update, n = {problem.mean.size}, m = {problem.variances.size}{detail}"
        peers: dict[str, Contender]
        peers = {"eq. 2.13 in numpy": partial(printed_filter, problem)} if filter_name != "ukf" else {}
        if filter_name == "ukf" or isinstance(problem.F, np.ndarray):
            peers |= {"filterpy": partial(filterpy, problem), "Stone Soup": partial(stonesoup, problem)}
        yield Race(name, partial(our_filter, filter_name, problem), peers)
    for kind in built_in():
        if kind.races is not None:
            own: Callable[[], Iterator[Race]] = kind.races.get()
            yield from own()
    ranges = range_problem(cfg)
    peers = {"scipy.optimize.least_squares": partial(scipy_position, ranges)}
    yield Race(f"multilaterate, {ranges.anchors_m.shape[0]} lengths", partial(our_position, ranges), peers)


# -- filters ----------------------------------------------------------------------------------------------------------


class FilterProblem(NamedTuple):
    """A prior, models and readings: one prediction and one update per reading."""

    mean: FloatArray  # shape (n,)
    covariance: FloatArray  # shape (n, n)
    F: Any  # matrix (n, n), or a nonlinear model
    H: Any  # matrix (m, n), or a nonlinear model
    Q: FloatArray  # process noise of a step, shape (n, n)
    variances: FloatArray  # of the independent rows, shape (m,)
    readings: FloatArray  # shape (k, m)


def thesis_problem(cfg: Config, rows: int) -> FilterProblem:
    """Thesis eqs 2.11 and 2.12: n = 4; ``rows`` = 2 k + 2 for k samples of each wheel."""
    robot, noise, k = cfg.robot, cfg.localizer, (rows - 2) // 2
    H = np.zeros((rows, 4))
    H[: 2 * k, 0] = 1.0 / robot.wheel_radius_m
    H[: 2 * k, 3] = np.repeat((0.5, -0.5), k) * robot.wheel_base_m / robot.wheel_radius_m
    H[2 * k, 1] = H[2 * k + 1, 3] = 1.0
    sigma = np.full(rows, noise.encoder_sigma_rad_s)
    sigma[2 * k :] = noise.accelerometer_sigma_m_s2, noise.gyroscope_sigma_rad_s
    F = np.eye(4)
    F[0, 1] = F[2, 3] = DT_S
    four = noise.four_state
    impulse = np.array([0.0, four.jerk_density_m2_s5, 0.0, four.angular_acceleration_density_rad2_s3]) * DT_S
    mean, covariance = np.array([0.05, 0.0, 0.2, 0.1]), np.diag([1e-4, 1e-2, 1e-4, 1e-2])
    return linear_problem(mean, covariance, F, H, F @ np.diag(impulse) @ F.T, MILDER * sigma**2)


def linear_problem(
    mean: FloatArray, covariance: FloatArray, F: FloatArray, H: FloatArray, Q: FloatArray, variances: FloatArray
) -> FilterProblem:
    """A linear problem with readings drawn from its own model."""
    rng = np.random.default_rng((SEED, *H.shape))
    x, readings = rng.multivariate_normal(mean, covariance), np.empty((STEPS, len(H)))
    for i in range(STEPS):
        x = F @ x + rng.multivariate_normal(np.zeros(len(F)), Q, method="svd")
        readings[i] = H @ x + np.sqrt(variances) * rng.normal(size=len(H))
    return FilterProblem(mean, covariance, F, H, Q, variances, readings)


def survey_problem(cfg: Config, angle_rad2: float = _ANGLE_RAD2) -> FilterProblem:
    """The full-state localizer's problem with its models: n = 20; readings: both wheel angles, rate, acceleration.

    ``angle_rad2``: variance of a reading of a wheel angle.
    """
    rng = np.random.default_rng((SEED, sm.STATES))
    robot, full = cfg.robot, cfg.localizer.full_state
    mean, sigma = np.zeros(sm.STATES), np.zeros(sm.STATES)
    mean[[sm.X, sm.Y, sm.PSI, sm.V, sm.W]] = _SURVEY_START
    sigma[[sm.X, sm.Y]] = cfg.localizer.start_position_sigma_m
    sigma[sm.PSI] = cfg.localizer.start_heading_sigma_rad
    sigma[[sm.V, sm.A, sm.W]] = 0.01, 0.05, 0.02
    sigma[sm.BG], sigma[sm.KG] = full.gyroscope_bias_sigma_rad_s, full.gyroscope_scale_sigma
    sigma[sm.BA], sigma[sm.KL] = full.accelerometer_bias_sigma_m_s2, full.wheel_base_sigma
    sigma[[sm.SR, sm.SL]], sigma[sm.C], sigma[[sm.E0, sm.E1]] = full.slip_sigma, full.creep_sigma, full.edge_sigma_m
    sigma[sm.CT] = full.turn_creep_sigma_m_rad
    sigma[[sm.PR, sm.PL]], sigma[[sm.TX, sm.TY]] = sqrt(_ANGLE_RAD2), robot.puck_height_m * full.panel_tilt_sigma_rad
    slope = Terrain(build_mirror(cfg.mirror)).at(float(mean[sm.X]), float(mean[sm.Y]))
    motion = sm.SurveyMotion(robot.wheel_radius_m, robot.wheel_base_m).over(DT_S, slope)
    slip = (full.slip_scatter_max * DT_S) ** 2
    impulses = np.array(
        (full.jerk_density_m2_s5 * DT_S, full.angular_acceleration_density_rad2_s3 * DT_S, *[slip] * 3, 1e-9)
    )
    drift = np.zeros(sm.STATES)
    drift[[sm.PR, sm.PL]] = cfg.localizer.encoder_sigma_rad_s**2 * full.encoder_period_s * DT_S
    Q = motion.noise(mean, impulses, drift)
    gyroscope, accelerometer = cfg.localizer.gyroscope_sigma_rad_s**2, cfg.localizer.accelerometer_sigma_m_s2**2
    variances = {sm.W: gyroscope, sm.PR: angle_rad2, sm.PL: angle_rad2, sm.A: accelerometer}
    sight = sm.SensorRows([(state, 0.0, variance) for state, variance in variances.items()])
    x, readings = mean + 0.5 * sigma * rng.normal(size=sm.STATES), np.empty((STEPS, sight.R.size))
    for i in range(STEPS):
        x = motion.at(x)[0] + rng.multivariate_normal(np.zeros(sm.STATES), Q, method="svd")
        readings[i] = sight.at(x)[0] + np.sqrt(sight.R) * rng.normal(size=sight.R.size)
    return FilterProblem(mean, np.diag(sigma**2), motion, sight, Q, sight.R, readings)


def linearised_problem(cfg: Config, rows: int, angle_rad2: float = _ANGLE_RAD2) -> FilterProblem:
    """``survey_problem`` with its initial Jacobians as matrices, so that the filter is timed without the models.

    Rows: the four sensors (4); with a fix of both coordinates (6); with ten samples of each wheel and a heading (23).
    """
    problem = survey_problem(cfg, angle_rad2)
    F, sensors = problem.F.at(problem.mean)[1].copy(), problem.H.at(problem.mean)[1].copy()
    fix, heading = np.eye(sm.STATES)[[sm.X, sm.Y]], np.eye(sm.STATES)[[sm.PSI]]
    H, variances = {
        4: (sensors, problem.variances),
        6: (np.vstack([sensors, fix]), np.append(problem.variances, [_POSITION_M2] * 2)),
        23: (
            np.vstack([np.repeat(sensors[1:3], 10, axis=0), sensors[[0, 3]], heading]),
            np.concatenate([np.full(20, _ANGLE_RAD2), problem.variances[[0, 3]], [_HEADING_RAD2]]),
        ),
    }[rows]
    return linear_problem(problem.mean, problem.covariance, F, H, problem.Q, variances)


def our_filter(name: str, problem: FilterProblem) -> Solution:
    """A filter of ``FILTERS``."""
    mean, covariance, F, H, Q, R, readings = problem
    ours = FILTERS[name](mean, covariance)
    yield attrgetter("mean", "covariance")
    for z in readings:
        ours.predict(F, Q)
        ours.update(z, H, R)
        yield ours


def printed_filter(problem: FilterProblem) -> Solution:
    """Thesis eq. 2.13 as printed, with an inverse and (I - W H) P, in numpy without checks."""
    x, P, motion, sight, Q, variances, readings = problem
    R, identity = np.diag(variances), np.eye(x.size)
    yield tuple
    for z in readings:
        x, F = _linearised(motion, x)
        P = F @ P @ F.T + Q
        h, H = _linearised(sight, x)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x = x + K @ (z - h)
        P = (identity - K @ H) @ P
        yield x, P


def _linearised(model: Any, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Image of x (n,) and the Jacobian, of a matrix or of a nonlinear model."""
    return (model @ x, model) if isinstance(model, np.ndarray) else model.at(x)


def _sigma_points(problem: FilterProblem) -> dict[str, float]:
    """Parameters of our sigma points, by the names that both peers use."""
    return {"alpha": ALPHA, "beta": BETA, "kappa": max(KURTOSIS - problem.mean.size, 0.0)}


def filterpy(problem: FilterProblem) -> Solution:
    """Filterpy's Kalman filter for matrices, its unscented filter with Merwe's scaled points for models."""
    from filterpy.kalman import KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter  # noqa: PLC0415 - an extra

    mean, covariance, F, H, Q, variances, readings = problem
    shape: tuple[int, ...] = (-1,)
    if isinstance(F, np.ndarray):
        peer, shape = KalmanFilter(dim_x=mean.size, dim_z=variances.size), (-1, 1)
        peer.F, peer.H = F, H
    else:
        points = MerweScaledSigmaPoints(mean.size, **_sigma_points(problem))
        peer = UnscentedKalmanFilter(
            mean.size, variances.size, DT_S, points=points,
            hx=lambda x: H.through(x[None])[0], fx=lambda x, _dt: F.through(x[None])[0],
        )  # fmt: skip
    peer.x, peer.P, peer.Q, peer.R = mean.reshape(shape).copy(), covariance.copy(), Q, np.diag(variances)
    columns = [reading.reshape(shape) for reading in readings]
    yield attrgetter("x", "P")
    for column in columns:
        peer.predict()
        peer.update(column)
        yield peer


def stonesoup(problem: FilterProblem) -> Solution:
    """Predictor and updater of Stone Soup: Kalman's for matrices, the unscented ones for models."""
    import stonesoup.predictor.kalman as predictors  # noqa: PLC0415 - belongs to an extra
    import stonesoup.updater.kalman as updaters  # noqa: PLC0415
    from stonesoup.types.detection import Detection  # noqa: PLC0415
    from stonesoup.types.hypothesis import SingleHypothesis  # noqa: PLC0415
    from stonesoup.types.state import GaussianState  # noqa: PLC0415

    is_linear = isinstance(problem.F, np.ndarray)
    kind, points = ("Kalman", {}) if is_linear else ("UnscentedKalman", _sigma_points(problem))
    transition, measurement = _stonesoup_models(problem, is_linear=is_linear)
    predictor = getattr(predictors, kind + "Predictor")(transition, **points)
    updater = getattr(updaters, kind + "Updater")(measurement, **points)
    detections = [Detection(reading[:, None]) for reading in problem.readings]
    estimate: Any = GaussianState(problem.mean[:, None].copy(), problem.covariance.copy())
    yield attrgetter("state_vector", "covar")
    for detection in detections:
        estimate = updater.update(SingleHypothesis(predictor.predict(estimate), detection))
        yield estimate


def _stonesoup_models(problem: FilterProblem, *, is_linear: bool) -> tuple[Any, Any]:
    """Motion and measurement model for Stone Soup."""
    from stonesoup.models.base import TimeInvariantModel  # noqa: PLC0415 - belongs to an extra
    from stonesoup.models.measurement.linear import LinearGaussian  # noqa: PLC0415
    from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement  # noqa: PLC0415
    from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel  # noqa: PLC0415
    from stonesoup.models.transition.nonlinear import GaussianTransitionModel  # noqa: PLC0415
    from stonesoup.types.array import StateVectors  # noqa: PLC0415

    n = problem.mean.size
    about = {"ndim_state": n, "mapping": tuple(range(n)), "noise_covar": np.diag(problem.variances)}

    def mapped(model: Any, state: Any) -> Any:
        return StateVectors(model.through(np.asarray(state.state_vector, dtype=np.float64).T).T)

    class Rows(LinearGaussian):  # type: ignore[misc] # Stone Soup has no types
        ndim_meas = problem.variances.size

        def matrix(self, **_: object) -> Any:
            return problem.H

    class Motion(GaussianTransitionModel, TimeInvariantModel):  # type: ignore[misc]
        ndim_state = n

        def covar(self, **_: object) -> FloatArray:
            return problem.Q

        def function(self, state: Any, noise: object = False, **_: object) -> Any:
            return mapped(problem.F, state)

    class Sight(NonLinearGaussianMeasurement):  # type: ignore[misc]
        ndim_meas = problem.variances.size

        def function(self, state: Any, noise: object = False, **_: object) -> Any:
            return mapped(problem.H, state)

    if not is_linear:
        return Motion(), Sight(**about)
    motion = LinearGaussianTimeInvariantTransitionModel(transition_matrix=problem.F, covariance_matrix=problem.Q)
    return motion, Rows(**about)


# -- a puck's position from its lengths -------------------------------------------------------------------------------


class RangeProblem(NamedTuple):
    """Anchors (m, 3); lengths of k pucks and their sigmas (k, m); expected positions (k, 3); all in metres."""

    anchors_m: FloatArray
    ranges_m: FloatArray
    sigmas_m: FloatArray
    expected_m: FloatArray


def range_problem(cfg: Config) -> RangeProblem:
    """Pucks at the first stops of the mirror, with expected positions that are some millimetres off."""
    rng = np.random.default_rng((SEED, 3))
    mirror = build_mirror(cfg.mirror)
    anchors = 1e-3 * np.array(cfg.mirror.collimators.positions_world_mm)
    points = [point for panel in sorted(mirror.panels) for point in mirror.point_ids(panel)][:STEPS]
    poses = [DeckPose(*mirror.point_on_deck(point), 0.0) for point in points]
    pucks = np.array([mirror.puck_world(pose, cfg.robot.puck_height_m) for pose in poses])
    true_m = np.linalg.norm(pucks[:, None, :] - anchors[None, :, :], axis=2)
    sigmas = cfg.etalon.length_sigma_m + cfg.etalon.length_sigma_per_m * true_m
    ranges = true_m + sigmas * rng.normal(size=true_m.shape)
    return RangeProblem(anchors, ranges, sigmas, pucks + 2e-3 * rng.normal(size=pucks.shape))


def our_position(problem: RangeProblem) -> Solution:
    """``multilaterate``."""
    anchors_m, *pucks = problem
    yield attrgetter("position_m", "covariance_m2")
    for ranges, sigmas, expected_m in zip(*pucks, strict=True):
        yield multilaterate(anchors_m, ranges, sigmas, expected_m)


def scipy_position(problem: RangeProblem) -> Solution:
    """The same weighted least squares by SciPy's Levenberg-Marquardt, and the covariance from its Jacobian."""
    anchors_m, *pucks = problem
    tolerance = sqrt(np.finfo(np.float64).eps)  # sufficient: with quadratic convergence the next error is its square

    def residuals(x: FloatArray, ranges: FloatArray, sigmas: FloatArray) -> FloatArray:
        offsets = x - anchors_m
        seen: FloatArray = (np.sqrt((offsets * offsets).sum(axis=1)) - ranges) / sigmas
        return seen

    def jacobian(x: FloatArray, _: FloatArray, sigmas: FloatArray) -> FloatArray:
        offsets = x - anchors_m
        slopes: FloatArray = offsets / (np.sqrt((offsets * offsets).sum(axis=1)) * sigmas)[:, None]
        return slopes

    yield tuple
    for ranges, sigmas, expected_m in zip(*pucks, strict=True):
        found = least_squares(
            residuals, expected_m, jac=jacobian, method="lm", args=(ranges, sigmas),
            xtol=tolerance, ftol=tolerance, gtol=tolerance,
        )  # fmt: skip
        slopes = np.asarray(found.jac, dtype=np.float64)
        yield found.x, np.linalg.inv(slopes.T @ slopes)
