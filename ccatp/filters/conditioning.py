"""Pure. A Gaussian conditioned on measurements: fast where the numbers allow it, by a square root where they do not."""

from typing import NamedTuple

import numpy as np
from numpy import vdot
from scipy.linalg.lapack import dpotrf, dtrtrs

from ccatp.filters.base import HUGE, FilterDiverged, FilterShapeError, FloatArray
from ccatp.filters.square_root import condition_by_rows, is_semidefinite, noise_root

CORNER = 1e300
"""Last diagonal entry of the joint matrix: more than any residual that is finite when squared takes away."""
STRONGEST = 1e4
"""Largest variance of a row over its noise that the joint form takes: S then has a condition number of some 1e4, and
the mean comes out within 1e-12 of a prior sigma."""
LEAST_PIVOT = 1e-2
"""Least part of a row's variance that the rows before it may leave: below, what it says is a difference that has lost
digits."""


class Posterior(NamedTuple):
    """What conditioning gives: change of the mean (n,), covariance (n, n), normalised innovation squared."""

    change: FloatArray
    covariance: FloatArray
    nis: float


class _Work:
    """Arrays of one number of rows m: the joint matrix, column-major for LAPACK, and views into it."""

    def __init__(self, m: int, n: int) -> None:
        self.joint = joint = np.zeros((m + n + 1, m + n + 1), order="F")
        self.seen, self.cross, self.state = joint[:m, :m], joint[m:-1, :m], joint[m:-1, m:-1]
        self.residual, self.last = joint[-1, :m], joint[-1, :-1]
        self.flat = joint.ravel(order="K")
        self.diagonal = self.flat[: m * (m + n + 2) : m + n + 2]


class Conditioner:
    """Conditions a Gaussian of n states on m rows, z = H x + noise (thesis eqs 2.8 to 2.10).

    Three forms of the same posterior, the cheapest that keeps the digits:

    * *joint*: the Cholesky factor of the covariance of measurement and state, with the residual as one more row,

          [ S      .   . ]        [ C        .  . ]
          [ P H^T  P   . ]   ->   [ V        L  . ]     S = H P H^T + R = C C^T,  V = P H^T C^-T
          [ nu^T   0   c ]        [ y^T      .  . ]     y = C^-1 nu

      so x + V y is the mean, L L^T = P - V V^T the covariance, symmetric positive semidefinite by construction, and
      y^T y the normalised innovation. Its errors are those of a relative change of 1e-16 of the *prior*.
    * *remainder*: P - V V^T itself, where P is singular and has no such factor: a state that is known exactly.
    * *rows*: ``condition_by_rows``, for more rows than states, which repeat each other, and where ``STRONGEST`` or
      ``LEAST_PIVOT`` say that the joint form loses digits.

    Args:
        n: number of states.
    """

    def __init__(self, n: int) -> None:
        self._n = n
        self._work: dict[int, _Work] = {}

    def on_rows(self, P: FloatArray, nu: FloatArray, H: FloatArray, R: FloatArray) -> Posterior:
        """Condition N(., P) on m rows.

        Args:
            P: covariance, shape (n, n); only the lower triangle is trusted to the last bit.
            nu: residual, shape (m,), m >= 1.
            H: measurement matrix, shape (m, n).
            R: variances, shape (m,), or covariance, shape (m, m), of the noise.

        Raises:
            FilterShapeError: H or R does not fit.
            FilterDiverged: the posterior is not finite, P is not positive semidefinite or R is not positive definite.
        """
        m, n = nu.size, self._n
        if H.shape != (m, n):
            raise FilterShapeError("H", H.shape, f"({m}, {n})")
        if R.shape not in ((m,), (m, m)):
            raise FilterShapeError("R", R.shape, f"({m},) or ({m}, {m})")
        # vdot, because it does not warn where it overflows: what passes cannot overflow in the products below.
        if not (vdot(nu, nu) < HUGE and vdot(H, H) < HUGE):
            raise FilterDiverged(f"update is not finite: residual {nu.tolist()}, or its measurement matrix")
        return (self._joint(P, nu, H, R) if m <= n else None) or _by_rows(P, nu, H, R)

    def on_moments(self, P: FloatArray, nu: FloatArray, cross: FloatArray, S: FloatArray) -> Posterior:
        """Condition on a measurement known by its moments: cross = cov(x, z), shape (n, m), and S = cov(z), (m, m).

        Raises:
            FilterDiverged: the posterior is not finite or S is not positive definite.
        """
        w = self._arrays(nu.size)
        w.cross[:] = cross
        w.seen[:] = S
        found = _factored(w, P, nu)
        if found is None:
            found = _remainder(P, nu, cross, S)
        return _checked(found, S)

    def _arrays(self, m: int) -> _Work:
        found = self._work.get(m)
        if found is None:
            found = self._work[m] = _Work(m, self._n)
        return found

    def _joint(self, P: FloatArray, nu: FloatArray, H: FloatArray, R: FloatArray) -> Posterior | None:
        """The joint form; None where it would lose digits."""
        w = self._arrays(nu.size)
        PHt = P.dot(H.T)
        w.cross[:] = PHt
        w.seen[:] = H.dot(PHt)
        if R.ndim == 1:
            w.diagonal += R
            noise = R.tolist()
            if not min(noise) > 0.0:
                raise FilterDiverged(f"update is not finite: least variance {min(noise):.3g} of {nu.size} rows")
        else:
            noise = (noise_root(R).diagonal() ** 2).tolist()
            w.seen += R
        total = w.diagonal.tolist()
        for s, r in zip(total, noise, strict=True):
            if not s < STRONGEST * r:
                return None
        found = _factored(w, P, nu)
        if found is None:
            S = H.dot(PHt) + (np.diag(R) if R.ndim == 1 else R)
            return _checked(_remainder(P, nu, PHt, S), R) if is_semidefinite(P) else None
        for s, pivot in zip(total, w.diagonal.tolist(), strict=True):
            if pivot * pivot < LEAST_PIVOT * s:
                return None
        return found


def _factored(w: _Work, P: FloatArray, nu: FloatArray) -> Posterior | None:
    """The posterior from the joint matrix whose ``seen`` and ``cross`` are in place; None where it is not definite."""
    w.state[:] = P
    w.last[:] = 0.0
    w.residual[:] = nu
    w.flat[-1] = CORNER
    if dpotrf(w.joint, 1, 1, 1)[1] != 0:
        return None
    L, y = w.state, w.residual
    return Posterior(w.cross.dot(y), L.dot(L.T), float(vdot(y, y)))


def _by_rows(P: FloatArray, nu: FloatArray, H: FloatArray, R: FloatArray) -> Posterior:
    return _checked(Posterior(*condition_by_rows(P, nu, H, R)), R)


def _remainder(P: FloatArray, nu: FloatArray, cross: FloatArray, S: FloatArray) -> Posterior:
    C, info = dpotrf(S, lower=1, clean=1)
    if info != 0:
        raise FilterDiverged("update is not finite, or the covariance of the measurement is not positive definite")
    y = dtrtrs(C, nu, lower=1)[0]
    V = dtrtrs(C, cross.T, lower=1)[0].T
    covariance = P - V.dot(V.T)
    return Posterior(V.dot(y), 0.5 * (covariance + covariance.T), float(y.dot(y)))


def _checked(found: Posterior, R: FloatArray) -> Posterior:
    x, P = found.change, found.covariance
    if not float(vdot(x, x)) + float(vdot(P, P)) + found.nis < HUGE:
        least = float((R if R.ndim == 1 else R.diagonal()).min())
        raise FilterDiverged(f"update is not finite: NIS {found.nis}, {len(R)} rows, least variance {least:.3g}")
    return found
