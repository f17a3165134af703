"""Pure. Outliers among the points of a panel, and whether it is bent: the cheapest explanation of its deviations.

Each explanation is a fit, rigid or with curvatures, to all points but a few. It costs its chi-square, and besides a
price for every point left out and a price for the curvatures; the cheapest one holds. Leaving a point out is the same
as giving it a shift of its own (mean-shift model), so its price is the chi-square of one degree of freedom that noise
reaches only with the agreed probability, shared by all points of the mirror. Baarda's data snooping asks the same of
one point at a time; a bent panel would make it throw good points away.
"""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.aligning.deviations import Deviations
from ccatp.aligning.modes import MAX_CONDITION, BoolArray, FloatArray, quadratic, rigid

_CURVATURES = 3
# Points beyond those that a fit takes, for each that is left out. With fewer, some choice of points always fits.
REDUNDANCY = 3


class Prices(NamedTuple):
    """Chi-square that has to be gained by leaving a point out, and by the three curvatures of a panel."""

    outlier: float
    shape: float


class Explanation(NamedTuple):
    """Points that count, and whether the curvatures are significant."""

    is_kept: BoolArray
    has_shape: bool


def prices(false_alarm: float, points: int, panels: int) -> Prices:
    """What an explanation costs.

    Args:
        false_alarm: probability that noise alone makes an outlier anywhere on the mirror, and as much for a shape.
        points: measured points of the mirror.
        panels: panels with measured points.
    """
    return Prices(
        float(chdtri(1, false_alarm / max(points, 1))), float(chdtri(_CURVATURES, false_alarm / max(panels, 1)))
    )


def explain(deviations: Deviations, price: Prices) -> Explanation:
    """The cheapest explanation of a panel's deviations.

    A panel that cannot be fitted, or has hardly more points than it takes, keeps all of them.
    """
    count = len(deviations.points)
    target = deviations.values_m / deviations.sigmas_m
    best, lowest = Explanation(np.ones(count, dtype=np.bool_), has_shape=False), np.inf
    for modes, needed in ((rigid, 3), (quadratic, 6)):
        has_shape = modes is quadratic
        extra = price.shape if has_shape else 0.0
        whitened = modes(deviations.places_m) * (deviations.lever / deviations.sigmas_m)[:, None]
        whitened /= np.linalg.norm(whitened, axis=0)
        for is_kept in _subsets(count, (count - needed) // REDUNDANCY):
            cost = extra + price.outlier * int(np.count_nonzero(~is_kept))
            if cost >= lowest:
                continue
            cost += _chi2(whitened[is_kept], target[is_kept])
            if cost < lowest:
                best, lowest = Explanation(is_kept, has_shape), cost
    return best


def _subsets(count: int, most: int) -> Iterator[BoolArray]:
    for left_out in range(most + 1):
        for some in combinations(range(count), left_out):
            is_kept = np.ones(count, dtype=np.bool_)
            is_kept[list(some)] = False
            yield is_kept


def _chi2(whitened: FloatArray, target: FloatArray) -> float:
    """What least squares leave; infinite where the points do not determine the coefficients."""
    solution, _, rank, _ = np.linalg.lstsq(whitened, target, rcond=1.0 / MAX_CONDITION)
    left = target - whitened @ solution
    return float(left @ left) if rank == whitened.shape[1] else np.inf
