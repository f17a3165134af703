"""Pure. Recovered misalignment against the one that was simulated: does the stated uncertainty hold?"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.aligning.panel_result import PanelResult
from ccatp.samples import PanelId, Vector3

BAND = 0.99


class Comparison(NamedTuple):
    """Recovered minus injected, over all panels that could be fitted.

    Attributes:
        panels: how many.
        piston_rms_m, tilt_rms_rad: of the differences; tip and tilt together.
        chi2: sum of ``e^T C^-1 e`` over the panels, e the three differences and C their covariance.
        dof: three a panel.
        low, high: what chi2 stays between with 99 % probability where the stated covariances are right.
    """

    panels: int
    piston_rms_m: float
    tilt_rms_rad: float
    chi2: float
    dof: int
    low: float
    high: float

    @property
    def agrees(self) -> bool:
        """The chi-square lies in its band."""
        return self.low <= self.chi2 <= self.high


def compare(panels: Sequence[PanelResult], injected: Mapping[PanelId, Vector3]) -> Comparison | None:
    """Compare; None without a panel of which both are known.

    Args:
        panels: as fitted.
        injected: piston (m), tip and tilt (rad) as simulated.
    """
    known = [panel for panel in panels if panel.panel in injected]
    if not known:
        return None
    errors = np.array([panel.fit.values - np.array(injected[panel.panel]) for panel in known])
    chi2 = sum(float(e @ np.linalg.solve(p.fit.covariance, e)) for e, p in zip(errors, known, strict=True))
    dof = errors.size
    return Comparison(
        panels=len(known),
        piston_rms_m=float(np.sqrt(np.mean(errors[:, 0] ** 2))),
        tilt_rms_rad=float(np.sqrt(np.mean(errors[:, 1:] ** 2))),
        chi2=chi2,
        dof=dof,
        low=float(chdtri(dof, 0.5 + 0.5 * BAND)),
        high=float(chdtri(dof, 0.5 - 0.5 * BAND)),
    )
