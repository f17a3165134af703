"""Checks of a fix before it is used: frame and unit of the laser system, place on the surface, agreement of fixes.

The positions of the collimators may be recorded with other axes, handedness or unit than the mirror's, and the lengths
may have another unit. The lengths may then still be consistent, or give a position far away. So the first fixes are
compared with the expected position. If they differ, the check searches for a single mistake that explains it.
"""

from collections.abc import Mapping
from itertools import permutations, product
from math import dist, hypot, isfinite, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.conditions.mission import FRAME_REFUSED, LENGTHS_REFUSED
from ccatp.config.models import FOUR_STATE, Config, EtalonConfig
from ccatp.core import NO_CAUSE, Cause, DeckPose, Fix, FloatArray, PointId, Vector3
from ccatp.estimation.fixes import DeckFoot, FixRefused, deck_foot
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.multilateration import MultilaterationError, solve_fix

_CONSISTENT = 3  # this many agreeing fixes are used against any estimate
_FAR = 4.0  # multiple of the limit beyond which they are needed, if the localizer has no gate of its own


def nis_of(foot: DeckFoot, pose: DeckPose, covariance: FloatArray) -> float:
    """Normalised innovation squared of a fix, two degrees of freedom; NaN if the covariance is not finite."""
    residual = np.array((foot.x_m - pose.x_m, foot.y_m - pose.y_m))
    spread = covariance[:2, :2] + foot.covariance_m2
    if not np.isfinite(spread).all():
        return float("nan")
    return float(residual.dot(np.linalg.solve(spread, residual)))


def _digits(length_mm: float) -> str:
    return f"{length_mm:.3g}" if length_mm < 100.0 else f"{length_mm:.0f}"


AXES = "xyz"
UNITS = (("mm for m", 1e-3), ("m for mm", 1e3), ("inches for mm", 25.4), ("mm for inches", 1.0 / 25.4))
_ENOUGH = 3  # number of places, not on a line, that determine a frame
_AREA_M2 = 1e-3  # least size of their triangle: 0.2 m and 10 mm


# All 48 matrices that permute and reverse axes, each (3, 3); the first is the identity.
SIGNED_AXES: tuple[FloatArray, ...] = tuple(
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
)
_UNEXPLAINED = "no exchange of axes or units explains it; is it at base, and is this the mirror?"


class FrameCheck:
    """Compares the first fixes of a mission with the expected positions, until they determine the frame."""

    def __init__(self, cfg: EtalonConfig) -> None:
        self._limit_m = cfg.start_distance_m
        self._places: list[FloatArray] = []
        self.is_over = False

    def look(self, measured_m: Vector3, expected_m: Vector3) -> str | None:
        """``None`` if a fix is right; else the mistake that explains it, or empty. Positions in the world frame."""
        if self.is_over:
            return None
        if not dist(measured_m, expected_m) <= self._limit_m:
            return explain(measured_m, expected_m, self._limit_m)
        self._places.append(np.array(measured_m))
        self.is_over = len(self._places) >= _ENOUGH and _spans_a_plane(self._places)
        return None


def _spans_a_plane(places: list[FloatArray]) -> bool:
    spread = np.array(places) - np.mean(places, axis=0)
    singular = np.linalg.svd(spread, compute_uv=False)
    return bool(singular[0] * singular[1] > _AREA_M2)


def explain(measured_m: Vector3, expected_m: Vector3, limit_m: float) -> str:
    """The mistake in axes or unit that changes the expected position into the measured one, or empty."""
    measured, expected = np.array(measured_m), np.array(expected_m)
    for name, factor in UNITS:
        if np.linalg.norm(factor * measured - expected) <= limit_m:
            return f"the unit is wrong: {name}"
    errors = [float(np.linalg.norm(matrix.T @ measured - expected)) for matrix in SIGNED_AXES]
    best = int(np.argmin(errors))
    if best and errors[best] <= limit_m:
        return f"the axes are wrong: what should be (x, y, z) is {_name(SIGNED_AXES[best])}"
    return ""


def explain_lengths(
    cfg: EtalonConfig, expected_m: Vector3, lengths_m: Mapping[int, float], collimators_m: Mapping[int, FloatArray]
) -> str:
    """The mistake in axes or unit without which the lengths give the expected position (world frame), or empty."""
    for name, factor in UNITS:
        scaled = {channel: factor * length for channel, length in lengths_m.items()}
        if _fits(cfg, expected_m, scaled, collimators_m):
            return f"the lengths' unit is wrong: {name}"
        places = {channel: factor * place for channel, place in collimators_m.items()}
        if _fits(cfg, expected_m, lengths_m, places):
            return f"the collimators' unit is wrong: {name}"
    for matrix in SIGNED_AXES[1:]:
        turned = {channel: matrix.T @ place for channel, place in collimators_m.items()}
        if _fits(cfg, expected_m, lengths_m, turned):
            return f"the collimators' axes are wrong: what should be (x, y, z) is {_name(matrix)}"
    return ""


def _fits(
    cfg: EtalonConfig, expected_m: Vector3, lengths_m: Mapping[int, float], collimators_m: Mapping[int, FloatArray]
) -> bool:
    try:
        fix: Fix = solve_fix(cfg, 0.0, expected_m, lengths_m, collimators_m)
    except (MultilaterationError, ValueError):
        return False
    return dist(fix.position_m, expected_m) <= cfg.start_distance_m


def _name(matrix: FloatArray) -> str:
    rows = [int(np.argmax(np.abs(row))) for row in matrix]
    signs = [float(row[k]) for row, k in zip(matrix, rows, strict=True)]
    return "(" + ", ".join(f"{'-' if sign < 0.0 else ''}{AXES[k]}" for sign, k in zip(signs, rows, strict=True)) + ")"


class FixFinding(NamedTuple):
    """Result of a check; both texts are empty for a good fix.

    ``doubt``: why to measure again instead of using the fix; ``refusal``: why this mission must not use this laser
    system.
    """

    doubt: str = ""
    refusal: Cause = NO_CAUSE


class FixGate:
    """Checks every fix of a mission before the localizer gets it.

    A fix off the surface is never used. A fix that contradicts the estimate is used when another one of the same
    standstill agrees with it; far from the estimate, two others must agree. A localizer with its own gate does this
    last count itself.
    """

    def __init__(self, mirror: Mirror, cfg: Config) -> None:
        self._gate_nis = None if cfg.run.filter in FOUR_STATE else cfg.localizer.full_state.fix_gate_nis
        self._mirror, self._cfg, self._puck_height_m = mirror, cfg.etalon, cfg.robot.puck_height_m
        self._frame = FrameCheck(cfg.etalon)
        self._collimators_m = dict(zip(mirror.channels, np.asarray(mirror.collimators_m), strict=True))
        self._is_first = True
        self._seen: list[Vector3] = []

    def begin(self) -> None:
        """Begin a new standstill: drop the fixes of the last one."""
        self._seen.clear()

    def review(
        self, fix: Fix, expected_m: Vector3, pose: DeckPose, covariance: FloatArray, *, is_lost: bool = False
    ) -> FixFinding:
        """Check a fix against the expected puck (world frame) and against the pose with its covariance, (3, 3)."""
        is_first, self._is_first = self._is_first, False
        why = None if is_lost else self._frame.look(fix.position_m, expected_m)
        if why is not None and (is_first or why):
            where = "its base" if is_first else "the place it drove to"
            distance_m = dist(fix.position_m, expected_m)
            return FixFinding(refusal=FRAME_REFUSED.cause(distance_m=distance_m, place=where, why=why or _UNEXPLAINED))
        return FixFinding(doubt=self._doubt(fix, pose, covariance))

    def _doubt(self, fix: Fix, pose: DeckPose, covariance: FloatArray) -> str:
        cfg = self._cfg
        try:
            foot = deck_foot(self._mirror, fix, self._puck_height_m)
        except FixRefused as refusal:
            return str(refusal)
        if not abs(foot.deviation_m) <= cfg.max_surface_residual_m:
            limit_mm = 1e3 * cfg.max_surface_residual_m
            return f"the puck is {1e3 * foot.deviation_m:.1f} mm off the surface, at most {limit_mm:g} mm are possible"
        agreeing = 1 + sum(dist(fix.position_m, other) <= cfg.repeat_m for other in self._seen)
        self._seen.append(fix.position_m)
        nis = nis_of(foot, pose, covariance)
        # A frozen localizer has no estimate: the NIS is not finite.
        if not isfinite(nis) or nis <= cfg.doubt_nis:
            return ""
        if self._gate_nis is not None and nis > self._gate_nis:
            return ""
        beyond = self._gate_nis is None and nis > _FAR * cfg.doubt_nis
        if agreeing >= (_CONSISTENT if beyond else 2):
            return ""
        # In this direction the normalized innovation squared is proportional to the square of the distance.
        distance_mm = 1e3 * hypot(foot.x_m - pose.x_m, foot.y_m - pose.y_m)
        expected_mm = distance_mm * sqrt(cfg.doubt_nis / nis)
        return f"it is {_digits(distance_mm)} mm from the estimate, expected at most {_digits(expected_mm)} mm"

    def refusal_of(self, lengths_m: Mapping[int, float], expected_m: Vector3) -> Cause:
        """Why the laser system is refused when lengths gave no position; empty after the first fix."""
        if not self._is_first:
            return NO_CAUSE
        why = explain_lengths(self._cfg, expected_m, lengths_m, self._collimators_m)
        return LENGTHS_REFUSED.cause(why=why) if why else NO_CAUSE


# Guard band (ISO 14253-1): the tolerance is reduced by the uncertainty of the fix. It is limited, so that an imprecise
# laser system does not make the robot approach a point again and again.
_GUARD_SIGMAS = 3.0
_MOST_GUARD = 0.1  # of the tolerance


class ApproachCounter:
    """Decides whether to correct the position after a fix further than ``tolerance_m`` from its point.

    After ``limit`` approaches the point is measured where the robot stands.
    """

    def __init__(self, tolerance_m: float, limit: int) -> None:
        self._tolerance_m, self._limit = tolerance_m, limit
        self._point: PointId | None = None
        self.count = 0

    def is_too_far(self, point: PointId, error_m: float, sigma_m: float) -> bool:
        """Whether to approach a point again; call once per fix. ``sigma_m``: position, in its worst direction."""
        self.count = self.count + 1 if point == self._point else 1
        self._point = point
        guard_m = min(_GUARD_SIGMAS * sigma_m, _MOST_GUARD * self._tolerance_m)
        return error_m > self._tolerance_m - guard_m and self.count < self._limit
