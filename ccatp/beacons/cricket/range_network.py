"""Motes and the checked ranges between them; ranges from delays of ultrasonic pulses; the mean range of each pair."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from ccatp.beacons.config.models import CricketConfig
from ccatp.beacons.config.onboard_models import COLDEST_C, HOTTEST_C
from ccatp.beacons.rigid_motion import RigidMotion, best_motion
from ccatp.core import FloatArray
from ccatp.errors import CcatpError, ExitStatus, listed

ABSOLUTE_ZERO_C = -273.15


class TdoaError(ValueError):
    """An impossible delay or temperature."""


class MoteRange(NamedTuple):
    """One distance between two motes."""

    first: str
    second: str
    range_m: float
    sigma_m: float


IndexArray = NDArray[np.intp]


class MappingError(CcatpError):
    """Ranges that give no map."""

    exit_status = ExitStatus.USAGE


@dataclass(frozen=True, slots=True)
class RigidBody:
    """Motes whose positions relative to each other are known: motes of a stand, tags on a trolley."""

    name: str
    motes: tuple[int, ...]
    local_m: FloatArray  # positions in the frame of the body, shape (k, d)

    def motion(self, positions_m: FloatArray) -> RigidMotion:
        """The motion that fits the body best to the positions of its motes; positions of all motes, shape (n, d)."""
        return best_motion(self.local_m, positions_m[list(self.motes)])

    def placed(self, positions_m: FloatArray) -> FloatArray:
        """Positions of its motes after that motion, with the known shape, shape (k, d)."""
        return self.motion(positions_m).moved(self.local_m)


@dataclass(frozen=True, slots=True)
class RangeNetwork:
    """A graph of ranges. ``first``, ``second``: indices of the two motes of each range, shape (m,)."""

    names: tuple[str, ...]
    dimension: int  # d, 2 or 3
    first: IndexArray
    second: IndexArray
    ranges_m: FloatArray  # measured, shape (m,)
    sigmas_m: FloatArray  # standard deviations, shape (m,)
    bodies: tuple[RigidBody, ...]
    known_m: FloatArray  # coordinates that are known, nan elsewhere, shape (n, d); none for motes of bodies

    @property
    def count(self) -> int:
        """Number n of motes."""
        return len(self.names)

    @property
    def pairs(self) -> IndexArray:
        """The two motes of each range, the smaller index first, shape (m, 2)."""
        return np.sort(np.column_stack([self.first, self.second]), axis=1)

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
    *,
    is_whole: bool = True,
) -> RangeNetwork:
    """The checked graph of some ranges.

    ``names``: the motes in order; ``None``: those of the readings, in order of appearance. ``known_m``: known
    coordinates, nan elsewhere, shape (n, d). ``is_whole``: require a connected graph. Raises MappingError: a range
    names a mote that is not in ``names``, is from a mote to itself, negative or not finite, or has no positive sigma;
    there are no ranges or fewer than two motes; or the graph is not connected as required.
    """
    rows = list(readings)
    if names is None:
        names = tuple(dict.fromkeys(name for row in rows for name in (row.first, row.second)))
    index = {name: place for place, name in enumerate(names)}
    for row in rows:
        _check_row(row, index)
    if len(names) < 2 or not rows:
        raise MappingError(f"{len(rows)} ranges among {len(names)} motes; a map needs two motes and a range at least")
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
    if is_whole:
        _check_connected(network)
    return network


def graph_pairs(network: RangeNetwork) -> IndexArray:
    """Sorted unique pairs whose distance is measured, or known within a body, shape (e, 2)."""
    bodies = [every_pair(np.array(body.motes, dtype=np.intp)) for body in network.bodies]
    return np.unique(np.sort(np.concatenate([network.pairs, *bodies]), axis=1), axis=0)


def every_pair(motes: IndexArray) -> IndexArray:
    """All pairs of some motes (k,), each once, shape (k (k - 1) / 2, 2)."""
    a, b = np.triu_indices(len(motes), 1)
    return np.column_stack([motes[a], motes[b]])


def coordinates_of(motes: Sequence[int] | IndexArray, dimension: int) -> IndexArray:
    """Indices of the coordinates of some motes (k,) in the vector of all coordinates, shape (k d,)."""
    return (np.asarray(motes, dtype=np.intp)[:, None] * dimension + np.arange(dimension)).ravel()


def adjacency(count: int, pairs: IndexArray, weights: FloatArray | None = None) -> csr_array:
    """The graph of some pairs (e, 2) with weights (e,) or ones, one direction each, shape (n, n)."""
    values = np.ones(len(pairs)) if weights is None else weights
    return coo_array((values, (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()


def components(count: int, pairs: IndexArray) -> IndexArray:
    """The number of the connected component of each vertex, shape (n,)."""
    return np.asarray(connected_components(adjacency(count, pairs), directed=False)[1], dtype=np.intp)


def sides(count: int, pairs: IndexArray, without: Sequence[int]) -> list[tuple[int, ...]]:
    """The connected components that remain when some vertices are removed."""
    labels = components(count, pairs[~np.isin(pairs, without).any(axis=1)])
    labels[list(without)] = -1
    return [tuple(np.flatnonzero(labels == label).tolist()) for label in np.unique(labels[labels >= 0])]


def _check_row(row: MoteRange, index: dict[str, int]) -> None:
    for name in (row.first, row.second):
        if name not in index:
            raise MappingError(f"range {row.first} to {row.second}: no mote {name!r}; there are {listed(list(index))}")
    if row.first == row.second:
        raise MappingError(f"range {row.first} to {row.second}: from a mote to itself; leave it out")
    if not 0.0 <= row.range_m < float("inf"):
        raise MappingError(f"range {row.first} to {row.second}: {row.range_m:g} m is no distance")
    if not 0.0 < row.sigma_m < float("inf"):
        raise MappingError(f"range {row.first} to {row.second}: sigma of {row.sigma_m:g} m, must be positive")


def _check_connected(network: RangeNetwork) -> None:
    # Motes with known positions are connected without any range.
    known = np.flatnonzero(np.isfinite(network.known_m).all(axis=1))
    linked = np.concatenate([graph_pairs(network), np.column_stack([known[:-1], known[1:]])])
    labels = components(network.count, linked)
    sizes = np.bincount(labels)
    if len(sizes) == 1:
        return
    lost = [network.names[mote] for mote in np.flatnonzero(labels == sizes.argmin())]
    raise MappingError(
        f"the motes fall into {len(sizes)} parts with no range between them: {listed(lost)} on one side; "
        "measure a range across, or map the parts one by one"
    )


class PairMeans:
    """Mean range of each pair, r = sum(r_i / sigma_i^2) / sum(1 / sigma_i^2).

    ``pairs``: unique, the smaller index first, shape (e, 2). ``pair_of``: index of the pair of each range, shape (m,).
    ``ranges_m``, ``sigmas_m``: of the means, shape (e,). ``table_m``, ``sigma_table_m``: the same as symmetric tables,
    nan without a range, shape (n, n).
    """

    def __init__(self, network: RangeNetwork) -> None:
        self.pairs: IndexArray
        self.pairs, place = np.unique(network.pairs, axis=0, return_inverse=True)
        self.pair_of: IndexArray = place.ravel()
        weights = 1.0 / network.sigmas_m**2
        total = np.bincount(self.pair_of, weights)
        self.ranges_m: FloatArray = np.bincount(self.pair_of, weights * network.ranges_m) / total
        self.sigmas_m: FloatArray = 1.0 / np.sqrt(total)
        self.table_m, self.sigma_table_m = np.full((2, network.count, network.count), np.nan)
        for i, j in (self.pairs.T, self.pairs.T[::-1]):
            self.table_m[i, j], self.sigma_table_m[i, j] = self.ranges_m, self.sigmas_m


def _kelvin(temperature_c: float) -> float:
    if not COLDEST_C <= temperature_c <= HOTTEST_C:
        raise TdoaError(f"temperature of {temperature_c:g} C is outside {COLDEST_C:g} to {HOTTEST_C:g} C")
    return temperature_c - ABSOLUTE_ZERO_C


def delay_at(at_c: float, delay_s: float, temperature_c: float) -> float:
    """The delay of the same way in air of another temperature ``at_c``. Raises TdoaError: impossible temperature."""
    return delay_s * sqrt(_kelvin(temperature_c) / _kelvin(at_c))


_MEDIAN_COST = np.sqrt(np.pi / 2.0)  # standard deviation of the median over that of the mean, for normal noise


def pair_range(
    cfg: CricketConfig, names: tuple[str, str], delays_s: FloatArray | Sequence[float], temperature_c: float
) -> MoteRange:
    """The range of a pair from its readings, d = c(T) (t_2 - t_1), Patil et al. eq. 1.

    The speed of sound is that of an ideal gas, c = c_0 sqrt(T / T_0), T in kelvin; the radio message takes no time.
    sigma^2 = sigma_1^2 / n + (d sigma_T / (2 T))^2: repetition reduces the noise of a reading, but not the error of the
    thermometer, dc/c = dT / (2 T). ``delays_s``: from message to pulse, one for each reading, shape (n,), n >= 1.
    Raises TdoaError: an impossible delay or temperature.
    """
    air, ranging, count = cfg.air, cfg.ranging, len(delays_s)
    delay_s = float(np.median(delays_s) if ranging.combine == "median" else np.mean(delays_s))
    if not 0.0 <= delay_s < float("inf"):
        raise TdoaError(f"delay of {delay_s:g} s: the pulse cannot arrive before the message")
    kelvin = _kelvin(temperature_c)
    range_m = air.sound_speed_m_s * sqrt(kelvin / (air.temperature_c - ABSOLUTE_ZERO_C)) * delay_s
    sigma_m = sqrt(ranging.sigma_m**2 / count + (range_m * (ranging.thermometer_sigma_c / (2.0 * kelvin))) ** 2)
    if ranging.combine == "median" and count > 2:
        sigma_m *= float(_MEDIAN_COST)
    return MoteRange(*names, range_m, sigma_m)
