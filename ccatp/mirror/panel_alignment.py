"""The alignment of one panel: deviations, modes, adjuster moves, outliers and shape, half-wavefront error.

The displacement along a panel's normal is ``D(x, y) = sum c_i m_i(x, y)`` with ``rigid`` modes (as in
``misalignment``), ``quadratic`` modes with the curvatures D_xx, D_xy, D_yy as coefficients, or ``adjustable`` modes,
twist and bowl, which five adjusters can change. The method is in docs/align.md.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb, exp, sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from ccatp.config.models import LightConfig
from ccatp.core import UNRELIABLE, BoolArray, FloatArray, Measured, PanelId, PointId, Vector3
from ccatp.mirror.layout import Panel
from ccatp.mirror.mirror import Mirror


class Deviations(NamedTuple):
    """The measured points of one panel, in the order of their numbers.

    ``places_m`` (k, 2) in the panel frame and ``deck_m`` (k, 2) are the surface points under the puck, ``values_m``
    (k,) the deviations along the local normal, > 0 towards the robot. ``lever`` (k,): scalar product of the local and
    the panel's normal, the deviation per displacement D along the panel's normal. ``common`` (k, r): change of the
    deviations per independent error of standard deviation 1 that they share with other panels, not part of the sigmas.
    ``readings`` (k,): of which each is the mean; None if of one. A point whose readings contradict each other is there
    once for each reading.
    """

    points: tuple[PointId, ...]
    places_m: FloatArray
    deck_m: FloatArray
    values_m: FloatArray
    sigmas_m: FloatArray
    lever: FloatArray
    metrology: tuple[str, ...] = ()
    common: FloatArray | None = None
    readings: FloatArray | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The numbers of the points; of those that are there more than once with the number of the reading."""
        numbers = [point.point for point in self.points]
        return tuple(
            f"{number} (reading {numbers[:at].count(number) + 1})" if numbers.count(number) > 1 else str(number)
            for at, number in enumerate(numbers)
        )

    @property
    def extra_readings(self) -> FloatArray:
        """How many more readings than usual each point is the mean of, (k,)."""
        if self.readings is None:
            return np.zeros(len(self.points))
        return np.asarray(np.maximum(self.readings - np.median(self.readings), 0.0))

    def scaled(self, factor: float) -> "Deviations":
        """With ``factor`` times the sigmas."""
        return self._replace(sigmas_m=factor * self.sigmas_m)


def deviations_of(
    mirror: Mirror,
    panel: PanelId,
    measured: Sequence[Measured],
    puck_height_m: float,
    floor_m: float,
    common: Mapping[PointId, FloatArray] | None = None,
    readings: Mapping[PointId, int] | None = None,
) -> Deviations:
    """Deviations of the points of a panel; their variance is ``n^T C n + floor^2``.

    A lateral error of the fix only moves the point along the surface. ``floor_m``: independent error of each point that
    the covariance of its fix does not include. ``common``: errors of the points, (3, r), world frame. ``readings``: of
    which a fix is the mean.

    Raises ``UnknownPanelError``, ``ConvergenceError`` far from the mirror.
    """
    chosen = sorted(measured, key=lambda one: one.point)
    body = mirror.panel(panel)
    feet = [mirror.foot_of_puck(one.fix.position_m, puck_height_m) for one in chosen]
    places = [body.from_deck(mirror.surface.point(x, y))[:2] for x, y, _ in feet]
    deck = np.array([mirror.surface.drop(body.to_deck((x, y, 0.0)), body.axes[2])[:2] for x, y in places])
    normals = [mirror.surface.normal(x, y) for x, y in deck.tolist()]
    world = np.array([mirror.rotate_world_from_deck(normal) for normal in normals])
    covariances = np.array([one.fix.covariance_m2 for one in chosen], dtype=np.float64).reshape(-1, 3, 3)
    variances = np.einsum("ki,kij,kj->k", world, covariances, world) + floor_m**2
    shared = None
    if common:
        width = len(next(iter(common.values()))[0])
        moves = [common.get(one.point, np.zeros((3, width))) for one in chosen]
        shared = np.einsum("ki,kir->kr", world, np.array(moves))
    return Deviations(
        points=tuple(one.point for one in chosen),
        places_m=np.array(places),
        deck_m=deck,
        values_m=np.array([deviation for _, _, deviation in feet]),
        sigmas_m=np.sqrt(variances),
        lever=np.array(normals) @ np.array(body.axes[2]),
        metrology=tuple(one.fix.metrology for one in chosen),
        common=shared,
        readings=None if readings is None else np.array([readings.get(one.point, 1) for one in chosen], np.float64),
    )


Modes = Callable[[FloatArray], FloatArray]

MAX_CONDITION = 1e4  # with columns of unit length; nine points of a panel give less than 10, points on a line infinity
_NODES, _NODE_WEIGHTS = np.polynomial.legendre.leggauss(4)  # exact for products of quadratics


def rigid(places_m: FloatArray) -> FloatArray:
    """The three modes of a rigid panel at (k, 2) places: shape (k, 3)."""
    x, y = places_m.T
    return np.column_stack([np.ones_like(x), y, x])


def quadratic(places_m: FloatArray) -> FloatArray:
    """The rigid modes and three curvatures at (k, 2) places: shape (k, 6)."""
    x, y = places_m.T
    return np.column_stack([rigid(places_m), x * x / 2.0, x * y, y * y / 2.0])


def adjustable(places_m: FloatArray) -> FloatArray:
    """The rigid modes, twist and bowl at (k, 2) places: shape (k, 5)."""
    x, y = places_m.T
    return np.column_stack([rigid(places_m), x * y, (x * x + y * y) / 2.0])


_SIX = np.eye(6)
_IN_QUADRATIC: Mapping[Modes, FloatArray] = {
    rigid: _SIX[:, :3], adjustable: np.column_stack([_SIX[:, :3], _SIX[:, 4], _SIX[:, 3] + _SIX[:, 5]]),
}  # fmt: skip
"""The modes as combinations of the quadratic ones, (6, m)."""


class ModeFit(NamedTuple):
    """Coefficients (m,) by weighted least squares, in m, rad and 1/m, with their covariance (m, m) and residuals (k,).

    ``residual_variance_m2``: expected mean square of the residuals from the uncertainty of the points. ``common``
    (m, r): change of the coefficients per error that other panels share; the covariance contains it, so that
    ``common @ other.common.T`` is the covariance with another panel.
    """

    values: FloatArray
    covariance: FloatArray
    residuals_m: FloatArray
    residual_variance_m2: float
    chi2: float
    dof: int
    common: FloatArray

    def widened(self, spread: FloatArray, factor: float = 1.0) -> "ModeFit":
        """With ``factor`` times its own covariance, and that (3, 3) of piston, tip and tilt, the first coefficients."""
        covariance = self.covariance + (factor - 1.0) * self.own_covariance
        covariance[:3, :3] += spread
        return self._replace(covariance=covariance)

    @property
    def own_covariance(self) -> FloatArray:
        """The covariance without the errors that other panels share."""
        return np.asarray(self.covariance - self.common @ self.common.T)

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the coefficients."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def unexplained_m2(self) -> float:
        """Mean square of the residuals minus its expected value; may be < 0 by chance."""
        return float(np.mean(self.residuals_m**2)) - self.residual_variance_m2


def fit_modes(
    design: FloatArray, values_m: FloatArray, sigmas_m: FloatArray, common: FloatArray | None = None
) -> ModeFit | None:
    """Weighted least squares by QR; None if the points do not determine the coefficients.

    ``design`` (k, m): modes at the points, each row times the point's lever; deviations and sigmas > 0, shape (k,).
    ``common`` (k, r): errors of the deviations that other panels share; they do not change the weights.
    """
    count, modes = design.shape
    if count < modes:
        return None
    whitened = design / sigmas_m[:, None]
    scales = np.linalg.norm(whitened, axis=0)
    if not (scales > 0.0).all() or not np.linalg.cond(whitened / scales) < MAX_CONDITION:
        return None
    q, r = np.linalg.qr(whitened)
    target = values_m / sigmas_m
    solution = np.linalg.solve(r, q.T @ target)
    spread = np.linalg.solve(r, np.eye(modes))
    left = target - whitened @ solution
    # The whitened residuals are the projection 1 - Q Q^T of unit noise.
    expected = float(np.mean(sigmas_m**2 * (1.0 - np.sum(q * q, axis=1))))
    shared = np.zeros((modes, 0)) if common is None else spread @ (q.T @ (common / sigmas_m[:, None]))
    return ModeFit(
        values=solution,
        covariance=spread @ spread.T + shared @ shared.T,
        residuals_m=left * sigmas_m,
        residual_variance_m2=expected,
        chi2=float(left @ left),
        dof=count - modes,
        common=shared,
    )


def fit_bent(deviations: Deviations, is_kept: BoolArray, modes: Modes, half_m: tuple[float, float]) -> ModeFit | None:
    """The ``modes`` that remove most of a bent panel over its area: of its fit with three curvatures.

    So they do not depend on which points were measured or left out. Chi-square and degrees of freedom are those of a
    fit of the modes alone. None if the points do not determine all six coefficients.
    """
    places, lever = deviations.places_m[is_kept], deviations.lever[is_kept, None]
    values, sigmas = deviations.values_m[is_kept], deviations.sigmas_m[is_kept]
    common = None if deviations.common is None else deviations.common[is_kept]
    design, own = lever * quadratic(places), lever * modes(places)
    full, alone = fit_modes(design, values, sigmas, common), fit_modes(own, values, sigmas, common)
    if full is None or alone is None:
        return None
    chosen, products = _IN_QUADRATIC[modes], gram(quadratic, half_m)
    over_area = np.linalg.solve(chosen.T @ products @ chosen, chosen.T @ products)
    operator = own @ over_area @ full.own_covariance @ (design / sigmas[:, None] ** 2).T
    left = (np.eye(len(values)) - operator) * sigmas
    return alone._replace(
        values=over_area @ full.values,
        covariance=over_area @ full.covariance @ over_area.T,
        residuals_m=values - own @ over_area @ full.values,
        residual_variance_m2=float(np.mean(np.sum(left**2, axis=1))),
        common=over_area @ full.common,
    )


def gram(modes: Modes, half_m: tuple[float, float]) -> FloatArray:
    """Mean G of the products of modes over a panel with half sizes ``half_m``; c^T G c is the mean square of D."""
    x, y = np.meshgrid(_NODES * half_m[0], _NODES * half_m[1])
    weights = np.outer(_NODE_WEIGHTS, _NODE_WEIGHTS).ravel() / 4.0
    at = modes(np.column_stack([x.ravel(), y.ravel()]))
    return np.asarray(at.T @ (weights[:, None] * at))


class Moves(NamedTuple):
    """Moves (a,) in the order of the adjusters' names; covariance (a, a), whose rank is that of the modes.

    ``common_m`` (a, r): change of the moves per error that other panels share.
    """

    values_m: FloatArray
    covariance_m2: FloatArray
    common_m: FloatArray

    @property
    def sigma_m(self) -> FloatArray:
        """Standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance_m2)))


def adjuster_places(mirror: Mirror, panel: PanelId) -> tuple[tuple[str, ...], FloatArray]:
    """Names of a panel's adjusters and their (x, y) in the panel frame, shape (a, 2), m."""
    body = mirror.panel(panel)
    found = mirror.adjusters_on_deck(panel)
    places = [body.from_deck(mirror.surface.point(x, y))[:2] for x, y in found.values()]
    return tuple(found), np.array(places, dtype=np.float64).reshape(-1, 2)


def adjuster_moves(fit: ModeFit, modes: Modes, places_m: FloatArray) -> Moves:
    """Moves that remove a fitted displacement; ``places_m``: adjusters in the panel frame, shape (a, 2), m."""
    at = -modes(places_m)
    return Moves(at @ fit.values, at @ fit.covariance @ at.T, at @ fit.common)


CURVATURES = 3
# Number of redundant points required for each point left out. With fewer, some selection of points always fits.
REDUNDANCY = 3
# Points that are left out at most, and number of points from which it is one: the selections are tried one by one.
_MOST_LEFT_OUT, _MANY = 2, 20
_MOST_SELECTIONS = 2000  # of as many points, which take a tenth of a second


class Prices(NamedTuple):
    """Least reduction of the chi-square to leave out a point, and to use the three curvatures of a panel.

    ``contradiction``: chance of the chi-square of a panel by noise below which its points contradict each other.
    """

    outlier: float
    shape: float
    contradiction: float


def prices(false_alarm: float, points: int, panels: int) -> Prices:
    """The prices for a ``false_alarm`` probability of an outlier, or of a shape, by noise on the whole mirror."""
    of_panel = false_alarm / max(panels, 1)
    return Prices(float(chdtri(1, false_alarm / max(points, 1))), float(chdtri(CURVATURES, of_panel)), of_panel)


class Explanation(NamedTuple):
    """One explanation of a panel's deviations: points that are kept (k,), whether it is bent, and its cost."""

    is_kept: BoolArray
    has_shape: bool
    cost: float
    chi2: float = np.inf

    @property
    def is_plain(self) -> bool:
        """A rigid panel with all its points."""
        return bool(self.is_kept.all()) and not self.has_shape

    def extends(self, other: "Explanation") -> bool:
        """Whether it is the other with more of the same: further points left out, or the curvatures added."""
        return bool((self.is_kept <= other.is_kept).all()) and self.has_shape >= other.has_shape


# Difference of the costs below which the points do not decide: one explanation is less than a thousand times as likely.
UNDECIDED = 13.8
# Cost of a further wrong point on a panel that has wrong points: the probability is one in a hundred.
FURTHER_POINT = 9.2


def explain(deviations: Deviations, price: Prices) -> tuple[Explanation, ...]:
    """All explanations of a panel's deviations that the points do not exclude, the chosen one first.

    All points are kept if the panel cannot be fitted, or has too few redundant points. A plain panel has no others.
    A point that is the mean of more readings than others costs as many points: all of them would have to be wrong.
    """
    found = _explanations(deviations, price)
    if not found:
        return (plain(deviations),)
    best, *others = found
    if best.is_plain:
        return (best,)
    if not best.is_kept.all() and len(set(deviations.points)) <= _MANY:
        # What is too many to be chosen may be true nevertheless: with bending, two wrong points look like one.
        others = [one for one in others if one.extends(best)]
        others += [one for one in _explanations(deviations, price, best) if not one.extends(best)]
    return (best, *others)


def _explanations(deviations: Deviations, price: Prices, best: Explanation | None = None) -> list[Explanation]:
    """Explanations that are not much dearer than the cheapest one, or than the ``best``, by their cost.

    With a ``best``: also those that leave out one point more than may be chosen, but for a bent panel if the best one
    is rigid. What they leave out beyond its number is cheaper, since wrong points of a panel often have one cause.
    """
    count = len(deviations.points)
    target = deviations.values_m / deviations.sigmas_m
    cost_of_point = price.outlier * (1.0 + deviations.extra_readings)
    free = count if best is None else int(np.count_nonzero(~best.is_kept))
    found, lowest = list[Explanation](), np.inf if best is None else best.cost
    for modes, needed in ((rigid, 3), (quadratic, 6)):
        has_shape = modes is quadratic
        extra = price.shape if has_shape else 0.0
        whitened = modes(deviations.places_m) * (deviations.lever / deviations.sigmas_m)[:, None]
        whitened /= np.linalg.norm(whitened, axis=0)
        most = _most_left_out(deviations, needed)
        if best is not None and has_shape <= best.has_shape:
            most = min(most + 1, count - needed - 1)
        for is_kept in _subsets(count, most):
            further = max(int(np.count_nonzero(~is_kept)) - free, 0)
            cost = extra + float(cost_of_point[~is_kept].sum()) - further * (price.outlier - FURTHER_POINT)
            if cost >= lowest + UNDECIDED:
                continue
            chi2 = _chi2(whitened[is_kept], target[is_kept])
            if cost + chi2 < lowest + UNDECIDED:
                found.append(Explanation(is_kept, has_shape, cost + chi2, chi2))
            if best is None:
                lowest = min(lowest, cost + chi2)
    if not np.isfinite(lowest):
        return []
    return sorted((one for one in found if one.cost < lowest + UNDECIDED), key=lambda one: one.cost)


def _most_left_out(deviations: Deviations, needed: int) -> int:
    """How many may be left out of a fit of ``needed`` coefficients.

    Of readings of one point that contradict each other all but one, whatever the other points are.
    """
    count, targets = len(deviations.points), len(set(deviations.points))
    most = min((targets - needed) // REDUNDANCY, _MOST_LEFT_OUT if targets <= _MANY else 1)
    most = max(most, 0) + min(count - targets, count - needed)
    while most > 1 and comb(count, most) > _MOST_SELECTIONS:
        most -= 1
    return most


def plain(deviations: Deviations) -> Explanation:
    """A rigid panel with all its points."""
    return Explanation(np.ones(len(deviations.points), dtype=np.bool_), has_shape=False, cost=np.inf)


def contradicts(one: Explanation, price: Prices) -> bool:
    """Whether the points that an explanation keeps contradict each other nevertheless."""
    kept = int(np.count_nonzero(one.is_kept))
    dof = kept - (6 if one.has_shape else 3)
    return dof > 0 and np.isfinite(one.chi2) and bool(chdtrc(dof, one.chi2) < price.contradiction)


def rivals(explanations: Sequence[Explanation]) -> tuple[Explanation, ...]:
    """Those that say something else than the cheapest one, and not only more of the same."""
    best, *others = explanations
    found: list[Explanation] = []
    for one in others:
        if not (one.is_plain or any(one.extends(other) for other in (best, *found))):
            found.append(one)
    return tuple(found)


def _subsets(count: int, most: int) -> Iterator[BoolArray]:
    for left_out in range(most + 1):
        for some in combinations(range(count), left_out):
            is_kept = np.ones(count, dtype=np.bool_)
            is_kept[list(some)] = False
            yield is_kept


def _chi2(whitened: FloatArray, target: FloatArray) -> float:
    """Least sum of squares; infinite if the points do not determine the coefficients."""
    solution, _, rank, _ = np.linalg.lstsq(whitened, target, rcond=1.0 / MAX_CONDITION)
    left = target - whitened @ solution
    return float(left @ left) if rank == whitened.shape[1] else np.inf


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
