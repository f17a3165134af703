"""Measurement rows taken apart for the written-out update; many of them as the few that say the same."""

import numpy as np
from numpy import vdot
from scipy.linalg.lapack import dgeqrf, dorgqr

from ccatp.core import FloatArray
from ccatp.filters.base import HUGE, FilterDiverged
from ccatp.filters.unrolled import Row

MANY = 12
"""Rows beyond which it costs less to compress them than to take one after the other."""
SPREAD = 1e3
"""Ratio of the most to the least exact row up to which rows are compressed: a reflection that mixes them costs the less
exact one as many digits, and three of sixteen may go."""


class Rows:
    """A measurement matrix H (m, n) with variances R (m,), taken apart once for every reading that comes with them.

    More than ``MANY`` rows are compressed by a QR factorisation of the weighted matrix: with
    W = R^-1/2 and W H = B T, B^T B = I, T upper triangular, the readings y = B^T W z = T x + noise of unit variance,
    one for each state measured, say as much of x as z does. What is left, W z - B y, depends on no state; its sum of
    squares belongs to the normalised innovation of all rows. For equal rows that is their weighted mean, with the sum
    of their information, and the scatter about it. Orthogonal factors are used because a product H^T R^-1 H would
    square the ratio of what the rows know well to what they know badly.

    Args:
        H: measurement matrix, shape (m, n).
        R: variances, shape (m,).
        order: of the states in ``rows``.

    Attributes:
        rows: what is taken one after the other, each with its variance.
        compress: z.dot(compress) are their readings, shape (m, len(rows)); None where they are z.

    Raises:
        FilterDiverged: H or R is not finite, or a variance is not positive.
    """

    def __init__(self, H: FloatArray, R: FloatArray, order: tuple[int, ...]) -> None:
        if not vdot(H, H) + vdot(R, R) < HUGE:
            raise FilterDiverged(f"update is not finite: variances {R.tolist()}, or the measurement matrix")
        noise = R.tolist()
        if not min(noise) > 0.0:
            raise FilterDiverged(f"update is not finite: least variance {min(noise):.3g} of {R.size} rows")
        is_measured: list[bool] = np.any(H, axis=0).tolist()
        measured = [state for state in order if is_measured[state]]
        self._basis: FloatArray | None = None
        self.compress: FloatArray | None = None
        self.rows: list[Row] = []
        if R.size > MANY:
            self._compress(H.T.take(measured, axis=0), 1.0 / np.sqrt(R), [is_measured[state] for state in order])
        if self._basis is None:
            self.rows = [(*row, r) for row, r in zip(H.take(order, axis=1).tolist(), noise, strict=True)]

    def _compress(self, columns: FloatArray, weights: FloatArray, is_measured: list[bool]) -> None:
        columns *= weights
        strengths = np.abs(columns).max(axis=0)
        if not strengths.max() < SPREAD * strengths.min():
            return
        factors, tau = dgeqrf(columns.T, overwrite_a=1)[:2]
        for i, row in enumerate(factors[: len(tau)].tolist()):
            entries = iter([0.0] * i + row[i:])
            self.rows.append((*(next(entries) if use else 0.0 for use in is_measured), 1.0))
        self._basis = dorgqr(factors, tau, overwrite_a=1)[0]
        self._weights, self.compress = weights, self._basis * weights[:, None]

    def contradiction(self, z: FloatArray, readings: list[float]) -> float:
        """Sum of the squares, in sigmas, of the part of z (m,) that no state explains."""
        if self._basis is None:
            return 0.0
        left = z * self._weights - self._basis.dot(readings)
        return float(left.dot(left))
