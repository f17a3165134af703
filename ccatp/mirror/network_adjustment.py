"""The laser network from all lengths of a survey: what changed in it, tested, and what stays uncertain.

Every effect has the prior of the configuration. One that the lengths contradict gets a wide prior, ``moved`` (stepwise:
the score test of each candidate, the most significant first). Candidates are the effects themselves, the same from
some point on (but for the drift), those of a channel until a later survey begins, and single lengths, which are not
used if they are significant. The probability of a false finding per survey is half of the configured one. If another
candidate explains the lengths nearly as well, both get the wide prior, and both are named. An effect that is suspect
only (chance ``_SUSPECT``) gets the wide prior, too, and is not named.

Errors of scale and drift that are too small for the test are larger than the noise of the panels. At the end each of
the two, if it was not found, has the mean of the usual and the wide prior, weighted by the probability of each with
these lengths: ``prior_of_both``.

A variation of the scale is found by the score test of each of its bands of periods. At the end each band has the mean
of some priors by their probabilities, ``prior_of_many``, whether it was found or not.

The noise of the lengths is measured with all effects free, so that larger noise makes no findings. A channel with
significantly more noise than the others gets a larger sigma.
"""

from collections.abc import Iterable, Iterator, Mapping
from enum import StrEnum
from itertools import pairwise
from math import log, sqrt
from typing import NamedTuple
from warnings import catch_warnings, simplefilter

import numpy as np
from scipy.special import betainc, chdtrc, chdtri

from ccatp.config.models import EtalonConfig, NetworkConfig
from ccatp.core import BoolArray, FloatArray, IntArray
from ccatp.mirror.network_model import (
    Adjustment,
    Effect,
    EffectKind,
    SurveyLengths,
    adjust,
    equal_effects,
    length_information,
    length_scores,
    score_since,
)

UNDETERMINED = 0.9  # ratio of the posterior to the prior sigma from which an effect is not determined by the lengths
_SUSPECT = 1e-3  # chance of a score by noise below which an effect gets the wide prior
_CLEAR = 13.8  # least difference of the chi-squares of two explanations, one of which is a thousand times as likely
_GRID = 100  # first points at which a change is looked for; then at every point near the best
_LEAST_PART = 5  # points before and after a change
_MOST_FINDINGS = 40
_AIR = EffectKind.SCALE, EffectKind.DRIFT
_AIR_CHANGED = 0.1  # chance of a scale or drift beyond the usual prior, before the lengths
_SHORTEST_H = 4.0 / 60.0  # period of a variation of the scale
_POINTS_OF_A_TERM = 8  # at least, of a variation
# Half waves in a survey at the beginning of each band of a variation, and behind the last. One half wave is nearly a
# line.
_BANDS = 2, 4, 6, 8, 12, 16, 24, 32, 48, 64
_STEPS = 0.5 ** np.arange(5.0)  # from the largest standard deviation of a variation to the smallest one, about 0.3 ppm
_NOISE_PASSES = 10  # in which the noise of single channels is measured
_MEDIAN = float(chdtri(1, 0.5))  # of the square of a standard normal value
_NOISE_SETTLED = 0.02  # relative change of it in the last pass
_AIR_VARIES = 0.5  # likewise of another band of a variation, if one is found
_FRAME = 3  # collimators that must agree with each other to be a frame for the others
_NEEDED = 4  # lengths of a point
_LOCATED_FROM = 6  # lengths of a point, of which one can be found to be wrong
_IGNORED_M = 1e3  # sigma of the lengths of a point that is left out
# Of a prior of 0, which stands for exact values.
_EXACT = {EffectKind.OFFSET: 1e-9, EffectKind.COLLIMATOR: 1e-9, EffectKind.SCALE: 1e-11, EffectKind.DRIFT: 1e-11}


class NetworkState(StrEnum):
    """What the lengths say of the network as configured."""

    CONSISTENT = "consistent"
    CHANGED = "changed"
    TOO_FEW = "too_few"  # points to test it


class Finding(NamedTuple):
    """An effect that is larger than its prior permits, as if it were the only explanation.

    ``alternatives``: other effects that explain the lengths nearly as well; the lengths do not decide between them.
    """

    effect: Effect
    values: FloatArray
    covariance: FloatArray
    alternatives: tuple[Effect, ...]

    @property
    def size(self) -> float:
        """Its value, or the length of the move of a collimator."""
        return float(np.linalg.norm(self.values)) if len(self.values) > 1 else float(self.values[0])

    @property
    def sigma(self) -> float:
        """Standard deviation of ``size``."""
        along = self.values / max(float(np.linalg.norm(self.values)), 1e-300)
        return float(sqrt(along @ self.covariance @ along))


class NetworkResult(NamedTuple):
    """The network of one or more surveys.

    ``suspects``: effects with the wide prior that are not named. ``undetermined``: effects of which the lengths say
    nothing. ``noise``: measured over configured noise of a length,
    at least 1; ``is_noisy``: significantly larger. ``bad_lengths`` (k, m): single lengths that contradict all others,
    left out; ``bad_points`` (k,): points whose lengths contradict each other, left out. ``has_frame``: enough
    collimators agree with each other to say which of the others moved.
    """

    state: NetworkState
    given: SurveyLengths
    adjustment: Adjustment
    findings: tuple[Finding, ...]
    suspects: tuple[Effect, ...]
    undetermined: tuple[Effect, ...]
    noise: float
    is_noisy: bool
    channel_noise: FloatArray
    chi2: float
    dof: int
    bad_lengths: BoolArray
    bad_points: BoolArray
    has_frame: bool


class _Search(NamedTuple):
    """The stepwise search: sigmas of the effects, wide ones among them, and what is left out.

    ``channel_noise`` (m,): noise of a channel over that of the others, 1 if it is not significantly larger.
    """

    sigmas: Mapping[Effect, float]
    wide: frozenset[Effect]
    channel_noise: FloatArray
    bad_lengths: BoolArray
    bad_points: BoolArray


class _Excess(NamedTuple):
    """Of each channel, (m,): median square of its standardised errors ``ratio``; share of its own noise in them.

    ``independent``: number of independent errors.
    """

    ratio: FloatArray
    share: FloatArray
    independent: FloatArray

    def chance(self) -> FloatArray:
        """Probability that noise as of the others gives this median, or a larger one: a binomial one."""
        half = 0.5 * (self.independent + 1.0)  # as many are at least as large
        return np.asarray(betainc(half, half, chdtrc(1, self.ratio)))


class NetworkSearch:
    """Priors and limits of the adjustment of one set of lengths."""

    def __init__(self, given: SurveyLengths, etalon: EtalonConfig, cfg: NetworkConfig, false_alarm: float) -> None:
        self._given = given
        count, channels = given.lengths_m.shape
        self._usual = {
            EffectKind.OFFSET: etalon.offset_sigma_m,
            EffectKind.COLLIMATOR: etalon.collimator_sigma_m,
            EffectKind.SCALE: etalon.refraction_sigma,
            EffectKind.DRIFT: cfg.drift_sigma_per_h,
        }
        self._usual = {kind: max(sigma, _EXACT[kind]) for kind, sigma in self._usual.items()}
        self._moved = {
            EffectKind.OFFSET: cfg.offset_changed_m,
            EffectKind.COLLIMATOR: cfg.collimator_moved_m,
            EffectKind.SCALE: cfg.refraction_changed,
            EffectKind.DRIFT: cfg.drift_changed_per_h,
            EffectKind.VARIATION: cfg.refraction_changed,
        }
        self.effects = equal_effects(channels, given.surveys)
        self._variations = tuple(variations(given))
        # Half of the false alarms of a survey, as other tests of its lengths have the rest.
        self._prices = {
            size: (
                float(chdtri(size, 0.05 * false_alarm / len(self.effects))),
                change_price(size, 0.25 * false_alarm / (2 * channels * given.surveys + given.surveys), count),
            )
            for size in (1, 3)
        }
        self._variation_chance = 0.1 * false_alarm / max(len(self._variations), 1)
        self._channel_chance = 0.1 * false_alarm / channels
        self._free: Adjustment | None = None
        self._length_price = float(chdtri(1, 0.2 * false_alarm / max(count * channels, 1)))
        self._noise_chance = 0.25 * false_alarm

    def run(self) -> NetworkResult:
        """Search, and adjust with what was found."""
        found = self._begin()
        given = self._used(found)
        redundant = int(np.maximum(np.isfinite(given.lengths_m).sum(axis=1) - 3, 0).sum())
        unknowns = sum(effect.size for effect in self.effects)
        if redundant < unknowns:
            return self._result(NetworkState.TOO_FEW, found, [], adjust(given, dict(found.sigmas)))
        found, adjustment = self._forward(found)
        findings: list[Finding] = []
        state = NetworkState.CHANGED
        if self._has_frame(found):
            findings = self._findings(found, adjustment)
            if not findings:
                state = NetworkState.CONSISTENT
            for effect in sorted({other for one in findings for other in one.alternatives}):
                found = self._widened(found, effect)
        else:
            # Which collimators moved cannot be said: all may have.
            for effect in self.effects:
                if effect.kind is EffectKind.COLLIMATOR:
                    found = self._widened(found, effect)
        found = self._with_air(found, adjustment)
        adjustment = adjust(self._used(found), dict(found.sigmas), adjustment.noise, adjustment)
        return self._result(state, found, findings, adjustment)

    def _begin(self) -> _Search:
        is_valid = np.isfinite(self._given.lengths_m)
        short = is_valid.sum(axis=1) < _NEEDED
        nothing = np.zeros(is_valid.shape, dtype=np.bool_)
        sigmas = {one: self._usual[one.kind] for one in self.effects}
        return _Search(sigmas, frozenset(), np.ones(is_valid.shape[1]), nothing, short)

    def _used(self, found: _Search) -> SurveyLengths:
        """Without what is left out; a point that is left out has all its lengths, with hardly any weight."""
        given = self._given.without(found.bad_lengths)
        sigmas_m = given.sigmas_m * found.channel_noise
        return given._replace(sigmas_m=np.where(found.bad_points[:, None], _IGNORED_M, sigmas_m))

    def _widened(self, found: _Search, effect: Effect) -> _Search:
        # What varies has parts in all bands.
        bands = {one for one in self._variations if one.of == effect.of}
        effects = bands if effect in bands else {effect}
        sigmas = {**found.sigmas, **{one: self._wide(one) for one in sorted(effects)}}
        return found._replace(sigmas=sigmas, wide=found.wide | effects)

    def _wide(self, effect: Effect) -> float:
        """Wide prior; of a cosine, so that all of a variation together have it."""
        sigma = self._moved[effect.kind]
        return sigma * sqrt(2.0 / effect.terms) if effect.kind is EffectKind.VARIATION else sigma

    def _with_air(self, found: _Search, adjustment: Adjustment) -> _Search:
        """Scale and drift that were not found, with both their priors; variations by what the lengths say of them."""
        sigmas = {
            effect: prior_of_both(
                float(adjustment.of(effect)[0]), float(adjustment.covariance_of(effect)[0, 0]),
                self._usual[effect.kind], self._moved[effect.kind],
            )
            for effect in self.effects
            if effect.kind in _AIR and effect not in found.wide
        }  # fmt: skip
        if self._variations:
            every = {**found.sigmas, **{one: self._wide(one) for one in self._variations}}
            free = adjust(self._used(found), every, adjustment.noise, adjustment)
            varied = {one.of for one in found.wide if one.kind is EffectKind.VARIATION}
            for one in self._variations:
                scales = self._wide(one) * _STEPS
                chance = _AIR_VARIES if one.of in varied else _AIR_CHANGED / len(self._variations)
                sigmas[one] = prior_of_many(free.of(one), free.covariance_of(one), self._wide(one), scales, chance)
        return found._replace(sigmas={**found.sigmas, **sigmas})

    def _narrowed(self, found: _Search, effect: Effect) -> _Search:
        sigmas = {one: sigma for one, sigma in found.sigmas.items() if one != effect}
        if effect in self.effects:
            sigmas = {**found.sigmas, effect: self._usual[effect.kind]}
        return found._replace(sigmas=sigmas, wide=found.wide - {effect})

    def _free_sigmas(self, found: _Search) -> dict[Effect, float]:
        return {one: self._wide(one) for one in (*self.effects, *found.wide)}

    def _noise(self, found: _Search) -> float:
        """Measured over configured noise, with all effects free and the found changes; at least 1.

        By the median over the points, which a few wrong lengths hardly change.
        """
        free = self._free = adjust(self._used(found), self._free_sigmas(found), start=self._free)
        used = ~found.bad_points & (free.dof > 0)
        if not used.any():
            return 1.0
        absorbed = len(free.values) - float(np.sum(np.diag(free.covariance) / free.prior))
        total = float(free.dof[used].sum())
        ratio = float(np.median(free.chi2[used] / chdtri(free.dof[used], 0.5)))
        return sqrt(max(ratio / max(1.0 - absorbed / total, 1.0 / total), 1.0))

    def _forward(self, found: _Search) -> tuple[_Search, Adjustment]:
        adjustment = adjust(self._used(found), dict(found.sigmas), self._noise(found))
        for _ in range(_MOST_FINDINGS):
            gain, effect = self._best(found, adjustment)
            lengths = length_scores(adjustment) - self._length_price
            worst = float(np.max(np.where(found.bad_points[:, None], -np.inf, lengths)))
            noisier, channel_noise = self._noisier(found, adjustment.noise)
            if max(gain, worst, noisier) <= 0.0:
                break
            newest: Effect | None = effect
            if noisier > max(gain, worst):
                found, newest = found._replace(channel_noise=channel_noise), None
            elif gain >= worst:
                found = self._widened(found, effect)
            else:
                found = self._left_out(found, lengths, worst)
            found = self._with_channel_noise(found)
            adjustment = adjust(self._used(found), dict(found.sigmas), self._noise(found), adjustment)
            found, adjustment = self._pruned(found, adjustment, newest)
        return self._with_suspects(found, adjustment)

    def _excess(self, found: _Search, noise: float) -> "_Excess":
        """The noise of each channel beside the others, by all effects free."""
        free = self._free or adjust(self._used(found), self._free_sigmas(found))
        left = length_information(free)
        is_used = (left > 0.0) & ~found.bad_points[:, None]
        left = np.where(is_used, left, np.nan)
        own = np.where(is_used, np.diagonal(free.weights, axis1=1, axis2=2), np.nan)
        variances = (self._given.sigmas_m * found.channel_noise) ** 2
        with catch_warnings():
            simplefilter("ignore", RuntimeWarning)  # a channel without lengths
            return _Excess(
                ratio=np.nan_to_num(np.nanmedian(free.weighted**2 / left, axis=0) / noise**2, nan=1.0),
                share=np.nan_to_num(np.nanmedian(left * variances, axis=0), nan=1.0),
                independent=np.maximum(np.nansum(left / own, axis=0), 1.0),
            )

    def _noisier(self, found: _Search, noise: float) -> tuple[float, FloatArray]:
        """What a noise of its own of the noisiest channel gains in twice the log-likelihood, and the noise with it."""
        excess = self._excess(found, noise)
        is_new = (excess.chance() < self._channel_chance) & (found.channel_noise == 1.0)
        squares = np.where(is_new, np.maximum(excess.ratio / _MEDIAN, 1.0), 1.0)
        gains = excess.independent * (squares - 1.0 - np.log(squares))
        worst = int(np.argmax(gains))
        channel_noise = found.channel_noise.copy()
        channel_noise[worst] *= sqrt(float(squares[worst]))
        return float(gains[worst]), channel_noise

    def _with_channel_noise(self, found: _Search) -> _Search:
        """The noise of the noisy channels, measured again; those that are noisy no longer have that of the others."""
        for _ in range(_NOISE_PASSES):
            is_noisy = found.channel_noise > 1.0
            if not is_noisy.any():
                break
            excess = self._excess(found, self._noise(found))
            before = found.channel_noise
            squares = before**2 * (1.0 + (excess.ratio / _MEDIAN - 1.0) / excess.share)
            squares = np.where(is_noisy, np.maximum(squares, 1.0), 1.0)
            # As if the channel had been weighted like the others.
            usual = excess.share / before**2 / (1.0 - excess.share + excess.share / before**2)
            alike = excess._replace(ratio=_MEDIAN * (1.0 + (squares - 1.0) * usual))
            squares = np.where(alike.chance() < 10.0 * self._channel_chance, squares, 1.0)
            found = found._replace(channel_noise=np.sqrt(squares))
            if np.max(np.abs(found.channel_noise / before - 1.0)) < _NOISE_SETTLED:
                break
        return found

    def _with_suspects(self, found: _Search, adjustment: Adjustment) -> tuple[_Search, Adjustment]:
        for _ in self.effects:
            given = self._used(found)
            chances = {
                one: float(chdtrc(one.size, score_since(adjustment, one, given, np.array([0]))[0]))
                for one in (*self.effects, *self._variations)
                if one not in found.wide
            }
            effect = min(chances, key=lambda one: chances[one], default=None)
            if effect is None or chances[effect] > _SUSPECT:
                break
            found = self._widened(found, effect)
            adjustment = adjust(given, dict(found.sigmas), adjustment.noise, adjustment)
        return found, adjustment

    def _pruned(self, found: _Search, adjustment: Adjustment, newest: Effect | None) -> tuple[_Search, Adjustment]:
        """Without effects that were widened before and are no longer significant."""
        for effect in sorted(found.wide - {newest, *self._variations}):
            values, covariance = adjustment.of(effect), adjustment.covariance_of(effect)
            usual = self._usual[effect.kind] ** 2 if effect in self.effects else 0.0
            spread = covariance + usual * np.eye(effect.size)
            if float(values @ np.linalg.solve(spread, values)) < self._price(effect):
                found = self._narrowed(found, effect)
                adjustment = adjust(self._used(found), dict(found.sigmas), adjustment.noise, adjustment)
        return found, adjustment

    def _price(self, effect: Effect) -> float:
        if effect.kind is EffectKind.VARIATION:
            return float(chdtri(effect.size, self._variation_chance))
        return self._prices[effect.size][not effect.is_always]

    def _gains(self, found: _Search, adjustment: Adjustment, also: int = 0) -> dict[Effect, float]:
        """The best candidate of each kind, channel or survey, and each end, with what it gains.

        One holds always, from some point on, or until a later survey begins, from the first point or from another one.
        ``also``: a point at which a change may begin, besides those of the grid.
        """
        given, gains = self._used(found), {}
        for base in self._bases():
            grid = self._firsts(base)
            firsts = np.unique([0, also, *grid]) if len(grid) else np.array([0])
            firsts = firsts[firsts < base.until] if base.until else firsts
            gained = score_since(adjustment, base, given, firsts)
            if base not in found.wide:
                gains[base] = float(gained[0]) - self._price(base)
            if len(firsts) > 1:
                at = 1 + int(np.argmax(gained[1:]))
                step = base._replace(since=int(firsts[at]))
                if step not in found.wide:
                    gains[step] = float(gained[at]) - self._price(step)
        return gains

    def _bases(self) -> Iterator[Effect]:
        """All effects, and those of a channel until each later survey begins."""
        yield from (*self.effects, *self._variations)
        begins = np.flatnonzero(np.diff(self._given.survey)) + 1
        for effect in self.effects:
            if effect.is_of_channel:
                yield from (effect._replace(until=int(begin)) for begin in begins)

    def _firsts(self, base: Effect) -> IntArray:
        """Points at which a change may begin, some apart."""
        if base.kind in (EffectKind.DRIFT, EffectKind.VARIATION):
            return np.arange(0)
        survey = self._given.survey
        inside = (
            np.flatnonzero(survey == base.of) if base.kind is EffectKind.SCALE else np.arange(len(survey))[base.part]
        )
        inside = inside[_LEAST_PART:-_LEAST_PART]
        return inside[:: max(1, -(-len(inside) // _GRID))]

    def _best(self, found: _Search, adjustment: Adjustment) -> tuple[float, Effect]:
        gains = self._gains(found, adjustment)
        most = max(gains.values())
        # The simplest of those that explain the lengths nearly as well as the best: an offset before a move.
        near_best = [effect for effect, gain in gains.items() if most - gain < min(_CLEAR, max(most, 0.0))]
        best = min(
            near_best, key=lambda effect: (effect.size, -gains[effect]), default=max(gains, key=gains.__getitem__)
        )
        gain = gains[best]
        if best.since:
            end = best.until or len(self._given.survey)
            near = np.arange(max(best.since - self._apart, 1), min(best.since + self._apart, end))
            gained = score_since(adjustment, best._replace(since=0), self._used(found), near)
            gain, best = float(gained.max()) - self._price(best), best._replace(since=int(near[np.argmax(gained)]))
        return gain, best

    @property
    def _apart(self) -> int:
        return -(-len(self._given.survey) // _GRID)

    def _left_out(self, found: _Search, lengths: FloatArray, worst: float) -> _Search:
        """Without the worst lengths, where one of a point is clearly the wrong one; otherwise without the point."""
        bad_lengths, bad_points = found.bad_lengths.copy(), found.bad_points.copy()
        valid = (np.isfinite(self._given.lengths_m) & ~bad_lengths).sum(axis=1)
        for point in np.flatnonzero((lengths.max(axis=1) >= max(0.25 * worst, 1e-12)) & ~bad_points):
            second, first = np.sort(lengths[point])[-2:]
            if first - second >= _CLEAR and valid[point] >= _LOCATED_FROM:
                bad_lengths[point, int(np.argmax(lengths[point]))] = True
            else:
                bad_points[point] = True
        return found._replace(bad_lengths=bad_lengths, bad_points=bad_points)

    def _findings(self, found: _Search, adjustment: Adjustment) -> list[Finding]:
        """The significant effects, each with the candidates that explain the lengths nearly as well without it."""
        findings = []
        strengths = {one: _strength(adjustment, one) - self._price(one) for one in found.wide & {*self._variations}}
        for effect in adjustment.slices:
            if effect not in found.wide or self._ratio(found, adjustment, effect) > UNDETERMINED:
                continue
            if effect in strengths and strengths[effect] < max(
                strength for one, strength in strengths.items() if one.of == effect.of
            ):
                # A weaker band of a variation is a part of it.
                if strengths[effect] > 0.0:
                    findings.append(Finding(effect, adjustment.of(effect), adjustment.covariance_of(effect), ()))
                continue
            without = self._narrowed(found, effect)
            other = adjust(self._used(without), dict(without.sigmas), adjustment.noise, adjustment)
            gains = self._gains(without, other, effect.since)
            same = {one for one in gains if (one.kind, one.of) == (effect.kind, effect.of)}
            mine = max((gains[one] for one in same), default=-np.inf)
            if mine <= 0.0:
                continue
            alternatives = (one for one, gain in gains.items() if one not in same and mine - gain < _CLEAR)
            findings.append(
                Finding(effect, adjustment.of(effect), adjustment.covariance_of(effect), tuple(alternatives))
            )
        return findings

    def _has_frame(self, found: _Search) -> bool:
        moved = {one.of for one in found.wide if one.kind is EffectKind.COLLIMATOR and one.since == 0}
        return not moved or self._given.lengths_m.shape[1] - len(moved) >= _FRAME

    @staticmethod
    def _ratio(found: _Search, adjustment: Adjustment, effect: Effect) -> float:
        """Posterior over prior sigma of an effect, in its worst direction; of a variation the rms."""
        if effect.kind is EffectKind.VARIATION:
            return sqrt(float(np.trace(adjustment.covariance_of(effect))) / effect.size) / found.sigmas[effect]
        return sqrt(float(np.linalg.eigvalsh(adjustment.covariance_of(effect))[-1])) / found.sigmas[effect]

    def _result(
        self, state: NetworkState, found: _Search, findings: Iterable[Finding], adjustment: Adjustment
    ) -> NetworkResult:
        used = ~found.bad_points
        absorbed = len(adjustment.values) - float(np.sum(np.diag(adjustment.covariance) / adjustment.prior))
        dof = max(round(float(adjustment.dof[used].sum()) - absorbed), 1)
        chi2 = float(adjustment.chi2[used].sum()) * adjustment.noise**2
        noise = sqrt(max(chi2 / dof, 1.0))
        if noise != adjustment.noise:
            adjustment = adjust(self._used(found), dict(found.sigmas), noise, adjustment)
        findings = tuple(findings)
        named = {other for one in findings for other in (one.effect, *one.alternatives)}
        return NetworkResult(
            state=state,
            given=self._given,
            adjustment=adjustment,
            findings=findings,
            suspects=tuple(one for one in adjustment.slices if one in found.wide - named),
            undetermined=tuple(
                one
                for one in adjustment.slices
                if one not in self._variations and self._ratio(found, adjustment, one) > UNDETERMINED
            ),
            noise=noise,
            is_noisy=float(chdtrc(dof, chi2)) < self._noise_chance,
            channel_noise=noise * found.channel_noise,
            chi2=chi2,
            dof=dof,
            bad_lengths=found.bad_lengths,
            bad_points=found.bad_points,
            has_frame=self._has_frame(found),
        )


def _strength(adjustment: Adjustment, effect: Effect) -> float:
    """Chi-square of an effect with a wide prior."""
    values = adjustment.of(effect)
    return float(values @ np.linalg.solve(adjustment.covariance_of(effect), values))


def prior_of_both(value: float, variance: float, usual: float, moved: float) -> float:
    """Sigma of a prior in place of the usual and the wide one: root of their mean square by the chances of both.

    ``value`` and ``variance``: of the unknown with the ``usual`` prior. The chances are those by the lengths alone.
    Where the lengths do not decide, the wide prior has nearly all of the mean square, so that intervals hold
    whichever prior is true.
    """
    information = max(1.0 / variance - 1.0 / usual**2, 1e-6 / moved**2)
    seen = value / (variance * information)  # by the lengths alone
    squares = np.array([usual, moved]) ** 2
    spreads = squares + 1.0 / information
    exponents = -0.5 * seen**2 / spreads - 0.5 * np.log(spreads) + np.log([1.0 - _AIR_CHANGED, _AIR_CHANGED])
    chances = np.exp(exponents - exponents.max())
    return sqrt(float(chances @ squares / chances.sum()))


def variations(given: SurveyLengths) -> Iterator[Effect]:
    """The bands of the variation of the scale in each survey that is long enough for them."""
    for survey in range(given.surveys):
        hours = given.hours[given.survey == survey]
        most = min(int(2.0 * np.ptp(hours) / _SHORTEST_H), len(hours) // _POINTS_OF_A_TERM)
        for first, end in pairwise(_BANDS):
            terms = min(end, most + 1) - first
            if terms > 0:
                yield Effect(EffectKind.VARIATION, survey, order=first, terms=terms)


def prior_of_many(values: FloatArray, covariance: FloatArray, prior: float, sigmas: FloatArray, chance: float) -> float:
    """Sigma of the common prior of some unknowns: root of the mean square of 0 and ``sigmas`` by the chances of each.

    ``values`` and ``covariance``: of the unknowns with the sigma ``prior``. That one of ``sigmas`` is true has the
    ``chance`` without the lengths, each the same.
    """
    precision = np.linalg.inv(covariance)
    information, axes = np.linalg.eigh(precision - np.eye(len(values)) / prior**2)
    seen = (axes.T @ precision @ values) ** 2
    squares = np.concatenate([[0.0], sigmas**2])
    grown = 1.0 + np.maximum(information, 0.0) * squares[:, None]
    exponents = 0.5 * np.sum(seen * squares[:, None] / grown - np.log(grown), axis=1)
    exponents += np.log([1.0 - chance, *np.full(len(sigmas), chance / len(sigmas))])
    chances = np.exp(exponents - exponents.max())
    return max(sqrt(float(chances @ squares / chances.sum())), _EXACT[EffectKind.SCALE])


def change_price(size: int, chance: float, count: int) -> float:
    """Least chi-square of a change at an unknown point of ``count``, for a probability of any such by noise.

    Tail of the maximum of a chi-square process over the first points; James, James and Siegmund 1987.
    """
    part = _LEAST_PART / max(count, 2 * _LEAST_PART + 1)
    span, price = 2.0 * log((1.0 - part) / part), float(chdtri(size, chance))
    for _ in range(20):
        looks = 1.0 + 0.5 * price * span * max(1.0 - size / price, 0.0) + 2.0
        price = float(chdtri(size, chance / looks))
    return price


def calibrate(given: SurveyLengths, etalon: EtalonConfig, cfg: NetworkConfig, false_alarm: float) -> NetworkResult:
    """Adjust the network with all lengths of one survey, or of several by the same collimators."""
    return NetworkSearch(given, etalon, cfg, false_alarm).run()
