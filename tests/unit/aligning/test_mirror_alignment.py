"""Whole mirrors without a robot: recovered against injected, moves applied, and what cannot be fitted."""

from dataclasses import replace

import numpy as np
import pytest

from ccatp.config.models import AlignConfig, Config
from ccatp.core import PanelId, PointId, Vector3
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.mirror_alignment import SurveyResult, compare, survey_result
from ccatp.mirror.misalignment import PanelMisalignment
from ccatp.mirror.panel_alignment import Measured, PanelResult
from tests.unit.aligning.conftest import HEIGHT_M, Truth, exact_fix, load, misaligned, survey

CFG, M1 = load("fyst-m1")
PANEL = PanelId(3, 7)
TRUTH = PanelMisalignment(piston_m=73e-6, tip_rad=-140e-6, tilt_rad=95e-6)


def injected(truth: Truth) -> dict[PanelId, Vector3]:
    return {panel: (m.piston_m, m.tip_rad, m.tilt_rad) for panel, m in truth.items()}


def moved(truth: Truth, panels: tuple[PanelResult, ...], mirror: Mirror) -> dict[PanelId, PanelMisalignment]:
    """The panels after somebody has turned the five adjusters by the moves: a rigid body on five points."""
    found = {}
    for result in panels:
        body, before = mirror.panel(result.panel), truth[result.panel]
        places = np.array([
            body.from_deck(mirror.surface_point(x, y))[:2]
            for x, y in mirror.adjusters_on_deck(result.panel).values()
        ])  # fmt: skip
        plane = np.column_stack([np.ones(5), places[:, 1], places[:, 0]])
        piston, tip, tilt = np.linalg.lstsq(plane, result.rigid.moves.values_m, rcond=None)[0].tolist()
        found[result.panel] = PanelMisalignment(before.piston_m + piston, before.tip_rad + tip, before.tilt_rad + tilt)
    return found


def true_rms_m(truth: Truth, panels: tuple[PanelResult, ...], mirror: Mirror) -> float:
    """Half-wavefront error of the true panels: their planes at a grid of places, weighted by area across the beam."""
    total = weights = 0.0
    for result in panels:
        body, lies = mirror.panel(result.panel), truth[result.panel]
        half_x, half_y = body.half_x_m / body.axes[0][0], body.half_y_m / body.axes[1][1]
        grid = np.linspace(-1.0, 1.0, 41)[:-1] + 0.025
        x, y = np.meshgrid(half_x * grid, half_y * grid)
        plane = lies.piston_m + lies.tilt_rad * x + lies.tip_rad * y
        weight = half_x * half_y * result.cos_i
        total += weight * float(np.mean((plane * result.cos_i) ** 2))
        weights += weight
    return float(np.sqrt(total / weights))


def test_a_whole_mirror_is_recovered_and_its_moves_align_it(each: tuple[Config, Mirror]) -> None:
    cfg, mirror = each
    rng = np.random.default_rng(21)
    truth = misaligned(cfg, mirror.panels, rng)
    result = survey_result(mirror, cfg.align, HEIGHT_M, survey(cfg, mirror, truth, rng), mirror.panels)
    assert len(result.panels) == len(mirror.panels)
    assert (result.undetermined, result.warnings) == ((), ())
    found = compare(result.panels, injected(truth))
    assert found is not None
    assert found.dof == 3 * len(mirror.panels)
    assert found.low < found.chi2 < found.high
    assert found.agrees
    assert found.piston_rms_m < 1e-6
    chi2, dof = sum(p.fit.chi2 for p in result.panels), sum(p.fit.dof for p in result.panels)
    assert chi2 == pytest.approx(dof, abs=4.0 * (2 * dof) ** 0.5)
    # Before: that of the panels as they really lie. After: as predicted, when the moves are made.
    assert result.wavefront is not None
    assert result.wavefront.before_m == pytest.approx(true_rms_m(truth, result.panels, mirror), rel=0.01)
    aligned = moved(truth, result.panels, mirror)
    left = true_rms_m(aligned, result.panels, mirror)
    # The mean square of 200 parameters is known to 10 %, its root to 5 %; four sigmas.
    assert left == pytest.approx(result.wavefront.after_m, rel=0.25)
    assert left < 0.02 * result.wavefront.before_m
    # A second survey shows nothing but noise.
    again = survey_result(mirror, cfg.align, HEIGHT_M, survey(cfg, mirror, aligned, rng), mirror.panels)
    assert again.wavefront is not None
    assert again.wavefront.before_m < 2.0 * result.wavefront.after_m


def exact(panel: PanelId = PANEL) -> list[Measured]:
    return [exact_fix(M1, point, TRUTH) for point in M1.point_ids(panel)]


def result_of(measured: list[Measured], align: AlignConfig = CFG.align, height_m: float = HEIGHT_M) -> SurveyResult:
    return survey_result(M1, align, height_m, measured, [PANEL])


def shifted(one: Measured, shift_m: float) -> Measured:
    """The same fix, off along the normal of its panel."""
    normal = M1.rotate_world_from_deck(M1.panel(one.point.panel).axes[2])
    x, y, z = (p + shift_m * n for p, n in zip(one.fix.position_m, normal, strict=True))
    return Measured(one.point, replace(one.fix, position_m=(x, y, z)))


def test_an_outlier_is_left_out_with_a_warning() -> None:
    measured = exact()
    measured[3] = shifted(measured[3], 80e-6)
    result = result_of(measured)
    (panel,) = result.panels
    assert panel.outliers == (PointId(3, 7, 4),)
    assert (panel.fit.dof, len(panel.deviations.points)) == (5, 9)
    assert panel.fit.values == pytest.approx([TRUTH.piston_m, TRUTH.tip_rad, TRUTH.tilt_rad], abs=1e-8)
    assert result.warnings == ("panel 3/7: left out as outliers: 3/7/4; measure them again",)


def test_contradictions_beyond_outliers_are_told() -> None:
    rng = np.random.default_rng(4)
    measured = [shifted(one, float(rng.normal()) * 60e-6) for one in exact()]
    result = result_of(measured)
    assert any("contradict each other by more than they are uncertain" in line for line in result.warnings)
    # A floor that says so makes them agree.
    result = result_of(measured, CFG.align.model_copy(update={"point_floor_m": 60e-6}))
    assert result.warnings == ()
    assert result.panels[0].fit.sigma[0] == pytest.approx(20e-6, rel=0.01)


@pytest.mark.parametrize(
    ("count", "why"), [(n, f"{n} of 3 points that it takes") for n in range(3)] + [(3, "its points lie on one line")]
)
def test_too_few_points_determine_nothing(count: int, why: str) -> None:
    result = result_of(exact()[:count])
    assert (result.panels, result.wavefront) == ((), None)
    assert result.undetermined == ((PANEL, count, why),)


def test_three_points_determine_a_plane_without_shape_and_bending() -> None:
    result = result_of([exact()[k] for k in (0, 2, 7)])
    (panel,) = result.panels
    assert (panel.fit.dof, panel.shape, panel.bending, panel.probability) == (0, None, None, 1.0)
    assert result.wavefront_bent is None
    assert panel.fit.values == pytest.approx([TRUTH.piston_m, TRUTH.tip_rad, TRUTH.tilt_rad], abs=1e-8)


def test_a_fix_that_is_none_does_not_stop_the_others() -> None:
    far = exact(PanelId(2, 2))
    far[0] = Measured(far[0].point, replace(far[0].fix, position_m=(1e3, 1e3, 1e3)))
    certain = [exact_fix(M1, point, TRUTH, sigma_m=0.0) for point in M1.point_ids(PanelId(2, 3))]
    result = result_of([*exact(), *far, *certain])
    assert [panel.panel for panel in result.panels] == [PANEL]
    assert [one.panel for one in result.undetermined] == [(2, 2), (2, 3)]
    assert result.undetermined[0].why.startswith("a fix is far from the mirror: ")
    assert result.undetermined[1].why == "a fix claims to be exact: its covariance is not positive"


def test_a_mirror_without_light_is_told() -> None:
    result = result_of(exact(), CFG.align.model_copy(update={"light": {}}))
    assert result.warnings == (
        "no light is configured for fyst-m1 (align.light): its angle of incidence is taken as 0",
    )
    assert result.panels[0].cos_i == 1.0


def test_nothing_known_of_the_truth_is_no_comparison() -> None:
    assert compare(result_of(exact()).panels, {}) is None
