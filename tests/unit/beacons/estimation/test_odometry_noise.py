"""Noise of the odometry, estimated: each part alone, larger and smaller than configured."""

from dataclasses import replace

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.estimation.batch_problem import BatchProblem
from ccatp.beacons.estimation.batch_unknowns import BEACON, SHARED, BatchState
from ccatp.beacons.estimation.evaluation import truth_at
from ccatp.beacons.estimation.least_squares import Factored, descend
from ccatp.beacons.estimation.odometry_noise import MOST, OdometryNoise, odometry_noise
from ccatp.beacons.estimation.recording import RecordedRun, Steps
from tests.unit.beacons.datasets.sets import recorded, world

CONFIG = load_recordings_config()
RIGHT = CONFIG.csv.model_copy(
    update={
        "radio": CONFIG.csv.radio.model_copy(
            update={"range_sigma_m": 0.03, "range_sigma_per_m": 0.0, "bearing_sigma_rad": 0.01, "freedom": 1e6}
        ),
        "priors": CONFIG.csv.priors.model_copy(update=dict.fromkeys(SHARED, 0.0)),
    }
)


def driven(
    seed: int, truth: OdometryNoise, range_sigma_m: float = 0.03, bearing_sigma_rad: float = 0.01
) -> RecordedRun:
    """Two minutes with odometry whose variances are the configured ones times these factors."""
    run = recorded(world(seed, 120.0, range_sigma_m=range_sigma_m, bearing_sigma_rad=bearing_sigma_rad))
    noise, s = truth.of(RIGHT.odometry), run.steps
    way, dt, turned = np.abs(s.distance_m), np.diff(s.times_s), np.abs(s.turn_rad)
    e = np.random.default_rng(seed).standard_normal((3, way.size))
    by_turn = noise.turn_per_sqrt_m**2 * way + noise.turn_per_sqrt_rad**2 * turned + noise.turn_per_sqrt_s**2 * dt
    steps = Steps(
        s.times_s, s.distance_m + noise.distance_per_sqrt_m * np.sqrt(way) * e[0],
        s.turn_rad + np.sqrt(by_turn) * e[1], noise.lateral_per_sqrt_m * np.sqrt(way) * e[2],
    )  # fmt: skip
    return replace(run, steps=steps)


def found_in(run: RecordedRun) -> OdometryNoise:
    """The factors where they have converged."""
    noise, times_s = OdometryNoise(), np.union1d(run.steps.times_s[:1], run.readings.times_s)
    assert run.truth is not None
    beacons = np.zeros((len(run.beacon_ids), BEACON))
    beacons[:, :2] = [run.beacon_truth_m[name] for name in run.beacon_ids]
    state = BatchState(truth_at(run.truth, times_s), np.zeros(len(SHARED)), beacons)
    for _ in range(12):
        settings = RIGHT.model_copy(update={"odometry": noise.of(RIGHT.odometry)})
        used = np.ones(len(beacons), dtype=bool)
        problem = BatchProblem(run.steps, run.readings, times_s, run.first_pose, settings, used)
        state, _ = descend(problem, state, 20)
        factored = Factored(problem.normal_equations(state, np.ones(len(run.readings.times_s))))
        before, noise = noise, odometry_noise(problem, state, factored, RIGHT.odometry, noise, OdometryNoise())
        if np.allclose(noise, before, rtol=0.01):
            break
    return noise


@pytest.mark.parametrize("part", OdometryNoise._fields)
@pytest.mark.parametrize("factor", [0.05, 3.0])
def test_each_part_is_found_larger_and_smaller_and_the_others_stay(part: str, factor: float) -> None:
    truth = OdometryNoise(**{part: factor})
    found = np.exp(np.mean([np.log(found_in(driven(seed, truth))) for seed in (1, 2, 3)], axis=0))
    for name, value in zip(OdometryNoise._fields, found.tolist(), strict=True):
        if name != part:
            assert 0.6 < value < 1.7, name
        elif factor > 1.0:
            assert 1.5 < value <= MOST
        else:  # the prior counts for ten errors; a lateral error looks like one of turning
            assert value < (0.75 if part == "lateral" else 0.5)


def test_what_the_readings_do_not_tell_stays_as_configured() -> None:
    run = driven(1, OdometryNoise(0.05, 0.05, 0.05))
    few = replace(run, readings=run.readings.where(np.arange(len(run.readings.times_s)) % 149 == 0))
    assert list(found_in(few)) == pytest.approx([1.0, 1.0, 1.0], abs=0.2)
