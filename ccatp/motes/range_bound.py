"""Pure. The Cramér-Rao bound of a map: the least error that any unbiased estimator can have from some ranges."""

from collections.abc import Sequence

import numpy as np

from ccatp.motes.map_batch import BatchFit, position_covariance
from ccatp.motes.map_model import MapModel
from ccatp.motes.range_network import FloatArray
from ccatp.radio.rigid_alignment import rigid_modes


def bound_rms_m(model: MapModel, true_m: FloatArray, motes: Sequence[int], *, aligned: bool) -> float | None:
    """sqrt(tr C / n) of some motes, C = (J^T Sigma^-1 J)^-1 at the true places.

    Args:
        model: network, and what else is unknown: bodies and known coordinates lower the bound, an offset raises it.
        true_m: places of all motes, shape (n, d).
        motes: those whose error counts.
        aligned: of the error after the rigid motion of these motes that makes it least, for maps without a frame.

    Returns:
        The bound in metres; None where the ranges leave the map free to move.
    """
    state = model.state(true_m)
    count = len(model.network.ranges_m)
    fit = BatchFit(state, 0.0, np.ones(count), np.zeros(count), 0, True)
    covariance, free = position_covariance(model, fit)
    if free > _frame_freedom(model):
        return None
    return map_rms_m(covariance, state.positions_m, motes, aligned=aligned)


def map_rms_m(covariance_m2: FloatArray, positions_m: FloatArray, motes: Sequence[int], *, aligned: bool) -> float:
    """Root mean square error that a covariance of all coordinates (n d, n d) expects of some motes.

    Args:
        covariance_m2: shape (n d, n d).
        positions_m: shape (n, d).
        motes: those whose error counts.
        aligned: after the best rigid motion of these motes.
    """
    d = positions_m.shape[1]
    at = (np.array(motes, dtype=np.intp)[:, None] * d + np.arange(d)).ravel()
    part = covariance_m2[np.ix_(at, at)]
    if aligned:
        modes = rigid_modes(positions_m[list(motes)])
        part = part - modes @ (modes.T @ part)
        part = part - (part @ modes) @ modes.T
    return float(np.sqrt(max(float(np.trace(part)), 0.0) / len(motes)))


def _frame_freedom(model: MapModel) -> int:
    """Rigid motions that no known coordinate excludes, where there are none at all or enough of them."""
    d = model.network.dimension
    return d * (d + 1) // 2 if np.isnan(model.network.known_m).all() else 0
