"""The linear filter of four states, in plain floats."""

from collections.abc import Callable
from typing import TypeVar, cast

import numpy as np
from numpy import ndarray, vdot

from ccatp.core import FloatArray
from ccatp.filters.base import (
    HUGE,
    FilterDiverged,
    FilterModelError,
    FilterShapeError,
    Innovation,
    Observation,
    Transition,
    check_rows,
)
from ccatp.filters.compression import Rows
from ccatp.filters.kalman import KalmanFilter
from ccatp.filters.unrolled import Four, Ten, condition, factored, product, propagate, transition, upper

STATES = 4
ORDER = (2, 0, 1, 3)
"""Of the states inside. What a row does not measure costs nothing if it stands first, and of eq. 2.1 that is mostly the
heading; what drives a state has to stand behind it, as acceleration and rate do."""
_SQUARE = (STATES, STATES)
_GRID = np.ix_(ORDER, ORDER)
_NO_STEP = (b"", b"")
_NO_ROWS: tuple[bytes, bytes, tuple[int, ...]] = (b"", b"", ())
_Answer = TypeVar("_Answer")


class FourStateFilter:
    """The Kalman filter of thesis eq. 2.13 on its four states: as ``KalmanFilter``, in a fraction of its time.

    The arrays of ``mean`` and ``covariance`` are made when they are asked for. Models are taken apart once and again
    only when their numbers change. A covariance that is only semidefinite and noise with correlated rows are left to
    ``KalmanFilter``.
    """

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        self._arrays = KalmanFilter(mean, covariance)
        self._step_key, self._rows_key = _NO_STEP, _NO_ROWS
        self._x: Four
        self._UD: Ten | None
        self._mean: FloatArray | None
        self._covariance: FloatArray | None
        self._return()

    @property
    def mean(self) -> FloatArray:
        """x, shape (4,)."""
        found = self._mean
        if found is None:
            found = self._mean = _restored(self._x)
        return found

    @property
    def covariance(self) -> FloatArray:
        """P, shape (4, 4), symmetric to the last bit."""
        found = self._covariance
        if found is None:
            found = self._covariance = _square(product(cast("Ten", self._UD)))  # where it is None the array is there
        return found

    @property
    def transition(self) -> FloatArray:
        """F of the last prediction, shape (4, 4); see ``Filter.transition``."""
        return np.frombuffer(self._F).reshape(_SQUARE)

    def reset(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Re-initialise with copies of ``mean`` (4,) and ``covariance`` (4, 4); see ``Filter.reset``."""
        self._arrays.reset(mean, covariance)
        self._return()

    def predict(self, F: FloatArray | Transition, Q: FloatArray) -> None:
        """Advance by F (4, 4) and Q (4, 4), thesis eqs 2.5 and 2.6; see ``Filter.predict``."""
        if not isinstance(F, ndarray):
            raise FilterModelError("KalmanFilter", F)
        UD, key = self._UD, (F.tobytes(), Q.tobytes())
        if key != self._step_key:
            _check_step(F, Q)
            self._step, self._step_key = transition(F[_GRID].tolist(), Q[_GRID].tolist()), key
        if UD is not None:
            found = propagate(self._x, UD, self._step)
            if found is not None:
                self._x, self._UD = found
                self._mean = self._covariance = None
                self._F = key[0]
                return
        self._by_arrays(lambda arrays: arrays.predict(F, Q))

    def update(self, z: FloatArray, H: FloatArray | Observation, R: FloatArray) -> Innovation:
        """Condition on z (m,) with H (m, 4) and R (m,) or (m, m), thesis eqs 2.7 to 2.10; see ``Filter.update``."""
        if not isinstance(H, ndarray):
            raise FilterModelError("KalmanFilter", H)
        x, UD, key = self._x, self._UD, (H.tobytes(), R.tobytes(), z.shape)
        if key != self._rows_key:
            check_rows(z, H, R, STATES)
            if R.ndim != 1 or not z.size:
                return self._by_arrays(lambda arrays: arrays.update(z, H, R))
            self._rows, self._rows_key = Rows(H, R, ORDER), key
        if UD is None:
            return self._by_arrays(lambda arrays: arrays.update(z, H, R))
        rows = self._rows
        compress = rows.compress
        if compress is None:
            readings = kept = z.tolist()
        else:
            if not vdot(z, z) < HUGE:  # the product would warn of it
                raise FilterDiverged(f"update is not finite: readings {z.tolist()}")
            readings, kept = z.dot(compress).tolist(), z.tobytes()
        after, UD, nis = condition(x, UD, readings, rows.rows)
        if not nis < HUGE:
            raise FilterDiverged(f"update is not finite: NIS {nis}, {z.size} rows, least variance {R.min():.3g}")
        self._x, self._UD = after, UD
        self._mean = self._covariance = None
        return _Seen((x, kept, key[0], nis, readings, rows))

    def _by_arrays(self, act: Callable[[KalmanFilter], _Answer]) -> _Answer:
        """What ``act`` does to a filter in arrays with this state."""
        arrays = self._arrays
        arrays.mean, arrays.covariance = self.mean, self.covariance
        answer = act(arrays)
        self._return()
        return answer

    def _return(self) -> None:
        """Take over the state of the filter in arrays."""
        arrays = self._arrays
        self._mean, self._covariance = arrays.mean, arrays.covariance
        self._F = arrays.transition.tobytes()
        a, b, c, d = arrays.mean.take(ORDER).tolist()
        self._x = (a, b, c, d)
        self._UD = factored(upper(arrays.covariance[_GRID].tolist()))


class _Seen(tuple[Four, list[float] | bytes, bytes, float, list[float], Rows]):
    """An ``Innovation`` computed as far as it is asked for.

    Holds the mean before the update, the readings z as a list or as bytes, the bytes of H, what is known of the
    normalised innovation, the readings that were used and their rows.
    """

    __slots__ = ()

    @property
    def size(self) -> int:
        """See ``Innovation``."""
        return self._z.size

    @property
    def residual(self) -> FloatArray:
        """See ``Innovation``."""
        residual: FloatArray = self._z - np.frombuffer(self[2]).reshape(-1, STATES).dot(_restored(self[0]))
        return residual

    @property
    def nis(self) -> float:
        """See ``Innovation``."""
        return self[3] + self[5].contradiction(self._z, self[4])

    @property
    def _z(self) -> FloatArray:
        z = self[1]
        return np.frombuffer(z) if isinstance(z, bytes) else np.array(z)


def _check_step(F: FloatArray, Q: FloatArray) -> None:
    for name, given in (("F", F), ("Q", Q)):
        if given.shape != _SQUARE:
            raise FilterShapeError(name, given.shape, str(_SQUARE))
    if not vdot(F, F) + vdot(Q, Q) < HUGE:
        raise FilterDiverged(f"prediction is not finite: F {F.tolist()}, Q {Q.tolist()}")


def _restored(x: Four) -> FloatArray:
    """The states in the order of the outside."""
    a, b, c, d = x
    return np.array((b, c, a, d))


def _square(P: Ten) -> FloatArray:
    cc, ca, cb, cd, aa, ab, ad, bb, bd, dd = P
    return np.array((aa, ab, ca, ad, ab, bb, cb, bd, ca, cb, cc, cd, ad, bd, cd, dd)).reshape(_SQUARE)
