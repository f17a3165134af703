"""Pure. The misalignment model and its recovery from measured puck positions."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import optimize, stats

from ccatp.config.models import Config
from ccatp.core import DeckPose, FloatArray, PanelId
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.mirror.misalignment import PanelMisalignment, fit_panel, misaligned_puck_world
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
from ccatp.mirror.surface import PanelFitError

HEIGHT_M = 0.05
PANEL = PanelId(3, 7)
TRUTH = PanelMisalignment(piston_m=73e-6, tip_rad=-140e-6, tilt_rad=95e-6)
ISOTROPIC = np.diag([4e-12, 4e-12, 4e-12])  # 2 um along every axis


def pucks(mirror: Mirror, panel: PanelId, truth: PanelMisalignment) -> NDArray[np.float64]:
    poses = [DeckPose(*mirror.point_on_deck(pid), 0.3) for pid in mirror.point_ids(panel)]
    return np.array([misaligned_puck_world(mirror, panel, truth, p, HEIGHT_M) for p in poses])


def test_misaligned_puck_is_the_ideal_one_moved_as_a_rigid_body(mirror: Mirror) -> None:
    # Independent: rotate the panel with its puck about the panel's centre by the rotation vector (tip, -tilt, 0).
    panel = mirror.panels[PANEL]
    pose = DeckPose(panel.x_m + 0.2, panel.y_m - 0.24, 0.0)
    ideal = np.array(panel.from_deck(mirror.deck_from_world(mirror.puck_world(pose, HEIGHT_M))))
    foot = np.array(panel.from_deck(mirror.surface_point(pose.x_m, pose.y_m)))
    spin = np.array([TRUTH.tip_rad, -TRUTH.tilt_rad, 0.0])
    moved = ideal + np.cross(spin, ideal) + [0.0, 0.0, TRUTH.piston_m]
    # The model leaves out the foot's sideways motion, spin times its sag of some 0.5 mm: 1e-7 m.
    sideways = np.cross(spin, [0.0, 0.0, foot[2]])
    found = panel.from_deck(mirror.deck_from_world(misaligned_puck_world(mirror, PANEL, TRUTH, pose, HEIGHT_M)))
    assert found == pytest.approx(tuple(moved - sideways), abs=1e-9)  # second order: 0.05 m times (2e-4)^2


def test_noiseless_misalignment_is_recovered(mirror: Mirror) -> None:
    for panel in mirror.panels:
        fit = fit_panel(mirror, panel, pucks(mirror, panel, TRUTH), np.tile(ISOTROPIC, (9, 1, 1)), HEIGHT_M)
        assert fit.piston_m == pytest.approx(TRUTH.piston_m, abs=2e-9)  # second order in angles and slopes
        assert (fit.tip_rad, fit.tilt_rad) == pytest.approx((TRUTH.tip_rad, TRUTH.tilt_rad), abs=1e-8)
        assert fit.dof == 6
        assert fit.chi2 < 1e-4  # residuals of nanometres against 2 um


def test_sigma_of_points_out_of_balance(m1: Mirror) -> None:
    some = [0, 1, 2, 3, 8]
    weights = np.array([1.0, 4.0, 0.25, 1.0, 9.0])
    covariances = ISOTROPIC / weights[:, None, None]
    fit = fit_panel(m1, PANEL, pucks(m1, PANEL, TRUTH)[some], covariances, HEIGHT_M)
    x, y = np.tile([-0.22, 0.0, 0.22], 3)[some], np.repeat([-0.25, 0.0, 0.25], 3)[some]
    design = np.column_stack([np.ones(5), y, x])
    expected = np.sqrt(np.diag(np.linalg.inv(design.T @ (weights[:, None] * design)))) * 2e-6
    assert fit.sigma == pytest.approx(tuple(expected), rel=1e-3)  # the puck's tilt moves the feet by 7 um of 0.2 m


def test_fit_is_consistent_with_its_sigmas(m1: Mirror) -> None:
    rng = np.random.default_rng(11)
    scales = []
    chi2 = []
    for _ in range(200):
        noise_axes = rng.normal(size=(9, 3, 3)) * 2e-6
        covariances = noise_axes @ noise_axes.transpose(0, 2, 1) + ISOTROPIC * 0.1
        noise = np.array([rng.multivariate_normal(np.zeros(3), c, method="cholesky") for c in covariances])
        fit = fit_panel(m1, PANEL, pucks(m1, PANEL, TRUTH) + noise, covariances, HEIGHT_M)
        error = np.subtract((fit.piston_m, fit.tip_rad, fit.tilt_rad), (TRUTH.piston_m, TRUTH.tip_rad, TRUTH.tilt_rad))
        scales.append(error / np.array(fit.sigma))
        chi2.append(fit.chi2)
    # Mean square of 200 unit normals: 1 +- sqrt(2/200); mean chi2 of 6 degrees: 6 +- sqrt(12/200); four sigmas.
    assert np.mean(np.square(scales), axis=0) == pytest.approx(np.ones(3), abs=0.4)
    assert np.mean(chi2) == pytest.approx(6.0, abs=1.0)


NINE = np.tile(ISOTROPIC, (9, 1, 1))
# A survey that ends after one row: its 10 mm would be a lever, and the plane one that nobody has measured.
ASIDE_M = np.array([[0.0, 0.01, 0.0], [0.0, -0.01, 0.0], [0.0, 0.01, 0.0]])


@pytest.mark.parametrize(
    ("points", "covariances", "why"),
    [
        *((np.zeros(shape), NINE, r"fit needs points of shape \(k >= 3, 3\)") for shape in ((2, 3), (3, 2), 3)),
        (None, NINE[:8], r"9 points, covariances of shape \(8, 3, 3\)"),
        *((None, factor * NINE, "variance along the normal is not positive") for factor in (0.0, -1.0, np.nan)),
        (ASIDE_M, NINE[:3], r"do not span the panel: they lie on one line to within \d\.\d mm"),
    ],
)
def test_what_cannot_be_fitted_is_refused(
    m1: Mirror, points: FloatArray | None, covariances: FloatArray, why: str
) -> None:
    at = pucks(m1, PANEL, TRUTH)
    given = at if points is None else at[:3] + points if points is ASIDE_M else points
    with pytest.raises(PanelFitError, match=rf"panel \(3, 7\): .*{why}"):
        fit_panel(m1, PANEL, given, covariances, HEIGHT_M)


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


@pytest.mark.parametrize(
    ("anchors", "ranges", "sigmas", "expected", "match"),
    [
        (CUBE[:3], np.ones(3), np.ones(3), np.zeros(3), "at least 4 needed in 3 dimensions"),
        (SQUARE[:2], np.ones(2), np.ones(2), np.zeros(2), "at least 3 needed in 2 dimensions"),
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
    with pytest.raises(TooFewRanges if "needed" in match else ValueError, match=match):
        multilaterate(anchors, ranges, sigmas, expected)
    with pytest.raises(NoConvergence, match="no rest after 2 iterations"):
        multilaterate(CUBE, ranges_to(CUBE, np.zeros(3)), np.ones(8), [3.0, 3.0, 3.0], max_iterations=2)


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
