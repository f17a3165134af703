"""A turn of the reflector: strongest reading, ties, lost packets, steps."""

from math import pi, radians

import pytest

from ccatp.beacons.slam.reflector import ReflectorScan, ScanResult
from ccatp.core import wrap_pi
from ccatp.sim.radio import Packet

SCAN = ReflectorScan(readings=40, bearing_sigma_rad=radians(18.0), loss_tolerance=0.5)
STEP = radians(9.0)


def turn(levels: dict[int, float], lost: set[int] | None = None, floor_dbm: float = -70.0) -> list[Packet]:
    return [
        Packet("b", wrap_pi(k * STEP), levels.get(k, floor_dbm)) for k in range(40) if lost is None or k not in lost
    ]


def read(packets: list[Packet]) -> ScanResult:
    (result,) = SCAN.results(packets)
    return result


def bearing(packets: list[Packet]) -> float:
    found = read(packets).bearing_rad
    assert found is not None
    return found


def test_bearing_is_that_of_the_strongest() -> None:
    assert bearing(turn({7: -40.0, 8: -45.0, 30: -41.0})) == pytest.approx(7 * STEP)


def test_neighbours_that_tie_give_their_middle_across_the_cut_too() -> None:
    assert bearing(turn({7: -40.0, 8: -40.0})) == pytest.approx(7.5 * STEP)
    assert abs(bearing(turn({20: -40.0, 21: -40.0, 19: -40.0}))) == pytest.approx(pi)


def test_ties_that_lie_apart_give_no_bearing_but_a_level() -> None:
    for levels in ({0: -40.0, 20: -40.0}, {0: -40.0, 12: -40.0}):
        result = read(turn(levels))
        assert result.bearing_rad is None
        assert result.rssi_dbm == -40.0


def test_level_is_the_mean_next_to_the_bearing() -> None:
    result = read(turn({7: -40.0, 6: -42.0, 8: -44.0}))
    assert result.rssi_dbm == pytest.approx(-42.0)
    assert result.readings == 3


def test_lost_packets_are_borne_up_to_the_tolerance() -> None:
    some = read(turn({7: -40.0}, lost=set(range(20, 39))))
    assert some.bearing_rad is not None
    assert some.heard == pytest.approx(21 / 40)
    most = read(turn({7: -40.0}, lost=set(range(10, 31))))
    assert most.bearing_rad is None


def test_variance_of_steps_is_in_the_bearing() -> None:
    assert SCAN.sigma_rad**2 == pytest.approx(radians(18.0) ** 2 + STEP**2 / 12.0)


def test_radios_are_kept_apart_by_their_identifier() -> None:
    both = [*turn({3: -40.0}), *(p._replace(beacon="c") for p in turn({9: -50.0}))]
    assert [(r.beacon, r.rssi_dbm > -65.0) for r in SCAN.results(both)] == [("b", True), ("c", True)]
    assert SCAN.results([]) == []
