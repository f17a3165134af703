"""Localization on a known map: consistent, better than without it, and a beacon that is not there is noticed."""

from dataclasses import replace

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.estimation.evaluation import judge
from ccatp.beacons.estimation.recording import KnownMap, Readings, RecordedRun
from ccatp.beacons.studies.recordings import FILTERS, estimate
from ccatp.beacons.studies.trait_runs import trait_run
from tests.support.cases import slow_case

CFG = load_recordings_config()
SIGMA_M = 0.05


def with_survey(run: RecordedRun, seed: int) -> RecordedRun:
    """The run with a known map, which misses the true places by the errors that its covariance tells."""
    true_m, rng = np.array([*run.beacon_truth_m.values()]), np.random.default_rng(seed)
    places_m = true_m + SIGMA_M * rng.standard_normal(true_m.shape)
    nothing = np.full(len(places_m), np.nan)
    return replace(run, known_map=KnownMap(run.beacon_ids, places_m, SIGMA_M**2 * np.eye(places_m.size), nothing))


# What the fixed lag does with a known map shows below, and the smoother has the same equations.
@pytest.mark.parametrize("name", [slow_case(name) if name == "fixed-lag" else name for name in FILTERS])
def test_a_known_map_gives_a_consistent_path_in_its_frame(name: str) -> None:
    poses, places, free_m, known_m = list[float](), list[float](), list[float](), list[float]()
    for seed in range(2):
        run = with_survey(trait_run((), seed), seed)
        free = judge(estimate(replace(run, known_map=None), CFG, name), run)  # not aligned
        track = estimate(run, CFG, name)
        judged = judge(track, run)
        assert judged.nees is not None
        assert judged.trajectory_rmse_m is not None
        assert free.trajectory_rmse_m is not None
        known_m.append(judged.trajectory_rmse_m)
        free_m.append(free.trajectory_rmse_m)
        poses.append(judged.nees.mean)
        for beacon, true_m in run.beacon_truth_m.items():
            off = np.array(track.beacons[beacon][:2]) - true_m
            places.append(float(off @ np.linalg.solve(track.beacons[beacon].covariance, off)) / 2.0)
    assert 0.2 < np.mean(poses) < 1.5  # one run in two has an odometry better than assumed, so less than one
    assert 0.5 < np.mean(places) < 1.5
    assert np.mean(known_m) < 0.7 * np.mean(free_m)


@pytest.mark.parametrize("name", FILTERS)
def test_a_beacon_that_is_not_where_it_was_surveyed_is_placed_again(name: str) -> None:
    run = with_survey(trait_run((), 1), 1)
    known = run.known_map
    assert known is not None
    wrong_m = known.places_m.copy()
    wrong_m[0] += 3.0
    track = estimate(replace(run, known_map=known._replace(places_m=wrong_m)), CFG, name)
    off_m = np.hypot(*(np.array(track.beacons["b0"][:2]) - run.beacon_truth_m["b0"]))
    assert off_m < 0.5
    if name != "smoother":
        assert any("beacon b0 was placed again" in line for line in track.warnings)


@pytest.mark.parametrize("name", FILTERS)
def test_beacons_that_cannot_be_placed_share_one_line(name: str) -> None:
    run = trait_run((), 1)
    names = (*run.beacon_ids, *(f"x{k}" for k in range(20)))
    first = run.readings.where(np.zeros(20, dtype=np.intp))
    once = first._replace(beacon=len(run.beacon_ids) + np.arange(20))
    strangers = Readings(*(np.concatenate(pair) for pair in zip(once[:5], run.readings[:5], strict=True)))
    run = replace(run, readings=strangers, beacon_ids=names, beacon_truth_m={})
    lines = [line for line in estimate(run, CFG, name).warnings if "could not be placed" in line]
    assert len(lines) == 1
    assert lines[0].startswith("beacons x0, x1, x2, x3, x4, x5, x6, x7 and 12 more could not be placed: ")
