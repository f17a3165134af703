"""Headers that others write: quantity, unit and beacon of each column, and what is no column of a recording."""

import numpy as np
import pytest

from ccatp.beacons.datasets.headers import column_of


@pytest.mark.parametrize(
    ("header", "quantity", "factor"),
    [
        ("Time (ms)", "time", 1e-3),
        ("timestamp_ns", "time", 1e-9),
        ("header.stamp.sec", "time", 1.0),
        ("header.stamp.nanosec", "fraction", 1e-9),
        ("header_stamp_nsec", None, 0.0),
        ("stamp_nsec", "fraction", 1e-9),
        ("field.header.stamp.nsecs", "fraction", 1e-9),
        ("%time", None, 0.0),
        ("__time", "time", 1.0),
        ("Anchor ID", "beacon", 1.0),
        ("anchor-id", "beacon", 1.0),
        ("field.anchor_id", "beacon", 1.0),
        ("initiator", "tag", 1.0),
        ("Distance [mm]", "range", 1e-3),
        ("range_cm", "range", 1e-2),
        ("range_std", None, 0.0),
        ("pose.pose.position.x", "x", 1.0),
        ("/odom/pose/pose/orientation/w", "qw", 1.0),
        ("pose.covariance.x", None, 0.0),
        ("twist.twist.linear.x", "speed", 1.0),
        ("twist.twist.linear.y", "left", 1.0),
        ("twist.twist.linear.z", None, 0.0),
        ("twist.twist.angular.x", None, 0.0),
        ("angular.z", "rate", 1.0),
        ("speed [km/h]", "speed", 1.0 / 3.6),
        ("speed_m_s", "speed", 1.0),
        ("yaw_rate [rpm]", "rate", np.pi / 30.0),
        ("yaw_deg", "heading", np.pi / 180.0),
        ("position_x_mm", "x", 1e-3),
        ("q_w []", "qw", 1.0),
        ("time [UTC]", "time", 1.0),
        ("range_ns", None, 0.0),
        ("", None, 0.0),
        ("/", None, 0.0),
    ],
)
def test_a_header_names_quantity_and_unit(header: str, quantity: str | None, factor: float) -> None:
    found = column_of(header)
    assert (found.quantity if found else None) == quantity
    if found:
        assert (found.beacon, found.problem) == ("", "")
        assert found.factor == pytest.approx(factor)


@pytest.mark.parametrize(
    ("header", "beacon", "factor"),
    [
        ("range A", "A", 1.0),
        ("dist_A1 [mm]", "A1", 1e-3),
        ("range_B_cm", "B", 1e-2),
        ("range3", "3", 1.0),
        ("Range_door_left", "door_left", 1.0),
    ],
)
def test_a_column_of_one_beacon_has_its_name_as_written(header: str, beacon: str, factor: float) -> None:
    found = column_of(header)
    assert found is not None
    assert (found.quantity, found.beacon) == ("range", beacon)
    assert found.factor == pytest.approx(factor)


@pytest.mark.parametrize(
    ("header", "unit"), [("range [ns]", "ns"), ("time (mm)", "mm"), ("speed [furlong/day]", "furl")]
)
def test_a_unit_of_another_quantity_is_a_problem_and_not_one(header: str, unit: str) -> None:
    found = column_of(header)
    assert found is not None
    assert f"{unit}" in found.problem
    assert np.isnan(found.factor)
