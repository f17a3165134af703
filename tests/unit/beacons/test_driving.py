"""Driving among beacons, on a vehicle that does what it is told, and whole missions, judged by the truth."""

from math import hypot, pi

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.stats import chi2

from ccatp.beacons.config.models import FuzzyConfig, RadioConfig
from ccatp.beacons.pilot import BackOff, BeaconPilot, FollowState, PilotState, TargetSight
from ccatp.beacons.sim.radio import SimDriveCommand, TruePose, clearance_m, seen_m
from ccatp.beacons.sim.radio_world import TrueVehicle
from ccatp.beacons.steering import HALT, FuzzyGapError, Point, Sugeno
from ccatp.beacons.studies.mote_navigation import BeaconSilResult, rehearse_beacons
from tests.support.scenario import radio_config_of
from tests.unit.beacons.test_mission import target_distances

QUIET = {f"sim__vehicle__{name}": 0.0 for name in ("speed_sigma_m_s", "steer_sigma_rad", "turn_rate_sigma_rad_s")}


def vehicle(cfg: RadioConfig, pose: tuple[float, float, float]) -> TrueVehicle:
    return TrueVehicle(cfg.vehicle, cfg.sim.vehicle, TruePose(*pose), default_rng(0))


@pytest.mark.parametrize("kind", ["ackermann", "differential"])
@pytest.mark.parametrize("mode", ["fuzzy", "pi", "constant"])
def test_a_loop_of_waypoints_is_visited(kind: str, mode: str) -> None:
    cfg = radio_config_of(vehicle__kind=kind, control__speed_mode=mode, workspace__loops=False, **QUIET)
    robot, pilot = vehicle(cfg, (0.8, 0.8, 0.0)), BeaconPilot(cfg)
    for step in range(2000):
        drive = pilot.drive(0.1 * step, 0.1, robot.pose, None, ())
        assert abs(drive.speed_m_s) <= cfg.vehicle.speed_max_m_s
        if pilot.state is PilotState.ARRIVED:
            break
        robot.step(SimDriveCommand(*drive), 0.1)
    assert pilot.waypoints.reached == 4
    assert drive == HALT


def follow(cfg: RadioConfig, start: tuple[float, float, float], path: list[tuple[float, float]]) -> list[float]:
    """Distances while the target goes along a path, a point a step, and then stays."""
    robot, pilot = vehicle(cfg, start), BeaconPilot(cfg)
    found = []
    for step, at_m in enumerate(path):
        drive = pilot.drive(0.1 * step, 0.1, robot.pose, TargetSight(at_m, 0.0, 0.0), ())
        robot.step(SimDriveCommand(*drive), 0.1)
        found.append(hypot(at_m[0] - robot.pose.x_m, at_m[1] - robot.pose.y_m))
    return found


@pytest.mark.parametrize("kind", ["ackermann", "differential"])
def test_a_target_is_approached_to_the_safe_distance_and_no_further(kind: str) -> None:
    cfg = radio_config_of(vehicle__kind=kind, follow__is_active=True, **QUIET)
    distances = follow(cfg, (0.0, 0.0, 0.0), [(2.0, 1.0)] * 600)
    safe_m, band_m = cfg.follow.safe_distance_m, cfg.follow.band_m
    assert safe_m < distances[-1] < safe_m + 2.0 * band_m
    assert min(distances) >= safe_m


def test_a_target_that_comes_nearer_is_backed_off_from() -> None:
    cfg = radio_config_of(follow__is_active=True, **QUIET)
    coming = [(1.0 - 0.002 * k, 0.0) for k in range(400)]  # 2 cm/s towards the robot
    distances = follow(cfg, (0.0, 0.0, 0.0), coming + coming[-1:] * 200)
    assert min(distances) > cfg.follow.safe_distance_m - 0.01  # it backs faster than the target comes, after a start


def test_uncertainty_of_the_target_keeps_the_robot_away() -> None:
    pilot = BeaconPilot(radio_config_of(follow__is_active=True, **QUIET))
    pilot.drive(0.0, 0.1, (0.0, 0.0, 0.0), TargetSight((0.8, 0.0), 0.0, 0.0), ())
    states = [pilot.follower.state]
    for sigma_m, velocity_m_s in ((0.05, 0.0), (0.25, 0.0), (0.0, -0.1)):  # surer; unsure; sure, but it comes
        pilot.drive(0.1, 0.1, (0.0, 0.0, 0.0), TargetSight((0.81, 0.0), sigma_m, 0.0, (velocity_m_s, 0.0)), ())
        states.append(pilot.follower.state)
    approaching, backing = FollowState.APPROACHING, FollowState.BACKING
    assert states == [approaching, approaching, backing, backing]


@pytest.mark.parametrize("target", [None, TargetSight((3.0, 0.0), 0.0, 11.0)])
def test_a_lost_target_stops_the_robot(target: TargetSight | None) -> None:
    pilot = BeaconPilot(radio_config_of(follow__is_active=True, **QUIET))
    assert pilot.drive(0.0, 0.1, (0.0, 0.0, 0.0), target, ()) == HALT
    assert pilot.follower.state is FollowState.LOST


@pytest.mark.parametrize("side", [-0.1, 0.0, 0.1])
def test_an_obstacle_in_the_way_is_gone_round(side: float) -> None:
    obstacle = [{"x_m": 1.5, "y_m": 1.5 + side, "radius_m": 0.15}]
    cfg = radio_config_of(
        avoidance__is_active=True,
        workspace__waypoints_m=[[2.7, 1.5]],
        workspace__loops=False,
        sim__obstacles=obstacle,
        **QUIET,
    )
    robot, pilot = vehicle(cfg, (0.3, 1.5, 0.0)), BeaconPilot(cfg)
    nearest_m, states = 9.0, set()
    for step in range(3000):
        seen = [min(seen_m(robot.pose, a, cfg.sim.obstacles), 3.0) for a in cfg.avoidance.sensors_rad]
        robot.step(SimDriveCommand(*pilot.drive(0.1 * step, 0.1, robot.pose, None, seen)), 0.1)
        nearest_m = min(nearest_m, clearance_m(robot.pose, cfg.sim.obstacles) - cfg.vehicle.radius_m)
        states.add(pilot.state)
        if pilot.state is PilotState.ARRIVED:
            break
    assert pilot.state is PilotState.ARRIVED
    assert PilotState.AVOIDING in states
    assert nearest_m > 0.0


def test_what_stands_too_near_ahead_is_escaped_from_backwards() -> None:
    cfg = radio_config_of(avoidance__is_active=True, workspace__waypoints_m=[[2.7, 1.5]], **QUIET)
    seen = [0.2 if abs(angle) < 0.6 else 3.0 for angle in cfg.avoidance.sensors_rad]
    pilot = BeaconPilot(cfg)
    drive = pilot.drive(0.0, 0.1, (0.3, 1.5, 0.0), None, seen)
    assert drive.speed_m_s < 0.0
    assert pilot.state is PilotState.ESCAPING


def test_nothing_is_backed_into_that_was_seen_before() -> None:
    cfg = radio_config_of(avoidance__is_active=True, follow__is_active=True, **QUIET)
    pilot = BeaconPilot(cfg)
    all_round = [0.3] * len(cfg.avoidance.sensors_rad)
    pilot.drive(0.0, 0.1, (0.0, 0.0, pi), None, all_round)  # looks back
    drive = pilot.drive(0.1, 0.1, (0.0, 0.0, 0.0), TargetSight((0.3, 0.0), 0.0, 0.0), [3.0] * len(all_round))
    assert pilot.follower.state is FollowState.BACKING
    assert drive.speed_m_s == 0.0


def two_terms(rules: list[dict[str, object]]) -> FuzzyConfig:
    terms = {"low": (-1.0, -1.0, 0.0, 1.0), "high": (0.0, 1.0, 9.0, 9.0)}
    inputs = {"a": {"terms": terms}, "b": {"terms": terms}}
    return FuzzyConfig.model_validate({"inputs": inputs, "outputs": {"slow": 1.0, "fast": 3.0}, "rules": rules})


FULL: list[dict[str, object]] = [
    {"when": {"a": "low"}, "then": "slow"},
    {"when": {"a": "high", "b": "low"}, "then": "fast"},
    {"when": {"a": "high", "b": "high"}, "then": "slow"},
]


@pytest.mark.parametrize(
    ("values", "output"),
    [
        ((0.0, 0.5), 1.0),  # one rule alone
        ((1.0, 0.0), 3.0),
        ((0.25, 0.4), 0.75 * 1.0 + 0.15 * 3.0 + 0.10 * 1.0),  # weights 0.75, 0.25 * 0.6, 0.25 * 0.4
        ((50.0, -50.0), 3.0),  # beyond its last shoulder an input counts as there
    ],
)
def test_output_is_the_mean_weighted_by_products(values: tuple[float, float], output: float) -> None:
    assert Sugeno(two_terms(FULL)).evaluate(values) == pytest.approx(output)


def test_rules_with_a_gap_are_refused() -> None:
    with pytest.raises(FuzzyGapError, match="no rule of the fuzzy controller fires at a = 1, b = 1; add a rule"):
        Sugeno(two_terms(FULL[:2]))


STILL = (0.0, 0.0)
POSE = (1.5, 1.5, 0.0)


@pytest.mark.parametrize("kind", ["ackermann", "differential"])
def test_it_goes_straight_away_where_nothing_stands(kind: str) -> None:
    retreat = BackOff(radio_config_of("follow", vehicle__kind=kind))
    ahead = retreat.drive(POSE, (2.0, 1.5), STILL, ())
    assert ahead.speed_m_s == -0.05
    assert (ahead.steer_rad, ahead.turn_rate_rad_s) == (0.0, 0.0)
    assert retreat.drive(POSE, (1.0, 1.5), STILL, ()).speed_m_s == 0.05


WALL = [(1.1, 1.5 + 0.1 * k) for k in range(-6, 7)]  # 0.4 m behind
RING = [(1.5 + 0.36 * x, 1.5 + 0.36 * y) for x, y in ((1, 0), (0.7, 0.7), (0, 1), (-0.7, 0.7), (-1, 0))]
RING += [(1.5 - 0.25, 1.5 - 0.25), (1.5, 1.14), (1.75, 1.25)]


@pytest.mark.parametrize(
    ("pose", "threat", "velocity", "obstacles", "signs"),
    [
        (POSE, (1.5, 2.0), (0.08, 0.0), [], {-1}),  # where the target goes counts
        (POSE, (1.5, 2.0), (-0.08, 0.0), [], {1}),
        (POSE, (2.0, 1.2), STILL, WALL, {1}),  # past the target, not into the wall
        (POSE, (1.9, 1.5), STILL, [(1.2, 1.5)], {0, 1}),  # nearer than stop_m already
        (POSE, (2.1, 1.5), STILL, RING, {0}),  # no way is free
        ((0.0, 1.5, 0.0), (0.7, 1.5), STILL, [], {0, 1}),  # at the wall of the room
    ],
)
def test_ways_to_back_off(
    pose: tuple[float, float, float], threat: Point, velocity: Point, obstacles: list[Point], signs: set[int]
) -> None:
    speed_m_s = BackOff(radio_config_of("follow")).drive(pose, threat, velocity, obstacles).speed_m_s
    assert (speed_m_s > 0.0) - (speed_m_s < 0.0) in signs


@pytest.mark.parametrize("kind", ["ackermann", "differential"])
def test_a_robot_between_an_obstacle_and_a_target_that_comes_gets_out(kind: str) -> None:
    """Backing off straight alone, it stood at the obstacle until the target was 0.23 m away."""
    cfg = radio_config_of("follow", vehicle__kind=kind, **QUIET)
    robot = vehicle(cfg, (2.15, 1.5, 0.4))
    pilot, distances, clearances = BeaconPilot(cfg), [], []
    x, y = 2.75, 1.8
    for step in range(400):
        dx, dy = robot.pose.x_m - x, robot.pose.y_m - y
        d = hypot(dx, dy)
        vx, vy = (0.03 * dx / d, 0.03 * dy / d) if step < 250 else (0.0, 0.0)
        x, y = x + 0.1 * vx, y + 0.1 * vy
        seen = [min(seen_m(robot.pose, a, cfg.sim.obstacles), 3.0) for a in cfg.avoidance.sensors_rad]
        drive = pilot.drive(0.1 * step, 0.1, robot.pose, TargetSight((x, y), 0.0, 0.0, (vx, vy)), seen)
        robot.step(SimDriveCommand(*drive), 0.1)
        distances.append(d)
        clearances.append(clearance_m(robot.pose, cfg.sim.obstacles) - cfg.vehicle.radius_m)
    assert min(distances) > 0.45
    assert min(clearances) > 0.03
    assert abs(robot.pose.heading_rad) < 2.0 * pi


# -- whole missions in virtual time, judged by the truth ---------------------------------------------------------------

MISSIONS = pytest.mark.xdist_group("beacon-missions")  # the missions by motes are driven once

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
    return [rehearse_beacons(radio_config_of("cricket", run__seed=seed)) for seed in (1, 2)]


@MISSIONS
def test_radios_are_mapped_and_all_waypoints_visited() -> None:
    summary = rehearse_beacons(radio_config_of("zigbee", run__seed=1)).summary
    assert summary["outcome"] == "complete"
    assert summary["waypoints"] == {"total": 8, "reached": 8, "within_3_sigma": 8}
    assert summary["beacons"]["mapped"] == 4
    assert summary["beacons"]["rmse_m"] < 0.30  # 2018: 20 to 30 cm
    assert summary["trajectory_rmse_m"] < summary["dead_reckoning_rmse_m"]


@MISSIONS
def test_slip_and_drift_are_seen_through() -> None:
    stress = {"sim__vehicle__slip": 0.05, "sim__vehicle__heading_drift_rad_s": 0.0087}
    known = {"odometry__slip_sigma": 0.05, "odometry__heading_drift_sigma_rad_s": 0.01}
    summary = rehearse_beacons(radio_config_of("zigbee", **stress, **known)).summary
    assert summary["outcome"] == "complete"
    assert summary["position_error_m"]["rmse"] < 0.5 * summary["dead_reckoning_rmse_m"]


@MISSIONS
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


@MISSIONS
def test_navigation_by_motes_knows_how_good_it_is(by_motes: list[BeaconSilResult]) -> None:
    times_s = (30.0, 45.0, 60.0, 75.0)  # apart enough: three ranges a frame forget the past within seconds
    low, high = band(3 * len(times_s) * len(by_motes))
    assert low < sum(nees_at(found, t_s) for found in by_motes for t_s in times_s) < high
    for found in by_motes:
        size = found.summary["consistency"]["readings"]
        low, high = band(size)
        assert low < size * found.summary["consistency"]["nis_mean"] < high


@MISSIONS
def test_the_target_is_followed_at_its_distance_and_the_obstacle_left_alone() -> None:
    for seed in (1, 2):
        cfg = radio_config_of("follow", run__seed=seed, mission__follow_s=60.0)
        found = rehearse_beacons(cfg)
        assert found.outcome == "complete"
        assert not found.summary["obstacles"]["touched"]
        distances = target_distances(found)
        assert distances.min() >= cfg.danger.target_m
        assert distances[-200:].mean() < 2.0 * cfg.follow.safe_distance_m


@MISSIONS
@pytest.mark.slow
def test_fifty_missions_by_motes_are_consistent() -> None:
    runs = [rehearse_beacons(radio_config_of("cricket", run__seed=seed)) for seed in range(100, 150)]
    low, high = band(3 * len(runs), 0.95)
    assert low < sum(nees_at(found, 60.0) for found in runs) < high
    reached = sum(found.summary["waypoints"]["within_3_sigma"] for found in runs)
    assert reached >= 0.97 * 6 * len(runs)  # 98.9 % of a plane's errors lie within 3 sigma


@MISSIONS
@pytest.mark.slow
def test_no_obstacle_is_touched_in_fifty_missions() -> None:
    for seed in range(1, 51):
        assert not rehearse_beacons(radio_config_of("follow", run__seed=seed)).summary["obstacles"]["touched"], seed
