"""Pure. The misalignment model and its recovery from measured puck positions."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize, stats

from ccatp.config.models import Config
from ccatp.core import DeckPose, FloatArray, Measured, PanelId
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.mirror.misalignment import PanelMisalignment, misaligned_puck_world
from ccatp.mirror.multilateration import MultilaterationError, multilaterate, solve_fix
from ccatp.mirror.panel_alignment import fit_panels
from ccatp.mirror.panel_modes import deviations_of
from tests.unit.mirror.test_panel_alignment import exact_fix

HEIGHT_M = 0.05
PANEL = PanelId(3, 7)
TRUTH = PanelMisalignment(piston_m=73e-6, tip_rad=-140e-6, tilt_rad=95e-6)


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


def measured(mirror: Mirror, panel: PanelId = PANEL) -> list[Measured]:
    return [exact_fix(mirror, point, TRUTH) for point in mirror.point_ids(panel)]


def test_noiseless_misalignment_is_recovered(mirror: Mirror) -> None:
    points = [one for panel in mirror.panels for one in measured(mirror, panel)]
    fits = fit_panels(mirror, points, HEIGHT_M)
    assert list(fits) == sorted(mirror.panels)
    for piston_m, tip_rad, tilt_rad in fits.values():
        assert piston_m == pytest.approx(TRUTH.piston_m, abs=2e-9)  # second order in angles and slopes
        assert (tip_rad, tilt_rad) == pytest.approx((TRUTH.tip_rad, TRUTH.tilt_rad), abs=1e-8)


@pytest.mark.parametrize(("count", "fitted"), [(2, []), (3, []), (4, [PANEL])])
def test_points_that_do_not_span_the_panel_fit_nothing(m1: Mirror, count: int, fitted: list[PanelId]) -> None:
    # A survey that ends after one row: its 10 mm would be a lever, and the plane one that nobody has measured.
    points = []
    for one, aside_m in zip(measured(m1)[:count], (0.01, -0.01, 0.01, 0.01), strict=False):
        x, y, z = one.fix.position_m
        points.append(Measured(one.point, replace(one.fix, position_m=(x, y + aside_m, z))))
    assert list(fit_panels(m1, points, HEIGHT_M)) == fitted


def test_deviations_are_reported_with_their_places(m1: Mirror) -> None:
    found = deviations_of(m1, PANEL, measured(m1), HEIGHT_M, 0.0)
    # The tilted puck moves its foot by 0.05 m times 140 urad = 7 um.
    x, y = found.places_m.T
    assert x == pytest.approx([-0.22, 0.0, 0.22] * 3, abs=1e-5)
    assert y == pytest.approx(np.repeat([-0.25, 0.0, 0.25], 3), abs=1e-5)
    assert found.values_m == pytest.approx([TRUTH.displacement_m(*place) for place in found.places_m], abs=2e-8)


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
        assert np.abs(solution.residuals_m).max() < EXACT_M


def test_weights_are_the_inverse_variances() -> None:
    anchors = np.vstack((np.eye(3), -np.eye(3))) * 5.0
    sigmas = np.array([0.1, 0.2, 0.3, 0.1, 0.2, 0.3])
    solution = multilaterate(anchors, np.full(6, 5.0), sigmas, [0.01, 0.02, -0.01])
    # Two opposite anchors per axis: variance sigma^2 / 2 along it.
    assert np.diag(solution.covariance_m2) == pytest.approx([0.005, 0.02, 0.045], abs=1e-12)
    assert solution.dop == pytest.approx(np.sqrt(1.5), abs=1e-9)


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
    with pytest.raises(MultilaterationError, match="leave a direction undetermined"):
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
    with pytest.raises(MultilaterationError if "needed" in match else ValueError, match=match):
        multilaterate(anchors, ranges, sigmas, expected)
    with pytest.raises(MultilaterationError, match="no rest after 2 iterations"):
        multilaterate(CUBE, ranges_to(CUBE, np.zeros(3)), np.ones(8), [3.0, 3.0, 3.0], max_iterations=2)


@pytest.mark.parametrize(
    ("limit", "off_m", "message"),
    [
        ({"max_residual_m": 1e-4}, 0.0, r"largest residual 0\.\d+ mm exceeds 0\.1 mm"),
        ({"max_dop": 1.0}, 0.0, r"dilution of precision 1\.\d+ exceeds 1$"),
        ({"max_distance_m": 1.0}, 2.0, r"position 2(\.\d+)? m from the expected one exceeds 1 m"),
    ],
)
def test_a_solution_past_a_limit_is_refused_with_its_numbers(
    config: Config, limit: dict[str, float], off_m: float, message: str
) -> None:
    ranges = ranges_to(CUBE, np.zeros(3))
    ranges[2] += 1e-3
    lengths, anchors = dict(enumerate(ranges.tolist())), dict(enumerate(CUBE))
    limits = {"max_residual_m": 1.0, "max_dop": 20.0, "max_distance_m": 3.0}
    etalon = config.etalon.model_copy(update=limits)
    assert solve_fix(etalon, 1.0, (off_m, 0.0, 0.0), lengths, anchors).position_m == pytest.approx((0, 0, 0), abs=1e-3)
    with pytest.raises(MultilaterationError, match=message):
        solve_fix(etalon.model_copy(update=limit), 1.0, (off_m, 0.0, 0.0), lengths, anchors)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_lengths_are_no_fix(config: Config, count: int) -> None:
    mirror = build_mirror(config.mirror)
    collimators = dict(zip(mirror.channels, mirror.collimators_m, strict=True))
    puck = mirror.puck_world(mirror.deck_pose(mirror.base_panel_pose), config.robot.puck_height_m)
    lengths = {c: float(np.linalg.norm(collimators[c] - np.array(puck))) for c in mirror.channels[:count]}
    with pytest.raises(MultilaterationError, match=f"{count} "):
        solve_fix(config.etalon, 0.0, puck, lengths, collimators)
