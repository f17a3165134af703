"""Pure. The way home: its stops, the first move away from the rim, refusals."""

from itertools import pairwise
from math import hypot, nan, pi
from typing import Any

import pytest

from ccatp.core import DeckPose, Stop, StopKind
from ccatp.survey.planning.legs import OutsideMirrorError, UnreachablePointError
from ccatp.survey.planning.way_home import plan_way_home


def go(world: Any, start: DeckPose, base: DeckPose | None = None) -> tuple[Stop, ...]:
    cfg = world.cfg
    return plan_way_home(world.mirror, start, base or world.mirror.base_pose, cfg.robot, cfg.limits, cfg.mission)


def test_ends_at_base_with_its_heading(world: Any) -> None:
    base = world.mirror.base_pose
    stops = go(world, DeckPose(0.3, 0.4, 1.0))
    assert (stops[-1].x_m, stops[-1].y_m, stops[-1].heading_rad) == (base.x_m, base.y_m, base.heading_rad)
    assert [stop.kind for stop in stops] == [StopKind.VIA] * (len(stops) - 1) + [StopKind.BASE]


def test_is_a_series_of_waypoints_about_one_per_panel(thesis: Any) -> None:
    start = DeckPose(2.0, 2.0, 0.0)
    ends = [(start.x_m, start.y_m), *((stop.x_m, stop.y_m) for stop in go(thesis, start))]
    legs = [hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(ends)]
    assert max(legs) <= 0.75 + 1e-9
    base = thesis.mirror.base_pose
    assert sum(legs) == pytest.approx(hypot(base.x_m - 2.0, base.y_m - 2.0))  # nothing in the way


def test_goes_around_stepped_corners(thesis: Any) -> None:
    start = DeckPose(-3.5, -1.7, 0.0)  # row 3, left of the rows below
    ends = [(start.x_m, start.y_m), *((stop.x_m, stop.y_m) for stop in go(thesis, start))]
    base = thesis.mirror.base_pose
    assert thesis.mirror.rim.segment_clearance_m(start.x_m, start.y_m, base.x_m, base.y_m) < 0.1
    assert all(thesis.mirror.rim.segment_clearance_m(*a, *b) >= 0.1 for a, b in pairwise(ends))


@pytest.mark.parametrize("heading", [0.0, pi / 2.0, pi, -pi / 2.0])
def test_leaves_the_rim_without_sweeping_it(heading: float, thesis: Any) -> None:
    first = go(thesis, DeckPose(3.625, 0.0, heading))[0]  # 110 mm from the right rim
    assert first.x_m < 3.625
    assert thesis.mirror.rim.signed_distance_m(first.x_m, first.y_m) > 0.1323
    if heading in {0.0, pi}:  # straight back, or straight ahead
        assert first.y_m == pytest.approx(0.0, abs=0.002)  # the surface turns headings by some mrad
        assert first.reverse == (heading == 0.0)


def test_out_of_a_corner_in_reverse(thesis: Any) -> None:
    mirror = thesis.mirror
    first = go(thesis, DeckPose(2.30, -3.28, -pi / 4.0))[0]  # facing the lower right corner, 75 mm from both sides
    assert first.reverse
    assert first.y_m + 3.28 == pytest.approx(2.30 - first.x_m, abs=1e-3)  # straight back along the diagonal
    assert mirror.rim.signed_distance_m(first.x_m, first.y_m) > 0.1323


def test_from_base_to_base(thesis: Any) -> None:
    base = thesis.mirror.base_pose
    assert go(thesis, base)[-1].kind is StopKind.BASE
    assert len(go(thesis, base)) == 1


def test_base_near_the_rim_is_entered_the_way_that_allows_its_heading(thesis: Any) -> None:
    base = DeckPose(3.62, 0.0, pi / 2.0)  # 115 mm from the right rim, along it
    stops = go(thesis, DeckPose(1.0, 0.5, 0.0), base)
    assert stops[-1].heading_rad == base.heading_rad
    dx, dy = stops[-1].x_m - stops[-2].x_m, stops[-1].y_m - stops[-2].y_m
    assert abs(dy) > 3.0 * abs(dx)  # along the rim: from straight inward the last turn would sweep it


@pytest.mark.parametrize(("x", "y"), [(9.0, 0.0), (3.4, 3.4), (nan, 0.0)])
def test_start_beyond_the_rim(x: float, y: float, thesis: Any) -> None:
    with pytest.raises(OutsideMirrorError, match=r"no way home from .* beyond the rim of thesis-m1"):
        go(thesis, DeckPose(x, y, 0.0))


def test_base_in_the_clearance(thesis: Any) -> None:
    with pytest.raises(
        UnreachablePointError, match=r"no safe way to base at \(3\.700, 0\.000\) m, 0\.035 m from the rim"
    ):
        go(thesis, DeckPose(0.0, 0.0, 0.0), DeckPose(3.7, 0.0, 0.0))


def test_mirror_too_small_to_turn_on(small: Any) -> None:
    with pytest.raises(UnreachablePointError, match=r"no place to turn within 0\.4 m of .* 0\.1\d\d m from the rim"):
        go(small, small.mirror.base_pose)
