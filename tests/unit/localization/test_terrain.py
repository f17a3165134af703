"""Pure. The ground as the localizer knows it, and poses in the frame of the panel under it."""

from math import hypot, sqrt
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from ccatp.core import DeckPose, PanelId, difference
from ccatp.estimation.localizer_base import PanelFrame
from ccatp.estimation.seams import axes_on
from ccatp.estimation.state_model import Slope, Terrain
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.surface import Surface

REACH_M = 5e-3


def places(mirror: Mirror, count: int, seed: int) -> list[tuple[float, float]]:
    """Deck points on the panels."""
    rng = np.random.default_rng(seed)
    panels = list(mirror.panels.values())
    drawn = zip(rng.integers(len(panels), size=count), rng.uniform(-1.0, 1.0, (count, 2)).tolist(), strict=True)
    return [(panels[k].x_m + u * panels[k].half_x_m, panels[k].y_m + v * panels[k].half_y_m) for k, (u, v) in drawn]


def test_slopes_and_height_near_an_evaluated_point(mirror: Mirror) -> None:
    terrain, rng = Terrain(mirror), np.random.default_rng(2)
    away = rng.uniform(-0.999 * REACH_M, 0.999 * REACH_M, (200, 2)).tolist()
    for (x, y), (dx, dy) in zip(places(mirror, 200, 1), away, strict=True):
        terrain.at(x, y)
        assert terrain.height_m(x, y) == mirror.surface.height_m(x, y)
        found, exact = terrain.at(x + dx, y + dy), mirror.surface.gradient(x + dx, y + dy)
        assert found[2:5] == terrain.at(x, y)[2:5]  # carried on, not evaluated
        a, b, c, d = mirror.surface.third(x, y)
        third, r = sqrt(a * a + 3.0 * b * b + 3.0 * c * c + d * d), hypot(dx, dy)  # no direction has more than the norm
        off = hypot(found.fx - exact[0], found.fy - exact[1])
        assert off < 1e-7
        assert off <= 0.5 * third * r * r * 1.02 + 1e-15  # the next term is r = 7 mm over metres of the first
        assert abs(terrain.height_m(x + dx, y + dy) - mirror.surface.height_m(x + dx, y + dy)) < third * r**3 / 5.0


@pytest.mark.parametrize("far", [(2.0, 0.0), (0.0, -2.0), (1.01, 0.0), (0.0, 1.01)])
def test_further_away_the_surface_is_evaluated_again(mirror: Mirror, far: tuple[float, float]) -> None:
    x, y = places(mirror, 1, 5)[0]
    terrain = Terrain(mirror)
    terrain.at(x, y)
    x, y = x + far[0] * REACH_M, y + far[1] * REACH_M
    assert terrain.height_m(x, y) == mirror.surface.height_m(x, y)
    assert terrain.at(x, y)[:5] == mirror.surface.jet(x, y)[1:]


def test_downhill_is_where_gravity_points_along_the_surface(mirror: Mirror) -> None:
    for psi, (x, y) in enumerate(places(mirror, 50, 3)):
        pose = DeckPose(x, y, float(psi))
        along, across, _ = mirror.gravity_in_robot(pose)
        hx, hy, lx, ly = mirror.body_axes(pose)
        length = hypot(along, across)
        slope = Terrain(mirror).at(x, y)
        expected = (along * hx + across * lx) / length, (along * hy + across * ly) / length
        assert (slope.gx, slope.gy) == pytest.approx(expected, abs=1e-14)  # rounding


def test_level_ground_has_no_downhill() -> None:
    flat = SimpleNamespace(surface=Surface(np.zeros((2, 2))), rotate_deck_from_world=lambda v: v)
    assert Terrain(cast(Mirror, flat)).at(0.3, 0.4) == Slope(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_the_robots_axes_are_the_mirrors(mirror: Mirror) -> None:
    for psi, (x, y) in enumerate(places(mirror, 20, 4)):
        expected = mirror.body_axes(DeckPose(x, y, float(psi)))
        assert axes_on(Terrain(mirror).at(x, y), float(psi)) == pytest.approx(expected, abs=1e-15)


# -- the panel's frame ------------------------------------------------------------------------------------------------


def test_a_pose_in_a_panels_frame_is_the_mirrors(mirror: Mirror) -> None:
    for k, (x, y) in enumerate(places(mirror, 50, 6)):
        panel = list(mirror.panels)[7 * k % len(mirror.panels)]  # not the one under the robot
        frame, psi = PanelFrame(mirror, panel), 0.37 * k - 9.0
        found = frame.pose((x, y, psi), mirror.surface.height_m(x, y), Terrain(mirror).at(x, y))
        expected = mirror.panel_pose(panel, DeckPose(x, y, psi))
        assert found.panel == panel
        assert (found.x_m, found.y_m) == pytest.approx((expected.x_m, expected.y_m), abs=1e-14)  # rounding of metres
        assert abs(difference(found.heading_rad, expected.heading_rad)) < 1e-14


def test_a_vector_along_a_panels_axes(mirror: Mirror) -> None:
    frame, panel = PanelFrame(mirror, PanelId(2, 8)), mirror.panel(PanelId(2, 8))
    for k, axis in enumerate(panel.axes[:2]):
        assert frame.along(*axis) == pytest.approx((1.0 - k, float(k)), abs=1e-15)


def test_the_panel_changes_in_the_middle_of_the_gap(mirror: Mirror) -> None:
    here, there = mirror.panel(PanelId(4, 4)), mirror.panel(PanelId(4, 5))
    frame, middle = PanelFrame(mirror, here.id), 0.5 * (here.x_m + there.x_m)
    for x, panel in ((here.x_m, here), (middle - 1e-6, here), (middle + 1e-6, there), (middle - 1e-6, here)):
        frame.hand_over(x, here.y_m)
        assert frame.panel == panel.id
        assert frame.pose(
            (panel.x_m, panel.y_m, 0.0), panel.origin[2], Terrain(mirror).at(panel.x_m, panel.y_m)
        ).x_m == (pytest.approx(0.0, abs=1e-15))


def test_the_panel_changes_along_y_and_far_away(mirror: Mirror) -> None:
    frame = PanelFrame(mirror, PanelId(4, 4))
    for wanted in (PanelId(5, 4), PanelId(2, 6)):
        frame.hand_over(mirror.panel(wanted).x_m, mirror.panel(wanted).y_m)
        assert frame.panel == wanted


def test_beside_the_mirror_the_last_panel_stays(mirror: Mirror) -> None:
    frame = PanelFrame(mirror, PanelId(5, 1))
    frame.hand_over(mirror.panel(PanelId(5, 1)).x_m - 1.0, 0.0)
    assert frame.panel == PanelId(5, 1)
