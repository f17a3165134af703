"""Deviations of the points of a panel, modes fitted to them, and the adjuster moves that remove these.

The displacement along a panel's normal is ``D(x, y) = sum c_i m_i(x, y)`` with ``rigid`` modes (as in
``misalignment``), ``quadratic`` modes with the curvatures D_xx, D_xy, D_yy as coefficients, or ``adjustable`` modes,
twist and bowl, which five adjusters can change.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ccatp.core import BoolArray, FloatArray, Measured, PanelId, PointId
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
    deck, normals = surface_under(mirror, panel, places)
    world = np.array([mirror.rotate_world_from_deck((x, y, z)) for x, y, z in normals.tolist()])
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
        lever=normals @ np.array(body.axes[2]),
        metrology=tuple(one.fix.metrology for one in chosen),
        common=shared,
        readings=None if readings is None else np.array([readings.get(one.point, 1) for one in chosen], np.float64),
    )


def surface_under(mirror: Mirror, panel: PanelId, places_m: Iterable[Sequence[float]]) -> tuple[FloatArray, FloatArray]:
    """Deck coordinates (k, 2) of the surface at (x, y) of the panel frame, and its normals (k, 3), deck frame."""
    body = mirror.panel(panel)
    deck = [mirror.surface.drop(body.to_deck((x, y, 0.0)), body.axes[2])[:2] for x, y in places_m]
    return np.array(deck), np.array([mirror.surface.normal(x, y) for x, y in deck])


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
