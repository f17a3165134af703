"""Outliers are found, bent panels are told from them, and noise is left alone."""

from itertools import combinations

import numpy as np
import pytest

from ccatp.mirror.panel_alignment import explain, prices, quadratic, rigid
from tests.unit.aligning.conftest import GRID_M, on_grid

SIGMA_M = 2e-6
PRICE = prices(0.01, 693, 77)
RIGID = rigid(GRID_M) @ np.array([5e-5, -1e-4, 8e-5])
BENT = RIGID + quadratic(GRID_M)[:, 3:] @ np.array([1e-3, -4e-4, 7e-4])


def noise(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(scale=SIGMA_M, size=9)


def test_prices_are_what_noise_reaches_with_the_agreed_probability() -> None:
    # A normal deviate beyond 4.3372 has a chance of 0.01 / 693.
    assert PRICE.outlier == pytest.approx(4.3372**2, rel=1e-3)
    assert PRICE.shape > prices(0.1, 693, 77).shape


def test_noise_makes_neither_outliers_nor_shapes() -> None:
    rng = np.random.default_rng(1)
    found = [explain(on_grid(RIGID + noise(rng)), PRICE) for _ in range(800)]
    # Ten mirrors' worth of panels: 0.1 alarms of either kind are expected.
    assert sum(not one.is_kept.all() for one in found) <= 1
    assert sum(one.has_shape for one in found) <= 1


@pytest.mark.parametrize("shift_m", [25e-6, -60e-6, 2e-3])
def test_an_outlier_is_found_wherever_it_is(shift_m: float) -> None:
    rng = np.random.default_rng(2)
    for k in range(9):
        values = RIGID + noise(rng)
        values[k] += shift_m
        found = explain(on_grid(values), PRICE)
        assert [int(i) for i in np.flatnonzero(~found.is_kept)] == [k]
        assert not found.has_shape


def test_two_outliers_are_found_wherever_they_are() -> None:
    rng = np.random.default_rng(3)
    for pair in combinations(range(9), 2):
        values = RIGID + noise(rng)
        values[list(pair)] += [90e-6, 150e-6]
        assert np.flatnonzero(~explain(on_grid(values), PRICE).is_kept).tolist() == list(pair)


def test_a_bent_panel_keeps_its_points() -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        found = explain(on_grid(BENT + noise(rng)), PRICE)
        assert found.has_shape
        assert found.is_kept.all()


def test_an_outlier_on_a_bent_panel() -> None:
    rng = np.random.default_rng(6)
    for k in range(9):
        values = BENT + noise(rng)
        values[k] += 80e-6
        found = explain(on_grid(values), PRICE)
        assert found.has_shape
        assert [int(i) for i in np.flatnonzero(~found.is_kept)] == [k]


@pytest.mark.parametrize("count", [3, 4, 5])
def test_few_points_accuse_nobody(count: int) -> None:
    # With so few, leaving any one of several points out explains the contradiction as well.
    some = GRID_M[[0, 2, 6, 8, 4]][:count]
    values = np.zeros(count)
    values[0] = 1e-3
    found = explain(on_grid(values, places_m=some), PRICE)
    assert found.is_kept.all()
    assert not found.has_shape


def test_scattered_points_are_no_outliers() -> None:
    # Scatter far beyond the stated sigma: with a third of the points left out something would always fit.
    rng = np.random.default_rng(7)
    for _ in range(100):
        found = explain(on_grid(RIGID + rng.normal(scale=60e-6, size=9)), PRICE)
        assert np.count_nonzero(~found.is_kept) <= 2 - found.has_shape


@pytest.mark.parametrize(("count", "is_found"), [(5, False), (6, True)])
def test_six_points_are_enough_to_find_one(count: int, is_found: bool) -> None:
    values = RIGID[[0, 2, 6, 8, 4, 1][:count]].copy()
    values[0] += 1e-3
    found = explain(on_grid(values, places_m=GRID_M[[0, 2, 6, 8, 4, 1][:count]]), PRICE)
    assert found.is_kept.tolist() == [not is_found] + [True] * (count - 1)
