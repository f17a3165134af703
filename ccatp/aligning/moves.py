"""Pure. Moves of the vertical adjusters that bring a panel back, and their uncertainty.

An adjuster moves its place on the panel along the panel's normal, > 0 towards the robot. Moving the adjusters at
(X_j, Y_j) by ``a_j = -sum c_i m_i(X_j, Y_j)`` adds ``-D`` to the panel, D being the displacement that was fitted in the
modes m. For the rigid modes the moves lie on a plane: they turn and shift the panel and do not bend it, and among the
moves that take the fitted plane away they are the ones of which five adjusters need no stiffness to be known. With
``modes.adjustable`` they take twist and bowl away as well.
"""

from typing import NamedTuple

import numpy as np

from ccatp.aligning.modes import FloatArray, ModeFit, Modes
from ccatp.mirror.mirror import Mirror
from ccatp.samples import PanelId


class Moves(NamedTuple):
    """Moves in the order of the adjusters' names.

    Attributes:
        values_m: moves, shape (a,).
        covariance_m2: theirs, shape (a, a); of the rank of the modes.
    """

    values_m: FloatArray
    covariance_m2: FloatArray

    @property
    def sigma_m(self) -> FloatArray:
        """Standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance_m2)))


def adjuster_places(mirror: Mirror, panel: PanelId) -> tuple[tuple[str, ...], FloatArray]:
    """Names of a panel's adjusters and their (x, y) in the panel frame, shape (a, 2), m.

    Raises:
        UnknownPanelError: for a panel that does not exist.
    """
    body = mirror.panel(panel)
    found = mirror.adjusters_on_deck(panel)
    places = [body.from_deck(mirror.surface.point(x, y))[:2] for x, y in found.values()]
    return tuple(found), np.array(places, dtype=np.float64).reshape(-1, 2)


def adjuster_moves(fit: ModeFit, modes: Modes, places_m: FloatArray) -> Moves:
    """Moves that take a fitted displacement away.

    Args:
        fit: coefficients of the modes.
        modes: the modes.
        places_m: of the adjusters, panel frame, shape (a, 2).
    """
    at = -modes(places_m)
    return Moves(at @ fit.values, at @ fit.covariance @ at.T)
