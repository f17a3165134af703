"""Pure. A segment driven again by its wheels alone, for several sets of parameters at once."""

from typing import NamedTuple

import numpy as np

from ccatp.calibrating.drive import FloatArray, Segment
from ccatp.localization.terrain import Terrain
from ccatp.mirror.mirror import Mirror

# Frames summed up to a step: at 0.1 m/s and 1 rad/s one of 3 mm or 0.03 rad, whose midpoint rule is exact to 1e-4 of
# the curvature that steering gives it.
STEP_FRAMES = 3


class Wheels(NamedTuple):
    """What turns wheel angles into motion.

    Attributes:
        right_m, left_m: radii.
        base_m: distance of the wheels.
        creep: downhill drift, part of the way.
    """

    right_m: float
    left_m: float
    base_m: float
    creep: float


class Carried(NamedTuple):
    """Where a segment leads from one pose, and how that depends on what is not known.

    Attributes:
        end: x, y (m), heading (rad), deck frame, shape (3,).
        of_wheels: derivatives of ``end`` by the four of ``Wheels``, shape (3, 4).
        of_start: by the pose at the start, shape (3, 3).
        of_slip: by the share of travel that right and left wheel gain in each motion, shape (3, 2 motions).
        turn_rad: the robot's own rotation; what is left of the change of heading the surface's curvature does.
    """

    end: FloatArray
    of_wheels: FloatArray
    of_start: FloatArray
    of_slip: FloatArray
    turn_rad: float


def carry(mirror: Mirror, segment: Segment, start: FloatArray, wheels: Wheels) -> Carried:
    """Drive a segment again.

    The model is that of the localizer (thesis eqs 2.11, 2.14 on the curved surface): with d = (r_R phi_R + r_L phi_L)/2
    and turn = (r_R phi_R - r_L phi_L)/b the deck position moves by d h(psi + turn/2) + c |d| g, and the heading by
    turn - fy (fxx dx + fxy dy) / ((1 + fx^2) W).

    Args:
        mirror: the surface.
        segment: what the wheels turned.
        start: x, y (m), heading (rad), deck frame.
        wheels: the parameters.
    """
    steps = np.array(wheels) * 1e-5
    steps[3] = 1e-3
    columns = 1 + len(wheels) + 1 + 2 * len(segment.motions)
    right_m, left_m = np.full(columns, wheels.right_m), np.full(columns, wheels.left_m)
    base_m, creep = np.full(columns, wheels.base_m), np.full(columns, wheels.creep)
    for k, parameter in enumerate((right_m, left_m, base_m, creep)):
        parameter[1 + k] += steps[k]
    psi = np.full(columns, start[2])
    psi[5] += _TURN_RAD
    grips = [
        (1 + len(wheels) + 1 + 2 * m + side, first, last)
        for m, (first, last) in enumerate(segment.motions)
        for side, (first, last) in ((0, (first, last)), (1, (first, last)))
    ]
    x, y, psi, turned = _drive(mirror, segment, start, psi, (right_m, left_m, base_m, creep), grips)
    ends = np.array([x, y, psi])
    end = ends[:, 0]
    away = ends - end[:, None]
    of_start = np.eye(3)
    of_start[:, 2] = away[:, 5] / _TURN_RAD
    return Carried(end, away[:, 1:5] / steps, of_start, away[:, 6:] / _GRIP, turned)


_TURN_RAD, _GRIP = 1e-5, 1e-4


def _drive(
    mirror: Mirror,
    segment: Segment,
    start: FloatArray,
    psi: FloatArray,
    wheels: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    grips: list[tuple[int, int, int]],
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Step by step, one column for each set of parameters; the surface is that under the first column."""
    right_m, left_m, base_m, creep = wheels
    terrain = Terrain(mirror)
    x, y = np.full(len(psi), start[0]), np.full(len(psi), start[1])
    psi = psi.copy()
    dx0 = dy0 = turned = 0.0
    for first, last in segment.motions:
        for begin in range(first, last, STEP_FRAMES):
            end = min(begin + STEP_FRAMES, last)
            phi_r, phi_l = float(segment.right_rad[begin:end].sum()), float(segment.left_rad[begin:end].sum())
            if phi_r == phi_l == 0.0:  # a counter at rest
                continue
            right, left = right_m * phi_r, left_m * phi_l
            for column, motion_first, motion_last in grips:
                if motion_first <= begin < motion_last:
                    (right if (column - 6) % 2 == 0 else left)[column] *= 1.0 + _GRIP
            d, turn = 0.5 * (right + left), (right - left) / base_m
            # In the middle of the step, as far as the last one tells.
            fx, fy, fxx, fxy, _, gx, gy = terrain.at(float(x[0]) + 0.5 * dx0, float(y[0]) + 0.5 * dy0)
            s2 = 1.0 + fx * fx
            s, norm = s2**0.5, (s2 + fy * fy) ** 0.5
            ex, ey = -fx * fy / (norm * s), s / norm
            middle = psi + 0.5 * turn
            cosine, sine = np.cos(middle), np.sin(middle)
            drift = creep * np.abs(d)
            dx = d * (cosine / s + sine * ex) + drift * gx
            dy = d * sine * ey + drift * gy
            x, y = x + dx, y + dy
            psi = psi + turn - fy * (fxx * dx + fxy * dy) / (s2 * norm)
            dx0, dy0 = float(dx[0]), float(dy[0])
            turned += float(turn[0])
    return x, y, psi, turned
