"""Pure. Motes and the ranges between them: what a self-mapping starts from, checked."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ccatp.errors import CcatpError, ExitStatus
from ccatp.motes.tdoa import MoteRange
from ccatp.samples import FloatArray

IntArray = NDArray[np.intp]

_SHOWN = 6  # names in a message


class MappingError(CcatpError):
    """Ranges of which no map can be made."""

    exit_status = ExitStatus.USAGE


class UnknownMote(MappingError):
    """A range names a mote that is none."""


class BadRange(MappingError):
    """A range that no two motes can have."""


class Disconnected(MappingError):
    """No chain of ranges leads from some motes to the others."""


class TooFewRanges(MappingError):
    """Fewer ranges than anything could be determined from."""


@dataclass(frozen=True, slots=True)
class RigidBody:
    """Motes whose places relative to each other are known: a network on its stand, tags on a trolley.

    Attributes:
        name: of the body.
        motes: their indices, length k.
        local_m: their places in the body's own frame, shape (k, d).
    """

    name: str
    motes: tuple[int, ...]
    local_m: FloatArray


@dataclass(frozen=True, slots=True)
class RangeNetwork:
    """A graph of ranges.

    Attributes:
        names: of the n motes.
        dimension: d, 2 or 3.
        first, second: ends of each of the m ranges, indices of motes, shape (m,).
        ranges_m: measured, shape (m,).
        sigmas_m: standard deviations, shape (m,).
        bodies: no mote is in two of them.
        known_m: coordinates that are known, nan elsewhere, shape (n, d); none for motes of bodies.
    """

    names: tuple[str, ...]
    dimension: int
    first: IntArray
    second: IntArray
    ranges_m: FloatArray
    sigmas_m: FloatArray
    bodies: tuple[RigidBody, ...]
    known_m: FloatArray

    @property
    def count(self) -> int:
        """N, the number of motes."""
        return len(self.names)

    @property
    def loose(self) -> tuple[int, ...]:
        """Motes that are in no body."""
        bound = {mote for body in self.bodies for mote in body.motes}
        return tuple(mote for mote in range(self.count) if mote not in bound)


def build_network(
    readings: Iterable[MoteRange],
    dimension: int,
    names: Sequence[str] | None = None,
    bodies: Sequence[RigidBody] = (),
    known_m: FloatArray | None = None,
) -> RangeNetwork:
    """The graph of some ranges, checked.

    Args:
        readings: the ranges; those of one pair may be repeated.
        dimension: 2 or 3.
        names: the motes in their order; those of the readings, as they come, if ``None``.
        bodies: motes that are rigidly joined.
        known_m: known coordinates, nan elsewhere, shape (n, d).

    Raises:
        UnknownMote: a range names a mote that is not among ``names``.
        BadRange: negative or not finite, without a positive sigma, or from a mote to itself.
        TooFewRanges: there is none, or there are fewer than two motes.
        Disconnected: the motes fall apart.
    """
    rows = list(readings)
    if names is None:
        names = tuple(dict.fromkeys(name for row in rows for name in (row.first, row.second)))
    index = {name: place for place, name in enumerate(names)}
    for row in rows:
        _check_row(row, index)
    if len(names) < 2 or not rows:
        raise TooFewRanges(f"{len(rows)} ranges among {len(names)} motes; a map needs two motes and a range at least")
    network = RangeNetwork(
        names=tuple(names),
        dimension=dimension,
        first=np.array([index[row.first] for row in rows], dtype=np.intp),
        second=np.array([index[row.second] for row in rows], dtype=np.intp),
        ranges_m=np.array([row.range_m for row in rows], dtype=np.float64),
        sigmas_m=np.array([row.sigma_m for row in rows], dtype=np.float64),
        bodies=tuple(bodies),
        known_m=np.full((len(names), dimension), np.nan) if known_m is None else known_m,
    )
    _check_connected(network)
    return network


def graph_pairs(network: RangeNetwork) -> IntArray:
    """Pairs whose distance is known or measured, each once and in order, shape (e, 2): ranges, and pairs of a body."""
    pairs = [np.column_stack([network.first, network.second])]
    for body in network.bodies:
        motes = np.array(body.motes, dtype=np.intp)
        upper = np.triu_indices(len(motes), 1)
        pairs.append(np.column_stack([motes[upper[0]], motes[upper[1]]]))
    together = np.sort(np.concatenate(pairs), axis=1)
    return np.unique(together, axis=0)


def components(count: int, pairs: IntArray) -> IntArray:
    """The number of the connected part that each vertex is in, shape (n,)."""
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    return np.asarray(labels, dtype=np.intp)


def list_names(names: Sequence[str]) -> str:
    """The first few of some names, and how many there are more."""
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


def _check_row(row: MoteRange, index: dict[str, int]) -> None:
    for name in (row.first, row.second):
        if name not in index:
            raise UnknownMote(
                f"range {row.first} to {row.second}: no mote {name!r}; there are {list_names(list(index))}"
            )
    if row.first == row.second:
        raise BadRange(f"range {row.first} to {row.second}: from a mote to itself; leave it out")
    if not 0.0 <= row.range_m < float("inf"):
        raise BadRange(f"range {row.first} to {row.second}: {row.range_m:g} m is no distance")
    if not 0.0 < row.sigma_m < float("inf"):
        raise BadRange(f"range {row.first} to {row.second}: sigma of {row.sigma_m:g} m, must be positive")


def _check_connected(network: RangeNetwork) -> None:
    # Motes whose places are known hang together without any range.
    known = np.flatnonzero(np.isfinite(network.known_m).all(axis=1))
    linked = np.concatenate([graph_pairs(network), np.column_stack([known[:-1], known[1:]])])
    labels = components(network.count, linked)
    sizes = np.bincount(labels)
    if len(sizes) == 1:
        return
    lost = [network.names[mote] for mote in np.flatnonzero(labels == sizes.argmin())]
    raise Disconnected(
        f"the motes fall into {len(sizes)} parts with no range between them: {list_names(lost)} on one side; "
        "measure a range across, or map the parts one by one"
    )
