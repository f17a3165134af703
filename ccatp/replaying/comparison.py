"""Pure. Estimates against a reference: the truth of a simulation, or what the run itself estimated."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccatp.mirror.batches import FloatArray
from ccatp.mirror.mirror import Mirror
from ccatp.replaying.trace import IntArray, Trace

REPRODUCED = 1e-9
"""Largest difference, m and rad, with which a replay counts as the run again: rounding and nothing else."""


class Errors(NamedTuple):
    """Differences of an estimate from its reference in the frames that both have.

    Attributes:
        distance_m: along a straight line, shape (k,).
        turn_rad: of the heading, in (-pi, pi], shape (k,).
        is_moving: the wheels turn, shape (k,).
        is_arrival: the robot has just come to rest at a point for the first time, shape (k,).
        nees: normalised estimation error squared of x, y and heading; 3 in the mean where the covariance is right;
            NaN where there is none; shape (k,).
    """

    distance_m: FloatArray
    turn_rad: FloatArray
    is_moving: NDArray[np.bool_]
    is_arrival: NDArray[np.bool_]
    nees: FloatArray


def errors_of(estimate: Trace, reference: Trace, moving: IntArray, arrivals: IntArray) -> Errors:
    """Compare in the frames that both have.

    Args:
        estimate: what is judged.
        reference: by what.
        moving: frames in which the wheels turned.
        arrivals: frames at whose end the robot stood at a point for the first time.
    """
    seqs, i, j = np.intersect1d(estimate.seq, reference.seq, return_indices=True)
    offset = estimate.place[i] - reference.place[j]
    turn = _wrapped(estimate.pose[i, 2] - reference.pose[j, 2])
    nees = np.full(len(seqs), np.nan)
    if estimate.covariance is not None:
        error = np.column_stack([offset[:, :2], turn])
        covariance = estimate.covariance[i]
        is_usable = np.linalg.det(covariance) > 0.0
        solved = np.linalg.solve(covariance[is_usable], error[is_usable][:, :, None])[:, :, 0]
        nees[is_usable] = (error[is_usable] * solved).sum(axis=1)
    distance = np.linalg.norm(offset, axis=1)
    return Errors(distance, turn, np.isin(seqs, moving), np.isin(seqs, arrivals), nees)


def joined(parts: Sequence[Errors]) -> Errors:
    """The errors of all parts of a run."""
    return Errors(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def fix_distances_m(estimate: Trace, feet: FloatArray, mirror: Mirror) -> FloatArray:
    """How far each fix was from the estimate before it, m, shape (f,).

    Args:
        estimate: before each fix.
        feet: frame before the fix, deck x, y of the robot's origin as the fix shows it, shape (f, 3).
        mirror: tells the height of the surface.
    """
    at = np.searchsorted(estimate.seq, feet[:, 0])
    x, y = feet[:, 1], feet[:, 2]
    distances: FloatArray = np.linalg.norm(
        estimate.place[at] - np.column_stack([x, y, mirror.surface.heights_m(x, y)]), axis=1
    )
    return distances


def figures(errors: Errors) -> dict[str, Any]:
    """The figures of a table: lengths in mm, angles in mrad; None where there is nothing to take them from."""
    distance_mm = 1e3 * errors.distance_m
    known = errors.nees[np.isfinite(errors.nees)]
    return {
        "position_error_mm": distribution(distance_mm),
        "moving_error_mm": {"rms": rms(distance_mm[errors.is_moving])},
        "arrival_error_mm": {
            "rms": rms(distance_mm[errors.is_arrival]),
            "max": largest(distance_mm[errors.is_arrival]),
        },
        "heading_error_mrad": {"rms": rms(1e3 * errors.turn_rad)},
        "nees_mean": float(known.mean()) if known.size else None,
    }


def difference(errors: Errors) -> dict[str, Any]:
    """How far replayed estimates are from the recorded ones, and whether that is only rounding."""
    distance, turn = errors.distance_m, np.abs(errors.turn_rad)
    is_same = bool(distance.size and max(distance.max(), turn.max()) <= REPRODUCED)
    return {
        "frames": int(distance.size),
        "position_mm": {"rms": rms(1e3 * distance), "max": largest(1e3 * distance)},
        "heading_mrad": {"rms": rms(1e3 * turn), "max": largest(1e3 * turn)},
        "reproduced": is_same,
    }


def distribution(values: FloatArray) -> dict[str, float | None]:
    """Mean, median, 99th percentile and largest."""
    if not values.size:
        return dict.fromkeys(("mean", "p50", "p99", "max"))
    p50, p99 = np.percentile(values, (50, 99)).tolist()
    return {"mean": float(values.mean()), "p50": p50, "p99": p99, "max": float(values.max())}


def rms(values: FloatArray) -> float | None:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else None


def largest(values: FloatArray) -> float | None:
    """The largest."""
    return float(values.max()) if values.size else None


def _wrapped(turn: FloatArray) -> FloatArray:
    # Exactly nothing for equal angles.
    wrapped: FloatArray = turn - 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
    return wrapped
