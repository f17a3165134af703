"""Pure. Whether the laser system measures in our frame and in our unit: asked of the first fixes of a mission.

The collimators' surveyed places may be written down with other axes, another hand or another unit than the mirror's;
the lengths may come in another unit. The lengths then fit all the same, or a place far off. So the first fixes are
compared with where the robot must be, and what does not fit is explained, as far as one mistake explains it.
"""

from collections.abc import Mapping
from itertools import permutations, product
from math import dist
from typing import NamedTuple

import numpy as np

from ccatp.config.models import EtalonConfig
from ccatp.filters.base import FloatArray
from ccatp.radio.multilateration import MultilaterationError
from ccatp.radio.puck_fix import solve_fix
from ccatp.samples import Fix, Vector3

AXES = "xyz"
UNITS = (("mm for m", 1e-3), ("m for mm", 1e3), ("inches for mm", 25.4), ("mm for inches", 1.0 / 25.4))
_ENOUGH = 3  # places that do not lie on a line determine a frame
_AREA_M2 = 1e-3  # of their triangle: 0.2 m and 10 mm


def signed_axes() -> tuple[FloatArray, ...]:
    """All 48 matrices that exchange and turn round axes, each (3, 3); the first is the identity."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            found.append(matrix)
    return tuple(found)


_SIGNED_AXES = signed_axes()


class FrameFault(NamedTuple):
    """What is wrong with the first fixes.

    Attributes:
        distance_m: how far the fix is from where the robot must be.
        explanation: the one mistake that would explain it; empty where none does.
    """

    distance_m: float
    explanation: str

    @property
    def is_explained(self) -> bool:
        """Whether one mistake in axes or units explains it."""
        return bool(self.explanation)

    def __str__(self) -> str:
        """The explanation, or what else may be wrong."""
        return self.explanation or "no exchange of axes or units explains it; is it at base, and is this the mirror?"


class FrameCheck:
    """Looks at the first fixes of a mission, until they have shown enough.

    Args:
        cfg: how far off a first fix may be.
    """

    def __init__(self, cfg: EtalonConfig) -> None:
        """Nothing seen."""
        self._limit_m = cfg.start_distance_m
        self._places: list[FloatArray] = []
        self.is_over = False

    def look(self, measured_m: Vector3, expected_m: Vector3) -> FrameFault | None:
        """One of the first fixes; what is wrong with it, or None.

        Args:
            measured_m, expected_m: of the puck, world frame, the robot standing still.
        """
        if self.is_over:
            return None
        distance_m = dist(measured_m, expected_m)
        if not distance_m <= self._limit_m:
            return FrameFault(distance_m, explain(measured_m, expected_m, self._limit_m))
        self._places.append(np.array(measured_m))
        self.is_over = len(self._places) >= _ENOUGH and _spans_a_plane(self._places)
        return None


def _spans_a_plane(places: list[FloatArray]) -> bool:
    spread = np.array(places) - np.mean(places, axis=0)
    singular = np.linalg.svd(spread, compute_uv=False)
    return bool(singular[0] * singular[1] > _AREA_M2)


def explain(measured_m: Vector3, expected_m: Vector3, limit_m: float) -> str:
    """The mistake in axes or unit that turns one position into the other; empty where none does."""
    measured, expected = np.array(measured_m), np.array(expected_m)
    for name, factor in UNITS:
        if np.linalg.norm(factor * measured - expected) <= limit_m:
            return f"the unit is wrong: {name}"
    errors = [float(np.linalg.norm(matrix.T @ measured - expected)) for matrix in _SIGNED_AXES]
    best = int(np.argmin(errors))
    if best and errors[best] <= limit_m:
        return f"the axes are wrong: what should be (x, y, z) is {_name(_SIGNED_AXES[best])}"
    return ""


def explain_lengths(
    cfg: EtalonConfig, expected_m: Vector3, lengths_m: Mapping[int, float], collimators_m: Mapping[int, FloatArray]
) -> str:
    """What turns lengths that give no position near the expected one into ones that do: axes or unit.

    Empty where no such mistake does.

    Args:
        cfg: limits of a solution.
        expected_m: where the puck must be, world frame.
        lengths_m: by channel, as measured.
        collimators_m: by channel, world frame, as configured, shape (3,).
    """
    for name, factor in UNITS:
        scaled = {channel: factor * length for channel, length in lengths_m.items()}
        if _fits(cfg, expected_m, scaled, collimators_m):
            return f"the lengths' unit is wrong: {name}"
        places = {channel: factor * place for channel, place in collimators_m.items()}
        if _fits(cfg, expected_m, lengths_m, places):
            return f"the collimators' unit is wrong: {name}"
    for matrix in _SIGNED_AXES[1:]:
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
