"""Pure. The misalignment model and its recovery from measured puck positions."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ccatp.core import DeckPose, PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.misalignment import PanelMisalignment, fit_panel, misaligned_puck_world, panel_deviations
from ccatp.mirror.surface import PanelFitError, UnknownPanelError

HEIGHT_M = 0.05
PANEL = PanelId(3, 7)
TRUTH = PanelMisalignment(piston_m=73e-6, tip_rad=-140e-6, tilt_rad=95e-6)
ISOTROPIC = np.diag([4e-12, 4e-12, 4e-12])  # 2 um along every axis


def pucks(mirror: Mirror, panel: PanelId, truth: PanelMisalignment) -> NDArray[np.float64]:
    poses = [DeckPose(*mirror.point_on_deck(pid), 0.3) for pid in mirror.point_ids(panel)]
    return np.array([misaligned_puck_world(mirror, panel, truth, p, HEIGHT_M) for p in poses])


def test_displacement_is_the_plane_of_the_model() -> None:
    assert PanelMisalignment(1e-5, 2e-4, 3e-4).displacement_m(0.1, -0.2) == pytest.approx(1e-5 + 3e-5 - 4e-5, abs=1e-18)


def test_without_misalignment_the_puck_stands_on_the_ideal_surface(mirror: Mirror) -> None:
    pose = DeckPose(mirror.panels[PANEL].x_m + 0.1, mirror.panels[PANEL].y_m - 0.2, 1.0)
    found = misaligned_puck_world(mirror, PANEL, PanelMisalignment(0.0, 0.0, 0.0), pose, HEIGHT_M)
    assert found == pytest.approx(mirror.puck_world(pose, HEIGHT_M), abs=1e-15)


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


def test_sigma_of_nine_equal_points(m1: Mirror) -> None:
    fit = fit_panel(m1, PANEL, pucks(m1, PANEL, TRUTH), np.tile(ISOTROPIC, (9, 1, 1)), HEIGHT_M)
    # Textbook: sigma/3 for the mean, sigma/(a sqrt 6) for a slope over three columns at -a, 0, a.
    expected = 2e-6 / 3, 2e-6 / (0.25 * np.sqrt(6)), 2e-6 / (0.22 * np.sqrt(6))
    assert fit.sigma == pytest.approx(expected, rel=1e-3)  # the points' projection differs by 0.1 %


def test_sigma_of_points_out_of_balance(m1: Mirror) -> None:
    some = [0, 1, 2, 3, 8]
    weights = np.array([1.0, 4.0, 0.25, 1.0, 9.0])
    covariances = ISOTROPIC / weights[:, None, None]
    fit = fit_panel(m1, PANEL, pucks(m1, PANEL, TRUTH)[some], covariances, HEIGHT_M)
    x, y = np.tile([-0.22, 0.0, 0.22], 3)[some], np.repeat([-0.25, 0.0, 0.25], 3)[some]
    design = np.column_stack([np.ones(5), y, x])
    expected = np.sqrt(np.diag(np.linalg.inv(design.T @ (weights[:, None] * design)))) * 2e-6
    assert fit.sigma == pytest.approx(tuple(expected), rel=1e-3)  # the puck's tilt moves the feet by 7 um of 0.2 m


def test_only_the_error_along_the_normal_counts(m1: Mirror) -> None:
    # Large sideways covariance must not loosen the fit.
    panel = m1.panels[PANEL]
    axes = np.array([m1.rotate_world_from_deck(a) for a in panel.axes])
    sideways = axes.T @ np.diag([1e-8, 1e-8, 4e-12]) @ axes
    fit = fit_panel(m1, PANEL, pucks(m1, PANEL, TRUTH), np.tile(sideways, (9, 1, 1)), HEIGHT_M)
    # Normals inside a panel differ by up to 4 mrad from its centre's: up to 0.4 um of 100 um sideways.
    assert fit.sigma[0] == pytest.approx(2e-6 / 3, rel=0.05)


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


def test_points_of_unequal_weight(m1: Mirror) -> None:
    # A point that is wrong by 1 mm but says so hardly moves the fit.
    measured = pucks(m1, PANEL, TRUTH)
    measured[4] += 1e-3 * np.array(m1.rotate_world_from_deck(m1.panels[PANEL].axes[2]))
    covariances = np.tile(ISOTROPIC, (9, 1, 1))
    covariances[4] *= 1e8
    fit = fit_panel(m1, PANEL, measured, covariances, HEIGHT_M)
    assert fit.piston_m == pytest.approx(TRUTH.piston_m, abs=3e-9)


def test_deviations_are_told_with_their_places(m1: Mirror) -> None:
    rows = panel_deviations(m1, PANEL, pucks(m1, PANEL, TRUTH), HEIGHT_M)
    assert rows.shape == (9, 3)
    # The tilted puck moves its foot by 0.05 m times 140 urad = 7 um.
    assert rows[:, 0] == pytest.approx([-0.22, 0.0, 0.22] * 3, abs=1e-5)
    assert rows[:, 1] == pytest.approx(np.repeat([-0.25, 0.0, 0.25], 3), abs=1e-5)
    assert rows[:, 2] == pytest.approx([TRUTH.displacement_m(x, y) for x, y in rows[:, :2]], abs=2e-8)


def test_no_points_give_no_deviations(m1: Mirror) -> None:
    assert panel_deviations(m1, PANEL, np.empty((0, 3)), HEIGHT_M).shape == (0, 3)


@pytest.mark.parametrize("points", [np.zeros((2, 3)), np.zeros((3, 2)), np.zeros(3)])
def test_too_few_points_are_refused(m1: Mirror, points: NDArray[np.float64]) -> None:
    with pytest.raises(PanelFitError, match=r"panel \(3, 7\): fit needs points of shape \(k >= 3, 3\)"):
        fit_panel(m1, PANEL, points, np.tile(ISOTROPIC, (len(points), 1, 1)), HEIGHT_M)


def test_points_on_one_line_are_refused(m1: Mirror) -> None:
    row = pucks(m1, PANEL, TRUTH)[:3]
    with pytest.raises(PanelFitError, match="3 points do not span the panel"):
        fit_panel(m1, PANEL, row, np.tile(ISOTROPIC, (3, 1, 1)), HEIGHT_M)


def test_a_row_that_was_measured_within_the_tolerance_of_arrivals_is_a_line(m1: Mirror) -> None:
    """A survey that ends after one row: its 10 mm would be a lever, and the plane one that nobody has measured."""
    row = pucks(m1, PANEL, TRUTH)[:3] + np.array([[0.0, 0.01, 0.0], [0.0, -0.01, 0.0], [0.0, 0.01, 0.0]])
    with pytest.raises(PanelFitError, match=r"do not span the panel: they lie on one line to within \d\.\d mm"):
        fit_panel(m1, PANEL, row, np.tile(ISOTROPIC, (3, 1, 1)), HEIGHT_M)


def test_three_points_fit_exactly(m1: Mirror) -> None:
    fit = fit_panel(m1, PANEL, pucks(m1, PANEL, TRUTH)[[0, 2, 7]], np.tile(ISOTROPIC, (3, 1, 1)), HEIGHT_M)
    assert fit.dof == 0
    assert fit.tilt_rad == pytest.approx(TRUTH.tilt_rad, abs=1e-8)


def test_covariances_must_match_the_points(m1: Mirror) -> None:
    with pytest.raises(PanelFitError, match=r"9 points, covariances of shape \(8, 3, 3\)"):
        fit_panel(m1, PANEL, pucks(m1, PANEL, TRUTH), np.tile(ISOTROPIC, (8, 1, 1)), HEIGHT_M)


@pytest.mark.parametrize("factor", [0.0, -1.0, np.nan])
def test_a_covariance_without_height_is_refused(m1: Mirror, factor: float) -> None:
    with pytest.raises(PanelFitError, match="variance along the normal is not positive"):
        fit_panel(m1, PANEL, pucks(m1, PANEL, TRUTH), np.tile(ISOTROPIC * factor, (9, 1, 1)), HEIGHT_M)


def test_a_panel_that_does_not_exist_is_refused(m1: Mirror) -> None:
    with pytest.raises(UnknownPanelError, match="no panel in row 1, column 9"):
        misaligned_puck_world(m1, PanelId(1, 9), TRUTH, DeckPose(0.0, 0.0, 0.0), HEIGHT_M)
