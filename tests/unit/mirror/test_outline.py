"""Pure. The edges around a place decide distances as the whole outline does."""

from math import hypot, inf, nan

import numpy as np
import pytest

from ccatp.mirror.mirror import Mirror
from ccatp.mirror.rim import NearOutline, Rim


def test_a_part_decides_within_its_disc_as_the_whole(mirror: Mirror) -> None:
    rng = np.random.default_rng(5)
    for _ in range(300):
        x, y = rng.uniform(-4.5, 4.5, 2).tolist()
        radius_m = float(rng.uniform(0.01, 0.8))
        part = mirror.rim.part(x, y, radius_m)
        for _ in range(10):
            dx, dy = (rng.uniform(-1.0, 1.0, 2) * radius_m).tolist()
            if hypot(dx, dy) <= radius_m:
                assert part.signed_distance_m(x + dx, y + dy) == mirror.rim.signed_distance_m(x + dx, y + dy)


def test_a_part_has_few_edges(mirror: Mirror) -> None:
    panel = min(mirror.panels.values(), key=lambda p: p.y_m)
    near = mirror.rim.part(panel.x_m, panel.y_m - panel.half_y_m + 0.1, 0.1)
    assert len(near._upright) + len(near._level) <= 3


def test_ways_along_and_over_the_rim(mirror: Mirror) -> None:
    rng = np.random.default_rng(6)
    near = NearOutline(mirror.rim)
    beyond = 0
    for _ in range(40):
        x, y = rng.uniform(-3.0, 3.0, 2).tolist()  # a jump
        dx, dy = (rng.uniform(-1.0, 1.0, 2) * 0.02).tolist()
        for k in range(100):
            found = near.signed_distance_m(x + k * dx, y + k * dy)
            assert found == mirror.rim.signed_distance_m(x + k * dx, y + k * dy)
            beyond += found < 0.0
    assert 400 < beyond < 3600


def test_a_waist() -> None:
    rim = Rim([(2.0, 0.0, 1.0), (1.0, 1.0, 2.0), (2.0, 2.0, 3.0)])
    near = NearOutline(rim)
    for x in np.linspace(-2.5, 2.5, 41).tolist():
        for y in np.linspace(-0.5, 3.5, 81).tolist():
            assert near.signed_distance_m(x, y) == rim.signed_distance_m(x, y)


@pytest.mark.parametrize(("x", "y"), [(nan, 0.0), (0.0, nan), (nan, nan)])
def test_a_place_that_is_no_number_is_beyond_and_leaves_no_trace(m1: Mirror, x: float, y: float) -> None:
    near = NearOutline(m1.rim)
    assert near.signed_distance_m(x, y) == -inf
    assert near.signed_distance_m(0.1, 0.2) == m1.rim.signed_distance_m(0.1, 0.2)
