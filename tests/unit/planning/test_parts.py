"""Long legs in parts."""

from itertools import pairwise
from math import hypot

import pytest

from ccatp.core import PointId, Stop, StopKind
from ccatp.survey.planning.legs import in_parts

STOP = Stop(0.7, 0.0, StopKind.MEASURE, PointId(1, 2, 3), True)


def test_a_short_leg_stays_whole() -> None:
    assert in_parts(0.35, 0.0, STOP, 0.36) == [STOP]
    assert in_parts(0.7, 0.0, STOP, 0.36) == [STOP]


@pytest.mark.parametrize("longest_m", [0.36, 0.2, 0.05])
def test_a_long_leg_has_equal_parts_in_the_same_direction(longest_m: float) -> None:
    parts = in_parts(0.0, 0.1, STOP, longest_m)
    assert parts[-1] is STOP
    assert all((part.kind, part.point, part.reverse) == (StopKind.VIA, None, True) for part in parts[:-1])
    places = [(0.0, 0.1), *((part.x_m, part.y_m) for part in parts)]
    lengths = [hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(places)]
    assert max(lengths) <= longest_m < 2.0 * max(lengths)
    assert max(lengths) - min(lengths) < 1e-12
    assert sum(lengths) == pytest.approx(hypot(0.7, 0.1))
