"""Extended Kalman filter of a vehicle, a shared calibration and a map whose landmarks are added and removed."""

from collections.abc import Callable, Hashable, Sequence
from copy import copy
from math import inf, sqrt
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.linalg.blas import daxpy, ddot, dscal, dtrsm, dtrsv
from scipy.linalg.lapack import dposv, dpotrf

from ccatp.core import FloatArray
from ccatp.filters.base import HUGE, FilterDiverged, FilterError, FilterShapeError, checked_gaussian

Columns = npt.NDArray[np.intp]
BlockId = Hashable
Linearise = Callable[[FloatArray], tuple[FloatArray, FloatArray]]

STRONG = 1e6
"""Ratio of a row's variance to its noise beyond which P - K S K^T loses digits, and the Joseph form is used."""


class BlockError(FilterError):
    """A block is not in the state, or is in it already; has its identifier."""

    def __init__(self, block: BlockId, what: str) -> None:
        super().__init__(f"block {block!r} {what}")
        self.block = block


class Update(NamedTuple):
    """An innovation, and whether the gate accepted it; otherwise the state is unchanged.

    ``residual``: z - h(x), (m,); ``nis``: nu^T S^-1 nu; ``size``: m; ``spread``: diagonal of S with the given noise,
    (m,).
    """

    residual: FloatArray
    nis: float
    size: int
    accepted: bool
    spread: FloatArray


class RowUpdate(msgspec.Struct, frozen=True, gc=False):
    """An ``Update`` of one row as numbers, because arrays of one element cost more than the algebra."""

    residual: float
    nis: float
    accepted: bool
    spread: float


class EkfSlam:
    """EKF-SLAM: x = (vehicle | calibration | one block for each landmark), P = cov(x).

    predict:  P_rr <- F P_rr F^T + Q,  P_rb <- F P_rb (b: all that is not the vehicle)
    update:   S = H P H^T + R,  K = P H^T S^-1,  x <- x + K nu,  P <- P - K S K^T
    augment:  b = g(x, z):  P_bx = G_x P,  P_bb = G_x P G_x^T + G_z R G_z^T

    Hevrdejs and Knoll 2017, eqs 1 and 2. H is sparse and given with its columns, so an update costs one product with
    these columns and one rank-m subtraction: n^2. The next call changes or replaces ``mean`` and ``covariance``.

    Vehicle mean (v,), covariance (v, v); calibration (c,), (c, c). All methods raise ``FilterShapeError`` for a wrong
    shape, and ``FilterDiverged`` for values that are not finite or not positive (semi)definite.
    """

    def __init__(
        self,
        vehicle_mean: FloatArray,
        vehicle_covariance: FloatArray,
        calibration_mean: FloatArray | None = None,
        calibration_covariance: FloatArray | None = None,
    ) -> None:
        x, P = checked_gaussian(vehicle_mean, vehicle_covariance, np.shape(vehicle_covariance))
        self.vehicle_size = v = x.size
        row, column = np.ogrid[:v, :v]
        # Flat indices of the upper triangle of (v, v), mirrored, to make a matrix exactly symmetric.
        self._mirrored = v * np.minimum(row, column) + np.maximum(row, column)
        c = 0 if calibration_mean is None else int(np.size(calibration_mean))
        self._blocks: dict[BlockId, slice] = {}
        mean, covariance = np.zeros(v + c), np.zeros((v + c, v + c))
        mean[:v], covariance[:v, :v] = x, P
        if calibration_mean is not None and c > 0:
            given = np.zeros((c, c)) if calibration_covariance is None else np.asarray(calibration_covariance)
            mean[v:], covariance[v:, v:] = checked_gaussian(calibration_mean, given, given.shape)
        self._take(mean, covariance)

    def _take(self, mean: FloatArray, covariance: FloatArray) -> None:
        v = self.vehicle_size
        self.mean, self.covariance = mean, covariance
        self._rows, self._columns, self._vehicle = covariance[:v], covariance[:, :v], mean[:v]

    def __deepcopy__(self, memo: dict[int, object]) -> "EkfSlam":
        """An independent copy, whose views refer to its own state."""
        other = copy(self)
        other._blocks = dict(self._blocks)
        other._take(self.mean.copy(), self.covariance.copy())
        memo[id(self)] = other
        return other

    @property
    def size(self) -> int:
        """n, the number of states."""
        return self.mean.size

    @property
    def blocks(self) -> tuple[BlockId, ...]:
        """Identifiers of the landmarks, in the order of the state."""
        return tuple(self._blocks)

    def __contains__(self, block: BlockId) -> bool:
        return block in self._blocks

    def block(self, block: BlockId) -> slice:
        """Place of a landmark in the state; a removal of another one may change it. Raises ``BlockError``."""
        try:
            return self._blocks[block]
        except KeyError:
            raise BlockError(block, "is not in the state") from None

    def predict(self, vehicle_mean: FloatArray, F: FloatArray, Q: FloatArray) -> None:
        """Advance the vehicle: its new mean (v,), F = d(new)/d(old) (v, v), and Q (v, v)."""
        v = self.vehicle_size
        if vehicle_mean.shape != (v,) or F.shape != (v, v) or Q.shape != (v, v):
            for name, array, wanted in (("vehicle_mean", vehicle_mean, (v,)), ("F", F, (v, v)), ("Q", Q, (v, v))):
                if array.shape != wanted:
                    raise FilterShapeError(name, array.shape, str(wanted))
        rows = F.dot(self._rows)
        corner = rows[:, :v].dot(F.T)
        corner += Q
        flat = corner.ravel()
        if not ddot(flat, flat) + ddot(vehicle_mean, vehicle_mean) < HUGE:
            raise FilterDiverged(f"prediction is not finite: vehicle {vehicle_mean.tolist()}")
        rows[:, :v] = flat.take(self._mirrored)
        self._rows[:] = rows
        self._columns[:] = rows.T
        self._vehicle[:] = vehicle_mean

    def copy_states(self, block: BlockId, start: int) -> None:
        """Copy the states from ``start`` on, with their correlations, into a block."""
        to = self.block(block)
        source, P = slice(start, start + to.stop - to.start), self.covariance
        self.mean[to] = self.mean[source]
        P[to] = P[source]
        P[:, to] = P[:, source]

    def replace(self, columns: Columns, mean: FloatArray, covariance: FloatArray) -> None:
        """Replace the estimate of different ``columns`` (k,) by mean (k,) and covariance (k, k) from all that is known.

        All other states keep their regression on these, G = P_ox P_xx^-1, and what it leaves: x_o <- x_o + G (new -
        old) and P_oo <- P_oo + G (new P_xx - old P_xx) G^T.
        """
        P = self.covariance
        old = P[np.ix_(columns, columns)]
        scale = 1.0 / np.sqrt(old.diagonal())
        G = np.linalg.solve(scale * old * scale[:, None], scale[:, None] * P[columns]).T * scale
        G[columns] = np.eye(columns.size)
        x = self.mean + G.dot(mean - self.mean[columns])
        full = P + G.dot(covariance - old).dot(G.T)
        if not float(np.vdot(full, full) + np.vdot(x, x)) < HUGE:
            raise FilterDiverged("replaced estimate is not finite")
        self.mean[:] = x
        P[:] = 0.5 * (full + full.T)

    def relax(self, index: int, factor: float, variance: float) -> None:
        """Predict one state as a Gauss-Markov process: x <- factor x + noise; ``factor`` 0 to 1."""
        n = self.size
        flat = self.covariance.ravel()
        self.mean[index] *= factor
        dscal(factor, flat, n, index * n)  # the row
        dscal(factor, flat, n, index, n)  # the column
        flat[index * (n + 1)] += variance

    def add_square(self, factor: float, vector: FloatArray) -> None:
        """P <- P + factor vector vector^T, vector (n,); exactly symmetric."""
        # Not by BLAS, which on some processors rounds the elements at the end of a column in another way.
        square = np.multiply.outer(vector, vector)
        if factor != 1.0:
            square *= factor
        self.covariance += square

    def update_row(
        self, columns: Columns, h: FloatArray, residual: float, r: float, gate: float = inf, knee: float = inf
    ) -> RowUpdate:
        """Condition on one row: different ``columns`` (k,), derivatives ``h`` (k,), residual z - h(x), variance ``r``.

        ``gate``: largest normalised innovation squared that is used. ``knee``: the noise of an innovation beyond this
        many sigmas is increased until it has the weight of one at the knee (Huber's loss, one step of reweighting). The
        NIS is that with the increased noise.
        """
        cross = h.dot(self.covariance.take(columns, 0))
        s = given = ddot(h, cross[columns]) + r
        if not (r > 0.0 and r <= s * (1.0 + 1e-9) and s < HUGE and residual * residual < HUGE):
            raise FilterDiverged(f"update is not finite: residual {residual:.6g}, noise {r:.3g}, variance {s:.3g}")
        nis = residual * residual / s
        if nis > gate:
            return RowUpdate(residual, nis, False, given)
        if nis > knee * knee:
            s *= sqrt(nis) / knee
            r += s - given
            nis = residual * residual / s
        root = sqrt(s)
        dscal(1.0 / root, cross)
        if s < STRONG * r:
            self.add_square(-1.0, cross)
        else:
            self._joseph(columns, h[None, :], cross[:, None] / root, np.array(((r,),)))
        daxpy(cross, self.mean, cross.size, residual / root)
        return RowUpdate(residual, nis, True, given)

    def update(self, columns: Columns, H: FloatArray, residual: FloatArray, R: FloatArray, gate: float = inf) -> Update:
        """Condition on m rows: different ``columns`` (k,); H (m, k); residual (m,); R (m, m) or variances (m,)."""
        R = _checked_rows(columns, H, residual, R)
        cross, S = self._moments(columns, H, R)
        root = _root(S, residual)
        y = dtrsv(root, residual, 1, 0, 1)
        nis = float(y.dot(y))
        learned = Update(residual, nis, residual.size, nis <= gate, S.diagonal().copy())
        if not learned.accepted:
            return learned
        V = dtrsm(1.0, root, cross, 1, 1, 1)
        self.mean += V.dot(y)
        if bool((S.diagonal() < STRONG * R.diagonal()).all()):
            self.covariance -= V.dot(V.T)
        else:
            self._joseph(columns, H, dtrsm(1.0, root, V, 1, 1), R)
        return learned

    def update_iterated(
        self, columns: Columns, linearise: Linearise, R: FloatArray, iterations: int, gate: float = inf,
        start: FloatArray | None = None,
    ) -> Update:  # fmt: skip
        """Condition on m rows, linearised again at each estimate: Gauss-Newton on the posterior (Bell and Cathey 1993).

        ``linearise``: x (n,) -> (z - h(x), shape (m,); H at x, shape (m, k)). ``start``: the first x, the mean if not
        given. The gate applies at the last linearisation.
        """
        prior = self.mean.copy()
        x = prior if start is None else start
        residual, H = linearise(x)
        for _ in range(iterations - 1):
            rows = _checked_rows(columns, H, residual, R)
            cross, S = self._moments(columns, H, rows)
            nu = residual + H.dot((x - prior)[columns])
            new = prior + cross.dot(dposv(S, nu, 1)[1])
            moved = np.abs(new - x) / (np.sqrt(self.covariance.diagonal()) + 1e-12)
            x = new
            residual, H = linearise(x)
            if float(moved.max()) < 1e-3:
                break
        return self.update(columns, H, residual + H.dot((x - prior)[columns]), R, gate)

    def augment(
        self,
        block: BlockId,
        mean: FloatArray,
        columns: Columns,
        J_state: FloatArray,
        J_z: FloatArray | None = None,
        R: FloatArray | None = None,
    ) -> None:
        """Add a landmark by the inverse measurement model b = g(x, z); ``mean`` is g, shape (b,).

        ``J_state``: dg/dx over ``columns``, (b, k); ``J_z``: dg/dz, (b, m), None without a measurement (a copy of
        states); R (m, m). Raises ``BlockError`` if the landmark exists.
        """
        if block in self._blocks:
            raise BlockError(block, "is in the state already")
        n, b = self.size, mean.size
        if J_state.shape != (b, columns.size):
            raise FilterShapeError("J_state", J_state.shape, f"({b}, {columns.size})")
        across = J_state.dot(self.covariance[columns])
        own = across[:, columns].dot(J_state.T)
        if J_z is not None and R is not None:
            if J_z.shape != (b, R.shape[0]) or R.shape != (R.shape[0], R.shape[0]):
                raise FilterShapeError("J_z", J_z.shape, f"({b}, {R.shape[0]}), R {R.shape}")
            own = own + J_z.dot(R).dot(J_z.T)
        if not float(np.vdot(own, own) + np.vdot(mean, mean)) < HUGE:
            raise FilterDiverged(f"block {block!r} is not finite: mean {mean.tolist()}")
        grown, P = np.concatenate((self.mean, mean)), np.empty((n + b, n + b))
        P[:n, :n] = self.covariance
        P[n:, :n], P[:n, n:] = across, across.T
        P[n:, n:] = 0.5 * (own + own.T)
        self._blocks[block] = slice(n, n + b)
        self._take(grown, P)

    def remove(self, *blocks: BlockId) -> None:
        """Marginalise landmarks: remove their rows and columns. Raises ``BlockError``."""
        keep = np.ones(self.size, dtype=np.bool_)
        for block in blocks:
            keep[self.block(block)] = False
        before = np.concatenate(((0,), np.cumsum(keep))).tolist()
        self._take(self.mean[keep], self.covariance[np.ix_(keep, keep)])
        self._blocks = {
            name: slice(before[place.start], before[place.stop])
            for name, place in self._blocks.items()
            if name not in blocks
        }

    def _moments(self, columns: Columns, H: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
        cross = H.dot(self.covariance[columns]).T
        return cross, H.dot(cross[columns]) + R

    def _joseph(self, columns: Columns, H: FloatArray, K: FloatArray, R: FloatArray) -> None:
        """P <- (I - K H) P (I - K H)^T + K R K^T, multiplied out from the left and then from the right."""
        P = self.covariance
        half = P - K.dot(H.dot(P[columns]))
        full = half - half[:, columns].dot(H.T).dot(K.T) + K.dot(R).dot(K.T)
        P[:] = 0.5 * (full + full.T)


def columns_of(*parts: slice | Sequence[int]) -> Columns:
    """Column numbers of slices and sequences, one after the other."""
    numbers: list[int] = []
    for part in parts:
        numbers += range(part.start, part.stop) if isinstance(part, slice) else part
    return np.array(numbers, dtype=np.intp)


def _checked_rows(columns: Columns, H: FloatArray, residual: FloatArray, R: FloatArray) -> FloatArray:
    m = residual.size
    if H.shape != (m, columns.size):
        raise FilterShapeError("H", H.shape, f"({m}, {columns.size})")
    if R.shape not in ((m,), (m, m)):
        raise FilterShapeError("R", R.shape, f"({m},) or ({m}, {m})")
    return np.diag(R) if R.ndim == 1 else R


def _root(S: FloatArray, residual: FloatArray) -> FloatArray:
    if not float(np.vdot(S, S) + np.vdot(residual, residual)) < HUGE:
        raise FilterDiverged(f"update is not finite: residuals {residual.tolist()}")
    root: FloatArray
    root, info = dpotrf(S, 1, 1)
    if info:
        raise FilterDiverged("update is not finite, or H P H^T + R is not positive definite")
    return root
