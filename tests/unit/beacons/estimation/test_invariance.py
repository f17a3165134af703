"""The same recording written in another way gives the same result, and a sparse truth the same judgement."""

from dataclasses import replace

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.estimation.evaluation import judge, truth_at
from ccatp.beacons.estimation.recording import RecordedRun, ReferencePath, first_of_each
from ccatp.beacons.studies.recordings import FILTERS, estimate
from ccatp.beacons.studies.trait_runs import trait_run
from tests.support.cases import slow_case

CONFIG = load_recordings_config()
UNTIL_S = 50.0


def short_run() -> RecordedRun:
    run = trait_run(("lateral",), 4)
    count = int(np.searchsorted(run.steps.times_s, UNTIL_S))
    assert run.truth is not None
    kept = run.truth.times_s < UNTIL_S
    return replace(
        run,
        steps=run.steps._replace(
            times_s=run.steps.times_s[: count + 1],
            **{name: getattr(run.steps, name)[:count] for name in ("distance_m", "turn_rad", "lateral_m")},
        ),
        readings=run.readings.where(run.readings.times_s < UNTIL_S),
        truth=ReferencePath(*(column[kept] for column in run.truth)),
    )


RUN = short_run()


def later(run: RecordedRun, by_s: float) -> RecordedRun:
    assert run.truth is not None
    return replace(
        run,
        steps=run.steps._replace(times_s=run.steps.times_s + by_s),
        readings=run.readings._replace(times_s=run.readings.times_s + by_s),
        truth=run.truth._replace(times_s=run.truth.times_s + by_s),
    )


@pytest.mark.parametrize("by_s", [slow_case(1000.0), 1.7e9])
@pytest.mark.parametrize("name", FILTERS)
def test_the_epoch_of_the_times_does_not_matter(name: str, by_s: float) -> None:
    """Times since 1970 are rounded to 2e-7 s. Steps of the odometry lie on the boundaries of the intervals."""
    first = estimate(RUN, CONFIG, name)
    again = estimate(later(RUN, by_s), CONFIG, name)
    assert again.times_s - by_s == pytest.approx(first.times_s, abs=1e-6)
    assert again.poses == pytest.approx(first.poses, abs=1e-4)
    assert again.covariances == pytest.approx(first.covariances, rel=1e-2, abs=1e-7)
    for beacon, fix in first.beacons.items():
        assert again.beacons[beacon][:2] == pytest.approx(fix[:2], abs=1e-4)


def test_a_time_on_a_boundary_is_in_the_interval_that_begins_there() -> None:
    for begin_s in (0.0, 0.3, 1000.0, 1.7e9):
        times_s = np.asarray(begin_s + 0.1 * np.arange(1, 200), dtype=np.float64)
        assert first_of_each(times_s, 0.1).tolist() == list(range(199))
        assert first_of_each(times_s, 0.5).tolist() == list(range(0, 199, 5))


def test_a_sparse_truth_judges_as_a_dense_one_does() -> None:
    """The vehicle turns between its rows, where a line between two of them is up to half a metre off."""
    assert RUN.truth is not None
    track = estimate(RUN, CONFIG, "fixed-lag")
    dense = judge(track, RUN)
    sparse = replace(RUN, truth=ReferencePath(*(column[::30] for column in RUN.truth)))
    assert sparse.truth is not None
    assert (
        np.nanmax(np.hypot(*(truth_at(sparse.truth, RUN.truth.times_s) - np.column_stack(RUN.truth[1:]))[:, :2].T))
        > 0.3
    )
    found = judge(track, sparse)
    assert dense.nees is not None
    assert found.nees is not None
    assert found.nees.mean == pytest.approx(dense.nees.mean, rel=0.5)
    assert found.trajectory_rmse_m == pytest.approx(dense.trajectory_rmse_m, rel=0.3)
    assert found.heading_rmse_rad == pytest.approx(dense.heading_rmse_rad, rel=0.3)


def test_a_sparse_truth_of_another_time_judges_nothing() -> None:
    assert RUN.truth is not None
    track = estimate(RUN, CONFIG, "ekf-slam")
    truth = ReferencePath(*(column[::30] for column in RUN.truth))
    found = judge(track, replace(RUN, truth=truth._replace(times_s=truth.times_s + 1e3)))
    assert found.trajectory_rmse_m is None
    assert found.nees is None


@pytest.mark.parametrize("offset_m", [slow_case(0.0), 0.4])
def test_a_calibration_is_within_its_stated_deviation(offset_m: float) -> None:
    """Even if the readings determine it too little to be taken for other than that of a good instrument."""
    off = []
    for seed in (4, 6):
        run = trait_run((), seed)
        run = replace(run, readings=run.readings._replace(range_m=run.readings.range_m + offset_m))
        assert run.truth is not None
        places_m = np.array([run.beacon_truth_m[name] for name in run.beacon_ids])[run.readings.beacon]
        way_m = np.hypot(*(places_m - truth_at(run.truth, run.readings.times_s)[:, :2]).T)
        _, true_m = np.linalg.lstsq(np.column_stack([way_m, np.ones_like(way_m)]), run.readings.range_m)[0].tolist()
        value, sigma = estimate(run, CONFIG, "fixed-lag").calibration["range_offset_m"]
        assert sigma < CONFIG.csv.priors.range_offset_m
        off.append(abs(value - true_m) / sigma)
    assert max(off) < 4.0
