"""Rows of measurement: values, Jacobians against differences, refusals; the clock of odometry."""

from math import log10, pi

import numpy as np
import pytest

from ccatp.beacons.slam.beacon_map import BearingModel, RangeModel, RobustLoss, RssiModel, SlamSettings
from ccatp.beacons.slam.landmark_init import derivatives, wrapped
from ccatp.beacons.slam.measurement_models import MeasurementError, MeasurementModels, MeasurementRow
from ccatp.beacons.slam.motion import DeadReckoning, DifferentialDrive, DifferentialNoise, Increment, Odometry
from ccatp.beacons.slam.recording import RangeBearingReading, RangeReading, RssiReading
from ccatp.core import FloatArray

TRUST = RobustLoss(5.0, 3.0, 0.0, 1.0, 3, 20, 0.3, 0.3, True)
MOTION = DifferentialDrive(DifferentialNoise(0.05, 0.0, 0.01, 0.0, 0.0, 0.0))
SETTINGS = SlamSettings(
    MOTION, TRUST, RangeModel(0.1, 0.02, 0.1, 0.3), BearingModel(0.05), RssiModel(2.0, -40.0, 3.0, 2.0, 0.3)
)
POSE, CALIBRATION, BEACON = [1.0, 2.0, 0.4], [0.06, -0.1], [4.0, 6.0, -37.0, 2.2]
READINGS: dict[str, RangeReading | RssiReading] = {
    "range": RangeReading(0.0, 1, 5.0),
    "rssi": RssiReading(0.0, 1, -50.0),
}


def row_at(sensors: MeasurementModels, kind: str, x: FloatArray) -> MeasurementRow:
    pose, calibration, beacon = x[:3].tolist(), x[3:5].tolist(), x[5:].tolist()
    if kind == "bearing":
        return sensors.bearing(pose, beacon)
    return sensors.row(READINGS[kind], pose, calibration, beacon[:2] if kind == "range" else beacon)


@pytest.mark.parametrize("kind", ["range", "bearing", "rssi"])
def test_jacobian_of_a_row(kind: str) -> None:
    sensors, x = MeasurementModels(SETTINGS), np.array((*POSE, *CALIBRATION, *BEACON))
    if kind == "range":
        x = x[:7]
    row = row_at(sensors, kind, x)
    differences = [
        (row_at(sensors, kind, x + 1e-6 * e).expected - row_at(sensors, kind, x - 1e-6 * e).expected) / 2e-6
        for e in np.eye(x.size)
    ]
    assert [*row.pose, *row.calibration, *row.beacon] == pytest.approx(differences, abs=1e-7)


def test_values_of_the_rows() -> None:
    sensors, x = MeasurementModels(SETTINGS), np.array((*POSE, *CALIBRATION, *BEACON))
    assert row_at(sensors, "range", x).expected == pytest.approx(1.06 * 5.0 - 0.1)
    assert row_at(sensors, "range", x).variance == pytest.approx(0.1**2 + (0.02 * 5.0) ** 2)
    assert row_at(sensors, "rssi", x).expected == pytest.approx(-37.0 - 22.0 * log10(5.0))
    assert row_at(sensors, "bearing", x).expected == pytest.approx(np.arctan2(4.0, 3.0) - 0.4)


def test_an_angle_goes_the_short_way_round() -> None:
    assert wrapped(pi - 0.1, -pi + 0.1, is_angle=True) == pytest.approx(-0.2)
    assert wrapped(7.0, 0.5, is_angle=False) == 6.5


@pytest.mark.parametrize("kind", ["range", "bearing"])
def test_jacobian_through_the_delay(kind: str) -> None:
    sensors, clock = MeasurementModels(SETTINGS), DeadReckoning(is_delayed=True)
    clock.took(Increment(1.0, 0.5, 0.0, 0.0), np.array((0.7, 1.6, 0.0)), np.array((1.0, 2.0, 0.4)))

    def expected(x: FloatArray) -> MeasurementRow:
        at = clock.at(x[:3].tolist(), 1.1, float(x[5]))
        return row_at(sensors, kind, np.array((*at.pose, *x[3:5], *BEACON[:2])))

    x = np.array((*POSE, *CALIBRATION, 0.15))
    at = clock.at(POSE, 1.1, 0.15)
    found = derivatives(row_at(sensors, kind, np.array((*at.pose, *CALIBRATION, *BEACON[:2]))), at, delayed=True)
    differences = [(expected(x + 1e-6 * e).expected - expected(x - 1e-6 * e).expected) / 2e-6 for e in np.eye(6)]
    assert found == pytest.approx(differences, abs=1e-6)


def test_steps_wait_until_they_are_due() -> None:
    clock = DeadReckoning(is_delayed=True)
    done: list[Odometry] = []
    for k in range(10):
        done += clock.due(Increment(0.1 * (k + 1), 0.1, 0.05, 0.02), 0.25)
    steps = [step for step in done if isinstance(step, Increment)]
    assert sum(step.distance_m for step in steps) == pytest.approx(0.05 * 7.5)
    assert sum(step.turn_rad for step in steps) == pytest.approx(0.02 * 7.5)
    assert done[-1].time_s == pytest.approx(0.75)


def test_a_pose_is_carried_no_further_than_a_step() -> None:
    clock = DeadReckoning(is_delayed=False)
    assert clock.at(POSE, 99.0, 0.0).pose == POSE
    clock.took(Increment(1.0, 0.1, 0.1, 0.0), np.zeros(3), np.array((0.1, 0.0, 0.0)))
    assert clock.at([0.1, 0.0, 0.0], 1.05, 0.0).pose == pytest.approx([0.15, 0.0, 0.0])
    assert clock.at([0.1, 0.0, 0.0], 9.0, 0.0).pose == pytest.approx([0.2, 0.0, 0.0])


def test_a_sensor_that_nobody_described_is_refused() -> None:
    sensors = MeasurementModels(SlamSettings(MOTION, TRUST))
    with pytest.raises(MeasurementError, match=r"no range model: give SlamSettings\.range"):
        sensors.row(RangeReading(0.0, 1, 1.0), POSE, [], [0.0, 0.0])
    with pytest.raises(MeasurementError, match=r"no RSSI model: give SlamSettings\.rssi"):
        sensors.row(RssiReading(0.0, 1, -50.0), POSE, [], [0.0, 0.0])
    with pytest.raises(MeasurementError, match=r"no bearing model: give SlamSettings\.bearing"):
        sensors.bearing(POSE, [0.0, 0.0])
    assert sensors.names == ()
    assert RangeBearingReading(0.0, 1, 1.0, 0.2).bearing_rad == 0.2
