"""Pure. The spread of many non-negative numbers in little room: histograms that add up over jobs.

A mission has half a million localization errors; a campaign pools hundreds of missions. Bins are 1/1000 of a decade
wide, so a quantile is right to 0.12 %; count, mean, maximum and the share within the limit are exact.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ccatp.samples import FloatArray, IntArray

PER_DECADE = 1000
LEAST = 1e-9  # anything smaller falls into the first bin


@dataclass(frozen=True, slots=True)
class Spread:
    """A histogram with logarithmic bins, empty ones left out.

    Attributes:
        bins: indices of the bins, ascending, shape (k,). Bin i ends at ``LEAST * 10**(i / PER_DECADE)``.
        counts: in each of them, shape (k,).
        total: sum of the values.
        largest: of the values; 0 where there are none.
        within: how many are at most the limit.
    """

    bins: IntArray
    counts: IntArray
    total: float
    largest: float
    within: int

    @classmethod
    def of(cls, values: FloatArray, limit: float) -> "Spread":
        """The spread of values, shape (n,).

        Raises:
            ValueError: a value is negative or not finite.
        """
        if values.size and not (np.isfinite(values).all() and values.min() >= 0.0):
            raise ValueError(f"values from {values.min()} to {values.max()}: must be finite and not negative")
        places = np.ceil(PER_DECADE * np.log10(np.maximum(values, LEAST) / LEAST)).astype(np.int64)
        bins, counts = np.unique(places, return_counts=True)
        largest = float(values.max(initial=0.0))
        return cls(bins, counts.astype(np.int64), float(values.sum()), largest, int(np.count_nonzero(values <= limit)))

    @property
    def count(self) -> int:
        """How many values."""
        return int(self.counts.sum())

    @property
    def mean(self) -> float:
        """Their mean; NaN where there are none."""
        return self.total / self.count if self.count else float("nan")

    def quantile(self, share: float) -> float:
        """The value that this share of the values does not exceed; NaN where there are none."""
        if not self.count:
            return float("nan")
        ends = np.cumsum(self.counts)
        rank = share * (self.count - 1)
        place = int(np.searchsorted(ends, rank, side="right"))
        value = self.edges[min(place, len(ends) - 1)] * 10.0 ** (-0.5 / PER_DECADE)  # the bin's middle
        return min(float(value), self.largest)

    @property
    def edges(self) -> FloatArray:
        """Upper ends of the bins, shape (k,)."""
        return np.asarray(LEAST * 10.0 ** (self.bins / PER_DECADE), dtype=np.float64)

    def exceedance(self) -> tuple[FloatArray, FloatArray]:
        """Values and the share of all that is larger, shapes (k,), for a figure."""
        return self.edges, 1.0 - np.cumsum(self.counts) / max(self.count, 1)

    def to_arrays(self, name: str) -> dict[str, NDArray[np.generic]]:
        """As arrays whose names begin with ``name``."""
        figures = np.array([self.total, self.largest, float(self.within)])
        return {f"{name}_bins": self.bins.astype(np.int32), f"{name}_counts": self.counts, f"{name}_figures": figures}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]], name: str) -> "Spread":
        """What ``to_arrays`` made."""
        total, largest, within = arrays[f"{name}_figures"].astype(np.float64).tolist()
        bins, counts = arrays[f"{name}_bins"].astype(np.int64), arrays[f"{name}_counts"].astype(np.int64)
        return cls(bins, counts, total, largest, int(within))


def pooled(spreads: Sequence[Spread]) -> Spread:
    """All of them in one."""
    places = np.concatenate([spread.bins for spread in spreads]) if spreads else np.empty(0, dtype=np.int64)
    counts = np.concatenate([spread.counts for spread in spreads]) if spreads else np.empty(0, dtype=np.int64)
    bins, where = np.unique(places, return_inverse=True)
    sums = np.zeros(len(bins), dtype=np.int64)
    np.add.at(sums, where, counts)
    return Spread(
        bins,
        sums,
        sum(spread.total for spread in spreads),
        max((spread.largest for spread in spreads), default=0.0),
        sum(spread.within for spread in spreads),
    )
