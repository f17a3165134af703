"""Motion models: Jacobians against differences, noise that adds up, calibration, rest."""

from collections.abc import Callable
from math import cos, pi, sin
from typing import Literal

import numpy as np
import pytest

from ccatp.beacons.slam.motion import (
    Ackermann,
    AckermannNoise,
    DifferentialDrive,
    DifferentialNoise,
    Increment,
    Steering,
)
from ccatp.core import FloatArray

NOISE = DifferentialNoise(0.05, 0.03, 0.01, 0.05, 0.002, 0.02, 0.02, 1e-4, 0.1, 0.1, 0.03, 0.03)


def jacobian(of: Callable[[FloatArray], FloatArray], x: FloatArray, step: float = 1e-6) -> FloatArray:
    return np.stack([(of(x + step * e) - of(x - step * e)) / (2.0 * step) for e in np.eye(x.size)], axis=1)


@pytest.mark.parametrize("turn_rad", [0.0, 1e-4, 0.7, -2.0])
@pytest.mark.parametrize("lateral_m", [0.0, 0.2])
def test_jacobian_of_the_differential_drive(turn_rad: float, lateral_m: float) -> None:
    drive, odometry = DifferentialDrive(NOISE), Increment(1.0, 0.5, 0.8, turn_rad, lateral_m)
    x = np.array((1.0, -2.0, 2.5, 0.01, 0.05, -0.04))
    F = drive.step(x, odometry).F.copy()
    assert pytest.approx(jacobian(lambda y: drive.step(y, odometry).mean, x), abs=1e-8) == F


@pytest.mark.parametrize("reference", ["front", "rear"])
def test_jacobian_of_the_ackermann_vehicle(reference: Literal["front", "rear"]) -> None:
    vehicle = Ackermann(0.35, AckermannNoise(0.01, 0.02), reference)
    odometry, x = Steering(1.0, 0.1, 0.4, 0.3), np.array((1.0, 2.0, 0.5))
    assert pytest.approx(jacobian(lambda y: vehicle.step(y, odometry).mean, x), abs=1e-8) == vehicle.step(x, odometry).F
    inputs = np.array((0.4, 0.3))
    L = jacobian(lambda u: vehicle.step(x, Steering(1.0, 0.1, u[0], u[1])).mean, inputs)
    assert pytest.approx(L @ np.diag((1e-4, 4e-4)) @ L.T, abs=1e-12) == vehicle.step(x, odometry).Q


def test_an_arc_ends_where_a_circle_does() -> None:
    drive = DifferentialDrive(DifferentialNoise(0.1, 0.0, 0.0, 0.1, 0.0, 0.0))
    end = drive.step(np.zeros(3), Increment(1.0, 1.0, pi, pi)).mean  # half a circle of radius 1
    assert end == pytest.approx((0.0, 2.0, pi), abs=1e-12)


def test_the_front_axle_goes_where_its_wheel_points() -> None:
    vehicle = Ackermann(0.35, AckermannNoise(0.01, 0.02))
    end = vehicle.step(np.zeros(3), Steering(0.1, 0.1, 0.15, 0.4)).mean
    assert end == pytest.approx((0.015 * cos(0.4), 0.015 * sin(0.4), 0.015 * sin(0.4) / 0.35))


def test_noise_of_a_way_does_not_depend_on_how_often_it_is_told() -> None:
    drive = DifferentialDrive(DifferentialNoise(0.05, 0.0, 0.02, 0.0, 0.01, 0.0))

    def told(steps: int) -> FloatArray:
        x, P = np.zeros(3), np.zeros((3, 3))
        for _ in range(steps):
            x, F, Q = drive.step(x, Increment(0.0, 4.0 / steps, 2.0 / steps, 0.0))
            P = F @ P @ F.T + Q
        return P

    assert told(400) == pytest.approx(told(40), rel=1e-2, abs=1e-9)  # midpoint and limit differ by 1 / steps^2
    assert told(40)[0, 0] == pytest.approx(0.05**2 * 2.0)
    assert told(40)[2, 2] == pytest.approx(0.02**2 * 2.0 + 0.01**2 * 4.0)


def test_noise_is_the_spread_of_steps() -> None:
    drive, rng = DifferentialDrive(DifferentialNoise(0.05, 0.02, 0.02, 0.05, 0.01, 0.04)), np.random.default_rng(3)
    odometry = Increment(1.0, 1.0, 1.0, 0.6)
    var_way, var_turn = 0.05**2 + 0.02**2 * 0.6, 0.02**2 + 0.05**2 * 0.6 + 0.01**2
    noise = np.sqrt((var_way, var_turn, 0.04**2)) * rng.normal(size=(20000, 3))
    x = np.array((0.0, 0.0, 0.4))
    ends = np.array([drive.step(x, Increment(1.0, 1.0, 1.0 + d, 0.6 + t, s)).mean.copy() for d, t, s in noise])
    assert pytest.approx(np.cov(ends.T), abs=2e-4) == drive.step(x, odometry).Q  # a tenth of the variances


def test_a_turn_at_rest_is_the_bias_and_turns_nothing() -> None:
    drive = DifferentialDrive(NOISE)
    x = np.array((1.0, 2.0, 0.3, 0.0, 0.0, 0.0))
    still = Increment(0.1, 0.1, 0.0, -7e-4)
    assert drive.step(x, still).mean == pytest.approx(x)
    shown = drive.at_rest(still)
    assert shown is not None
    assert shown.column == 3
    assert shown.value == pytest.approx(-7e-3)
    assert shown.variance == pytest.approx(0.002**2 / 0.1)
    assert drive.at_rest(Increment(0.1, 0.1, 0.01, -7e-4)) is None


def test_each_vehicle_takes_its_own_odometry() -> None:
    with pytest.raises(TypeError, match="differential drive takes increments, not Steering"):
        DifferentialDrive(NOISE).step(np.zeros(6), Steering(0.1, 0.1, 0.1, 0.1))
    with pytest.raises(TypeError, match="speed and steering angle, not Increment"):
        Ackermann(0.35, AckermannNoise(0.01, 0.02)).step(np.zeros(3), Increment(0.1, 0.1, 0.1, 0.1))
