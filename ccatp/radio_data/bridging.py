"""Pure. Steps of which the odometry tells nothing: what the vehicle most likely did, and how far that may be off."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ccatp.radio.recording import Steps
from ccatp.radio_data.cleaning import long_pauses
from ccatp.samples import FloatArray

BEFORE_S = 1.0
"""Over so long the speed before a gap is taken."""
WINDOWS = 1000
"""Spans of the run by which speeds are compared with those before."""
LOST_RAD = float(np.pi / np.sqrt(3.0))
"""Standard deviation of a heading that is anything: more cannot be unknown."""


class _Guess(NamedTuple):
    """Amount of a span, by the mean rate before it.

    Attributes:
        share: of that rate, by which the span goes on.
        sigma: standard deviation of the amount.
    """

    share: float
    sigma: float


def bridged(steps: Steps) -> Steps:
    """Steps without gaps: ways and turns that are NaN, or span a pause of the recording, are guessed.

    A vehicle goes on as it did. How much so, and how far that is off, the run tells itself: by the least-squares ratio,
    over all spans as long as the gap, of what was travelled to the rate in the ``BEFORE_S`` before. If the heading is
    lost by sigma, the mean of the way is shorter by exp(-sigma^2 / 2), and the rest of it is spread about that.
    """
    interval_s = np.diff(steps.times_s)
    unknown = np.isnan(steps.distance_m + steps.turn_rad + steps.lateral_m)
    unknown[long_pauses(steps.times_s)] = True
    if not unknown.any() or unknown.all():
        return steps
    known_s = np.concatenate([[0.0], np.cumsum(interval_s[~unknown])])
    way, turn = (np.concatenate([[0.0], np.cumsum(c[~unknown])]) for c in (steps.distance_m, steps.turn_rad))
    distance_m, turn_rad, lateral_m = steps.distance_m.copy(), steps.turn_rad.copy(), steps.lateral_m.copy()
    guess_m2, guess_rad2 = np.zeros(unknown.size), np.zeros(unknown.size)
    for first, stop in _runs(unknown):
        span_s = float(interval_s[first:stop].sum())
        begin_s = float(interval_s[:first][~unknown[:first]].sum())
        by_way, by_turn = _guessed(known_s, way, span_s), _guessed(known_s, turn, span_s)
        lost_rad = min(by_turn.sigma, LOST_RAD)
        kept = float(np.exp(-0.5 * lost_rad**2))
        went_m = by_way.share * _rate_before(known_s, way, begin_s) * span_s
        part = interval_s[first:stop] / span_s
        distance_m[first:stop] = kept * went_m * part
        turn_rad[first:stop] = by_turn.share * _rate_before(known_s, turn, begin_s) * span_s * part
        lateral_m[first:stop] = 0.0
        guess_m2[first:stop] = (by_way.sigma * by_way.sigma + went_m * went_m * (1.0 - kept * kept)) * part
        guess_rad2[first:stop] = lost_rad**2 * part
    return Steps(steps.times_s, distance_m, turn_rad, lateral_m, guess_m2, guess_rad2)


def _runs(marked: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and end of each row of marks."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _rate_before(times_s: FloatArray, total: FloatArray, at_s: float) -> float:
    """Mean rate in the ``BEFORE_S`` before a time of what was added up; 0 at the beginning."""
    from_s = max(at_s - BEFORE_S, float(times_s[0]))
    if at_s <= from_s:
        return 0.0
    begin, end = np.interp((from_s, at_s), times_s, total).tolist()
    return float((end - begin) / (at_s - from_s))


def _guessed(times_s: FloatArray, total: FloatArray, span_s: float) -> _Guess:
    """How the amount of a span follows from the rate before it; a span of half the run at most is looked at."""
    whole_s = float(times_s[-1] - times_s[0])
    before_s, seen_s = min(BEFORE_S, 0.25 * whole_s), min(span_s, 0.5 * whole_s)
    t = np.linspace(times_s[0] + before_s, times_s[-1] - seen_s, WINDOWS)
    at, later, sooner = (np.interp(t + shift, times_s, total) for shift in (0.0, seen_s, -before_s))
    rate, went = (at - sooner) / before_s, (later - at) / seen_s
    square = float(rate @ rate)
    share = float(rate @ went) / square if square > 0.0 else 0.0
    return _Guess(share, float(np.sqrt(np.mean((went - share * rate) ** 2))) * span_s)
