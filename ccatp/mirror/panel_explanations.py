"""Which points of a panel are wrong, and whether it is bent: explanations of its deviations, and how they compare.

The method is in docs/align.md.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from ccatp.core import BoolArray, FloatArray
from ccatp.mirror.panel_modes import MAX_CONDITION, Deviations, quadratic, rigid

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
