"""Noise of the ranges of each beacon, from the residuals of a window: its spread, and how long its errors last."""

from math import log

import numpy as np

from ccatp.beacons.estimation.batch_problem import BatchProblem, BeaconNoise
from ccatp.beacons.estimation.batch_unknowns import BatchState
from ccatp.beacons.estimation.measurement_models import range_variance
from ccatp.core import FloatArray

FEWEST = 20  # readings of a beacon from which its noise is estimated
SPANS = 5.0  # correlation times of the errors that readings must span: in a shorter time such errors look constant
ASSUMED = 10.0  # number of independent readings for which the configured noise counts
LEAST = 0.25  # smallest factor on the configured variance
CLIPPED = 3.0  # standard deviations at which residuals are cut off: outliers are no errors that last
SURE = 2.0  # standard deviations of a correlation by chance, above which it counts
MOST_SHARE, LONGEST = 0.95, 0.995  # of the variance that lasts; correlation of successive readings
SCALINGS = 10  # iterations of the scale of Student's t


def range_noise(problem: BatchProblem, state: BatchState, before: BeaconNoise) -> BeaconNoise:
    """The noise of each beacon by each radio.

    The noise as it was before where there are too few readings, or in too short a time.
    """
    noise = BeaconNoise(*(column.copy() for column in before))
    off_m = problem.residuals(state).readings[:, 0]
    sigmas = np.sqrt(range_variance(problem.radio, problem.readings.range_m))
    for heard in range(len(noise.variance)):
        rows = np.flatnonzero((problem.heard == heard) & problem.there[:, 0])
        times_s = problem.readings.times_s[rows]
        if rows.size < FEWEST or times_s[-1] - times_s[0] < SPANS * before.lasts_s[heard]:
            continue
        noise.repeats[heard], noise.share[heard], noise.lasts_s[heard] = 1.0, 0.0, 1.0
        e = off_m[rows] / sigmas[rows]
        square = _scale(e, problem.radio.freedom)
        rho = correlations(np.clip(e / np.sqrt(square), -CLIPPED, CLIPPED))
        if rho[1] > SURE / np.sqrt(rows.size):
            noise.repeats[heard] = repeats = readings_as_one(rho)
            # rho_k = share phi^k, whose sum over k is share phi / (1 - phi)
            phi = min(max(1.0 - 2.0 * float(rho[1]) / max(repeats - 1.0, 1e-9), 0.1), LONGEST)
            noise.share[heard] = min(float(rho[1]) / phi, MOST_SHARE)
            noise.lasts_s[heard] = -float(np.median(np.diff(times_s))) / log(phi)
        count = rows.size / noise.repeats[heard]
        noise.variance[heard] = max((ASSUMED + count * square) / (ASSUMED + count), LEAST)
    return noise


def _scale(e: FloatArray, freedom: float) -> float:
    """Maximum-likelihood square of the scale of Student's t, of residuals (m,)."""
    square = float(np.median(e * e)) / 0.455  # the median of chi-squared of one degree of freedom
    for _ in range(SCALINGS):
        square = float(np.mean(e * e * (freedom + 1.0) / (freedom + e * e / max(square, 1e-12))))
    return max(square, 1e-6)


def correlations(e: FloatArray) -> FloatArray:
    """Correlation of errors (m,) of mean zero with those that follow 0, 1, ... m / 3 readings later."""
    m = e.size
    lags = m // 3 + 1
    spectrum = np.fft.rfft(e, 2 * m)
    sums = np.fft.irfft(spectrum * spectrum.conj(), 2 * m)[:lags]
    found: FloatArray = sums / np.arange(m, m - lags, -1)
    return np.asarray(found / found[0])


def readings_as_one(rho: FloatArray) -> float:
    """1 + 2 sum(rho): the number of readings that together tell as much of a constant as one with white errors would.

    The sum ends before the first pair of correlations that is not positive (initial monotone sequence: Geyer 1992).
    """
    pairs = rho[: rho.size // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.0)
    pairs = np.minimum.accumulate(pairs[: ends[0]] if ends.size else pairs)
    return max(1.0, 2.0 * float(pairs.sum()) - 1.0)
