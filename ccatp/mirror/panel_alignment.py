"""The alignment of one panel: adjuster moves, shape, half-wavefront error. The method is in docs/align.md."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import exp, sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from ccatp.config.models import LightConfig
from ccatp.core import UNRELIABLE, BoolArray, FloatArray, Measured, PanelId, PointId, Vector3
from ccatp.mirror.layout import Panel
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panel_explanations import (
    CURVATURES,
    REDUNDANCY,
    Explanation,
    Prices,
    contradicts,
    explain,
    plain,
    rivals,
)
from ccatp.mirror.panel_modes import (
    Deviations,
    ModeFit,
    Modes,
    Moves,
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


class PanelWavefront(NamedTuple):
    """One panel's mean squares of the half-wavefront error: fitted, of the fit's uncertainty, unexplained, of noise.

    The unexplained part may be < 0. ``mean_m``: mean half-wavefront error before the moves.
    """

    weight_m2: float
    fitted_m2: float
    uncertain_m2: float
    unexplained_m2: float
    noise_m2: float
    mean_m: float


class MirrorWavefront(NamedTuple):
    """Root mean squares over all panels that could be fitted, m.

    ``before_level_m``: without the mean over the beam, which is common to all light. ``after_m``: predicted for after
    the moves. ``noise_m``: of a single point; a survey after the moves shows the root sum of squares of both.
    """

    before_m: float
    before_level_m: float
    after_m: float
    noise_m: float


def cos_incidence(mirror: Mirror, panel: PanelId, light: LightConfig | None) -> float:
    """Cosine of the angle between a panel's normal and the light at its centre; 1 without ``light``."""
    if light is None:
        return 1.0
    body = mirror.panel(panel)
    # Vector from the panel to the focus of the rays, times the vergence; for parallel light the direction itself.
    direction = np.array(light.direction_world)
    direction /= np.linalg.norm(direction)
    offset = np.array(mirror.world_from_deck(body.origin)) - mirror.world_from_mirror((0.0, 0.0, 0.0))
    direction -= light.vergence_1_m * offset
    normal = np.array(mirror.rotate_world_from_deck(body.axes[2]))
    return float(abs(direction @ normal) / np.linalg.norm(direction))


def half_size_m(panel: Panel) -> tuple[float, float]:
    """Half a panel's size along its own x and y: half the deck size over the cosines of the slopes."""
    return panel.half_x_m / panel.axes[0][0], panel.half_y_m / panel.axes[1][1]


def panel_wavefront(panel: Panel, cos_i: float, fit: ModeFit, gram: FloatArray, sigmas_m: FloatArray) -> PanelWavefront:
    """Half-wavefront error of one panel; ``gram`` is of the fitted modes."""
    half_x, half_y = half_size_m(panel)
    square = cos_i * cos_i
    return PanelWavefront(
        weight_m2=4.0 * half_x * half_y * cos_i,
        fitted_m2=square * float(fit.values @ gram @ fit.values),
        uncertain_m2=square * float(np.trace(fit.covariance @ gram)),
        unexplained_m2=square * fit.unexplained_m2,
        noise_m2=square * float(np.mean(sigmas_m**2)),
        # The first mode is 1, so the first row of the products holds the means of the modes.
        mean_m=cos_i * float(gram[0] @ fit.values),
    )


def mirror_wavefront(panels: Iterable[PanelWavefront]) -> MirrorWavefront | None:
    """Root mean square over panels, weighted by their areas across the beam; None without any."""
    table = np.array(list(panels), dtype=np.float64).reshape(-1, len(PanelWavefront._fields))
    if not len(table):
        return None
    weights = table[:, 0] / table[:, 0].sum()
    fitted, uncertain, unexplained, noise, mean = (float(value) for value in weights @ table[:, 1:])
    left = max(unexplained, 0.0)
    level = max(fitted - mean * mean, 0.0) + left
    return MirrorWavefront(sqrt(fitted + left), sqrt(level), sqrt(uncertain + left), sqrt(noise))


# Least spread of the points. A single row, with an arrival tolerance of 10 mm, would give tilts of about 0.1 rad.
_MIN_SPREAD_M = 0.02


def fit_panels(mirror: Mirror, measured: Iterable[Measured], puck_height_m: float) -> dict[PanelId, Vector3]:
    """Piston (m), tip and tilt (rad) of every panel with enough reliable points, for the summary of a survey."""
    by_panel: dict[PanelId, list[Measured]] = {}
    for one in measured:
        if one.fix.metrology == UNRELIABLE:
            continue
        by_panel.setdefault(one.point.panel, []).append(one)
    fits = {}
    for panel, own in sorted(by_panel.items()):
        found = deviations_of(mirror, panel, own, puck_height_m, 0.0)
        centred = found.places_m - found.places_m.mean(axis=0)
        spread_m = float(np.linalg.svd(centred, compute_uv=False)[-1]) / sqrt(len(own))
        fit = fit_modes(found.lever[:, None] * rigid(found.places_m), found.values_m, found.sigmas_m)
        if fit is not None and spread_m >= _MIN_SPREAD_M:  # otherwise the survey ended early
            piston_m, tip_rad, tilt_rad = fit.values.tolist()
            fits[panel] = piston_m, tip_rad, tilt_rad
    return fits


SHAPE = slice(3, 6)


class PanelShape(NamedTuple):
    """Curvatures D_xx, D_xy, D_yy and their sigmas, 1/m, shape (3,); ``gain``: reduction of the chi-square."""

    values_1_m: FloatArray
    sigma_1_m: FloatArray
    gain: float
    probability: float
    chi2: float
    dof: int
    is_significant: bool


class AdjusterPlan(NamedTuple):
    """Moves of the adjusters, and the panel's half-wavefront error with them."""

    moves: Moves
    wavefront: PanelWavefront


@dataclass(frozen=True, slots=True, eq=False)
class PanelResult:
    """Alignment of a panel: piston, m, tip and tilt, rad; of a bent panel those of the plane that fits its area best.

    The adjusters can correct these without bending the panel. ``is_kept`` (k,): the points that are not outliers.
    ``shape``, and ``bending`` (moves that also remove twist and bowl), are None if there are too few points.
    ``sigma_factor``: by which the standard deviations are multiplied, as the points contradict each other.
    ``alternatives``: other explanations of the deviations that the points do not exclude; the covariances contain the
    differences. ``deciding``: the point that tells the chosen explanation from the others if it is measured again.
    """

    panel: PanelId
    deviations: Deviations
    is_kept: BoolArray
    cos_i: float
    fit: ModeFit
    shape: PanelShape | None
    adjusters: tuple[str, ...]
    rigid: AdjusterPlan
    bending: AdjusterPlan | None
    sigma_factor: float = 1.0
    alternatives: tuple[Explanation, ...] = ()
    deciding: PointId | None = None

    @property
    def outliers(self) -> tuple[PointId, ...]:
        """The points left out."""
        return tuple(p for p, kept in zip(self.deviations.points, self.is_kept, strict=True) if not kept)

    @property
    def explained(self) -> Explanation:
        """The explanation that was used."""
        has_shape = self.shape is not None and self.shape.is_significant
        return Explanation(self.is_kept, has_shape, 0.0)

    @property
    def model(self) -> "ModeFit | PanelShape":
        """The chosen model, with its ``chi2`` and ``dof``."""
        return self.shape if self.shape is not None and self.shape.is_significant else self.fit

    @property
    def probability(self) -> float:
        """Probability that the points' uncertainty alone gives this chi-square of the chosen model, or a larger one."""
        return float(chdtrc(self.model.dof, self.model.chi2)) if self.model.dof > 0 else 1.0


def panel_result(
    mirror: Mirror, panel: PanelId, deviations: Deviations, price: Prices, cos_i: float
) -> PanelResult | None:
    """Fit a panel; None if its points do not determine piston, tip and tilt."""
    explanations = explain(deviations, price)
    factor = 1.0
    if contradicts(explanations[0], price):
        # No explanation holds: the points scatter as they do.
        explanations = (plain(deviations),)
        every = fit_modes(
            deviations.lever[:, None] * rigid(deviations.places_m), deviations.values_m, deviations.sigmas_m
        )
        factor = 1.0 if every is None else max(every.chi2 / every.dof, 1.0)
    best, others = explanations[0], rivals(explanations)
    kept, has_shape = best.is_kept, best.has_shape
    places, lever = deviations.places_m[kept], deviations.lever[kept, None]
    values, sigmas = deviations.values_m[kept], deviations.sigmas_m[kept]
    common = None if deviations.common is None else deviations.common[kept]
    body = mirror.panel(panel)
    half_m = half_size_m(body)
    fit = _fit_of(deviations, best, rigid, half_m)
    if fit is None:
        return None
    full = fit_modes(lever * quadratic(places), values, sigmas, common)
    spread = _spread(deviations, explanations, others, half_m)
    fit = fit.widened(spread, factor)
    names, adjusters = adjuster_places(mirror, panel)

    def plan(found: ModeFit, modes: Modes) -> AdjusterPlan:
        wavefront = panel_wavefront(body, cos_i, found, gram(modes, half_m), sigmas)
        return AdjusterPlan(adjuster_moves(found, modes, adjusters), wavefront)

    bent = _fit_of(deviations, best, adjustable, half_m)
    bent = None if bent is None else bent.widened(spread, factor)
    shape = None
    if full is not None:
        plane = fit_modes(lever * rigid(places), values, sigmas)
        gain = 0.0 if plane is None else plane.chi2 - full.chi2
        chance = float(chdtrc(CURVATURES, max(gain, 0.0)))
        values_1_m, sigma_1_m = full.values[SHAPE], full.sigma[SHAPE]
        shape = PanelShape(values_1_m, sigma_1_m, gain, chance, full.chi2, full.dof, has_shape)
    return PanelResult(
        panel=panel,
        deviations=deviations,
        is_kept=kept,
        cos_i=cos_i,
        fit=fit,
        shape=shape,
        adjusters=names,
        rigid=plan(fit, rigid),
        bending=None if bent is None else plan(bent, adjustable),
        sigma_factor=sqrt(factor),
        alternatives=others,
        deciding=_deciding(deviations, [best, *others]) if others else None,
    )


def _fit_of(deviations: Deviations, one: Explanation, modes: Modes, half_m: tuple[float, float]) -> ModeFit | None:
    """The ``modes`` of a panel by one explanation."""
    kept = one.is_kept
    if one.has_shape:
        return fit_bent(deviations, kept, modes, half_m)
    common = None if deviations.common is None else deviations.common[kept]
    design = deviations.lever[kept, None] * modes(deviations.places_m[kept])
    return fit_modes(design, deviations.values_m[kept], deviations.sigmas_m[kept], common)


def all_points(deviations: Deviations) -> ModeFit | None:
    """The fit of all points, with curvatures if that leaves redundant points as for one outlier."""
    modes = quadratic if len(deviations.points) >= 3 + CURVATURES + REDUNDANCY else rigid
    return fit_modes(deviations.lever[:, None] * modes(deviations.places_m), deviations.values_m, deviations.sigmas_m)


def _spread(
    deviations: Deviations,
    explanations: Sequence[Explanation],
    others: Sequence[Explanation],
    half_m: tuple[float, float],
) -> FloatArray:
    """Mean square differences (3, 3) of the planes of other explanations from that of the best.

    The rivals have equal weights. Those that only say more of the same have their probability with these points.
    """
    best, *rest = explanations
    weights = {id(one): 1.0 / len(others) for one in others}
    found = np.zeros((3, 3))
    plane = _fit_of(deviations, best, rigid, half_m)
    for one in rest:
        fit = _fit_of(deviations, one, rigid, half_m)
        if fit is not None and plane is not None:
            difference = fit.values - plane.values
            found += weights.get(id(one), exp(-0.5 * (one.cost - best.cost))) * np.outer(difference, difference)
    return found


def _deciding(deviations: Deviations, explanations: Sequence[Explanation]) -> PointId:
    """The point that tells the first of the explanations from all others; one that was not measured again, if possible.

    At it the difference of the surface from the nearest of the others is largest.
    """
    surfaces = []
    for one in explanations:
        modes = quadratic if one.has_shape else rigid
        design = deviations.lever[one.is_kept, None] * modes(deviations.places_m[one.is_kept])
        fit = fit_modes(design, deviations.values_m[one.is_kept], deviations.sigmas_m[one.is_kept])
        if fit is not None:
            surfaces.append(modes(deviations.places_m) @ fit.values)
    differences = np.min(np.abs(np.array(surfaces[1:]) - surfaces[0]), axis=0)
    is_repeated = deviations.extra_readings > 0.0
    is_repeated |= np.array([deviations.points.count(point) > 1 for point in deviations.points])
    if not is_repeated.all():
        differences[is_repeated] = 0.0
    return deviations.points[int(np.argmax(differences))]


def on_grid_m(mirror: Mirror, panel: PanelResult, cells: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The displacement along the panel's normal on a grid of cells, with the curvatures if they are significant.

    Edges along deck x and deck y (cells + 1,), values (cells, cells), rows along x, m.
    """
    body = mirror.panel(panel.panel)
    x = np.linspace(body.x_m - body.half_x_m, body.x_m + body.half_x_m, cells + 1)
    y = np.linspace(body.y_m - body.half_y_m, body.y_m + body.half_y_m, cells + 1)
    middle_x, middle_y = np.meshgrid((x[1:] + x[:-1]) / 2.0, (y[1:] + y[:-1]) / 2.0)
    deck = np.column_stack([middle_x.ravel(), middle_y.ravel()]).tolist()
    places = np.array([body.from_deck(mirror.surface.point(*place))[:2] for place in deck])
    found = rigid(places) @ panel.fit.values
    if panel.shape is not None and panel.shape.is_significant:
        # The rigid fit includes the mean of the curvatures' part, so it is subtracted here.
        bend = quadratic(places)[:, 3:] @ panel.shape.values_1_m
        found += bend - bend.mean()
    return x, y, found.reshape(cells, cells)
