"""Least squares of what a panel can do: exact without noise, as uncertain as it says with noise."""

import numpy as np
import pytest

from ccatp.mirror.panel_alignment import Modes, adjustable, fit_modes, gram, quadratic, rigid
from tests.unit.aligning.conftest import GRID_M

ALL: list[tuple[Modes, int]] = [(rigid, 3), (adjustable, 5), (quadratic, 6)]
EVEN = np.full(9, 2e-6)


@pytest.mark.parametrize(("modes", "count"), ALL)
def test_each_coefficient_is_recovered_exactly(modes: Modes, count: int) -> None:
    for k in range(count):
        truth = np.zeros(count)
        truth[k] = 1e-4
        fit = fit_modes(modes(GRID_M), modes(GRID_M) @ truth, EVEN)
        assert fit is not None
        assert fit.values == pytest.approx(truth, abs=1e-9 * 1e-4)
        assert fit.dof == 9 - count
        assert fit.residuals_m == pytest.approx(np.zeros(9), abs=1e-15)


def test_the_curvatures_are_second_derivatives() -> None:
    x, y = GRID_M.T
    fit = fit_modes(quadratic(GRID_M), 3e-4 * x * x + 5e-4 * x * y - 2e-4 * y * y, EVEN)
    assert fit is not None
    assert fit.values == pytest.approx([0.0, 0.0, 0.0, 6e-4, 5e-4, -4e-4], abs=1e-12)


def test_sigmas_of_nine_equal_points() -> None:
    fit = fit_modes(rigid(GRID_M), np.zeros(9), EVEN)
    assert fit is not None
    assert fit.sigma == pytest.approx([2e-6 / 3, 2e-6 / (0.25 * 6**0.5), 2e-6 / (0.22 * 6**0.5)], rel=1e-12)


@pytest.mark.parametrize(("modes", "count"), ALL)
def test_the_covariance_and_the_residuals_are_as_stated(modes: Modes, count: int) -> None:
    rng = np.random.default_rng(5)
    sigmas = np.array([1.0, 2.0, 1.5, 3.0, 1.0, 0.8, 2.5, 1.2, 2.0]) * 1e-6
    truth = np.full(count, 1e-4)
    distances, unexplained, chi2 = [], [], []
    for _ in range(200):
        fit = fit_modes(modes(GRID_M), modes(GRID_M) @ truth + rng.normal(size=9) * sigmas, sigmas)
        assert fit is not None
        error = fit.values - truth
        distances.append(error @ np.linalg.solve(fit.covariance, error))
        chi2.append(fit.chi2)
        unexplained.append(fit.unexplained_m2)
    # Sums of 200 chi-squares: variance 2 x 200 x count; four sigmas.
    assert sum(distances) == pytest.approx(200 * count, abs=4.0 * (400 * count) ** 0.5)
    assert sum(chi2) == pytest.approx(200 * (9 - count), abs=4.0 * (400 * (9 - count)) ** 0.5)
    assert abs(np.mean(unexplained)) < 4.0 * np.std(unexplained) / 200**0.5
    assert fit is not None
    assert np.std(unexplained) < 3.0 * fit.residual_variance_m2


def test_the_mean_square_over_a_panel() -> None:
    a, b = 0.335, 0.375
    found = gram(quadratic, (a, b))
    # Means of 1, y^2, x^2, x^4/4, x^2 y^2, y^4/4 over a rectangle.
    assert np.diag(found) == pytest.approx([1.0, b**2 / 3, a**2 / 3, a**4 / 20, a**2 * b**2 / 9, b**4 / 20], rel=1e-12)
    assert found[0] == pytest.approx([1.0, 0.0, 0.0, a**2 / 6, 0.0, b**2 / 6], abs=1e-15)


@pytest.mark.parametrize(
    ("modes", "places"),
    [
        (rigid, GRID_M[:3]),  # on a line
        (rigid, GRID_M[:2]),
        (rigid, np.zeros((4, 2))),
        (quadratic, GRID_M[:6]),  # two rows: y^2 is not determined
        (quadratic, GRID_M[:5]),
        (adjustable, GRID_M[[0, 2, 6, 8]]),
    ],
)
def test_too_little_determines_nothing(modes: Modes, places: np.ndarray) -> None:
    assert fit_modes(modes(places), np.zeros(len(places)), np.full(len(places), 1e-6)) is None
