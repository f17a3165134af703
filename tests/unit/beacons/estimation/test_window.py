"""The fixed-lag smoother: its window beside the smoother of the whole run, what is marginalised, and learned noise."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.config.models import FixedLagConfig
from ccatp.beacons.estimation.batch_problem import BeaconNoise
from ccatp.beacons.estimation.batch_smoother import smooth
from ccatp.beacons.estimation.batch_unknowns import BEACON, SHARED, BatchState, MarginalPrior
from ccatp.beacons.estimation.causal import filter_run, follow
from ccatp.beacons.estimation.evaluation import judge, truth_at
from ccatp.beacons.estimation.least_squares import Factored, eliminated
from ccatp.beacons.estimation.measurement_models import ANTENNA
from ccatp.beacons.estimation.range_noise import correlations, range_noise, readings_as_one
from ccatp.beacons.estimation.recording import EstimatedPath, RecordedRun
from ccatp.beacons.estimation.track_review import range_residuals
from ccatp.beacons.estimation.window import Window, reweighted, settled_square
from ccatp.beacons.filters.ekf_slam import EkfSlam
from ccatp.beacons.studies.trait_runs import trait_run
from ccatp.core import FloatArray
from tests.support.slam_settings import Settings, odometry, settings, trust
from tests.unit.beacons.datasets.sets import recorded, world
from tests.unit.beacons.estimation.test_batch_smoother import problem

CONFIG = load_recordings_config()
LAG = FixedLagConfig(lag_s=10.0, poses=10, window_s=1e4, map_s=3600.0)
PLAIN = settings(
    **trust(100.0, 100.0, 0.0, 5.0, 3, 20), **odometry(0.01, 0.0, 0.005, 0.005, 0.0, 0.0), radio__range_sigma_m=0.05,
    radio__bearing_sigma_rad=0.02, radio__freedom=1e6,
)  # fmt: skip


def no_clock() -> float:
    """Time stands still."""
    return 0.0


def estimated(run: RecordedRun, given: Settings, lag: FixedLagConfig) -> EstimatedPath:
    return follow(run, *given, no_clock, lag=lag)[0]


def test_a_window_of_the_whole_run_gives_at_its_end_what_the_smoother_gives() -> None:
    run = recorded(world(2))
    track, smoothed = estimated(run, PLAIN, LAG), smooth(run, *PLAIN, no_clock)
    assert track.delayed is not None
    _, times_s, poses, covariances = track.delayed
    for k in (5, 20, -1):
        at = int(np.argmin(np.abs(smoothed.times_s - times_s[k])))
        expected = [np.interp(times_s[k], smoothed.times_s, column) for column in smoothed.poses.T]
        sigmas = np.sqrt(np.diag(smoothed.covariances[at]))
        # Before the end the smoother has later readings, too.
        assert np.all(np.abs(poses[k] - expected) < (0.2 if k == -1 else 1.5) * sigmas)
        assert np.sqrt(np.diag(covariances[k])) == pytest.approx(sigmas, rel=0.15 if k == -1 else 0.6)


@pytest.mark.parametrize("bearings", [True, False], ids=["range-bearing", "range-only"])
def test_what_is_marginalised_is_neither_lost_nor_counted_twice(bearings: bool) -> None:
    """A window of a quarter of the run ends with the same map and pose as one of the whole run, and the same sigmas."""
    run = recorded(world(1), bearings=bearings)
    long, short = (estimated(run, PLAIN, LAG.model_copy(update={"window_s": s})) for s in (1e4, 15.0))
    found = [
        (
            np.array([*track.poses[-1], *(value for one in track.beacons.values() for value in one[:2])]),
            np.concatenate([np.diag(P) for P in (track.covariances[-1], *(one[2] for one in track.beacons.values()))]),
        )
        for track in (long, short)
    ]
    (a, P), (b, Q) = found
    assert np.all(np.abs(a - b) < 0.5 * np.sqrt(P))
    assert np.sqrt(Q) == pytest.approx(np.sqrt(P), rel=0.15)


def test_it_is_better_than_one_linearisation_for_each_reading() -> None:
    run = trait_run((), 0)
    once = judge(filter_run(run, CONFIG.csv, CONFIG.filter, no_clock), run)
    again = judge(estimated(run, Settings(CONFIG.csv, CONFIG.filter), CONFIG.fixed_lag), run)
    assert once.trajectory_rmse_m is not None
    assert again.trajectory_rmse_m is not None
    assert again.trajectory_rmse_m < 0.7 * once.trajectory_rmse_m


def test_readings_that_the_filter_alone_would_refuse_are_linearised_again_first() -> None:
    """One beacon: the filter is so far off after a minute that three good readings would make it doubt its pose."""
    run = trait_run(("single",), 6)
    run = replace(run, readings=run.readings.where(run.readings.times_s < 72.0))
    found = follow(run, CONFIG.csv, CONFIG.filter, no_clock, lag=CONFIG.fixed_lag)
    assert found.slam.jumps == 0
    assert run.truth is not None
    at = found.path.times_s <= 72.0
    off_m = found.path.poses[at, :2] - truth_at(run.truth, found.path.times_s[at])[:, :2]
    assert np.hypot(*off_m.T)[-20:].max() < 1.0  # without: 1.9 m, and a heading off by 0.8 rad


def test_without_further_readings_it_doubts_them_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two readings are refused, and nothing is received for twenty seconds after them."""
    run = trait_run((), 0)
    last = int(np.searchsorted(run.readings.times_s, 40.0))
    wrong = run.readings.where(np.arange(run.readings.times_s.size) < last)
    wrong.range_m[-2:] += 5.0
    count = int(np.searchsorted(run.steps.times_s, 60.0))
    moves = {name: getattr(run.steps, name)[:count] for name in ("distance_m", "turn_rad", "lateral_m")}
    run = replace(run, readings=wrong, steps=run.steps._replace(times_s=run.steps.times_s[: count + 1], **moves))
    solved_s, solve = list[float](), Window.solve

    def counted(self: Window, time_s: float, *rest: Any) -> None:
        solved_s.append(time_s)
        solve(self, time_s, *rest)

    monkeypatch.setattr(Window, "solve", counted)
    follow(run, CONFIG.csv, CONFIG.filter, no_clock, lag=CONFIG.fixed_lag)
    assert any(40.0 < at_s < 41.5 for at_s in solved_s)
    assert sum(at_s > 41.5 for at_s in solved_s) < 8  # 19 if it doubts them once a second


def test_it_is_consistent_where_errors_last_and_says_that_they_do() -> None:
    run = trait_run(("correlated",), 1)
    track = estimated(run, Settings(CONFIG.csv, CONFIG.filter), CONFIG.fixed_lag)
    found = judge(track, run).nees
    assert found is not None
    assert 0.3 < found.mean < 3.0
    assert any("range errors of beacon" in line for line in track.warnings)


def test_a_calibration_far_from_zero_is_found_and_one_near_zero_stays_there() -> None:
    run = recorded(world(3, 90.0), bearings=False)
    scaled = replace(run, readings=run.readings._replace(range_m=1.08 * run.readings.range_m))
    given = Settings(CONFIG.csv, CONFIG.filter)
    sure, free = (estimated(one, given, CONFIG.fixed_lag).calibration["range_scale"] for one in (run, scaled))
    assert abs(sure.value) < 0.02
    assert sure.sigma < 0.025  # that of the distance's scale is 0.014, and readings tell the ratio of both alone
    assert free.value == pytest.approx(0.08, abs=3.0 * free.sigma)


def test_good_instruments_lose_little_by_being_calibrated() -> None:
    none = CONFIG.csv.priors.model_copy(update=dict.fromkeys(SHARED, 0.0))
    by_none = Settings(CONFIG.csv.model_copy(update={"priors": none}), CONFIG.filter)
    ratios = []
    for seed in (4, 6):
        run = trait_run((), seed)
        own, other = (
            judge(estimated(run, given, CONFIG.fixed_lag), run).trajectory_rmse_m
            for given in (Settings(CONFIG.csv, CONFIG.filter), by_none)
        )
        assert own is not None
        assert other is not None
        ratios.append(own / other)
    assert np.exp(np.mean(np.log(ratios))) < 1.35  # 1.7 with half of each prior, until the evidence is for the whole


def test_a_prior_has_the_weight_of_student_s_t() -> None:
    """Its width grows with the calibration without a step, and without any reading it is that of the core."""
    priors = CONFIG.csv.priors
    core = priors.core * priors.range_scale
    widths = [reweighted(priors, {"range_scale": [(k * core) ** 2]}).range_scale for k in range(41)]
    assert reweighted(priors, {}).range_scale == pytest.approx(core)
    assert widths[1] == pytest.approx(core)
    assert np.all(np.diff(widths) > 0.0)
    assert np.all(np.diff(widths) < 0.5 * core)
    assert reweighted(priors, {}).rssi_reference_db == priors.rssi_reference_db


@pytest.mark.parametrize(("value", "sigma", "is_found"), [(0.4, 0.02, True), (0.4, 0.1, False), (0.0, 1e3, False)])
def test_the_weight_of_a_prior_converges_in_one_solution(value: float, sigma: float, is_found: bool) -> None:
    """To that at which the estimate has this weight; a value of many cores is found where the readings are clear."""
    scale = 0.01

    def under(width: float) -> tuple[float, float]:
        variance = 1.0 / (sigma**-2 + width**-2)
        return variance * value / sigma**2, variance

    square = settled_square(*under(scale), scale, scale)
    mean, variance = under(float(np.sqrt((8.0 * scale**2 + square) / 9.0)))
    assert mean**2 + variance == pytest.approx(square, rel=1e-6)
    assert (abs(mean) > 0.8 * 0.4) == is_found


@pytest.mark.parametrize(("value", "told"), [(4e-6, 7e-13), (4e-6, -3.6e-12), (0.31, 1.7e-5)])
def test_a_prior_keeps_its_weight_where_readings_tell_nothing(value: float, told: float) -> None:
    """What they seem to tell is rounding, or a solution that has not converged: it opened priors a million times."""
    scale = 0.075
    assert settled_square(value, scale**2 / (1.0 + told), scale, scale) == pytest.approx(scale**2, rel=0.01)


def test_its_ellipses_contain_the_truth_where_neither_heights_nor_the_antenna_are_known() -> None:
    run = trait_run(("heights",), 0)
    given = Settings(CONFIG.csv, CONFIG.filter).but(
        priors__beacon_height_m2=4.0, priors__antenna_ahead_m=0.1, priors__antenna_left_m=0.1
    )
    track = estimated(run, given, CONFIG.fixed_lag)
    found = judge(track, run).nees
    assert found is not None
    assert found.mean < 2.0
    for name, true_m in zip(ANTENNA, (0.4, 0.2), strict=True):
        value, sigma = track.calibration[name]
        assert abs(value - true_m) < 4.0 * sigma < 0.1
    off_m = range_residuals(run, track, 0.0)[len(run.readings.times_s) // 2 :]
    assert np.median(np.abs(off_m)) < 0.1  # with the heights and the antenna that were found


# -- its parts --------------------------------------------------------------------------------------------------------


def marginal() -> tuple[MarginalPrior, BatchState]:
    rng = np.random.default_rng(3)
    beacons, shared = rng.normal(0.0, 3.0, (2, BEACON)), 0.1 * rng.standard_normal(len(SHARED))
    state = BatchState(np.array([[1.0, -2.0, 0.7]]), shared, beacons)
    root = rng.standard_normal((3 + len(SHARED) + beacons.size,) * 2)
    return MarginalPrior.made(state, 0, np.ones(2, dtype=bool), root @ root.T, rng.standard_normal(len(root))), state


def moved(state: BatchState, x: FloatArray) -> BatchState:
    return state.moved(x[None, :3], x[3:])


def test_the_prior_of_a_window_has_the_gradient_of_its_cost() -> None:
    prior, state = marginal()
    x = 0.3 * np.random.default_rng(4).standard_normal(3 + len(SHARED) + 2 * BEACON)
    at = moved(state, x)
    _, side = prior.normal_equations(at)
    for k in range(x.size):
        step = np.zeros_like(x)
        step[k] = 1e-6
        slope = (prior.cost(moved(at, step)) - prior.cost(moved(at, -step))) / 2e-6
        assert -side[k] == pytest.approx(slope, rel=1e-5, abs=1e-5)


def test_a_rotation_of_the_whole_map_tells_the_prior_of_the_heading_alone() -> None:
    prior, state = marginal()
    cost_of_heading = []
    for angle in (0.0, 0.4):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array(((c, -s), (s, c)))
        beacons = np.column_stack([state.beacons[:, :2] @ turn.T, state.beacons[:, 2:]])
        pose = np.array([*(turn @ state.poses[0, :2]), state.poses[0, 2] + angle])
        L, _ = prior.normal_equations(BatchState(pose[None, :], state.shared, beacons))
        direction = np.zeros(len(L))
        quarter = np.array(((0.0, -1.0), (1.0, 0.0)))
        direction[:3] = *(quarter @ pose[:2]), 1.0
        for k in range(2):
            direction[3 + len(SHARED) + BEACON * k :][:2] = quarter @ beacons[k, :2]
        cost_of_heading.append(float(direction @ L @ direction))
    assert cost_of_heading[1] == pytest.approx(cost_of_heading[0])
    assert cost_of_heading[0] == pytest.approx(prior.information[2, 2])


def test_elimination_leaves_the_marginal_of_the_last_pose_and_the_rest() -> None:
    made, state = problem()
    system = made.normal_equations(state, np.ones(6))
    information, side = eliminated(system)
    factored = Factored(system)
    poses, shared = factored.solution()
    assert np.linalg.inv(information) == pytest.approx(factored.covariance_at(-1), rel=1e-6, abs=1e-12)
    assert np.linalg.solve(information, side) == pytest.approx(np.concatenate([poses[-1], shared]), rel=1e-6)
    for k, covariance in enumerate(factored.pose_covariances()):
        assert factored.covariance_at(k)[:3, :3] == pytest.approx(covariance, rel=1e-6, abs=1e-12)


def test_a_part_that_is_replaced_takes_the_rest_along_as_an_update_of_it_does() -> None:
    rng = np.random.default_rng(6)
    root = rng.standard_normal((6, 6))
    x, P, columns = rng.standard_normal(6), root @ root.T, np.array((1, 4))
    updated, replaced = EkfSlam(x, P), EkfSlam(x, P)
    updated.update(columns, np.array(((1.0, 0.5), (0.0, 2.0))), np.array((0.3, -1.0)), np.array((0.2, 0.4)))
    at = np.ix_(columns, columns)
    replaced.replace(columns, updated.mean[columns], updated.covariance[at])
    assert replaced.mean == pytest.approx(updated.mean)
    assert replaced.covariance == pytest.approx(updated.covariance)


def test_the_noise_of_a_beacon_with_few_readings_stays_what_it_was() -> None:
    """So after a restart of the window errors that last are not taken for white ones."""
    made, state = problem()
    before = BeaconNoise(np.array((2.0, 0.5)), np.array((7.0, 1.0)), np.array((0.8, 0.0)), np.array((3.0, 1.0)))
    for found, kept in zip(range_noise(made, state, before), before, strict=True):
        assert found == pytest.approx(kept)


@pytest.mark.parametrize(("phi", "expected"), [(0.0, 1.0), (0.8, 9.0), (0.95, 39.0)])
def test_errors_that_last_are_counted_as_few(phi: float, expected: float) -> None:
    """(1 + phi) / (1 - phi) readings of a first-order process count as one."""
    rng, found = np.random.default_rng(7), []
    for _ in range(20):
        e = rng.standard_normal(2000)
        for k in range(1, e.size):
            e[k] = phi * e[k - 1] + np.sqrt(1.0 - phi * phi) * e[k]
        found.append(readings_as_one(correlations(e)))
    assert np.mean(found) == pytest.approx(expected, rel=0.25)
