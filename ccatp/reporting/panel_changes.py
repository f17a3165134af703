"""Pure. How the panels lie in one survey against another: which have moved by more than both are uncertain."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from ccatp.aligning.panel_result import PanelResult
from ccatp.reporting.record import FloatArray
from ccatp.samples import PanelId

_MODES = 3
BAND = 0.99
FALSE_ALARM = 0.01  # probability that noise alone makes any panel of the mirror look moved


class PanelChange(NamedTuple):
    """One panel, the later survey less the earlier one.

    Attributes:
        panel: which.
        values: piston (m), tip, tilt (rad), shape (3,).
        sigma: standard deviations of these, shape (3,).
        chi2: of no change at all, three degrees of freedom.
        has_moved: noise alone would hardly make it so.
    """

    panel: PanelId
    values: FloatArray
    sigma: FloatArray
    chi2: float
    has_moved: bool


class Changes(NamedTuple):
    """All panels that both surveys tell of, the chi-square of no change, and the band noise alone keeps it in."""

    panels: tuple[PanelChange, ...]
    chi2: float
    dof: int
    low: float
    high: float

    @property
    def agree(self) -> bool:
        """Nothing but noise is between the surveys."""
        return self.chi2 <= self.high and not any(panel.has_moved for panel in self.panels)


def panel_changes(before: Sequence[PanelResult], after: Sequence[PanelResult]) -> Changes | None:
    """Compare two surveys of one mirror; None without a panel of both.

    The error of the puck's height shifts all pistons of a survey alike and is in no covariance here: with another puck,
    or another height, all pistons seem to have moved.
    """
    earlier = {panel.panel: panel for panel in before}
    pairs = [(earlier[panel.panel], panel) for panel in after if panel.panel in earlier]
    if not pairs:
        return None
    changes = [_change(one, other, FALSE_ALARM / len(pairs)) for one, other in pairs]
    dof = _MODES * len(changes)
    return Changes(
        tuple(changes),
        sum(change.chi2 for change in changes),
        dof,
        float(chdtri(dof, 0.5 + 0.5 * BAND)),
        float(chdtri(dof, 0.5 - 0.5 * BAND)),
    )


def _change(before: PanelResult, after: PanelResult, rare: float) -> PanelChange:
    values = after.fit.values - before.fit.values
    covariance = after.fit.covariance + before.fit.covariance
    chi2 = float(values @ np.linalg.solve(covariance, values))
    return PanelChange(after.panel, values, np.sqrt(np.diag(covariance)), chi2, float(chdtrc(_MODES, chi2)) < rare)
