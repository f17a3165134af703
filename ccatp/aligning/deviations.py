"""Pure. Deviation of each measured point from the ideal surface, along the normal where the puck really stood."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ccatp.mirror.alignment import panel_deviations
from ccatp.mirror.mirror import Mirror
from ccatp.samples import Fix, FloatArray, PanelId, PointId


class Measured(NamedTuple):
    """A point and its fix."""

    point: PointId
    fix: Fix


class Deviations(NamedTuple):
    """The measured points of one panel, in the order of their numbers.

    Attributes:
        points: which they are, length k.
        places_m: (x, y) in the panel frame of the surface point under the puck, shape (k, 2).
        deck_m: (x, y) of the same in the deck frame, shape (k, 2).
        values_m: deviation along the local normal, > 0 towards the robot, shape (k,).
        sigmas_m: standard deviation of each, shape (k,).
        lever: local normal times the panel's, shape (k,): a displacement D along the panel's normal is a deviation of
            D times this.
    """

    points: tuple[PointId, ...]
    places_m: FloatArray
    deck_m: FloatArray
    values_m: FloatArray
    sigmas_m: FloatArray
    lever: FloatArray


def deviations_of(
    mirror: Mirror, panel: PanelId, measured: Sequence[Measured], puck_height_m: float, floor_m: float
) -> Deviations:
    """Deviations of the points of a panel.

    The variance of a deviation is ``n^T C n + floor^2``: an error of the fix sideways moves along the surface.

    Args:
        mirror: the ideal mirror.
        panel: the panel.
        measured: its points, at least one.
        puck_height_m: nominal height of the puck along the normal.
        floor_m: standard deviation, point by point, of what the covariance of a fix does not know.

    Raises:
        UnknownPanelError: for a panel that does not exist.
        ConvergenceError: for a fix far from the mirror.
    """
    chosen = sorted(measured, key=lambda one: one.point)
    body = mirror.panel(panel)
    rows = panel_deviations(mirror, panel, np.array([one.fix.position_m for one in chosen]), puck_height_m)
    deck = np.array([mirror.surface.drop(body.to_deck((x, y, 0.0)), body.axes[2])[:2] for x, y, _ in rows.tolist()])
    normals = [mirror.surface.normal(x, y) for x, y in deck.tolist()]
    world = np.array([mirror.rotate_world_from_deck(normal) for normal in normals])
    covariances = np.array([one.fix.covariance_m2 for one in chosen], dtype=np.float64).reshape(-1, 3, 3)
    variances = np.einsum("ki,kij,kj->k", world, covariances, world) + floor_m**2
    return Deviations(
        points=tuple(one.point for one in chosen),
        places_m=rows[:, :2],
        deck_m=deck,
        values_m=rows[:, 2],
        sigmas_m=np.sqrt(variances),
        lever=np.array(normals) @ np.array(body.axes[2]),
    )
