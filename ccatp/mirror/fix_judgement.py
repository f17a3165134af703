"""The fix of a set of lengths with both judgements: whether it may navigate the robot, and whether it is a measurement.

Navigation refuses only a contradiction that matters for the rim; a smaller one widens the covariance. Metrology marks
the fix: ``good``, ``unchecked`` (too few lengths to contradict each other), or ``unreliable``.
"""

from collections.abc import Mapping
from math import dist, isfinite

import numpy as np

from ccatp.config.models import EtalonConfig
from ccatp.core import Fix, FloatArray, Vector3
from ccatp.mirror.length_integrity import Judgement, LengthIntegrity
from ccatp.mirror.length_watch import LengthWatch
from ccatp.mirror.multilateration import MultilaterationError, solve_fix

_MOST_M = 1e6  # no laser measures so far, and squares of such lengths are exact enough
_NEEDED = 4  # lengths of a position


def outside(
    cfg: EtalonConfig, expected_m: Vector3, lengths_m: Mapping[int, float], collimators_m: Mapping[int, FloatArray]
) -> dict[int, str]:
    """The channels whose length no accepted position of the puck explains, with the reason."""
    limit_m = cfg.max_distance_m + cfg.max_residual_m
    found = {}
    for channel, length_m in lengths_m.items():
        there_m = dist(collimators_m[channel].tolist(), expected_m)
        if not abs(length_m - there_m) <= limit_m:
            found[channel] = f"{length_m:.4g} m instead of {there_m:.4g} m"
    return found


class FixJudge:
    """Judges the fixes of one run; keeps the calibration of the network and the running tests of the channels."""

    def __init__(self, cfg: EtalonConfig, collimators_m: Mapping[int, FloatArray]) -> None:
        self._cfg, self._collimators_m = cfg, dict(collimators_m)
        self._integrity = LengthIntegrity(cfg, self._collimators_m)
        self._watch = LengthWatch(cfg, tuple(self._collimators_m))
        self._left_out: dict[int, str] = {}

    def fix(self, t_s: float, expected_m: Vector3, lengths_m: Mapping[int, float]) -> Fix:
        """The fix; raises ``MultilaterationError``: no solution, or one that navigation refuses."""
        cfg = self._cfg
        impossible = outside(cfg, expected_m, lengths_m, self._collimators_m)
        possible = {channel: length for channel, length in lengths_m.items() if channel not in impossible}
        if len(possible) < _NEEDED:
            # The error of the solution of all if they can be solved, or that too few lengths are possible.
            if all(0.0 < length < _MOST_M for length in lengths_m.values()) and all(
                abs(one) < _MOST_M for one in expected_m
            ):
                solve_fix(cfg, t_s, expected_m, lengths_m, self._collimators_m)
            raise MultilaterationError(f"impossible lengths: {_listed(impossible)}")
        found = self._integrity.judge(expected_m, possible)
        self._check(found, expected_m)
        left_out = impossible | {
            channel: f"{1e3 * self._error_m(found, channel, possible):+.4g} mm from the others"
            for channel in found.left_out
        }
        warnings = [
            f"channel {channel} contradicts the others and is not used: {why}"
            for channel, why in left_out.items()
            if channel not in self._left_out
        ]
        self._left_out = left_out
        if found.w:
            constant = self._integrity.network.constant_errors()
            warnings += [one.text for one in self._watch.add(found.w, found.chi2, found.dof, constant)]
        x, y, z = found.solution.position_m.tolist()
        covariance = found.solution.covariance_m2 + found.inconsistency_m**2 * np.eye(3)
        return Fix(
            t_s=t_s,
            position_m=(x, y, z),
            covariance_m2=tuple(covariance.ravel().tolist()),
            dop=found.solution.dop,
            channels=found.used,
            residual_rms_m=float(np.sqrt(np.mean(found.solution.residuals_m**2))),
            left_out=tuple(left_out),
            lengths_m=tuple(lengths_m[channel] for channel in (*found.used, *left_out)),
            metrology=found.metrology,
            suspects=found.suspects,
            detectable_m=_finite(found.detectable_m),
            protection_m=_finite(found.protection_m),
            warnings=tuple(warnings),
        )

    def _error_m(self, found: Judgement, channel: int, lengths_m: Mapping[int, float]) -> float:
        there_m = float(np.linalg.norm(self._collimators_m[channel] - found.solution.position_m))
        return lengths_m[channel] - there_m

    def _check(self, found: Judgement, expected_m: Vector3) -> None:
        """Limits of navigation."""
        cfg, solution = self._cfg, found.solution
        residual_m = max(float(np.max(np.abs(solution.residuals_m))), found.inconsistency_m)
        if not residual_m <= cfg.max_residual_m:
            who = ", ".join(map(str, found.suspects))
            raise MultilaterationError(
                f"the lengths contradict each other by up to {residual_m * 1e3:.4g} mm, more than "
                f"{cfg.max_residual_m * 1e3:.4g} mm (channels {who})"
            )
        if not solution.dop <= cfg.max_dop:
            raise MultilaterationError(f"dilution of precision {solution.dop:.4g} exceeds {cfg.max_dop:.4g}")
        distance_m = dist(solution.position_m.tolist(), expected_m)
        if not distance_m <= cfg.max_distance_m:
            raise MultilaterationError(
                f"position {distance_m:.4g} m from the expected one exceeds {cfg.max_distance_m:.4g} m"
            )


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None


def _listed(reasons: Mapping[int, str]) -> str:
    return ", ".join(f"channel {channel}: {why}" for channel, why in reasons.items())
