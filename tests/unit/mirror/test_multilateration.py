"""Multilateration: against closed forms, an independent optimiser and Monte Carlo."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize, stats

from ccatp.config.models import Config
from ccatp.core import FloatArray
from ccatp.mirror.mirror import build_mirror
from ccatp.mirror.multilateration import (
    DegenerateGeometry,
    DilutionTooLarge,
    NoConvergence,
    ResidualTooLarge,
    TooFarFromExpected,
    TooFewRanges,
    check_solution,
    multilaterate,
    solve_fix,
)

CUBE = np.array(list(itertools.product((-4.0, 5.0), (-5.0, 4.0), (-3.0, 6.0))))
RING = np.array([[3.0 * np.cos(a), 3.0 * np.sin(a), 1.0] for a in np.linspace(0.3, 6.0, 8)])
SQUARE = np.array([[-4.0, -5.0], [5.0, -4.0], [4.0, 6.0], [-6.0, 4.0], [0.0, 7.0]])
EXACT_M = 1e-8  # ranges of some 10 m carry 2e-15 m of rounding; the iteration ends at steps of 1e-9 m


def ranges_to(anchors: FloatArray, position: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(anchors - position, axis=1))


@pytest.mark.parametrize("count", range(4, 9))
def test_every_subset_of_at_least_four_anchors_finds_the_position_in_3d(count: int) -> None:
    truth = np.array([0.3, -1.1, 0.4])  # in none of the planes through four corners
    for subset in itertools.combinations(range(8), count):
        anchors = CUBE[list(subset)]
        solution = multilaterate(anchors, ranges_to(anchors, truth), np.full(count, 1e-6), [0.35, -1.2, 0.5])
        assert solution.position_m == pytest.approx(truth, abs=EXACT_M)
        assert solution.residual_rms_m < EXACT_M


@pytest.mark.parametrize("count", range(3, 6))
def test_every_subset_of_at_least_three_anchors_finds_the_position_in_2d(count: int) -> None:
    truth = np.array([0.3, -0.7])
    for subset in itertools.combinations(range(5), count):
        anchors = SQUARE[list(subset)]
        solution = multilaterate(anchors, ranges_to(anchors, truth), np.full(count, 0.01), truth + 0.3)
        assert solution.position_m == pytest.approx(truth, abs=EXACT_M)


def test_covariance_and_dop_of_a_cross_in_2d_are_those_of_the_closed_form() -> None:
    anchors = np.array([[2.0, 0.0], [-2.0, 0.0], [0.0, 2.0], [0.0, -2.0]])
    solution = multilaterate(anchors, np.full(4, 2.0), np.full(4, 0.1), [0.01, -0.02])
    # H^T H = 2 I: covariance sigma^2 / 2 per axis, dop = sqrt(2 * 1/2) = 1.
    assert solution.covariance_m2 == pytest.approx(np.eye(2) * 0.005, abs=1e-12)
    assert solution.dop == pytest.approx(1.0, abs=1e-9)


def test_weights_are_the_inverse_variances() -> None:
    anchors = np.vstack((np.eye(3), -np.eye(3))) * 5.0
    sigmas = np.array([0.1, 0.2, 0.3, 0.1, 0.2, 0.3])
    solution = multilaterate(anchors, np.full(6, 5.0), sigmas, [0.01, 0.02, -0.01])
    # Two opposite anchors per axis: variance sigma^2 / 2 along it.
    assert np.diag(solution.covariance_m2) == pytest.approx([0.005, 0.02, 0.045], abs=1e-12)
    assert solution.dop == pytest.approx(np.sqrt(1.5), abs=1e-9)


def test_a_precise_range_outweighs_a_coarse_one() -> None:
    anchors = np.array([[5.0, 0.0], [-5.0, 0.0], [0.0, 5.0], [0.0, -5.0]])
    ranges = [5.0, 5.3, 5.0, 5.0]
    solution = multilaterate(anchors, ranges, [0.1, 0.2, 0.1, 0.1], [0.0, 0.0])
    # Along x: (0 / 0.1^2 + 0.3 / 0.2^2) / (1 / 0.1^2 + 1 / 0.2^2) = 0.06 up to the curvature of the circles.
    assert solution.position_m[0] == pytest.approx(0.06, abs=1e-4)


@pytest.mark.parametrize(("anchors", "truth"), [(CUBE, [0.3, -0.7, 0.4]), (RING, [0.4, 0.2, -3.0]), (SQUARE, [1, 2])])
def test_noisy_ranges_give_what_an_independent_optimiser_gives(anchors: FloatArray, truth: list[float]) -> None:
    rng = np.random.default_rng(5)
    sigmas = rng.uniform(0.01, 0.1, len(anchors))
    ranges = ranges_to(anchors, np.array(truth)) + sigmas * rng.standard_normal(len(anchors))
    solution = multilaterate(anchors, ranges, sigmas, truth)

    def weighted_residuals(position: FloatArray) -> FloatArray:
        return (ranges_to(anchors, position) - ranges) / sigmas

    oracle = optimize.least_squares(weighted_residuals, truth, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    # The optimiser's own end: about the root of the machine precision times the curvature.
    assert solution.position_m == pytest.approx(oracle.x, abs=1e-6)
    assert solution.chi_squared == pytest.approx(2.0 * oracle.cost, rel=1e-6)


@pytest.mark.parametrize(("anchors", "truth"), [(CUBE, [0.3, -0.7, 0.4]), (RING, [0.4, 0.2, -3.0]), (SQUARE, [1, 2])])
def test_monte_carlo_errors_have_the_reported_covariance(anchors: FloatArray, truth: list[float]) -> None:
    rng = np.random.default_rng(7)
    count, dimension = 500, len(truth)
    exact = ranges_to(anchors, np.array(truth, dtype=float))
    sigmas = 1e-6 + 2.5e-7 * exact
    nees, chi_squared = 0.0, 0.0
    for _ in range(count):
        solution = multilaterate(anchors, exact + sigmas * rng.standard_normal(len(exact)), sigmas, truth)
        error = solution.position_m - truth
        nees += float(error @ np.linalg.solve(solution.covariance_m2, error))
        chi_squared += solution.chi_squared
    # Sums of 500 normalised squares: chi-squared, and both must lie in its 99.9 % band.
    assert stats.chi2.ppf(0.0005, count * dimension) < nees < stats.chi2.ppf(0.9995, count * dimension)
    redundant = count * (len(exact) - dimension)
    assert stats.chi2.ppf(0.0005, redundant) < chi_squared < stats.chi2.ppf(0.9995, redundant)


@given(
    st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-4.0, -0.5) | st.floats(2.5, 6.0)),
    st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.2, 3.0)),
)
def test_the_expected_position_selects_the_side_of_coplanar_anchors(
    truth: tuple[float, float, float], start: tuple[float, float, float]
) -> None:
    height = truth[2] - 1.0
    expected = (start[0], start[1], 1.0 + np.copysign(start[2], height))
    solution = multilaterate(RING, ranges_to(RING, np.array(truth)), np.full(8, 1e-3), expected)
    assert solution.position_m == pytest.approx(np.array(truth), abs=1e-7)
    other = multilaterate(
        RING, ranges_to(RING, np.array(truth)), np.full(8, 1e-3), (start[0], start[1], 2.0 - expected[2])
    )
    assert other.position_m == pytest.approx([truth[0], truth[1], 2.0 - truth[2]], abs=1e-7)


def test_the_side_is_kept_where_the_iteration_crosses_the_plane() -> None:
    # Ranges with 0.3 m of noise and a start near the plane: the steps end on the other side of z = 1.
    ranges = [4.03, 4.66, 4.9, 4.41, 3.2, 2.11, 0.93, 2.58]
    above = multilaterate(RING, ranges, np.full(8, 0.1), [0.9, -2.2, 1.14])
    below = multilaterate(RING, ranges, np.full(8, 0.1), [0.9, -2.2, 0.86])
    assert above.position_m[2] > 1.1
    assert below.position_m == pytest.approx(above.position_m * [1, 1, -1] + [0, 0, 2], abs=EXACT_M)


def test_collinear_anchors_in_2d_leave_a_mirror_image_that_the_expected_position_selects() -> None:
    anchors = np.array([[-3.0, 0.0], [0.0, 0.0], [4.0, 0.0]])
    ranges = ranges_to(anchors, np.array([1.0, 2.0]))
    assert multilaterate(anchors, ranges, [0.1] * 3, [0.5, 0.3]).position_m == pytest.approx([1.0, 2.0], abs=EXACT_M)
    assert multilaterate(anchors, ranges, [0.1] * 3, [0.5, -0.3]).position_m == pytest.approx([1, -2], abs=EXACT_M)


@pytest.mark.parametrize(
    ("anchors", "truth", "start"),
    [
        (np.outer(np.arange(5.0), [1.0, 2.0, 0.5]), [1.0, -1.0, 3.0], [1.1, -1.0, 3.0]),  # on a line
        (np.zeros((4, 3)), [1.0, 0.0, 0.0], [1.0, 0.1, 0.0]),  # all in one place
        (RING, [0.5, 0.2, 1.0], [0.4, 0.3, 1.0]),  # position and start in the anchors' plane
        (RING, [0.5, 0.2, -2.0], [0.4, 0.3, 1.0]),  # start in the anchors' plane: no side selected
        (np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0]]), [2.0, 0.0], [2.1, 0.0]),  # on the anchors' line
    ],
)
def test_geometry_that_leaves_a_direction_undetermined_is_refused(
    anchors: FloatArray, truth: list[float], start: list[float]
) -> None:
    ranges = ranges_to(anchors, np.array(truth))
    with pytest.raises(DegenerateGeometry, match="leave a direction undetermined"):
        multilaterate(anchors, ranges, np.full(len(ranges), 1e-6), start)


def test_a_start_far_away_or_on_an_anchor_still_converges() -> None:
    truth = np.array([0.3, -0.7, 0.4])
    for start in ([60.0, -80.0, 40.0], CUBE[3]):
        solution = multilaterate(CUBE, ranges_to(CUBE, truth), np.full(8, 1e-6), start)
        assert solution.position_m == pytest.approx(truth, abs=EXACT_M)
    # From here Gauss-Newton without damping diverges.
    truth = np.array([-2.5, -2.8, 3.7])
    solution = multilaterate(RING, ranges_to(RING, truth), np.full(8, 1e-3), [18.7, -12.9, 12.1])
    assert solution.position_m == pytest.approx(truth, abs=EXACT_M)


@pytest.mark.parametrize(("anchors", "dimension"), [(CUBE[:3], 3), (SQUARE[:2], 2)])
def test_too_few_ranges_are_refused(anchors: FloatArray, dimension: int) -> None:
    with pytest.raises(TooFewRanges, match=f"at least {dimension + 1} needed in {dimension} dimensions"):
        multilaterate(anchors, np.ones(len(anchors)), np.ones(len(anchors)), np.zeros(dimension))


def test_an_iteration_that_does_not_come_to_rest_is_reported() -> None:
    with pytest.raises(NoConvergence, match="no rest after 2 iterations"):
        multilaterate(CUBE, ranges_to(CUBE, np.zeros(3)), np.ones(8), [3.0, 3.0, 3.0], max_iterations=2)


@pytest.mark.parametrize(
    ("anchors", "ranges", "sigmas", "expected", "match"),
    [
        (CUBE, np.ones(8), np.ones(8), np.zeros(4), "not \\(2,\\) or \\(3,\\)"),
        (CUBE, np.ones(7), np.ones(7), np.zeros(3), "do not fit dimension 3"),
        (CUBE, np.ones(8), np.ones(7), np.zeros(3), "do not fit"),
        (SQUARE, np.ones(5), np.ones(5), np.zeros(3), "do not fit"),
        (CUBE, np.full(8, np.nan), np.ones(8), np.zeros(3), "not finite"),
        (CUBE, np.ones(8), np.ones(8), np.full(3, np.inf), "not finite"),
        (CUBE, np.ones(8), np.zeros(8), np.zeros(3), "must be positive"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(
    anchors: FloatArray, ranges: FloatArray, sigmas: FloatArray, expected: FloatArray, match: str
) -> None:
    with pytest.raises(ValueError, match=match):
        multilaterate(anchors, ranges, sigmas, expected)


def test_a_solution_past_a_limit_is_refused_with_its_numbers() -> None:
    ranges = ranges_to(CUBE, np.zeros(3))
    ranges[2] += 1e-3
    solution = multilaterate(CUBE, ranges, np.full(8, 1e-6), np.zeros(3))
    limits = {"max_residual_m": 1.0, "max_dop": 20.0, "max_distance_m": 1.0}
    check_solution(solution, [0.0, 0.0, 0.0], **limits)
    with pytest.raises(ResidualTooLarge, match=r"largest residual 0\.\d+ mm exceeds 0\.1 mm"):
        check_solution(solution, [0.0, 0.0, 0.0], **limits | {"max_residual_m": 1e-4})
    with pytest.raises(DilutionTooLarge, match=r"dilution of precision 1\.\d+ exceeds 1$"):
        check_solution(solution, [0.0, 0.0, 0.0], **limits | {"max_dop": 1.0})
    with pytest.raises(TooFarFromExpected, match=r"position 2(\.\d+)? m from the expected one exceeds 1 m"):
        check_solution(solution, [2.0, 0.0, 0.0], **limits)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_lengths_are_no_fix(config: Config, count: int) -> None:
    mirror = build_mirror(config.mirror)
    collimators = dict(zip(mirror.channels, mirror.collimators_m, strict=True))
    puck = mirror.puck_world(mirror.deck_pose(mirror.base_panel_pose), config.robot.puck_height_m)
    lengths = {c: float(np.linalg.norm(collimators[c] - np.array(puck))) for c in mirror.channels[:count]}
    with pytest.raises(TooFewRanges, match=f"{count} "):
        solve_fix(config.etalon, 0.0, puck, lengths, collimators)
