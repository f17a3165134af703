"""Adjuster moves: they take the displacement away, in the direction that is stated."""

import numpy as np
import pytest

from ccatp.core import PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panel_alignment import Modes, adjustable, adjuster_moves, adjuster_places, fit_modes, rigid
from tests.unit.aligning.conftest import GRID_M

PANEL = PanelId(3, 7)
SIGMAS = np.full(9, 2e-6)


def test_the_adjusters_of_the_telescope_are_under_the_corner_points_and_the_centre(m1: Mirror) -> None:
    names, places = adjuster_places(m1, PANEL)
    assert names == ("V1", "V2", "V3", "V4", "V5")
    # M1's deck runs against the mirror frame's x, in which the tables give V1 at (-220, -250).
    assert places == pytest.approx(
        np.array([[0.22, -0.25], [-0.22, -0.25], [0.22, 0.25], [-0.22, 0.25], [0.0, 0.0]]), abs=1e-9
    )


def test_a_panel_that_stands_out_is_moved_away_from_the_robot(m1: Mirror) -> None:
    fit = fit_modes(rigid(GRID_M), np.full(9, 30e-6), SIGMAS)
    assert fit is not None
    moves = adjuster_moves(fit, rigid, adjuster_places(m1, PANEL)[1])
    assert moves.values_m == pytest.approx(np.full(5, -30e-6), abs=1e-15)
    # A corner: piston and both slopes at their lever arms.
    corner = 2e-6 * (1 / 9 + 1 / 6 + 1 / 6) ** 0.5
    assert moves.sigma_m == pytest.approx([corner] * 4 + [2e-6 / 3], rel=1e-6)


@pytest.mark.parametrize(("modes", "count"), [(rigid, 3), (adjustable, 5)])
def test_moves_are_minus_the_displacement_at_the_adjusters(modes: Modes, count: int, m1: Mirror) -> None:
    truth = np.array([4e-5, -1e-4, 7e-5, 6e-4, -9e-4])[:count]
    fit = fit_modes(modes(GRID_M), modes(GRID_M) @ truth, SIGMAS)
    assert fit is not None
    places = adjuster_places(m1, PANEL)[1]
    moves = adjuster_moves(fit, modes, places)
    assert modes(places) @ truth + moves.values_m == pytest.approx(np.zeros(5), abs=1e-14)
    # Independent: five moves, interpolated by the same modes, cancel the displacement at the measured points.
    moved = np.linalg.lstsq(modes(places), moves.values_m, rcond=None)[0]
    assert modes(GRID_M) @ (truth + moved) == pytest.approx(np.zeros(9), abs=1e-14)


def test_moves_are_as_uncertain_as_stated(m1: Mirror) -> None:
    rng = np.random.default_rng(8)
    places = adjuster_places(m1, PANEL)[1]
    drawn, stated = [], np.zeros(5)
    for _ in range(400):
        fit = fit_modes(adjustable(GRID_M), rng.normal(size=9) * SIGMAS, SIGMAS)
        assert fit is not None
        moves = adjuster_moves(fit, adjustable, places)
        drawn.append(moves.values_m)
        stated = moves.sigma_m
    # A standard deviation of 400 draws is known to 3.5 %; four sigmas.
    assert np.std(drawn, axis=0) == pytest.approx(stated, rel=0.14)
