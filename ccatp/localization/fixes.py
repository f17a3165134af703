"""Pure. What a fix of the puck says about the robot: its position in a panel frame and how well it is known."""

from math import isfinite
from typing import NamedTuple

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.mirror.errors import MirrorError
from ccatp.mirror.mirror import Mirror
from ccatp.samples import DeckPose, Fix, PanelId

_WORLD_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class FixRefused(ValueError):
    """A fix cannot be used; the pose is unchanged. The message carries the numbers."""


class FixGated(FixRefused):
    """A fix contradicts the estimate; measured again it may prove to be right."""


class DeckFoot(NamedTuple):
    """Where the robot's origin stood when a fix was taken.

    Attributes:
        x_m, y_m: deck frame.
        covariance_m2: of the two, shape (2, 2).
        deviation_m: height of the surface there above the ideal one.
    """

    x_m: float
    y_m: float
    covariance_m2: FloatArray
    deviation_m: float


class Foot(NamedTuple):
    """Where the robot's origin stood when a fix was taken.

    Attributes:
        x_m, y_m: in the panel frame.
        variance_m2: mean variance of the two.
        deviation_m: height of the surface there above the ideal one.
    """

    x_m: float
    y_m: float
    variance_m2: float
    deviation_m: float


def check_fix(fix: Fix, oldest_s: float, newest_s: float) -> None:
    """Refuse a fix that is not finite or of a time for which the robot's path is not known.

    Raises:
        FixRefused: with the numbers.
    """
    if not all(isfinite(v) for v in (fix.t_s, *fix.position_m, *fix.covariance_m2)):
        raise FixRefused(f"fix is not finite: {fix.position_m} m at {fix.t_s} s")
    if not oldest_s <= fix.t_s <= newest_s:
        raise FixRefused(f"fix of {fix.t_s:.3f} s is outside the known path, {oldest_s:.3f} s to {newest_s:.3f} s")


def foot_of_fix(mirror: Mirror, fix: Fix, puck_height_m: float, panel: PanelId) -> Foot:
    """Foot of the puck on the surface, in the frame of ``panel``.

    The puck stands ``puck_height_m`` above the robot's origin along the surface normal. Of the fix's covariance only
    the part along the surface counts: half its trace without the normal's share.

    Raises:
        FixRefused: the position is far from the mirror, or its covariance has no positive part along the surface.
    """
    try:
        x, y, deviation = mirror.foot_of_puck(fix.position_m, puck_height_m)
    except MirrorError as error:
        raise FixRefused(f"fix at {fix.position_m} m has no foot on the mirror: {error}") from error
    normal = np.array(mirror.rotate_world_from_deck(mirror.surface.normal(x, y)))
    covariance = np.array(fix.covariance_m2, dtype=np.float64).reshape(3, 3)
    variance = 0.5 * float(np.trace(covariance) - normal @ covariance @ normal)
    if not variance > 0.0:
        raise FixRefused(f"fix has the variance {variance:.3g} m^2 along the surface")
    foot = mirror.panel_pose(panel, DeckPose(x, y, 0.0))  # the heading plays no part
    return Foot(foot.x_m, foot.y_m, variance, deviation)


def deck_foot(mirror: Mirror, fix: Fix, puck_height_m: float) -> DeckFoot:
    """Foot of the puck on the surface, deck frame, with its whole covariance along the surface.

    An error along the normal leaves the foot where it is, so the fix's covariance is projected along the normal on the
    deck plane: ``J = [[1, 0, -nx/nz], [0, 1, -ny/nz]]``, ``J R^T C R J^T``.

    Raises:
        FixRefused: the position is far from the mirror, or its covariance has no positive part along the surface.
    """
    try:
        x, y, deviation = mirror.foot_of_puck(fix.position_m, puck_height_m)
    except MirrorError as error:
        raise FixRefused(f"fix at {fix.position_m} m has no foot on the mirror: {error}") from error
    fx, fy = mirror.surface.gradient(x, y)
    # The normal is along (-fx, -fy, 1).
    J = np.array([[1.0, 0.0, fx], [0.0, 1.0, fy]])
    rotation = np.array([mirror.rotate_deck_from_world(axis) for axis in _WORLD_AXES]).T
    onto = J.dot(rotation)
    covariance: FloatArray = onto.dot(np.array(fix.covariance_m2, dtype=np.float64).reshape(3, 3)).dot(onto.T)
    if not (covariance[0, 0] > 0.0 and np.linalg.det(covariance) > 0.0):
        raise FixRefused(f"fix has the covariance {covariance.ravel().tolist()} m^2 along the surface")
    return DeckFoot(x, y, covariance, deviation)
