"""Pure. Whether a map and its ranges agree: which ranges are outliers, and how well the others fit."""

from dataclasses import dataclass

import numpy as np

from ccatp.motes.map_batch import BatchFit
from ccatp.motes.range_network import FloatArray

_DENIED = 3.0  # chi-squared for each degree of freedom


@dataclass(frozen=True, slots=True)
class Agreement:
    """How the ranges fit a map.

    Attributes:
        outlying: ranges of which the loss left less than half.
        inlier_cost: chi-squared of the others.
        dof: of all ranges.
    """

    outlying: tuple[int, ...]
    inlier_cost: float
    dof: int

    @property
    def outliers(self) -> int:
        """The number of ``outlying``."""
        return len(self.outlying)

    @property
    def factor(self) -> float:
        """Chi-squared of the ranges that are no outliers by their degree of freedom: 1 where the sigmas are right."""
        left = self.dof - self.outliers
        return self.inlier_cost / left if left > 0 else 1.0

    @property
    def is_denied(self) -> bool:
        """Whether the good ranges do not fit, or more than half of those to spare are outliers.

        As many outliers as that can agree on another map (breakdown point: Rousseeuw 1984).
        """
        return self.factor > _DENIED or 2 * self.outliers > self.dof > 0


def agreement_of(fit: BatchFit, sigmas_m: FloatArray, dof: int) -> Agreement:
    """How the ranges fit a map.

    Args:
        fit: the map.
        sigmas_m: of its ranges, shape (m,).
        dof: ranges less unknowns that they determine.
    """
    is_out = fit.weights < 0.5
    cost = float(((fit.residuals_m / sigmas_m)[~is_out] ** 2).sum())
    return Agreement(tuple(np.flatnonzero(is_out).tolist()), cost, dof)
