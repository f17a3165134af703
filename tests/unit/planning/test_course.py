"""Pure. Courses in the deck plane and headings in the tangent plane."""

from math import pi
from typing import Any

import pytest

from ccatp.core import DeckPose, difference
from ccatp.survey.planning.legs import course_of_heading, heading_of_course

ROUNDING = 1e-12


@pytest.mark.parametrize("heading", [-3.1, -1.0, 0.0, 0.5, pi / 2.0, 2.0])
def test_there_and_back(heading: float, world: Any) -> None:
    course = course_of_heading(world.mirror, DeckPose(1.5, -2.0, heading))
    assert difference(heading_of_course(world.mirror, 1.5, -2.0, course), heading) == pytest.approx(0.0, abs=ROUNDING)


def test_along_x_both_are_the_same(world: Any) -> None:
    assert heading_of_course(world.mirror, 1.5, -2.0, 0.0) == pytest.approx(0.0, abs=ROUNDING)


def test_they_differ_where_the_mirror_slopes_both_ways(world: Any) -> None:
    mirror = world.mirror
    fx, fy = mirror.surface.gradient(2.0, 2.0)
    # The tangents of the lines x = const and y = const are fx fy off a right angle, to first order.
    assert heading_of_course(mirror, 2.0, 2.0, pi / 2.0) == pytest.approx(pi / 2.0 - fx * fy, abs=2e-5)
