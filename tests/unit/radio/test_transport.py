"""A covariance that follows corrections of the map: what nobody tells of the heading stays unknown."""

import numpy as np
import pytest

from ccatp.beacons.slam.beacon_map import HeadingTransport
from ccatp.core import FloatArray
from ccatp.filters.ekf_slam import EkfSlam

QUARTER = np.array(((0.0, -1.0), (1.0, 0.0)))


def a_map(heading_variance: float) -> EkfSlam:
    """A pose at the origin, two places and a wandering error; nothing is unknown but the turn of everything."""
    x = np.array((0.0, 0.0, 0.3, 2.0, 1.0, -1.0, 3.0, 0.1))
    turn = np.array((0.0, 0.0, 1.0, *(QUARTER @ x[3:5]), *(QUARTER @ x[5:7]), 0.0))
    P = heading_variance * np.outer(turn, turn)
    engine = EkfSlam(x[:3], P[:3, :3])
    none = np.empty(0, dtype=np.intp)
    for name, part in (("a", slice(3, 5)), ("b", slice(5, 7)), (("wander", "a"), slice(7, 8))):
        size = part.stop - part.start
        engine.augment(name, x[part], none, np.zeros((size, 0)), np.eye(size), np.eye(size))
    engine.covariance[:] = P
    return engine


def test_a_turn_of_everything_stays_as_unknown_as_it_was() -> None:
    engine = a_map(0.04)
    transport, before = HeadingTransport(engine), engine.mean.copy()
    moved: FloatArray = np.array((0.3, -0.2, 0.1, 0.5, 0.1, -0.4, 0.2, 0.7))
    engine.mean += moved
    transport.follow(before.copy())
    x = engine.mean
    pairs = (x[:2] - before[:2], QUARTER @ (x[3:5] - before[3:5]), QUARTER @ (x[5:7] - before[5:7]))
    turn = np.array(
        (*(QUARTER @ pairs[0]), 1.0, *(QUARTER @ before[3:5] + pairs[1]), *(QUARTER @ before[5:7] + pairs[2]), 0.0)
    )
    assert engine.covariance == pytest.approx(0.04 * np.outer(turn, turn), abs=1e-15)
    assert np.array_equal(engine.covariance, engine.covariance.T)
    bearing = np.zeros(8)  # by pose, heading and the place a, at the new estimate
    dx, dy = x[3:5] - x[:2]
    q = dx * dx + dy * dy
    bearing[:5] = dy / q, -dx / q, -1.0, -dy / q, dx / q
    assert bearing @ engine.covariance @ bearing == pytest.approx(0.0, abs=1e-15)  # no reading tells the turn


def test_what_joined_since_is_left_alone_and_what_left_stops_it() -> None:
    engine = a_map(0.04)
    transport, before = HeadingTransport(engine), engine.mean.copy()
    engine.augment("c", np.array((1.0, 1.0)), np.arange(2), np.eye(2))
    engine.mean[3] += 0.5
    transport.follow(before.copy())
    row = engine.covariance[2]
    assert row[8:10] == pytest.approx(engine.covariance[2, :2])
    assert row[4] == pytest.approx(0.04 * (2.0 + 0.5))
    engine.remove("a")
    engine.remove("b")
    whole = engine.covariance.copy()
    engine.mean[0] += 1.0
    transport.follow(before.copy())
    assert np.array_equal(engine.covariance, whole)
