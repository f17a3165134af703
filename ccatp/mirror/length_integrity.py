"""Integrity of a fix from the redundancy of its lengths: fault detection and exclusion (RAIM), with its limits.

``m`` lengths for three coordinates leave ``m - 3`` combinations, the parity vector ``p = Q^T (l - |x - c|)``, which no
error of the position reaches (``Q``: orthonormal, ``Q^T H = 0``). Its covariance is ``Q^T (N + G P G^T) Q``: ``N`` is
the noise of the lengths, ``P`` that of the network ``b`` (collimators, offset of each channel, one refraction scale),
which is common to all fixes of a run. ``b`` begins with its prior, and each good fix corrects it (Kalman filter), so
the first fixes calibrate the part of the network that shows in the parity vector. Deviations within the prior that
exist from the first fix on belong to that part and are no fault. What does not show in it stays unknown: it moves all
fixes alike.

The chi-squares of successive fixes are independent, so that a probability per survey divides by the number of fixes.

An error of one channel that is larger than its prior and exists from the first fix on is calibrated away fix by fix.
``constant_errors`` finds it: the likelihood ratio of such an error, with what the correction of the network makes of it
in the later innovations (Willsky and Jones 1976).
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from math import inf, isfinite
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, ndtri

from ccatp.config.models import EtalonConfig
from ccatp.core import GOOD, UNCHECKED, UNRELIABLE, FloatArray, Vector3
from ccatp.mirror.multilateration import MultilaterationError, RangeSolution, multilaterate

SURVEY_FIXES = 800  # number of fixes of a survey for which the probability of a false alarm is configured
LOCATED_FROM = 6  # valid channels
_DETECTED_FROM, _TWO_FROM = 5, 8
_POWER = 0.999  # of the minimal detectable error
_CLEAR = 13.8  # least difference of the chi-squares of the best and the second explanation, 0.001 for two explanations
_COVER = 3.3  # sigmas of the noise in a protection level, 0.999
_PER_COLLIMATOR = 3
# Part of an error, or of the largest information of a channel, below which only rounding shows it in the parity vector.
_INVISIBLE = 1e-12


def per_fix(cfg: EtalonConfig) -> float:
    """Probability of a false alarm of one fix; the rest of that of a survey belongs to the running tests."""
    return 0.4 * cfg.false_alarm / SURVEY_FIXES


class Parity(NamedTuple):
    """What the lengths of one fix have in common with no position: basis Q (m, r), Q^T G (r, n), covariance (r, r).

    ``rows`` (m,): positions of the channels in the network.
    """

    rows: tuple[int, ...]
    basis: FloatArray
    design: FloatArray
    covariance: FloatArray


class NetworkCalibration:
    """Errors of the network: per channel collimator (3) and offset, then the refraction scale; SI units.

    ``mean`` has the shape (n,), or (runs, n) for many runs along the same places at once. ``covariance`` (n, n).
    """

    def __init__(self, cfg: EtalonConfig, count: int) -> None:
        sigmas = [*[cfg.collimator_sigma_m] * (_PER_COLLIMATOR * count), *[cfg.offset_sigma_m] * count]
        self.covariance: FloatArray = np.diag(np.square([*sigmas, cfg.refraction_sigma]))
        self.mean: FloatArray = np.zeros(len(self.covariance))
        self._count = count
        # Of a constant error of each channel: change of the mean per metre, and its score and information until now.
        self._shifts: FloatArray = np.zeros((count, len(self.covariance)))
        self._scores: FloatArray = np.zeros(count)
        self._information: FloatArray = np.zeros(count)

    def design(self, rows: Sequence[int], directions: FloatArray, distances_m: FloatArray) -> FloatArray:
        """G (m, n): change of the lengths per error of the network; directions (m, 3) from collimators to puck."""
        count, width = len(rows), len(self.mean.T)
        found = np.zeros((count, width))
        at = np.arange(count)
        for axis in range(_PER_COLLIMATOR):
            found[at, _PER_COLLIMATOR * np.array(rows) + axis] = -directions[:, axis]
        found[at, _PER_COLLIMATOR * self._count + np.array(rows)] = 1.0
        found[:, -1] = distances_m
        return found

    def parity(
        self, rows: Sequence[int], directions: FloatArray, distances_m: FloatArray, sigmas_m: FloatArray
    ) -> Parity:
        """The parity space of m lengths with noise ``sigmas_m`` (m,)."""
        basis = np.linalg.qr(directions, mode="complete")[0][:, directions.shape[1] :]
        design = basis.T @ self.design(rows, directions, distances_m)
        noise = (basis.T * sigmas_m**2) @ basis
        return Parity(tuple(rows), basis, design, noise + design @ self.covariance @ design.T)

    def innovation(self, parity: Parity, residuals_m: FloatArray) -> FloatArray:
        """Parity vector minus its expectation, (r,) or (runs, r); residuals (m,) or (runs, m)."""
        return np.asarray(residuals_m @ parity.basis - self.mean @ parity.design.T)

    def correct(self, parity: Parity, innovation: FloatArray) -> None:
        """Correct the network by a good fix."""
        spread = self.covariance @ parity.design.T
        gain: FloatArray = np.asarray(np.linalg.solve(parity.covariance, spread.T).T, dtype=np.float64)
        self._score_constant_errors(parity, innovation, gain)
        self.mean = self.mean + innovation @ gain.T
        left = self.covariance - gain @ spread.T
        self.covariance = 0.5 * (left + left.T)

    def _score_constant_errors(self, parity: Parity, innovation: FloatArray, gain: FloatArray) -> None:
        shown = -self._shifts @ parity.design.T
        shown[list(parity.rows)] += parity.basis
        weighted = np.linalg.solve(parity.covariance, shown.T)
        self._scores = self._scores + innovation @ weighted
        self._information = self._information + np.sum(shown * weighted.T, axis=1)
        self._shifts = self._shifts + shown @ gain.T

    def constant_errors(self) -> tuple[FloatArray, FloatArray]:
        """Errors of single channels since the first fix: standardised (standard normal without a fault), and in m.

        Both (count,), or (runs, count).
        """
        is_shown = self._information > _INVISIBLE * np.max(self._information)
        information = np.where(is_shown, self._information, np.inf)
        return np.asarray(self._scores / np.sqrt(information)), np.asarray(self._scores / information)


def chi_square(parity: Parity, innovation: FloatArray) -> FloatArray:
    """Chi-square with r degrees of freedom, of each run."""
    return np.asarray(np.sum(innovation * np.linalg.solve(parity.covariance, innovation.T).T, axis=-1))


def standardised(parity: Parity, innovation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors of single channels that the innovation shows, each standard normal without a fault; and their sigmas, m.

    Shapes (m,) or (runs, m), and (m,). An error that shows in no innovation is 0 with an infinite sigma. Reference:
    Baarda 1968 (w-test).
    """
    weights = np.linalg.solve(parity.covariance, parity.basis.T)
    information = np.einsum("ij,ji->i", parity.basis, weights)
    is_shown = information > _INVISIBLE * np.max(information)
    inverse = 1.0 / np.sqrt(np.where(is_shown, information, 1.0))
    return np.asarray(innovation @ weights * np.where(is_shown, inverse, 0.0)), np.where(is_shown, inverse, np.inf)


class Judgement(NamedTuple):
    """Result of the test of one fix.

    ``used``, ``left_out``: channels; ``suspects``: those that contradict each other. ``detectable_m``: error of a
    length found with probability 0.999, in the worst channel (infinite without redundancy). ``protection_m``: error of
    the position by an undetected fault of one channel, or of all (offset, scale) alike, with the noise.
    ``inconsistency_m``: error of the position that the contradiction allows. ``w``: standardised errors
    by channel, of a fix whose used lengths agree and are new.
    """

    solution: RangeSolution
    metrology: str
    used: tuple[int, ...]
    left_out: tuple[int, ...]
    suspects: tuple[int, ...]
    chi2: float
    dof: int
    detectable_m: float
    protection_m: float
    inconsistency_m: float
    w: Mapping[int, float]


def _is_shown(pattern: FloatArray, error: FloatArray) -> bool:
    """Whether errors of the lengths (m,) show in the parity vector by more than rounding."""
    return float(pattern @ pattern) > _INVISIBLE * float(error @ error)


class _Subset(NamedTuple):
    channels: tuple[int, ...]
    solution: RangeSolution
    parity: Parity
    innovation: FloatArray
    chi2: float


class LengthIntegrity:
    """Judges the lengths of the fixes of one run, and calibrates the network by those without a fault."""

    def __init__(self, cfg: EtalonConfig, collimators_m: Mapping[int, FloatArray]) -> None:
        self._cfg = cfg
        self._collimators_m = dict(collimators_m)
        self._rows = {channel: row for row, channel in enumerate(collimators_m)}
        self.network = NetworkCalibration(cfg, len(self._rows))
        self._before: Mapping[int, float] = {}

    def judge(self, expected_m: Vector3, lengths_m: Mapping[int, float]) -> Judgement:
        """Solve, test, and exclude; raises ``MultilaterationError`` without a solution."""
        channels = tuple(lengths_m)
        whole = self._solve(channels, expected_m, lengths_m)
        is_new = lengths_m != self._before
        if self._is_consistent(whole):
            self._learn(whole, lengths_m)
            metrology = UNCHECKED if len(channels) < _DETECTED_FROM else GOOD
            return self._judgement(whole, metrology, (), (), is_new=is_new)
        best, suspects = self._locate(whole, expected_m, lengths_m)
        if best is None:
            return self._judgement(whole, UNRELIABLE, (), suspects, is_new=is_new)
        left_out = tuple(channel for channel in channels if channel not in best.channels)
        self._learn(best, lengths_m)
        return self._judgement(best, GOOD, left_out, left_out, is_new=is_new)

    def _solve(self, channels: tuple[int, ...], expected_m: Vector3, lengths_m: Mapping[int, float]) -> _Subset:
        ranges_m = np.array([lengths_m[channel] for channel in channels])
        anchors_m = np.array([self._collimators_m[channel] for channel in channels]).reshape(-1, 3)
        sigmas_m = self._cfg.length_sigma_m + self._cfg.length_sigma_per_m * ranges_m
        solution = multilaterate(anchors_m, ranges_m, sigmas_m, expected_m)
        offsets = solution.position_m - anchors_m
        distances_m = np.linalg.norm(offsets, axis=1)
        rows = [self._rows[channel] for channel in channels]
        parity = self.network.parity(rows, offsets / distances_m[:, None], distances_m, sigmas_m)
        innovation = self.network.innovation(parity, solution.residuals_m)
        return _Subset(channels, solution, parity, innovation, float(chi_square(parity, innovation)))

    def _limit(self, dof: int) -> float:
        return float(chdtri(dof, per_fix(self._cfg)))

    def _is_consistent(self, some: _Subset) -> bool:
        return some.chi2 <= self._limit(len(some.innovation))

    def _locate(
        self, whole: _Subset, expected_m: Vector3, lengths_m: Mapping[int, float]
    ) -> tuple[_Subset | None, tuple[int, ...]]:
        """The channels without the faulty ones if one explanation is clearly the best; and the suspects."""
        count = len(whole.channels)
        for number, needed in ((1, LOCATED_FROM), (2, _TWO_FROM)):
            if count < needed:
                break
            found = []
            for kept in combinations(whole.channels, count - number):
                try:
                    some = self._solve(kept, expected_m, lengths_m)
                except MultilaterationError:
                    continue
                if some.solution.dop <= self._cfg.max_dop:
                    found.append(some)
            found.sort(key=lambda some: some.chi2)
            explained = [some for some in found if self._is_consistent(some)]
            if not explained:
                continue
            rivals = [self._chi2_of_common(whole), *(some.chi2 for some in found[1:])]
            if min(rivals) - found[0].chi2 >= _CLEAR:
                return found[0], ()
            kept_by_all = set.intersection(*(set(some.channels) for some in explained))
            return None, tuple(channel for channel in whole.channels if channel not in kept_by_all) or whole.channels
        return None, whole.channels

    def _chi2_of_common(self, whole: _Subset) -> float:
        """Chi-square if an error common to all lengths, in m or in proportion, is the explanation."""
        parity, best = whole.parity, whole.chi2
        for error in self._common(whole):
            pattern = error @ parity.basis
            if not _is_shown(pattern, error):
                continue
            weighted = np.linalg.solve(parity.covariance, pattern)
            gain = float(weighted @ whole.innovation) ** 2 / float(pattern @ weighted)
            best = min(best, whole.chi2 - gain)
        return best

    def _common(self, some: _Subset) -> FloatArray:
        """Errors common to all lengths: an offset, and a scale; (2, m)."""
        lengths_m = self._lengths_of(some)
        return np.array([np.ones(len(lengths_m)), lengths_m])

    def _lengths_of(self, some: _Subset) -> FloatArray:
        anchors_m = np.array([self._collimators_m[channel] for channel in some.channels])
        return np.asarray(np.linalg.norm(some.solution.position_m - anchors_m, axis=1))

    def _learn(self, some: _Subset, lengths_m: Mapping[int, float]) -> None:
        """Lengths of the last fix, repeated, have the same noise and are no new information."""
        if lengths_m != self._before:
            self._before = dict(lengths_m)
            self.network.correct(some.parity, some.innovation)

    def _judgement(
        self, some: _Subset, metrology: str, left_out: tuple[int, ...], suspects: tuple[int, ...], *, is_new: bool
    ) -> Judgement:
        w, sigmas = standardised(some.parity, some.innovation)
        dof = len(some.innovation)
        # A chi-square above its limit needs at most this error of a single channel, in sigmas of that error.
        least = float(np.sqrt(self._limit(dof)) + ndtri(_POWER))
        moves = self._moves(some)
        # Per sigma of its visibility: what an error of one channel, or of all alike, moves the position.
        moved_m = [*(np.linalg.norm(moves, axis=0) * sigmas).tolist(), *self._moved_by_common(some, moves)]
        noise_m = _COVER * float(np.sqrt(np.linalg.eigvalsh(some.solution.covariance_m2)[-1]))
        is_checked = len(some.channels) >= _DETECTED_FROM
        return Judgement(
            solution=some.solution,
            metrology=metrology,
            used=some.channels,
            left_out=left_out,
            suspects=suspects,
            chi2=some.chi2,
            dof=dof,
            detectable_m=least * float(np.max(sigmas)) if is_checked else inf,
            protection_m=least * max(moved_m) + noise_m if is_checked else inf,
            # An error that does not show in the parity vector cannot explain the contradiction.
            inconsistency_m=max(filter(isfinite, moved_m), default=0.0) * float(np.sqrt(some.chi2))
            if metrology == UNRELIABLE
            else 0.0,
            w=dict(zip(some.channels, w.tolist(), strict=True)) if is_new and metrology != UNRELIABLE else {},
        )

    def _moved_by_common(self, some: _Subset, moves: FloatArray) -> list[float]:
        """Move of the position by each error common to all lengths, per sigma; infinite if it does not show."""
        parity, found = some.parity, []
        for error in self._common(some):
            pattern = error @ parity.basis
            visible = float(pattern @ np.linalg.solve(parity.covariance, pattern))
            moved_m = float(np.linalg.norm(moves @ error))
            found.append(moved_m / visible**0.5 if _is_shown(pattern, error) else inf)
        return found

    def _moves(self, some: _Subset) -> FloatArray:
        """Change of the position per error of each length, (3, m)."""
        lengths_m = self._lengths_of(some)
        anchors_m = np.array([self._collimators_m[channel] for channel in some.channels])
        directions = (some.solution.position_m - anchors_m) / lengths_m[:, None]
        weights = (self._cfg.length_sigma_m + self._cfg.length_sigma_per_m * lengths_m) ** -2.0
        return np.asarray(some.solution.covariance_m2 @ (directions * weights[:, None]).T)
