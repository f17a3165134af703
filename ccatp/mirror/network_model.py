"""The lengths of a survey as functions of the points and the network, and one adjustment of both by least squares.

A length is ``|x_k - a_i - d_i| (1 + s) + o_i``: point ``x_k``, configured collimator ``a_i``, its move ``d_i``, offset
``o_i`` of the channel, scale ``s`` (refraction) with a drift and a variation. An ``Effect`` is one block of these
unknowns; it may hold from some point on only. The points are eliminated: ``M = W - W H (H^T W H)^-1 H^T W`` is the
weight that is left to the lengths of a point for the network. Each effect has a normal prior of mean 0, so that the
solution always exists; rigid motions of the collimators move all points alike, show in no length, and keep their prior.
"""

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from ccatp.core import BoolArray, FloatArray, IntArray

_AXES = 3
_MOST_ITERATIONS = 30
_LEAST_VISIBLE = 1e-9  # part of the information of a candidate that the unknowns must leave; less is rounding
_CONVERGED_M = 1e-10  # largest change of a point in the last iteration; a thousandth of the noise of a length


class EffectKind(StrEnum):
    """What may be wrong in the network."""

    OFFSET = "offset"  # of the lengths of a channel, m
    COLLIMATOR = "collimator"  # move of a collimator, world frame, m
    SCALE = "scale"  # of all lengths of a survey
    DRIFT = "drift"  # of the scale of a survey, 1/h, zero in the middle of its time
    VARIATION = "variation"  # of the scale of a survey about its drift: amplitudes of cosines of time


class Effect(NamedTuple):
    """One block of unknowns: of a channel (its column), or of a survey (its number).

    ``since``: the first point at which it holds. ``until``: the first one after it at which it does not hold any more,
    the beginning of a later survey; 0: it holds to the end. A variation has ``terms`` cosines of ``order`` and the next
    ones; the order is the number of half waves in the survey.
    """

    kind: EffectKind
    of: int
    since: int = 0
    until: int = 0
    order: int = 0
    terms: int = 1

    @property
    def part(self) -> slice:
        """The points at which it holds."""
        return slice(self.since, self.until or None)

    @property
    def is_always(self) -> bool:
        """Whether it holds at all points."""
        return not (self.since or self.until)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return _AXES if self.kind is EffectKind.COLLIMATOR else self.terms

    @property
    def is_of_channel(self) -> bool:
        """Whether it belongs to one channel."""
        return self.kind in (EffectKind.OFFSET, EffectKind.COLLIMATOR)


class SurveyLengths(NamedTuple):
    """Lengths (k, m) of k points by m channels with their sigmas, NaN where there is none; SI units.

    ``collimators_m`` (m, 3): as configured. ``start_m`` (k, 3): approximate points, from which the solution begins.
    ``hours`` (k,): time of each point from the middle of its survey. ``survey`` (k,): number of the survey.
    """

    lengths_m: FloatArray
    sigmas_m: FloatArray
    collimators_m: FloatArray
    start_m: FloatArray
    hours: FloatArray
    survey: IntArray

    @property
    def surveys(self) -> int:
        """Number of surveys."""
        return int(self.survey.max()) + 1 if len(self.survey) else 0

    def without(self, is_bad: BoolArray) -> "SurveyLengths":
        """The same without some lengths, (k, m)."""
        return self._replace(lengths_m=np.where(is_bad, np.nan, self.lengths_m))


class Adjustment(NamedTuple):
    """Result of one adjustment.

    ``values`` (n,) with ``covariance`` (n, n), in the order of ``slices``. ``points_m`` (k, 3); ``noise_m2`` (k, 3, 3):
    their covariance by the noise of the lengths alone; ``moves`` (k, 3, n): change of the points per unknown.
    ``weighted`` (k, m): M r, the derivative of half the chi-square; ``weights`` (k, m, m): M; ``directions`` (k, m, 3);
    ``distances_m`` (k, m); ``design`` (k, m, n). ``chi2`` (k,) of each point with ``dof`` (k,).
    All sigmas of lengths are multiplied by ``noise``.
    """

    slices: dict[Effect, slice]
    prior: FloatArray
    values: FloatArray
    covariance: FloatArray
    points_m: FloatArray
    noise_m2: FloatArray
    moves: FloatArray
    residuals_m: FloatArray
    weighted: FloatArray
    weights: FloatArray
    directions: FloatArray
    distances_m: FloatArray
    design: FloatArray
    chi2: FloatArray
    dof: IntArray
    noise: float

    def of(self, effect: Effect) -> FloatArray:
        """Values of an effect."""
        return self.values[self.slices[effect]]

    def covariance_of(self, effect: Effect) -> FloatArray:
        """Covariance of an effect."""
        part = self.slices[effect]
        return self.covariance[part, part]

    @property
    def scale_design(self) -> FloatArray:
        """Change of the scale at each point per unknown, (k, n); with ``values`` the scale of its lengths."""
        is_scale = np.concatenate([np.full(effect.size, not effect.is_of_channel) for effect in self.slices])
        return np.where(is_scale, self.design[:, 0] / self.distances_m[:, :1], 0.0)

    @property
    def by_survey(self) -> FloatArray:
        """The part of the covariance that differs between surveys, (n, n).

        It comes from the noise of the lengths, and from the priors of scale and drift, which are of one survey; the
        rest comes from the priors of the collimators and of the offsets.
        """
        is_common = np.concatenate([np.full(effect.size, effect.is_of_channel) for effect in self.slices])
        scaled = (self.covariance / np.sqrt(self.prior)[:, None])[is_common]
        return np.asarray(self.covariance - scaled.T @ scaled)


def variation_shapes(effect: Effect, given: SurveyLengths) -> FloatArray:
    """The cosines of a variation at each point, (k, terms), 0 at those of other surveys.

    Each is without the line that fits it best, which is a scale and a drift.
    """
    is_own = given.survey == effect.of
    hours = given.hours[is_own]
    time = hours / max(float(np.ptp(hours)), 1e-12)  # -1/2 to 1/2
    orders = np.arange(effect.order, effect.order + effect.terms)
    slopes = np.where(orders % 2 == 1, -24.0 / (np.pi * orders) ** 2, 0.0)
    found = np.zeros((len(given.hours), effect.terms))
    found[is_own] = np.cos(np.pi * orders * (time[:, None] + 0.5)) - slopes * time[:, None]
    return found


def columns_of(effect: Effect, given: SurveyLengths, directions: FloatArray, distances_m: FloatArray) -> FloatArray:
    """Change of each length per unknown of an effect, (k, m, size)."""
    count, channels = distances_m.shape
    found = np.zeros((count, channels, effect.size))
    part = effect.part
    match effect.kind:
        case EffectKind.OFFSET:
            found[part, effect.of, 0] = 1.0
        case EffectKind.COLLIMATOR:
            found[part, effect.of] = -directions[part, effect.of]
        case EffectKind.SCALE:
            found[part, :, 0] = distances_m[part] * (given.survey[part] == effect.of)[:, None]
        case EffectKind.DRIFT:
            hours = given.hours[part] * (given.survey[part] == effect.of)
            found[part, :, 0] = distances_m[part] * hours[:, None]
        case EffectKind.VARIATION:
            found[part] = distances_m[part, :, None] * variation_shapes(effect, given)[part, None, :]
    return found


class _Predicted(NamedTuple):
    lengths_m: FloatArray
    directions: FloatArray
    distances_m: FloatArray


def _predict(given: SurveyLengths, slices: dict[Effect, slice], values: FloatArray, points_m: FloatArray) -> _Predicted:
    count, channels = given.lengths_m.shape
    moved = np.zeros((count, channels, _AXES))
    offsets = np.zeros((count, channels))
    scale = np.zeros(count)
    for effect, part in slices.items():
        at = effect.part
        match effect.kind:
            case EffectKind.OFFSET:
                offsets[at, effect.of] += values[part]
            case EffectKind.COLLIMATOR:
                moved[at, effect.of] += values[part]
            case EffectKind.SCALE:
                scale[at] += values[part] * (given.survey[at] == effect.of)
            case EffectKind.DRIFT:
                scale[at] += values[part] * given.hours[at] * (given.survey[at] == effect.of)
            case EffectKind.VARIATION:
                scale[at] += variation_shapes(effect, given)[at] @ values[part]
    away = points_m[:, None, :] - given.collimators_m - moved
    distances = np.sqrt(np.sum(away * away, axis=2))
    directions = away / np.maximum(distances, 1e-12)[..., None]
    return _Predicted(distances * (1.0 + scale[:, None]) + offsets, directions, distances)


class _System(NamedTuple):
    """The linearised problem at some values and points; the points are eliminated from ``normal`` and ``right``."""

    residuals: FloatArray
    design: FloatArray
    spread: FloatArray  # (H^T W H)^-1
    gain: FloatArray  # of the points by the lengths, (k, 3, m)
    weights: FloatArray
    normal: FloatArray
    right: FloatArray
    directions: FloatArray
    distances_m: FloatArray


def _system(
    given: SurveyLengths, slices: dict[Effect, slice], values: FloatArray, points: FloatArray, noise: float
) -> _System:
    is_valid = np.isfinite(given.lengths_m)
    weight = np.where(is_valid, (noise * given.sigmas_m) ** -2.0, 0.0)
    found = _predict(given, slices, values, points)
    residuals = np.where(is_valid, given.lengths_m - found.lengths_m, 0.0)
    design = np.concatenate(
        [columns_of(effect, given, found.directions, found.distances_m) for effect in slices], axis=2
    )
    left = found.directions * weight[..., None]  # W H
    spread = np.asarray(np.linalg.inv(left.transpose(0, 2, 1) @ found.directions), dtype=np.float64)
    gain = spread @ left.transpose(0, 2, 1)
    weights = -left @ gain
    at = np.arange(weight.shape[1])
    weights[:, at, at] += weight
    width = design.shape[2]
    reduced = (weights @ design).reshape(-1, width)
    return _System(
        residuals=residuals,
        design=design,
        spread=spread,
        gain=gain,
        weights=weights,
        normal=design.reshape(-1, width).T @ reduced,
        right=residuals.ravel() @ reduced,
        directions=found.directions,
        distances_m=found.distances_m,
    )


def _posterior(system: _System, prior: FloatArray) -> FloatArray:
    """Covariance of the effects; inverted in units of the prior sigmas, where the matrix is well conditioned."""
    unit = np.sqrt(prior)
    scaled = system.normal * unit[:, None] * unit
    found = np.linalg.inv(0.5 * (scaled + scaled.T) + np.eye(len(unit)))
    return np.asarray(0.5 * (found + found.T) * unit[:, None] * unit)


def adjust(
    given: SurveyLengths, sigmas: dict[Effect, float], noise: float = 1.0, start: Adjustment | None = None
) -> Adjustment:
    """Adjust points and effects with these prior sigmas (> 0) by Gauss-Newton; begins at ``start`` if it is given.

    Each point needs four lengths whose directions do not lie in a plane.
    """
    slices, end = {}, 0
    for effect in sigmas:
        slices[effect] = slice(end, end + effect.size)
        end += effect.size
    prior = np.concatenate([np.full(effect.size, sigma**2) for effect, sigma in sigmas.items()])
    values, points = np.zeros(end), given.start_m
    if start is not None:
        points = start.points_m
        for effect, part in slices.items():
            if effect in start.slices:
                values[part] = start.of(effect)
    system = _system(given, slices, values, points, noise)
    for _ in range(_MOST_ITERATIONS):
        step = _posterior(system, prior) @ (system.right - values / prior)
        move = (system.gain @ (system.residuals - system.design @ step)[..., None])[..., 0]
        values, points = values + step, points + move
        system = _system(given, slices, values, points, noise)
        if np.max(np.abs(move), initial=0.0) <= _CONVERGED_M:
            break
    weighted = (system.weights @ system.residuals[..., None])[..., 0]
    return Adjustment(
        slices=slices,
        prior=prior,
        values=values,
        covariance=_posterior(system, prior),
        points_m=points,
        noise_m2=system.spread,
        moves=-system.gain @ system.design,
        residuals_m=system.residuals,
        weighted=weighted,
        weights=system.weights,
        directions=system.directions,
        distances_m=system.distances_m,
        design=system.design,
        chi2=np.sum(system.residuals * weighted, axis=1),
        dof=np.maximum(np.isfinite(given.lengths_m).sum(axis=1) - _AXES, 0),
        noise=noise,
    )


def _shown(score: FloatArray, own: FloatArray, cross: FloatArray, covariance: FloatArray) -> FloatArray:
    """Chi-squares of candidates with scores (c, s), information (c, s, s), cross information (c, s, n), shape (c,)."""
    left = own - cross @ covariance @ cross.transpose(0, 2, 1)
    values, axes = np.linalg.eigh(0.5 * (left + left.transpose(0, 2, 1)))
    total = np.trace(own, axis1=1, axis2=2)[:, None]
    is_shown = values > _LEAST_VISIBLE * np.maximum(total, 1e-300)
    along = (score[:, None, :] @ axes)[:, 0]
    return np.asarray(np.sum(np.where(is_shown, along**2 / np.where(is_shown, values, 1.0), 0.0), axis=1))


def score_since(found: Adjustment, base: Effect, given: SurveyLengths, firsts: IntArray) -> FloatArray:
    """The chi-square that an additional effect would take away if it began at each of the points ``firsts``.

    This is the score test: exact in the linear model. ``firsts`` grow, and are before the end of ``base``.
    """
    columns = columns_of(base, given, found.directions, found.distances_m)

    def since(values: FloatArray) -> FloatArray:
        parts = np.add.reduceat(values, firsts, axis=0)
        return np.cumsum(parts[::-1], axis=0)[::-1]

    # An effect of one channel has only zeros in the columns of the others.
    rows = slice(base.of, base.of + 1) if base.is_of_channel else slice(None)
    columns, weights = columns[:, rows], found.weights[:, rows]
    turned = columns.transpose(0, 2, 1)
    score = since((turned @ found.weighted[:, rows, None])[..., 0])
    mine = turned @ weights
    return _shown(score, since(mine[..., rows] @ columns), since(mine @ found.design), found.covariance)


def length_information(found: Adjustment) -> FloatArray:
    """Inverse variance of each length minus what all others say of it, (k, m), 1/m^2; 0 where they say nothing."""
    own = np.diagonal(found.weights, axis1=1, axis2=2)
    cross = found.weights @ found.design
    left = own - np.sum((cross @ found.covariance) * cross, axis=2)
    is_shown = left > _LEAST_VISIBLE * np.maximum(own.max(axis=1, keepdims=True), 1e-300)
    return np.asarray(np.where(is_shown, left, 0.0))


def length_scores(found: Adjustment) -> FloatArray:
    """The chi-square that an error of each single length would take away, (k, m); 0 where it does not show."""
    left = length_information(found)
    return np.asarray(np.where(left > 0.0, found.weighted**2 / np.where(left > 0.0, left, 1.0), 0.0))


def equal_effects(channels: int, surveys: int) -> Sequence[Effect]:
    """The effects of every network: per channel collimator and offset, per survey scale and drift."""
    return (
        *(Effect(EffectKind.COLLIMATOR, one) for one in range(channels)),
        *(Effect(EffectKind.OFFSET, one) for one in range(channels)),
        *(Effect(EffectKind.SCALE, one) for one in range(surveys)),
        *(Effect(EffectKind.DRIFT, one) for one in range(surveys)),
    )
