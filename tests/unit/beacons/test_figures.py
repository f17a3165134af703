"""Whole missions among beacons in virtual time, judged by the truth."""

import numpy as np
import pytest
from scipy.stats import chi2

from ccatp.studies.mote_navigation import BeaconSilResult, rehearse_beacons
from tests.unit.beacons.test_mission import beacon_config, target_distances

pytestmark = pytest.mark.xdist_group("beacon-missions")  # the missions by motes are driven once

SURE = 0.9999  # both tails of a band together miss once in ten thousand


def band(dof: int, sure: float = SURE) -> tuple[float, float]:
    """Where a sum of that many squared standard normals lies."""
    low, high = (float(chi2.ppf(share, dof)) for share in (0.5 - 0.5 * sure, 0.5 + 0.5 * sure))
    return low, high


def nees_at(found: BeaconSilResult, t_s: float) -> float:
    """e^T P^-1 e of the pose in the frame at a time."""
    frame = round(10 * t_s)
    row, true = np.array(found.track[frame], dtype=float), np.array(found.truth[frame][:5], dtype=float)
    P = row[[5, 6, 8, 6, 7, 9, 8, 9, 10]].reshape(3, 3)
    error = row[2:5] - true[2:5]
    return float(error @ np.linalg.solve(P, error))


@pytest.fixture(scope="module")
def by_motes() -> list[BeaconSilResult]:
    return [rehearse_beacons(beacon_config("cricket", run__seed=seed)) for seed in (1, 2)]


def test_radios_are_mapped_and_all_waypoints_visited() -> None:
    summary = rehearse_beacons(beacon_config("zigbee", run__seed=1)).summary
    assert summary["outcome"] == "complete"
    assert summary["waypoints"] == {"total": 8, "reached": 8, "within_3_sigma": 8}
    assert summary["beacons"]["mapped"] == 4
    assert summary["beacons"]["rmse_m"] < 0.30  # 2018: 20 to 30 cm
    assert summary["trajectory_rmse_m"] < summary["dead_reckoning_rmse_m"]


def test_slip_and_drift_are_seen_through() -> None:
    stress = {"sim__vehicle__slip": 0.05, "sim__vehicle__heading_drift_rad_s": 0.0087}
    known = {"odometry__slip_sigma": 0.05, "odometry__heading_drift_sigma_rad_s": 0.01}
    summary = rehearse_beacons(beacon_config("zigbee", **stress, **known)).summary
    assert summary["outcome"] == "complete"
    assert summary["position_error_m"]["rmse"] < 0.5 * summary["dead_reckoning_rmse_m"]


def test_motes_map_themselves_first_and_then_carry_the_robot(by_motes: list[BeaconSilResult]) -> None:
    for found in by_motes:
        states = list(dict.fromkeys(found.states))
        assert states == ["idle", "mapping", "visiting", "done"]  # in the first frame there is no verdict
        assert found.states.count("idle") == 1
        assert set(np.array(found.speeds_m_s)[[state == "mapping" for state in found.states]]) == {0.0}
        summary = found.summary
        assert summary["waypoints"] == {"total": 6, "reached": 6, "within_3_sigma": 6}
        assert summary["map"]["map_expected_m"] <= 0.005  # cricket.phase2.target_rms_m
        assert summary["beacons"]["rmse_m"] < 3 * 0.005
        assert summary["position_error_m"]["rmse"] < 0.02


def test_navigation_by_motes_knows_how_good_it_is(by_motes: list[BeaconSilResult]) -> None:
    times_s = (30.0, 45.0, 60.0, 75.0)  # apart enough: three ranges a frame forget the past within seconds
    low, high = band(3 * len(times_s) * len(by_motes))
    assert low < sum(nees_at(found, t_s) for found in by_motes for t_s in times_s) < high
    for found in by_motes:
        size = found.summary["consistency"]["readings"]
        low, high = band(size)
        assert low < size * found.summary["consistency"]["nis_mean"] < high


def test_the_target_is_followed_at_its_distance_and_the_obstacle_left_alone() -> None:
    for seed in (1, 2):
        cfg = beacon_config("follow", run__seed=seed, mission__follow_s=60.0)
        found = rehearse_beacons(cfg)
        assert found.outcome == "complete"
        assert not found.summary["obstacles"]["touched"]
        distances = target_distances(found)
        assert distances.min() >= cfg.danger.target_m
        assert distances[-200:].mean() < 2.0 * cfg.follow.safe_distance_m


@pytest.mark.slow
def test_fifty_missions_by_motes_are_consistent() -> None:
    runs = [rehearse_beacons(beacon_config("cricket", run__seed=seed)) for seed in range(100, 150)]
    low, high = band(3 * len(runs), 0.95)
    assert low < sum(nees_at(found, 60.0) for found in runs) < high
    reached = sum(found.summary["waypoints"]["within_3_sigma"] for found in runs)
    assert reached >= 0.97 * 6 * len(runs)  # 98.9 % of a plane's errors lie within 3 sigma


@pytest.mark.slow
def test_no_obstacle_is_touched_in_fifty_missions() -> None:
    for seed in range(1, 51):
        assert not rehearse_beacons(beacon_config("follow", run__seed=seed)).summary["obstacles"]["touched"], seed
