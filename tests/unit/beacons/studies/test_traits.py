"""The study of traits: one small run of each kind of row, and how runs are combined."""

import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.estimation.evaluation import RECKONING
from ccatp.beacons.studies.traits import PLAIN, STUDY, combine_traits, run_trait, trait_cells
from ccatp.studies.campaign import Job, JobOutcome

CFG = load_recordings_config()


def test_an_estimator_is_better_than_dead_reckoning_and_consistent() -> None:
    reckoned = run_trait(Job("traits", {"traits": PLAIN, "estimator": RECKONING}, 1, CFG)).values
    found = run_trait(Job("traits", {"traits": PLAIN, "estimator": "ekf-slam"}, 1, CFG)).values
    assert found["path_m"] < 0.5 * reckoned["path_m"]
    assert "nees" not in reckoned
    assert found["nees"] < 2.0
    assert found["covered"] > 0.9


def test_runs_are_combined_by_the_median_and_the_largest_nees_is_kept() -> None:
    rows = [{"path_m": p, "beacons_m": None, "nees": n, "covered": 0.9, "run_s": 1.0} for p, n in ((1, 1), (2, 5))]
    found = combine_traits({}, [*map(JobOutcome, rows), JobOutcome({"gave_up": True})]).values
    assert (found["path_m"], found["nees"], found["nees_most"], found["gave_up"]) == (1.5, 3.0, 5, 1)
    assert found["beacons_m"] is None
    assert found["each_path_m"] == [1, 2, None]


def test_the_error_without_alignment_is_not_smaller_than_that_after_it() -> None:
    found = run_trait(Job("traits", {"traits": PLAIN, "estimator": RECKONING}, 1, CFG)).values
    assert found["unaligned_m"] > found["path_m"] > 0.0


def test_the_ratio_to_the_peer_is_the_geometric_mean_over_the_runs_that_both_finished() -> None:
    rows = [{"path_m": own, "peer": {"path_m": other}} for own, other in ((2.0, 1.0), (1.0, 2.0), (3.0, None))]
    found = combine_traits({}, [*map(JobOutcome, rows), JobOutcome({"gave_up": True})]).values["ratio"]["path_m"]
    assert found["mean"] == pytest.approx(1.0)
    assert found["band"] == pytest.approx([1.0 / 4.0, 4.0])  # two standard errors, 2 ln 2
    one = combine_traits({}, [JobOutcome(rows[0])]).values["ratio"]["path_m"]
    assert one == {"mean": None, "band": None}


def test_with_peers_each_estimator_stands_beside_one_of_its_kind() -> None:
    assert STUDY.with_peers is not None
    peers = {cell.factors["estimator"]: cell.factors["peer"] for cell in STUDY.with_peers()}
    assert peers["fixed-lag"] == peers["ekf-slam"] == "GTSAM iSAM2"
    assert peers["smoother"] == "GTSAM batch"


def test_each_trait_and_each_pair_is_a_cell() -> None:
    names = {str(cell.factors["traits"]) for cell in trait_cells()}
    assert len(names) == 1 + 9 + 36
    assert {PLAIN, "correlated", "correlated+scale"} <= names


def test_an_unknown_trait_is_refused() -> None:
    with pytest.raises(ValueError, match="no trait 'slow'"):
        run_trait(Job("traits", {"traits": "slow", "estimator": RECKONING}, 0, CFG))


def test_a_peer_that_is_stopped_leaves_the_estimator_its_result() -> None:
    pytest.importorskip("gtsam", reason="the extra peers is not installed")
    short = load_recordings_config(None, {"run.peer_limit_s": 1e-6})
    job = Job("traits", {"traits": PLAIN, "estimator": RECKONING, "peer": "GTSAM iSAM2"}, 1, short)
    outcome = run_trait(job)
    assert outcome.values["path_m"] > 0.0
    assert "peer" not in outcome.values
    found = combine_traits({}, [outcome]).values
    assert (found["gave_up"], found["peer_gave_up"]) == (0, 1)
