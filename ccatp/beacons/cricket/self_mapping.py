"""Phase 2 of self-mapping: an extended Kalman filter over distances between motes; the plan of who maps whom."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.beacons.cricket.range_network import MappingError, RigidBody, coordinates_of
from ccatp.config.beacon_models import BatchConfig, CricketConfig, PhaseTwoConfig
from ccatp.core import FloatArray
from ccatp.filters.ekf_slam import EkfSlam, Update
from ccatp.filters.metrics import best_motion

_STRAIGHT = 0.01  # share of the variance of a range up to which its curvature does not matter
_CURVED = 2  # times that all pairs are taken together: how far the map is from straight depends on its errors
_POOLED = 80  # pairs up to which all of them are linearised together after each reading
_DIRECTION_M = 1e-9  # motes nearer than this have no direction between them


_OFFSET_SIGMA_M, _SCALE_SIGMA = 0.5, 0.05  # priors of a common offset and scale, where they are estimated


class MoteMapper:
    """The filter of Patil et al., eqs 18 to 38: motes stand still, each distance corrects the places of both ends.

    Where pairs determine little, the map wanders along what they leave free, and a filter that takes each new reading
    of a pair along a new line of sight believes to have seen that too. With ``pools`` the posterior is computed from
    the prior and the mean ranges of all pairs, linearised together (Bell and Cathey 1993), so that repeats teach
    nothing but the length of a line. Beyond ``_POOLED`` pairs, that costs too much, each reading is filtered as it
    comes.

    z = (1 + s) |p_i - p_j| + o;  H has the unit vector from j to i at i, its negative at j, distance and 1 at s and o.
    What is known has neither variance nor covariance; the prior of all else is the caller's, and is conditioned on what
    is known.

    Args:
        positions_m: of the motes, shape (n, d).
        covariance_m2: shape (n d, n d).
        known_m: coordinates that are known, nan elsewhere, shape (n, d).
        batch: what it estimates of offset and scale, the filter estimates, too.

    Raises:
        MappingError: shapes that do not fit, or a place that is missing.
    """

    def __init__(
        self, positions_m: FloatArray, covariance_m2: FloatArray, how: PhaseTwoConfig,
        known_m: FloatArray | None = None, batch: BatchConfig | None = None,
    ) -> None:  # fmt: skip
        count, self._dimension = positions_m.shape
        if covariance_m2.shape != (positions_m.size, positions_m.size):
            raise MappingError(
                f"covariance of shape {covariance_m2.shape} for {count} motes in {self._dimension} dimensions"
            )
        if not np.isfinite(positions_m).all():
            raise MappingError("a mote has no place to begin with; phase 2 starts from a place for each")
        mean, covariance = positions_m.ravel(), covariance_m2
        if known_m is not None:
            mean, covariance = conditioned(mean, covariance, known_m.ravel())
        offset_sigma_m = _OFFSET_SIGMA_M if batch is not None and batch.estimates_offset else 0.0
        scale_sigma = _SCALE_SIGMA if batch is not None and batch.estimates_scale else 0.0
        self._prior = mean.copy(), covariance.copy(), np.diag((offset_sigma_m**2, scale_sigma**2))
        self._filter = self._at_prior()
        self._how = how
        self._gate = float(chdtri(1, 1.0 - how.gate_probability))
        self._count, self._size = count, positions_m.size
        self._pairs: dict[tuple[int, int], tuple[float, float]] = {}  # sum of z / sigma^2, sum of 1 / sigma^2

    @property
    def positions_m(self) -> FloatArray:
        """Places, shape (n, d)."""
        return self._filter.mean[: self._size].reshape(self._count, self._dimension).copy()

    @property
    def covariance_m2(self) -> FloatArray:
        """Covariance of the places, shape (n d, n d)."""
        return self._filter.covariance[: self._size, : self._size].copy()

    @property
    def offset_m(self) -> float:
        """Common offset of the ranges."""
        return float(self._filter.mean[-2])

    @property
    def scale(self) -> float:
        """Common scale of the ranges, less one."""
        return float(self._filter.mean[-1])

    @property
    def expected_rms_m(self) -> float:
        """Root mean square of the errors that the filter expects, sqrt(tr P / n)."""
        return float(np.sqrt(np.trace(self._filter.covariance[: self._size, : self._size]) / self._count))

    def observe(self, first: int, second: int, range_m: float, sigma_m: float) -> Update:
        """Condition the map on one distance. Raises MappingError: the motes stand in one place."""
        rows = _Rows(self._dimension, self._count, [(first, second)], np.array([range_m]))
        R = np.array([sigma_m**2])
        if self._how.linearisations == 1:
            residual, H = rows(self._filter.mean)
            learned = self._filter.update(rows.columns, H, residual, R, self._gate)
        else:
            learned = self._filter.update_iterated(rows.columns, rows, R, self._how.linearisations, self._gate)
        if not (learned.accepted and self._how.pools):
            return learned
        pair = min(first, second), max(first, second)
        total, weight = self._pairs.get(pair, (0.0, 0.0))
        self._pairs[pair] = total + range_m / R[0], weight + 1.0 / R[0]
        if len(self._pairs) <= _POOLED:
            self._pool()
        return learned

    def _pool(self) -> None:
        totals, weights = np.array(list(self._pairs.values())).T
        rows = _Rows(self._dimension, self._count, list(self._pairs), totals / weights)
        for _ in range(_CURVED):
            start = self._filter.mean.copy()
            curvature = rows.curvature(start, self._filter.covariance)
            R = np.diag(1.0 / weights) + curvature
            self._filter = self._at_prior()
            self._filter.update_iterated(rows.columns, rows.starting_at(start), R, self._how.linearisations)
            if float((curvature.diagonal() * weights).max()) < _STRAIGHT:
                break

    def _at_prior(self) -> EkfSlam:
        mean, covariance, calibration = self._prior
        return EkfSlam(mean, covariance, np.zeros(2), calibration)


class _Rows:
    def __init__(self, dimension: int, count: int, pairs: Sequence[tuple[int, int]], ranges_m: FloatArray) -> None:
        motes, places = np.unique(np.array(pairs), return_inverse=True)
        self._at = coordinates_of(motes, dimension)
        size = count * dimension
        self.columns = np.concatenate([self._at, (size, size + 1)]).astype(np.intp)
        self._ends = places.reshape(-1, 2)
        self._pairs, self._ranges_m, self._dimension = pairs, ranges_m, dimension

    def __call__(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        d = self._dimension
        ways, distances = self._ways(x)
        if float(distances.min()) < _DIRECTION_M:
            first, second = self._pairs[int(distances.argmin())]
            raise MappingError(f"motes {first} and {second} stand in one place: no direction to correct them along")
        offset_m, scale = float(x[self.columns[-2]]), 1.0 + float(x[self.columns[-1]])
        u = scale * ways / distances[:, None]
        H = np.zeros((len(ways), len(self.columns)))
        rows = np.arange(len(ways))[:, None]
        H[rows, self._ends[:, :1] * d + np.arange(d)] = u
        H[rows, self._ends[:, 1:] * d + np.arange(d)] = -u
        H[:, -2], H[:, -1] = 1.0, distances
        return self._ranges_m - scale * distances - offset_m, H

    def starting_at(self, start: FloatArray) -> Callable[[FloatArray], tuple[FloatArray, FloatArray]]:
        """The rows with their first linearisation at a better place than the prior."""
        is_first = True

        def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            nonlocal is_first
            if not is_first:
                return self(x)
            is_first = False
            residual, H = self(start)
            # As if linearised at x: what lies between is taken along the same lines of sight.
            return residual + H @ (start - x)[self.columns], H

        return linearise

    def curvature(self, x: FloatArray, P: FloatArray) -> FloatArray:
        """Covariance of what the rows leave out of second order, tr(A_k P_kl A_l P_lk) / 2, shape (m, m).

        P_kl is the covariance of the ways of two pairs; A, the second derivative of a distance, is (1 - u u^T) / r
        across the line of sight u (Jazwinski 1970, section 9.3). Measuring a pair more often does not lessen it.
        """
        d, count = self._dimension, self._at.size // self._dimension
        ways, distances = self._ways(x)
        u = ways / distances[:, None]
        A = (np.eye(d) - u[:, :, None] * u[:, None, :]) / distances[:, None, None]
        C = P[np.ix_(self._at, self._at)].reshape(count, d, count, d)
        i, j = self._ends[:, :1], self._ends[:, 1:]
        ways_ways = C[i, :, i.T] - C[i, :, j.T] - C[j, :, i.T] + C[j, :, j.T]  # of pairs k and l, shape (m, m, d, d)
        left = np.einsum("kab,klbc->klac", A, ways_ways)
        return np.asarray(0.5 * np.einsum("klac,lcd,klad->kl", left, A, ways_ways))

    def _ways(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        points = x[self._at].reshape(-1, self._dimension)
        ways = points[self._ends[:, 0]] - points[self._ends[:, 1]]
        return ways, np.sqrt((ways**2).sum(axis=1))


class PhaseTwo(NamedTuple):
    """How phase 2 went."""

    positions_m: FloatArray  # after each update, the first before any, shape (k + 1, n, d)
    expected_rms_m: FloatArray  # likewise, shape (k + 1,)
    nis: FloatArray  # of each update, shape (k,)
    refused: int
    reached: bool


def run_phase_two(
    mapper: MoteMapper, readings: Iterable[tuple[int, int, float, float]], target_rms_m: float
) -> PhaseTwo:
    """Observe one distance after the other until the expected error is small enough, or there are no more.

    ``readings``: first, second, range_m, sigma_m. ``target_rms_m``: of ``MoteMapper.expected_rms_m``.
    """
    places, expected, nis = [mapper.positions_m], [mapper.expected_rms_m], []
    refused = 0
    for reading in readings:
        if expected[-1] <= target_rms_m:
            break
        learned = mapper.observe(*reading)
        refused += not learned.accepted
        nis.append(learned.nis)
        places.append(mapper.positions_m)
        expected.append(mapper.expected_rms_m)
    return PhaseTwo(np.array(places), np.array(expected), np.array(nis), refused, expected[-1] <= target_rms_m)


def conditioned(mean: FloatArray, covariance: FloatArray, known: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A Gaussian, given some of its coordinates exactly: m + P_k P_kk^+ (z - m_k), P - P_k P_kk^+ P_k^T.

    ``mean``: shape (n,). ``covariance``: shape (n, n). ``known``: values, nan where a coordinate is not known, shape
    (n,).
    """
    at = np.flatnonzero(np.isfinite(known))
    if at.size == 0:
        return mean, covariance
    cross = covariance[:, at]
    gain = np.linalg.lstsq(cross[at], cross.T, rcond=1e-12)[0].T
    mean = mean + gain @ (known[at] - mean[at])
    covariance = covariance - gain @ cross.T
    mean[at] = known[at]
    covariance[at, :] = 0.0
    covariance[:, at] = 0.0
    return mean, 0.5 * (covariance + covariance.T)


def printed_prior(count: int, dimension: int, known: Sequence[int], variance_m2: float) -> FloatArray:
    """The covariance of Patil et al. eq. 25: one variance for all coordinates, none for those that are known.

    It is no prior of a map by trilateration: its errors are centimetres to decimetres and hang together.
    """
    variances = np.full(count * dimension, variance_m2)
    variances[list(known)] = 0.0
    return np.diag(variances)


Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class MotePlan:
    """The motes of a configuration.

    ``networks``: indices of the motes of each stand, in the order of mapping; empty where there are none. ``axes_m``:
    where A stands and the direction towards B, shape (2, d): what takes the map's frame to the field's.
    """

    names: tuple[str, ...]
    dimension: int
    anchors: tuple[int, ...]
    networks: tuple[tuple[int, ...], ...]
    bodies: tuple[RigidBody, ...]  # the stands, whose shapes are known
    axes_m: FloatArray
    phase1_pairs: Pairs  # pairs that are measured in phase 1
    phase2_pairs: Pairs  # pairs that phase 2 goes through
    surveyed_m: FloatArray  # coordinates that phase 2 takes as known, nan elsewhere, shape (n, d)

    @property
    def heads(self) -> tuple[int, ...]:
        """The first mote of each stand, which phase 2 places."""
        return tuple(network[0] for network in self.networks)

    @property
    def mapped(self) -> tuple[int, ...]:
        """The motes that the map is for: all but the anchors."""
        return tuple(mote for mote in range(len(self.names)) if mote not in self.anchors)


def network_plan(cfg: CricketConfig) -> MotePlan:
    """The plan of stands of motes (Patil et al., section 3): each stand is mapped by the one before it."""
    size = len(cfg.stand_m)
    anchors = tuple(range(len(cfg.anchors)))
    networks = tuple(
        tuple(range(len(anchors) + size * number, len(anchors) + size * (number + 1)))
        for number in range(len(cfg.networks))
    )
    names = (*cfg.anchors, *(f"{name}-{mote + 1}" for name in cfg.networks for mote in range(size)))
    places = np.array(list(cfg.anchors.values()), dtype=np.float64)
    local_m = np.array(cfg.stand_m, dtype=np.float64)
    heads = [network[0] for network in networks]
    first, second = anchors
    # A to B, both to the first network, then all of a network to all of the next.
    phase1_pairs = [(first, second), *((anchor, mote) for anchor in anchors for mote in networks[0])]
    for before, after in pairwise(networks):
        phase1_pairs += [(old, new) for old in before for new in after]
    surveyed_m = np.full((len(names), cfg.dimension), np.nan)
    if cfg.phase2.frame == "surveyed":  # place of the first head and y of the second: the zeros of Patil et al. eq. 25
        origin, along = list(cfg.networks.values())[:2]
        surveyed_m[heads[0]] = origin.place_m
        surveyed_m[heads[1], 1] = along.place_m[1]
    return MotePlan(
        names=names,
        dimension=cfg.dimension,
        anchors=anchors,
        networks=networks,
        bodies=tuple(RigidBody(name, motes, local_m) for name, motes in zip(cfg.networks, networks, strict=True)),
        axes_m=np.array([places[0], places[1] - places[0]]),
        phase1_pairs=tuple(phase1_pairs),
        phase2_pairs=tuple((heads[i], heads[j]) for i, j in head_pairs(len(heads), cfg.phase2.pairs)),
        surveyed_m=surveyed_m,
    )


def loose_plan(cfg: CricketConfig, names: tuple[str, ...]) -> MotePlan:
    """The plan of motes by themselves: every pair in reach is measured and used."""
    count, d = len(names), cfg.dimension
    pairs = tuple((i, j) for i in range(count) for j in range(i + 1, count))
    nowhere = np.full((count, d), np.nan)
    return MotePlan(names, d, (), (), (), np.zeros((2, d)), pairs, pairs, nowhere)


def head_pairs(count: int, programme: str) -> list[tuple[int, int]]:
    """Pairs of stands that measure each other in phase 2.

    ``programme``: ``zigzag``: each with the next; ``adjacent``: and with the one after it; ``all``.
    """
    if programme == "all":
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    pairs = list(pairwise(range(count)))
    if programme == "adjacent":
        pairs += [(i, i + 2) for i in range(count - 2)]
    return pairs


class CompletedMap(NamedTuple):
    """All motes of all stands."""

    motes: tuple[int, ...]
    positions_m: FloatArray  # shape (k, d)
    covariance_m2: FloatArray  # shape (k d, k d)


def complete_stands(
    plan: MotePlan, first_m: FloatArray, first_covariance_m2: FloatArray, heads_m: FloatArray,
    heads_covariance_m2: FloatArray,
) -> CompletedMap:  # fmt: skip
    """Patil et al., figure 8, last box: motes 2 and 3 of each stand with respect to mote 1; in the plane.

    Where a stand looks is what phase 1 found of its three motes, by the best turn of the known shape; its error is that
    of the turn, dtheta = sum(w_k x dp_k) / sum(|w_k|^2) over the arms w_k about their mean, and is taken as independent
    of the heads, which phase 2 has placed far better than phase 1 had.

    Args:
        first_m: places of all motes after phase 1, shape (n, 2).
        first_covariance_m2: shape (2 n, 2 n).
        heads_m: places of the first motes after phase 2, shape (s, 2).
        heads_covariance_m2: shape (2 s, 2 s).
    """
    sizes = [len(network) for network in plan.networks]
    heads = np.repeat(np.arange(len(sizes)), sizes)
    at_heads = coordinates_of(heads, 2)
    covariance = heads_covariance_m2[np.ix_(at_heads, at_heads)].copy()
    places, row = [], 0
    for stand, body in enumerate(plan.bodies):
        motes = list(body.motes)
        rotation = best_motion(body.local_m, first_m[motes]).rotation
        arms = (body.local_m - body.local_m[0]) @ rotation.T
        places.append(heads_m[stand] + arms)
        middle = (body.local_m - body.local_m.mean(axis=0)) @ rotation.T
        lever = np.column_stack([-middle[:, 1], middle[:, 0]]).ravel() / float((middle**2).sum())
        at = coordinates_of(motes, 2)
        variance = float(lever @ first_covariance_m2[np.ix_(at, at)] @ lever)
        turned = np.column_stack([-arms[:, 1], arms[:, 0]]).ravel()
        block = slice(2 * row, 2 * (row + len(motes)))
        covariance[block, block] += variance * np.outer(turned, turned)
        row += len(motes)
    motes_of_all = tuple(mote for network in plan.networks for mote in network)
    return CompletedMap(motes_of_all, np.concatenate(places), covariance)
