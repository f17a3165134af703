"""Pure. What is not known of a heading stays unknown: the covariance follows the map when the map is corrected."""

import numpy as np
from scipy.linalg.blas import daxpy, dger

from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import EkfSlam
from ccatp.radio.beacon_map import is_place

HEADING = 2


class Transport:
    """After a correction, P <- M P M^T with M = I + d e^T, e the heading and d = J (new - old) of every place.

    Nobody tells the heading of the whole map: a turn of everything about any point changes no reading. In the state it
    is the direction (J p of each place p, 1 of the heading), J a quarter turn; derivatives are taken at the estimate,
    so it changes with each correction, and a filter that leaves P as it was takes that change for knowledge. A
    covariance of errors that turn with the heading does not have to change (the invariant EKF: Barrau and Bonnabel
    2015; Zhang et al. 2017); this is that covariance, said of errors of x and y.

    Args:
        engine: the state: the pose first, then blocks.
    """

    def __init__(self, engine: EkfSlam) -> None:
        self._engine = engine
        self._seen: FloatArray | None = None
        self._partner = np.empty(0, dtype=np.intp)
        self._sign = np.empty(0)

    def follow(self, before: FloatArray) -> None:
        """The state was corrected.

        Args:
            before: its mean before that, shape (n,) or, without what joined since, less; work space afterwards. Where
                something left the state since, nothing is done.
        """
        engine = self._engine
        P = engine.covariance
        if P is not self._seen:
            self._look(P)
        if before.size > engine.size:
            return
        if before.size < engine.size:
            before = np.concatenate((before, engine.mean[before.size :]))
        daxpy(engine.mean, before, a=-1.0)
        d = before.take(self._partner)
        d *= self._sign
        more = P[HEADING] + d
        less = P[HEADING] - d
        half = 0.5 * P.item(HEADING, HEADING)  # w = P e + d e^T P e / 2
        daxpy(d, more, a=half)
        daxpy(d, less, a=half)
        # d w^T + w d^T as a difference of squares: P stays symmetric exactly
        dger(0.5, more, more, a=P.T, overwrite_a=1)
        dger(-0.5, less, less, a=P.T, overwrite_a=1)

    def _look(self, P: FloatArray) -> None:
        """Which states are x and y of a place: each with its partner and the sign of the quarter turn."""
        engine = self._engine
        self._seen = P
        x = np.array([0, *(engine.block(block).start for block in engine.blocks if is_place(block))])
        self._partner, self._sign = np.zeros(engine.size, dtype=np.intp), np.zeros(engine.size)
        self._partner[x], self._sign[x] = x + 1, 1.0  # of the old less the new
        self._partner[x + 1], self._sign[x + 1] = x, -1.0
