"""Half-wavefront error: the angle of incidence, and sums over panels."""

from math import atan, cos, sqrt

import numpy as np
import pytest

from ccatp.core import PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panel_alignment import (
    PanelWavefront,
    cos_incidence,
    fit_modes,
    gram,
    half_size_m,
    mirror_wavefront,
    panel_wavefront,
    rigid,
)
from tests.unit.aligning.conftest import GRID_M, load

MIDDLE = PanelId(5, 5)


@pytest.mark.parametrize(("name", "angle_rad"), [("fyst-m1", atan(1 / 2)), ("fyst-m2", atan(1 / 3))])
def test_light_meets_the_middle_of_the_mirrors_at_their_inclination(name: str, angle_rad: float) -> None:
    cfg, mirror = load(name)
    # The middle panel of M1 is 35 mm off the axis, where the mirror is curved with 26 m: 1.3 mrad.
    found = cos_incidence(mirror, MIDDLE, cfg.align.light[name])
    assert found == pytest.approx(cos(angle_rad), abs=1e-3)


def test_light_on_m2_comes_from_m1() -> None:
    # Independent: rays along world +z, reflected at the panels of M1 by the law of reflection, and traced to M2.
    _, m1 = load("fyst-m1")
    cfg, m2 = load("fyst-m2")
    hit = 0
    for body in m1.panels.values():
        normal = np.array(m1.rotate_world_from_deck(body.axes[2]))
        ray = np.array([0.0, 0.0, 1.0]) - 2.0 * normal[2] * normal
        start = np.array(m2.deck_from_world(m1.world_from_deck(body.origin)))
        way = np.array(m2.rotate_deck_from_world((float(ray[0]), float(ray[1]), float(ray[2]))))
        x, y, _ = m2.surface.drop((float(start[0]), float(start[1]), float(start[2])), (way[0], way[1], way[2]))
        panel = m2.panel_at(x, y)
        if panel is None:
            continue
        hit += 1
        body2 = m2.panel(panel)
        # Within half a panel the angle changes by up to 0.35 m / 30 m and the slope's 12 mrad.
        assert cos_incidence(m2, panel, cfg.align.light["fyst-m2"]) == pytest.approx(
            -float(way @ np.array(body2.axes[2])), abs=0.012
        )
    assert hit > 60


def test_unknown_light_meets_the_mirror_along_its_normal(m1: Mirror) -> None:
    assert cos_incidence(m1, MIDDLE, None) == 1.0


def test_a_panel_is_larger_than_its_projection(m1: Mirror) -> None:
    body = m1.panel(PanelId(1, 5))
    half_x, half_y = half_size_m(body)
    low, high = (m1.surface_point(body.x_m, body.y_m + s * body.half_y_m) for s in (-1, 1))
    assert 2 * half_y == pytest.approx(float(np.linalg.norm(np.subtract(high, low))), rel=1e-4)
    assert half_x >= body.half_x_m


def test_a_shifted_panel_has_its_shift_times_the_cosine(m1: Mirror) -> None:
    fit = fit_modes(rigid(GRID_M), np.full(9, 20e-6), np.full(9, 1e-9))
    assert fit is not None
    body = m1.panel(MIDDLE)
    found = mirror_wavefront([panel_wavefront(body, 0.9, fit, gram(rigid, half_size_m(body)), np.full(9, 1e-9))])
    assert found is not None
    assert found.before_m == pytest.approx(18e-6, rel=1e-6)
    assert found.before_level_m < 1e-9
    assert found.after_m < 1e-9
    assert found.noise_m == pytest.approx(0.9e-9)


def test_a_tilted_panel_has_the_mean_square_of_a_plane(m1: Mirror) -> None:
    fit = fit_modes(rigid(GRID_M), rigid(GRID_M) @ np.array([0.0, 0.0, 1e-4]), np.full(9, 1e-9))
    assert fit is not None
    body = m1.panel(MIDDLE)
    half = half_size_m(body)
    own = panel_wavefront(body, 1.0, fit, gram(rigid, half), np.full(9, 1e-9))
    assert sqrt(own.fitted_m2) == pytest.approx(1e-4 * half[0] / sqrt(3), rel=1e-9)
    assert own.weight_m2 == pytest.approx(4.0 * half[0] * half[1])


def test_a_panel_weighs_its_area_across_the_beam(m1: Mirror) -> None:
    fit = fit_modes(rigid(GRID_M), np.zeros(9), np.full(9, 1e-9))
    assert fit is not None
    body = m1.panel(MIDDLE)
    weights = [panel_wavefront(body, c, fit, np.eye(3), np.full(9, 1e-9)).weight_m2 for c in (1.0, 0.8)]
    # 0.67 m x 0.75 m in the deck plane.
    assert weights == pytest.approx([0.67 * 0.75, 0.8 * 0.67 * 0.75], rel=1e-3)


def test_panels_count_with_their_area_across_the_beam() -> None:
    one = PanelWavefront(3.0, 4e-12, 1e-12, 0.0, 1e-12, 2e-6)
    two = PanelWavefront(1.0, 16e-12, 1e-12, 0.0, 1e-12, -4e-6)
    found = mirror_wavefront([one, two])
    assert found is not None
    assert found.before_m == pytest.approx(sqrt(7e-12))
    assert found.before_level_m == pytest.approx(sqrt(7e-12 - (0.5e-6) ** 2))
    assert found.after_m == pytest.approx(1e-6)


def test_what_is_unexplained_is_cut_off_over_the_mirror_not_panel_by_panel() -> None:
    def with_unexplained(value: float) -> PanelWavefront:
        return PanelWavefront(1.0, 0.0, 1e-12, value, 1e-12, 0.0)

    balanced = mirror_wavefront([with_unexplained(3e-12), with_unexplained(-3e-12)])
    less = mirror_wavefront([with_unexplained(-3e-12)])
    more = mirror_wavefront([with_unexplained(3e-12)])
    assert balanced is not None
    assert less is not None
    assert more is not None
    assert balanced.after_m == less.after_m == pytest.approx(1e-6)
    assert (more.after_m, more.before_m) == pytest.approx((2e-6, sqrt(3e-12)))


def test_no_panels_have_no_error() -> None:
    assert mirror_wavefront([]) is None
