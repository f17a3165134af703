"""A Gaussian conditioned on measurements: fast where the numbers allow it, by a square root where they do not."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy import vdot
from scipy.linalg.lapack import dpotrf, dtrtrs

from ccatp.core import FloatArray
from ccatp.filters.base import HUGE, FilterDiverged
from ccatp.filters.block_kernel import condition
from ccatp.filters.square_root import condition_by_rows, noise_root

STRONGEST = 1e6
"""Largest variance of a row over its noise of which the prior is simply subtracted: four digits of sixteen."""
LEAST_PIVOT = 1e-3
"""Least part of a row's variance that the rows before it may leave: below, what it says is a difference that has lost
digits."""


class Posterior(NamedTuple):
    """What conditioning gives: change of the mean (n,), covariance (n, n), normalised innovation squared."""

    change: FloatArray
    covariance: FloatArray
    nis: float


class _Work:
    """Arrays of one number of rows m: H P with the residual (n + 1, m), S (m, m), and views for LAPACK's order."""

    def __init__(self, m: int, n: int) -> None:
        self.block, self.S = np.empty((n + 1, m)), np.empty((m, m))
        self.cross, self.residual = self.block[:n], self.block[n]
        self.columns, self.factor = self.block.T, self.S.T
        self.diagonal = self.S.ravel()[:: m + 1]


class Conditioner:
    """Conditions a Gaussian of n states on m rows, z = H x + noise (thesis eqs 2.8 to 2.10).

    With S = H P H^T + R = C C^T, V = P H^T C^-T and y = C^-1 nu the mean changes by V y, P - V V^T is the covariance,
    and y^T y the normalised innovation squared. V V^T is symmetric to the last bit. The subtraction errs by 1e-16 of
    the *prior*, which leaves a posterior positive as long as it is not much smaller: beyond ``STRONGEST``, and where
    rows nearly repeat each other (``LEAST_PIVOT``; always for more rows than states), ``condition_by_rows`` computes
    the same from a square root, without a difference of covariances.

    Args:
        n: number of states.
    """

    def __init__(self, n: int) -> None:
        self._n = n
        self._work: dict[int, _Work] = {}

    def on_rows(self, P: FloatArray, nu: FloatArray, H: FloatArray, R: FloatArray) -> Posterior:
        """Condition N(., P) on m rows.

        Args:
            P: covariance, shape (n, n), symmetric.
            nu: residual, shape (m,), m >= 1.
            H: measurement matrix, shape (m, n).
            R: variances, shape (m,), or covariance, shape (m, m), of the noise.

        Raises:
            FilterDiverged: the posterior is not finite, P is not positive semidefinite or R is not positive definite.
        """
        done = condition(P, nu, H, R)
        if done is not None:
            return Posterior(*done)
        m = nu.size
        # vdot, because it does not warn where it overflows: what passes cannot overflow in the products below.
        if not vdot(H, H) < HUGE:
            raise FilterDiverged(f"update is not finite: measurement matrix {H.tolist()}")
        found = None
        if m == 1:
            found = _on_one(P, nu, H[0], R.item())
        elif m <= self._n:
            found = self._on_some(P, nu, H, R)
        if found is None:
            if not vdot(nu, nu) < HUGE:
                raise _not_finite(nu, R)
            found = _finite(Posterior(*condition_by_rows(P, nu, H, R)), nu, R)
        least = min(found.covariance.diagonal().tolist())
        if least < 0.0:
            raise FilterDiverged(f"covariance is not positive semidefinite: least variance {least:.3g}")
        return found

    def on_moments(self, P: FloatArray, nu: FloatArray, cross: FloatArray, S: FloatArray) -> Posterior:
        """Condition on a measurement known by its moments: cross = cov(x, z), shape (n, m), and S = cov(z), (m, m).

        Raises:
            FilterDiverged: the posterior is not finite or S is not positive definite.
        """
        w = self._arrays(nu.size)
        w.cross[:] = cross
        w.S[:] = S
        if dpotrf(w.factor, 1, 0, 1)[1] != 0:
            raise FilterDiverged("update is not finite, or the covariance of the measurement is not positive definite")
        return _subtracted(P, nu, w, S)

    def _arrays(self, m: int) -> _Work:
        found = self._work.get(m)
        if found is None:
            found = self._work[m] = _Work(m, self._n)
        return found

    def _on_some(self, P: FloatArray, nu: FloatArray, H: FloatArray, R: FloatArray) -> Posterior | None:
        """All rows at once; None where that would lose digits."""
        w = self._arrays(nu.size)
        P.dot(H.T, out=w.cross)
        H.dot(w.cross, out=w.S)
        if R.ndim == 1:
            np.add(w.diagonal, R, out=w.diagonal)
            noise = R.tolist()
        else:
            np.add(w.S, R, out=w.S)
            noise = (noise_root(R).diagonal() ** 2).tolist()
        if not min(noise) > 0.0:
            raise FilterDiverged(f"update is not finite: least variance {min(noise):.3g} of {nu.size} rows")
        total = w.diagonal.tolist()
        if dpotrf(w.factor, 1, 0, 1)[1] != 0:
            return None
        for s, r, pivot in zip(total, noise, w.diagonal.tolist(), strict=True):
            if not (s < STRONGEST * r and pivot * pivot > LEAST_PIVOT * s):
                return None
        return _subtracted(P, nu, w, R)


def _on_one(P: FloatArray, nu: FloatArray, h: FloatArray, r: float) -> Posterior | None:
    """One row; None where it is too strong."""
    cross = P.dot(h)
    s = float(h.dot(cross)) + r
    e = nu.item()
    if not (r > 0.0 and r <= s < STRONGEST * r and e * e < HUGE):
        return None
    v = (cross * (1.0 / sqrt(s)))[:, None]
    return Posterior(cross * (e / s), P - v.dot(v.T), e * e / s)


def _subtracted(P: FloatArray, nu: FloatArray, w: _Work, R: FloatArray) -> Posterior:
    """The posterior from the work arrays: the cross-covariance in place, S factored."""
    w.residual[:] = nu
    dtrtrs(w.factor, w.columns, lower=1, overwrite_b=1)
    V, y = w.cross, w.residual
    nis = float(vdot(y, y))
    if not nis < HUGE:
        raise _not_finite(nu, R)
    return Posterior(V.dot(y), P - V.dot(V.T), nis)


def _finite(found: Posterior, nu: FloatArray, R: FloatArray) -> Posterior:
    x, P = found.change, found.covariance
    if not vdot(x, x) + vdot(P, P) + found.nis < HUGE:
        raise _not_finite(nu, R)
    return found


def _not_finite(nu: FloatArray, R: FloatArray) -> FilterDiverged:
    least = float((R if R.ndim == 1 else R.diagonal()).min())
    return FilterDiverged(f"update is not finite: residuals {nu.tolist()}, least variance {least:.3g}")
