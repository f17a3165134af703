"""Pure but for reading the shipped configuration. The full-state filter knows how wrong it is.

Robots are drawn from the filter's own model: state before the first step, impulses, drifts, readings, fixes. The
model's formulas are written out once more, so that a filter that is consistent with a wrong model of its own is not.
"""

from functools import cache
from math import atan2, cos, hypot, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2

from ccatp.beacons.estimation.beacon_slam import BeaconSlam, recorded_slam
from ccatp.beacons.estimation.motion import Increment
from ccatp.beacons.estimation.recording import Reading
from ccatp.config.models import LocalizerConfig
from ccatp.core import FloatArray, PanelId, PanelPose
from ccatp.estimation.odometry import PreintegratedMotion, WheelAngle
from ccatp.estimation.slip_prior import SlipPrior
from ccatp.estimation.state_filter import SurveyFilter
from ccatp.estimation.state_model import BA, BG, CT, KG, KL, PL, PR, PSI, SL, SR, STATES, A, C, V, W, X, Y
from ccatp.filters import FILTERS
from ccatp.filters.base import Filter
from ccatp.kinematics import wrap_pi
from ccatp.mirror.mirror import Mirror
from tests.support.cases import slow_case
from tests.support.scenario import transport_rad
from tests.support.slam_settings import odometry, settings, trust
from tests.unit.estimation.drive import config, mirror

SEEDS, STEPS, DT_S = 200, 50, 0.04
FIX_STEPS, FIX_SIGMA_M = (20, 35, 50), 2e-5
LOOKS = (10, 20, 21, 35, 50)  # steps after which the errors are looked at, after the fix where there is one
QUANTUM_RAD = 2.0 * np.pi / 1200.0
SAMPLES = 4  # of the inertial unit in a block
START = PanelPose(PanelId(3, 7), 0.0, 0.0, 0.4)
POSE = [X, Y, PSI]
KNOWN = [X, Y, PSI, V, A, W, BG, KG, BA, SR, SL, KL, C, CT]  # nothing but an offset to the encoders in the others
# 5 looks at two sets of states and two sums of innovations: the band of each is that of 95 % for all twelve together.
ALPHA = 0.05 / 12.0


@cache
def cfg() -> LocalizerConfig:
    """As shipped, but a drive that the wheels can do: the shipped densities are those of a controller at work."""
    shipped = config().localizer
    full = shipped.full_state.model_copy(
        update={"jerk_density_m2_s5": 1e-4, "angular_acceleration_density_rad2_s3": 0.05}
    )
    return shipped.model_copy(update={"full_state": full, "reset_rate_sigma_rad_s": 0.1})


def moved(m: Mirror, x: FloatArray) -> FloatArray:
    """Thesis eqs 2.11 and 2.14 on the surface at the step's beginning, its axes and gravity from the mirror."""
    robot, out = config().robot, x.copy()
    out[V] = x[V] + x[A] * DT_S
    d, turn = out[V] * DT_S, x[W] * DT_S
    (e1x, _, _), (e2x, e2y, _), n = m.surface.axes(float(x[X]), float(x[Y]))
    middle = float(x[PSI]) + 0.5 * float(turn)
    g = np.array(m.rotate_deck_from_world((0.0, 0.0, 1.0)))
    g = g - (g @ np.array(n)) * np.array(n)
    g /= sqrt(g @ g)
    down = x[C] * abs(d) + x[CT] * abs(turn)
    dx = d * (cos(middle) * e1x + sin(middle) * e2x) + down * g[0]
    dy = d * sin(middle) * e2y + down * g[1]
    out[X], out[Y] = x[X] + dx, x[Y] + dy
    out[PSI] = x[PSI] + turn + transport_rad(m, float(x[X]), float(x[Y]), float(dx), float(dy))
    side = turn * (1.0 + x[KL]) * 0.5 * robot.wheel_base_m
    out[PR] = x[PR] + (d + side) / (robot.wheel_radius_m * (1.0 - x[SR]))
    out[PL] = x[PL] + (d - side) / (robot.wheel_radius_m * (1.0 - x[SL]))
    return out


class Run(NamedTuple):
    """Of one robot: normalised errors of the pose and of the state at the looks, of the innovations at the fixes."""

    pose: list[float]
    state: list[float]
    nis: list[float]


def nees(x: FloatArray, filter_: Filter, which: list[int]) -> float:
    error = (x - filter_.mean)[which]
    return float(error @ np.linalg.solve(filter_.covariance[np.ix_(which, which)], error))


@cache
def run(name: str, seed: int) -> Run:
    rng, m, full = np.random.default_rng(seed), mirror(), cfg().full_state
    inner = FILTERS[name](np.zeros(STATES), np.eye(STATES))
    found = SurveyFilter(inner, m, config().model_copy(update={"localizer": cfg()}), {}, m.deck_pose(START))
    mean, P = inner.mean.copy(), inner.covariance.copy()
    mean[V] = 0.1
    inner.reset(mean, P)
    x = mean + np.linalg.cholesky(P + 1e-24 * np.eye(STATES)) @ rng.normal(size=STATES)
    right, left = WheelAngle(), WheelAngle()
    for wheel in (right, left):
        wheel.is_counter, wheel.quantum_rad, wheel.is_fresh, wheel.noise_rad2_s2 = True, QUANTUM_RAD, True, 0.0
    slip, creep, turn_creep = (full.wander_fraction**2 / full.wander_time_s * DT_S * v for v in scatters())
    impulses = np.array(
        (
            full.jerk_density_m2_s5 * DT_S,
            full.angular_acceleration_density_rad2_s3 * DT_S,
            slip,
            slip,
            creep,
            turn_creep,
        )
    )
    gyro, accelerometer = cfg().gyroscope_sigma_rad_s ** 2, cfg().accelerometer_sigma_m_s2 ** 2
    result = Run([], [], [])
    for k in range(1, STEPS + 1):
        x[[A, W, SR, SL, C, CT]] += np.sqrt(impulses) * rng.normal(size=6)
        x = moved(m, x)
        creep, root_turned = float(inner.mean[CT]), sqrt(abs(float(inner.mean[W])) * DT_S)
        x[:2] += full.turn_creep_aside * creep * root_turned * rng.normal(size=2)
        lost_rad = full.turn_loss_per_creep * hypot(creep, sqrt(inner.covariance[CT, CT])) * root_turned
        x[[PR, PL]] += 0.5 * config().robot.wheel_base_m / config().robot.wheel_radius_m * lost_rad * rng.normal(size=2)
        x[BG] += full.gyroscope_bias_walk_rad_s_sqrt_s * sqrt(DT_S) * rng.normal()
        x[BA] += full.accelerometer_bias_walk_m_s2_sqrt_s * sqrt(DT_S) * rng.normal()
        right.angle_rad, left.angle_rad = (x[[PR, PL]] + QUANTUM_RAD / sqrt(12.0) * rng.normal(size=2)).tolist()
        rate = (1.0 + x[KG]) * x[W] + x[BG] + sqrt(gyro / SAMPLES) * rng.normal()
        jumps = accelerometer / SAMPLES + full.acceleration_jump_m_s2**2
        block = PreintegratedMotion(DT_S, DT_S, float(rate), float(x[A] + x[BA] + sqrt(jumps) * rng.normal()), SAMPLES)
        found.replay_buffer.begin(k * DT_S, DT_S)
        found.move(k * DT_S, block, right, left, (gyro, accelerometer))
        if k in FIX_STEPS:
            found.fix(k * DT_S, x[:2] + FIX_SIGMA_M * rng.normal(size=2), FIX_SIGMA_M**2 * np.eye(2))
            assert found.innovation is not None
            result.nis.append(found.innovation.nis)
        if k in LOOKS:
            result.pose.append(nees(x, inner, POSE))
            result.state.append(nees(x, inner, KNOWN))
    return result


def scatters() -> tuple[float, float, float]:
    """Variances from leg to leg of a wheel's slip, twice that of the mean of two, and of the creeps, before any leg."""
    full = cfg().full_state
    slip, creep = SlipPrior(full).scatter
    return 2.0 * slip * slip, creep * creep, (full.turn_creep_scatter_share * full.turn_creep_sigma_m_rad) ** 2


def band(freedom: int) -> tuple[float, float]:
    """The two-sided band of a chi-squared, as a share of its degrees of freedom."""
    return float(chi2.ppf(0.5 * ALPHA, freedom)) / freedom, float(chi2.ppf(1.0 - 0.5 * ALPHA, freedom)) / freedom


@pytest.mark.parametrize("name", ["ekf", pytest.param("ukf", marks=pytest.mark.slow)])
def test_errors_are_as_large_as_the_covariance_says(name: str) -> None:
    """At each look the robots are independent: the sum over the seeds is chi-squared, with its degrees of freedom."""
    runs = [run(name, seed) for seed in range(SEEDS)]
    for states, values in ((POSE, [r.pose for r in runs]), (KNOWN, [r.state for r in runs])):
        low, high = band(SEEDS * len(states))
        for look, mean in zip(LOOKS, np.mean(values, axis=0) / len(states), strict=True):
            assert low < mean < high, (look, len(states))


@pytest.mark.parametrize("name", ["ekf", slow_case("ukf")])
def test_fixes_are_as_far_off_as_expected(name: str) -> None:
    """Innovations of a filter that fits are white, so those of one robot count as those of three."""
    nis = np.array([run(name, seed).nis for seed in range(SEEDS)])
    low, high = band(2 * nis.size)
    assert low < nis.mean() / 2.0 < high


def test_a_filter_that_trusts_itself_too_much_would_be_found() -> None:
    """The band is narrow enough: sigmas that are 8 % (pose) or 5 % (state) too small leave it."""
    for states, share in ((POSE, 0.08), (KNOWN, 0.05)):
        assert band(SEEDS * len(states))[1] < 1.0 / (1.0 - share) ** 2


# -- SLAM by beacons ---------------------------------------------------------------------------------------------------


BEACONS = {1: (4.0, 1.0), 2: (2.0, 6.0), 3: (-3.0, 4.0), 4: (-1.0, -2.0)}
SIGMA_M, SIGMA_RAD, STEP_M, TURN_RAD = 0.1, 0.05, 0.1, 0.04
P0 = np.diag((1e-4, 1e-4, 1e-4))
# The textbook's filter: no gate, no knee, nothing learned.
PLAIN = settings(
    **trust(1e3, 1e3, 0.0, 1.0, 10**9, 10**9), **odometry(0.02, 0.0, 0.01, 0.02, 0.0, 0.0),
    radio__range_sigma_m=SIGMA_M, radio__bearing_sigma_rad=SIGMA_RAD,
)  # fmt: skip
NOISE = PLAIN.cfg.odometry


def drive(slam: BeaconSlam, seed: int, steps: int, *, bearings: bool) -> tuple[float, float, int]:
    """NEES of the pose at the end, sum of the NIS, and how many numbers that were."""
    rng = np.random.default_rng(seed)
    x, y, heading = (np.sqrt(np.diag(P0)) * rng.normal(size=3)).tolist()
    nis, size = 0.0, 0
    for k in range(steps):
        time_s, turn = 0.1 * (k + 1), TURN_RAD * (1.0 if k % 320 < 160 else -1.0)
        slam.predict(Increment(time_s, 0.1, STEP_M, turn))
        way = STEP_M + NOISE.distance_per_sqrt_m * STEP_M**0.5 * rng.normal()
        turn += (NOISE.turn_per_sqrt_m**2 * STEP_M + NOISE.turn_per_sqrt_rad**2 * abs(turn)) ** 0.5 * rng.normal()
        x, y = x + way * cos(heading + turn / 2), y + way * sin(heading + turn / 2)
        heading += turn
        readings: list[Reading] = []
        for beacon, (bx, by) in BEACONS.items():
            range_m = hypot(bx - x, by - y) + SIGMA_M * rng.normal()
            if bearings:
                bearing = wrap_pi(atan2(by - y, bx - x) - heading + SIGMA_RAD * rng.normal())
                readings.append(Reading(time_s, beacon, range_m, bearing))
            else:
                readings.append(Reading(time_s, beacon, range_m))
        for learned in slam.observe(readings):
            nis, size = nis + learned.nis, size + learned.size
    error = np.array((slam.pose.x_m - x, slam.pose.y_m - y, wrap_pi(slam.pose.heading_rad - heading)))
    return float(error @ np.linalg.solve(slam.pose_covariance, error)), nis, size


def check_consistent(seeds: int, steps: int, *, bearings: bool) -> None:
    nees, nis, size = 0.0, 0.0, 0
    for seed in range(seeds):
        slam = recorded_slam(*PLAIN, (0.0, 0.0, 0.0), P0)
        found = drive(slam, seed, steps, bearings=bearings)
        assert set(slam.beacons) == set(BEACONS)
        nees, nis, size = nees + found[0], nis + found[1], size + found[2]
    low, high = (float(chi2.ppf(q, 3 * seeds)) for q in (0.025, 0.975))
    assert low < nees < high
    low, high = (float(chi2.ppf(q, size)) for q in (0.025, 0.975))
    assert low < nis < high


def test_range_and_bearing_over_fifty_seeds() -> None:
    check_consistent(50, 60, bearings=True)


def test_a_filter_that_believes_too_much_is_found_out() -> None:
    """The band is narrow enough: a tenth less noise than there is falls out of it."""
    sure = PLAIN.but(radio__range_sigma_m=0.9 * SIGMA_M, radio__bearing_sigma_rad=0.9 * SIGMA_RAD)
    nis, size = 0.0, 0
    for seed in range(10):
        found = drive(recorded_slam(*sure, (0.0, 0.0, 0.0), P0), seed, 60, bearings=True)
        nis, size = nis + found[1], size + found[2]
    assert nis > chi2.ppf(0.975, size)


@pytest.mark.slow
def test_range_and_bearing_over_fifty_long_runs() -> None:
    check_consistent(50, 800, bearings=True)


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="1 run in 35 is too sure of a wrong place: docs/measurements/slam.md, Measured")
def test_ranges_alone_over_fifty_long_runs() -> None:
    check_consistent(50, int(2 * pi / TURN_RAD) * 3, bearings=False)
