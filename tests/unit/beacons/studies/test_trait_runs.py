"""Simulated runs with traits: each trait is in the run that has it, and not in a plain one."""

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.estimation.evaluation import truth_at
from ccatp.beacons.estimation.recording import RecordedRun
from ccatp.beacons.studies.trait_runs import TRAITS, trait_run
from ccatp.core import FloatArray

SEED = 3
PLAIN = trait_run((), SEED)


def errors_m(run: RecordedRun) -> FloatArray:
    """Ranges minus true distances in the plane."""
    assert run.truth is not None
    at = truth_at(run.truth, run.readings.times_s)[:, :2]
    places = np.array([run.beacon_truth_m[name] for name in run.beacon_ids])[run.readings.beacon]
    return np.asarray(run.readings.range_m - np.hypot(*(places - at).T))


def lasting(run: RecordedRun) -> float:
    """Correlation of each range error with the next one of the same beacon."""
    off = [errors_m(run)[run.readings.beacon == k] for k in range(len(run.beacon_ids))]
    return float(np.mean([np.corrcoef(e[:-1], e[1:])[0, 1] for e in off]))


def measures(run: RecordedRun) -> dict[str, float]:
    """One number for each trait, which is larger if the run has it."""
    off = errors_m(run)
    spread = [float(np.std(off[run.readings.beacon == k])) for k in range(len(run.beacon_ids))]
    places, lasts = np.array(list(run.beacon_truth_m.values())), np.diff(run.steps.times_s)
    assert run.truth is not None
    path = np.column_stack(run.truth[1:3])
    driven = float(np.hypot(*np.diff(path, axis=0).T).sum())
    measured = float(np.hypot(run.steps.distance_m, run.steps.lateral_m).sum())
    return {
        "correlated": lasting(run),
        "scale": abs(measured / driven - 1.0),
        "outliers": float(np.abs(off).max()),
        "lateral": float(np.abs(run.steps.lateral_m).sum()),
        "heights": float(np.median(off)),
        "reflected": max(spread),
        "single": -float(len(places)),
        "far": float(np.hypot(*(places - path.mean(axis=0)).T).min()),
        "rates": 1.0 / float(np.median(lasts)),
    }


@pytest.mark.parametrize("trait", TRAITS)
def test_a_run_has_its_trait(trait: str) -> None:
    plain, found = measures(PLAIN)[trait], measures(trait_run((trait,), SEED))[trait]
    assert found > plain + 0.5 * abs(plain) + 0.02


def test_equal_arguments_give_equal_runs_and_other_seeds_other_ones() -> None:
    again, other = trait_run((), SEED), trait_run((), SEED + 1)
    assert np.array_equal(PLAIN.readings.range_m, again.readings.range_m)
    assert PLAIN.readings.range_m.size != other.readings.range_m.size or not np.array_equal(
        PLAIN.readings.range_m, other.readings.range_m
    )
    assert np.all(np.diff(PLAIN.readings.times_s) > 0.0)
    assert np.all(np.diff(PLAIN.steps.times_s) > 0.0)


def test_first_poses_differ_from_the_truth_as_their_prior_says() -> None:
    off = []
    for seed in range(40):
        run = trait_run(("single",), seed)
        assert run.truth is not None
        off.append(np.subtract(run.first_pose, [column[0] for column in run.truth[1:]]))
    prior = load_recordings_config().csv.priors
    sigmas = np.array([prior.pose_m, prior.pose_m, prior.heading_rad])
    shares = np.mean(np.square(off / sigmas), axis=0)
    assert np.all((shares > 0.5) & (shares < 1.7))  # chi-square of 40: 0.52 to 1.66 in 99.8 %
