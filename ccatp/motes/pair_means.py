"""Pure. One range for each pair of motes: the weighted mean of all that were measured between them."""

from collections.abc import Iterable

import numpy as np

from ccatp.motes.range_network import FloatArray, IntArray, RangeNetwork


class PairMeans:
    """Ranges by pair, r = sum(r_i / sigma_i^2) / sum(1 / sigma_i^2).

    Args:
        network: the ranges, those of a pair in either direction.

    Attributes:
        pairs: each once, the smaller index first, shape (e, 2).
        ranges_m: shape (e,).
        sigmas_m: of the means, shape (e,).
    """

    def __init__(self, network: RangeNetwork) -> None:
        pairs = np.sort(np.column_stack([network.first, network.second]), axis=1)
        self.pairs: IntArray
        self.pairs, place = np.unique(pairs, axis=0, return_inverse=True)
        weights = 1.0 / network.sigmas_m**2
        total = np.bincount(place.ravel(), weights)
        self.ranges_m: FloatArray = np.bincount(place.ravel(), weights * network.ranges_m) / total
        self.sigmas_m: FloatArray = 1.0 / np.sqrt(total)
        self._index = {(int(i), int(j)): row for row, (i, j) in enumerate(self.pairs)}
        self._partners: dict[int, list[int]] = {}
        for i, j in self.pairs.tolist():
            self._partners.setdefault(i, []).append(j)
            self._partners.setdefault(j, []).append(i)

    def between(self, first: int, second: int) -> tuple[float, float] | None:
        """Range and sigma of a pair in either order, or None."""
        row = self._index.get((min(first, second), max(first, second)))
        return None if row is None else (float(self.ranges_m[row]), float(self.sigmas_m[row]))

    def partners(self, mote: int) -> list[int]:
        """The motes that have a range to this one."""
        return self._partners.get(mote, [])

    def are_all_linked(self, motes: Iterable[int]) -> bool:
        """Whether every two of some motes have a range."""
        listed = list(motes)
        return all(self.between(a, b) is not None for k, a in enumerate(listed) for b in listed[k + 1 :])
