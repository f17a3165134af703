"""Deviations: where the puck stood, along the normal there, as uncertain as the fix along it."""

from dataclasses import replace

import numpy as np
import pytest

from ccatp.core import DeckPose, Fix, PanelId, PointId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.misalignment import PanelMisalignment, misaligned_puck_world
from ccatp.mirror.panel_alignment import Measured, deviations_of
from ccatp.mirror.surface import UnknownPanelError
from tests.unit.aligning.conftest import HEIGHT_M, exact_fix

PANEL = PanelId(1, 2)
SHIFTED = PanelMisalignment(30e-6, 0.0, 0.0)


def test_the_surface_counts_where_the_puck_stood(m1: Mirror) -> None:
    x, y = m1.point_on_deck(PointId(1, 2, 9))
    puck = misaligned_puck_world(m1, PANEL, SHIFTED, DeckPose(x + 8e-3, y - 6e-3, 0.0), HEIGHT_M)
    one = exact_fix(m1, PointId(1, 2, 9), SHIFTED)
    found = deviations_of(m1, PANEL, [Measured(one.point, replace(one.fix, position_m=puck))], HEIGHT_M, 0.0)
    # The mirror's slope against the panel's there is 3 mrad: the height of the point itself is off by some 20 um.
    assert found.deck_m[0] == pytest.approx([x + 8e-3, y - 6e-3], abs=1e-6)
    assert found.values_m[0] == pytest.approx(30e-6 * found.lever[0], rel=1e-6)


def test_points_come_in_the_order_of_their_numbers(m1: Mirror) -> None:
    measured = [exact_fix(m1, point, SHIFTED) for point in reversed(m1.point_ids(PANEL))]
    found = deviations_of(m1, PANEL, measured, HEIGHT_M, 0.0)
    assert found.points == m1.point_ids(PANEL)
    assert found.places_m[0] == pytest.approx([-0.22, -0.25], abs=1e-6)


def test_the_lever_is_the_cosine_between_the_normals(m1: Mirror) -> None:
    found = deviations_of(m1, PANEL, [exact_fix(m1, p, SHIFTED) for p in m1.point_ids(PANEL)], HEIGHT_M, 0.0)
    here, middle = (np.array(m1.surface.normal(*found.deck_m[k])) for k in (0, 4))
    assert found.lever[0] == pytest.approx(float(here @ middle), abs=1e-12)
    assert 3e-6 < 1.0 - found.lever[0] < 1e-5
    assert found.lever[4] == pytest.approx(1.0, abs=1e-12)


def test_the_variance_is_that_along_the_normal_and_the_floor(m1: Mirror) -> None:
    one = exact_fix(m1, PointId(1, 2, 1), SHIFTED)
    normal = np.array(m1.rotate_world_from_deck(m1.surface.normal(*m1.point_on_deck(one.point))))
    covariance = 9e-12 * np.outer(normal, normal) + 1e-6 * (np.eye(3) - np.outer(normal, normal))
    fix: Fix = replace(one.fix, covariance_m2=tuple(covariance.ravel().tolist()))
    found = deviations_of(m1, PANEL, [Measured(one.point, fix)], HEIGHT_M, 4e-6)
    assert found.sigmas_m[0] == pytest.approx(5e-6, rel=1e-6)


def test_a_panel_that_does_not_exist_is_refused(m1: Mirror) -> None:
    with pytest.raises(UnknownPanelError, match="no panel in row 1, column 9"):
        deviations_of(m1, PanelId(1, 9), [exact_fix(m1, PointId(1, 2, 1), SHIFTED)], HEIGHT_M, 0.0)
