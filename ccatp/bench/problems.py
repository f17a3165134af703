"""What the contenders are given to solve: drawn from a seed, the same for all of them."""

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np

from ccatp.bench.pose_model import STATES, PoseMotion, PoseSight
from ccatp.config.models import Config, LocalizerConfig, RobotConfig
from ccatp.core import DeckPose, FloatArray
from ccatp.estimation.state_model import (
    BA,
    BG,
    E0,
    E1,
    KG,
    KL,
    PL,
    PR,
    PSI,
    SL,
    SR,
    TX,
    TY,
    A,
    C,
    SensorRows,
    SurveyMotion,
    Terrain,
    V,
    W,
    X,
    Y,
)
from ccatp.estimation.state_model import STATES as SURVEY_STATES
from ccatp.filters.base import Observation, Transition
from ccatp.mirror.mirror import build_mirror

STEPS = 50
DT_S = 0.01
MILDER = 1e4
LINEAR_ROWS = (2, 4, 22)  # gyroscope and accelerometer; and one sample of each wheel; and ten of each wheel
POSE_ROWS = {1: (6,), 4: (0, 1, 2, 3), 8: tuple(range(8))}  # a seam line; inertial unit and wheels; all of them
_SIGMA_LINE_M, _SIGMA_HEADING_RAD, _LINE_RAD = 2e-4, 0.035, 0.3
_POSE_SIGMA = (2e-3, 2e-3, 0.01, 0.01, 0.05, 0.02, 0.0175, 0.3, 0.02, 0.02, 0.02, 0.02)
_POSE_NOISE = (0.0, 0.0, 0.0, 1e-4, 0.05, 0.05, 3e-6, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4)  # standard deviations of a step
_SURVEY_START = (0.3, -0.4, 0.5, 0.05, 0.1)  # on the mirror, under way and turning
_ANGLE_RAD2 = 1e-6  # variance of a wheel's angle
_POSE_START = (0.1, -0.2, 0.5, 0.08, 0.0, 0.1, 0.01, -0.1, 0.02, 0.03, 0.01, -0.01)


@dataclass(frozen=True, slots=True)
class FilterProblem:
    """A tracking problem: predict and update with each reading.

    Attributes:
        mean, covariance: prior, shapes (n,) and (n, n).
        Q: process noise of a step, shape (n, n).
        variances: of the independent rows, shape (m,).
        readings: shape (k, m).
        F, H: the linear models, shapes (n, n) and (m, n); None where they are nonlinear.
        motion, sight: the nonlinear models; None where they are linear.
    """

    mean: FloatArray
    covariance: FloatArray
    Q: FloatArray
    variances: FloatArray
    readings: FloatArray
    F: FloatArray | None = None
    H: FloatArray | None = None
    motion: Transition | None = None
    sight: Observation | None = None


@dataclass(frozen=True, slots=True)
class RangeProblem:
    """A puck seen from the collimators.

    Attributes:
        anchors_m: shape (m, 3).
        ranges_m: one row for each puck, shape (k, m).
        sigmas_m: shape (k, m).
        expected_m: where each puck is looked for, shape (k, 3).
    """

    anchors_m: FloatArray
    ranges_m: FloatArray
    sigmas_m: FloatArray
    expected_m: FloatArray


def models(problem: FilterProblem) -> tuple[Transition, Observation]:
    """The nonlinear models of a problem.

    Raises:
        ValueError: its models are linear.
    """
    if problem.motion is None or problem.sight is None:
        raise ValueError(f"a problem of n = {problem.mean.size} with linear models has no nonlinear ones")
    return problem.motion, problem.sight


def mild(problem: FilterProblem) -> FilterProblem:
    """The same with readings a hundred times less exact.

    An encoder's sigma of 0.001 rad/s against what a frame leaves unknown makes H P H^T + R so badly conditioned that
    forms with an inverse and (I - W H) P lose half their digits: a difference there may be rounding. Here it would be a
    mistake.
    """
    return replace(problem, variances=MILDER * problem.variances)


def linear_problem(robot: RobotConfig, cfg: LocalizerConfig, rows: int, seed: int) -> FilterProblem:
    """The localizer's problem of thesis eqs 2.11 and 2.12: n = 4, ``rows`` = 2 k + 2 with k samples of each wheel."""
    rng = np.random.default_rng((seed, rows))
    k = (rows - 2) // 2
    per_radius, turn = 1.0 / robot.wheel_radius_m, 0.5 * robot.wheel_base_m / robot.wheel_radius_m
    H = np.zeros((rows, 4))
    H[: 2 * k, 0] = per_radius
    H[:k, 3], H[k : 2 * k, 3] = turn, -turn
    H[2 * k, 1] = H[2 * k + 1, 3] = 1.0
    sigma = np.full(rows, cfg.encoder_sigma_rad_s)
    sigma[2 * k :] = cfg.accelerometer_sigma_m_s2, cfg.gyroscope_sigma_rad_s
    F = np.eye(4)
    F[0, 1] = F[2, 3] = DT_S
    impulse = np.array([0.0, cfg.jerk_density_m2_s5, 0.0, cfg.angular_acceleration_density_rad2_s3]) * DT_S
    Q = F @ np.diag(impulse) @ F.T
    mean, covariance = np.array([0.05, 0.0, 0.2, 0.1]), np.diag([1e-4, 1e-2, 1e-4, 1e-2])
    x = rng.multivariate_normal(mean, covariance)
    readings = np.empty((STEPS, rows))
    for i in range(STEPS):
        x = F @ (x + np.sqrt(impulse) * rng.normal(size=4))
        readings[i] = H @ x + sigma * rng.normal(size=rows)
    return FilterProblem(mean, covariance, Q, sigma**2, readings, F=F, H=H)


def pose_problem(robot: RobotConfig, cfg: LocalizerConfig, rows: int, seed: int) -> FilterProblem:
    """A pose with biases, scale errors and drift: n = 12, ``rows`` out of ``POSE_ROWS``."""
    rng = np.random.default_rng((seed, STATES, rows))
    wheel = [cfg.encoder_sigma_rad_s] * 4
    every = np.array(
        [cfg.gyroscope_sigma_rad_s, cfg.accelerometer_sigma_m_s2, *wheel, _SIGMA_LINE_M, _SIGMA_HEADING_RAD]
    )
    sigma = every[list(POSE_ROWS[rows])]
    motion = PoseMotion(DT_S)
    sight = PoseSight(POSE_ROWS[rows], robot.wheel_radius_m, robot.wheel_base_m, _LINE_RAD)
    noise, mean = np.array(_POSE_NOISE), np.array(_POSE_START)
    x = mean + 0.5 * np.array(_POSE_SIGMA) * rng.normal(size=STATES)
    readings = np.empty((STEPS, rows))
    for i in range(STEPS):
        x = motion.value(x) + noise * rng.normal(size=STATES)
        readings[i] = sight.value(x) + sigma * rng.normal(size=rows)
    covariance = np.diag(np.square(_POSE_SIGMA))
    return FilterProblem(mean, covariance, np.diag(noise**2), sigma**2, readings, motion=motion, sight=sight)


def survey_problem(cfg: Config, seed: int) -> FilterProblem:
    """The full-state localizer's problem with its own models: n = 19, both wheels' angles, rate and acceleration."""
    rng = np.random.default_rng((seed, SURVEY_STATES))
    robot, full = cfg.robot, cfg.localizer.full_state
    mean, sigma = np.zeros(SURVEY_STATES), np.zeros(SURVEY_STATES)
    mean[[X, Y, PSI, V, W]] = _SURVEY_START
    sigma[[X, Y]], sigma[PSI] = cfg.localizer.start_position_sigma_m, cfg.localizer.start_heading_sigma_rad
    sigma[[V, A, W]] = 0.01, 0.05, 0.02
    sigma[BG], sigma[KG] = full.gyroscope_bias_sigma_rad_s, full.gyroscope_scale_sigma
    sigma[BA], sigma[KL] = full.accelerometer_bias_sigma_m_s2, full.wheel_base_sigma
    sigma[[SR, SL]], sigma[C], sigma[[E0, E1]] = full.slip_sigma, full.creep_sigma, full.edge_sigma_m
    sigma[[PR, PL]], sigma[[TX, TY]] = sqrt(_ANGLE_RAD2), robot.puck_height_m * full.panel_tilt_sigma_rad
    x = mean + 0.5 * sigma * rng.normal(size=SURVEY_STATES)
    slope = Terrain(build_mirror(cfg.mirror)).at(float(mean[X]), float(mean[Y]))
    motion = SurveyMotion(robot.wheel_radius_m, robot.wheel_base_m).over(DT_S, slope)
    slip = (full.slip_scatter_max * DT_S) ** 2
    impulses = np.array(
        (full.jerk_density_m2_s5 * DT_S, full.angular_acceleration_density_rad2_s3 * DT_S, slip, slip, slip)
    )
    drift = np.zeros(SURVEY_STATES)
    drift[[PR, PL]] = cfg.localizer.encoder_sigma_rad_s**2 * full.encoder_period_s * DT_S
    Q = motion.noise(mean, impulses, drift)
    gyroscope, accelerometer = cfg.localizer.gyroscope_sigma_rad_s**2, cfg.localizer.accelerometer_sigma_m_s2**2
    sight = SensorRows().take((0.0, 0.0, _ANGLE_RAD2), (0.0, gyroscope), (0.0, accelerometer))
    variances, readings = sight.R, np.empty((STEPS, sight.R.size))
    for i in range(STEPS):
        x = x.copy()
        x[[A, W, SR, SL, C]] += np.sqrt(impulses) * rng.normal(size=impulses.size)
        x = motion.at(x)[0] + np.sqrt(drift) * rng.normal(size=drift.size)
        readings[i] = sight.at(x)[0] + np.sqrt(variances) * rng.normal(size=variances.size)
    return FilterProblem(mean, np.diag(sigma**2), Q, variances, readings, motion=motion, sight=sight)


def range_problem(cfg: Config, seed: int) -> RangeProblem:
    """Pucks at the first stops of the mirror, looked for some millimetres off."""
    rng = np.random.default_rng((seed, 3))
    mirror = build_mirror(cfg.mirror)
    anchors = 1e-3 * np.array(cfg.mirror.collimators.positions_world_mm)
    points = [point for panel in sorted(mirror.panels) for point in mirror.point_ids(panel)][:STEPS]
    poses = [DeckPose(*mirror.point_on_deck(point), 0.0) for point in points]
    pucks = np.array([mirror.puck_world(pose, cfg.robot.puck_height_m) for pose in poses])
    true_m = np.linalg.norm(pucks[:, None, :] - anchors[None, :, :], axis=2)
    sigmas = cfg.etalon.length_sigma_m + cfg.etalon.length_sigma_per_m * true_m
    ranges = true_m + sigmas * rng.normal(size=true_m.shape)
    return RangeProblem(anchors, ranges, sigmas, pucks + 2e-3 * rng.normal(size=pucks.shape))
