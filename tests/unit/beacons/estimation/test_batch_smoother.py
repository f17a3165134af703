"""The smoother: its problem against independent arithmetic, and what it finds in simulated runs."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.linalg import LinAlgError
from scipy.spatial.transform import Rotation

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.config.models import OdometryNoiseConfig, PriorsConfig, RadioNoiseConfig, RecordingConfig
from ccatp.beacons.estimation.batch_problem import BatchProblem, repeats
from ccatp.beacons.estimation.batch_smoother import smooth
from ccatp.beacons.estimation.batch_unknowns import BEACON, SHARED, BatchState
from ccatp.beacons.estimation.evaluation import judge, truth_at
from ccatp.beacons.estimation.least_squares import Factored, t_cost, t_weights
from ccatp.beacons.estimation.reckoning import CALIBRATION, Reckoning
from ccatp.beacons.estimation.recording import (
    BeaconFix,
    EstimatedPath,
    Readings,
    RecordedRun,
    ReferencePath,
    Steps,
    dead_reckoned,
)
from ccatp.beacons.rigid_motion import RigidMotion, aligned_rms_m, best_motion
from ccatp.filters.metrics import consistency, nees
from tests.unit.beacons.datasets.sets import BEACONS, changed, recorded, world

FloatArray = npt.NDArray[np.float64]
DELAY = CALIBRATION.index("odometry_delay_s")
ODOMETRY = OdometryNoiseConfig(
    distance_per_sqrt_m=0.02, distance_per_sqrt_rad=0.01, turn_per_sqrt_m=0.02, turn_per_sqrt_rad=0.05,
    turn_per_sqrt_s=0.01, lateral_per_sqrt_m=0.015,
)  # fmt: skip
RADIO = RadioNoiseConfig(
    range_sigma_m=0.1, range_sigma_per_m=0.02, camera_field_rad=0.0, bearing_sigma_rad=0.03, rssi_sigma_db=3.0,
    rssi_reference_dbm=-40.0, rssi_exponent=2.2, freedom=5.0, correlation_s=0.0, gate_sigmas=5.0,
)  # fmt: skip
NO_PRIORS = PriorsConfig(
    **dict.fromkeys(PriorsConfig.model_fields, 0.0) | {"pose_m": 0.05, "heading_rad": 0.03, "core": 0.5}
)
PRIORS = PriorsConfig(
    distance_scale=0.1, distance_per_rad=0.05, turn_scale=0.1, turn_per_m=0.05, turn_bias_rad_s=0.02,
    odometry_delay_s=0.2, range_scale=0.1, range_offset_m=0.3, bearing_offset_rad=0.02, rssi_reference_db=5.0,
    rssi_exponent=0.4, beacon_offset_m=0.1, beacon_reference_db=2.0, beacon_height_m2=1.0, antenna_ahead_m=0.2,
    antenna_left_m=0.2, pose_m=0.05, heading_rad=0.03, core=0.5,
)  # fmt: skip
OF_PROBLEM = RecordingConfig(odometry=ODOMETRY, radio=RADIO, priors=PRIORS)


def steps(n: int = 60, rng: np.random.Generator | None = None) -> Steps:
    """A winding way with steps of uneven length."""
    rng = rng or np.random.default_rng(5)
    t = np.cumsum(np.concatenate([[0.0], rng.uniform(0.1, 0.2, n)]))
    return Steps(t, rng.uniform(0.0, 0.2, n), rng.uniform(-0.2, 0.3, n), rng.uniform(-0.05, 0.05, n))


def problem() -> tuple[BatchProblem, BatchState]:
    """Six readings of two beacons, of all kinds, and a state off the minimum."""
    rng = np.random.default_rng(11)
    s = steps()
    t = np.array([0.7, 1.9, 2.0, 3.3, 4.4, 5.5])
    nan = np.nan
    readings = Readings(
        t,
        np.array([0, 1, 0, 1, 0, 1]),
        np.array([3.0, nan, 2.5, 4.0, nan, 3.9]),
        np.array([0.3, -0.2, nan, 1.0, 0.5, nan]),
        np.array([nan, -52.0, nan, nan, -50.0, -55.0]),
    )
    times = np.union1d(s.times_s[:1], t)
    both = np.ones(2, dtype=bool)
    made = BatchProblem(s, readings, times, (0.1, -0.2, 0.3), OF_PROBLEM, both, rest=(0.3, 0.5), raised=both)
    assert made.reckoning.at_rest[0] > 0.0
    poses = np.column_stack([np.interp(times, s.times_s, c) for c in dead_reckoned(s, (0.1, -0.2, 0.3)).T])
    poses += 0.05 * rng.standard_normal(poses.shape)
    shared = 0.02 * rng.standard_normal(len(SHARED))
    beacons = np.column_stack([[2.0, -1.5], [3.0, 1.0], 0.02 * rng.standard_normal((2, 3))])
    return made, BatchState(poses, shared, beacons)


def flat(state: BatchState) -> FloatArray:
    """All unknowns in a row."""
    return np.concatenate([state.poses.ravel(), state.shared, state.beacons.ravel()])


def unflat(x: FloatArray, like: BatchState) -> BatchState:
    """And back."""
    n = like.poses.size
    return BatchState(x[:n].reshape(-1, 3), x[n : n + len(SHARED)], x[n + len(SHARED) :].reshape(-1, BEACON))


def half_squares(made: BatchProblem, x: FloatArray, like: BatchState, weights: FloatArray) -> float:
    """Half the weighted sum of squares, from the residuals alone; noise of the odometry as at ``like``."""
    state = unflat(x, like)
    at_like, found = made.residuals(like), made.residuals(state)
    W = at_like.odometry_information
    total = np.einsum("ki,kij,kj->", found.odometry, W, found.odometry)
    return float(0.5 * (total + (weights * found.chi2).sum())) + made.prior_cost(state)


def dense(made: BatchProblem, state: BatchState, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The normal equations as one full matrix and its right-hand side."""
    system = made.normal_equations(state, weights)
    n, m = len(state.poses), len(system.corner)
    A = np.zeros((3 * n + m, 3 * n + m))
    for down, diagonal in enumerate(system.band):
        for k in range(3 * n - down):
            A[k + down, k] = A[k, k + down] = diagonal[k]
    A[: 3 * n, 3 * n :], A[3 * n :, : 3 * n] = system.border, system.border.T
    A[3 * n :, 3 * n :] = system.corner
    return A, np.concatenate([system.pose_side, system.shared_side])


def test_at_rest_the_heading_stays_and_the_turn_is_the_bias() -> None:
    bias_rad_s, t = 0.02, np.linspace(0.0, 10.0, 101)
    drives = (t[:-1] >= 6.0).astype(np.float64)
    s = Steps(t, 0.1 * drives, np.full(100, 0.1 * bias_rad_s) + 0.05 * drives, np.zeros(100))
    reckoning = Reckoning(s, np.array([0.0, 6.0, 10.0]), rest=(0.1, 0.1))
    assert reckoning.at_rest == pytest.approx((6.0, 6.0 * bias_rad_s))
    for bias, turned in ((0.0, 2.0 + 4.0 * bias_rad_s), (bias_rad_s, 2.0)):
        motion, _, _ = reckoning.increments(np.array((0.0, 0.0, 0.0, bias, 0.0, 0.0)), ODOMETRY)
        assert motion[:, 2] == pytest.approx([0.0, turned])


def test_the_gradient_is_that_of_the_cost() -> None:
    made, state = problem()
    weights = np.linspace(0.5, 1.5, 6)
    _, side = dense(made, state, weights)
    x = flat(state)
    h = 1e-6
    for k in range(x.size):
        step = np.zeros_like(x)
        step[k] = h
        up = half_squares(made, x + step, state, weights)
        down = half_squares(made, x - step, state, weights)
        if k != DELAY + state.poses.size:  # its derivative is taken across 50 ms: below
            assert -side[k] == pytest.approx((up - down) / (2.0 * h), rel=1e-4, abs=1e-4), k


def test_solution_and_covariances_are_those_of_the_full_matrix() -> None:
    made, state = problem()
    A, side = dense(made, state, np.ones(6))
    factored = Factored(made.normal_equations(state, np.ones(6)))
    n = state.poses.size
    poses, shared = factored.solution()
    assert np.concatenate([poses.ravel(), shared]) == pytest.approx(np.linalg.solve(A, side), rel=1e-8)
    C = np.linalg.inv(A)
    assert factored.shared_covariance() == pytest.approx(C[n:, n:], rel=1e-6, abs=1e-12)
    for k, covariance in enumerate(factored.pose_covariances()):
        assert covariance == pytest.approx(C[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], rel=1e-6, abs=1e-12)


def test_covariances_of_steps_are_those_of_the_full_matrix() -> None:
    made, state = problem()
    A, _ = dense(made, state, np.ones(6))
    factored = Factored(made.normal_equations(state, np.ones(6)))
    n, m, rng = len(state.poses), len(A) - state.poses.size, np.random.default_rng(8)
    by_poses, by_shared = rng.standard_normal((n - 1, 2, 6)), rng.standard_normal((n - 1, 2, m))
    found, C = factored.step_covariances(by_poses, by_shared), np.linalg.inv(A)
    for k in range(n - 1):
        J = np.zeros((2, len(A)))
        J[:, 3 * k : 3 * k + 6], J[:, 3 * n :] = by_poses[k], by_shared[k]
        assert found[k] == pytest.approx(J @ C @ J.T, rel=1e-6, abs=1e-12)


def test_errors_under_another_prior_are_those_of_the_estimate_that_assumes_the_first() -> None:
    """P' = P (A - 1 / assumed + actual / assumed^2) P for one unknown: covariance of P (J^T W z + prior)."""
    made, state = problem()
    A, _ = dense(made, state, np.ones(6))
    factored, n = Factored(made.normal_equations(state, np.ones(6))), state.poses.size
    assumed, actual = np.full(len(A) - n, np.inf), np.full(len(A) - n, np.inf)
    assumed[1], actual[1] = 1.0 / made.prior_information[1], 9.0 / made.prior_information[1]
    middle, C = A.copy(), np.linalg.inv(A)
    middle[n + 1, n + 1] += actual[1] / assumed[1] ** 2 - 1.0 / assumed[1]
    expected = C @ middle @ C
    found = factored.spread_by(assumed, actual)
    assert found.shared_covariance() == pytest.approx(expected[n:, n:], rel=1e-6, abs=1e-12)
    for k, covariance in enumerate(found.pose_covariances()):
        assert covariance == pytest.approx(expected[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], rel=1e-6, abs=1e-12)
        assert found.covariance_at(k)[:3, :3] == pytest.approx(covariance, rel=1e-6, abs=1e-12)


def test_a_matrix_that_is_not_positive_definite_is_refused() -> None:
    made, state = problem()
    system = made.normal_equations(state, np.ones(6))
    system.band[0, 7] *= -1.0
    with pytest.raises(LinAlgError, match="not positive definite"):
        Factored(system)


def test_what_has_no_prior_is_not_estimated() -> None:
    made, state = problem()
    fixed = BatchProblem(
        steps(), made.readings, np.union1d(steps().times_s[:1], made.readings.times_s), (0.1, -0.2, 0.3),
        RecordingConfig(odometry=ODOMETRY, radio=RADIO, priors=NO_PRIORS), np.array([True, False]),
    )  # fmt: skip
    assert np.flatnonzero(fixed.free).tolist() == [len(SHARED), len(SHARED) + 1]  # x and y of the first beacon
    assert fixed.residuals(state).information[1::2].sum() == 0.0  # readings of the other one count nothing


def test_weights_are_the_gradient_of_the_cost() -> None:
    chi2, sizes = np.array([0.0, 0.5, 3.0, 80.0]), np.array([1.0, 2.0, 2.0, 1.0])
    for softness in (1.0, 7.0):
        h = 1e-5
        for k in range(4):
            e = np.zeros(4)
            e[k] = h
            slope = (t_cost(chi2 + e, sizes, 4.0, softness) - t_cost(chi2 - e, sizes, 4.0, softness)) / (2.0 * h)
            assert t_weights(chi2, sizes, 4.0, softness)[k] == pytest.approx(2.0 * slope, rel=1e-6)


def test_readings_that_share_their_error_are_counted() -> None:
    nothing = np.full(5, np.nan)
    readings = Readings(np.array([0.0, 0.4, 0.8, 5.0, 5.1]), np.array([0, 0, 0, 0, 1]), nothing, nothing, nothing)
    assert repeats(readings.times_s, readings.beacon, 1.0).tolist() == [2.0, 3.0, 2.0, 1.0, 1.0]
    assert repeats(readings.times_s, readings.beacon, 0.0).tolist() == [1.0] * 5


SETTINGS, HOW = load_recordings_config().csv, load_recordings_config().filter


def no_clock() -> float:
    """Time stands still."""
    return 0.0


def with_priors(**priors: float) -> RecordingConfig:
    return SETTINGS.model_copy(update={"priors": SETTINGS.priors.model_copy(update=priors)})


def noisy(run: RecordedRun, seed: int, distance_scale: float = 1.0, bias_rad_s: float = 0.0) -> RecordedRun:
    """Odometry with the noise that the settings assume, a wrong scale and a bias."""
    rng = np.random.default_rng(seed)
    s, noise = run.steps, SETTINGS.odometry
    way, dt = np.abs(s.distance_m), np.diff(s.times_s)
    e = rng.standard_normal((3, way.size))
    sigma_turn = np.sqrt(
        noise.turn_per_sqrt_m**2 * way + noise.turn_per_sqrt_rad**2 * np.abs(s.turn_rad) + noise.turn_per_sqrt_s**2 * dt
    )
    steps = Steps(
        s.times_s,
        (s.distance_m + noise.distance_per_sqrt_m * np.sqrt(way) * e[0]) / distance_scale,
        s.turn_rad + sigma_turn * e[1] + bias_rad_s * dt,
        noise.lateral_per_sqrt_m * np.sqrt(way) * e[2],
    )
    return replace(run, steps=steps)


def run_of(seed: int, *, bearings: bool, seconds: float = 120.0, **wrong: float) -> RecordedRun:
    """A simulated run with readings as noisy as the settings assume."""
    return noisy(
        recorded(world(seed, seconds, range_sigma_m=0.1, bearing_sigma_rad=0.05), bearings=bearings), seed, **wrong
    )


@pytest.mark.parametrize("bearings", [True, False], ids=["range-bearing", "range-only"])
def test_path_beacons_and_calibration_are_found(bearings: bool) -> None:
    run = run_of(3, bearings=bearings, distance_scale=1.02, bias_rad_s=0.008)
    long = replace(run, readings=run.readings._replace(range_m=1.04 * run.readings.range_m + 0.15))
    track = smooth(long, SETTINGS, HOW, no_clock)
    found = judge(track, long)
    assert found.trajectory_rmse_m == pytest.approx(0.0, abs=0.08)  # less than the noise of one range
    assert found.beacon_rmse_m == pytest.approx(0.0, abs=0.1)
    for name, true in (
        ("distance_scale", -0.02 / 1.02),  # positive where the odometry reads too much
        ("turn_bias_rad_s", 0.008),
        ("range_scale", 0.04),
        ("range_offset_m", 0.15),
    ):
        value, sigma = track.calibration[name]
        assert abs(value - true) < 3.5 * sigma, name
    assert track.calibration["turn_bias_rad_s"].sigma < 0.6 * SETTINGS.priors.turn_bias_rad_s
    assert ("bearing_offset_rad" in track.calibration) is False  # it has no prior
    assert track.warnings == ()
    assert track.updates + track.refused == len(run.readings.times_s)


def test_errors_are_as_large_as_the_covariance_says() -> None:
    """NEES over ten runs: of the map in the 95 % band; of the path about one, since it is one long correlation."""
    paths, maps = [], []
    for seed in range(10):
        run = run_of(100 + seed, bearings=True, seconds=60.0)
        # priors that the simulation draws from: what is exact must be known as exact
        exact = ("distance_scale", "turn_scale", "turn_per_m", "turn_bias_rad_s", "range_scale", "range_offset_m")
        tight = with_priors(**dict.fromkeys(exact, 0.0), pose_m=1e-3, heading_rad=1e-3).priors
        gaussian = SETTINGS.radio.model_copy(update={"freedom": 1e6, "range_sigma_per_m": 0.0})
        track = smooth(run, SETTINGS.model_copy(update={"radio": gaussian, "priors": tight}), HOW, no_clock)
        judged = judge(track, run)
        assert judged.nees is not None
        paths.append(judged.nees.mean)
        maps += [_nees(track, name, place) for name, place in BEACONS.items()]
    assert np.mean(paths) == pytest.approx(1.0, abs=0.35)
    assert 57.2 < np.sum(maps) < 106.6  # chi-squared of 80 degrees of freedom


def _nees(track: EstimatedPath, name: str, place: tuple[float, float]) -> float:
    fix = track.beacons[name]
    e = np.array((fix.x_m - place[0], fix.y_m - place[1]))
    return float(e @ np.linalg.solve(fix.covariance, e))


def test_outliers_hardly_move_it() -> None:
    run = run_of(5, bearings=True)
    rng = np.random.default_rng(9)
    wild = rng.random(len(run.readings.times_s)) < 0.1
    ranges = np.where(wild, run.readings.range_m + rng.uniform(2.0, 6.0, wild.size), run.readings.range_m)
    bearings = np.where(wild, rng.uniform(-3.0, 3.0, wild.size), run.readings.bearing_rad)
    hit = replace(run, readings=run.readings._replace(range_m=ranges, bearing_rad=bearings))
    clean, found = smooth(run, SETTINGS, HOW, no_clock), smooth(hit, SETTINGS, HOW, no_clock)
    assert judge(clean, run).trajectory_rmse_m == pytest.approx(0.0, abs=0.06)
    assert judge(found, hit).trajectory_rmse_m == pytest.approx(0.0, abs=0.08)
    assert found.refused > 0.8 * wild.sum()


def test_signal_strengths_alone_place_beacons() -> None:
    run = run_of(7, bearings=False)
    rng = np.random.default_rng(1)
    w = world(7, 120.0, range_sigma_m=0.0)
    rssi = -43.0 - 10.0 * 2.1 * np.log10(w.range_m) + 2.0 * rng.standard_normal(w.range_m.size)
    nothing = np.full(rssi.size, np.nan)
    received = replace(run, readings=run.readings._replace(range_m=nothing, rssi_dbm=rssi))
    track = smooth(received, SETTINGS, HOW, no_clock)
    judged = judge(track, received)
    assert judged.beacon_rmse_m == pytest.approx(0.0, abs=0.6)  # 2 dB are a quarter of the distance
    assert set(track.calibration) >= {"rssi_reference_db", "rssi_exponent"}
    assert "range_scale" not in track.calibration


def test_commands_that_the_vehicle_follows_late() -> None:
    w = world(8, 120.0, range_sigma_m=0.05, bearing_sigma_rad=0.01)
    early = changed(w, times_s=w.times_s - 0.25)
    run = recorded(w)
    lagged = replace(run, steps=run.steps._replace(times_s=early.times_s))
    begin = lagged.steps.times_s >= 0.0
    steps = Steps(
        lagged.steps.times_s[begin], lagged.steps.distance_m[begin[:-1]], lagged.steps.turn_rad[begin[:-1]],
        lagged.steps.lateral_m[begin[:-1]],
    )  # fmt: skip
    inside = lagged.readings.times_s < steps.times_s[-1]
    lagged = replace(lagged, steps=steps, readings=lagged.readings.where(inside))
    settings = with_priors(odometry_delay_s=0.3)
    delay, sigma = smooth(lagged, settings, HOW, no_clock).calibration["odometry_delay_s"]
    assert delay == pytest.approx(0.25, abs=max(4.0 * sigma, 0.02))


def test_a_straight_path_leaves_the_side_in_doubt() -> None:
    w = world(9, 40.0)
    n = w.distance_m.size
    x = 3.0 + 0.05 * np.arange(n + 1)
    poses = np.column_stack([x, np.ones(n + 1), np.zeros(n + 1)])
    sx = np.interp(w.read_s, w.times_s, x)
    places = np.array(list(BEACONS.values()))[w.read_beacon]
    ranges = np.hypot(places[:, 0] - sx, places[:, 1] - 1.0)
    straight = changed(w, poses=poses, distance_m=np.full(n, 0.05), turn_rad=np.zeros(n), range_m=ranges)
    track = smooth(recorded(straight, bearings=False), SETTINGS, HOW, no_clock)
    (doubt,) = (line for line in track.warnings if "may lie at the mirror image" in line)
    assert "7" in doubt.split(" may ")[0]


def test_a_robot_that_stands_places_no_beacon() -> None:
    w = world(10, 20.0)
    n = w.distance_m.size
    stood = changed(
        w, poses=np.zeros((n + 1, 3)), distance_m=np.zeros(n), turn_rad=np.zeros(n), range_m=0.0 * w.range_m + 3.0
    )
    track = smooth(recorded(stood, bearings=False), SETTINGS, HOW, no_clock)
    assert track.beacons == {}
    assert np.isfinite(track.covariances).all()
    assert "beacons 6, 7, 8, 9 could not be placed: too few readings, or all from one place" in track.warnings


# -- figures of a run --------------------------------------------------------------------------------------------------


def test_squares_of_gaussian_errors_lie_in_the_band_and_others_do_not() -> None:
    rng = np.random.default_rng(4)
    P = np.array(((2.0, 0.3), (0.3, 0.5)))
    errors = rng.multivariate_normal((0.0, 0.0), P, size=500)
    squares = nees(errors, np.broadcast_to(P, (500, 2, 2)))
    honest = consistency(squares, np.full(500, 2.0))
    assert honest is not None
    assert honest.low < honest.mean < honest.high
    assert (honest.low, honest.high) == pytest.approx((0.914, 1.090), abs=0.002)  # tables of chi-squared, 1000 degrees
    proud = consistency(squares * 1.5, np.full(500, 2.0))
    assert proud is not None
    assert proud.mean > proud.high
    assert consistency(np.empty(0), np.empty(0)) is None


def test_truth_is_unknown_outside_and_in_its_gaps() -> None:
    t = np.array([0.0, 0.4, 2.0, 2.4, 2.8])
    found = truth_at(ReferencePath(t, t, -t, 2.0 * t), np.array([-0.1, 0.2, 1.0, 2.2, 2.9]))
    assert np.isnan(found[[0, 2, 4]]).all()
    assert found[[1, 3]] == pytest.approx(np.array([(0.2, -0.2, 0.4), (2.2, -2.2, 4.4)]))
    slow = np.array([0.0, 1.0, 2.0, 3.0, 9.0])  # a reference of a hertz is no gap
    assert np.isfinite(truth_at(ReferencePath(slow, slow, slow, slow), np.array([0.5, 5.0]))[:, 0]).tolist() == [
        True,
        False,
    ]


AWAY = RigidMotion(np.array(((np.cos(1.0), -np.sin(1.0)), (np.sin(1.0), np.cos(1.0)))), np.array((5.0, -3.0)))


def track_of(turned: RigidMotion, *, beacons: bool = True) -> EstimatedPath:
    """The truth of a simulated run, moved rigidly, with a beacon 0.3 m off."""
    w = world(seconds=20.0)
    places = turned.moved(np.array(list(BEACONS.values())) + np.array([[0.3, 0.0], [0, 0], [0, 0], [0, 0]]))
    poses = np.column_stack([turned.moved(w.poses[:, :2]), w.poses[:, 2] + turned.angle_rad])
    return EstimatedPath(
        times_s=w.times_s,
        poses=poses,
        covariances=np.broadcast_to(np.eye(3), (len(poses), 3, 3)),
        beacons={n: BeaconFix(x, y, np.eye(2)) for n, (x, y) in zip(BEACONS, places.tolist(), strict=True)}
        if beacons
        else {},
        calibration={},
        refused=0,
        updates=0,
        warnings=(),
    )


def test_a_track_is_judged_after_one_rigid_alignment() -> None:
    judged = judge(track_of(AWAY), recorded(world(seconds=20.0)))
    assert judged.trajectory_rmse_m == pytest.approx(0.0, abs=1e-9)
    assert judged.heading_rmse_rad == pytest.approx(0.0, abs=1e-9)
    assert judged.beacon_rmse_m == pytest.approx(0.15)  # sqrt(0.3^2 / 4)
    assert judged.beacon_errors_m == pytest.approx({"6": 0.3, "7": 0.0, "8": 0.0, "9": 0.0}, abs=1e-9)
    assert judged.nees is not None
    assert judged.nees.mean > 1.0  # the poses as they are, not aligned
    assert judged.nis is None


def test_without_a_true_path_the_beacons_are_aligned_themselves() -> None:
    run = replace(recorded(world(seconds=20.0)), truth=None)
    judged = judge(track_of(AWAY), run)
    assert judged.trajectory_rmse_m is None
    assert judged.heading_rmse_rad is None
    assert judged.nees is None
    assert judged.beacon_rmse_m is not None
    assert 0.0 < judged.beacon_rmse_m < 0.15
    two = {name: BEACONS[name] for name in ("6", "7")}
    assert judge(track_of(AWAY), replace(run, beacon_truth_m=two)).beacon_rmse_m is None
    none = judge(track_of(RigidMotion(np.eye(2), np.zeros(2)), beacons=False), run)
    assert none.beacon_rmse_m is None


RNG = np.random.default_rng(3)


def test_a_mirror_image_is_another_map_unless_excluded() -> None:
    points = RNG.normal(size=(8, 2))
    mirrored = points * (1.0, -1.0)
    assert aligned_rms_m(mirrored, points) > 0.3
    assert np.linalg.det(best_motion(mirrored, points).rotation) == pytest.approx(1.0)
    assert aligned_rms_m(mirrored, points, mirrors=True) == pytest.approx(0.0, abs=1e-12)


def test_covariances_turn_with_the_points() -> None:
    rng = np.random.default_rng(3)
    points = rng.multivariate_normal((0.0, 0.0), ((4.0, 1.0), (1.0, 0.5)), size=200)
    motion = RigidMotion(Rotation.from_euler("z", 0.7).as_matrix()[:2, :2], np.array((1.0, 2.0)))
    assert motion.angle_rad == pytest.approx(0.7)
    assert motion.turned(np.cov(points.T)) == pytest.approx(np.cov(motion.moved(points).T))
    maps = rng.normal(size=(40, 3, 2))  # of three points each
    together = np.cov(np.array([motion.moved(one).ravel() for one in maps]).T)
    assert motion.turned_map(np.cov(maps.reshape(40, 6).T)) == pytest.approx(together)


def test_a_single_point_fixes_no_turn() -> None:
    found = best_motion(np.array([[1.0, 2.0]]), np.array([[4.0, 1.0]]))
    assert found.rotation == pytest.approx(np.eye(2))
    assert found.translation_m == pytest.approx([3.0, -1.0])
