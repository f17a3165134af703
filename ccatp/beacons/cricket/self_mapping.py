"""Phase 2 of self-mapping: an extended Kalman filter on distances between motes, and the completed stands."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.beacons.config.models import BatchConfig, CricketConfig, PhaseTwoConfig
from ccatp.beacons.cricket.mote_plan import MotePlan
from ccatp.beacons.cricket.range_network import MappingError, coordinates_of
from ccatp.beacons.cricket.trilateration import FirstMap
from ccatp.beacons.filters.ekf_slam import EkfSlam, Update
from ccatp.core import FloatArray

_STRAIGHT = 0.01  # share of the variance of a range below which the second-order term is negligible
_CURVED = 2  # joint updates of all pairs: the second-order term depends on the errors of the map
_POOLED = 80  # largest number of pairs for which all are linearised together after each reading
_DIRECTION_M = 1e-9  # motes nearer than this have no direction between them


_OFFSET_SIGMA_M, _SCALE_SIGMA = 0.5, 0.05  # priors of a common offset and scale, where they are estimated


class MoteMapper:
    """The filter of Patil et al., eqs 18 to 38: motes are static; each distance corrects the positions of both ends.

    If the pairs determine little, the map drifts along the free directions. Each new reading of a pair is then
    linearised along a new line of sight, and the filter gains false information about these directions. With ``pools``
    the posterior is computed from the prior and the mean ranges of all pairs, linearised together (Bell and Cathey
    1993), so that repeats improve only the length of a line. Beyond ``_POOLED`` pairs this costs too much, and each
    reading is filtered on arrival.

    z = (1 + s) |p_i - p_j| + o;  H has the unit vector from j to i at i, its negative at j, distance and 1 at s and o.
    Known coordinates have no variance; the prior of the others is conditioned on them. Positions (n, d), covariance
    (n d, n d); ``known_m``: known coordinates, nan elsewhere, shape (n, d). ``batch``: selects whether offset and scale
    are estimated. Raises MappingError: shapes do not fit, or a position is missing.
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
        """Common scale of the ranges, minus one."""
        return float(self._filter.mean[-1])

    @property
    def expected_rms_m(self) -> float:
        """Root mean square of the errors that the filter expects, sqrt(tr P / n)."""
        return float(np.sqrt(np.trace(self._filter.covariance[: self._size, : self._size]) / self._count))

    def observe(self, first: int, second: int, range_m: float, sigma_m: float) -> Update:
        """Update the map with one distance. Raises MappingError: both motes are at the same point."""
        rows = _Rows(self._dimension, self._count, [(first, second)], np.array([range_m]))
        R = np.array([sigma_m**2])
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
            curvature = rows.curvature(self._filter.mean, self._filter.covariance)
            starts = iter([self._filter.mean.copy()])

            def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
                # The first linearisation is at the last estimate, which is better than the prior. Its residual is
                # extrapolated to the prior x.
                at = next(starts, x)  # noqa: B023
                residual, H = rows(at)
                return residual + H @ (at - x)[rows.columns], H

            self._filter = self._at_prior()
            R = np.diag(1.0 / weights) + curvature
            self._filter.update_iterated(rows.columns, linearise, R, self._how.linearisations)
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

    def curvature(self, x: FloatArray, P: FloatArray) -> FloatArray:
        """Covariance of the neglected second-order terms, tr(A_k P_kl A_l P_lk) / 2, shape (m, m).

        P_kl is the covariance of the vectors between the motes of pairs k and l. A = (1 - u u^T) / r is the second
        derivative of a distance, u the line of sight (Jazwinski 1970, section 9.3). Repeated readings do not reduce it.
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


def begin_phase_two(cfg: CricketConfig, plan: MotePlan, first: FirstMap) -> MoteMapper:
    """The filter after phase 1, for the first mote of each stand, or for all motes if there are no stands.

    The printed prior, the covariance of Patil et al. eq. 25, is one variance for all coordinates. It does not describe
    a map by trilateration, whose errors are correlated and centimetres to decimetres large.
    """
    motes = list(plan.heads or plan.mapped)
    at = coordinates_of(motes, plan.dimension)
    mean, covariance = (first.positions_m + first.bias_m)[motes], first.covariance_m2[np.ix_(at, at)]
    known = plan.surveyed_m[motes]
    if cfg.phase2.prior == "printed":
        mean = first.positions_m[motes]
        covariance = np.diag(np.where(np.isnan(known.ravel()), cfg.phase2.printed_variance_m2, 0.0))
    return MoteMapper(mean, covariance, cfg.phase2, known, cfg.batch)


class PhaseTwo(NamedTuple):
    """The course of phase 2."""

    positions_m: FloatArray  # before the first and after each update, shape (k + 1, n, d)
    expected_rms_m: FloatArray  # at the same times, shape (k + 1,)
    nis: FloatArray  # of each update, shape (k,)
    refused: int


def run_phase_two(
    mapper: MoteMapper, readings: Iterable[tuple[int, int, float, float]], target_rms_m: float
) -> PhaseTwo:
    """Process distances one by one until the expected error is small enough, or none are left.

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
    return PhaseTwo(np.array(places), np.array(expected), np.array(nis), refused)


def conditioned(mean: FloatArray, covariance: FloatArray, known: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A Gaussian conditioned on exact values of some coordinates: m + P_k P_kk^+ (z - m_k), P - P_k P_kk^+ P_k^T.

    ``mean``: shape (n,). ``covariance``: shape (n, n). ``known``: the values, nan if not known, shape (n,).
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


class CompletedMap(NamedTuple):
    """All motes of all stands."""

    motes: tuple[int, ...]
    positions_m: FloatArray  # shape (k, d)
    covariance_m2: FloatArray  # shape (k d, k d)


def complete_stands(plan: MotePlan, first: FirstMap, mapper: MoteMapper) -> CompletedMap:
    """Patil et al., figure 8, last box: motes 2 and 3 of each stand relative to mote 1, in the plane.

    The orientation of a stand is the rotation that fits its known shape best to the positions of phase 1. Its error is
    dtheta = sum(w_k x dp_k) / sum(|w_k|^2) over the arms w_k about their mean. It is taken as independent of the heads,
    because phase 2 has placed them far better than phase 1 had.
    """
    motes = [mote for body in plan.bodies for mote in body.motes]
    at_heads = coordinates_of(np.repeat(np.arange(len(plan.bodies)), [len(body.motes) for body in plan.bodies]), 2)
    covariance = mapper.covariance_m2[np.ix_(at_heads, at_heads)]
    places, row = [], 0
    for head_m, body in zip(mapper.positions_m, plan.bodies, strict=True):
        rotated = body.local_m @ body.motion(first.positions_m).rotation.T
        arms, middle = rotated - rotated[0], rotated - rotated.mean(axis=0)
        lever = _across(middle) / float((middle**2).sum())
        at = coordinates_of(body.motes, 2)
        variance = float(lever @ first.covariance_m2[np.ix_(at, at)] @ lever)
        places.append(head_m + arms)
        block = slice(row, row + at.size)
        covariance[block, block] += variance * np.outer(_across(arms), _across(arms))
        row += at.size
    return CompletedMap(tuple(motes), np.concatenate(places), covariance)


def _across(arms: FloatArray) -> FloatArray:
    return np.column_stack([-arms[:, 1], arms[:, 0]]).ravel()
