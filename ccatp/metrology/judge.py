"""Pure. Doubts about a fix: off the surface, far from the estimate, or not repeated by the next."""

from math import dist, hypot, isfinite

import numpy as np

from ccatp.config.models import EtalonConfig
from ccatp.filters.base import FloatArray
from ccatp.localization.fixes import DeckFoot, FixRefused, deck_foot
from ccatp.mirror.mirror import Mirror
from ccatp.samples import DeckPose, Fix, Vector3

_CONSISTENT = 3  # so many fixes that agree are right against any estimate
_FAR = 4.0  # where the localizer has no gate of its own, this many times the limit asks for them


class FixJudge:
    """Judges the fixes of one standstill; ``begin`` starts the next.

    A fix off the surface is never believed. One that contradicts the estimate is believed once another of the same
    standstill agrees with it; one that contradicts it beyond the localizer's own gate once two others do. A localizer
    that has such a gate keeps that count itself.

    Args:
        mirror: the ideal surface.
        cfg: the limits.
        puck_height_m: of the puck above the robot's origin.
        gate_nis: the localizer's gate; ``None`` where it has none.
    """

    def __init__(self, mirror: Mirror, cfg: EtalonConfig, puck_height_m: float, gate_nis: float | None) -> None:
        """No fix seen."""
        self._mirror, self._cfg, self._puck_height_m, self._gate_nis = mirror, cfg, puck_height_m, gate_nis
        self._seen: list[Vector3] = []

    def begin(self) -> None:
        """The robot stands anew: what was measured before says nothing about here."""
        self._seen.clear()

    def doubt(self, fix: Fix, pose: DeckPose, covariance: FloatArray) -> str:
        """Why to measure again instead of using ``fix``, or empty.

        Args:
            fix: as measured.
            pose: the estimate for its time.
            covariance: of the estimate's (x, y, heading), shape (3, 3).
        """
        try:
            foot = deck_foot(self._mirror, fix, self._puck_height_m)
        except FixRefused as refusal:
            return str(refusal)
        if not abs(foot.deviation_m) <= self._cfg.max_surface_residual_m:
            limit_mm = 1e3 * self._cfg.max_surface_residual_m
            return f"the puck is {1e3 * foot.deviation_m:.1f} mm off the surface, at most {limit_mm:g} mm are possible"
        agreeing = 1 + sum(dist(fix.position_m, other) <= self._cfg.repeat_m for other in self._seen)
        self._seen.append(fix.position_m)
        nis = nis_of(foot, pose, covariance)
        # A localizer that is frozen has no estimate to contradict.
        if not isfinite(nis) or nis <= self._cfg.doubt_nis:
            return ""
        if self._gate_nis is not None and nis > self._gate_nis:
            return ""
        beyond = self._gate_nis is None and nis > _FAR * self._cfg.doubt_nis
        if agreeing >= (_CONSISTENT if beyond else 2):
            return ""
        return f"it is {1e3 * hypot(foot.x_m - pose.x_m, foot.y_m - pose.y_m):.1f} mm from the estimate (NIS {nis:.3g})"


def nis_of(foot: DeckFoot, pose: DeckPose, covariance: FloatArray) -> float:
    """Normalised innovation squared of a fix against an estimate, two degrees of freedom; NaN where there is none.

    Args:
        foot: of the fix.
        pose: the estimate.
        covariance: of its (x, y, heading), shape (3, 3).
    """
    residual = np.array((foot.x_m - pose.x_m, foot.y_m - pose.y_m))
    spread = covariance[:2, :2] + foot.covariance_m2
    if not np.isfinite(spread).all():
        return float("nan")
    return float(residual.dot(np.linalg.solve(spread, residual)))
