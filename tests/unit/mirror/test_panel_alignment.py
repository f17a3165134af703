"""One panel: deviations, least squares, adjuster moves, outliers and shapes; and the command ``ccatp align``."""

import csv
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from itertools import combinations
from math import sqrt
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest

from ccatp.cli import main
from ccatp.config.models import AlignConfig, Config
from ccatp.core import DeckPose, Fix, FloatArray, Measured, PanelId, PointId, Vector3
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.mirror_alignment import SurveyResult, compare, survey_result
from ccatp.mirror.misalignment import PanelMisalignment, misaligned_puck_world
from ccatp.mirror.multilateration import solve_fix
from ccatp.mirror.panel_alignment import (
    PanelResult,
    PanelWavefront,
    cos_incidence,
    fit_panels,
    half_size_m,
    mirror_wavefront,
    panel_result,
)
from ccatp.mirror.panel_explanations import explain, prices
from ccatp.mirror.panel_modes import (
    Deviations,
    Modes,
    adjustable,
    adjuster_moves,
    adjuster_places,
    deviations_of,
    fit_bent,
    fit_modes,
    gram,
    quadratic,
    rigid,
)
from ccatp.records.recorder import TELEMETRY, Recorder, RobotClock
from ccatp.sim.world import draw_misalignments
from tests.support.cases import slow_case
from tests.support.command import answered, printed
from tests.support.recorded import make_run, record
from tests.support.scenario import MIRRORS, World, config_of, world_of

HEIGHT_M = 0.05
Truth = Mapping[PanelId, PanelMisalignment]
Survey = Callable[[Truth, np.random.Generator], list[Measured]]


def misaligned(cfg: Config, panels: Iterable[PanelId], rng: np.random.Generator) -> dict[PanelId, PanelMisalignment]:
    return draw_misalignments(panels, cfg, rng)


def survey(cfg: Config, mirror: Mirror, truth: Truth, rng: np.random.Generator) -> list[Measured]:
    """Every point of the panels of ``truth``: the puck stands 3 mm beside it, eight lengths have the laser's noise."""
    measured = []
    collimators = dict(zip(mirror.channels, mirror.collimators_m, strict=True))
    for panel, misalignment in truth.items():
        for point in mirror.point_ids(panel):
            dx, dy = rng.normal(scale=3e-3, size=2)
            x, y = mirror.point_on_deck(point)
            pose = DeckPose(x + float(dx), y + float(dy), 0.0)
            puck = misaligned_puck_world(mirror, panel, misalignment, pose, HEIGHT_M)
            lengths = {}
            for channel, collimator in collimators.items():
                length = float(np.linalg.norm(collimator - np.array(puck)))
                lengths[channel] = length + float(rng.normal()) * (1e-6 + 2.5e-7 * length)
            measured.append(Measured(point, solve_fix(cfg.etalon, 1.0, puck, lengths, collimators)))
    return measured


def exact_fix(mirror: Mirror, point: PointId, misalignment: PanelMisalignment, sigma_m: float = 2e-6) -> Measured:
    """A fix without error that claims ``sigma_m`` along every axis."""
    x, y = mirror.point_on_deck(point)
    puck = misaligned_puck_world(mirror, point.panel, misalignment, DeckPose(x, y, 0.0), HEIGHT_M)
    covariance = tuple((np.eye(3) * sigma_m**2).ravel().tolist())
    return Measured(point, Fix(1.0, puck, covariance, 1.0, (1, 2, 3, 4), 0.0))


GRID_M = np.array([(x, y) for y in (-0.25, 0.0, 0.25) for x in (-0.22, 0.0, 0.22)])


def on_grid(values_m: FloatArray, sigma_m: float = 2e-6, places_m: FloatArray = GRID_M) -> Deviations:
    """Deviations at the nine places of a panel."""
    points = tuple(PointId(1, 1, k + 1) for k in range(len(places_m)))
    sigmas = np.full(len(places_m), sigma_m)
    return Deviations(points, places_m, places_m, values_m, sigmas, np.ones(len(places_m)))


# -- deviations -------------------------------------------------------------------------------------------------------

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


# -- least squares ----------------------------------------------------------------------------------------------------

ALL: list[tuple[Modes, int]] = [(rigid, 3), (adjustable, 5), (quadratic, 6)]
EVEN = np.full(9, 2e-6)


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


# -- adjuster moves ---------------------------------------------------------------------------------------------------

MOVED = PanelId(3, 7)


def test_the_adjusters_of_the_telescope_are_under_the_corner_points_and_the_centre(m1: Mirror) -> None:
    names, places = adjuster_places(m1, MOVED)
    assert names == ("V1", "V2", "V3", "V4", "V5")
    # M1's deck runs against the mirror frame's x, in which the tables give V1 at (-220, -250).
    assert places == pytest.approx(
        np.array([[0.22, -0.25], [-0.22, -0.25], [0.22, 0.25], [-0.22, 0.25], [0.0, 0.0]]), abs=1e-9
    )


def test_a_panel_that_stands_out_is_moved_away_from_the_robot(m1: Mirror) -> None:
    fit = fit_modes(rigid(GRID_M), np.full(9, 30e-6), EVEN)
    assert fit is not None
    moves = adjuster_moves(fit, rigid, adjuster_places(m1, MOVED)[1])
    assert moves.values_m == pytest.approx(np.full(5, -30e-6), abs=1e-15)
    # A corner: piston and both slopes at their lever arms.
    corner = 2e-6 * (1 / 9 + 1 / 6 + 1 / 6) ** 0.5
    assert moves.sigma_m == pytest.approx([corner] * 4 + [2e-6 / 3], rel=1e-6)


# -- outliers ---------------------------------------------------------------------------------------------------------

SIGMA_M = 2e-6
PRICE = prices(0.01, 693, 77)
RIGID = rigid(GRID_M) @ np.array([5e-5, -1e-4, 8e-5])
BENT = RIGID + quadratic(GRID_M)[:, 3:] @ np.array([1e-3, -4e-4, 7e-4])


def noise(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(scale=SIGMA_M, size=9)


def test_noise_makes_neither_outliers_nor_shapes() -> None:
    rng = np.random.default_rng(1)
    found = [explain(on_grid(RIGID + noise(rng)), PRICE) for _ in range(800)]
    # Ten mirrors' worth of panels: 0.1 alarms of either kind are expected.
    assert sum(not best.is_plain for best, *_ in found) <= 1
    assert sum(len(one) > 1 for one in found) <= 1


@pytest.mark.parametrize("shift_m", [25e-6, -60e-6, 2e-3])
def test_an_outlier_is_found_wherever_it_is(shift_m: float) -> None:
    rng = np.random.default_rng(2)
    for k in range(9):
        values = RIGID + noise(rng)
        values[k] += shift_m
        best, *others = explain(on_grid(values), PRICE)
        assert [int(i) for i in np.flatnonzero(~best.is_kept)] == [k]
        assert not best.has_shape
        assert others == []


def test_two_outliers_are_found_wherever_they_are() -> None:
    rng = np.random.default_rng(3)
    for pair in combinations(range(9), 2):
        values = RIGID + noise(rng)
        values[list(pair)] += [90e-6, 150e-6]
        found = explain(on_grid(values), PRICE)
        assert list(pair) in [np.flatnonzero(~one.is_kept).tolist() for one in found if not one.has_shape]
        assert np.flatnonzero(~found[0].is_kept).tolist() == list(pair)


def test_two_equal_outliers_that_a_bent_panel_explains_as_well_are_not_decided() -> None:
    """Of 36 pairs all have the truth among the explanations, and no move is further off than its sigmas say."""
    rng = np.random.default_rng(31)
    undecided, pulls = 0, []
    for pair in combinations(range(9), 2):
        measured = exact()
        for k in pair:
            measured[k] = shifted(measured[k], 50e-6)
        for k in range(9):
            measured[k] = shifted(measured[k], float(rng.normal()) * SIGMA_M)
        result = result_of(measured)
        (panel,) = result.panels
        explained = [panel.explained, *panel.alternatives]
        assert list(pair) in [np.flatnonzero(~one.is_kept).tolist() for one in explained if not one.has_shape]
        error = panel.fit.values - np.array([TRUTH.piston_m, TRUTH.tip_rad, TRUTH.tilt_rad])
        places = adjuster_places(M1, TILTED)[1]
        pulls.append(np.max(np.abs(rigid(places) @ error) / panel.rigid.moves.sigma_m))
        if panel.alternatives:
            undecided += 1
            assert panel.deciding is not None
            assert any("do not decide between" in line and "again, which decides" in line for line in result.warnings)
    # With one number off by its sigma more often than not, five adjusters are within four.
    assert max(pulls) < 4.0
    assert 5 <= undecided <= 25


@pytest.mark.parametrize(
    ("first_m", "second_m", "most_wrong"), [(50e-6, 50e-6, 0), (50e-6, -50e-6, 1), slow_case(50e-6, 30e-6, 1)]
)
def test_two_wrong_points_of_a_bent_panel_that_look_like_another_one_are_not_decided(
    first_m: float, second_m: float, most_wrong: int
) -> None:
    """The moves are uncertain by it. One pair of 36 looks like two wrong points of a rigid panel, which is likelier."""
    rng = np.random.default_rng(32)
    truth = fit_bent(on_grid(BENT), np.ones(9, dtype=np.bool_), rigid, half_size_m(M1.panel(TILTED)))
    assert truth is not None
    places = adjuster_places(M1, TILTED)[1]
    pulls = []
    for pair in combinations(range(9), 2):
        values = BENT + noise(rng)
        values[list(pair)] += [first_m, second_m]
        panel = panel_result(M1, TILTED, on_grid(values), PRICE, 1.0)
        assert panel is not None
        pulls.append(np.max(np.abs(rigid(places) @ (panel.fit.values - truth.values)) / panel.rigid.moves.sigma_m))
    # The largest of five moves of 36 panels.
    assert sum(pull > 4.0 for pull in pulls) <= most_wrong


def test_one_wrong_point_of_a_bent_panel_is_decided_by_further_readings() -> None:
    """Two wrong points might look like it; the points that are asked for are measured again until it is decided."""
    rng = np.random.default_rng(33)
    for k in range(9):
        values, points, asked = BENT + noise(rng), [*range(9)], list[int]()
        values[k] += 50e-6
        while True:
            named = tuple(PointId(1, 1, at + 1) for at in points)
            measured = on_grid(values, places_m=GRID_M[points])._replace(points=named)
            panel = panel_result(M1, TILTED, measured, PRICE, 1.0)
            assert panel is not None
            if panel.deciding is None:
                break
            asked.append(panel.deciding.point - 1)
            points.append(asked[-1])
            values = np.append(values, BENT[asked[-1]] + rng.normal() * SIGMA_M)
        assert np.flatnonzero(~panel.is_kept).tolist() == [k]
        assert len(set(asked)) == len(asked)
        assert 1 <= len(asked) <= 4


def test_a_bent_panel_keeps_its_points() -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        best, *_ = explain(on_grid(BENT + noise(rng)), PRICE)
        assert best.has_shape
        assert best.is_kept.all()


HALF_M = 0.335, 0.375


@pytest.mark.parametrize("modes", [rigid, adjustable])
def test_the_plane_of_a_bent_panel_does_not_depend_on_the_points_that_show_it(modes: Modes) -> None:
    """Its points without noise; nine of them, or seven: the plane is that of the whole area."""
    every = on_grid(BENT)
    fits = []
    for left_out in ((), *combinations(range(9), 2)):
        is_kept = np.ones(9, dtype=np.bool_)
        is_kept[list(left_out)] = False
        if (fit := fit_bent(every, is_kept, modes, HALF_M)) is not None:
            fits.append(fit.values)
    assert len(fits) > 25
    assert np.ptp(np.array(fits), axis=0) == pytest.approx(np.zeros(fits[0].size), abs=1e-12)
    # Independent: least squares over a dense grid of the area.
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 201) * HALF_M[0], np.linspace(-1.0, 1.0, 201) * HALF_M[1])
    dense = np.column_stack([x.ravel(), y.ravel()])
    coefficients = np.linalg.lstsq(quadratic(GRID_M), BENT, rcond=None)[0]
    expected = np.linalg.lstsq(modes(dense), quadratic(dense) @ coefficients, rcond=None)[0]
    # The grid has its outer points on the rim: 1 % more than the area.
    assert fits[0] == pytest.approx(expected, rel=0.02, abs=1e-7)


def test_the_covariance_and_the_residuals_of_a_bent_panel_are_as_stated() -> None:
    rng = np.random.default_rng(12)
    is_kept = np.arange(9) != 2
    exact = fit_bent(on_grid(BENT), is_kept, rigid, HALF_M)
    assert exact is not None
    distances, residuals = [], []
    for _ in range(300):
        fit = fit_bent(on_grid(BENT + noise(rng)), is_kept, rigid, HALF_M)
        assert fit is not None
        error = fit.values - exact.values
        distances.append(error @ np.linalg.solve(fit.covariance, error))
        residuals.append(np.mean((fit.residuals_m - exact.residuals_m) ** 2))
    # Sum of 300 chi-squares of three degrees of freedom: variance 2 x 3 x 300; four sigmas.
    assert sum(distances) == pytest.approx(900.0, abs=4.0 * 1800**0.5)
    assert np.mean(residuals) == pytest.approx(exact.residual_variance_m2, rel=0.15)


@pytest.mark.parametrize("error_m", [50e-6, slow_case(-200e-6)])
def test_a_wrong_point_of_a_bent_panel_does_not_move_it(error_m: float) -> None:
    rng = np.random.default_rng(21)
    truth = fit_bent(on_grid(BENT), np.ones(9, dtype=np.bool_), rigid, half_size_m(M1.panel(TILTED)))
    assert truth is not None
    places = adjuster_places(M1, TILTED)[1]
    pulls = []
    for k in [*range(9)] * 4:
        values = BENT + noise(rng)
        values[k] += error_m
        panel = panel_result(M1, TILTED, on_grid(values), PRICE, 1.0)
        assert panel is not None
        assert [point.point - 1 for point in panel.outliers] == [k]
        error = rigid(places) @ (panel.fit.values - truth.values)
        pulls.append(np.max(np.abs(error) / panel.rigid.moves.sigma_m))
    # The largest of five moves of 36 panels.
    assert max(pulls) < 4.0


@pytest.mark.parametrize("count", [3, 4, 5])
def test_few_points_accuse_nobody(count: int) -> None:
    # With so few, leaving any one of several points out explains the contradiction as well.
    some = GRID_M[[0, 2, 6, 8, 4]][:count]
    values = np.zeros(count)
    values[0] = 1e-3
    (best,) = explain(on_grid(values, places_m=some), PRICE)
    assert best.is_plain


# -- half-wavefront error ---------------------------------------------------------------------------------------------


def test_light_on_m2_comes_from_m1() -> None:
    # Independent: rays along world +z, reflected at the panels of M1 by the law of reflection, and traced to M2.
    _, m1 = world_of()
    cfg, m2 = world_of("fyst-m2")
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


def test_panels_count_with_their_area_across_the_beam() -> None:
    one = PanelWavefront(3.0, 4e-12, 1e-12, 0.0, 1e-12, 2e-6)
    two = PanelWavefront(1.0, 16e-12, 1e-12, 0.0, 1e-12, -4e-6)
    found = mirror_wavefront([one, two])
    assert found is not None
    assert found.before_m == pytest.approx(sqrt(7e-12))
    assert found.before_level_m == pytest.approx(sqrt(7e-12 - (0.5e-6) ** 2))
    assert found.after_m == pytest.approx(1e-6)


# -- whole mirrors -----------------------------------------------------------------------------------------------------


CFG, M1 = world_of()
TILTED = PanelId(3, 7)
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


@pytest.mark.parametrize("world", ["fyst-m2", "thesis-m1", *map(slow_case, ("fyst-m1", "thesis-m2"))], indirect=True)
def test_a_whole_mirror_is_recovered_and_its_moves_align_it(world: World) -> None:
    cfg, mirror = world
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


def exact(panel: PanelId = TILTED) -> list[Measured]:
    return [exact_fix(M1, point, TRUTH) for point in M1.point_ids(panel)]


def result_of(measured: list[Measured], align: AlignConfig = CFG.align, height_m: float = HEIGHT_M) -> SurveyResult:
    return survey_result(M1, align, height_m, measured, [TILTED])


def shifted(one: Measured, shift_m: float) -> Measured:
    """The same fix, off along the normal of its panel."""
    normal = M1.rotate_world_from_deck(M1.panel(one.point.panel).axes[2])
    x, y, z = (p + shift_m * n for p, n in zip(one.fix.position_m, normal, strict=True))
    return Measured(one.point, replace(one.fix, position_m=(x, y, z)))


def unreliable(one: Measured) -> Measured:
    """The same fix a millimetre off, whose lengths contradict each other."""
    moved = shifted(one, 1e-3)
    return Measured(one.point, replace(moved.fix, metrology="unreliable", suspects=(1, 2, 3, 4)))


def test_points_whose_lengths_contradict_each_other_do_not_move_a_panel() -> None:
    measured = exact()
    some = result_of([unreliable(one) if k < 4 else one for k, one in enumerate(measured)])
    assert some.panels[0].fit.values == pytest.approx(result_of(measured[4:]).panels[0].fit.values, abs=1e-12)
    assert some.warnings[0].startswith("not used, their lengths contradict each other: ")
    none = result_of([unreliable(one) for one in measured])
    assert none.panels == ()
    assert none.undetermined[0].why == "the lengths of 9 of its 9 points contradict each other"
    assert fit_panels(M1, [unreliable(one) for one in measured], HEIGHT_M) == {}


def test_contradictions_beyond_outliers_are_reported() -> None:
    rng = np.random.default_rng(4)
    measured = [shifted(one, float(rng.normal()) * 60e-6) for one in exact()]
    result = result_of(measured)
    (line,) = result.warnings
    assert "the points scatter about the panels" in line
    assert result.sigma_factor == pytest.approx(30.0, rel=0.5)
    # A floor that says so makes them agree.
    result = result_of(measured, CFG.align.model_copy(update={"point_floor_m": 60e-6}))
    assert result.warnings == ()
    assert result.panels[0].fit.sigma[0] == pytest.approx(20e-6, rel=0.01)


@pytest.mark.parametrize("rough_m", [20e-6, slow_case(28e-6)])
def test_points_that_scatter_more_than_they_are_uncertain_have_larger_sigmas(rough_m: float) -> None:
    """Panels that are not smooth: no point of them is an outlier, and the moves are as uncertain as they are wrong."""
    rng = np.random.default_rng(6)
    truth = misaligned(CFG, M1.panels, rng)
    measured = [
        shifted(exact_fix(M1, point, lies), float(rng.normal()) * rough_m)
        for panel, lies in truth.items()
        for point in M1.point_ids(panel)
    ]
    result = survey_result(M1, CFG.align, HEIGHT_M, measured, truth)
    (line,) = result.warnings
    assert "the points scatter about the panels" in line
    assert result.sigma_factor * 2e-6 == pytest.approx(rough_m, rel=0.25)
    assert sum(len(panel.outliers) for panel in result.panels) == 0
    found = compare(result.panels, injected(truth))
    assert found is not None
    assert found.chi2 / found.dof == pytest.approx(1.0, abs=0.45)  # as the factor, which is squared


def test_one_rough_panel_of_many_has_larger_sigmas_alone() -> None:
    rng = np.random.default_rng(8)
    panels = [*M1.panels][:12]
    measured = []
    for panel in panels:
        scale = 60e-6 if panel == panels[3] else 2e-6
        measured += [
            shifted(exact_fix(M1, point, PanelMisalignment(0.0, 0.0, 0.0)), float(rng.normal()) * scale)
            for point in M1.point_ids(panel)
        ]
    result = survey_result(M1, CFG.align, HEIGHT_M, measured, panels)
    assert result.sigma_factor == 1.0
    (line,) = [one for one in result.warnings if "contradict each other by more than they are uncertain" in one]
    assert line.startswith(f"panel {panels[3].row}/{panels[3].col}")
    rough = result.panels[3]
    assert f"are multiplied by {rough.sigma_factor:.1f}" in line
    assert np.max(np.abs(rough.rigid.moves.values_m) / rough.rigid.moves.sigma_m) < 4.0


@pytest.mark.parametrize(
    ("count", "why"), [(n, f"{n} of 3 points that it takes") for n in range(3)] + [(3, "its points lie on one line")]
)
def test_too_few_points_determine_nothing(count: int, why: str) -> None:
    result = result_of(exact()[:count])
    assert (result.panels, result.wavefront) == ((), None)
    assert result.undetermined == ((TILTED, count, why),)


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
    assert [panel.panel for panel in result.panels] == [TILTED]
    assert [one.panel for one in result.undetermined] == [(2, 2), (2, 3)]
    assert result.undetermined[0].why.startswith("a fix is far from the mirror: ")
    assert result.undetermined[1].why == "a fix claims to be exact: its covariance is not positive"


def test_a_mirror_without_light_is_reported() -> None:
    result = result_of(exact(), CFG.align.model_copy(update={"light": {}}))
    assert result.warnings == (
        "no light is configured for fyst-m1 (align.light): its angle of incidence is taken as 0",
    )
    assert result.panels[0].cos_i == 1.0


def test_nothing_known_of_the_truth_is_no_comparison() -> None:
    assert compare(result_of(exact()).panels, {}) is None


# -- the command ``ccatp align``: on surveys in process on all mirrors, its JSON, its files, its refusals --------------

ALIGNED = PanelId(3, 7)
LIES = PanelMisalignment(40e-6, -90e-6, 120e-6)


def aligned(capsys: pytest.CaptureFixture[str], run_dir: Path, *args: str) -> Any:
    return answered(capsys, "align", run_dir, *args)


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """One panel measured, one begun, one to come; on one point lay something."""
    rng = np.random.default_rng(1)
    truth = misaligned(CFG, M1.panels, rng) | {ALIGNED: LIES}
    begun, to_come = PanelId(3, 8), PanelId(3, 9)
    planned = [point for panel in (ALIGNED, begun, to_come) for point in M1.point_ids(panel)]
    measured = survey(CFG, M1, {ALIGNED: LIES, begun: truth[begun]}, rng)[:11]
    high = PanelMisalignment(LIES.piston_m + 300e-6, LIES.tip_rad, LIES.tilt_rad)
    measured[5] = exact_fix(M1, measured[5].point, high)
    return make_run(tmp_path / "run", CFG, planned, measured, truth)


@pytest.mark.parametrize("name", [MIRRORS[0], *(pytest.param(name, marks=pytest.mark.slow) for name in MIRRORS[1:])])
def test_a_survey_recovers_what_was_simulated(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = aligned(capsys, record(tmp_path / "run", run__mirror=name, run__world="thesis"))
    assert (found["mirror"], found["world"], found["warnings"]) == (name, "thesis", [])
    assert found["points"] == {"total": 9, "measured": 9, "outliers": 0}
    truth = found["truth"]
    assert (truth["panels"], truth["dof"], truth["agrees"]) == (1, 3, True)
    assert truth["band_99"][0] < truth["chi2"] < truth["band_99"][1]
    assert truth["piston_rms_um"] < 3.0
    # One panel hardly determines the scale of the lengths, which is most of it.
    assert found["rms_after_um"] < 5.0 < found["rms_before_um"]


def test_the_json_is_that_of_the_contract(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = aligned(capsys, run_dir)
    (panel,) = found["panels"]
    assert {"row", "col", "piston_um", "tip_urad", "tilt_urad", "sigma", "adjusters_um", "chi2"} <= set(panel)
    assert (panel["row"], panel["col"]) == ALIGNED
    assert panel["piston_um"] == pytest.approx(40.0, abs=3.0)
    assert panel["tip_urad"] == pytest.approx(-90.0, abs=15.0)
    assert panel["tilt_urad"] == pytest.approx(120.0, abs=15.0)
    assert (len(panel["sigma"]), len(panel["adjusters_um"]), panel["dof"]) == (3, 5, 5)
    assert found["adjusters"] == ["V1", "V2", "V3", "V4", "V5"]
    assert panel["adjusters_um"][4] == -panel["piston_um"]  # the fifth is at the centre; > 0 towards the robot
    assert (panel["outliers"], found["points"]["outliers"]) == ([6], 1)
    assert [one["is_outlier"] for one in panel["deviations"]] == [False] * 5 + [True] + [False] * 3
    assert panel["deviations"][5]["residual_um"] == pytest.approx(300.0, abs=10.0)
    assert found["rms_after_um"] < 5.0 < found["rms_before_um"]
    assert [(one["row"], one["col"], one["points"]) for one in found["undetermined"]] == [(3, 8, 2), (3, 9, 0)]


def test_the_table_tells_the_same(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["align", str(run_dir)]) == 0
    out, err = capsys.readouterr()
    assert "fyst-m1, simulation, world thesis, seed 1\n11 of 27 points measured, 1 of them not used\n" in out
    assert "\n3/7         8 " in out
    assert "not used: 3/7/6" in out
    assert "panel 3/8 not determined: 2 of 3 points that it takes\n1 panel not measured\n" in out
    assert "half-wavefront error" in out
    assert "inside its 99 % band" in out
    assert err == (
        "ccatp: warning: panel 3/7: not used, because they are outliers: 3/7/6; measure them again\n"
        "ccatp: warning: panel 3/8 not determined: 2 of 3 points that it takes\n"
    )


def with_lengths(one: Measured) -> Measured:
    collimators = dict(zip(M1.channels, M1.collimators_m, strict=True))
    lengths = tuple(float(np.linalg.norm(np.subtract(one.fix.position_m, collimators[k]))) for k in one.fix.channels)
    return Measured(one.point, replace(one.fix, lengths_m=lengths))


def test_two_surveys_of_a_night_are_adjusted_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Their servers may have different ports; a laser of other uncertainty is another one."""
    rng = np.random.default_rng(2)
    for name, panel, keys in (
        ("first", ALIGNED, {}),
        ("second", PanelId(4, 5), {"etalon__port": 4711}),
        ("other", PanelId(4, 5), {"etalon__offset_sigma_m": 3e-6}),
    ):
        measured = [with_lengths(one) for one in survey(CFG, M1, {panel: LIES}, rng)]
        make_run(tmp_path / name, config_of(**keys), M1.point_ids(panel), measured, None)
    found = aligned(capsys, tmp_path / "first", "--with", str(tmp_path / "second"))
    assert {one["survey"] for one in found["network"]["effects"] if one["kind"] == "scale"} == {0, 1}
    assert [(one["row"], one["col"]) for one in found["panels"]] == [ALIGNED]
    assert main(["align", str(tmp_path / "first"), "--with", str(tmp_path / "other")]) == 2
    assert "its etalon.offset_sigma_m is not that of the first run" in capsys.readouterr().err
    copytree(tmp_path / "first", tmp_path / "copy")
    for same in ("first", "copy"):
        assert main(["align", str(tmp_path / "first"), "--with", str(tmp_path / same)]) == 2
        assert "the same lengths at 9 points: they are one survey" in capsys.readouterr().err
    # A change begins at a point and lasts, so the order of the surveys matters.
    for name, begun_s in (("first", 9000.0), ("second", 5000.0)):
        clock = RobotClock(is_simulation=True, now_ns=partial(round, 1e9 * begun_s))
        recorder = Recorder(tmp_path / name / TELEMETRY, [("mission", {})], is_simulation=True, clock=clock)
        recorder.write("mission", 1.0, b"{}")
        recorder.close()
    aligned(capsys, tmp_path / "first", "--with", str(tmp_path / "second"))
    assert main(["align", str(tmp_path / "second"), "--with", str(tmp_path / "first")]) == 2
    assert "name the latest survey first" in capsys.readouterr().err


def test_a_survey_without_a_panel_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_dir = make_run(tmp_path / "run", CFG, M1.point_ids(ALIGNED), [], None)
    found = aligned(capsys, run_dir)
    assert (found["panels"], found["rms_before_um"], found["rms_after_um"]) == ([], None, None)
    assert (found["truth"], found["world"]) == (None, None)
    assert "1 panel not measured" in printed(capsys, "align", run_dir)


def test_the_csv_has_a_line_a_panel_and_the_figure_is_drawn(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "panels.pdf"
    found = aligned(capsys, run_dir, "--csv", str(tmp_path / "moves.csv"), "--figure", str(picture))
    assert picture.read_bytes().startswith(b"%PDF")
    with (tmp_path / "moves.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["row"], row["col"], row["points"], row["outliers"], row["is_bent"]) == ("3", "7", "9", "6", "0")
    assert [float(row[f"V{k}_um"]) for k in range(1, 6)] == found["panels"][0]["adjusters_um"]
    assert float(row["sigma_piston_um"]) == found["panels"][0]["sigma"][0]


def test_settings_act(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    usual = aligned(capsys, run_dir)["panels"][0]
    higher = aligned(capsys, run_dir, "--set", "robot.puck_height_m=0.0501")["panels"][0]
    assert higher["piston_um"] == pytest.approx(usual["piston_um"] - 100.0, abs=0.2)
    floor = aligned(capsys, run_dir, "--set", "align.point_floor_m=1e-3")["panels"][0]
    assert floor["sigma"][0] == pytest.approx(1e3 / 3, rel=0.01)
    assert floor["outliers"] == []


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--csv", "nowhere/moves.csv"], "--csv: no directory nowhere; make it first"),
        (["--set", "run.seed=2"], "run.seed: has no effect on the alignment; what has: align., robot.puck_height_m"),
        (["--set", "align.false_alarm=2"], "align.false_alarm"),
        (
            ["--set", "align.light.fyst-m1.direction_world=[0.0, 0.0, 0.0]"],
            "direction_world = [0, 0, 0] is no direction",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    args: list[str], message: str, run_dir: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["align", str(run_dir), *args]) == 2
    out, err = capsys.readouterr()
    *warnings, line = err.splitlines()
    assert all("warning" in one for one in warnings)
    assert message in line
    assert out == ""


def test_a_csv_that_cannot_be_written_and_no_run_are_errors(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run_dir / "dir.csv").symlink_to("/dev/full")
    assert main(["align", str(run_dir), "--csv", str(run_dir / "dir.csv")]) == 2  # the table is printed all the same
    assert "--csv: cannot write" in capsys.readouterr().err
    (run_dir / "config.toml").unlink()
    assert main(["align", str(run_dir)]) == 2
    assert capsys.readouterr().err == f"ccatp: {run_dir}: no config.toml there; name the directory of a run\n"
