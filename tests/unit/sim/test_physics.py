"""The robot with real physics: rest, drives, turns, and what happens where grip is short."""

import sys
from math import radians

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.errors import ConfigError
from ccatp.mirror.mirror import build_mirror
from ccatp.sim.physics import PhysicsHardware

LOOP_HZ, STEP_S = 500.0, 0.002
FULL = (1.0, 1.0)


def robot(mirror: str = "fyst-m1", duty: tuple[float, float] = FULL, **physics: object) -> PhysicsHardware:
    """At base, with fans at a duty."""
    cfg = load_config(
        overrides={"run.mirror": mirror, **{f"sim.physics.{key}": value for key, value in physics.items()}}
    )
    hardware = PhysicsHardware(
        cfg, build_mirror(cfg.mirror), np.random.default_rng(1), loop_hz=LOOP_HZ, counts_per_rev=3575.0
    )
    hardware.command_fans(*duty)
    return hardware


def run(hardware: PhysicsHardware, duration_s: float, right_v: float, left_v: float, from_s: float = 0.0) -> float:
    """Constant voltages; the time after them."""
    for k in range(round(duration_s / STEP_S)):
        hardware.drive(right_v, left_v)
        hardware.read(from_s + (k + 1) * STEP_S)
    return from_s + duration_s


@pytest.mark.parametrize("mirror", ["fyst-m1", "fyst-m2"])
@pytest.mark.parametrize("tyre", ["round", "flat"])
def test_pressed_on_it_stands_still_with_braked_wheels(mirror: str, tyre: str) -> None:
    hardware = robot(mirror, tyre=tyre)
    plant = hardware.plant
    t_s = run(hardware, 0.3, 0.0, 0.0)  # it settles on its tyres
    x, y, heading = plant.x_m, plant.y_m, plant.heading_rad
    angles = plant.right_angle_rad, plant.left_angle_rad
    run(hardware, 0.5, 0.0, 0.0, t_s)
    # Wheels may roll against their brake; the tyres do not slide.
    right, left = plant.right_angle_rad - angles[0], plant.left_angle_rad - angles[1]
    assert np.hypot(plant.x_m - x, plant.y_m - y) == pytest.approx(abs(0.015 * (right + left)), abs=5e-4)
    assert plant.heading_rad - heading == pytest.approx(0.2 * (right - left), abs=5e-3)
    assert not hardware.world.is_fallen


def test_a_drive_goes_where_the_wheels_roll_and_the_heading_where_they_turn_it() -> None:
    hardware = robot()
    plant, t_s = hardware.plant, run(hardware, 0.1, 0.0, 0.0)
    t_s = run(hardware, 1.2, -4.0, 4.0, t_s)  # away from the rim
    t_s = run(hardware, 0.3, 0.0, 0.0, t_s)
    right, left, x, y, heading = plant.right_angle_rad, plant.left_angle_rad, plant.x_m, plant.y_m, plant.heading_rad
    t_s = run(hardware, 0.8, 4.5, 4.5, t_s)
    rolled_m = 0.015 * (plant.right_angle_rad - right + plant.left_angle_rad - left)
    assert rolled_m > 0.03
    assert np.hypot(plant.x_m - x, plant.y_m - y) == pytest.approx(rolled_m, rel=0.02)
    right, left, heading = plant.right_angle_rad, plant.left_angle_rad, plant.heading_rad
    run(hardware, 0.8, 3.5, -3.5, t_s)
    turned_rad = 0.03 * (plant.right_angle_rad - right - plant.left_angle_rad + left) / 0.15
    assert plant.heading_rad - heading == pytest.approx(turned_rad, rel=0.05)
    assert abs(turned_rad) > radians(5.0)


def test_the_inertial_unit_sees_the_turn_and_gravity_is_that_of_the_slope() -> None:
    hardware = robot()
    t_s = run(hardware, 0.3, 0.0, 0.0)
    heading = hardware.plant.heading_rad
    rates = []
    for k in range(300):
        hardware.drive(3.0, -3.0)
        readings = hardware.read(t_s + (k + 1) * STEP_S)
        rates += [wz for _, _, wz in readings.imu]
        gravity = readings.gravity or (0.0, 0.0, 0.0, -1.0)
    assert np.mean(rates) * 0.6 == pytest.approx(hardware.plant.heading_rad - heading, rel=0.1)
    assert gravity[3] < -0.8


def test_without_thrust_it_falls_from_a_mirror_that_overhangs() -> None:
    hardware = robot("fyst-m2", (0.0, 0.0))
    run(hardware, 1.0, 0.0, 0.0)
    assert hardware.world.is_fallen


def test_too_little_friction_slides_down_the_slope() -> None:
    hardware = robot("fyst-m1", (0.0, 0.0), friction=0.2)
    plant = hardware.plant
    x, y = plant.x_m, plant.y_m
    run(hardware, 1.0, 0.0, 0.0)
    assert np.hypot(plant.x_m - x, plant.y_m - y) > 0.05 or hardware.world.is_fallen


def test_the_same_commands_give_the_same_run() -> None:
    ends = []
    for _ in range(2):
        hardware = robot()
        run(hardware, 0.5, 3.0, 1.0)
        ends.append((hardware.plant.x_m, hardware.plant.y_m, hardware.plant.heading_rad))
    assert ends[0] == ends[1]


def test_a_missing_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(
        ConfigError, match=r"^sim.robot.physics = .mujoco.: the package mujoco is not installed; pip inst"
    ):
        robot()
