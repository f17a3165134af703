"""Pure. The end of phase 2: the other motes of each stand, from its first one and the stand's known shape."""

from typing import NamedTuple

import numpy as np

from ccatp.motes.mote_plan import MotePlan
from ccatp.motes.range_network import FloatArray
from ccatp.radio.rigid_alignment import best_motion


class WholeMap(NamedTuple):
    """All motes of all stands.

    Attributes:
        motes: their indices in the plan.
        positions_m: shape (k, d).
        covariance_m2: shape (k d, k d).
    """

    motes: tuple[int, ...]
    positions_m: FloatArray
    covariance_m2: FloatArray


def complete_stands(
    plan: MotePlan,
    first_m: FloatArray,
    first_covariance_m2: FloatArray,
    heads_m: FloatArray,
    heads_covariance_m2: FloatArray,
) -> WholeMap:
    """Patil et al., figure 8, last box: motes 2 and 3 of each stand with respect to mote 1; in the plane.

    Where a stand looks is what phase 1 found of its three motes, by the best turn of the known shape; its error is that
    of the turn, dtheta = sum(w_k x dp_k) / sum(|w_k|^2) over the arms w_k about their mean, and is taken as independent
    of the heads, which phase 2 has placed far better than phase 1 had.

    Args:
        plan: the stands.
        first_m: places of all motes after phase 1, shape (n, 2).
        first_covariance_m2: shape (2 n, 2 n).
        heads_m: places of the first motes after phase 2, shape (s, 2).
        heads_covariance_m2: shape (2 s, 2 s).
    """
    sizes = [len(network) for network in plan.networks]
    heads = np.repeat(np.arange(len(sizes)), sizes)
    at_heads = (heads[:, None] * 2 + np.arange(2)).ravel()
    covariance = heads_covariance_m2[np.ix_(at_heads, at_heads)].copy()
    places, row = [], 0
    for stand, body in enumerate(plan.bodies):
        motes = list(body.motes)
        rotation = best_motion(body.local_m, first_m[motes]).rotation
        arms = (body.local_m - body.local_m[0]) @ rotation.T
        places.append(heads_m[stand] + arms)
        middle = (body.local_m - body.local_m.mean(axis=0)) @ rotation.T
        lever = np.column_stack([-middle[:, 1], middle[:, 0]]).ravel() / float((middle**2).sum())
        at = (np.array(motes)[:, None] * 2 + np.arange(2)).ravel()
        variance = float(lever @ first_covariance_m2[np.ix_(at, at)] @ lever)
        turned = np.column_stack([-arms[:, 1], arms[:, 0]]).ravel()
        block = slice(2 * row, 2 * (row + len(motes)))
        covariance[block, block] += variance * np.outer(turned, turned)
        row += len(motes)
    return WholeMap(tuple(mote for network in plan.networks for mote in network), np.concatenate(places), covariance)
