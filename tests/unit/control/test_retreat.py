"""Getting away from a target: where to, with what stands about, and when to stand."""

from math import hypot, pi

import pytest
from numpy.random import default_rng

from ccatp.beacons.pilot import BackOff, BeaconPilot, TargetSight
from ccatp.beacons.steering import HALT
from ccatp.config.beacon_models import RadioConfig
from ccatp.config.load import load_radio_config
from ccatp.sim.radio import SimDriveCommand, TruePose, clearance_m, seen_m
from ccatp.sim.radio_world import TrueVehicle

STILL = (0.0, 0.0)
POSE = (1.5, 1.5, 0.0)


def config(**keys: object) -> RadioConfig:
    return load_radio_config(None, {"system": "follow", **{k.replace("__", "."): v for k, v in keys.items()}})


@pytest.mark.parametrize("kind", ["ackermann", "differential"])
def test_it_goes_straight_away_where_nothing_stands(kind: str) -> None:
    retreat = BackOff(config(vehicle__kind=kind))
    ahead = retreat.drive(POSE, (2.0, 1.5), STILL, ())
    assert ahead.speed_m_s == -0.05
    assert (ahead.steer_rad, ahead.turn_rate_rad_s) == (0.0, 0.0)
    assert retreat.drive(POSE, (1.0, 1.5), STILL, ()).speed_m_s == 0.05


def test_where_the_target_goes_counts() -> None:
    beside = (1.5, 2.0)
    assert BackOff(config()).drive(POSE, beside, (0.08, 0.0), ()).speed_m_s < 0.0
    assert BackOff(config()).drive(POSE, beside, (-0.08, 0.0), ()).speed_m_s > 0.0


def test_what_stands_behind_is_not_touched_and_what_is_too_near_is_left() -> None:
    cfg = config()
    wall = [(1.1, 1.5 + 0.1 * k) for k in range(-6, 7)]  # 0.4 m behind
    drive = BackOff(cfg).drive(POSE, (2.0, 1.2), STILL, wall)
    assert drive.speed_m_s > 0.0  # past the target
    touching = BackOff(cfg).drive(POSE, (1.9, 1.5), STILL, [(1.2, 1.5)])  # nearer than stop_m already
    assert touching.speed_m_s >= 0.0


def test_it_stands_where_no_way_is_free_and_at_the_wall_of_the_room() -> None:
    ring = [(1.5 + 0.36 * x, 1.5 + 0.36 * y) for x, y in ((1, 0), (0.7, 0.7), (0, 1), (-0.7, 0.7), (-1, 0))]
    ring += [(1.5 - 0.25, 1.5 - 0.25), (1.5, 1.14), (1.75, 1.25)]
    assert BackOff(config()).drive(POSE, (2.1, 1.5), STILL, ring) == HALT
    assert BackOff(config()).drive((0.0, 1.5, 0.0), (0.7, 1.5), STILL, ()).speed_m_s >= 0.0


@pytest.mark.parametrize("kind", ["ackermann", "differential"])
def test_a_robot_between_an_obstacle_and_a_target_that_comes_gets_out(kind: str) -> None:
    """Backing off straight alone, it stood at the obstacle until the target was 0.23 m away."""
    quiet = {f"sim.vehicle.{name}": 0.0 for name in ("speed_sigma_m_s", "steer_sigma_rad", "turn_rate_sigma_rad_s")}
    cfg = config(vehicle__kind=kind, **quiet)
    robot = TrueVehicle(cfg.vehicle, cfg.sim.vehicle, TruePose(2.15, 1.5, 0.4), default_rng(0))
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
