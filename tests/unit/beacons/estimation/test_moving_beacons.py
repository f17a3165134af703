"""Beacons that move: a random walk in the filter, where they were when, and what a kick leaves of the map."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.estimation.evaluation import judge, truth_at
from ccatp.beacons.estimation.recording import EstimatedPath, RecordedRun
from ccatp.beacons.studies.recordings import EstimateError, estimate
from ccatp.core import FloatArray
from tests.unit.beacons.datasets.sets import BEACONS, recorded, world

CFG = load_recordings_config(None, {"csv.radio.range_sigma_m": 0.05})
MOVED = "8"
SECONDS = 120.0


def with_places(seed: int, place_at: Callable[[FloatArray], FloatArray]) -> RecordedRun:
    """A drive on which beacon ``MOVED`` is at a place (n, 2) at each time (n,)."""
    run, rng = recorded(world(seed, SECONDS), bearings=False), np.random.default_rng(500 + seed)
    assert run.truth is not None
    r = run.readings
    rows = r.beacon == run.beacon_ids.index(MOVED)
    at = truth_at(run.truth, r.times_s[rows])[:, :2]
    range_m = r.range_m.copy()
    range_m[rows] = np.hypot(*(place_at(r.times_s[rows]) - at).T) + 0.05 * rng.standard_normal(rows.sum())
    return replace(run, readings=r._replace(range_m=range_m))


def walk(seed: int) -> Callable[[FloatArray], FloatArray]:
    """A random walk of 0.1 m after a second."""
    times_s = np.arange(0.0, SECONDS + 1.0, 0.1)
    steps = 0.1 * np.sqrt(0.1) * np.random.default_rng(seed).standard_normal((times_s.size, 2))
    places = np.cumsum(steps, axis=0) + BEACONS[MOVED]
    return lambda at_s: np.column_stack([np.interp(at_s, times_s, column) for column in places.T])


def kick(at_s: FloatArray) -> FloatArray:
    """Two metres to the right after a minute."""
    return np.asarray(np.array(BEACONS[MOVED]) + np.outer(at_s > 0.5 * SECONDS, (2.0, 0.0)))


def nees_of(track: EstimatedPath, place_at: Callable[[FloatArray], FloatArray]) -> float:
    found = track.tracks[MOVED]
    off = found.places_m - place_at(found.times_s)
    return float(np.mean([e @ np.linalg.solve(P, e) / 2.0 for e, P in zip(off, found.covariances_m2, strict=True)]))


@pytest.mark.parametrize("name", ["ekf-slam", "fixed-lag"])
def test_a_beacon_that_walks_is_followed_consistently_and_the_path_keeps_its_accuracy(name: str) -> None:
    squares, moving_m, standing_m = list[float](), list[float](), list[float]()
    for seed in range(2):
        run = with_places(seed, walk(seed))
        track = estimate(replace(run, moving=(MOVED,)), CFG, name)
        assert MOVED not in track.beacons
        assert track.tracks[MOVED].times_s[-1] > SECONDS - 5.0
        squares.append(nees_of(track, walk(seed)))
        for found, errors in ((track, moving_m), (estimate(run, CFG, name), standing_m)):
            error_m = judge(found, run).trajectory_rmse_m
            assert error_m is not None
            errors.append(error_m)
    assert 0.4 < float(np.mean(squares)) < 2.0
    assert float(np.mean(moving_m)) < float(np.mean(standing_m))


@pytest.mark.parametrize("name", ["ekf-slam", "fixed-lag"])
def test_the_place_of_a_beacon_before_it_was_kicked_is_kept_with_its_time(name: str) -> None:
    track = estimate(with_places(1, kick), CFG, name)
    assert any(f"beacon {MOVED} was placed again" in line for line in track.warnings)
    before = track.tracks[MOVED]
    assert before.times_s.size == 1
    assert 0.5 * SECONDS - 5.0 < before.times_s[0] < 0.5 * SECONDS + 5.0
    np.testing.assert_allclose(before.places_m[0], BEACONS[MOVED], atol=0.3)
    np.testing.assert_allclose(track.beacons[MOVED][:2], (BEACONS[MOVED][0] + 2.0, BEACONS[MOVED][1]), atol=0.3)


def test_without_beacons_that_move_nothing_is_kept() -> None:
    run = recorded(world(2, 40.0), bearings=False)
    assert estimate(run, CFG, "ekf-slam").tracks == {}


def test_the_smoother_refuses_beacons_that_move() -> None:
    run = replace(with_places(1, walk(1)), moving=(MOVED,))
    with pytest.raises(EstimateError, match=r"the smoother has no model of beacons that move \(8\); use ekf-slam or"):
        estimate(run, CFG, "smoother")
