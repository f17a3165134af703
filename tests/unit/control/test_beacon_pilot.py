"""Driving among beacons, on a vehicle that does what it is told: arrives, follows, keeps away, goes round."""

from math import cos, hypot, pi, sin

import pytest
from numpy.random import default_rng

from ccatp.beacons.pilot import BeaconPilot, FollowState, PilotState, TargetSight
from ccatp.beacons.steering import HALT, BearingToPoint, WaypointList, WaypointSteering, aim_at
from ccatp.config.beacon_models import RadioConfig
from ccatp.config.load import load_radio_config
from ccatp.sim.radio import SimDriveCommand, TruePose, clearance_m, seen_m
from ccatp.sim.radio_world import TrueVehicle

QUIET = {f"sim.vehicle.{name}": 0.0 for name in ("speed_sigma_m_s", "steer_sigma_rad", "turn_rate_sigma_rad_s")}


def config(**keys: object) -> RadioConfig:
    return load_radio_config(None, {**QUIET, **{name.replace("__", "."): value for name, value in keys.items()}})


def vehicle(cfg: RadioConfig, pose: tuple[float, float, float]) -> TrueVehicle:
    return TrueVehicle(cfg.vehicle, cfg.sim.vehicle, TruePose(*pose), default_rng(0))


@pytest.mark.parametrize("kind", ["ackermann", "differential"])
@pytest.mark.parametrize("mode", ["fuzzy", "pi", "constant"])
def test_a_loop_of_waypoints_is_visited(kind: str, mode: str) -> None:
    cfg = config(vehicle__kind=kind, control__speed_mode=mode, workspace__loops=False)
    robot, pilot = vehicle(cfg, (0.8, 0.8, 0.0)), BeaconPilot(cfg)
    for step in range(2000):
        drive = pilot.drive(0.1 * step, 0.1, robot.pose, None, ())
        assert abs(drive.speed_m_s) <= cfg.vehicle.speed_max_m_s
        if pilot.state is PilotState.ARRIVED:
            break
        robot.step(SimDriveCommand(*drive), 0.1)
    assert pilot.waypoints.reached == 4
    assert drive == HALT


def test_steering_is_proportional_and_limited() -> None:
    cfg = config()
    driver = WaypointSteering(cfg.control, cfg.vehicle)
    assert driver.drive(BearingToPoint(1.0, 0.2), 0.1).steer_rad == pytest.approx(1.2 * 0.2)
    assert driver.drive(BearingToPoint(1.0, -2.0), 0.1).steer_rad == -cfg.vehicle.steer_max_rad


def test_aim_is_seen_from_the_heading() -> None:
    aim = aim_at((1.0, 1.0, pi / 2), (1.0, 3.0))
    assert aim.distance_m == pytest.approx(2.0)
    assert aim.error_rad == pytest.approx(0.0)
    assert aim_at((0.0, 0.0, 0.0), (0.0, 1.0)).error_rad == pytest.approx(pi / 2)


def test_waypoints_begin_again_only_where_they_loop() -> None:
    once = WaypointList([(0.0, 0.0)], 0.1, loops=False)
    assert once.visit((0.0, 0.0, 0.0)) is None
    again = WaypointList([(0.0, 0.0), (1.0, 0.0)], 0.1, loops=True)
    assert again.visit((0.0, 0.0, 0.0)) == (1.0, 0.0)
    assert again.visit((1.0, 0.0, 0.0)) == (0.0, 0.0)


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
    cfg = config(vehicle__kind=kind, follow__is_active=True)
    distances = follow(cfg, (0.0, 0.0, 0.0), [(2.0, 1.0)] * 600)
    safe_m, band_m = cfg.follow.safe_distance_m, cfg.follow.band_m
    assert safe_m < distances[-1] < safe_m + 2.0 * band_m
    assert min(distances) >= safe_m


def test_a_target_that_comes_nearer_is_backed_off_from() -> None:
    cfg = config(follow__is_active=True)
    coming = [(1.0 - 0.002 * k, 0.0) for k in range(400)]  # 2 cm/s towards the robot
    distances = follow(cfg, (0.0, 0.0, 0.0), coming + coming[-1:] * 200)
    assert min(distances) > cfg.follow.safe_distance_m - 0.01  # it backs faster than the target comes, after a start


def test_uncertainty_of_the_target_keeps_the_robot_away() -> None:
    pilot = BeaconPilot(config(follow__is_active=True))
    pilot.drive(0.0, 0.1, (0.0, 0.0, 0.0), TargetSight((0.8, 0.0), 0.0, 0.0), ())
    states = [pilot.follower.state]
    for sigma_m, velocity_m_s in ((0.05, 0.0), (0.25, 0.0), (0.0, -0.1)):  # surer; unsure; sure, but it comes
        pilot.drive(0.1, 0.1, (0.0, 0.0, 0.0), TargetSight((0.81, 0.0), sigma_m, 0.0, (velocity_m_s, 0.0)), ())
        states.append(pilot.follower.state)
    approaching, backing = FollowState.APPROACHING, FollowState.BACKING
    assert states == [approaching, approaching, backing, backing]


def test_who_knows_nothing_of_the_target_goes_there_all_the_same() -> None:
    pilot = BeaconPilot(config(follow__is_active=True))
    pilot.drive(0.0, 0.1, (0.0, 0.0, 0.0), TargetSight((2.5, 0.0), 3.0, 0.0), ())
    assert pilot.follower.state is FollowState.APPROACHING


@pytest.mark.parametrize("target", [None, TargetSight((3.0, 0.0), 0.0, 11.0)])
def test_a_lost_target_stops_the_robot(target: TargetSight | None) -> None:
    pilot = BeaconPilot(config(follow__is_active=True))
    assert pilot.drive(0.0, 0.1, (0.0, 0.0, 0.0), target, ()) == HALT
    assert pilot.follower.state is FollowState.LOST


@pytest.mark.parametrize("side", [-0.1, 0.0, 0.1])
def test_an_obstacle_in_the_way_is_gone_round(side: float) -> None:
    obstacle = [{"x_m": 1.5, "y_m": 1.5 + side, "radius_m": 0.15}]
    cfg = config(
        avoidance__is_active=True, workspace__waypoints_m=[[2.7, 1.5]], workspace__loops=False, sim__obstacles=obstacle
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
    cfg = config(avoidance__is_active=True, workspace__waypoints_m=[[2.7, 1.5]])
    seen = [0.2 if abs(angle) < 0.6 else 3.0 for angle in cfg.avoidance.sensors_rad]
    pilot = BeaconPilot(cfg)
    drive = pilot.drive(0.0, 0.1, (0.3, 1.5, 0.0), None, seen)
    assert drive.speed_m_s < 0.0
    assert pilot.state is PilotState.ESCAPING


def test_nothing_is_backed_into_that_was_seen_before() -> None:
    cfg = config(avoidance__is_active=True, follow__is_active=True)
    pilot = BeaconPilot(cfg)
    all_round = [0.3] * len(cfg.avoidance.sensors_rad)
    pilot.drive(0.0, 0.1, (0.0, 0.0, pi), None, all_round)  # looks back
    drive = pilot.drive(0.1, 0.1, (0.0, 0.0, 0.0), TargetSight((0.3, 0.0), 0.0, 0.0), [3.0] * len(all_round))
    assert pilot.follower.state is FollowState.BACKING
    assert drive.speed_m_s == 0.0


def test_backing_off_turns_the_vehicle_towards_the_target() -> None:
    for kind in ("ackermann", "differential"):
        cfg = config(vehicle__kind=kind)
        robot = vehicle(cfg, (0.0, 0.0, 0.0))
        before = aim_at(robot.pose, (cos(0.5), sin(0.5))).error_rad
        for _ in range(20):
            robot.step(SimDriveCommand(*WaypointSteering(cfg.control, cfg.vehicle).away(0.1, before)), 0.1)
        assert robot.pose.heading_rad > 0.0
